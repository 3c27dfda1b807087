"""A common interface of oriented images: photographs, line scanners, rational polynomials.

Every pixel has a line of sight X(q), with a parameter q along which positions in another image move
about evenly: the inverse distance 1/s of a photograph, the height of a scanner image.

| | photograph | line scanner, RPC |
|---|---|---|
| q | 1/s, s from the projection centre | height |
| X | object coordinates | east, north of a point in the scene, height; metres |

Matching uses only J = ∂(u, v)/∂X [2, 3] of a view: the direction of its line of
sight is the null vector J₁ × J₂, and the affine transformation from one image to another, through
a plane with the normal n, is

    A = J'·T,        [J; nᵀ]·T = [I; 0].

Arrays are NumPy arrays; points are padded to few sizes, so that few programs are compiled.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree, Shaped, UInt8

from jaxbundle.cameras import CameraModel, default_parameters, get_model, image_ray, project
from jaxbundle.cameras.pixel_frame import pixel_frame
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix
from jaxbundle.io.networks.orientation_covariance import (
    OrientationCovariance,
    Unknown,
    unknowns_of_photograph,
)
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.programs import compile_once

Points = Float[np.ndarray, "n 3"]
Places = Float[np.ndarray, "n 2"]
# Grey values of an image as its file has them: 8 or 16 bits, or floating point.
Grey = Shaped[np.ndarray, "rows columns"]


class OrientedImage(Protocol):
    """An oriented image; (0, 0) is the centre of its upper-left pixel.

    `size`: columns, rows. `grey`: its grey values.
    """

    name: str
    size: tuple[int, int]
    grey: Grey

    def points(self, uv: Places, q: Float[np.ndarray, " n"]) -> Points:
        """The points of lines of sight."""
        ...

    def parameter(self, X: Points) -> Float[np.ndarray, " n"]:
        """q of points."""
        ...

    def project(self, X: Points) -> Places:
        """(u, v) of points; NaN: outside the camera's field of view."""
        ...

    def derivative(self, X: Points) -> Float[np.ndarray, "n 2 3"]:
        """∂(u, v)/∂X."""
        ...

    def bounds(self, uv: Places, low: float, high: float) -> Float[np.ndarray, "n 2"]:
        """Bounds of q, ascending, for heights Z from `low` to `high`."""
        ...


