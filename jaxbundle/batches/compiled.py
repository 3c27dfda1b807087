"""The programs of a batch: all cameras of a portion solved, or their points tested, in one call.

Each is compiled once for a model, its free parameters and the padded sizes of a portion."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from jaxbundle.batches.camera import (
    CameraSolution,
    solve_camera,
)
from jaxbundle.batches.input import Portion
from jaxbundle.batches.normal import POSE, CameraUnknowns, Sightings, residual_lengths
from jaxbundle.batches.pope_tests import point_tests
from jaxbundle.batches.start import start_values
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    omega_phi_kappa_from_matrix,
)
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

# Fields of a `BatchCalibration`, and what it is made of, by name.
Rows = dict[str, Shaped[np.ndarray, "cameras *axes"]]


class ProgramKey(NamedTuple):
    """What is compiled into the programs of a call: the camera model, the columns of its free
    parameters, whether the start values have focal lengths, and whether the cameras of a portion
    come one after the other or all at once."""

    model: CameraModel
    free: tuple[int, ...]
    has_focal_length: bool
    on_cpu: bool

    def for_every(self, function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """The function of one camera for all of a portion (see the module)."""
        return partial(jax.lax.map, function) if self.on_cpu else jax.vmap(function)


@partial(compile_once, static=0)
def tests_of_points(
    key: ProgramKey,
    sightings: Sightings,
    is_used: Float[AnyArray, "cameras views points"],
    unknowns: CameraUnknowns,
    views: Bool[AnyArray, "cameras views"],
) -> Float[Array, "cameras views points"]:
    def test(
        arguments: tuple[Sightings, Array, CameraUnknowns, Array],
    ) -> Float[AnyArray, "views points"]:
        sightings, is_used, unknowns, views = arguments
        sightings = Sightings(sightings.point, sightings.xy, sightings.weight * views[:, None])
        return point_tests(key.model, key.free, sightings, sightings.weight * is_used, unknowns)

    return key.for_every(test)((sightings, is_used, unknowns, views))


def solve_portion(key: ProgramKey, max_steps: int, size: float, portion: Portion) -> Rows:
    """The rows of a `BatchCalibration`, with the status as its number."""
    data = in_double(portion.sightings), portion.interior, portion.axes, portion.middle
    result = _portion_program(key, portion.flat, max_steps, size, *data)
    return jax.tree.map(np.array, result)


def in_double(sightings: Sightings) -> Sightings:
    """On the device, in double precision: one program for measurements in either."""
    return jax.tree.map(lambda x: jnp.asarray(x).astype(float), sightings)


@partial(compile_once, static=(0, 1))
def _portion_program(
    key: ProgramKey,
    flat: bool,
    max_steps: int,
    size: float,
    sightings: Sightings,
    interior: Float[AnyArray, "cameras parameters"],
    axes: Float[AnyArray, "cameras 3 3"],
    middle: Float[AnyArray, "cameras 3"],
) -> dict[str, Array]:
    model, free = key.model, key.free

    def calibrate(arguments: tuple[Sightings, Array]) -> tuple[CameraSolution, Float[Array, ""]]:
        sightings, interior = arguments
        usable, start = start_values(model, flat, key.has_focal_length, sightings, interior, size)
        solved = solve_camera(model, free, max_steps, size, usable, start)
        return solved, jnp.sum(residual_lengths(model, usable, solved.unknowns))

    solved, lengths = key.for_every(calibrate)((sightings, interior))
    # A posteriori, since nobody stated a σ: Σ = σ0²·Q. The number of points follows from the
    # redundancy, 2·points − k − 6·views.
    variance = 2 * solved.cost / solved.redundancy
    covariance = variance[:, None, None] * solved.interior_cofactors
    points = 0.5 * (solved.redundancy + len(free) + POSE * solved.views.sum(1))
    rotation, position, angles, pose_sigma = jax.vmap(
        jax.vmap(_exterior_orientation, (0, 0, 0, None, None))
    )(solved.unknowns.rotation, solved.unknowns.shift, solved.pose_cofactors, axes, middle)
    pose_sigma = jnp.sqrt(variance)[:, None, None] * pose_sigma
    return dict(
        status=solved.status,
        values=solved.unknowns.interior[:, jnp.array(free)],
        sigma=jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2)),
        covariance=covariance,
        reduced=solved.reduced,
        interior=solved.unknowns.interior,
        sigma0=jnp.sqrt(variance),
        rms=jnp.sqrt(2 * solved.cost / points),
        mean_length=lengths / points,
        quaternion=solved.unknowns.rotation,
        shift=solved.unknowns.shift,
        redundancy=solved.redundancy,
        iterations=solved.steps,
        views=solved.views,
        position=position,
        angles=angles,
        sigma_position=pose_sigma[..., :3],
        sigma_angles=pose_sigma[..., 3:],
        rotation=rotation,
    )


def _exterior_orientation(
    quaternion: Float[Array, "4"],
    shift: Float[Array, "3"],
    Q: Float[Array, "6 6"],
    axes: Float[AnyArray, "3 3"],
    middle: Float[AnyArray, "3"],
) -> tuple[Array, Array, Array, Array]:
    """M, X0, (ω, φ, κ) and their σ for σ₀ = 1 of one view, from the cofactors Q of (δt, δθ).

    ray = M'·A·(X − X̄) + t, so that M = M'·A and X0 = X̄ − Mᵀ·t; A: the object's principal axes.
    """

    orientation, M = _pose(quaternion, shift, axes, middle, jnp.zeros(6))
    J = exterior_slopes(quaternion, shift, axes, middle)
    return M, orientation[:3], orientation[3:], jnp.sqrt(jnp.diagonal(J @ Q @ J.T))


def _pose(
    quaternion: Float[AnyArray, "4"],
    shift: Float[AnyArray, "3"],
    axes: Float[AnyArray, "3 3"],
    middle: Float[AnyArray, "3"],
    change: Float[Array, "6"],
) -> tuple[Array, Array]:
    """X0, (ω, φ, κ) and M of a view after a change (δt, δθ)."""
    M = matrix_from_rotation_vector(change[3:]) @ matrix_from_quaternion(quaternion) @ axes
    X0 = middle - M.T @ (shift + change[:3])
    return jnp.concatenate([X0, omega_phi_kappa_from_matrix(M)]), M


def exterior_slopes(
    quaternion: Float[AnyArray, "4"],
    shift: Float[AnyArray, "3"],
    axes: Float[AnyArray, "3 3"],
    middle: Float[AnyArray, "3"],
) -> Float[Array, "6 6"]:
    """The derivatives of X0 and ω, φ, κ of a view by (δt, δθ)."""
    pose = partial(_pose, quaternion, shift, axes, middle)
    return jax.jacfwd(pose, has_aux=True)(jnp.zeros(6))[0]
