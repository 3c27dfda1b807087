"""The sections of the page, in their order; words and numbers are those of the protocol."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.plotting.cameras import curve_reach
from jaxbundle.plotting.distortion import distortion_profile
from jaxbundle.plotting.style import micrometres
from jaxbundle.report import head
from jaxbundle.report.equations import equations
from jaxbundle.report.layout import fixed, significant
from jaxbundle.report.observations import count_by_class
from jaxbundle.report.page.charts import Curve, draw_curves, draw_histogram
from jaxbundle.report.page.markup import facts, figure, grid, items, paragraph, section, text
from jaxbundle.report.page.origin import Origin, software_versions
from jaxbundle.report.page.tables import MOST_ROWS
from jaxbundle.report.page.verdict import in_words, judge
from jaxbundle.report.summary import summary
from jaxbundle.report.unknowns import validity

NO_SCRIPT = "<noscript><p>The tables need JavaScript; --out has them as CSV files.</p></noscript>\n"
MOST_CAMERAS = 20
"""Distortion and correlations are drawn of so many cameras."""
TABLES = {
    "cameras": ("Cameras", "cameras.csv"),
    "images": ("Images", "images.csv"),
    "points": ("Points", "points.csv"),
    "far_points": ("Points at any distance", "far_points.csv"),
    "checks": ("Check points", "checks.csv"),
    "observations": ("Observations", "residuals.csv"),
    "blunders": ("Blunders", "result.json"),
}
"""By table its heading, and the file of --out that has all of its rows."""


def result(adjustment) -> Iterator[str]:
    """All sections of a solved adjustment but those of where it comes from."""
    yield overview(adjustment)
    yield contents()
    yield network()
    yield photographs()
    yield from cameras(adjustment)
    yield residuals(adjustment)
    yield convergence(adjustment)
    yield from tables(adjustment)


def overview(adjustment) -> str:
    """The verdict, the warnings, the findings, and the numbers of the whole."""
    findings, warnings = judge(adjustment), adjustment.warnings
    state, words = in_words(findings, len(warnings))
    parts = [paragraph(words, f"verdict {state.replace(' ', '-')}")]
    if warnings:
        parts.append(f"<h3>Warnings</h3>\n{items(warnings)}")
    rows = [(f.about, f.state, f.words) for f in findings]
    parts += ["<h3>Tests</h3>\n", grid(("test", "", "what was found"), rows, "words")]
    parts += ["<h3>Result</h3>\n", facts(row for row in summary(adjustment) if row[0] != "Note")]
    parts += ["<h3>Variance factor</h3>\n", facts(head.variance_facts(adjustment))]
    parts += ["<h3>Counts</h3>\n", grid(("", "", ""), head.count_rows(adjustment), "words")]
    parts.append(paragraph(
        "Standard deviations are a posteriori, σ0 times those of the a priori weights, unless they "
        "are said to be a priori."
    ))  # fmt: skip
    return section("overview", "Verdict", *parts)


def contents() -> str:
    """Links to the sections."""
    names = {"network": "Network", "photographs": "Photographs", "distortion": "Distortion",
             "residuals": "Residuals", "convergence": "Convergence", "table-images": "Tables",
             "origin": "Settings and origin"}  # fmt: skip
    links = "".join(f'<a href="#{id}">{text(name)}</a>\n' for id, name in names.items())
    return f"<nav>{links}</nav>\n"


def network() -> str:
    """The place of the network to be turned."""
    return section(
        "network", "Network",
        paragraph("Parallel projection. Drag to turn, with Shift to move, wheel to zoom; click a "
                  "point or a station for its standard deviations, a station also for its rays.",
                  "hint"),
        '<div class="tools" id="network-tools"></div>\n',
        '<canvas id="network-canvas" width="1200" height="800"></canvas>\n',
        '<p class="legend" id="network-legend"></p>\n',
        '<p id="network-said" aria-live="polite"></p>\n',
        breaks=True,
    )  # fmt: skip


def photographs() -> str:
    """The place of the residuals of an image."""
    return section(
        "photographs", "Photographs: residuals and redundancy",
        '<div class="tools" id="photograph-tools"></div>\n',
        '<canvas id="photograph-canvas" width="1200" height="900"></canvas>\n',
        paragraph("Residuals v = computed − observed, lines from the measured places; thick where "
                  "|τ| > 3. The area of a mark is the redundancy number r, mean of both "
                  "coordinates; a cross where r < 0.1: hardly controlled."),
        '<p id="photograph-said" aria-live="polite"></p>\n',
        breaks=True,
    )  # fmt: skip


def cameras(adjustment) -> Iterator[str]:
    """Equations, distortion and correlations of the cameras."""
    chosen = list(adjustment.cameras)[:MOST_CAMERAS]
    for number, camera in enumerate(chosen):
        entry = adjustment.cameras[camera]
        model = get_model(entry["model"])
        parts = [items(equations(model)), _distortion(adjustment, camera)]
        parts.append(paragraph(validity(adjustment, camera)))
        if len(entry["free"]) > 1:
            parts += ["<h3>Correlations in %</h3>\n", _correlations(entry)]
        id = "distortion" if number == 0 else f"distortion-{number}"
        yield section(id, f"Camera {camera}: {entry['model']}", *parts, breaks=True)
    if len(adjustment.cameras) > len(chosen):
        yield paragraph(f"{len(adjustment.cameras) - len(chosen)} other cameras are in the table.")


def _distortion(adjustment, camera: str) -> str:
    measured, reach = curve_reach(adjustment, camera)
    if not reach > 0:
        return ""
    found = distortion_profile(adjustment, camera, reach=reach)
    scale, unit = micrometres(found.unit)
    curves = [Curve("symmetric radial, band ±σ", found.radius, scale * found.radial,
                    scale * found.radial_sigma)]  # fmt: skip
    if np.nan_to_num(found.decentring).any() or np.nan_to_num(found.decentring_sigma).any():
        curves.append(Curve("decentring, band ±σ", found.radius, scale * found.decentring,
                            scale * found.decentring_sigma, "second"))  # fmt: skip
    mark = (measured, "farthest measurement") if measured < reach else None
    drawing = draw_curves(
        curves, f"distance from the principal point [{found.unit}]",
        f"measured − ideal [{unit}]", mark=mark,
    )  # fmt: skip
    return figure(drawing, f"Distortion of camera {camera}, σ a posteriori")


def _correlations(entry) -> str:
    names, C = entry["free"], 100 * entry["correlations"]
    rows = [
        (name, *(fixed(C[i, j], 0) for j in range(i + 1)), *[""] * (len(names) - i - 1))
        for i, name in enumerate(names)
    ]
    strong = [
        f"{names[i]} and {names[j]} {fixed(C[i, j], 1)} %"
        for i in range(len(names)) for j in range(i)
        if abs(C[i, j]) > 90
    ]  # fmt: skip
    note = f"Over 90 %: {', '.join(strong)}." if strong else "None is over 90 %."
    return grid(("", *names), rows, "matrix") + paragraph(note)


def residuals(adjustment) -> str:
    """The histogram of the normalised residuals, and the variance components."""
    edges, counted, expected = count_by_class(adjustment.residuals["tau"])
    components = [
        (name, c.observations, fixed(c.redundancy, 2), significant(c.vtpv, 5),
         significant(c.sigma, 4))
        for name, c in adjustment.variance_components.items()
    ]  # fmt: skip
    header = ("group", "observations", "Σr", "vᵀPv", "σ̂/σ given")
    return section(
        "residuals", "Normalised residuals",
        figure(draw_histogram(edges, counted, expected),
               f"Normalised residuals of {counted.sum()} controlled observations; outer classes "
               "are open"),
        "<h3>Variance components</h3>\n", grid(header, components),
        breaks=True,
    )  # fmt: skip


def convergence(adjustment) -> str:
    """vᵀPv of the steps."""
    vtpv, damping, accepted = head.evaluations(adjustment)
    there = np.isfinite(vtpv) & (vtpv > 0)
    step = np.arange(len(vtpv))
    drawing = ""
    if there.sum() > 1:
        curve = Curve("vᵀPv", step[there], np.log10(vtpv[there]))
        drawing = figure(draw_curves([curve], "iteration", "vᵀPv", logarithmic=True),
                         f"{head.result_in_words(adjustment)}: {adjustment.termination}")
    rows = [
        (i or "start", f"{vtpv[i]:.8e}" if np.isfinite(vtpv[i]) else "not finite",
         f"{damping[i]:.1e}" if i else "", ("accepted" if accepted[i] else "rejected") if i else "")
        for i in step
    ]  # fmt: skip
    return section("convergence", "Convergence", drawing,
                   grid(("iteration", "vᵀPv", "λ (damping)", "step"), rows))  # fmt: skip


def tables(adjustment) -> Iterator[str]:
    """The places of the tables, which the script fills."""
    yield paragraph("Click a header to sort, again to turn the order; type to search.",
                    "hint")  # fmt: skip
    yield NO_SCRIPT
    total = len(adjustment.residuals["tau"])
    for id, (title, file) in TABLES.items():
        note = ""
        if id == "observations" and total > MOST_ROWS:
            note = paragraph(f"The {MOST_ROWS} with the largest |τ| of {total}, here and in the "
                             f"photographs; all are in {file}.")  # fmt: skip
        place = f'<div class="table" data-table="{id}" data-file="{file}"></div>\n'
        yield section(f"table-{id}", title, note, place)


def failure(rows: Iterable[tuple[str, str]], warnings: Sequence[str]) -> str:
    """The verdict where there is no result, and what to do."""
    parts = [paragraph(head.NO_RESULT, "verdict not-met")]
    if warnings:
        parts.append(f"<h3>Warnings</h3>\n{items(warnings)}")
    return section("overview", "Verdict", *parts, facts(rows))


def describe_origin(chosen: Iterable[tuple[str, object]], origin: Origin) -> str:
    """Settings, fingerprints of the files read, versions of the software."""
    parts = [facts([*chosen, *origin.settings.items()])]
    if origin.inputs:
        rows = [(file.name, file.size, file.sha256) for file in origin.inputs]
        parts += ["<h3>Input files</h3>\n", grid(("file", "bytes", "SHA-256"), rows, "words")]
    parts += ["<h3>Software</h3>\n", facts(software_versions())]
    return section("origin", "Settings and origin", *parts, breaks=True)
