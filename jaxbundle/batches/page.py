"""The page of a batch: how many inputs have a result, the population of the cameras, the outlying
ones, a table of all."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from jaxbundle.batches.population import Population
from jaxbundle.network.columns import count
from jaxbundle.report.layout import DIGITS_WITHOUT_SIGMA, digits_of, estimate, fixed, significant
from jaxbundle.report.page import (
    UNKNOWN,
    Addition,
    Finding,
    Listing,
    Origin,
    Page,
    Section,
    give_verdict,
    write,
)
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.report.page.charts import draw_histogram
from jaxbundle.report.page.columns import Column, estimates
from jaxbundle.report.page.document import NOTHING
from jaxbundle.report.page.markup import figure, grid, paragraph
from jaxbundle.report.verdict import BAD, DOUBTFUL, GOOD


def compose_batch(
    rows: Iterable[Mapping] | Population,
    origin: Origin = UNKNOWN,
    against: Mapping[str, np.ndarray] = NOTHING,
    also: Addition = NO_ADDITION,
) -> Iterator[str]:
    """The page of the results of `run_batch`, as their lines are read (`result_rows`): HTML, in
    pieces. `against`: columns to correlate with (`Population.correlations`); `also`: findings and
    sections of a command."""
    found = rows if isinstance(rows, Population) else Population(rows)
    return write(_describe(found, origin, against, also))


def _describe(
    found: Population, origin: Origin, against: Mapping[str, np.ndarray], also: Addition
) -> Page:
    sections = [
        *also.sections,
        *_rms(found),
        *_parameters(found),
        *_correlations(found, against),
        *_outlying(found),
    ]
    counts = Counter(found.status.tolist()).most_common()
    states = [(name, n, fixed(100 * n / len(found), 1)) for name, n in counts]
    shown = "<h3>Status</h3>\n", grid(("status", "number", "%"), states)
    first = give_verdict([*also.findings, *_judge(found)], (), *shown)
    title = f"{count(len(found), 'input')}: batch"
    listed = Listing("Results", _columns(found, against), "", "One row a camera or network.")
    return Page(title, [first, *sections], origin, tables={"results": listed})


def _judge(found: Population) -> list[Finding]:
    total, solved, fit = len(found), int(found.solved.sum()), int(found.fit.sum())
    state = BAD if not solved else GOOD if solved == total else DOUBTFUL
    findings = [Finding("Results", state, f"{solved} of {count(total, 'input')} have values")]
    words = f"weak or misfit: {solved - fit} of these {solved}"
    findings.append(Finding("Fit", GOOD if fit == solved else DOUBTFUL, words))
    limit = found.settings.outlier_limit
    far = int((np.nan_to_num(found.farthest) > limit).sum())
    if np.isfinite(found.farthest).any():
        words = (
            f"{far} with a parameter more than {limit:g} robust standard deviations from the median"
        )
        findings.append(Finding("Population", DOUBTFUL if far else GOOD, words))
    return findings


def _rms(found: Population) -> list[Section]:
    """The histogram of the RMS of cameras, or of σ0 for networks only."""
    name, label = ("rms", "RMS of an image point [px]")
    if not np.isfinite(found.numbers["rms"]).any():
        name, label = "sigma0", "σ0"
    values = found.numbers[name]
    values = values[np.isfinite(values)]
    if not len(values):
        return []
    middle = float(np.median(values))
    # From 0, so that heights of two batches compare, and without the tail of a few misfits.
    top = max(min(3 * middle, float(values.max())), 1e-12)
    edges = np.linspace(0, top, 25)
    above = (values > top).any()
    edges = np.append(edges, np.inf) if above else edges
    counted = np.histogram(values, edges)[0]
    caption = (
        f"{len(values)} results with values; median {significant(middle)}, largest "
        f"{significant(float(values.max()))}" + ("; the last class is open" if above else "")
    )
    drawing = figure(draw_histogram(edges, counted, label, "number of inputs"), caption)
    return [Section("rms", f"Distribution of {label.split(' [')[0]}", drawing, "Distribution")]


def _parameters(found: Population) -> list[Section]:
    rows = []
    for name, values in found.values.items():
        middle, deviation = found.spread(values)
        sigma = found.spread(found.sigma[name])[0]
        there = values[found.fit & np.isfinite(values)]
        if len(there):
            ends = (significant(x, digits_of(x, deviation)) for x in (there.min(), there.max()))
            rows.append((name, len(there), *estimate(middle, deviation), significant(sigma), *ends))
    if not rows:
        return []
    note = paragraph(
        "Converged cameras. Robust σ: 1.4826 times the median absolute deviation. A "
        "spread far above the median σ comes from the cameras, not from the "
        "measurements."
    )
    header = ("parameter", "cameras", "median", "robust σ", "median σ", "least", "greatest")
    shown = grid(header, rows) + note + "".join(_histograms(found))
    return [Section("population", "Parameters of the population", shown, "Population")]


def _histograms(found: Population) -> Iterator[str]:
    for name, values in found.values.items():
        edges, counted = found.histogram(values)
        enough = counted.sum() >= found.settings.min_cameras
        if enough and np.isfinite(edges[1:-1]).all() and len(edges) > 4:
            yield figure(
                draw_histogram(edges, counted, name, "number of cameras"),
                f"{name} of {counted.sum()} converged cameras",
            )


def _correlations(found: Population, against: Mapping[str, np.ndarray]) -> list[Section]:
    """Correlations of parameters."""
    told = found.correlations(against)
    if not told:
        return []
    level = found.settings.level / len(told)
    rows = [
        (
            f"{one.parameter} with {one.column}",
            one.cameras,
            fixed(one.rank_correlation, 3),
            significant(one.probability, 2),
            "yes" if one.probability < level else "no",
            significant(one.change),
        )
        for one in told
    ]
    note = paragraph(
        "Rank correlation (Spearman) over the converged cameras, and the probability of one as "
        f"large by chance; significant at {100 * found.settings.level:g} % for all of these "
        "together. Change: of the median, from the lower half of the column to the upper."
    )
    header = ("", "cameras", "correlation", "probability", "significant", "change")
    return [
        Section(
            "correlations",
            "What parameters correlate with",
            grid(header, rows) + note,
            "Correlations",
        )
    ]


def _outlying(found: Population) -> list[Section]:
    """Inputs that need attention: those without a result first, then misfits, then the farthest."""
    said = found.outlying()
    if not said:
        return []
    rows = [
        (found.keys[i], significant(found.numbers["rms"][i], 4), words)
        for i, words in said[:30]  # a screen or two; the table has all
    ]
    more = len(said) - len(rows)
    note = paragraph(f"and {more} more: sort the table.") if more else ""
    return [
        Section(
            "outlying",
            "Outlying cameras and networks",
            grid(("input", "RMS [px]", "why"), rows, "words") + note,
            "Outlying",
        )
    ]


def _columns(found: Population, against: Mapping[str, np.ndarray]) -> dict[str, Column]:
    places = {"rms": "RMS [px]", "sigma0": "σ0"}
    columns = {"id": Column(found.keys, "input"), "status": Column(found.status, "status")}
    columns |= {
        name: Column(values, places.get(name, name), -4)
        for name, values in found.numbers.items()
        if np.isfinite(values).any()
    }
    for name, values in found.values.items():
        columns |= {
            name: estimates(values, found.sigma[name], name),
            f"sigma_{name}": Column(found.sigma[name], f"σ {name}"),
        }
    if np.isfinite(found.farthest).any():
        columns["farthest"] = Column(found.farthest, "largest deviation [robust σ]", 1)
    columns |= {
        f"with {n}": Column(values, n, -DIGITS_WITHOUT_SIGMA, True) for n, values in against.items()
    }
    return columns | {"remark": Column(found.remark, "remark")}
