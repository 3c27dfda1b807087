"""The tables of a result: columns by name from an `Adjustment`.

σ are a posteriori, angles in the network's unit; there is one function per kind of table.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.further_unknowns import Estimate, estimates
from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.leastsquares.declarations import ObservationSet
from jaxbundle.leastsquares.quality.correlation import correlation_matrix, total_correlation
from jaxbundle.leastsquares.quality.reliability import external_reliability, minimal_detectable
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.network.units import unit_words

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


def cameras(adjustment: "Adjustment") -> dict[str, dict]:
    """Per camera: model, and per parameter value, sigma, free, t, total_correlation; and the
    correlation matrix of the free ones."""
    tables = {}
    for camera_of_network in adjustment.problem.network.cameras:
        values = adjustment.camera_parameters(camera_of_network.id)
        free, Q = adjustment.camera_cofactor(camera_of_network.id)
        sigma = dict(zip(free, adjustment.sigma0 * np.sqrt(np.diagonal(Q))))
        C = adjustment.correlated_camera_covariance(camera_of_network.id)
        correlated = {} if C is None else dict(zip(free, np.sqrt(np.diagonal(C))))
        total = dict(zip(free, total_correlation(Q))) if free else {}
        # Tied parameters are one unknown: all have its σ and its correlations.
        for first_name, *equal_names in camera_of_network.tie:
            if first_name in sigma:
                sigma |= dict.fromkeys(equal_names, sigma[first_name])
                total |= dict.fromkeys(equal_names, total[first_name])
                if first_name in correlated:
                    correlated |= dict.fromkeys(equal_names, correlated[first_name])
        default = default_parameters(get_model(camera_of_network.model))
        tables[camera_of_network.id] = {
            "model": str(camera_of_network.model),
            "parameters": {
                name: {
                    "value": value,
                    "sigma": float(sigma[name]) if name in sigma else None,
                    "free": name in sigma,
                    # By the σ that is shown first: under correlated errors it may be the larger.
                    "t": _significance(
                        value - default.get(name, 0.0),
                        max(sigma[name], correlated.get(name, 0.0)),
                    )
                    if name in sigma
                    else None,
                    "total_correlation": float(total[name]) if name in sigma else None,
                }
                | ({"sigma_correlated": float(correlated[name])} if name in correlated else {})
                for name, value in values.items()
            },
            "free": free,
            "tied": [list(group) for group in camera_of_network.tie],
            "correlations": correlation_matrix(Q),
        } | ({} if C is None else {"correlations_correlated": correlation_matrix(C)})
    return tables


def parameters(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """The parameters of all cameras, one row each."""
    rows = [
        {"camera": camera, "model": camera_entry["model"], "parameter": parameter, **entry}
        for camera, camera_entry in adjustment.cameras.items()
        for parameter, entry in camera_entry["parameters"].items()
    ]
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: np.array([row.get(key) for row in rows], dtype=object) for key in keys}


def images(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """Columns id, X0 … kappa, sX0 … skappa (angles in the network's unit), rays, rms (of v,
    image unit); with an error model sX0_correlated … skappa_correlated."""
    problem = adjustment.problem
    scale = np.array([1, 1, 1, *[adjustment.angle_scale] * 3])
    values = adjustment.image_values * scale
    sigma = _sigma(adjustment.classical_image_covariance) * scale
    table = {"id": np.array(problem.network.images.id, dtype=object)}
    table |= {name: values[:, i] for i, name in enumerate(EXTERIOR)}
    table |= {f"s{name}": sigma[:, i] for i, name in enumerate(EXTERIOR)}
    if (C := adjustment.correlated_image_covariance) is not None:
        sigma = _sigma(C) * scale
        table |= {f"s{name}_correlated": sigma[:, i] for i, name in enumerate(EXTERIOR)}
    return table | _rays_and_rms(adjustment, problem.image, len(values))


def points(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """Columns id, role, X, Y, Z, sX, sY, sZ, rays, rms (of v of its image points, image unit)."""
    problem, network = adjustment.problem, adjustment.problem.network
    sigma = _sigma(adjustment.classical_point_covariance)
    table = {
        "id": np.array(network.points.id, dtype=object),
        "role": np.array(network.points.role, dtype=object),
    }
    table |= {axis: adjustment.point_values[:, i] for i, axis in enumerate("XYZ")}
    table |= {f"s{axis}": sigma[:, i] for i, axis in enumerate("XYZ")}
    if (C := adjustment.correlated_point_covariance) is not None:
        sigma = _sigma(C)
        table |= {f"s{axis}_correlated": sigma[:, i] for i, axis in enumerate("XYZ")}
    return table | _rays_and_rms(adjustment, problem.point, len(network.points))


def _sigma(C: Float[np.ndarray, "n k k"]) -> Float[np.ndarray, "n k"]:
    """σ of covariance blocks; rounding of a zero is zero."""
    return np.sqrt(np.clip(np.diagonal(C, axis1=1, axis2=2), 0, None))


def far_points(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """The points at any distance, if any: columns id, uX, uY, uZ (the direction from the centroid
    of the projection centres), su (its largest σ, angle unit), distance, nearer and farther (one σ
    of the inverse distance from it), at_infinity."""
    distant = adjustment.far_points
    if distant is None:
        return {}
    table = {"id": np.array(distant.id, dtype=object)}
    table |= {f"u{axis}": distant.direction[:, i] for i, axis in enumerate("XYZ")}
    table["su"] = distant.sigma_direction[:, 0] * adjustment.angle_scale
    table |= {
        "distance": distant.distance,
        "nearer": distant.reach[:, 0],
        "farther": distant.reach[:, 1],
    }
    return table | {"at_infinity": distant.at_infinity}


def units(adjustment: "Adjustment", columns: Sequence[str], name: str) -> dict[str, str]:
    """The units of columns of a table that have one for all rows."""
    if name in ("residuals", "cameras"):
        return {}
    length, angle = adjustment.network.object_unit, adjustment.network.angle_unit
    lengths = (*"XYZ", *EXTERIOR[:3], "distance", "nearer", "farther")
    unit_of: dict[str, str] = {name: length for name in lengths}
    unit_of |= dict.fromkeys((*EXTERIOR[3:], "su"), angle)
    unit_of |= dict.fromkeys(("rms", "x", "y"), adjustment.image_unit)

    def unit_of_column(column: str) -> str | None:
        column = column.removesuffix("_correlated")
        return unit_of.get(column) or unit_of.get(column[1:] if column[:1] in "sd" else "")

    return {column: unit for column in columns if (unit := unit_of_column(column))}


def image_residuals(adjustment: "Adjustment") -> Float[np.ndarray, "rays 2"]:
    """v of all image coordinates, in the image unit; of no meaning where they are not used."""
    weight, has_weight = adjustment.problem.image_weights, adjustment.problem.used_coordinates
    return adjustment.inspection.image_residuals / np.where(has_weight, weight, 1.0)


def _rays_and_rms(
    adjustment: "Adjustment", of_ray: Int[np.ndarray, " rays"], n: int
) -> dict[str, np.ndarray]:
    """Columns rays and rms (of v, image unit) by the index `of_ray` of every ray."""
    has_weight, v = adjustment.problem.used_coordinates, image_residuals(adjustment)
    squares = np.bincount(of_ray, (v**2 * has_weight).sum(1), minlength=n)
    number = np.bincount(of_ray, has_weight.sum(1), minlength=n)
    return {
        "rays": np.bincount(of_ray, has_weight.any(1), minlength=n).astype(int),
        "rms": np.sqrt(np.where(number > 0, squares, np.nan) / np.maximum(number, 1)),
    }


def residuals(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """One row per observation: kind, image, point, axis, unit, v, sigma (a priori), r, w (Baarda),
    tau (Pope), mdb, external, and weight (the factor) after robust estimation; image observations
    first, in the given order."""
    tests = adjustment.reliability
    parts = observations(adjustment.problem, *(getattr(tests, name) for name in TESTED))
    return concatenate([residual_rows(adjustment, part) for part in parts])


def measured_values(problem: NetworkProblem) -> np.ndarray:
    """By row of `residuals`, what was measured; NaN of priors, and of kinds that measure something
    else than one number for each residual."""
    blank = lambda name: np.full(problem.weights(name).shape, np.nan)
    measured = {o.name: blank(o.name) for o in problem.observations}
    for name in ("control", "distance", *problem.further_sets):
        measured_rows = problem.data.measured.get(name)
        if (
            isinstance(measured_rows, jax.Array | np.ndarray)
            and measured_rows.size == measured[name].size
        ):
            origin = problem.origin if name == "control" else 0.0
            measured[name] = np.reshape(measured_rows, measured[name].shape) + origin
    columns = []
    for part in observations(problem, measured):
        values = problem.image_coordinates() if part.kind == "image" else part.quantities[0]
        unit = np.array([factor for factor, _ in part.units])
        columns.append((values * unit)[part.inverse_sigma > 0])
    return np.concatenate(columns)


BySet = Mapping[str, Float[np.ndarray, "n r"]]


class KindRows(NamedTuple):
    """Observations of one kind: ids of image and point of each ("" for none), names of its axes;
    1/σ [observations, axes], and further quantities in that shape; `units`: of every axis the
    factor from the unit of computation and the word of that in tables; `unit_of_rows`: the words of
    rows that differ in them; `set_name`: of the set of observations, empty for image points, which
    are several."""

    kind: str
    image: Sequence[str] | np.ndarray
    point: Sequence[str] | np.ndarray
    axes: Sequence[str]
    inverse_sigma: Float[np.ndarray, "observations axes"]
    quantities: tuple[Float[np.ndarray, "observations axes"], ...]
    units: Sequence[tuple[float, str]]
    unit_of_rows: np.ndarray | None = None
    set_name: str = ""


def observations(problem: NetworkProblem, *quantities_by_set: BySet) -> Iterator[KindRows]:
    """Every kind of observation, with the part of each of `quantities_by_set`."""
    network = problem.network
    images = np.array(network.images.id, dtype=object)
    points = np.array(network.points.id, dtype=object)
    cameras = np.array([c.id for c in network.cameras], dtype=object)
    blank = lambda rows: np.full(rows, "", dtype=object)
    sets = {o.name: o for o in problem.observations}

    words = unit_words(network)

    def quantities(name: str) -> tuple[np.ndarray, tuple[np.ndarray, ...], list, None, str]:
        weights, units = problem.weights(name), sets[name].kind.units
        unit_of_axis = [units] * weights.shape[1] if isinstance(units, str) else units
        rows = tuple(np.asarray(rows[name]) for rows in quantities_by_set)
        return weights, rows, [words.get(unit, (1.0, "")) for unit in unit_of_axis], None, name

    weight, *rows = (
        np.asarray(problem.image_points(x)) for x in (problem.data.weight, *quantities_by_set)
    )
    of_image, of_point = images[problem.image], points[problem.point]
    units = [words["image"]] * 2
    # Cameras with models in mm and in pixels may be in one network.
    of_model = np.array([get_model(c.model).unit for c in network.cameras], dtype=object)
    unit_of_rows = of_model[problem.camera]
    yield KindRows(
        "image", of_image, of_point, ("x", "y"), weight, tuple(rows), units, unit_of_rows
    )
    if "control" in sets:
        control = points[sets["control"].rows[0]]
        yield KindRows(
            "control", blank(len(control)), control, tuple("XYZ"), *quantities("control")
        )
    if "exterior" in sets:
        exterior = images[sets["exterior"].rows[0]]
        yield KindRows("prior", exterior, blank(len(exterior)), EXTERIOR, *quantities("exterior"))
    for table in problem.cameras:
        name = table.interior_set
        if name in sets:
            camera_names = cameras[table.cameras[sets[name].rows[0]]]
            yield KindRows(
                "prior", camera_names, blank(len(camera_names)), table.parameters, *quantities(name)
            )
    for name in problem.further_sets:
        yield KindRows(*_of_further_kind(problem, sets[name]), *quantities(name))
    if "distance" in sets:
        a, b = (points[network.distances.points[:, i]] for i in range(2))
        yield KindRows("distance", a, b, ("d",), *quantities("distance"))


def _of_further_kind(
    problem: NetworkProblem, observation_set: ObservationSet
) -> tuple[str, np.ndarray, np.ndarray, tuple[str, ...]]:
    """The rows that observations of a further kind touch are in the column of the point."""
    if {*observation_set.kind.of} == {"point"}:
        ids = problem.table("point").label
        touched_labels = [
            " – ".join(ids(int(row)) for row in rows) for rows in zip(*observation_set.rows)
        ]
    else:
        touched_labels = [
            observation_set.label(problem.tables, row) for row in range(observation_set.number)
        ]
        touched_labels = [
            label.removeprefix(f"{observation_set.kind.name} of ") for label in touched_labels
        ]
    width = problem.weights(observation_set.name).shape[1]
    axes = observation_set.kind.axes or tuple(str(i + 1) for i in range(width))
    blank = np.full(observation_set.number, "", dtype=object)
    return observation_set.kind.name, blank, np.array(touched_labels, dtype=object), axes


def further_estimates(adjustment: "Adjustment") -> list[Estimate]:
    """The unknowns of further kinds of observations in the units of the network, with their
    words."""
    names, origin = set(adjustment.problem.further_tables), adjustment.problem.origin
    if not names:
        return []
    words = unit_words(adjustment.network)
    all_estimates = estimates(adjustment.cofactors.solution, names, adjustment.sigma0, origin)
    scaled = ((estimate, *words.get(estimate.unit, (1.0, ""))) for estimate in all_estimates)
    return [
        estimate._replace(value=estimate.value * scale, sigma=estimate.sigma * scale, unit=word)
        for estimate, scale, word in scaled
    ]


def further_unknowns(adjustment: "Adjustment") -> dict[str, dict]:
    """By table, row and name: value and sigma, like `Adjustment.further_unknowns`."""
    by_table: dict[str, dict] = {}
    for estimate in adjustment.further_estimates:
        row = by_table.setdefault(estimate.table, {}).setdefault(estimate.row, {})
        row[estimate.name] = {"value": estimate.value, "sigma": estimate.sigma}
    return by_table


def checks(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """The check points, if any: columns id, X, Y, Z, dX, dY, dZ (against the given
    coordinates), sX, sY, sZ, rays."""
    check_points = adjustment.check_points
    if check_points is None:
        return {}
    sigma = _sigma(check_points.covariance)
    table = {"id": np.array(check_points.id, dtype=object)}
    table |= {axis: check_points.position[:, i] for i, axis in enumerate("XYZ")}
    table |= {f"d{axis}": check_points.difference[:, i] for i, axis in enumerate("XYZ")}
    table |= {f"s{axis}": sigma[:, i] for i, axis in enumerate("XYZ")}
    return table | {"rays": check_points.rays}


def control(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """Control points predicted from all other observations, if any: columns id, dX, dY, dZ
    (predicted − given), sX, sY, sZ, probability (of a larger error by chance)."""
    prediction = adjustment.control_prediction
    if prediction is None:
        return {}
    table = {"id": np.array(prediction.id, dtype=object)}
    table |= {f"d{axis}": prediction.error[:, i] for i, axis in enumerate("XYZ")}
    table |= {f"s{axis}": prediction.sigma[:, i] for i, axis in enumerate("XYZ")}
    return table | {"probability": prediction.probability}


def control_measurements(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """Image measurements of control predicted from all other observations, if any: columns image,
    point, dx, dy (predicted − measured, image unit), sx, sy, probability."""
    prediction = adjustment.control_prediction
    if prediction is None or not prediction.measurement:
        return {}
    image, point = zip(*prediction.measurement)
    table = {"image": np.array(image, dtype=object), "point": np.array(point, dtype=object)}
    table |= {f"d{axis}": prediction.image_error[:, i] for i, axis in enumerate("xy")}
    table |= {f"s{axis}": prediction.image_sigma[:, i] for i, axis in enumerate("xy")}
    return table | {"probability": prediction.image_probability}


# Of `Reliability`, what a row of residuals is made of.
TESTED = ("residual", "gain", "redundancy", "w", "hat")


class TestedResult(Protocol):
    """What rows of residuals need of an adjustment: the weight factors of robust estimation, and
    Pope's τ of w."""

    @property
    def weights(self) -> Float[np.ndarray, " rays"] | None: ...

    def pope(self, w: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]: ...


