"""Errors that image points of a rig share, as of one camera
(`adjustment.quality.correlated_errors`): photographs are those of a camera at an epoch."""

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.quality.correlated_errors import (
    CorrelationSettings,
    ImageRows,
    StationsAndPoints,
    components_of,
    with_given_points_and_others,
)
from jaxbundle.calibration.rig.declare import Rig, used_rays
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.quality.error_components import ErrorModel, fit_error_model
from jaxbundle.leastsquares.quality.error_effects import first_rows, stack_rows
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def rig_errors(rig: Rig, solution: Solution, settings: CorrelationSettings) -> ErrorModel | None:
    """The error model of an adjusted rig; None where its image points cannot show any component."""
    starts, row = first_rows(solution), np.zeros(len(rig.xy), int)
    for table, rows in rig.sets:
        row[rows] = starts[table.image_set] + 2 * np.arange(len(rows))
    is_used = used_rays(rig, solution.problem)
    # Computed − measured.
    xy = rig.xy + rig.in_order(solution.residuals) * rig.sigma
    epochs = len(rig.epochs)
    image = rig.camera * epochs + rig.epoch
    rays = ImageRows(
        row[is_used],
        image[is_used],
        # A body moves between epochs, but its points and their errors are the same.
        rig.point[is_used],
        rig.camera[is_used],
        xy[is_used],
        rig.sigma[is_used],
        len(stack_rows(solution, solution.residuals)),
    )
    components = components_of(rays, _scene(rig, solution), rig.cameras, settings)
    components = with_given_points_and_others(components, rays, solution, settings)
    return fit_error_model(solution, components, settings.estimation) if components else None


def _scene(rig: Rig, solution: Solution) -> StationsAndPoints:
    """The stations of all photographs in the frames of their bodies, X0_e + M_eᵀ·b_k, and the
    points."""
    position, rotation = (np.asarray(x) for x in rig.poses(solution.values))
    base = np.asarray(solution.values["mounting"].position)
    turned = np.einsum("eij,ki->kej", np.asarray(_matrices(rotation)), base)
    X = np.asarray(solution.values["point"])[:, :3]
    return StationsAndPoints((position + turned).reshape(-1, 3), X)


@compile_once
def _matrices(rotation: Float[AnyArray, "n 4"]) -> Float[Array, "n 3 3"]:
    return jax.vmap(matrix_from_quaternion)(rotation)
