"""The page of a certificate: verdict cards and a picture first, tables behind; it prints on A4."""

from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.uncertainty_budget import HEADER as BUDGET_HEADER
from jaxbundle.adjustment.uncertainty_budget import RESULT_HEADER
from jaxbundle.calibration.rig.report import (
    MOUNTED,
    correlation_rows,
    mounting_rows,
    mounting_titles,
    rig_parameter_rows,
)
from jaxbundle.certificates import lengths as length_tests
from jaxbundle.certificates import positional
from jaxbundle.certificates.acceptance import HEADER as ACCEPTANCE_HEADER
from jaxbundle.certificates.details import FIELDS, WANTED
from jaxbundle.certificates.positional import SUMMARY_HEADER
from jaxbundle.certificates.result_verdict import verdict_of
from jaxbundle.certificates.units import convert
from jaxbundle.io.results.gis import round_down
from jaxbundle.network.columns import count
from jaxbundle.network.units import METRES
from jaxbundle.report import head, observations
from jaxbundle.report.correlated import INDEPENDENCE
from jaxbundle.report.layout import clean, column_decimals, fixed, significant
from jaxbundle.report.page.charts import ChartLayout, Curve, draw_curves, draw_field, draw_plan
from jaxbundle.report.page.document import Page, Section, write
from jaxbundle.report.page.markup import facts, figure, grid, grid_of_first, items, paragraph, text
from jaxbundle.report.page.sections import show_correlations
from jaxbundle.report.verdict import BAD, GOOD

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment
    from jaxbundle.calibration.rig.result import RigCalibration
    from jaxbundle.certificates.acceptance import Acceptance
    from jaxbundle.certificates.document import Certificate, CertifiedPart
    from jaxbundle.certificates.lengths import LengthTest

STYLE = "certificate.css"
# Rows of a table of control or check points on the page: four printed pages; files have all.
MOST_ROWS = 200
# Budgets that are printed in full: four a page, so that a rig of ten cameras keeps to 20 pages.
MOST_BUDGETS = 80


class Card(NamedTuple):
    """A key figure: `title`, `value`, `note`; `state`, "good", "open", "bad" or none."""

    title: str
    value: str
    note: str = ""
    state: str = ""


def compose_certificate(certificate: "Certificate") -> Iterator[str]:
    """The certificate as HTML, in pieces."""
    details = certificate.details.fields
    title = certificate.title + (f" {details['number']}" if "number" in details else "")
    sections = [
        _result_section(certificate),
        *_findings(certificate),
        *_results(certificate),
        *_rig(certificate),
        *_acceptance(certificate),
        *_lengths(certificate),
        *_accuracy(certificate),
        *_budgets(certificate),
        *_survey(certificate),
        _statements(certificate),
    ]
    style = files("jaxbundle.certificates").joinpath(STYLE).read_text(encoding="utf-8")
    return write(Page(title, sections, certificate.origin, style=style))


# --- first screen ---------------------------------------------------------------------------


def _result_section(certificate: "Certificate") -> Section:
    parts = [_cards(find_cards(certificate)), *map(_picture, certificate.parts[:1])]
    return Section("certificate", "Result", "".join([*parts, _identity(certificate)]))


def _findings(certificate: "Certificate") -> Iterator[Section]:
    """What lowers the verdict of the tests, in full."""
    lowering = [one for one in verdict_of(certificate.result).findings if one.lowers]
    rows = "".join(
        f'<tr><th scope="row">{text(clean(one.about))}</th><td>{text(one.state)}: '
        f"{text(clean(one.words))}</td></tr>\n"
        for one in lowering
    )
    if rows:
        yield Section(
            "findings", "Findings", f'<table class="facts">\n{rows}</table>\n', "Findings"
        )


