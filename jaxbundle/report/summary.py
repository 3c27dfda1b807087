"""The short forms of a result: a few lines of text, and a small HTML for notebooks."""

from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.network.columns import count, list_some
from jaxbundle.report.correlated import first_facts, stated_sigma, stated_sigma_of
from jaxbundle.report.head import (
    chi_squared,
    count_points,
    count_removed,
    image_precision,
    image_residuals_in_words,
    left_out_in_words,
    redundancy_in_words,
    result_in_words,
    sigma0_in_words,
)
from jaxbundle.report.layout import (
    MISSING,
    clean,
    estimate,
    facts,
    significant,
)

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


def one_line(adjustment: "Adjustment") -> str:
    """The text of `repr`."""
    network = adjustment.network
    name = f"Adjustment {clean(network.name)!r}"
    if not adjustment.converged:
        return f"<{name}: NOT converged ({adjustment.termination})>"
    return (
        f"<{name}: converged, σ0 {sigma0_in_words(adjustment)}, redundancy "
        f"{adjustment.redundancy}, {count(len(network.images), 'image')}, "
        f"{count(count_points(adjustment), 'point')}>"
    )


def summary(adjustment: "Adjustment") -> list[tuple[str, str]]:
    """The facts of the short forms: names and texts."""
    network = adjustment.problem.network
    rows = [
        ("Result", result_in_words(adjustment)),
        (
            "Network",
            f"{count(len(network.cameras), 'camera')}, {count(len(network.images), 'image')}, "
            f"{count(count_points(adjustment), 'point')}; datum {network.datum}, defect "
            f"{adjustment.counts.datum}; residuals {network.residuals}",
        ),
        ("Redundancy", redundancy_in_words(adjustment)),
    ]
    if words := left_out_in_words(adjustment):
        rows.insert(1, ("Left out", words))
    if adjustment.converged:
        rows[1:1] = [("Verdict", adjustment.verdict.words), *first_facts(adjustment)]
    if not adjustment.converged:
        if adjustment.undetermined:
            rows.append(("Not determined", list_some(adjustment.undetermined, 8, clean)))
        rows.append(("", "There is no result; report() says what to do."))
    else:
        rows += [
            ("σ0", sigma0_in_words(adjustment)),
            ("Image precision", image_precision(adjustment)),
            ("RMS residual", image_residuals_in_words(adjustment)),
            ("χ² test", chi_squared(adjustment)),
            *_cameras(adjustment),
            ("Points", _points(adjustment)),
            *_far_points(adjustment),
            ("Largest |τ|", _worst(adjustment)),
        ]
    for noun, number in (
        ("removed observation", count_removed(adjustment.removed)),
        ("eliminated parameter", len(adjustment.eliminated)),
        ("warning", len(adjustment.warnings)),
    ):
        if number:
            rows.append(("Note", f"{count(number, noun)}: see report()"))
    return rows


def _cameras(adjustment: "Adjustment") -> Iterator[tuple[str, str]]:
    # The summary stays within a screen: three cameras, of a spline model the first parameters.
    max_cameras, max_parameters = 3, 20
    tables = adjustment.cameras
    for camera, entry in list(tables.items())[:max_cameras]:
        parts = [
            f"{name} {value}" + ("" if sigma == MISSING else f" ± {sigma}")
            for name, parameter in entry["parameters"].items()
            if parameter["free"]
            for value, sigma in [estimate(parameter["value"], stated_sigma_of(parameter))]
        ]
        if len(parts) > max_parameters:
            number_of_others = len(parts) - max_parameters // 2
            parts[max_parameters // 2 :] = [f"and {number_of_others} more parameters, see report()"]
        text = ", ".join(parts) if parts else "held"
        yield f"Camera {clean(camera)}", f"{entry['model']}: {text}"
    if len(tables) > max_cameras:
        yield "", f"and {count(len(tables) - max_cameras, 'other camera')}"


def _points(adjustment: "Adjustment") -> str:
    unit = clean(adjustment.network.object_unit)
    # Beside the median the 95 % quantile: a handful of hardly determined points would dominate the
    # RMS and the maximum.
    share = 0.95
    parts = []
    for axis in "XYZ":
        sigma = stated_sigma(adjustment.points, axis)
        sigma = sigma[np.isfinite(sigma) & (sigma > 0) & adjustment.located]
        if len(sigma):
            middle, quantile = np.quantile(sigma, (0.5, share))
            parts.append(f"σ{axis} {significant(middle)} ({significant(quantile)})")
    if not parts:
        return "no coordinate is estimated with a σ"
    brackets = f"in brackets the value that {100 * share:g} % do not exceed"
    return f"median {', '.join(parts)} {unit}, {brackets}"


def _far_points(adjustment: "Adjustment") -> Iterator[tuple[str, str]]:
    distant = adjustment.far_points
    if distant is not None:
        number = f"{count(len(distant.id), 'point')} at any distance"
        yield "", f"and {number}, {distant.at_infinity.sum()} of them at infinity"


def _worst(adjustment: "Adjustment") -> str:
    columns = adjustment.residuals
    tau = np.abs(np.nan_to_num(columns["tau"]))
    if not tau.max(initial=0.0) > 0:
        return "no observation is controlled"
    i = int(tau.argmax())
    observation = " ".join(
        clean(part)
        for part in (columns["kind"][i], columns["image"][i], columns["point"][i])
        if part
    )
    return f"{significant(tau[i])} ({observation}, {columns['axis'][i]})"


def short(adjustment: "Adjustment") -> str:
    """The result in about fifteen lines; one that was not solved shows no numbers of a solution."""
    head = f"Adjustment {clean(adjustment.network.name)!r}"
    return "\n".join([head, *facts(summary(adjustment), indent=2)])


def html(adjustment: "Adjustment") -> str:
    """The facts of the summary as a small self-contained HTML; everything from files is escaped."""
    cell = 'style="text-align:left;vertical-align:top;padding:2px 12px 2px 0"'
    colour = "#2a6f4e" if adjustment.converged else "#a33b2c"
    rows = "".join(
        f"<tr><th {cell}>{escape(name)}</th><td {cell}>{escape(text)}</td></tr>"
        for name, text in summary(adjustment)
    )
    name = escape(clean(adjustment.network.name))
    return (
        f'<div style="border-left:4px solid {colour};padding-left:10px">'
        f"<b>Adjustment {name}</b>"
        f'<table style="border-collapse:collapse;font-size:90%">{rows}</table></div>'
    )
