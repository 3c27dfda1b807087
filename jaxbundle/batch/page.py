"""The page of a batch: how many inputs have a result, the population of the cameras, the outlying
ones, a table of all."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from jaxbundle.batch.camera import CONVERGED, STATUS
from jaxbundle.batch.result import SOLVED
from jaxbundle.network.columns import count
from jaxbundle.report.layout import fixed, significant
from jaxbundle.report.page import (
    UNKNOWN,
    Finding,
    Listing,
    Origin,
    Page,
    Section,
    describe_origin,
    give_verdict,
    write,
)
from jaxbundle.report.page.charts import draw_histogram
from jaxbundle.report.page.columns import Column, numbers
from jaxbundle.report.page.markup import figure, grid, paragraph
from jaxbundle.report.page.verdict import BAD, DOUBTFUL, GOOD

MOST_OUTLYING = 30
"""Cameras listed as outlying; the table has all."""
FEWEST = 8
"""Cameras that make a population."""
APART = 5.0
"""A parameter so many robust standard deviations from the median is outlying."""
NORMAL = 1.4826
"""The standard deviation of a normal distribution over its median absolute deviation."""


def compose_batch(rows: Iterable[Mapping], origin: Origin = UNKNOWN) -> Iterator[str]:
    """The page of the results of `run_batch`, as their lines are read (`result_rows`): HTML, in
    pieces."""
    return write(_describe(_Population(rows), origin))


class _Population:
    """Columns over all rows: `keys`, `status`, `remark`, `numbers` by name; the parameters of
    cameras with their σ, and how far each is from the median, in robust standard deviations."""

    def __init__(self, rows: Iterable[Mapping]):
        kept = [_row(row) for row in rows]
        words = lambda name: np.array([str(row.get(name, "")) for row in kept], dtype=object)
        self.keys, self.status, self.remark = (words(n) for n in ("key", "status", "remark"))
        self.numbers = {
            name: numbers(row.get(name) for row in kept)
            for name in ("rms", "sigma0", "redundancy", "iterations", "views", "removed")
        }
        names = dict.fromkeys(name for row in kept for name in row["parameters"])
        of = lambda name, what: numbers(row["parameters"].get(name, {}).get(what) for row in kept)
        self.values = {name: of(name, "value") for name in names}
        self.sigma = {name: of(name, "sigma") for name in names}
        self.apart = {name: self._apart(values) for name, values in self.values.items()}

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def solved(self) -> np.ndarray:
        """Which have values."""
        return np.isin(self.status.astype(str), SOLVED)

    @property
    def fit(self) -> np.ndarray:
        """Which have values that fit and are determined: the population."""
        return self.status == STATUS[CONVERGED]

    def spread(self, values: np.ndarray) -> tuple[float, float]:
        """Median and robust standard deviation over the population."""
        found = values[self.fit & np.isfinite(values)]
        if not len(found):
            return np.nan, np.nan
        middle = float(np.median(found))
        return middle, NORMAL * float(np.median(np.abs(found - middle)))

    def _apart(self, values: np.ndarray) -> np.ndarray:
        middle, deviation = self.spread(values)
        known = np.isfinite(values).sum() >= FEWEST and deviation > 0
        return np.abs(values - middle) / deviation if known else np.full(len(values), np.nan)

    @property
    def farthest(self) -> np.ndarray:
        """Of every row the largest deviation of a parameter from the median; NaN without any."""
        if not self.apart:
            return np.full(len(self), np.nan)
        found = np.array(list(self.apart.values()))
        largest = np.nan_to_num(found, nan=-1.0).max(0)
        return np.where(largest < 0, np.nan, largest)

    def why_outlying(self, i: int) -> str:
        """Status, remark and the parameters far from the median, in words; empty: not outlying."""
        said = [] if self.fit[i] else [self.status[i]]
        said += [self.remark[i]] if self.remark[i] else []
        said += [f"{name} {significant(far[i], 2)} robust σ from the median"
                 for name, far in self.apart.items() if far[i] > APART]  # fmt: skip
        return "; ".join(said)


def _row(row: Mapping) -> dict:
    """What the page has of a line, without poses and covariances."""
    names = ("key", "status", "remark", "rms", "sigma0", "redundancy", "iterations", "views")
    found = {name: row[name] for name in names if name in row}
    removed = row.get("removed")
    found["removed"] = len(removed) if isinstance(removed, list) else removed
    found["remark"] = row.get("remark") or row.get("error", "")
    return found | {"parameters": row.get("parameters", {})}


def _describe(found: _Population, origin: Origin) -> Page:
    sections = [*_rms(found), *_parameters(found), *_outlying(found)]
    first = give_verdict(_judge(found), (), "<h3>Status</h3>\n", _states(found))
    title = f"{count(len(found), 'input')}: batch"
    listed = Listing("Results", _columns(found), "", "One row a camera or network.")
    return Page(title, [first, *sections], describe_origin((), origin), {"results": listed})


def _judge(found: _Population) -> list[Finding]:
    total, solved, fit = len(found), int(found.solved.sum()), int(found.fit.sum())
    state = BAD if not solved else GOOD if solved == total else DOUBTFUL
    findings = [Finding("Results", state, f"{solved} of {count(total, 'input')} have values")]
    words = f"weak or misfit: {solved - fit} of these {solved}"
    findings.append(Finding("Fit", GOOD if fit == solved else DOUBTFUL, words))
    far = int((np.nan_to_num(found.farthest) > APART).sum())
    if np.isfinite(found.farthest).any():
        words = (f"{far} with a parameter more than {APART:g} robust standard deviations from the "
                 "median")  # fmt: skip
        findings.append(Finding("Population", DOUBTFUL if far else GOOD, words))
    return findings


def _states(found: _Population) -> str:
    counts = Counter(found.status.tolist()).most_common()
    return grid(("status", "number", "%"),
                [(name, n, fixed(100 * n / len(found), 1)) for name, n in counts])  # fmt: skip


def _rms(found: _Population) -> list[Section]:
    """The histogram of the RMS of cameras, of σ0 where there are networks alone."""
    name, label = ("rms", "RMS of an image point [px]")
    if not np.isfinite(found.numbers["rms"]).any():
        name, label = "sigma0", "σ0"
    values = found.numbers[name]
    values = values[np.isfinite(values)]
    if not len(values):
        return []
    middle = float(np.median(values))
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


def _parameters(found: _Population) -> list[Section]:
    rows = []
    for name, values in found.values.items():
        middle, deviation = found.spread(values)
        sigma = found.spread(found.sigma[name])[0]
        there = values[found.fit & np.isfinite(values)]
        if len(there):
            rows.append((name, len(there), significant(middle, 7), significant(deviation),
                         significant(sigma), significant(there.min(), 7),
                         significant(there.max(), 7)))  # fmt: skip
    if not rows:
        return []
    note = paragraph("Converged cameras. Robust σ: 1.4826 times the median absolute deviation. A "
                     "spread far above the median σ is of the cameras, not of the measurements.")
    header = ("parameter", "cameras", "median", "robust σ", "median σ", "least", "greatest")
    return [Section("population", "Parameters of the population", grid(header, rows) + note,
                    "Population")]  # fmt: skip


def _outlying(found: _Population) -> list[Section]:
    """What needs attention: no result first, then misfit, then the farthest."""
    said = [(i, found.why_outlying(i)) for i in range(len(found))]
    said = [(i, words) for i, words in said if words]
    if not said:
        return []
    far, rms = np.nan_to_num(found.farthest), np.nan_to_num(found.numbers["rms"])
    said.sort(key=lambda item: (bool(found.solved[item[0]]), bool(found.fit[item[0]]),
                                -far[item[0]], -rms[item[0]]))  # fmt: skip
    rows = [(found.keys[i], significant(found.numbers["rms"][i], 4), words)
            for i, words in said[:MOST_OUTLYING]]  # fmt: skip
    more = len(said) - len(rows)
    note = paragraph(f"and {more} more: sort the table.") if more else ""
    return [Section("outlying", "Outlying cameras and networks",
                    grid(("input", "RMS [px]", "why"), rows, "words") + note, "Outlying")]


def _columns(found: _Population) -> dict[str, Column]:
    places = {"rms": "RMS [px]", "sigma0": "σ0"}
    columns = {"id": Column(found.keys, "input"), "status": Column(found.status, "status")}
    columns |= {
        name: Column(values, places.get(name, name), -4)
        for name, values in found.numbers.items() if np.isfinite(values).any()
    }  # fmt: skip
    for name, values in found.values.items():
        columns |= {name: Column(values, name, -8, True),
                    f"sigma_{name}": Column(found.sigma[name], f"σ {name}")}  # fmt: skip
    if np.isfinite(found.farthest).any():
        columns["farthest"] = Column(found.farthest, "largest deviation [robust σ]", 1)
    return columns | {"remark": Column(found.remark, "remark")}