def _cards(cards: Sequence[Card]) -> str:
    content = "".join(
        f'<div class="card {card.state}"><small>{text(card.title)}</small>'
        f"<b>{text(card.value)}</b><small>{text(card.note)}</small></div>\n"
        for card in cards
    )
    return f'<div class="cards">\n{content}</div>\n'


STATES = {GOOD: "good", BAD: "bad", "doubtful": "open"}


def find_cards(certificate: "Certificate") -> list[Card]:
    """Verdicts first, then key figures."""
    cards = []
    if (acceptance := certificate.acceptance) is not None:
        state = "good" if acceptance.met else "bad"
        verdict = "accepted" if acceptance.met else "not accepted"
        cards.append(Card("Acceptance criteria", verdict, acceptance.sentence, state))
    if (test := certificate.lengths) is not None:
        verdict_words = {
            length_tests.CONFORMS: ("conforms", "good"),
            length_tests.FAILS: ("does not conform", "bad"),
            length_tests.OPEN: ("not decided", "open"),
            "": ("no MPE stated", ""),
        }[test.verdict]
        note = f"MPE {test.mpe.text or significant(test.mpe.constant)}" if test.mpe else ""
        cards.append(Card("Length measurement", verdict_words[0], note, verdict_words[1]))
    verdict = verdict_of(certificate.result)
    cards.append(Card("Tests", verdict.state, verdict.words, STATES.get(verdict.state, "")))
    if test is not None:
        rms = readable_length(test.rms, test.unit)
        note = f"largest of {count(len(test.lengths), 'length')}, RMS {rms}"
        cards.append(Card("|E|", readable_length(test.largest, test.unit), note))
    for part in certificate.parts:
        cards += _figures(part)
    return cards


def _figures(part: "CertifiedPart") -> list[Card]:
    name = f"{clean(part.name)}: " if part.name else ""
    cards = [
        Card(
            f"{name}σ0", f"{part.adjustment.sigma0:.3f}", f"redundancy {part.adjustment.redundancy}"
        )
    ]
    if part.calibration is not None:
        note = f"{len(part.calibration.views)} photographs"
        cards.append(Card(f"{name}RMS of an image point", f"{part.calibration.rms:.3f} px", note))
    if part.accuracy is not None:
        accuracy = part.accuracy
        state = {"met": "good", "not met": "bad", "": ""}[accuracy.verdict]
        title, rmse = "RMSE_V", accuracy.rmse_v
        if accuracy.number[0]:
            title, rmse = "RMSE_H", accuracy.rmse_h
        if all(accuracy.number):
            title, rmse = "RMSE_3D", accuracy.rmse_3d
        value = readable_length(rmse, accuracy.unit)
        note = count(max(accuracy.number), "check point")
        cards.append(Card(f"{name}{title}", value, note, state))
    if part.budget is not None:
        value, U, unit = part.budget.result_rows()[0][1:4]
        first_measurand = part.budget.measurands[0].words
        note = f"± {U} {unit}, {100 * part.budget.coverage:.4g} %"
        cards.append(Card(first_measurand, f"{value} {unit}".strip(), note))
    return cards


def readable_length(value: float, unit: str) -> str:
    """A length in km, m, mm or µm, whichever has one to three digits before the point."""
    if unit not in METRES or not np.isfinite(value) or value == 0:
        return f"{significant(value)} {clean(unit)}"
    best = next((u for u in ("km", "m", "mm", "um") if abs(convert(value, unit, u)) >= 1), "um")
    return f"{significant(convert(value, unit, best))} {best.replace('um', 'µm')}"


def _identity(certificate: "Certificate") -> str:
    """What the laboratory states, with lines to fill in where it did not."""
    stated = certificate.details.fields
    rows = []
    for name, title in FIELDS.items():
        if name in stated:
            cell = text(stated[name])
        elif name in WANTED:
            cell = '<span class="blank"></span>'
        else:
            continue
        rows.append(f'<tr><th scope="row">{text(title)}</th><td>{cell}</td></tr>\n')
    return f'<h3>Identification</h3>\n<table class="facts">\n{"".join(rows)}</table>\n'


