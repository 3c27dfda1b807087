"""The adjusted unknowns in a protocol: cameras, images, points, each with its precision."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.cameras import CameraModel, get_model
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.report.camera_equations import camera_equations
from jaxbundle.report.correlated import stated_sigma, stated_sigma_of
from jaxbundle.report.layout import (
    DIGITS_WITHOUT_SIGMA,
    bar,
    clean,
    column_decimals,
    coordinate_decimals,
    estimate,
    facts,
    fixed,
    heading,
    paragraph,
    significant,
    table,
)
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

CLASSES = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, np.inf)
ROLE_WORDS = {"tie": "tie", "control": "ctrl", "fixed": "fix", "check": "check"}


# --- cameras --------------------------------------------------------------------------------


def cameras(adjustment: "Adjustment") -> list[str]:
    """Every camera in full; many cameras as one table a model."""
    tables, models = adjustment.cameras, _models(adjustment)
    lines = []
    if len(tables) > 8:  # half a page each: more would hide the rest of the report
        return [*heading(f"Cameras ({len(tables)})"), *_many_cameras(adjustment)]
    for camera, entry in tables.items():
        lines += heading(f"Camera {clean(camera)}")
        lines += _one_camera(entry, models[entry["model"]])
        lines += ["", *paragraph(validity(adjustment, camera))]
    return lines


def _models(adjustment: "Adjustment") -> dict[str, CameraModel]:
    """The camera models by name."""
    return {str(camera.model): get_model(camera.model) for camera in adjustment.network.cameras}


def _one_camera(entry: Mapping[str, Any], model: CameraModel) -> list[str]:
    lines = _equations(model)
    # Student's t at 95 %: 1.96 where the redundancy is large, 2 as in `Adjustment.insignificant`
    critical_t = 2.0
    rows, held_parameters = [], []
    for name, parameter in entry["parameters"].items():
        # Held ones follow in one line.
        if not parameter["free"]:
            held_parameters.append(
                f"{name} {significant(parameter['value'], DIGITS_WITHOUT_SIGMA)}"
            )
            continue
        value, sigma = estimate(parameter["value"], stated_sigma_of(parameter))
        t, total = parameter["t"], parameter["total_correlation"]
        mark = "–" if np.isnan(t) else "no" if t < critical_t else "yes"
        rows.append((name, value, sigma, significant(t, 3), mark, fixed(100 * total, 1)))
    if rows:
        header = ("parameter", "value", "σ", "t", "significant", "total corr. %")
        lines += ["", *table(header, rows, "lrrrrr")]
    if held_parameters:
        lines += ["", *facts([("Held", ", ".join(held_parameters))])]
    if entry["tied"]:
        lines += ["", *facts([("Tied", ", ".join(" = ".join(group) for group in entry["tied"]))])]
    if rows:
        lines += paragraph(
            f"t = |value|/σ; no: t < {critical_t:g}, not significantly different from 0 (95 %). "
            "Total correlation: the share of a parameter that the others of the camera explain."
        )
    free = entry["free"]
    if len(free) > 1:
        C = entry.get("correlations_correlated", entry["correlations"])
        lines += ["", "Correlations in %", *_triangle(free, C)]
    return lines


def _equations(model: CameraModel) -> list[str]:
    first_equation, *other_equations = map(clean, camera_equations(model))
    rows = [
        (f"Model {clean(model.name)}", first_equation),
        *(("", line) for line in other_equations),
    ]
    return facts(rows)


def _triangle(names: Sequence[str], C: Float[np.ndarray, "n n"]) -> list[str]:
    """The lower triangle of a correlation matrix."""
    width = max(5, max(map(len, names)))
    name_width = max(map(len, names))
    lines = [" " * name_width + " " + " ".join(f"{name:>{width}}" for name in names)]
    for i, name in enumerate(names):
        cells = (fixed(100 * C[i, j], 0) for j in range(i + 1))
        lines.append(f"{name:<{name_width}} " + " ".join(f"{cell:>{width}}" for cell in cells))
    return lines


def _many_cameras(adjustment: "Adjustment") -> list[str]:
    """Two lines a camera, value and σ; one table a model."""
    lines = []
    tables = adjustment.cameras
    for name, model in _models(adjustment).items():
        of_model = {id: entry for id, entry in tables.items() if entry["model"] == name}
        names = [
            p
            for p in model.parameters
            if any(e["parameters"][p]["free"] for e in of_model.values())
        ]
        rows = []
        for camera, entry in of_model.items():
            cells = [
                estimate(entry["parameters"][p]["value"], stated_sigma_of(entry["parameters"][p]))
                for p in names
            ]
            rows += [(camera, *(a for a, _ in cells)), ("   σ", *(b for _, b in cells))]
        lines += [*_equations(model), ""]
        # Six columns of values fit in the width of a page.
        for start in range(0, len(names), 6):
            part = slice(start, start + 6)
            header = ("camera", *names[part])
            cells = [(row[0], *row[1:][part]) for row in rows]
            lines += [*table(header, cells, "l" + "r" * (len(header) - 1)), ""]
    return lines[:-1]


def validity(adjustment: "Adjustment", camera: str) -> str:
    """Whether the distortion is one-to-one over the image of a camera."""
    reach = adjustment.distortion_reach[camera]
    if reach.radius <= 0:
        return "Distortion: no measurements to compare with."
    if reach.message is not None:
        return reach.message
    where = "the image" if reach.of_image else "the measurements"
    unit = _models(adjustment)[adjustment.cameras[camera]["model"]].unit
    radius = significant(reach.radius, 4)
    return f"Distortion: one-to-one over {where}, as far as r = {radius} {unit}."


# --- images ---------------------------------------------------------------------------------


def images(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """Exterior orientation, two lines an image: values, and σ under them."""
    columns = adjustment.images
    unit, angle = adjustment.image_unit, adjustment.network.angle_unit
    stated = {name: stated_sigma(columns, name) for name in EXTERIOR}
    places = [coordinate_decimals(stated[name]) for name in EXTERIOR]
    scale, rms_unit = (1e3, "µm") if unit == "mm" else (1.0, unit)
    rms_places = column_decimals(scale * columns["rms"])
    rows = []
    for i in range(min(len(columns["id"]), max_rows)):
        values = [fixed(columns[name][i], d) for name, d in zip(EXTERIOR, places)]
        sigma = [_sigma(stated[name][i], d) for name, d in zip(EXTERIOR, places)]
        rms = fixed(scale * columns["rms"][i], rms_places)
        rows += [
            (columns["id"][i], *values, str(columns["rays"][i]), rms),
            ("   σ", *sigma, "", ""),
        ]
    header = ("image", "X0", "Y0", "Z0", "ω", "φ", "κ", "rays", f"RMS v {rms_unit}")
    unit = clean(adjustment.network.object_unit)
    title = f"Images: exterior orientation in {unit} and {angle}"
    lines = [*heading(title), *table(header, rows, "lrrrrrrrr")]
    lines += _left_out(len(columns["id"]), max_rows, "image", "images.csv")
    return lines


def _sigma(value: float, places: int) -> str:
    return fixed(value, places) if value > 0 else "–"


def _left_out(total: int, max_rows: int, noun: str, file: str) -> list[str]:
    if total <= max_rows:
        return []
    return [f"… and {count(total - max_rows, f'other {noun}')}: all {total} are in {file}."]


# --- points ---------------------------------------------------------------------------------


def points(
    adjustment: "Adjustment", max_rows: int, accuracy_unit: float | None = None
) -> list[str]:
    """Precision of the points in summary, rays a point, then the list."""
    lines = heading("Points: precision")
    lines += _precision(adjustment, accuracy_unit)
    lines += _rays(adjustment.points["rays"])
    excluded = np.flatnonzero(adjustment.problem.excluded)
    if len(excluded):
        names = list_some((adjustment.network.points.id[p] for p in excluded), 20, clean)
        lines += [
            "",
            *paragraph(
                "Without coordinates, because the rays left by data snooping do not determine "
                f"them: {names}."
            ),
        ]
    return [*lines, *_list_of_points(adjustment, max_rows)]


# Of the σ of the points. A handful of hardly determined points would make their mean and RMS.
SUMMARY = (
    ("median", np.median),
    ("95 %", lambda s: np.quantile(s, 0.95)),
    ("max", np.max),
    ("min", np.min),
)


def _precision(adjustment: "Adjustment", accuracy_unit: float | None) -> list[str]:
    columns_of_points, unit = adjustment.points, clean(adjustment.network.object_unit)
    sigma = np.stack([stated_sigma(columns_of_points, axis) for axis in "XYZ"], 1)
    free = adjustment.problem.table("point").free > 0
    free = free & np.isfinite(sigma) & (sigma > 0)
    # Points at infinity have no coordinates whose σ could be counted.
    free &= adjustment.located[:, None]
    if not free.any():
        return ["No point has an estimated coordinate with a standard deviation."]
    columns = [sigma[free[:, i], i] for i in range(3)]
    all_free = sigma[free]
    places = column_decimals(all_free)
    rows = [
        (name, *(fixed(float(reduce(s)), places) if len(s) else "–" for s in (*columns, all_free)))
        for name, reduce in SUMMARY
    ]
    scale = float(np.median(all_free)) if accuracy_unit is None else float(accuracy_unit)
    meaning = "the median of all" if accuracy_unit is None else "as chosen"
    rows.append(("points", *(str(len(s)) for s in columns), ""))
    header = (f"in {unit}", "σX", "σY", "σZ", "all")
    counted = [np.histogram(s / scale, CLASSES)[0] for s in (*columns, all_free)]
    text = ["∞" if np.isinf(end) else f"{end:g}" for end in CLASSES]
    classes = [
        (f"{a}–{b}", *(str(column[i]) for column in counted))
        for i, (a, b) in enumerate(zip(text, text[1:]))
    ]
    # One table, so that both parts have the same columns.
    head, *body = table(header, [*rows, ("", "", "", "", ""), *classes], "lrrrr")
    first_rows, second_rows = body[: len(rows)], body[len(rows) + 1 :]
    note = f"Number of σ in classes of σ/s, s = {significant(scale, 3)} {unit} ({meaning})"
    return [head, *first_rows, "", note, *second_rows]


def _rays(rays: Int[np.ndarray, " points"]) -> list[str]:
    """How many points have how many rays."""
    numbers_seen = np.unique(rays)
    groups = [(int(n), int(n)) for n in numbers_seen]
    if len(groups) > 12:  # classes of equal ratio instead
        edges = np.unique(
            np.round(np.geomspace(max(numbers_seen[0], 1), numbers_seen[-1] + 1, 11)).astype(int)
        )
        groups = [(0, 0), *((int(a), int(b) - 1) for a, b in zip(edges, edges[1:]))]
    counted = [int(((rays >= a) & (rays <= b)).sum()) for a, b in groups]
    rows = [
        (str(a) if a == b else f"{a}–{b}", str(n), bar(n, max(counted)))
        for (a, b), n in zip(groups, counted)
        if n
    ]
    return ["", *table(("rays", "points", ""), rows, "rrl")]


def _list_of_points(adjustment: "Adjustment", max_rows: int) -> list[str]:
    columns = adjustment.points
    total = len(columns["id"])
    unit = clean(adjustment.network.object_unit)
    lines = heading(f"Points: coordinates in {unit}")
    # A table of what was given, without σ, says nothing of the result.
    if not (adjustment.problem.table("point").free > 0).any():
        return [*lines, f"All {count(total, 'point')} are held where they are given (points.csv)."]
    rows_shown = np.arange(min(total, max_rows))
    stated = {axis: stated_sigma(columns, axis) for axis in "XYZ"}
    places = [coordinate_decimals(stated[axis]) for axis in "XYZ"]
    rows = [
        (
            columns["id"][i],
            ROLE_WORDS[columns["role"][i]],
            *(fixed(columns[axis][i], d) for axis, d in zip("XYZ", places)),
            *(_sigma(stated[axis][i], d) for axis, d in zip("XYZ", places)),
            str(columns["rays"][i]),
        )
        for i in rows_shown
    ]
    header = ("point", "role", "X", "Y", "Z", "σX", "σY", "σZ", "rays")
    return [
        *lines,
        *table(header, rows, "llrrrrrrr"),
        *_left_out(total, max_rows, "point", "points.csv"),
    ]


# --- points at any distance -----------------------------------------------------------------


def far_points(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """Direction and distance of the points whose rays are nearly parallel, those at infinity
    first."""
    columns = adjustment.table("far_points")
    if not columns:
        return []
    network = adjustment.network
    order = np.lexsort((-columns["distance"], ~columns["at_infinity"]))
    rows = [
        (
            str(columns["id"][i]),
            *(f"{columns[f'u{axis}'][i]:.6f}" for axis in "XYZ"),
            significant(float(columns["su"][i])),
            "at infinity"
            if columns["at_infinity"][i]
            else significant(float(columns["distance"][i]), 4),
            significant(float(columns["nearer"][i])),
            "∞" if np.isinf(columns["farther"][i]) else significant(float(columns["farther"][i])),
        )
        for i in order[:max_rows]
    ]
    place = ", ".join(significant(x, 8) for x in not_none(adjustment.far_points).origin)
    angle = network.angle_unit
    lines = [
        *heading(f"Points at any distance: directions from {place}"),
        f"Their rays are nearly parallel. σ in {angle}; distance, and its interval of one σ of",
        f"the inverse distance, in {clean(network.object_unit)}.",
        "",
        *table(("point", "uX", "uY", "uZ", "σ", "distance", "from", "to"), rows, "lrrrrrrr"),
    ]
    return [*lines, *_left_out(len(order), max_rows, "point", "far_points.csv")]


# --- further kinds of observations ----------------------------------------------------------


def further_unknowns(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """The unknowns of further kinds of observations, a line each."""
    lines = []
    tables: dict[str, list] = {}
    for estimated in adjustment.further_estimates:
        value_and_sigma = estimate(estimated.value, estimated.sigma)
        tables.setdefault(estimated.table, []).append(
            (estimated.row, estimated.name, *value_and_sigma, clean(estimated.unit))
        )
    for name, rows in tables.items():
        lines += heading(clean(name[0].upper() + name[1:]))
        lines += table(("of", "unknown", "value", "σ", "unit"), rows[:max_rows], "llrrl")
        if len(rows) > max_rows:
            lines += _left_out(len(rows), max_rows, "unknown", "result.json")
    return lines
