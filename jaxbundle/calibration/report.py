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
from jaxbundle.network.blunders import removed_rays
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
    number_used = len({*views.photographs})
    return [
        *((f"Board {clean(name)}".strip(), str(board)) for name, board in boards),
        ("Photographs", f"{number_used} used, {len(views.failed)} not; {size} pixels"),
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
    number_removed = len(removed_rays(calibration.adjustment.removed))
    # The first as OpenCV states it, the second to compare with σ of a coordinate.
    lines += ["", f"RMS of an image point {rms:.4f} px, of a coordinate {rms / np.sqrt(2):.4f} px"]
    lines += (
        [f"Removed as gross errors: {count(number_removed, 'image point')}"]
        if number_removed
        else []
    )
    return lines


def _quality(calibration: "Calibration") -> list[str]:
    lines = heading("Quality")
    distances, unit = calibration.distances, clean(calibration.adjustment.network.object_unit)
    lines += facts(
        [
            ("Coverage", coverage_in_words(calibration.coverage)),
            ("Distances", f"{distances.min():.4g} to {distances.max():.4g} {unit}"),
        ]
    )
    lines += ["", "Uncertainty of a projected point (σ, pixels)"]
    lines += table(MAPS_HEADER, map_rows(calibration.reported_maps, unit), "lrr")
    lines += ["", *paragraph(mapping_error_in_words(calibration.mapping_error))]
    if calibration.bias is not None:
        lines += paragraph(bias_in_words(calibration.bias))
    first_sentence, *other_sentences = cross_validation_in_words(calibration)
    lines += ["", *paragraph(f"Cross-validation: {first_sentence}")]
    return [*lines, *(line for words in other_sentences for line in paragraph(words))]


def mapping_error_in_words(error: "MappingError") -> str:
    """The expected mapping error."""
    percent = lambda share: f"{100 * share:.0f} % of the image"
    whole_in_words = (
        "the whole image" if error.share == 1 else f"the {percent(error.share)} with rays"
    )
    if error.measured is None:
        where, stated_error, remark = whole_in_words, error, ""
    else:
        stated_error = error.measured
        where = f"the {percent(stated_error.share)} within the farthest measured point"
        remark = f"; over {whole_in_words}, partly extrapolated, {error.rms:.3f} px"
    return (
        f"Expected mapping error over {where}, rotation removed: {stated_error.rms:.3f} px (RMS), "
        f"below {stated_error.quantile():.3f} px with 95 %{remark}."
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
        distance = f"{m.distance:.3g} {unit}" if m.distance < np.inf else "infinity"
        return f"the {m.frame}, at {distance}"
    return {"rotation": "all rays, rotation removed", "camera": "the camera frame"}[m.frame]


def _advice(calibration: "Calibration") -> list[str]:
    warnings = calibration.advice
    lines = heading("Advice")
    if not warnings:
        return [*lines, "none: directions, distances and coverage are good"]
    for item in warnings:
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
    document = {"calibration": about, **result_dict(adjustment, brief)}
    if "verdict" in document:
        document["verdict"] = verdict_dict(conclude_calibration(calibration))
    return document


def _boards_dict(board: Board | BoardSet) -> dict:
    """The board, or several by name."""
    if isinstance(board, BoardSet):
        return {
            "boards": {
                name: _boards_dict(named_board)["board"] for name, named_board in board.items
            }
        }
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


def choice_text(comparison: "ModelComparison") -> str:
    """The comparison of models (`model_choice.ModelComparison`)."""
    lines = ["Camera models compared", "=" * 100]
    lines += facts(
        [
            (
                "Photographs",
                f"{len(comparison.views)}, in {comparison.folds} folds; "
                f"{len(comparison.gross)} points that no model explains are left out",
            ),
        ]
    )
    lines += ["", *table(MODELS_HEADER, model_rows(comparison), "lrrrrrrrrr"), ""]
    lines += paragraph(models_legend(comparison))
    lines += [
        f"not compared: {clean(name)}: {clean(why)}" for name, why in comparison.failed.items()
    ]
    return "\n".join(line.rstrip() for line in [*lines, "", *paragraph(comparison.sentence)])


MODELS_HEADER = ("model", "free", "σ0", "RMS", "left out", "ΔAIC", "ΔBIC", "Δ rms", "largest", "/σ")


def model_rows(comparison: "ModelComparison") -> list[tuple[str, ...]]:
    """One row per model (`MODELS_HEADER`)."""
    low = {
        name: min(getattr(candidate, name) for candidate in comparison.candidates)
        for name in ("aic", "bic")
    }
    rows = []
    for candidate in comparison.candidates:
        difference = comparison.differences.get(candidate.model)
        map_of = (
            ("", "", "")
            if difference is None
            else (
                fixed(difference.rms, 3),
                fixed(difference.largest, 3),
                fixed(difference.over_sigma, 1),
            )
        )
        rows.append(
            (
                candidate.model,
                str(candidate.free),
                fixed(candidate.sigma0, 3),
                fixed(candidate.rms, 4),
                fixed(candidate.left_out, 4),
                fixed(candidate.aic - low["aic"], 1),
                fixed(candidate.bic - low["bic"], 1),
                *map_of,
            )
        )
    return rows


def models_legend(comparison: "ModelComparison") -> str:
    """The columns of `model_rows`."""
    return (
        "RMS: residuals of all photographs; left out: of those not used for the camera; Δ: images "
        f"apart from those of {comparison.best.model}, over the whole image, rotation removed, and "
        "RMS over their σ. Pixels."
    )


def choice_dict(comparison: "ModelComparison") -> dict:
    """The comparison of models as a section of JSON."""
    candidates = {}
    for candidate in comparison.candidates:
        difference = comparison.differences.get(candidate.model)
        candidates[candidate.model] = {
            "free": candidate.free,
            "unknowns": candidate.unknowns,
            "sigma0": candidate.sigma0,
            "rms": candidate.rms,
            "left_out": candidate.left_out,
            "aic": candidate.aic,
            "bic": candidate.bic,
            "parameters": candidate.calibration.parameters,
            "sigma": candidate.calibration.sigma,
            "difference": None
            if difference is None
            else {
                "rms": difference.rms,
                "largest": difference.largest,
                "over_sigma": difference.over_sigma,
            },
        }
    return {
        "suffices": comparison.suffices.model,
        "best": comparison.best.model,
        "sentence": comparison.sentence,
        "folds": comparison.folds,
        "photographs": list(comparison.views),
        "gross": [list(pair) for pair in comparison.gross],
        "failed": comparison.failed,
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
