"""The adjusted network as a project: for other programs, and to be adjusted again."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.network.camera_tables import with_start
from jaxbundle.network.kinds import (
    CameraParameters,
    ExteriorPriors,
    Interfaces,
    ObservationTable,
    RobotPoses,
)
from jaxbundle.network.kinds.base import included_tables
from jaxbundle.network.subsets import keep_distances, keep_points
from jaxbundle.network.tables import ESTIMATED, Camera, Images, Network, Points

if TYPE_CHECKING:
    from jaxbundle.adjustment.problem import NetworkProblem
    from jaxbundle.adjustment.result import Adjustment


def adjusted_network(adjustment: "Adjustment") -> Network:
    """The network of a solved `Adjustment` at its solution, for other programs.

    Cameras, orientations and points have their adjusted values; observations removed by data
    snooping are left out. Control points with σ are tie points here; priors and observations of
    further kinds are dropped: their information is already in the adjusted values and would count
    twice. Only priors required by a camera model, such as a grid of splines, stay, of the values
    that were observed: without them it has no solution. So the datum is inner; a second adjustment
    changes nothing. Refracting interfaces are held at their adjusted values. σ of image coordinates
    are the given ones, even if variance components were estimated. Check points are left out, and
    so are points without coordinates: at infinity, or excluded by data snooping.
    """
    problem = adjustment.problem
    network = problem.network.replace(name=adjustment.network.name)
    values = adjustment.image_values
    images, points, rays = network.images, network.points, network.observations
    eliminated = {(name.id, name.parameter) for name in adjustment.eliminated}
    cameras = tuple(
        dataclasses.replace(
            with_start(camera, adjustment.camera_parameters(camera.id))
            if get_model(camera.model).prior
            else _camera_without_priors(camera, adjustment),
            free=tuple(name for name in camera.unknowns if (camera.id, name) not in eliminated),
        )
        for camera in network.cameras
    )
    used_rows = problem.used
    roles = tuple("tie" if role == "control" else role for role in points.role)
    adjusted = network.replace(
        cameras=cameras,
        images=Images(
            images.id,
            images.camera,
            values[:, :3],
            values[:, 3:],
            np.full_like(images.sigma, np.nan),
            images.source,
        ),
        points=dataclasses.replace(
            points,
            role=roles,
            position=adjustment.point_values,
            sigma=np.full_like(points.sigma, np.nan),
        ),
        observations=rays.take(used_rows),
        datum="inner",
        datum_points=(),
        further=_interfaces_at_solution(adjustment),
        warnings=(),
        notes=("the adjusted network",),
    )
    return keep_points(adjusted, np.asarray(np.isfinite(adjustment.point_values).all(1)))


def readjustable_network(adjustment: "Adjustment") -> Network:
    """The network of a solved `Adjustment` with adjusted start values and all observations that
    took part: adjusted again it gives the same values, σ and σ0.

    Priors of orientations and cameras become rows of `exterior_priors` and `camera_parameters`,
    because what was observed differs from the start values; control points have their given
    coordinates.
    σ are the final ones, after variance components (then their origin is "estimated") and robust
    weights. Observations removed by data
    snooping, points without coordinates and check points are left out.
    """
    problem = adjustment.problem
    network = problem.network.replace(name=adjustment.network.name)
    images, rays = network.images, network.observations
    values, eliminated = (
        adjustment.image_values,
        {(n.id, n.parameter) for n in adjustment.eliminated},
    )
    cameras = tuple(
        dataclasses.replace(
            _camera_without_priors(camera, adjustment),
            free=tuple(name for name in camera.unknowns if (camera.id, name) not in eliminated),
        )
        for camera in network.cameras
    )
    weight, used_rows = problem.image_weights, problem.used
    distance_weight = _weights(problem, "distance", (len(network.distances), 1)).ravel()
    adjusted = network.replace(
        cameras=cameras,
        images=Images(
            images.id,
            images.camera,
            values[:, :3],
            values[:, 3:],
            np.where(images.sigma == 0, 0.0, np.nan),
            images.source,
        ),
        points=_points_with_given_control(adjustment),
        observations=dataclasses.replace(
            rays,
            sigma=_sigma(weight, np.nan),
            sigma_origin=ESTIMATED if adjustment.sigma_factors else rays.sigma_origin,
        ).take(used_rows),
        distances=dataclasses.replace(network.distances, sigma=_sigma(distance_weight, np.nan)),
        further=_join_tables(*_further_observations(adjustment), *_priors(adjustment)),
        warnings=(),
        notes=("the adjusted network",),
    )
    adjusted = keep_distances(adjusted, distance_weight > 0)
    return keep_points(adjusted, np.asarray(np.isfinite(adjustment.point_values).all(1)))


def _interfaces_at_solution(adjustment: "Adjustment") -> tuple[ObservationTable, ...]:
    """The interfaces of a network as they were estimated: without them rays would be straight."""
    unknowns = adjustment.further_unknowns
    radians = 1 / adjustment.angle_scale
    return tuple(
        table.held_at(unknowns, radians)
        for table in adjustment.problem.network.further
        if isinstance(table, Interfaces)
    )


def _camera_without_priors(camera: Camera, adjustment: "Adjustment") -> Camera:
    """A camera at its adjusted values, without priors."""
    parameters = adjustment.camera_parameters(camera.id)
    return dataclasses.replace(camera, parameters=parameters, sigma={}, observed={})


def _weights(
    problem: "NetworkProblem", name: str, absent_shape: tuple[int, int]
) -> Float[np.ndarray, "rows residuals"]:
    """1/σ of a set of observations; of one that the network lacks, zeros of the shape given."""
    is_declared = any(o.name == name for o in problem.observations)
    return problem.weights(name) if is_declared else np.zeros(absent_shape)


def _sigma(weight: Float[np.ndarray, "..."], unused_sigma: float) -> Float[np.ndarray, "..."]:
    """σ of the engine's weights, which are 1/σ; `unused_sigma` where nothing was used."""
    return np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), unused_sigma)