def _picture(part: "CertifiedPart") -> str:
    """A camera's uncertainty over its image; else the network in plan."""
    if part.calibration is not None:
        uncertainty = part.calibration.uncertainty()
        return figure(
            draw_field(uncertainty.sigma),
            f"Camera {part.calibration.name}: σ of a projected point at infinity over the image, "
            "from corner to corner, pixels",
        )
    return draw_network(part.adjustment)


def draw_network(adjustment: "Adjustment") -> str:
    """Stations and points in plan, with error ellipses of the points; nothing without points."""
    points, C = adjustment.point_values[:, :2], adjustment.point_covariance[:, :2, :2]
    stations = adjustment.image_values[:, :2]
    is_finite = np.isfinite(points).all(1) & np.isfinite(C).all((1, 2))
    points, C = points[is_finite], C[is_finite]
    if not len(points):
        return ""
    extent = float(np.ptp(np.concatenate([points, stations]), axis=0).max()) or 1.0
    roots = [_ellipse_root(block) for block in C]
    largest = max((float(np.linalg.norm(root)) for root in roots), default=0.0)
    # The largest ellipse a twentieth of the network, times a round number.
    factor = round_down(0.05 * extent / largest) if largest > 0 else 0.0
    turn = np.linspace(0, 2 * np.pi, 33)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    lines = []
    for centre, root in zip(points, roots):
        x, y = centre[:, None] + factor * root @ circle
        lines.append(Curve(f"σ of a point × {factor:g}", x, y, kind="first"))
    size = 0.012 * extent
    # An equilateral triangle, √3/2 = 0.87, closed by its first corner.
    corners = size * np.array([[0, 1], [-0.87, -0.5], [0.87, -0.5], [0, 1]])
    for station in stations:
        x, y = (station + corners).T
        lines.append(Curve("station", x, y, kind="station"))
    unit = clean(adjustment.network.object_unit)
    layout = ChartLayout(height=380)
    drawing = draw_plan(lines, f"X [{unit}]", f"Y [{unit}]", layout=layout)
    return figure(drawing, "The network in plan: stations, and points with their error ellipses")


