"""The embedded tables of a result, for sorting, searching and drawing."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.network.tables import EXTERIOR
from jaxbundle.report.correlated import stated_sigma, stated_sigma_of
from jaxbundle.report.layout import clean, coordinate_decimals
from jaxbundle.report.page.columns import Column, estimates, numbers
from jaxbundle.report.page.document import Listing

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

# Largest number of embedded observations: a page with a million takes too long to open.
MAX_OBSERVATIONS = 500_000

Columns = dict[str, Column]
# The embedded elements of a symmetric matrix, in this order.
UPPER = [(i, j) for i in range(3) for j in range(i, 3)]
ANGLES = {"omega": "ω", "phi": "φ", "kappa": "κ"}


def collect_tables(adjustment: "Adjustment") -> dict[str, Listing]:
    """All tables by name."""
    total = len(adjustment.residuals["tau"])
    note = ""
    if total > MAX_OBSERVATIONS:
        note = (
            f"The {MAX_OBSERVATIONS} with the largest |τ| of {total}, here and in the photographs; "
            "all are in residuals.csv."
        )
    return {
        "cameras": Listing("Cameras", cameras(adjustment), "cameras.csv"),
        "images": Listing("Images", images(adjustment), "images.csv"),
        "points": Listing("Points", points(adjustment), "points.csv"),
        "far_points": Listing("Points at any distance", far_points(adjustment), "far_points.csv"),
        "checks": Listing("Check points", checks(adjustment), "checks.csv"),
        "observations": Listing("Observations", observations(adjustment), "residuals.csv", note),
        "blunders": Listing("Blunders", blunders(adjustment), "result.json"),
    }


def cameras(adjustment: "Adjustment") -> Columns:
    """One row per parameter."""
    columns = adjustment.table("cameras")
    parameters = [
        entry for camera in adjustment.cameras.values() for entry in camera["parameters"].values()
    ]
    sigma = numbers(stated_sigma_of(entry) for entry in parameters)
    classical = {}
    if "sigma_correlated" in columns:
        classical["classical"] = Column(numbers(columns["sigma"]), "σ classical")
    return {
        "camera": Column(columns["camera"], "camera"),
        "model": Column(columns["model"], "model"),
        "parameter": Column(columns["parameter"], "parameter"),
        "value": estimates(numbers(columns["value"]), sigma, "value"),
        "sigma": Column(sigma, "σ"),
        **classical,
        "free": Column(columns["free"].astype(bool), "free"),
        "t": Column(numbers(columns["t"]), "t = |value|/σ"),
        "total": Column(100 * numbers(columns["total_correlation"]), "total correlation %", 1),
    }


def images(adjustment: "Adjustment") -> Columns:
    """Exterior orientation; the covariance of the projection centre, to be drawn."""
    columns, network = adjustment.images, adjustment.problem.network
    unit, angle = clean(network.object_unit), network.angle_unit
    units = dict(zip(EXTERIOR, [unit] * 3 + [angle] * 3))
    label = lambda name: f"{ANGLES.get(name, name)} [{units[name]}]"
    sigma = {name: stated_sigma(columns, name) for name in EXTERIOR}
    places = {name: coordinate_decimals(sigma[name]) for name in EXTERIOR}
    ids = np.array([camera.id for camera in network.cameras], dtype=object)
    return (
        {
            "id": Column(columns["id"], "image"),
            "camera": Column(ids[network.images.camera], "camera"),
        }
        | {name: Column(columns[name], label(name), places[name], True) for name in EXTERIOR}
        | {f"s{name}": Column(sigma[name], f"σ {label(name)}") for name in EXTERIOR}
        | {
            "rays": Column(columns["rays"], "rays"),
            "rms": Column(columns["rms"], f"RMS v [{adjustment.image_unit}]"),
        }
        | _covariance(adjustment.image_covariance[:, :3, :3])
    )


def points(adjustment: "Adjustment") -> Columns:
    """Coordinates with σ; the covariance, and whether a point is near enough to be drawn."""
    columns, unit = adjustment.points, clean(adjustment.network.object_unit)
    sigma = {axis: stated_sigma(columns, axis) for axis in "XYZ"}
    places = {axis: coordinate_decimals(sigma[axis]) for axis in "XYZ"}
    return (
        {"id": Column(columns["id"], "point"), "role": Column(columns["role"], "role")}
        | {a: Column(columns[a], f"{a} [{unit}]", places[a], True) for a in "XYZ"}
        | {f"s{a}": Column(sigma[a], f"σ{a} [{unit}]") for a in "XYZ"}
        | {
            "rays": Column(columns["rays"], "rays"),
            "rms": Column(columns["rms"], f"RMS v [{adjustment.image_unit}]"),
            "near": Column(adjustment.located.astype(int)),
        }
        | _covariance(adjustment.point_covariance)
    )


def _covariance(matrices: Float[np.ndarray, "n 3 3"]) -> Columns:
    return {f"c{i}{j}": Column(matrices[:, i, j]) for i, j in UPPER}


def far_points(adjustment: "Adjustment") -> Columns:
    """Directions of the points at any distance."""
    columns = adjustment.table("far_points")
    network = adjustment.network
    labels = {
        "id": "point",
        "uX": "uX",
        "uY": "uY",
        "uZ": "uZ",
        "su": f"σ [{network.angle_unit}]",
        "distance": f"distance [{clean(network.object_unit)}]",
        "nearer": "from",
        "farther": "to",
        "at_infinity": "at infinity",
    }
    directions = ("uX", "uY", "uZ")
    return {
        name: Column(column, labels[name], 6 if name in directions else -3)
        for name, column in columns.items()
    }


def checks(adjustment: "Adjustment") -> Columns:
    """Check points: intersected, minus given, σ."""
    columns, unit = adjustment.table("checks"), clean(adjustment.network.object_unit)
    if not columns:
        return {}
    places = {axis: coordinate_decimals(columns[f"s{axis}"]) for axis in "XYZ"}
    return (
        {"id": Column(columns["id"], "point")}
        | {a: Column(columns[a], f"{a} [{unit}]", places[a], True) for a in "XYZ"}
        | {f"d{a}": Column(columns[f"d{a}"], f"d{a} [{unit}]") for a in "XYZ"}
        | {f"s{a}": Column(columns[f"s{a}"], f"σ{a} [{unit}]") for a in "XYZ"}
        | {"rays": Column(columns["rays"], "rays")}
    )


def observations(adjustment: "Adjustment") -> Columns:
    """All observations, of very many those with the largest |τ|, and what was measured."""
    return table_of_residuals(
        adjustment.residuals | {"measured": adjustment.measured}, adjustment.sigma0
    )


def table_of_residuals(columns: Mapping[str, np.ndarray], sigma0: float) -> Columns:
    """The columns there are of a table of residuals."""
    largest_rows = choose_largest(columns["tau"], MAX_OBSERVATIONS)
    labels = {
        "kind": "kind",
        "image": "image",
        "point": "point",
        "axis": "axis",
        "unit": "unit",
        "measured": "measured",
        "v": "v",
        "sigma": "σ a priori",
        "r": "r",
        "w": "w",
        "tau": "τ",
        "mdb": "MDB (σ a priori)",
        "external": "ext.",
        "weight": "weight",
    }
    of_images = columns["sigma"][columns["kind"] == "image"]
    places = {"r": 3, "tau": 2, "w": 2, "measured": coordinate_decimals(sigma0 * of_images)}
    return {
        name: Column(columns[name][largest_rows], label, places.get(name, -3))
        for name, label in labels.items()
        if name in columns
    }


def choose_largest(tau: np.ndarray, max_rows: int) -> np.ndarray:
    """The rows with the largest |τ|, limited in number, in their order."""
    if len(tau) <= max_rows:
        return np.arange(len(tau))
    # A partition needs no order among the largest.
    return np.sort(np.argpartition(-np.abs(np.nan_to_num(tau)), max_rows)[:max_rows])


def blunders(adjustment: "Adjustment") -> Columns:
    """Observations removed by data snooping, in order, and suspects of a robust estimate."""
    rows = [("removed", r.kind, r.name, r.test, 0.0) for r in adjustment.removed]
    rows += [("suspect", s.kind, s.name, s.test, s.weight) for s in adjustment.suspects]
    if not rows:
        return {}
    state, kind, name, test, weight = zip(*rows)
    words: Mapping[str, tuple] = {"state": state, "kind": kind, "observation": name}
    return {
        name: Column(np.array(values, dtype=object), name) for name, values in words.items()
    } | {"test": Column(numbers(test), "test"), "weight": Column(numbers(weight), "weight")}
