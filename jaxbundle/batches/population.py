"""The population of a batch: distribution of its cameras, outliers, correlations of parameters.

A parameter of a camera is outlying if it is more than `outlier_limit` robust standard deviations
from the median of the converged cameras; likewise a high RMS. The robust standard deviation s is
1.4826 times the median absolute deviation; for a camera known worse than most it is
√(s² + σ² − σ_m²), with its σ and their median σ_m: it may be as far off by its measurements.

Correlation with a serial number or a date is Spearman's rank correlation (1904), with the p-value
from

    t = r·√((n − 2)/(1 − r²))   ~   Student's t with n − 2 degrees of freedom.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.batches.camera import CONVERGED, SOLVED, STATUS, WEAK
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD, f_tail
from jaxbundle.network.columns import Columns, as_columns
from jaxbundle.report.layout import significant
from jaxbundle.report.page.columns import numbers

NUMBERS = ("rms", "sigma0", "redundancy", "iterations", "views", "removed")
ID = "id"


@dataclasses.dataclass(frozen=True)
class PopulationSettings:
    """What is unusual in a population, and how it is drawn.

    **Fields:**

    - `min_cameras`: below it a median deviation says little; not critical.
    - `outlier_limit`: in robust standard deviations. Cameras are not normally distributed (lots,
      focus): 5 lists what anybody would look at, not the tails.
    - `level`: joint level of all correlations of a batch (Bonferroni): one batch in a hundred
      without any relation shows one.
    - `classes`, `half_width`: of a histogram: their number, and half its width in robust standard
      deviations, so that a class is a third of one.
    """

    min_cameras: int = 8
    outlier_limit: float = 5.0
    level: float = 0.01
    classes: int = 24
    half_width: float = 4.0


@dataclasses.dataclass(frozen=True)
class Correlation:
    """Rank correlation of a parameter with a column over `cameras`; its p-value `probability`;
    `change`: the median for the upper half of the column minus that for the lower."""

    column: str
    parameter: str
    cameras: int
    rank_correlation: float
    probability: float
    change: float


class Population:
    """Columns over all rows of a batch (`batches.result_rows`): `keys`, `status`, `remark`,
    `numbers` by name; the `models` of cameras; their parameters, `values`, with their `sigma`, and
    their deviations `apart` from the median, in robust standard deviations; `rms_apart`, signed."""

    def __init__(self, rows: Iterable[Mapping], settings: PopulationSettings | None = None):
        self.settings = settings or PopulationSettings()
        kept_rows = [_row(row) for row in rows]
        texts = lambda name: np.array([str(row.get(name, "")) for row in kept_rows], dtype=object)
        self.keys, self.status, self.remark = (texts(n) for n in ("key", "status", "remark"))
        self.numbers = {name: numbers(row.get(name) for row in kept_rows) for name in NUMBERS}
        self.models = {model for row in kept_rows for model in row["models"]}
        names = dict.fromkeys(name for row in kept_rows for name in row["parameters"])
        column = lambda name, quantity: numbers(
            row["parameters"].get(name, {}).get(quantity) for row in kept_rows
        )
        self.values = {name: column(name, "value") for name in names}
        self.sigma = {name: column(name, "sigma") for name in names}
        self.apart = {
            name: np.abs(self._deviations(values, self.sigma[name]))
            for name, values in self.values.items()
        }
        # Views that determine nothing: weak without values.
        self._void = np.array(
            [row.get("status") == STATUS[WEAK] and not row["parameters"] for row in kept_rows], bool
        )
        self.rms_apart = self._deviations(self.numbers["rms"], np.zeros(len(kept_rows)))

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def solved(self) -> np.ndarray:
        """Which have values."""
        return np.isin(self.status.astype(str), SOLVED) & ~self._void

    @property
    def fit(self) -> np.ndarray:
        """Which have values that fit and are determined, i.e. the population."""
        return self.status == STATUS[CONVERGED]

    def spread(self, values: np.ndarray) -> tuple[float, float]:
        """Median and robust standard deviation over the population."""
        finite_values = values[self.fit & np.isfinite(values)]
        if not len(finite_values):
            return np.nan, np.nan
        median = float(np.median(finite_values))
        return median, NORMAL_SIGMA_BY_MAD * float(np.median(np.abs(finite_values - median)))

    def _deviations(self, values: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        median, robust_sigma = self.spread(values)
        number = (self.fit & np.isfinite(values)).sum()
        if number < self.settings.min_cameras or not robust_sigma > 0:
            return np.full(len(values), np.nan)
        # s contains the usual σ already; only what a camera has on top of it widens its limit
        median_sigma = np.nan_to_num(self.spread(sigma)[0])
        additional_variance = np.maximum(np.nan_to_num(sigma) ** 2 - median_sigma**2, 0.0)
        return (values - median) / np.sqrt(robust_sigma**2 + additional_variance)

    @property
    def farthest(self) -> np.ndarray:
        """The largest deviation of a parameter from the median, by row; NaN without any."""
        if not self.apart:
            return np.full(len(self), np.nan)
        deviations = np.array(list(self.apart.values()))
        largest = np.nan_to_num(deviations, nan=-1.0).max(0)
        return np.where(largest < 0, np.nan, largest)

    def why_outlying(self, i: int) -> str:
        """Status, remark and outlying parameters, in words; empty: not outlying."""
        reasons = [] if self.fit[i] else [self.status[i]]
        reasons += [self.remark[i]] if self.remark[i] else []
        reasons += [
            f"{name} {significant(deviation[i], 2)} robust σ from the median"
            for name, deviation in self.apart.items()
            if deviation[i] > self.settings.outlier_limit
        ]
        if self.fit[i] and self.rms_apart[i] > self.settings.outlier_limit:
            reasons.append(f"RMS {significant(self.rms_apart[i], 2)} robust σ above the median")
        return "; ".join(reasons)

    def outlying(self) -> list[tuple[int, str]]:
        """Rows that need attention, with the reason: without a result first, then weak ones and
        misfits, then the farthest."""
        rows_and_reasons = [(i, self.why_outlying(i)) for i in range(len(self))]
        farthest, rms = np.nan_to_num(self.farthest), np.nan_to_num(self.numbers["rms"])
        rows_and_reasons = [(i, reason) for i, reason in rows_and_reasons if reason]
        return sorted(
            rows_and_reasons,
            key=lambda item: (
                bool(self.solved[item[0]]),
                bool(self.fit[item[0]]),
                -farthest[item[0]],
                -rms[item[0]],
            ),
        )

    def histogram(self, values: np.ndarray) -> tuple[Float[np.ndarray, " edges"], np.ndarray]:
        """Edges and counts of classes over the population, the outer ones open if values lie
        beyond."""
        finite_values = values[self.fit & np.isfinite(values)]
        if not len(finite_values):
            return np.zeros(0), np.zeros(0, int)
        median, robust_sigma = self.spread(values)
        smallest, greatest = float(finite_values.min()), float(finite_values.max())
        if robust_sigma > 0:
            reach = self.settings.half_width * robust_sigma
            smallest, greatest = max(smallest, median - reach), min(greatest, median + reach)
        if not greatest > smallest:
            smallest, greatest = smallest - 0.5, greatest + 0.5
        edges = np.linspace(smallest, greatest, self.settings.classes + 1)
        edges[0] = -np.inf if finite_values.min() < smallest else edges[0]
        edges[-1] = np.inf if finite_values.max() > greatest else edges[-1]
        return edges, np.histogram(finite_values, edges)[0]

    def correlations(self, against: Mapping[str, np.ndarray]) -> list[Correlation]:
        """Correlations of every parameter and the RMS with every column of `against` (a number per
        row, NaN if missing), the most significant first."""
        correlations = []
        for column, column_values in against.items():
            for name, values in {**self.values, "rms": self.numbers["rms"]}.items():
                is_used = self.fit & np.isfinite(values) & np.isfinite(column_values)
                varies = lambda x, is_used=is_used: np.ptp(x[is_used]) > 0
                has_enough = is_used.sum() >= self.settings.min_cameras
                if has_enough and varies(column_values) and varies(values):
                    correlations.append(
                        _correlation(column, name, column_values[is_used], values[is_used])
                    )
        return sorted(
            correlations,
            key=lambda correlation: (correlation.probability, -abs(correlation.rank_correlation)),
        )

    def summary(self, against: Mapping[str, np.ndarray] | None = None) -> dict[str, Any]:
        """The population as plain dicts and numbers."""
        names, counts = np.unique(self.status.astype(str), return_counts=True)
        columns = {**self.values, "rms": self.numbers["rms"]}
        parameters = {}
        for name, values in columns.items():
            finite_values = values[self.fit & np.isfinite(values)]
            if not len(finite_values):
                continue
            median, robust_sigma = self.spread(values)
            edges, counted = self.histogram(values)
            parameters[name] = {
                "cameras": len(finite_values),
                "median": median,
                "robust_sigma": robust_sigma,
                "least": float(finite_values.min()),
                "greatest": float(finite_values.max()),
                "histogram": {"edges": edges.tolist(), "numbers": counted.tolist()},
            }
            if name in self.sigma:
                parameters[name]["median_sigma"] = self.spread(self.sigma[name])[0]
        correlations = self.correlations(against or {})
        return {
            "inputs": len(self),
            "status": dict(zip(names.tolist(), counts.tolist())),
            "rms": parameters.pop("rms", None),
            "parameters": parameters,
            "outlying": [{"key": self.keys[i], "why": why} for i, why in self.outlying()],
            "correlations": [
                vars(correlation)
                | {"significant": correlation.probability < self.settings.level / len(correlations)}
                for correlation in correlations
            ],
        }

    def table(self, against: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
        """One row per input: key, status, remark, the numbers, every parameter with its σ, the
        largest deviation from a median, and the columns of `against`."""
        columns = {"key": self.keys, "status": self.status, "remark": self.remark}
        columns |= {n: values for n, values in self.numbers.items() if np.isfinite(values).any()}
        for name, values in self.values.items():
            columns |= {name: values, f"sigma_{name}": self.sigma[name]}
        columns["farthest"] = self.farthest
        return columns | {name: x for name, x in (against or {}).items() if name not in columns}


def _row(row: Mapping) -> dict:
    """The data of a line used by the population, without poses and covariances."""
    names = ("key", "status", "remark", "rms", "sigma0", "redundancy", "iterations", "views")
    used_entries = {name: row[name] for name in names if name in row}
    removed = row.get("removed")
    used_entries["removed"] = len(removed) if isinstance(removed, list) else removed
    used_entries["remark"] = row.get("remark") or row.get("error", "")
    cameras = (row.get("cameras") or {}).values()
    used_entries["models"] = {row.get("model"), *(c.get("model") for c in cameras)} - {None}
    return used_entries | {
        "parameters": row["parameters"] if "parameters" in row else _estimates_of_network(row)
    }


def _estimates_of_network(row: Mapping) -> dict[str, dict]:
    """Estimates of a network that are not held and belong to no single image: free parameters of
    its cameras (with the camera's id where there are several), mountings, boresights and the
    like."""
    estimate_of, cameras = {}, row.get("cameras") or {}
    for id, camera in cameras.items():
        for name, estimate in camera["parameters"].items():
            if estimate.get("free"):
                estimate_of[name if len(cameras) == 1 else f"{id} {name}"] = estimate
    for table, unknowns in (row.get("further_unknowns") or {}).items():
        for object_id, estimates in unknowns.items():
            if object_id not in row.get("images", {}):
                estimate_of |= {
                    f"{table} {object_id} {name}": estimate
                    for name, estimate in estimates.items()
                    if estimate["sigma"] != 0
                }
    return estimate_of


def _correlation(
    column: str, name: str, column_values: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]
) -> Correlation:
    n = len(values)
    r = float(np.corrcoef(_ranks(column_values), _ranks(values))[0, 1])
    t_squared = r * r * (n - 2) / max(1 - r * r, 1e-300)
    # A rank correlation has no unit: the change of the median says how much it matters.
    upper = column_values > np.median(column_values)
    change = np.median(values[upper]) - np.median(values[~upper]) if upper.any() else np.nan
    return Correlation(column, name, n, r, f_tail(t_squared, 1, n - 2), float(change))


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks, those of equal values their mean."""
    _, rank, times = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(times) - (times - 1) / 2)[rank]


