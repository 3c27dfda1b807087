"""The network of all pairs of stations and targets: the problem whose precision is designed.

Measured image points are unchanged; every other pair of a station and a target is an observation
whose 1/σ is multiplied by its visibility, so that its weight p = 1/σ² is multiplied by the square.
"""

import dataclasses
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbundle.adjustment.problem import NetworkProblem, make_problem
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.leastsquares.problem import fill_data
from jaxbundle.network.check import check_tables
from jaxbundle.network.kinds import CameraParameters
from jaxbundle.network.tables import Network, Observations, Source, require_network
from jaxbundle.network_design.aims import (
    Aim,
    Task,
    log_aim,
    points_of_interest,
    refuse_arbitrary,
    task_of,
)
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.visibility import (
    Rules,
    UsableFormat,
    image_of,
    margins,
    rules_of,
    view_of,
    visibility,
    visible,
)
from jaxbundle.types import AnyArray

# Of a determined target: four coordinates for three unknowns.
MIN_RAYS = 2
# Of an included photograph: six coordinates for six unknowns.
MIN_TARGETS = 3
# Of the rays of an excluded photograph, the factor of 1/σ: 1e-7 of its information, which no aim
# shows, and far above rounding (1e-16), so that its orientation stays determined.
IDLE_VISIBILITY = 3e-4


@dataclasses.dataclass(frozen=True)
class StationTargetPairs:
    """A problem of all pairs, its aim and its conditions.

    `given_visibility`: of rays independent of the design, 1 for measured and 0 for missing ones;
    NaN for all others. `views`: the image of every camera; `rules`: the conditions of rays;
    `normals`: of all points; `interest`: the points of the aim.
    """

    problem: NetworkProblem
    aim: Aim
    task: Task
    conditions: Conditions
    given_visibility: Float[np.ndarray, " rays"]
    views: tuple[UsableFormat, ...]
    rules: Rules
    normals: Float[np.ndarray, "points 3"] | None
    interest: Bool[np.ndarray, " points"]

    @property
    def soft(self) -> Bool[np.ndarray, " rays"]:
        """Which rays depend on the design."""
        return np.isnan(self.given_visibility)

    def of_camera(self, c: int) -> Int[np.ndarray, " rows"]:
        """The rays of a camera."""
        return np.flatnonzero(self.problem.camera == c)

    def each_ray(self, function: Callable[..., PyTree], values: Values) -> Any:
        """`function(view, position, rotation, interior, point, normal)` of every ray, stacked in
        their order."""
        image, point, by_view, order = self.problem.image, self.problem.point, [], []
        for c, view in enumerate(self.views):
            rows = self.of_camera(c)
            table, row = self.problem.table_of_camera(c)
            interior = jnp.asarray(values[table.name])[row]
            normal = None if self.normals is None else jnp.asarray(self.normals)[point[rows]]
            axes = 0, 0, None, 0, None if normal is None else 0
            mapped = jax.vmap(partial(function, view), axes)
            take = lambda x, index, rows=rows: jnp.asarray(x)[index[rows]]
            by_view.append(
                mapped(
                    take(values["image"].position, image),
                    take(values["image"].rotation, image),
                    interior,
                    take(values["point"], point),
                    normal,
                )
            )
            order.append(rows)
        inverse_order = np.argsort(np.concatenate(order))
        return jax.tree.map(lambda *x: jnp.concatenate(x)[inverse_order], *by_view)

    def visibilities(
        self, values: Values, softness: float | Float[AnyArray, ""]
    ) -> Float[Array, " rays"]:
        """The visibility of every ray, 0 to 1."""
        of_ray = lambda view, p, q, interior, X, n: visibility(
            margins(view, self.rules, p, q, interior, X, n, softness), softness
        )
        of_others = np.nan_to_num(self.given_visibility)
        return jnp.where(self.soft, self.each_ray(of_ray, values), of_others)

    def data(self, values: Values, visibilities: Float[AnyArray, " rays"]) -> Data:
        """The numbers of the design, padded to the sizes of the plan: 1/σ times the visibilities,
        image coordinates those of the values."""
        problem = self.problem
        data = dataclasses.replace(problem.data, start=values)
        data = problem.with_image_coordinates(data, self.predict(values))
        # The engine's `weight` is 1/σ, the root of the weight.
        sqrt_p = jnp.asarray(problem.image_weights) * jnp.asarray(visibilities)[:, None]
        return fill_data(problem, problem.with_image_weights(data, sqrt_p))

    def aim_at(self, measured: Bool[np.ndarray, " rays"], values: Values) -> float:
        """The aim with these rays; NaN if they do not determine it. Photographs with too few
        rays are excluded: their rays have a negligible weight, so that they stay determined."""
        image = self.problem.image
        rays = np.bincount(image[measured], minlength=len(self.problem.network.images))
        idle = rays[image] < MIN_TARGETS
        visibilities = np.where(idle, IDLE_VISIBILITY, np.asarray(measured, float))
        data = self._compiled_data(values, visibilities)
        return float(jnp.exp(log_aim(self.task, data)[0]))

    @cached_property
    def _compiled_data(self) -> Callable[..., Data]:
        return jax.jit(self.data)

    @cached_property
    def _test_all(self) -> Callable[[Values], dict[str, Bool[Array, " rays"]]]:
        """Which rays satisfy which conditions, without softness."""
        test_ray = lambda view, p, q, interior, X, n: visible(
            margins(view, self.rules, p, q, interior, X, n)
        )
        return jax.jit(lambda values: self.each_ray(test_ray, values))

    @cached_property
    def predict(self) -> Callable[[Values], Float[Array, "rays 2"]]:
        """The image coordinates of all rays at given values, [rays, 2]."""
        of_ray = lambda view, p, q, interior, X, _: image_of(view, p, q, interior, X)
        return jax.jit(lambda values: self.each_ray(of_ray, values))

    def measured(self, values: Values) -> Bool[np.ndarray, " rays"]:
        """Which rays are measured: those that satisfy all conditions, and already measured ones."""
        is_visible = np.logical_and.reduce([np.asarray(v) for v in self._test_all(values).values()])
        return np.where(self.soft, is_visible, self.given_visibility > 0)


