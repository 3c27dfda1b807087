"""Images of line scanners and of rational polynomials as oriented images.

Their points X are metres in the neighbourhood of an origin (λ₀, φ₀) on the ellipsoid,

    X = (λ − λ₀)·N·cos φ₀,    Y = (φ − φ₀)·M,    Z = h,

N and M the radii of curvature across and along the meridian: coordinates as smooth as the Earth, in
which heights are heights. A scanner in a local frame keeps its own coordinates.
"""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, earth_fixed, geodetic
from jaxbundle.io.networks.orientation_covariance import OrientationCovariance, Unknown
from jaxbundle.pushbroom.ground_to_image import make_search, project_near, project_points
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.rpc.bias import BiasDomain
from jaxbundle.pushbroom.rpc.polynomials import Rpc, locate, project
from jaxbundle.pushbroom.surfaces import Height, Plane
from jaxbundle.surfaces.ground_orientation import (
    GroundOrientation,
    bias_derivative,
    scanner_derivative,
)
from jaxbundle.surfaces.views import Grey, Places, Points, run_in_lanes
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


class Neighbourhood(eqx.Module):
    """The origin (λ₀, φ₀), radians, and metres per radian of longitude and latitude there."""

    longitude: Float[Array, ""]
    latitude: Float[Array, ""]
    scale: Float[Array, "2"]

    def geographic(
        self, X: Float[AnyArray, "3 *n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[AnyArray, "*n"]]:
        """(λ, φ, h) of a point."""
        return self.longitude + X[0] / self.scale[0], self.latitude + X[1] / self.scale[1], X[2]

    def local(
        self,
        longitude: Scalar,
        latitude: Scalar,
        h: Scalar,
    ) -> Float[Array, "3 *n"]:
        """The point of (λ, φ, h); longitudes may differ by whole turns."""
        east = longitude - self.longitude
        east = east - 2 * jnp.pi * jnp.round(east / (2 * jnp.pi))
        return jnp.stack([self.scale[0] * east, self.scale[1] * (latitude - self.latitude), h])


def neighbourhood(longitude: float, latitude: float, earth: Ellipsoid = WGS84) -> Neighbourhood:
    """Around an origin given in radians."""
    a, c = float(earth.a), float(earth.c)
    e2 = 1 - (c / a) ** 2
    w = np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    scale = a / w * np.cos(latitude), a * (1 - e2) / w**3
    return Neighbourhood(jnp.asarray(longitude), jnp.asarray(latitude), jnp.asarray(scale))


class _GroundView:
    """Common base of both kinds: heights are the parameters of their lines of sight."""

    shift = (0.0, 0.0)
    """Added to projected positions (u, v): the estimated error of the orientation."""
    _point: ClassVar[Callable]
    orientation: GroundOrientation | None = None
    """What a refinement says of the errors of its orientation."""

    def __init__(self, name: str, grey: Grey, frame: PyTree) -> None:
        self.name, self.grey, self._frame = name, grey, frame
        self.size = (grey.shape[1], grey.shape[0])

    def points(self, uv: Places, q: Float[np.ndarray, " n"]) -> Points:
        return run_in_lanes(self._point, self._frame, uv - np.array(self.shift), q)

    def parameter(self, X: Points) -> Float[np.ndarray, " n"]:
        return X[:, 2]

    def bounds(self, uv: Places, low: float, high: float) -> Float[np.ndarray, "n 2"]:
        return np.broadcast_to(np.array([low, high], float), (len(uv), 2)).copy()

    @property
    def joint(self) -> OrientationCovariance | None:
        """The covariance of the orientations of its refinement."""
        return None if self.orientation is None else self.orientation.joint

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Of its orientation, that are not held."""
        return () if self.orientation is None else self.orientation.unknowns


class RpcView(_GroundView):
    """An image with rational polynomials."""

    def __init__(self, name: str, grey: Grey, rpc: Rpc, around: Neighbourhood) -> None:
        super().__init__(name, grey, (rpc, around))
        self.rpc, self.neighbourhood = rpc, around

    _point = staticmethod(lambda frame, uv, q: _rpc_points(frame, uv, q))

    def project(self, X: Points) -> Places:
        return run_in_lanes(_rpc_project, self._frame, X) + np.array(self.shift)

    def derivative(self, X: Points) -> Float[np.ndarray, "n 2 3"]:
        return run_in_lanes(_rpc_derivative, self._frame, X)

    def derivative_by_orientation(self, X: Points) -> Float[np.ndarray, "n 2 k"]:
        """∂(u, v) by the unknowns."""
        if self.orientation is None or self.orientation.domain is None:
            return np.zeros((len(X), 2, 0))
        frame = (*self._frame, BiasDomain(*map(jnp.asarray, self.orientation.domain)))
        return run_in_lanes(_rpc_by_bias, frame, X)[:, :, list(self.orientation.columns)]

    def range(self) -> tuple[float, float]:
        """The range of heights of the polynomials."""
        middle, half_range = float(self.rpc.height_offset), abs(float(self.rpc.height_scale))
        return middle - half_range, middle + half_range


class ScannerView(_GroundView):
    """An image of a line scanner; `around` is None in a local frame."""

    def __init__(
        self,
        name: str,
        grey: Grey,
        image: PushbroomImage,
        earth: Ellipsoid | None,
        around: Neighbourhood | None,
    ) -> None:
        super().__init__(name, grey, _Scanner(image, around, earth))
        self.image, self.search = image, make_search(image, earth)

    _point = staticmethod(lambda frame, uv, q: _scanner_points(frame, uv, q))

    def project(self, X: Points) -> Places:
        return run_in_lanes(
            lambda frame, X: self._locate(_trajectory_points(frame, X)), self._frame, X
        ) + np.array(self.shift)

    def _locate(self, X: Float[Array, "3 n"]) -> Places:
        # Positions up to 200 pixels outside the image are found as well, so that segments that
        # leave it have both ends.
        projected = project_points(self.image, self.search, X, margin=200.0)
        return np.stack([np.asarray(projected.pixel[0]), np.asarray(projected.line[0])], 1)

    def derivative(self, X: Points) -> Float[np.ndarray, "n 2 3"]:
        places = np.nan_to_num(self.project(X) - np.array(self.shift))
        return run_in_lanes(_scanner_derivative, self._frame, X, places)

    def derivative_by_orientation(self, X: Points) -> Float[np.ndarray, "n 2 k"]:
        """∂(u, v) by the unknowns."""
        if self.orientation is None:
            return np.zeros((len(X), 2, 0))
        # Without the shift, and of points outside the image those of its corner, finite.
        places = np.nan_to_num(self.project(X) - np.array(self.shift))
        Xt = run_in_lanes(lambda frame, X: _trajectory_points(frame, X).T, self._frame, X)
        return scanner_derivative(self.orientation, self.image, self._frame.earth, Xt, places)


GroundView = RpcView | ScannerView


class _Scanner(eqx.Module):
    """What the positions of a scanner image depend on."""

    image: PushbroomImage
    neighbourhood: Neighbourhood | None
    earth: Ellipsoid | None = eqx.field(static=True)

    def to_trajectory(self, X: Float[Array, "3"]) -> Float[Array, "3"]:
        """A point in the coordinates of the trajectory."""
        if self.neighbourhood is None or self.earth is None:
            return X
        return jnp.stack(earth_fixed(self.earth, self.neighbourhood.geographic(X)))


@compile_once
def _rpc_points(
    frame: tuple[Rpc, Neighbourhood], uv: Float[Array, "n 2"], q: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    rpc, around = frame

    def point(uv: Float[Array, "2"], h: Float[Array, ""]) -> Float[Array, "3"]:
        longitude, latitude, _ = locate(rpc, uv[1], uv[0], h)
        return around.local(longitude, latitude, h)

    return jax.vmap(point)(uv, q)


def _rpc_pixel(frame: tuple[Rpc, Neighbourhood], X: Float[Array, "3"]) -> Float[Array, "2"]:
    rpc, around = frame
    line, sample = project(rpc, *around.geographic(X))
    return jnp.stack([sample, line])


@compile_once
def _rpc_project(frame: tuple[Rpc, Neighbourhood], X: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
    return jax.vmap(partial(_rpc_pixel, frame))(X)


@compile_once
def _rpc_derivative(
    frame: tuple[Rpc, Neighbourhood], X: Float[Array, "n 3"]
) -> Float[Array, "n 2 3"]:
    return jax.vmap(jax.jacfwd(partial(_rpc_pixel, frame)))(X)


@compile_once
def _rpc_by_bias(
    frame: tuple[Rpc, Neighbourhood, BiasDomain], X: Float[Array, "n 3"]
) -> Float[Array, "n 2 terms"]:
    rpc, around, domain = frame
    return jax.vmap(lambda X: bias_derivative(rpc, domain, *around.geographic(X)))(X)


@compile_once
def _scanner_points(
    frame: _Scanner, uv: Float[Array, "n 2"], q: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    def point(uv: Float[Array, "2"], h: Float[Array, ""]) -> Float[Array, "3"]:
        if frame.neighbourhood is None or frame.earth is None:
            return jnp.stack(locate_point(frame.image, Plane(level=h), uv[1], uv[0]))
        X = locate_point(frame.image, Height(level=h, earth=frame.earth), uv[1], uv[0])
        return frame.neighbourhood.local(*geodetic(frame.earth, X))

    return jax.vmap(point)(uv, q)


@compile_once
def _trajectory_points(frame: _Scanner, X: Float[Array, "n 3"]) -> Float[Array, "3 n"]:
    return jax.vmap(frame.to_trajectory)(X).T


@compile_once
def _scanner_derivative(
    frame: _Scanner, X: Float[Array, "n 3"], places: Float[Array, "n 2"]
) -> Float[Array, "n 2 3"]:
    def pixel(X: Float[Array, "3"], place: Float[Array, "2"]) -> Float[Array, "2"]:
        line, u = project_near(frame.image, frame.to_trajectory(X), place[1], place[0], frame.earth)
        return jnp.stack([u, line])

    return jax.vmap(jax.jacfwd(pixel))(X, places)