class FrameView:
    """A photograph: camera, projection centre, rotation M from object to camera; `sigma` of X0, Y0,
    Z0, ω, φ, κ (object unit, radians), 0: fixed or not known; `joint`: covariance of these and the
    parameters of the camera with those of the other photographs, used instead of `sigma`;
    `colours()`: its red, green, blue."""

    def __init__(
        self,
        name: str,
        grey: Grey,
        camera: Camera,
        X0: Float[np.ndarray, "3"],
        M: Float[np.ndarray, "3 3"],
        sigma: Float[np.ndarray, "6"] | None = None,
        colours: Callable[[], UInt8[np.ndarray, "rows columns 3"]] | None = None,
        joint: OrientationCovariance | None = None,
    ) -> None:
        self.name, self.grey, self.colours, self.joint = name, grey, colours, joint
        self.sigma = np.nan_to_num(np.zeros(6) if sigma is None else np.asarray(sigma, float))
        self.size = (grey.shape[1], grey.shape[0])
        model = get_model(camera.model)
        if camera.image_size is not None and tuple(camera.image_size) != self.size:
            raise InputError(
                f"{name}: the photograph has {self.size[0]} × {self.size[1]} pixels, camera "
                f"{camera.id} {camera.image_size[0]} × {camera.image_size[1]}; give the photograph "
                "the camera was calibrated for"
            )
        try:
            origin, step = pixel_frame(model, self.size, camera.pixel_size)
        except ValueError as error:
            raise InputError(f"camera {camera.id}: {error}") from None
        parameters = {**default_parameters(model), **camera.parameters}
        self.camera, self.X0, self.M = camera, np.asarray(X0, float), np.asarray(M, float)
        p = np.array([float(parameters.get(n, 0.0)) for n in model.parameters])
        self.frame = PhotographFrame(model, *map(jnp.asarray, (p, self.X0, self.M, origin, step)))
        edge = self.edge()
        axis = self.points(edge, np.ones(len(edge))) - self.X0
        # Far outside the image the polynomials of distortion may turn back and project a point into
        # it, so that rays farther from the axis than those of the image are excluded. 2 %: the
        # farthest ray of the image may be between the sampled ones.
        self._farthest = 1.02 * float(np.nanmax(np.arccos(np.clip(-axis @ self.M[2], -1, 1))))

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Of its orientation and camera, also held ones."""
        return unknowns_of_photograph(self.name, self.camera.id, self.frame.model.parameters)

    def derivative_by_orientation(self, X: Points) -> Float[np.ndarray, "n 2 k"]:
        """∂(u, v)/∂(X0, Y0, Z0, ω, φ, κ, parameters), pixels per object unit, radian, unit of the
        parameter."""
        return run_in_lanes(_by_orientation, self.frame, X)

    def edge(self) -> Places:
        """Positions along and across the whole image, including its edges."""
        # 17 positions a side: distortion is smooth, and only the extent of the rays is used
        u, v = (np.linspace(-0.5, n - 0.5, 17) for n in self.size)
        return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)

    def points(self, uv: Places, q: Float[np.ndarray, " n"]) -> Points:
        return run_in_lanes(_points, self.frame, uv, q)

    def parameter(self, X: Points) -> Float[np.ndarray, " n"]:
        return 1 / np.linalg.norm(X - self.X0, axis=1)

    def project(self, X: Points) -> Places:
        d = X - self.X0
        with np.errstate(invalid="ignore", divide="ignore"):
            # M[2] points backwards: the camera looks along −z, as in photogrammetry
            angle = np.arccos(np.clip(-(d @ self.M[2]) / np.linalg.norm(d, axis=1), -1, 1))
        uv = run_in_lanes(_project, self.frame, X)
        return np.where((angle <= self._farthest)[:, None], uv, np.nan)

    def derivative(self, X: Points) -> Float[np.ndarray, "n 2 3"]:
        return run_in_lanes(_derivative, self.frame, X)

    def bounds(self, uv: Places, low: float, high: float) -> Float[np.ndarray, "n 2"]:
        d = self.points(uv, np.ones(len(uv))) - self.X0
        with np.errstate(divide="ignore", invalid="ignore"):
            # X0 + t·d has the height Z at t = (Z − Z0)/d_z, and q = 1/t: the order turns round. A
            # ray that reaches only one of the heights in front of the camera is not bounded there
            # (q = 0), one that reaches neither has no range (NaN).
            t = np.sort((np.array([low, high]) - self.X0[2]) / d[:, 2:], axis=1)
            return 1 / np.where(t[:, ::-1] > 0, t[:, ::-1], [np.nan, 0.0])


class PhotographFrame(eqx.Module):
    """The quantities on which image coordinates of a photograph depend."""

    model: CameraModel = eqx.field(static=True)
    p: Float[Array, " parameters"]
    X0: Float[Array, "3"]
    M: Float[Array, "3 3"]
    origin: Float[Array, "2"]
    step: Float[Array, "2"]


def frame_views(
    network: Network,
    greys: Sequence[np.ndarray],
    colours: Sequence[Callable | None] | None = None,
    joint: OrientationCovariance | None = None,
) -> tuple[FrameView, ...]:
    """The oriented photographs of a network, a view for each image."""
    images = network.images
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(images.angles)))
    colours = colours or [None] * len(images)
    return tuple(
        FrameView(name, grey, network.cameras[c], X0, m, sigma, sigma_of_reading, joint)
        for name, grey, c, X0, m, sigma, sigma_of_reading in zip(
            images.id, greys, images.camera, images.position, M, images.sigma, colours
        )
    )


def line_of_sight(J: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 3"]:
    """Directions, of length 1, in which the image of a point does not change."""
    d = np.cross(J[:, 0], J[:, 1])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def steps_on_plane(
    J: Float[np.ndarray, "n 2 3"], normal: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 2"]:
    """T: the displacement on a plane for a step of one pixel."""
    stacked = np.concatenate([J, normal[:, None]], axis=1)
    return np.linalg.inv(stacked)[:, :, :2]


def is_inside(view: OrientedImage, uv: Places, margin: float = 0.0) -> Bool[np.ndarray, " n"]:
    """Which positions are in the image, at least `margin` pixels from its edge."""
    columns, rows = view.size
    with np.errstate(invalid="ignore"):
        return (
            (uv[:, 0] >= margin)
            & (uv[:, 0] <= columns - 1 - margin)
            & (uv[:, 1] >= margin)
            & (uv[:, 1] <= rows - 1 - margin)
        )


def run_in_lanes(
    program: Callable, frame: PyTree, *arrays: Shaped[np.ndarray, "n ..."]
) -> np.ndarray:
    """The results of a compiled program for arrays [n, …], in padded blocks."""
    n = len(arrays[0])
    # XLA compiles for one shape: with only two block sizes no number of points compiles again.
    # The small one is for the few points of bounds and overlaps.
    lanes = 8192 if n > 512 else 512
    parts = []
    for begin in range(0, max(n, 1), lanes):
        lane_rows = np.minimum(np.arange(begin, begin + lanes), max(n - 1, 0))
        if n == 0:
            arrays = tuple(np.zeros((1, *np.shape(a)[1:])) for a in arrays)
            lane_rows = np.zeros(lanes, int)
        parts.append(np.asarray(program(frame, *(np.asarray(a)[lane_rows] for a in arrays))))
    return np.concatenate(parts)[:n]


def _point(frame: PhotographFrame, uv: Float[Array, "2"], q: Float[Array, ""]) -> Float[Array, "3"]:
    xy = (uv - frame.origin) / frame.step
    ray = jnp.stack(image_ray(frame.model, tuple(frame.p), xy[0], xy[1]))
    return frame.X0 + frame.M.T @ ray / q


def pixel_of(frame: PhotographFrame, X: Float[Array, "3"]) -> Float[Array, "2"]:
    """(u, v) of a point, by the frame of a photograph."""
    r, s, q = frame.M @ (X - frame.X0)
    xy = jnp.stack(project(frame.model, tuple(frame.p), r, s, q))
    return frame.origin + frame.step * xy


@compile_once
def _points(
    frame: PhotographFrame, uv: Float[Array, "n 2"], q: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    return jax.vmap(partial(_point, frame))(uv, q)


@compile_once
def _project(frame: PhotographFrame, X: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
    return jax.vmap(partial(pixel_of, frame))(X)


@compile_once
def _derivative(frame: PhotographFrame, X: Float[Array, "n 3"]) -> Float[Array, "n 2 3"]:
    return jax.vmap(jax.jacfwd(partial(pixel_of, frame)))(X)


@compile_once
def _by_orientation(frame: PhotographFrame, X: Float[Array, "n 3"]) -> Float[Array, "n 2 k"]:
    angles = omega_phi_kappa_from_matrix(frame.M)

    def pixel(theta: Float[Array, " k"], X: Float[Array, "3"]) -> Float[Array, "2"]:
        M = matrix_from_omega_phi_kappa(theta[3:6])
        moved_frame = eqx.tree_at(lambda f: (f.X0, f.M, f.p), frame, (theta[:3], M, theta[6:]))
        return pixel_of(moved_frame, X)

    theta = jnp.concatenate([frame.X0, angles, frame.p])
    return jax.vmap(jax.jacfwd(pixel), (None, 0))(theta, X)