def make_pairs(
    network: Network,
    aim: Aim,
    conditions: Conditions,
    sigma: float,
    new: Bool[np.ndarray, " images"] | None = None,
) -> StationTargetPairs:
    """The problem of all pairs of a network without check points.

    **Arguments:** `sigma`: of future image coordinates, in the unit of the cameras' models; `new`:
    images to design, whose rays are not measured; all if not given, and then measured image
    points are ignored.

    **Raises:** `InputError` for a network that cannot be designed, or an aim that depends on the
    datum.
    """
    # All pairs, so that visibility is a number that changes smoothly and the sizes of arrays, with
    # them the compiled programs, do not depend on where stations are.
    _refuse(require_network(network))
    images, points, rays = network.images, network.points, network.observations
    shape = len(images), len(points)
    new = np.ones(len(images), bool) if new is None else new
    visibilities, xy = np.zeros(shape), np.zeros((*shape, 2))
    sigmas = np.full((*shape, 2), sigma)
    visibilities[rays.image, rays.point], xy[rays.image, rays.point] = 1.0, rays.xy
    sigmas[rays.image, rays.point] = rays.sigma
    visibilities[new], xy[new], sigmas[new] = np.nan, 0.0, sigma
    i, p = np.indices(shape).reshape(2, -1)
    observations = Observations(i, p, xy.reshape(-1, 2), sigmas.reshape(-1, 2), Source("pairs"))
    full = check_tables(network.replace(observations=observations, residuals="corrected"))
    problem = make_problem(full)
    refuse_arbitrary(aim, problem)
    return StationTargetPairs(
        problem,
        aim,
        task_of(problem, aim),
        conditions,
        visibilities.ravel(),
        views=tuple(view_of(c, conditions.edge) for c in problem.network.cameras),
        rules=rules_of(conditions, problem.origin),
        normals=conditions.of_points(len(points)),
        interest=points_of_interest(problem),
    )


def _refuse(network: Network) -> None:
    """Refuse networks from which a design cannot start.

    **Raises:** `InputError`."""
    images, points = network.images, network.points
    poses = np.concatenate([images.position, images.angles], 1)
    for table, rows, words in (
        (images, poses, "position and angles of every station"),
        (points, points.position, "coordinates of every target"),
    ):
        bad = ~np.isfinite(rows).all(1)
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"{table.source(row)}: {table.id[row]!r} has no start values; a "
                f"design starts from {words}"
            )
    other_kinds = [rows for rows in network.further if not isinstance(rows, CameraParameters)]
    if other_kinds:
        raise InputError(
            f"{other_kinds[0].source.name}: a design uses image points, distances, control "
            "points and priors; omit the other observations"
        )
    if len(network.points) < 3 or len(network.images) < 1:
        raise InputError("a design needs three targets and a station to start from")
