"""The pages of a calibration: of one camera, of several, of a rig."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.calibration.quality import Coverage, UncertaintyMap
from jaxbundle.calibration.report import (
    MAPS_HEADER,
    MODELS_HEADER,
    map_rows,
    model_rows,
    models_legend,
    photograph_facts,
)
from jaxbundle.calibration.rig.report import (
    MOUNTED,
    correlation_rows,
    mounting_rows,
    mounting_titles,
    rig_facts,
    rig_parameter_rows,
)
from jaxbundle.calibration.verdict import (
    NOT_FOR_BOARDS,
    conclude_calibrations,
    coverage_in_words,
    cross_validation_in_words,
)
from jaxbundle.calibration.verdict import find as find_own
from jaxbundle.measure.views import BoardViews
from jaxbundle.report.layout import clean
from jaxbundle.report.page import (
    UNKNOWN,
    Addition,
    Listing,
    Origin,
    Page,
    Section,
    compose,
    give_verdict,
    write,
)
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.report.page.charts import Curve, draw_curves, draw_field
from jaxbundle.report.page.columns import Column, estimates, numbers
from jaxbundle.report.page.markup import facts, figure, grid, paragraph, text
from jaxbundle.report.page.overview import list_messages
from jaxbundle.report.page.sections import show_residuals
from jaxbundle.report.page.tables import table_of_residuals

if TYPE_CHECKING:
    from jaxbundle.calibration.model_choice import ModelComparison
    from jaxbundle.calibration.result import Calibration
    from jaxbundle.calibration.rig.result import RigCalibration
    from jaxbundle.calibration.several import Calibrations

KIND = "calibration of cameras"


def compose_calibrations(
    calibrations: "Calibrations",
    origin: Origin = UNKNOWN,
    choice: "ModelComparison | None" = None,
    also: Addition = NO_ADDITION,
) -> Iterator[str]:
    """The page of one calibration, or the common page of several, with the rig.

    **Arguments:** `calibrations`: `Calibrations`; `choice`: the underlying comparison of models;
    `also`: further findings and sections."""
    if len(calibrations.cameras) == 1 and calibrations.rig is None:
        return compose_calibration(next(iter(calibrations.cameras.values())), origin, choice, also)
    return write(_describe_several(calibrations, origin, also))


def compose_calibration(
    calibration: "Calibration",
    origin: Origin = UNKNOWN,
    choice: "ModelComparison | None" = None,
    also: Addition = NO_ADDITION,
) -> Iterator[str]:
    """The page of one camera: that of its adjustment, and its accuracy; `also`: further findings
    and sections."""
    addition_of_camera = _describe_one(calibration, choice).followed_by(also)
    return compose(calibration.adjustment, origin, also=addition_of_camera)


def _describe_one(calibration: "Calibration", choice: "ModelComparison | None" = None) -> Addition:
    views, sections = calibration.views, []
    rows = list(photograph_facts(views))
    if calibration.converged:
        rows.append(("RMS of an image point", f"{calibration.rms:.4f} px"))
    overview = f"<h3>Photographs</h3>\n{facts(rows)}"
    if choice is not None:
        sections.append(_models(choice))
    if not calibration.converged:
        return Addition("", overview=overview, sections=(*sections, *_list_failed(views)))
    sections += [
        _quality(calibration.coverage, calibration.reported_maps, _unit(calibration)),
        _validation(calibration),
        *_list_failed(views),
    ]
    overview += list_messages("Advice", calibration.suggestions)
    return Addition(
        "",
        tuple(find_own(calibration)),
        NOT_FOR_BOARDS,
        tuple(calibration.shortcomings),
        overview,
        tuple(sections),
    )


def _unit(calibration: "Calibration") -> str:
    return clean(calibration.adjustment.network.object_unit)


def _quality(
    covered: Coverage, maps: Sequence[UncertaintyMap], unit: str, name: str = "", number: int = 0
) -> Section:
    """Coverage, and the uncertainty of a projected point over the image."""
    # Cells without points stay white.
    counts = np.where(covered.counts > 0, covered.counts, np.nan)
    caption = f"Measured points by cell: {coverage_in_words(covered)}"
    parts = [figure(draw_field(counts, 0), caption)]
    parts += [
        "<h3>Uncertainty of a projected point (σ, pixels)</h3>\n",
        grid(MAPS_HEADER, map_rows(maps, unit)),
    ]
    parts.append('<div class="maps">\n')
    for uncertainty, (frame, *_) in zip(maps, map_rows(maps, unit)):
        caption = f"σ over the image from corner to corner, pixels; point held in {frame}"
        parts.append(figure(draw_field(uncertainty.sigma), caption))
    parts.append("</div>\n")
    title = f"Quality of camera {name}" if name else "Quality"
    link = "Quality" if number == 0 else ""
    return Section(f"quality-{number}" if number else "quality", title, "".join(parts), link)


def _validation(calibration: "Calibration") -> Section:
    """σ against distance, and the two halves of the photographs."""
    distances, middle, corners, reported = calibration.uncertainty_curves()
    # σ is 0 everywhere if the measurements fit exactly, and no number without a ray
    curve_data = [
        (name, np.log10(distances[s > 0]), np.log10(s[s > 0]), kind)
        for name, s, kind in (
            ("middle of the image", middle, "first"),
            ("worst corner", corners, "second"),
        )
    ]
    curves = [Curve(name, x, y, kind=kind) for name, x, y, kind in curve_data if len(x)]
    unit = _unit(calibration)
    if curves:
        drawing = draw_curves(
            curves,
            f"distance [{unit}]",
            "σ of a projected point [px]",
            "xy",
            (float(np.log10(reported[0, 0])), "median distance of the board"),
        )
        content = figure(drawing, "Uncertainty against the distance of the point, in the scene")
    else:
        content = paragraph("The measurements fit exactly: σ of a projected point is 0.")
    parts = [content, "<h3>Cross-validation</h3>\n"]
    parts += [
        paragraph(words[:1].upper() + words[1:]) for words in cross_validation_in_words(calibration)
    ]
    return Section("validation", "Distance and cross-validation", "".join(parts), "Validation")


def _list_failed(views: BoardViews) -> list[Section]:
    if not views.failed:
        return []
    rows = grid(("photograph", "reason"), views.failed, "words")
    return [Section("failed", "Photographs not used", rows, "Not used")]


def _models(choice: "ModelComparison") -> Section:
    parts = [
        paragraph(choice.sentence),
        grid(MODELS_HEADER, model_rows(choice)),
        paragraph(models_legend(choice)),
    ]
    if choice.failed:
        parts += [
            "<h3>Not compared</h3>\n",
            grid(("model", "reason"), choice.failed.items(), "words"),
        ]
    return Section("models", "Camera models compared", "".join(parts), "Models")


def _describe_several(calibrations: "Calibrations", origin: Origin, addition: Addition) -> Page:
    """The common page: the verdict, the rig, the parameters of all."""
    sections, tables = [], {"cameras": _table_of_cameras(calibrations)}
    rig = calibrations.rig
    if rig is not None:
        unit = _unit(next(iter(rig.cameras.values())))
        sections += [_rig(rig, unit)]
        for number, name in enumerate(rig.names):
            maps = rig.reported_maps(name)
            sections.append(_quality(rig.coverage(name), maps, unit, f"{name} in the rig", number))
        sections.append(show_residuals(rig.residuals["tau"]))
        listed = table_of_residuals(rig.residuals, rig.sigma0)
        tables["observations"] = Listing("Observations of the rig", listed, "result.json")
    else:
        solved = {
            name: calibration
            for name, calibration in calibrations.cameras.items()
            if calibration.converged
        }
        for number, (name, calibration) in enumerate(solved.items()):
            sections.append(
                _quality(
                    calibration.coverage,
                    calibration.reported_maps,
                    _unit(calibration),
                    name,
                    number,
                )
            )
    remark = paragraph("Every camera has its own page in its folder of --out.")
    title = f"{KIND.capitalize()} {', '.join(map(clean, calibrations.cameras))}"
    findings = [*conclude_calibrations(calibrations).findings, *addition.findings]
    verdict_section = give_verdict(findings, (), remark)
    return Page(title, [verdict_section, *addition.sections, *sections], origin, tables=tables)


def _rig(rig: "RigCalibration", unit: str) -> Section:
    parts = [facts(rig_facts(rig, unit))]
    for title, m in mounting_titles(rig).items():
        parts += [
            f"<h3>{text(title)}</h3>\n",
            grid(("", "value", "σ", "unit"), mounting_rows(m, unit)),
            grid(("", *MOUNTED), correlation_rows(m)),
        ]
    parts.append(list_messages("Advice on the mountings", rig.advice))
    for name in rig.names:
        parts += [
            f"<h3>{text(f'Camera {name} in the rig')}</h3>\n",
            grid(("parameter", "value", "σ"), rig_parameter_rows(rig, name)),
        ]
    return Section("rig", f"Rig, reference {rig.names[0]}", "".join(parts), "Rig")


def _table_of_cameras(calibrations: "Calibrations") -> Listing:
    """One row per parameter of every separately calibrated camera."""
    rows = [
        (name, calibration.camera.model, parameter, value, calibration.stated_sigma.get(parameter))
        for name, calibration in calibrations.cameras.items()
        if calibration.converged
        for parameter, value in calibration.parameters.items()
    ]
    camera, model, parameter, value, sigma = zip(*rows) if rows else ((),) * 5
    words = lambda values: np.array(values, dtype=object)
    return Listing(
        "Cameras, calibrated separately",
        {
            "camera": Column(words(camera), "camera"),
            "model": Column(words(model), "model"),
            "parameter": Column(words(parameter), "parameter"),
            "value": estimates(numbers(value), numbers(sigma), "value"),
            "sigma": Column(numbers(sigma), "σ"),
        },
        "result.json",
    )
