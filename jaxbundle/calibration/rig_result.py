"""The result of a rig: the mountings of its cameras, and the cameras as they are in it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle import plotting
from jaxbundle.adjustment.rig import RigSolution
from jaxbundle.adjustment.rig_normal import (
    RigCamera,
    RigObject,
    interior_columns,
    mounting_columns,
)
from jaxbundle.calibration.frames import unit_size
from jaxbundle.calibration.quality import DRAWN, GRID, Coverage, UncertaintyMap
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig_quality import rig_coverage, rig_points, rig_uncertainty
from jaxbundle.cameras import get_model
from jaxbundle.geometry import matrix_from_rotation_vector, omega_phi_kappa_near
from jaxbundle.geometry import omega_phi_kappa_from_matrix as angles_of
from jaxbundle.network.tables import Camera


@dataclasses.dataclass(frozen=True)
class Mounting:
    """Where a camera sits in the frame of the reference camera.

    **Fields:** `base`: its projection centre, object unit; `rotation`: R, from the reference's
    frame to its own; `angles`: ω, φ, κ of R, degrees; `covariance` [6, 6] of base and angles, a
    posteriori; `length` of the base and its σ.
    """

    base: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    angles: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "6 6"]
    length: float
    length_sigma: float

    @property
    def sigma(self) -> Float[np.ndarray, "6"]:
        """σ of base (object unit) and ω, φ, κ (degrees)."""
        return np.sqrt(np.diagonal(self.covariance))


class RigCalibration:
    """Cameras of one mounting, calibrated together.

    **Attributes:** `cameras`: the calibrations of each by itself; `mountings`, `parameters`,
    `sigma` of the common adjustment, by camera; `board`: its points [points, 3]; `epochs`;
    `measured`: the image points used; `left_out`, and `contradicting` that were kept
    all the same: epoch and reason; `rms` (pixels) by camera;
    `sigma0`, `redundancy`, `converged`.
    """

    def __init__(
        self, cameras, rig, known: RigObject, epochs, left_out, solution: RigSolution,
        contradicting=(),
    ):  # fmt: skip
        self.cameras: dict[str, Calibration] = cameras
        self.measured: list[RigCamera] = rig
        self._maps: dict[tuple, UncertaintyMap] = {}
        self.known = known
        self.epochs: tuple[str, ...] = epochs
        self.left_out: tuple[tuple[str, str], ...] = left_out
        self.contradicting: tuple[tuple[str, str], ...] = contradicting
        self.solution = solution

    @property
    def names(self) -> list[str]:
        return list(self.cameras)

    @property
    def converged(self) -> bool:
        return self.solution.converged

    @property
    def sigma0(self) -> float:
        return self.solution.sigma0

    @property
    def redundancy(self) -> int:
        return self.solution.redundancy

    @functools.cached_property
    def rms(self) -> dict[str, float]:
        """√(Σ|v|²/points) in pixels, by camera."""
        found = {}
        for name, v in zip(self.names, self.solution.residuals):
            given = self.cameras[name].camera
            v = v / np.array(unit_size(get_model(given.model), given.pixel_size))
            found[name] = float(np.sqrt(np.nanmean((v**2).sum(2))))
        return found

    @property
    def board(self) -> Float[np.ndarray, "points 3"]:
        """Adjusted coordinates of the board, object unit."""
        nominal = next(iter(self.cameras.values())).views.board.points
        return self.solution.values.points + nominal.mean(0)

    @functools.cached_property
    def parameters(self) -> dict[str, dict[str, float]]:
        """Parameters of every camera by name."""
        return {
            name: dict(zip(get_model(self.cameras[name].camera.model).parameters, p.tolist()))
            for name, p in zip(self.names, self.solution.values.interior)
        }

    @functools.cached_property
    def sigma(self) -> dict[str, dict[str, float]]:
        """σ of the free parameters of every camera, a posteriori."""
        Q, found = self.solution.cofactors, {}
        for k, name in enumerate(self.names):
            own = interior_columns(self.measured, k)
            sigma = self.sigma0 * np.sqrt(np.diagonal(Q)[own])
            names = get_model(self.cameras[name].camera.model).parameters
            found[name] = {names[c]: float(s) for c, s in zip(self.measured[k].free, sigma)}
        return found

    @functools.cached_property
    def mountings(self) -> dict[str, Mounting]:
        """The mounting of every camera but the reference, the first."""
        found = {}
        for k, name in enumerate(self.names[1:], 1):
            own = mounting_columns(self.measured, k)
            C = self.sigma0**2 * self.solution.cofactors[own, own]
            at = self.solution.values
            found[name] = _mounting(at.base[k], at.turn[k], C)
        return found

    def camera(self, name: str) -> Camera:
        """A camera with the parameters of the common adjustment, held."""
        return dataclasses.replace(self.cameras[name].camera, parameters=self.parameters[name])

    @property
    def distance(self) -> float:
        """The median distance of the board from the reference camera, object unit."""
        return float(np.median(np.linalg.norm(self.solution.values.shift, axis=1)))

    def coverage(self, name: str) -> Coverage:
        """Where in the image of a camera the rig has points."""
        return rig_coverage(self, name)

    def uncertainty(
        self, name: str, distance: float = np.inf, frame: str = "rig", grid=GRID
    ) -> UncertaintyMap:
        """Uncertainty of a projected point over the image of a camera, pixels; frames: see
        `jaxbundle.calibration.rig_quality`."""
        key = (name, distance, frame, grid)
        if key not in self._maps:
            self._maps[key] = rig_uncertainty(self, name, distance, frame, grid)
        return self._maps[key]

    def reported_maps(self, name: str) -> list[UncertaintyMap]:
        """At the distance of the board, at ten times that, at infinity; and without mounting."""
        chosen = (("rig", self.distance), ("rig", 10 * self.distance), ("rig", np.inf),
                  ("rotation", np.inf))  # fmt: skip
        return [self.uncertainty(name, distance, frame) for frame, distance in chosen]

    def plot_coverage(self, name: str, ax=None):
        """Where in the image of a camera the rig has points; matplotlib axes."""
        size = self.cameras[name].views.image_size
        return plotting.coverage_map(self.coverage(name), rig_points(self, name), size, name, ax)

    def plot_uncertainty(self, name: str, distance: float = np.inf, frame: str = "rig", ax=None):
        """σ of a projected point over the image of a camera; matplotlib axes."""
        found, one = self.uncertainty(name, distance, frame, DRAWN), self.cameras[name]
        unit = one.adjustment.network.object_unit
        return plotting.uncertainty_image(found, one.views.image_size, unit, name, ax)

    def __str__(self) -> str:
        lines = [f"Rig of {len(self.cameras)} cameras, {len(self.epochs)} epochs, σ0 "
                 f"{self.sigma0:.3f}, reference {self.names[0]}"]  # fmt: skip
        for name, m in self.mountings.items():
            lines.append(f"{name}: base {m.length:.6g} ± {m.length_sigma:.2g}")
        return "\n".join(lines)


@jax.jit
def _to_angles(base, turn):
    """Length of the base, ω, φ, κ in degrees, and derivatives of base and angles by (δb, δθ)."""

    def mounting(change):
        R = matrix_from_rotation_vector(change[3:]) @ turn
        angles = jnp.degrees(omega_phi_kappa_near(R, angles_of(turn)))
        return jnp.concatenate([base + change[:3], angles])

    zero = jnp.zeros(6)
    return mounting(zero)[3:], jax.jacfwd(mounting)(zero)


def _mounting(base, turn, C) -> Mounting:
    angles, J = map(np.asarray, _to_angles(base, turn))
    length = float(np.linalg.norm(base))
    along = base / length if length else np.zeros(3)
    return Mounting(
        np.asarray(base), np.asarray(turn), angles, J @ C @ J.T, length,
        float(np.sqrt(along @ C[:3, :3] @ along)),
    )  # fmt: skip
