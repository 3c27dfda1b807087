"""The page of a refinement of scanner images (`jaxbundle.refinement`)."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.network.columns import count
from jaxbundle.refinement import Refinement, point_rows
from jaxbundle.refinement.inputs import PHOTOGRAPH
from jaxbundle.report.layout import estimate
from jaxbundle.report.page.columns import Column, numbers
from jaxbundle.report.page.document import Listing, Page, Section, write
from jaxbundle.report.page.markup import facts, grid
from jaxbundle.report.page.origin import UNKNOWN, Origin
from jaxbundle.report.page.overview import give_verdict
from jaxbundle.report.page.sections import photographs, show_correlations, show_residuals
from jaxbundle.report.page.tables import Columns
from jaxbundle.report.refinement_verdict import conclude_refinement
from jaxbundle.types import not_none

KIND = "refinement of scanner images"
SCANNER_AXES = ("line", "pixel")
# A row of `Refinement.image_points`.
ImagePoint = dict[str, Any]


def compose_refinement(result: Refinement, origin: Origin = UNKNOWN) -> Iterator[str]:
    """The page of a `Refinement`: HTML, in pieces."""
    return write(_describe(result, origin))


def _describe(result: Refinement, origin: Origin) -> Page:
    all_points = _image_points(result)
    used_points = [row for row in all_points if not row["removed"]]
    w = np.concatenate([row["w"] for row in used_points])
    findings = conclude_refinement(result).findings
    first_section = give_verdict(findings, result.warnings, _list_numbers(result, used_points))
    sections = [first_section, photographs("w"), _unknowns(result), show_residuals(w, "w")]
    tables = {
        "images": Listing("Images", _images(result, used_points), "result.json"),
        "points": Listing("Points", _points(result), "points.csv"),
        "checks": Listing("Check points, computed − given", _checks(result), "result.json"),
        "observations": Listing("Image points", _observations(used_points), "result.json"),
        "heights": Listing("Terrain heights", _terrain_heights(result), "result.json"),
        "removed": Listing(
            "Removed as blunders",
            {
                "observation": Column(_words(b.name for b in result.removed), "observation"),
                "test": Column(numbers(b.test for b in result.removed), "|w|"),
            },
            "result.json",
        ),
    }
    title = f"{', '.join(scanner_image.id for scanner_image in result.images)}: {KIND}"
    frames = {"frames": _frames(result)}
    return Page(title, sections, origin, tables=tables, drawings=frames)


def _words(values: Iterable[object]) -> np.ndarray:
    return np.array(list(values), dtype=object)


def _image_points(result: Refinement) -> list[ImagePoint]:
    """The rows of `Refinement.image_points`, with what was measured and the names of the axes."""
    declared, inputs = result.inspection.declared, result.inspection.declared.inputs
    xy = lambda table: np.asarray(
        not_none(inputs.frames).observations.xy if table == PHOTOGRAPH else inputs.observations.xy
    )
    # The parts of the equations are in another order than the images.
    measured = declared.image_by_image(xy(p.table)[p.rows] for p in declared.parts)
    scanners = {scanner_image.id for scanner_image in result.images}
    return [
        row | {"measured": place, "axes": SCANNER_AXES if row["image"] in scanners else ("x", "y")}
        for row, place in zip(result.image_points(), measured)
    ]


def _list_numbers(result: Refinement, used_points: Sequence[ImagePoint]) -> str:
    roles = [result.points.role[k] for k in result.inspection.declared.rays.points]
    frames = 0 if result.frames is None else len(result.frames.images)
    rows = [
        ("Scanner images", f"{len(result.images)}, {len(result.inputs.rpc)} with RPC"),
        ("Photographs", frames),
        ("Points", ", ".join(f"{roles.count(role)} {role}" for role in ("control", "tie"))),
        ("Points by rays", ", ".join(f"{n} with {k}" for k, n in result.rays().items())),
        ("Image points", len(used_points)),
        ("Counts", ", ".join(f"{word} {n}" for word, n in result.counts().items() if n)),
        (
            "σ0",
            f"{result.sigma0:.4f} (robust {result.robust_sigma0:.4f}), redundancy "
            f"{result.redundancy}, {count(result.inspection.steps, 'step')}",
        ),
    ]
    return f"<h3>Result</h3>\n{facts(rows)}"


def _unknowns(result: Refinement) -> Section:
    """The changes of the unknowns with σ and prior, and their correlations."""
    # The numbers of more than 40 columns cannot be read on a page: they are in result.json.
    rows, shows_matrix = [], 1 < len(result.names) <= 40
    numbered = [
        f"{i}: {name}" if shows_matrix else str(name) for i, name in enumerate(result.names, 1)
    ]
    for owner, name, value, s, p in zip(
        numbered, result.names, result.estimate, result.inspection.sigma, result.prior_sigma
    ):
        prior = "free" if np.isinf(p) else f"{p * name.factor:.4g}"
        rows.append((owner, *estimate(value * name.factor, s * name.factor), prior, name.unit))
    parts = [grid(("unknown", "change", "σ", "σ of prior", "unit"), rows)]
    if shows_matrix:
        parts += [
            "<h3>Correlations in %</h3>\n",
            show_correlations(numbered, result.correlation, range(1, len(rows) + 1)),
        ]
    return Section("unknowns", "Unknowns of the images", "".join(parts), "Unknowns")


def _images(result: Refinement, used_points: Sequence[ImagePoint]) -> Columns:
    camera, rms = [], []
    for id in result.inspection.declared.inputs.ids:
        v = np.array([row["v"] for row in used_points if row["image"] == id]).reshape(-1, 2)
        rms.append(np.sqrt((v**2).sum(1).mean()) if len(v) else np.nan)
    scanners = [scanner_image.id for scanner_image in result.images]
    if result.frames is not None:
        camera = [result.frames.cameras[c].id for c in result.frames.images.camera]
    return {
        "id": Column(_words(result.inspection.declared.inputs.ids), "image"),
        "camera": Column(_words([*(f"scanner {id}" for id in scanners), *camera]), "camera"),
        "rms": Column(np.array(rms), "RMS |v|"),
    }


def _points(result: Refinement) -> Columns:
    rows = point_rows(result)
    columns = {
        "id": Column(_words(row["id"] for row in rows), "point"),
        "role": Column(_words(row["role"] for row in rows), "role"),
    }
    columns |= {a: Column(numbers(row[a] for row in rows), f"{a} [m]", 3, True) for a in "XYZ"}
    return columns | {
        f"s{a}": Column(numbers(row[f"s{a}"] for row in rows), f"σ{a} [m]") for a in "XYZ"
    }


def _checks(result: Refinement) -> Columns:
    check = result.check
    if check is None:
        return {}
    axes = ("X", "Y", "Z") if result.images[0].earth is None else ("east", "north", "up")
    columns = {"id": Column(_words(check.id), "point")}
    for k, axis in enumerate(axes):
        columns[f"d{k}"] = Column(check.difference[:, k], f"d {axis} [m]")
        columns[f"s{k}"] = Column(check.sigma[:, k], f"σ {axis} [m]")
    return columns | {"rays": Column(np.asarray(check.rays), "rays")}


def _terrain_heights(result: Refinement) -> Columns:
    rows = [row for row in result.terrain_heights() if not row["removed"]]
    if not rows:
        return {}
    return {
        "point": Column(_words(row["point"] for row in rows), "point"),
        "v": Column(numbers(row["v"] for row in rows), "v [m]"),
        "r": Column(numbers(row["r"] for row in rows), "r", 3),
        "tau": Column(numbers(row["w"] for row in rows), "w", 2),
    }


def _observations(used_points: Sequence[ImagePoint]) -> Columns:
    """One row per coordinate, as for an adjustment; `tau`, the drawn test, is w."""
    both_coordinates = lambda name: np.concatenate([row[name] for row in used_points])
    for_both = lambda name: _words(row[name] for row in used_points for _ in range(2))
    return {
        "kind": Column(np.full(2 * len(used_points), "image", dtype=object)),
        "image": Column(for_both("image"), "image"),
        "point": Column(for_both("point"), "point"),
        "axis": Column(_words(axis for row in used_points for axis in row["axes"]), "axis"),
        "measured": Column(both_coordinates("measured"), "measured", 3),
        "v": Column(both_coordinates("v"), "v"),
        "r": Column(both_coordinates("r"), "r", 3),
        "tau": Column(both_coordinates("w"), "w", 2),
    }


def _frames(result: Refinement) -> dict[str, dict]:
    """By camera, and scanner image, what is drawn: pixels to the right, lines down."""
    frame = lambda low, high, is_known, y_down, unit: {
        "low": low,
        "high": high,
        "known": is_known,
        "down": y_down,
        "scale": 1.0,
        "unit": unit,
        "centre": None,
    }
    frames = {
        f"scanner {scanner_image.id}": frame(
            [0.0, 0.0],
            [scanner_image.image.pixels - 1.0, scanner_image.image.lines - 1.0],
            True,
            True,
            "px",
        )
        for scanner_image in result.images
    }
    for camera in () if result.frames is None else result.frames.cameras:
        model = get_model(camera.model)
        frames[camera.id] = frame([0.0, 0.0], [0.0, 0.0], False, model.axes == "down", model.unit)
    return frames
