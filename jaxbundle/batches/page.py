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
    population = rows if isinstance(rows, Population) else Population(rows)
    return write(_describe(population, origin, against, also))


def _describe(
    population: Population,
    origin: Origin,
    further_columns: Mapping[str, np.ndarray],
    addition: Addition,
) -> Page:
    sections = [
        *addition.sections,
        *_rms(population),
        *_parameters(population),
        *_correlations(population, further_columns),
        *_outlying(population),
    ]
    counts = Counter(population.status.tolist()).most_common()
    states = [(name, n, fixed(100 * n / len(population), 1)) for name, n in counts]
    status_table = "<h3>Status</h3>\n", grid(("status", "number", "%"), states)
    verdict_section = give_verdict([*addition.findings, *_judge(population)], (), *status_table)
    title = f"{count(len(population), 'input')}: batch"
    listing = Listing(
        "Results", _columns(population, further_columns), "", "One row a camera or network."
    )
    return Page(title, [verdict_section, *sections], origin, tables={"results": listing})


def _judge(population: Population) -> list[Finding]:
    total, solved, fit = len(population), int(population.solved.sum()), int(population.fit.sum())
    state = BAD if not solved else GOOD if solved == total else DOUBTFUL
    findings = [Finding("Results", state, f"{solved} of {count(total, 'input')} have values")]
    if solved:
        words = f"weak or misfit: {solved - fit} of these {solved}"
        findings.append(Finding("Fit", GOOD if fit == solved else DOUBTFUL, words))
    limit = population.settings.outlier_limit
    number_far = int((np.nan_to_num(population.farthest) > limit).sum())
    if np.isfinite(population.farthest).any():
        words = (
            f"{number_far} with a parameter more than {limit:g} robust standard deviations from "
            "the median"
        )
        findings.append(Finding("Population", DOUBTFUL if number_far else GOOD, words))
    return findings


def _rms(population: Population) -> list[Section]:
    """The histogram of the RMS of cameras, or of σ0 for networks only."""
    name, label = ("rms", "RMS of an image point [px]")
    if not np.isfinite(population.numbers["rms"]).any():
        name, label = "sigma0", "σ0"
    values = population.numbers[name]
    values = values[np.isfinite(values)]
    if not len(values):
        return []
    median = float(np.median(values))
    # From 0, so that heights of two batches compare, and without the tail of a few misfits.
    top = max(min(3 * median, float(values.max())), 1e-12)
    edges = np.linspace(0, top, 25)
    has_above = (values > top).any()
    edges = np.append(edges, np.inf) if has_above else edges
    counted = np.histogram(values, edges)[0]
    caption = (
        f"{len(values)} results with values; median {significant(median)}, largest "
        f"{significant(float(values.max()))}" + ("; the last class is open" if has_above else "")
    )
    drawing = figure(draw_histogram(edges, counted, label, "number of inputs"), caption)
    return [Section("rms", f"Distribution of {label.split(' [')[0]}", drawing, "Distribution")]


def _parameters(population: Population) -> list[Section]:
    rows = []
    for name, values in population.values.items():
        median, robust_sigma = population.spread(values)
        sigma = population.spread(population.sigma[name])[0]
        finite_values = values[population.fit & np.isfinite(values)]
        if len(finite_values):
            ends = (
                significant(x, digits_of(x, robust_sigma))
                for x in (finite_values.min(), finite_values.max())
            )
            rows.append(
                (
                    name,
                    len(finite_values),
                    *estimate(median, robust_sigma),
                    significant(sigma),
                    *ends,
                )
            )
    if not rows:
        return []
    note = paragraph(
        "Converged cameras. Robust σ: 1.4826 times the median absolute deviation. A "
        "spread far above the median σ comes from the cameras, not from the "
        "measurements."
    )
    header = ("parameter", "cameras", "median", "robust σ", "median σ", "least", "greatest")
    content = grid(header, rows) + note + "".join(_histograms(population))
    return [Section("population", "Parameters of the population", content, "Population")]


def _histograms(population: Population) -> Iterator[str]:
    for name, values in population.values.items():
        edges, counted = population.histogram(values)
        if counted.sum() >= population.settings.min_cameras:
            yield figure(
                draw_histogram(edges, counted, name, "number of cameras"),
                f"{name} of {counted.sum()} converged cameras",
            )


def _correlations(
    population: Population, further_columns: Mapping[str, np.ndarray]
) -> list[Section]:
    """Correlations of parameters."""
    correlations = population.correlations(further_columns)
    if not correlations:
        return []
    level = population.settings.level / len(correlations)
    rows = [
        (
            f"{correlation.parameter} with {correlation.column}",
            correlation.cameras,
            fixed(correlation.rank_correlation, 3),
            significant(correlation.probability, 2),
            "yes" if correlation.probability < level else "no",
            significant(correlation.change),
        )
        for correlation in correlations
    ]
    note = paragraph(
        "Rank correlation (Spearman) over the converged cameras, and the probability of one as "
        f"large by chance; significant at {100 * population.settings.level:g} % for all of these "
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


def _outlying(population: Population) -> list[Section]:
    """Inputs that need attention: those without a result first, then misfits, then the farthest."""
    rows_and_reasons = population.outlying()
    if not rows_and_reasons:
        return []
    rows = [
        (population.keys[i], significant(population.numbers["rms"][i], 4), reason)
        for i, reason in rows_and_reasons[:30]  # a screen or two; the table has all
    ]
    number_of_others = len(rows_and_reasons) - len(rows)
    note = paragraph(f"and {number_of_others} more: sort the table.") if number_of_others else ""
    return [
        Section(
            "outlying",
            "Outlying cameras and networks",
            grid(("input", "RMS [px]", "why"), rows, "words") + note,
            "Outlying",
        )
    ]


def _columns(
    population: Population, further_columns: Mapping[str, np.ndarray]
) -> dict[str, Column]:
    places = {"rms": "RMS [px]", "sigma0": "σ0"}
    columns = {
        "id": Column(population.keys, "input"),
        "status": Column(population.status, "status"),
    }
    columns |= {
        name: Column(values, places.get(name, name), -4)
        for name, values in population.numbers.items()
        if np.isfinite(values).any()
    }
    for name, values in population.values.items():
        columns |= {
            name: estimates(values, population.sigma[name], name),
            f"sigma_{name}": Column(population.sigma[name], f"σ {name}"),
        }
    if np.isfinite(population.farthest).any():
        columns["farthest"] = Column(population.farthest, "largest deviation [robust σ]", 1)
    columns |= {
        f"with {n}": Column(values, n, -DIGITS_WITHOUT_SIGMA, True)
        for n, values in further_columns.items()
    }
    return columns | {"remark": Column(population.remark, "remark")}