def _points_with_given_control(adjustment: "Adjustment") -> Points:
    """Points at their adjusted coordinates, controlled axes at the given ones; a control point of
    which no axis is used any more is a tie point."""
    problem = adjustment.problem
    points = problem.network.points
    control = np.flatnonzero(points.has_role("control"))
    weight = _weights(problem, "control", (0, 3))
    observed = np.asarray(problem.data.measured.get("control", np.zeros((0, 3)))) + problem.origin
    position, sigma = adjustment.point_values.copy(), np.full_like(points.sigma, np.nan)
    sigma[control] = _sigma(weight, np.inf)
    position[control] = np.where(weight > 0, observed, position[control])
    roles = np.array(points.role, dtype=object)
    roles[control[~(weight > 0).any(1)]] = "tie"
    # A tie point has no observed coordinates.
    sigma[roles == "tie"] = np.nan
    return dataclasses.replace(points, role=tuple(roles.tolist()), position=position, sigma=sigma)


def _priors(adjustment: "Adjustment") -> list[ObservationTable]:
    """What was observed of orientations and cameras."""
    problem = adjustment.problem
    network, measured = problem.network, problem.data.measured
    observation_sets = {o.name: o for o in problem.observations}
    tables: list[ObservationTable] = []
    if "exterior" in observation_sets:
        value = np.asarray(measured["exterior"]) + np.concatenate([problem.origin, np.zeros(3)])
        image = tuple(network.images.id[k] for k in observation_sets["exterior"].rows[0])
        sigma = _sigma(problem.weights("exterior"), np.inf)
        tables.append(ExteriorPriors(image=image, value=value, sigma=sigma))
    eliminated = {(name.id, name.parameter) for name in adjustment.eliminated}
    rows = []
    for table in problem.cameras:
        if table.interior_set not in observation_sets:
            continue
        weights = problem.weights(table.interior_set)
        for row, table_row in enumerate(observation_sets[table.interior_set].rows[0]):
            camera = network.cameras[table.cameras[table_row]]
            for j, name in enumerate(table.parameters):
                is_used = weights[row, j] > 0 and name in camera.unknowns
                if is_used and (camera.id, name) not in eliminated:
                    value = float(measured[table.interior_set][row, j])
                    rows.append((camera.id, name, value, float(1 / weights[row, j])))
    if rows:
        camera, parameter, value, sigma = zip(*rows)
        tables.append(
            CameraParameters(
                camera=camera, parameter=parameter, value=np.array(value), sigma=np.array(sigma)
            )
        )
    return tables


def _join_tables(*further: ObservationTable) -> tuple[ObservationTable, ...]:
    """One table of each kind: priors follow the rows of the same kind that the network had."""
    tables: dict[str, ObservationTable] = {}
    for table in further:
        earlier_table = tables.get(table.TABLE)
        if earlier_table is None:
            tables[table.TABLE] = table
            continue
        names = [f.name for f in dataclasses.fields(table) if f.name not in ("settings", "source")]
        join = lambda a, b: np.concatenate([a, b]) if isinstance(a, np.ndarray) else (*a, *b)
        joined_columns: dict = {
            name: join(getattr(earlier_table, name), getattr(table, name)) for name in names
        }
        tables[table.TABLE] = type(table)(**joined_columns, settings=earlier_table.settings)
    return tuple(tables.values())


def _further_observations(adjustment: "Adjustment") -> list[ObservationTable]:
    """The observations of further kinds without those removed by data snooping, with their final σ:
    a kind with one observation per row of its table is followed row by row."""
    problem = adjustment.problem
    network = problem.network
    # The engine's sets in the order of declaration, the user's own before those of the network.
    kinds = sorted(included_tables(network), key=lambda table: not table.CHANGES_IMAGE_POINTS)
    numbers = [len(table.declare(network, problem.origin).observations) for table in kinds]
    user_set_count = len(problem.further_sets) - sum(numbers)
    names, tables = iter(problem.further_sets[user_set_count:]), []
    for table, number in zip(kinds, numbers):
        if not number:
            tables.append(table)
            continue
        observation_set, *_ = [problem.observations_of(next(names)) for _ in range(number)]
        factor = adjustment.sigma_factors.get(observation_set.kind.name, 1.0)
        if isinstance(table, RobotPoses) and number > 1:
            table, factor = table.rescale(adjustment.sigma_factors), 1.0
        for name, power in (("sigma", 1), ("covariance", 2)):
            if factor != 1 and hasattr(table, name):
                changed: dict = {name: getattr(table, name) * factor**power}
                table = dataclasses.replace(table, **changed)
        if observation_set.number == len(table):
            row_weights = (
                np.abs(np.asarray(problem.weights(observation_set.name)))
                .reshape(len(table), -1)
                .max(1)
            )
            table = table.take(row_weights > 0)
        tables += [table] if len(table) else []
    return tables