def residual_rows(adjustment: TestedResult, part: KindRows) -> dict[str, np.ndarray]:
    """The observations of one kind as columns, a row for every axis with weight; the quantities of
    the part are `TESTED`."""
    # The engine's quantities are of v/σ, and so without unit; rows of the table have that of their
    # kind. Rows without weight (axes that are not given, removed observations) are left out.
    v, gain, r, w, hat = part.quantities
    kind, axes = part.kind, part.axes
    free = np.clip(1 - hat, 0, 1)
    unit, words = (np.array(x) for x in zip(*part.units))
    has_weight = part.inverse_sigma > 0
    sigma = np.where(has_weight, unit / np.where(has_weight, part.inverse_sigma, 1), np.nan)
    repeat = lambda ids: np.repeat(ids, len(axes))
    columns = {
        "kind": np.full(sigma.size, kind, dtype=object),
        "image": repeat(part.image),
        "point": repeat(part.point),
        "axis": np.tile(np.array(axes, dtype=object), len(part.image)),
        "unit": np.tile(words.astype(object), len(part.image))
        if part.unit_of_rows is None
        else repeat(part.unit_of_rows),
        "v": (v * sigma).ravel(),
        "sigma": sigma.ravel(),
        "r": r.ravel(),
        "w": w.ravel(),
        "tau": adjustment.pope(w).ravel(),
        "mdb": minimal_detectable(sigma / np.where(has_weight, gain, 1.0), free).ravel(),
        "external": external_reliability(free).ravel(),
    }
    if adjustment.weights is not None:
        factor = adjustment.weights if kind == "image" else np.ones(len(part.image))
        columns["weight"] = repeat(factor)
    return {name: column[has_weight.ravel()] for name, column in columns.items()}


def _significance(value: float, sigma: float) -> float:
    """t = |value − default|/σ, the default mostly 0; for σ = 0, as after an exact fit, infinite, or
    NaN for the value 0."""
    if sigma == 0:
        return float("inf") if value else float("nan")
    return abs(value) / float(sigma)


def concatenate(tables: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