def _ellipse_root(C: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    w, E = np.linalg.eigh(C)
    return E * np.sqrt(np.clip(w, 0, None))


# --- results and budgets --------------------------------------------------------------------


def _results(certificate: "Certificate") -> Iterator[Section]:
    parts, number = [], 0
    if certificate.rig is not None:
        parts.append(
            paragraph(
                "Every camera by its separate calibration; by the common adjustment of the rig "
                "they are under Mountings."
            )
        )
    for part in certificate.parts:
        parts += [f"<h3>{text(part.name)}</h3>\n"] if part.name else []
        if part.budget is None:
            parts.append(paragraph(part.no_budget))
            continue
        number += 1
        parts.append(grid(RESULT_HEADER, part.budget.result_rows()))
    if number:
        coverage = 100 * certificate.details.coverage
        parts.append(
            paragraph(
                "U is the expanded uncertainty: the standard uncertainty u multiplied by the "
                f"coverage factor k of Student's distribution with ν_eff degrees of freedom, for a "
                f"coverage probability of {coverage:.4g} % (JCGM 100:2008, Annex G)."
            )
        )
        budgeted = (part.adjustment for part in certificate.parts if part.budget is not None)
        if any(part.adjustment.error_model is not None for part in certificate.parts):
            parts.append(
                paragraph(
                    "The sizes of shared errors are estimates. That makes σ in the report larger; "
                    "here it is in ν_eff and k, and not in u."
                )
            )
        if any(adjustment.assumes_independence for adjustment in budgeted):
            parts.append(paragraph(f"Standard uncertainties are {INDEPENDENCE}."))
        parts.append(_correlations(certificate))
    yield Section("results", "Results with expanded uncertainty", "".join(parts), "Results")


def _correlations(certificate: "Certificate") -> str:
    parts = []
    for part in certificate.parts:
        for camera, entry in part.adjustment.cameras.items():
            if len(entry["free"]) < 2:  # noqa: PLR2004 - one has none
                continue
            C = entry.get("correlations_correlated", entry["correlations"])
            title = f"Correlations of camera {camera} in %"
            parts += [f"<h3>{text(title)}</h3>\n", show_correlations(entry["free"], C)]
    return "".join(parts)


def _rig(certificate: "Certificate") -> Iterator[Section]:
    rig: RigCalibration | None = certificate.rig
    if rig is None:
        return
    unit, parts = clean(rig.object_unit), []
    parts.append(
        paragraph(
            f"Common adjustment: σ0 {rig.sigma0:.4f}, redundancy {rig.redundancy}, "
            f"{count(len(rig.epochs), 'epoch')}. σ are standard uncertainties (k = 1). Results and "
            "budgets are of the separate calibration of every camera."
        )
    )
    rows = [(name, *row) for name in rig.stated_sigma for row in rig_parameter_rows(rig, name)]
    parts += [
        "<h3>Cameras by the common adjustment</h3>\n",
        grid(("camera", "parameter", "value", "σ"), rows),
    ]
    for title, m in mounting_titles(rig).items():
        parts += [
            f"<h3>{text(title)}</h3>\n",
            grid(("", "value", "σ", "unit"), mounting_rows(m, unit)),
            grid(("", *MOUNTED), correlation_rows(m)),
        ]
    yield Section("mountings", f"Mountings, reference {rig.names[0]}", "".join(parts), "Mountings")


def _budgets(certificate: "Certificate") -> Iterator[Section]:
    parts, remaining = [], MOST_BUDGETS
    for part in certificate.parts:
        if part.budget is None:
            continue
        for m, measurand in enumerate(part.budget.measurands):
            remaining -= 1
            if remaining < 0:
                continue
            where = f", {part.name}" if part.name else ""
            row = part.budget.result_rows()[m]
            parts += [
                f"<h3>{text(measurand.words + where)}</h3>\n",
                grid(BUDGET_HEADER, part.budget.rows(m), "budget"),
                paragraph(
                    f"u = {row[4]}, ν_eff = {row[6]}, k = {row[5]}, "
                    f"U = {f'{row[2]} {measurand.unit}'.strip()}; σ of "
                    f"the adjustment {significant(float(part.budget.sigma[m]))}."
                ),
            ]
    if not parts:
        return
    if remaining < 0:
        parts.append(paragraph(f"… and the budgets of {-remaining} more results."))
    parts.append(
        paragraph(
            "c: derivative of the result with respect to the input, through the whole adjustment; "
            "of several inputs √Σc². Type A: evaluated from the residuals; type B: stated (JCGM "
            "100:2008, 4.2 and 4.3). Image coordinates share one estimate of their σ and are one "
            "term of ν_eff. The list of all single inputs: uncertainty_budget of the library."
        )
    )
    yield Section("budget", "Uncertainty budget", "".join(parts), "Uncertainty budget")


# --- tests ----------------------------------------------------------------------------------


def _acceptance(certificate: "Certificate") -> Iterator[Section]:
    if certificate.acceptance is None:
        return
    yield acceptance_section(certificate.acceptance)


def acceptance_section(acceptance: "Acceptance") -> Section:
    """The criteria, with what was found."""
    content = grid(ACCEPTANCE_HEADER, acceptance.text_rows(), "words")
    return Section("acceptance", "Acceptance criteria", content, "Acceptance")


def _lengths(certificate: "Certificate") -> Iterator[Section]:
    if certificate.lengths is not None:
        yield lengths_section(certificate.lengths)


def lengths_section(test: "LengthTest") -> Section:
    """The errors of calibrated lengths, with verdict and arrangement."""
    unit = clean(test.unit)
    rule = (
        "ISO 14253-1 (2017): an error conforms if |E| ≤ MPE − g, and does not if |E| > MPE + g, "
        "g = 1.645·u of the calibrated length"
        if test.rule == length_tests.RULES[0]
        else "simple acceptance: an error conforms if |E| ≤ MPE"
    )
    rows = [
        ("Largest |E|", readable_length(test.largest, unit)),
        ("RMS of E", readable_length(test.rms, unit)),
        ("Maximum permissible error", _mpe_in_words(test)),
        ("Decision rule", rule),
        ("Verdict", test.verdict or "none: no maximum permissible error is stated"),
    ]
    requirements = [
        (about, wanted, met_by, "met" if is_met else "not met")
        for about, wanted, met_by, is_met in test.requirements()
    ]
    parts = [
        _draw_errors(test),
        facts(rows),
        "<h3>Arrangement</h3>\n",
        grid(("VDI/VDE 2634-1", "wanted", "found", ""), requirements, "words"),
        f"<h3>Lengths in {text(unit)}</h3>\n",
        grid(length_tests.HEADER, test.rows(), "remarks"),
    ]
    if test.missing:
        ends = [" – ".join(ends_of_length) for ends_of_length in test.missing]
        parts += ["<h3>Not measured</h3>\n", items(ends)]
    if test.between_control:
        ends = [" – ".join(ends_of_length) for ends_of_length in test.between_control]
        parts += ["<h3>Not tested: both ends are control points</h3>\n", items(ends)]
    title = "Length measurement errors (VDI/VDE 2634-1)"
    return Section("lengths", title, "".join(parts), "Length errors")


def _mpe_in_words(test: "LengthTest") -> str:
    if test.mpe is None:
        return "not stated"
    return test.mpe.text or f"{significant(test.mpe.constant)} {clean(test.unit)}"


def _draw_errors(test: "LengthTest") -> str:
    """E over the length, with ±MPE."""
    order = np.argsort(test.lengths.value, kind="stable")
    x = test.lengths.value[order]
    size = 0.006 * (float(np.ptp(x)) or float(x[0]))
    u = 2 * test.lengths.sigma[order]
    curves = []
    for length, error, half_width in zip(x, test.error[order], u):
        ends = np.array([length - size, length + size])
        curves.append(Curve("E", ends, np.full(2, error)))
        if half_width > 0:
            upright = np.array([error - half_width, error + half_width])
            curves.append(Curve("± 2u of the calibration", np.full(2, length), upright))
    if test.mpe is not None:
        lengths_drawn = np.linspace(0.0, float(x[-1]), 60)
        limit = test.mpe(lengths_drawn)
        curves += [
            Curve("± MPE", lengths_drawn, sign * limit, kind="second") for sign in (1.0, -1.0)
        ]
    unit = clean(test.unit)
    drawing = draw_curves(curves, f"calibrated length [{unit}]", f"E [{unit}]")
    return figure(drawing, "Length measurement errors E = measured − calibrated, bars ± 2u")


def _accuracy(certificate: "Certificate") -> Iterator[Section]:
    for part in certificate.parts:
        if (accuracy := part.accuracy) is not None:
            parts = [
                grid(SUMMARY_HEADER, accuracy.summary()),
                items(accuracy.statements()),
                *([items(accuracy.remarks())] if accuracy.remarks() else []),
                f"<h3>Check points: product − check point, in {text(accuracy.unit)}</h3>\n",
                grid_of_first(positional.HEADER, accuracy.rows(), MOST_ROWS),
                paragraph(f"Standard: {positional.STANDARD}."),
            ]
        elif part.no_accuracy:
            parts = [paragraph(part.no_accuracy)]
        else:
            continue
        where = f", {part.name}" if part.name else ""
        link = "Positional accuracy" if part is certificate.parts[0] else ""
        title = f"Positional accuracy{where}"
        yield Section("accuracy" + part.name.replace(" ", "-"), title, "".join(parts), link)


# --- tables of surveys ----------------------------------------------------------------------


def _survey(certificate: "Certificate") -> Iterator[Section]:
    """σ0 and its test, control with residuals and predictions, per adjustment."""
    for number, part in enumerate(certificate.parts):
        adjustment = part.adjustment
        parts = [
            facts(head.variance_facts(adjustment)),
            "<h3>Counts</h3>\n",
            grid(("", "", ""), head.count_rows(adjustment), "words"),
            *_control(adjustment),
        ]
        where = f", {part.name}" if part.name else ""
        id = f"adjustment-{number}" if number else "adjustment"
        link = "Adjustment" if number == 0 else ""
        yield Section(id, f"Adjustment and control{where}", "".join(parts), link)


def _control(adjustment: "Adjustment") -> Iterator[str]:
    unit = clean(adjustment.network.object_unit)
    if rows := control_rows(adjustment):
        yield f"<h3>Control points: adjusted − given, in {text(unit)}</h3>\n"
        yield grid_of_first(CONTROL_HEADER, rows, MOST_ROWS)
    if number := int(adjustment.problem.network.points.has_role("fixed").sum()):
        yield paragraph(f"{count(number, 'point')} held at given coordinates, without σ.")
    points = adjustment.table("control")
    if points:
        predicted = observations.predicted_rows(points, ("id",), "XYZ")
        yield f"<h3>Control predicted from all other observations, in {text(unit)}</h3>\n"
        yield paragraph(observations.PREDICTION_LEGEND)
        yield grid_of_first(observations.CONTROL_HEADER, predicted, MOST_ROWS)


CONTROL_HEADER = ("point", "X", "Y", "Z", "vX", "vY", "vZ", "σX", "σY", "σZ")


def control_rows(adjustment: "Adjustment") -> list[tuple[str, ...]]:
    """Control points: adjusted coordinates, adjusted − given, and the given σ."""
    points = adjustment.problem.network.points
    control_points = np.flatnonzero(points.has_role("control"))
    if not len(control_points):
        return []
    given_coordinates, sigma = points.position[control_points], points.sigma[control_points]
    adjusted = adjustment.point_values[control_points]
    v = np.where(np.isposinf(sigma), np.nan, adjusted - given_coordinates)
    places = column_decimals(np.concatenate([sigma.ravel(), adjustment.points["sX"]]))
    cell = lambda x: fixed(float(x), places)
    sigma_text = lambda s: "free" if np.isposinf(s) else "held" if not s > 0 else cell(s)
    return [
        (points.id[row], *map(cell, (*a, *d)), *map(sigma_text, s))
        for row, a, d, s in zip(control_points, adjusted, v, sigma)
    ]


# --- statements -----------------------------------------------------------------------------


def _statements(certificate: "Certificate") -> Section:
    """Method, and what the certificate does not say."""
    lines = [
        "Evaluation: least-squares adjustment of all observations together; unknowns, their "
        "covariances and the sensitivity coefficients are those of this adjustment.",
        "The results are those of the object as it was when it was measured. Changes after it "
        "(refocusing, transport, temperature) are not part of the uncertainties, unless they are "
        "inputs of the budget.",
        "Values are stated with two significant digits of their expanded uncertainty (JCGM "
        "100:2008, 7.2.6).",
    ]
    if certificate.lengths is not None:
        lines.append(
            "Calibrated lengths have no part in the adjustment. Their values are those of the "
            "reference temperature that their calibration states."
        )
    name = certificate.details.fields.get("approved_by", "")
    signatures = (
        '<div class="signatures"><div>Place and date</div><div>Signature'
        f"{text(f', {name}' if name else '')}</div></div>\n"
    )
    return Section("statements", "Statements", items(lines) + signatures, "Statements")