def read_against(table: Any, keys: Iterable[str], name: str) -> dict[str, np.ndarray]:
    """The columns of a table (numbers, or dates as 2026-05-01: days) for these keys, by its column
    `id`: the key of an input, or of a camera its part after #.

    **Raises:** `InputError` for a table without `id`, or without another column, for a repeated id,
    a cell that is neither number nor date, and no matching key."""
    columns_given: Columns = as_columns(table, name)
    value_columns = [column for column in columns_given.values if column != ID]
    if ID not in columns_given.values or not value_columns:
        raise InputError(
            f"{name}: expected a column id and others, but there are "
            f"{', '.join(columns_given.values) or 'none'}"
        )
    rows: dict[str, int] = {}
    for row, id in enumerate(columns_given.ids(ID)):
        if id in rows:
            raise InputError(f"{columns_given.source(row)}: id {id!r} occurs twice")
        rows[id] = row
    keys = list(keys)
    # Keys are PATH#CAMERA; a table of serial numbers knows only the camera.
    place = [rows.get(key, rows.get(key.rpartition("#")[2])) for key in keys]
    if all(row is None for row in place):
        raise InputError(f"{name}: expected ids of cameras or inputs; none of its ids is one")
    row_of_key = np.array([-1 if row is None else row for row in place], int)
    chosen_values = {}
    for column in value_columns:
        values = np.append(_numbers(columns_given, column), np.nan)  # row −1: missing
        chosen_values[column] = values[row_of_key]
    return chosen_values


def _numbers(columns: Columns, column: str) -> np.ndarray:
    """Numbers, or dates as days since 1970; NaN where a cell is empty."""
    cells = [str(cell).strip() if cell is not None else "" for cell in columns.values[column]]
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        if cell in ("", "nan", "None", "NaT"):
            continue
        values[row] = number_or_days(cell, f"{columns.source(row)}: {column}")
    return values


def number_or_days(cell: str, where: str) -> float:
    """A number, or a date such as 2026-05-01 as days since 1970.

    **Raises:** `InputError` for what is neither."""
    try:
        return float(cell)
    except ValueError:
        pass
    try:
        date = datetime.fromisoformat(cell)
    except ValueError:
        raise InputError(
            f"{where} is {cell!r}; expected a number or a date such as 2026-05-01"
        ) from None
    date = date if date.tzinfo else date.replace(tzinfo=UTC)
    return date.timestamp() / 86400
