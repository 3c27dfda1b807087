"""The report of a calibration and its JSON: photographs, camera, quality, adjustment."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.calibration.verdict import (
    conclude_calibration,
    coverage_in_words,
    cross_validation_in_words,
)
from jaxbundle.io.results.result_json import result_dict, verdict_dict
from jaxbundle.measure.boards import Board, BoardSet
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.columns import count
from jaxbundle.report.head import first_facts
from jaxbundle.report.layout import (
    DIGITS_WITHOUT_SIGMA,
    clean,
    cut_lines,
    estimate,
    facts,
    fixed,
    heading,
    paragraph,
    significant,
    table,
)

if TYPE_CHECKING:
    from jaxbundle.calibration.bias import CalibrationBias
    from jaxbundle.calibration.mapping_error import MappingError
    from jaxbundle.calibration.model_choice import ModelComparison
    from jaxbundle.calibration.quality import Coverage, UncertaintyMap
    from jaxbundle.calibration.result import Calibration

MAPS_HEADER = ("point held in", "middle", "corners")


def text(calibration: "Calibration") -> str:
    """Photographs, camera, quality and advice, followed by the report of the adjustment."""
    verdict = conclude_calibration(calibration) if calibration.converged else None
    body = _join([*_photographs(calibration), *_assessment(calibration)])
    return f"{body}\n{calibration.adjustment.report(verdict=verdict)}"


def summary(calibration: "Calibration") -> str:
    """The verdict, photographs, camera, quality and advice: a page or two."""
    if not calibration.converged:
        return text(calibration)
    verdict = facts(first_facts(calibration.adjustment, conclude_calibration(calibration)))
    return _join([*_photographs(calibration), "", *verdict, *_assessment(calibration)])


def _assessment(calibration: "Calibration") -> list[str]:
    """Camera, quality and advice, of what has a solution."""
    if not calibration.converged:
        return []
    return [*_camera(calibration), *_quality(calibration), *_advice(calibration)]


def _join(lines: Sequence[str]) -> str:
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _photographs(calibration: "Calibration") -> list[str]:
    views = calibration.views
    lines = [f"Calibration of {clean(calibration.name)}", "=" * 100]
    lines += facts(photograph_facts(views))
    if views.failed:
        lines += heading("Photographs not used")
        rows = facts((clean(name), clean(why)) for name, why in views.failed)
        lines += cut_lines(rows, 50, "…")  # the JSON has all
    return lines


def photograph_facts(views: BoardViews) -> list[tuple[str, str]]:
    """The board, the number of photographs and of detected points."""
    size = " × ".join(map(str, views.image_size))
    boards = views.board.items if isinstance(views.board, BoardSet) else [("", views.board)]
    used = len({*views.photographs})
    return [
        *((f"Board {clean(name)}".strip(), str(board)) for name, board in boards),
        ("Photographs", f"{used} used, {len(views.failed)} not; {size} pixels"),
        ("Points", f"{int(views.visible.sum())} of {views.possible} image points found"),
        *(("Note", note) for note in views.notes),
    ]


def _camera(calibration: "Calibration") -> list[str]:
    lines = heading(f"Camera ({calibration.adjustment.network.cameras[0].model})")
    free = calibration.stated_sigma
    rows = []
    # Parameters held at zero are not part of the camera, to a reader.
    for name, value in calibration.parameters.items():
        if name in free:
            rows.append((name, *estimate(value, free[name])))
        elif value != 0:
            rows.append((name, significant(value, DIGITS_WITHOUT_SIGMA), "held"))
    lines += table(("parameter", "value", "σ"), rows, "lrr")
    rms = calibration.rms
    removed = len(calibration.adjustment.removed)
    # The first as OpenCV states it, the second to compare with σ of a coordinate.
    lines += ["", f"RMS of an image point {rms:.4f} px, of a coordinate {rms / np.sqrt(2):.4f} px"]
    lines += [f"Removed as gross errors: {count(removed, 'image point')}"] if removed else []
    return lines


def _quality(calibration: "Calibration") -> list[str]:
    lines = heading("Quality")
    away, unit = calibration.distances, clean(calibration.adjustment.network.object_unit)
    lines += facts(
        [
            ("Coverage", coverage_in_words(calibration.coverage)),
            ("Distances", f"{away.min():.4g} to {away.max():.4g} {unit}"),
        ]
    )
    lines += ["", "Uncertainty of a projected point (σ, pixels)"]
    lines += table(MAPS_HEADER, map_rows(calibration.reported_maps, unit), "lrr")
    lines += ["", *paragraph(mapping_error_in_words(calibration.mapping_error))]
    if calibration.bias is not None:
        lines += paragraph(bias_in_words(calibration.bias))
    first, *further = cross_validation_in_words(calibration)
    lines += ["", *paragraph(f"Cross-validation: {first}")]
    return [*lines, *(line for words in further for line in paragraph(words))]


def mapping_error_in_words(error: "MappingError") -> str:
    """The expected mapping error."""
    percent = lambda share: f"{100 * share:.0f} % of the image"
    whole = "the whole image" if error.share == 1 else f"the {percent(error.share)} with rays"
    if error.measured is None:
        where, stated, more = whole, error, ""
    else:
        stated = error.measured
        where = f"the {percent(stated.share)} within the farthest measured point"
        more = f"; over {whole}, partly extrapolated, {error.rms:.3f} px"
    return (
        f"Expected mapping error over {where}, rotation removed: {stated.rms:.3f} px (RMS), "
        f"below {stated.quantile():.3f} px with 95 %{more}."
    )


def bias_in_words(bias: "CalibrationBias") -> str:
    """σ of a corner compared with that of the residuals, and the conclusion of the tests."""
    tests = "; ".join(f"{name} {test}" for name, test in bias.tests.items())
    return (
        f"Bias: σ of a corner {bias.corner_sigma:.4f} px from {bias.cells} cells of four, of "
        f"the residuals {bias.residual_sigma:.4f} px. {tests}: {bias.sentence}."
    )


def map_rows(maps: Sequence["UncertaintyMap"], unit: str) -> list[tuple[str, str, str]]:
    """The frame in which a point is fixed, its σ in the middle and in the corners, pixels
    (`MAPS_HEADER`)."""
    return [(_held_in(m, unit), fixed(m.middle, 3), fixed(m.corners, 3)) for m in maps]


def _held_in(m: "UncertaintyMap", unit: str) -> str:
    if m.frame in ("scene", "rig"):
        away = f"{m.distance:.3g} {unit}" if m.distance < np.inf else "infinity"
        return f"the {m.frame}, at {away}"
    return {"rotation": "all rays, rotation removed", "camera": "the camera frame"}[m.frame]


def _advice(calibration: "Calibration") -> list[str]:
    found = calibration.advice
    lines = heading("Advice")
    if not found:
        return [*lines, "none: directions, distances and coverage are good"]
    for item in found:
        lines += paragraph(f"- {item}", hanging=2)
    return lines


def as_dict(calibration: "Calibration", brief: bool = False) -> dict:
    """The JSON of the adjustment with a section `calibration`."""
    views, adjustment = calibration.views, calibration.adjustment
    about = {
        "camera": calibration.name,
        **_boards_dict(views.board),
        "image_size": list(views.image_size),
        "photographs": {
            "used": list(dict.fromkeys(views.photographs)),
            "failed": dict(views.failed),
        },
    }
    if calibration.converged:
        about |= _quality_dict(calibration)
    found = {"calibration": about, **result_dict(adjustment, brief)}
    if "verdict" in found:
        found["verdict"] = verdict_dict(conclude_calibration(calibration))
    return found


def _boards_dict(board: Board | BoardSet) -> dict:
    """The board, or several by name."""
    if isinstance(board, BoardSet):
        return {"boards": {name: _boards_dict(one)["board"] for name, one in board.items}}
    return {
        "board": {
            "kind": board.kind,
            "columns": board.columns,
            "rows": board.rows,
            "square": board.square,
            "row_spacing": board.spacing[1],
            "first_marker": board.first_marker,
        }
    }


def _quality_dict(calibration: "Calibration") -> dict:
    covered, checked, bias = calibration.coverage, calibration.cross_validation, calibration.bias
    return {
        "rms": calibration.rms,
        "distances": calibration.distances.tolist(),
        "coverage": coverage_dict(covered),
        "uncertainty": maps_dict(calibration.reported_maps),
        "mapping_error": _mapping_error_dict(calibration.mapping_error),
        "bias": None
        if bias is None
        else {
            "cells": bias.cells,
            "corner_sigma": bias.corner_sigma,
            "residual_sigma": bias.residual_sigma,
            "ratio": bias.ratio,
            "found": list(bias.found),
            "tests": {
                name: {"F": test.F, "degrees": list(test.degrees), "probability": test.probability}
                for name, test in bias.tests.items()
            },
        },
        "cross_validation": None
        if checked is None
        else {
            "rms_own": checked.rms_own,
            "rms_other": checked.rms_other,
            "test": checked.test,
            "difference": checked.difference,
            "halves": list(checked.halves),
            "images": None
            if checked.comparison is None
            else {
                "rms": checked.comparison.rms,
                "largest": checked.comparison.largest,
                "unit": checked.comparison.unit,
            },
        },
        "advice": calibration.advice,
    }


def choice_text(found: "ModelComparison") -> str:
    """The comparison of models (`model_choice.ModelComparison`)."""
    lines = ["Camera models compared", "=" * 100]
    lines += facts(
        [
            (
                "Photographs",
                f"{len(found.views)}, in {found.folds} folds; "
                f"{len(found.gross)} points that no model explains are left out",
            ),
        ]
    )
    lines += ["", *table(MODELS_HEADER, model_rows(found), "lrrrrrrrrr"), ""]
    lines += paragraph(models_legend(found))
    lines += [f"not compared: {clean(name)}: {clean(why)}" for name, why in found.failed.items()]
    return "\n".join(line.rstrip() for line in [*lines, "", *paragraph(found.sentence)])


MODELS_HEADER = ("model", "free", "σ0", "RMS", "left out", "ΔAIC", "ΔBIC", "Δ rms", "largest", "/σ")


def model_rows(found: "ModelComparison") -> list[tuple[str, ...]]:
    """One row per model (`MODELS_HEADER`)."""
    low = {name: min(getattr(one, name) for one in found.candidates) for name in ("aic", "bic")}
    rows = []
    for one in found.candidates:
        apart = found.differences.get(one.model)
        map_of = (
            ("", "", "")
            if apart is None
            else (fixed(apart.rms, 3), fixed(apart.largest, 3), fixed(apart.over_sigma, 1))
        )
        rows.append(
            (
                one.model,
                str(one.free),
                fixed(one.sigma0, 3),
                fixed(one.rms, 4),
                fixed(one.left_out, 4),
                fixed(one.aic - low["aic"], 1),
                fixed(one.bic - low["bic"], 1),
                *map_of,
            )
        )
    return rows


def models_legend(found: "ModelComparison") -> str:
    """The columns of `model_rows`."""
    return (
        f"RMS: residuals of all photographs; left out: of those not used for the camera; Δ: images "
        f"apart from those of {found.best.model}, over the whole image, rotation removed, and RMS "
        "over their σ. Pixels."
    )


def choice_dict(found: "ModelComparison") -> dict:
    """The comparison of models as a section of JSON."""
    candidates = {}
    for one in found.candidates:
        apart = found.differences.get(one.model)
        candidates[one.model] = {
            "free": one.free,
            "unknowns": one.unknowns,
            "sigma0": one.sigma0,
            "rms": one.rms,
            "left_out": one.left_out,
            "aic": one.aic,
            "bic": one.bic,
            "parameters": one.calibration.parameters,
            "sigma": one.calibration.sigma,
            "difference": None
            if apart is None
            else {
                "rms": apart.rms,
                "largest": apart.largest,
                "over_sigma": apart.over_sigma,
            },
        }
    return {
        "suffices": found.suffices.model,
        "best": found.best.model,
        "sentence": found.sentence,
        "folds": found.folds,
        "photographs": list(found.views),
        "gross": [list(pair) for pair in found.gross],
        "failed": found.failed,
        "models": candidates,
    }


def coverage_dict(covered: "Coverage") -> dict:
    return {
        "part": covered.part,
        "reach": covered.reach,
        "corners": covered.corners,
        "counts": covered.counts.tolist(),
    }


def maps_dict(maps: Sequence["UncertaintyMap"]) -> list[dict]:
    number = lambda x: float(x) if np.isfinite(x) else None
    return [
        {
            "frame": m.frame,
            "distance": number(m.distance),
            "middle": number(m.middle),
            "corners": number(m.corners),
        }
        for m in maps
    ]


def _mapping_error_dict(error: "MappingError | None") -> dict | None:
    return (
        None
        if error is None
        else {
            # Pixels², the others pixels.
            "expected": error.expected,
            "rms": error.rms,
            "quantile_95": error.quantile(),
            "share": error.share,
            "measured": _mapping_error_dict(error.measured),
        }
    )
