"""The sections of an adjustment, in order; words and numbers are those of the report."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.plotting.cameras import curve_reach
from jaxbundle.plotting.distortion import distortion_profile
from jaxbundle.plotting.style import micrometres
from jaxbundle.report import correlated, head, observations
from jaxbundle.report.camera_equations import camera_equations
from jaxbundle.report.layout import clean, fixed, significant
from jaxbundle.report.observations import count_by_class
from jaxbundle.report.page.charts import Curve, draw_curves, draw_histogram
from jaxbundle.report.page.document import Section
from jaxbundle.report.page.markup import facts, figure, grid, grid_of_first, items, paragraph, text
from jaxbundle.report.unknowns import validity

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


def collect(adjustment: "Adjustment") -> Iterator[Section]:
    """All sections of a solved adjustment between its verdict and its tables."""
    # A picture soon after the verdict, numbers behind it.
    yield network()
    yield variance_factor(adjustment)
    yield photographs()
    yield from cameras(adjustment)
    yield residuals(adjustment)
    yield from predicted_control(adjustment)
    yield from correlated_errors(adjustment)
    yield convergence(adjustment)


def network() -> Section:
    """The placeholder of the rotatable network."""
    parts = [
        paragraph(
            "Parallel projection. Drag to rotate, with Shift to move, wheel to zoom; click a "
            "point or a station for its standard deviations, a station also for its rays.",
            "hint",
        ),
        '<div class="tools" id="network-tools"></div>\n',
        '<canvas id="network-canvas" width="1200" height="800"></canvas>\n',
        '<p class="legend" id="network-legend"></p>\n',
        '<p id="network-said" aria-live="polite"></p>\n',
    ]
    return Section("network", "Network", "".join(parts), "Network")


def variance_factor(adjustment: "Adjustment") -> Section:
    """Variance factor and counts."""
    parts = [
        facts(head.variance_facts(adjustment)),
        "<h3>Counts</h3>\n",
        grid(("", "", ""), head.count_rows(adjustment), "words"),
    ]
    return Section("variance", "Variance factor", "".join(parts), "Variance factor")


def photographs(test: str = "τ") -> Section:
    """The placeholder of the residuals of an image; `test`: the symbol of their test values."""
    parts = [
        '<div class="tools" id="photograph-tools"></div>\n',
        '<canvas id="photograph-canvas" width="1200" height="900"></canvas>\n',
        paragraph(
            "Residuals v = computed − observed, lines from the measured positions; thick if "
            f"|{test}| > 3. The area of a mark is the redundancy number r, mean of both "
            "coordinates; a cross means r < 0.1: hardly controlled."
        ),
        '<p id="photograph-said" aria-live="polite"></p>\n',
    ]
    title = "Photographs: residuals and redundancy"
    return Section("photographs", title, "".join(parts), "Photographs")


def cameras(adjustment: "Adjustment", max_cameras: int = 20) -> Iterator[Section]:
    """Equations, distortion and correlations of the cameras; of more than `max_cameras` the first,
    since each has a drawing: the table has all."""
    listed = list(adjustment.cameras)[:max_cameras]
    for number, camera in enumerate(listed):
        entry = adjustment.cameras[camera]
        model = get_model(entry["model"])
        parts = [items(camera_equations(model)), _distortion(adjustment, camera)]
        parts.append(paragraph(validity(adjustment, camera)))
        if len(entry["free"]) > 1:
            parts += [
                "<h3>Correlations in %</h3>\n",
                show_correlations(
                    entry["free"], entry.get("correlations_correlated", entry["correlations"])
                ),
            ]
        number_of_others = len(adjustment.cameras) - len(listed)
        if number_of_others and number == len(listed) - 1:
            parts.append(paragraph(f"{number_of_others} other cameras are in the table."))
        id, link = ("distortion", "Distortion") if number == 0 else (f"distortion-{number}", "")
        yield Section(id, f"Camera {camera}: {entry['model']}", "".join(parts), link)


def _distortion(adjustment: "Adjustment", camera: str) -> str:
    measured, reach = curve_reach(adjustment, camera)
    if not reach > 0:
        return ""
    profile = distortion_profile(adjustment, camera, reach=reach)
    scale, unit = micrometres(profile.unit)
    curves = [
        Curve(
            "symmetric radial, band ±σ",
            profile.radius,
            scale * profile.radial,
            scale * profile.radial_sigma,
        )
    ]
    if np.nan_to_num(profile.decentring).any() or np.nan_to_num(profile.decentring_sigma).any():
        curves.append(
            Curve(
                "decentring, band ±σ",
                profile.radius,
                scale * profile.decentring,
                scale * profile.decentring_sigma,
                "second",
            )
        )
    mark = (measured, "farthest measurement") if measured < reach else None
    drawing = draw_curves(
        curves,
        f"distance from the principal point [{profile.unit}]",
        f"measured − ideal [{unit}]",
        mark=mark,
    )
    return figure(drawing, f"Distortion of camera {camera}, σ a posteriori")


def show_correlations(
    names: Sequence[str], correlations: np.ndarray, short: Sequence[object] = ()
) -> str:
    """The lower triangle of a correlation matrix in %, and a list of those over 90 %; `short`:
    names for the matrix, such as numbers."""
    C, short = 100 * np.asarray(correlations), short or names
    rows = [
        (name, *(fixed(C[i, j], 0) for j in range(i + 1)), *[""] * (len(names) - i - 1))
        for i, name in enumerate(short)
    ]
    strong = [
        f"{names[i]} and {names[j]} {fixed(C[i, j], 1)} %"
        for i in range(len(names))
        for j in range(i)
        if abs(C[i, j]) > 90
    ]
    note = f"Over 90 %: {', '.join(strong)}." if strong else "None is over 90 %."
    return grid(("", *short), rows, "matrix") + paragraph(note)


def residuals(adjustment: "Adjustment") -> Section:
    """The histogram of the normalised residuals, and the variance components."""
    components = [
        (
            name,
            c.observations,
            fixed(c.redundancy, 2),
            significant(c.vtpv, 5),
            significant(c.sigma, 4),
            head.span(c.estimated, 3),
            c.unit,
        )
        for name, c in adjustment.variance_components.items()
    ]
    header = ("group", "observations", "Σr", "vᵀPv", "σ̂/σ given", "σ̂", "unit")
    components_part = "<h3>Variance components</h3>\n" + grid(header, components, "remarks")
    return show_residuals(adjustment.residuals["tau"], further_content=components_part)


def show_residuals(
    test: np.ndarray, symbol: str = "τ = w/σ0", further_content: str = ""
) -> Section:
    """The histogram of test values, with the normal distribution."""
    edges, counted, expected = count_by_class(test)
    drawing = figure(
        draw_histogram(edges, counted, f"normalised residual {symbol}", "observations", expected),
        f"Normalised residuals of {counted.sum()} controlled observations; outer classes are open",
    )
    return Section("residuals", "Normalised residuals", drawing + further_content, "Residuals")


def predicted_control(adjustment: "Adjustment") -> Iterator[Section]:
    """Control points and their image measurements as all other observations predict them."""
    points, rays = (adjustment.table(name) for name in ("control", "control_measurements"))
    if not points:
        return
    rows, most = observations.predicted_rows(points, ("id",), "XYZ"), observations.ROWS_OF_PAGE
    parts = [
        paragraph(observations.PREDICTION_LEGEND),
        grid_of_first(observations.CONTROL_HEADER, rows, most, all_are="in the JSON"),
    ]
    if rays:
        listed = observations.predicted_rows(rays, ("image", "point"), "xy")
        parts += [
            f"<h3>Image measurements of control, in {text(adjustment.image_unit)}</h3>\n",
            grid_of_first(observations.MEASUREMENT_HEADER, listed, most, all_are="in the JSON"),
        ]
    unit = clean(adjustment.network.object_unit)
    title = f"Control predicted from all other observations, in {unit}"
    yield Section("predicted", title, "".join(parts), "Predicted control")


def correlated_errors(adjustment: "Adjustment") -> Iterator[Section]:
    """Components of errors that image points share, σ under them, and the replication; nothing if
    they were not requested."""
    if why := adjustment.why_no_error_model:
        parts = [paragraph(f"Not looked for: {why}.")]
    elif adjustment.error_model is not None:
        parts = [
            grid(correlated.COMPONENT_HEADER, correlated.component_rows(adjustment)),
            *(paragraph(remark) for remark in correlated.remarks(adjustment)),
            paragraph(correlated.LEGEND),
        ]
        if words := correlated.not_looked_for(adjustment.error_model):
            parts.append(paragraph(words))
        parts += [
            "<h3>Standard deviations</h3>\n",
            grid(correlated.SIGMA_HEADER, correlated.sigma_rows(adjustment)),
        ]
    else:
        parts = []
    if (halves := adjustment.replication) is not None:
        parts += ["<h3>Replication</h3>\n", paragraph(f"{halves.sentence}.")]
        for split in halves.splits:
            parts.append(grid(correlated.DIFFERENCE_HEADER, correlated.difference_rows(split)))
        parts.append(paragraph(correlated.REPLICATION_LEGEND))
    if parts:
        yield Section("correlated", correlated.TITLE, "".join(parts), "Correlated errors")


def convergence(adjustment: "Adjustment") -> Section:
    """vᵀPv of the steps."""
    vtpv, damping, is_accepted = head.evaluations(adjustment)
    is_positive = np.isfinite(vtpv) & (vtpv > 0)
    step = np.arange(len(vtpv))
    drawing = ""
    # A smaller fall than 1e-5 cannot be seen in the six digits of the table either.
    if is_positive.sum() > 1 and vtpv[is_positive].max() > (1 + 1e-5) * vtpv[is_positive].min():
        curve = Curve("vᵀPv", step[is_positive], np.log10(vtpv[is_positive]))
        drawing = figure(
            draw_curves([curve], "iteration", "vᵀPv", logarithmic="y"),
            f"{head.result_in_words(adjustment)}: {adjustment.termination}",
        )
    rows = [
        (
            i or "start",
            f"{vtpv[i]:.5e}" if np.isfinite(vtpv[i]) else "not finite",
            f"{damping[i]:.1e}" if i else "",
            ("accepted" if is_accepted[i] else "rejected") if i else "",
        )
        for i in step
    ]
    table = grid(("iteration", "vᵀPv", "λ (damping)", "step"), rows)
    return Section("convergence", "Convergence", drawing + table, "Convergence")
