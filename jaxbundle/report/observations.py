"""The observations in a report: residuals, reliability, groups, blunders, comparisons.

w = (v/σ)/√r uses the a priori σ (Baarda), τ = w/σ0 the a posteriori one (Pope). Only τ is
comparable between projects with guessed a priori σ, so the report sorts by τ unless Baarda's test
is requested.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.cameras import get_model
from jaxbundle.leastsquares.quality.distributions import normal_quantile, tau_quantile
from jaxbundle.network.columns import count
from jaxbundle.report.head import span
from jaxbundle.report.layout import (
    bar,
    clean,
    column_decimals,
    facts,
    fixed,
    heading,
    paragraph,
    significant,
    table,
    to_place_of,
)
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

TESTS = {"pope": "tau", "baarda": "w"}
SYMBOLS = {"pope": "τ", "baarda": "w"}


# --- residuals ------------------------------------------------------------------------------


def residuals(adjustment: Any, limit: float, test: str, max_rows: int = 100) -> list[str]:
    """Residuals over the limit, the largest first, then the distribution of all.

    **Arguments:** `adjustment`: an `Adjustment` or a calibrated rig; `max_rows`: of more residuals
    the largest are listed, two pages; the tables have all.
    """
    columns, symbol = adjustment.residuals, SYMBOLS[test]
    size = np.abs(np.nan_to_num(columns[TESTS[test]]))
    order = np.argsort(-size, kind="stable")
    rows_over = order[size[order] > limit]
    lines = heading(f"Residuals with |{symbol}| > {limit:g}")
    lines += paragraph(
        f"Test: {'Pope, τ = w/σ0, σ a posteriori' if test == 'pope' else 'Baarda, σ a priori'}; "
        f"critical value {significant(critical_value(adjustment, test), 3)} for one observation at "
        "0.1 %. v, σ (a priori) and MDB: in the unit of their row. r: redundancy number. MDB: the "
        "smallest blunder that the test of w detects (α 0.1 %, power 80 %), by the a priori σ. "
        "ext. (external reliability): the largest effect of such a blunder on an unknown, in σ of "
        "that unknown."
    )
    lines.append("")
    if len(rows_over):
        lines += _rows(adjustment, rows_over[:max_rows])
        if len(rows_over) > max_rows:
            number_of_others = len(rows_over) - max_rows
            lines.append(
                f"… and {number_of_others} more: all residuals are in residuals.csv or the JSON."
            )
        lines += ["", f"{len(rows_over)} of {len(size)} observations."]
    else:
        lines.append(f"None of {count(len(size), 'observation')}. The largest:")
        lines += _rows(adjustment, order[:3])
    return lines + _histogram(columns["tau"])


def critical_value(adjustment: "Adjustment", test: str = "pope", level: float = 0.001) -> float:
    """The critical value of the test of one observation at a level."""
    if test == "baarda":
        return normal_quantile(1 - level / 2)
    return tau_quantile(1 - level / 2, adjustment.redundancy)


def _rows(adjustment: "Adjustment", chosen: Iterable[int]) -> list[str]:
    columns, sigma0 = adjustment.residuals, adjustment.sigma0
    header = ("kind", "image", "point", "axis", "unit", "v", "σ", "r", "w", "τ", "MDB", "ext.")
    rows = []
    for i in chosen:
        sigma = columns["sigma"][i]
        rows.append(
            (
                *(columns[name][i] for name in ("kind", "image", "point", "axis", "unit")),
                to_place_of(columns["v"][i], sigma0 * sigma),
                significant(sigma, 3),
                fixed(columns["r"][i], 3),
                significant(columns["w"][i], 3),
                fixed(columns["tau"][i], 2),
                to_place_of(columns["mdb"][i], sigma),
                significant(columns["external"][i], 3),
            )
        )
    return table(header, rows, "lllll" + "r" * 7)


def _histogram(tau: Float[np.ndarray, " n"]) -> list[str]:
    """Counts of τ in classes of ½, compared with a normal distribution."""
    tau = tau[np.isfinite(tau)]
    if not len(tau):
        return []
    edges, counted, expected = count_by_class(tau)
    largest = max(counted.max(), expected.max())
    rows = []
    for i, number_found in enumerate(counted):
        a, b = edges[i], edges[i + 1]
        name = f"< {b:g}" if i == 0 else f"> {a:g}" if np.isinf(b) else f"{a:g} to {b:g}"
        rows.append((name, str(number_found), f"{expected[i]:.1f}", bar(number_found, largest, 50)))
    return [
        *heading("Normalised residuals τ"),
        *table(("class", "number", "normal", ""), rows, "rrrl"),
        "",
        f"Mean {fixed(tau.mean(), 3)}, RMS {fixed(math.sqrt((tau**2).mean()), 3)}, "
        f"largest |τ| {fixed(np.abs(tau).max(), 3)}, of {len(tau)} controlled observations.",
    ]


def count_by_class(
    tau: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " edges"], Int[np.ndarray, " classes"], Float[np.ndarray, " classes"]]:
    """Edges of classes of ½ from −4 to 4, open at both ends; how many τ are in each, and how many
    a normal distribution would give."""
    tau = tau[np.isfinite(tau)]
    edges = np.concatenate([[-np.inf], np.arange(-4, 4.25, 0.5), [np.inf]])
    normal = np.array([0.5 * (1 + math.erf(edge / math.sqrt(2))) for edge in edges])  # Φ
    return edges, np.histogram(tau, edges)[0], len(tau) * np.diff(normal)


# --- reliability ----------------------------------------------------------------------------


def redundancy(adjustment: Any, max_rows: int = 8) -> list[str]:
    """Redundancy numbers: their sum, their range, and the `max_rows` observations that are least
    controlled: enough to see which kind or point they belong to."""
    columns = adjustment.residuals
    r = columns["r"]
    order = np.argsort(r, kind="stable")[:max_rows]
    weak, loose = count_weak(r)
    rows = [
        ("Sum", f"{r.sum():.3f} (redundancy {adjustment.redundancy})"),
        ("Mean, min, max", f"{r.mean():.3f}, {r.min():.3f}, {r.max():.3f}"),
        ("r < 0.1", f"{count(weak, 'observation')} weakly controlled"),
    ]
    if loose:
        rows.append(("r = 0", f"{count(loose, 'observation')} not controlled at all"))
    return [
        *heading("Redundancy numbers"),
        *facts(rows),
        "",
        "The least controlled observations:",
        *_rows(adjustment, order),
    ]


def count_weak(r: Float[np.ndarray, " n"]) -> tuple[int, int]:
    """The number of weakly controlled observations, r < 0.1, and of uncontrolled ones."""
    # r < 0.1 (Förstner, 1979: the bound of "bad" control); 1e-8: 0 but for rounding of 1 − hᵢᵢ
    return int((r < 0.1).sum()), int((r < 1e-8).sum())


def components(adjustment: "Adjustment") -> list[str]:
    """Variance components: the estimated σ of every group, relative to the given ones and
    absolute."""
    rows = [
        (
            name,
            str(c.observations),
            f"{c.redundancy:.2f}",
            significant(c.vtpv, 5),
            significant(c.sigma, 4),
            span(c.estimated, 3),
            clean(c.unit),
        )
        for name, c in adjustment.variance_components.items()
    ]
    header = ("group", "observations", "Σr", "vᵀPv", "σ̂/σ given", "σ̂", "unit")
    lines = [*heading("Variance components"), *table(header, rows, "lrrrrrl")]
    if adjustment.sigma_factors:
        names = ", ".join(
            f"{clean(name)} by {significant(factor, 4)}"
            for name, factor in adjustment.sigma_factors.items()
        )
        lines += [
            "",
            *paragraph(
                f"Estimated: the given σ were multiplied, {names}. A priori elsewhere "
                "in this report means these estimated σ."
            ),
        ]
    return lines


def removals(adjustment: Any) -> list[str]:
    """Observations removed by data snooping, in order, and insignificant parameters that were
    fixed."""
    lines = []
    if adjustment.removed:
        rows = [
            (str(i), item.kind, item.name, significant(item.test, 3))
            for i, item in enumerate(adjustment.removed, 1)
        ]
        lines += heading("Data snooping: removed observations")
        lines += table(("", "kind", "observation", "test"), rows, "rllr")
        lines += ["", "They are excluded from all results in this report."]
        if any(item.others for item in adjustment.removed):
            lines += paragraph(
                "Either of: one of these rays is wrong, but the point does not show which, "
                "and none of them is used."
            )
        if any(math.isnan(item.test) for item in adjustment.removed):
            lines += paragraph(
                "–: suspected, but not tested again, because the remaining rays do not determine "
                "its point."
            )
    if adjustment.eliminated:
        names = ", ".join(clean(name) for name in adjustment.eliminated)
        lines += heading("Eliminated parameters")
        defaults = {c.id: dict(get_model(c.model).defaults) for c in adjustment.network.cameras}
        has_other_default = any(
            defaults.get(n.id, {}).get(n.parameter) for n in adjustment.eliminated
        )
        lines += paragraph(
            f"Held at {'their defaults' if has_other_default else '0'} because they were not "
            f"significant, in this order: {names}."
        )
    return lines


def downweighted(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """The scale of a robust estimate, and the image points it suspects."""
    if adjustment.robust is None:
        return []
    suspects = adjustment.suspects
    rows = [
        (str(i), item.kind, item.name, significant(item.test, 3), significant(item.weight, 2))
        for i, item in enumerate(suspects[:max_rows], 1)
    ]
    weighted = len(not_none(adjustment.weights))
    lines = heading(f"Robust estimation ({adjustment.robust})")
    lines += paragraph(
        f"Scale: {significant(adjustment.robust_scale, 4)} times the a priori σ, estimated from "
        "the median of the residuals (MAD). "
        f"{len(suspects)} of {count(weighted, 'image point')} have residuals longer "
        f"than the critical length{', in σ times the scale (test):' if rows else '.'}"
    )
    if rows:
        header = ("", "kind", "observation", "test", "weight")
        lines += ["", *table(header, rows, "rllrr")]
    if len(suspects) > max_rows:
        lines.append(f"… and {len(suspects) - max_rows} more: all are in result.json.")
    return lines


# --- comparisons ----------------------------------------------------------------------------


def check_points(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """Check points: differences, adjusted minus given, with their σ; RMS."""
    columns_of_checks = adjustment.table("checks")
    if not columns_of_checks:
        return []
    unit = clean(adjustment.network.object_unit)
    total = len(columns_of_checks["id"])
    places = column_decimals(np.concatenate([columns_of_checks[f"s{axis}"] for axis in "XYZ"]))
    rows: list[tuple[str, ...]] = [
        (
            columns_of_checks["id"][i],
            *(fixed(columns_of_checks[f"d{axis}"][i], places) for axis in "XYZ"),
            *(fixed(columns_of_checks[f"s{axis}"][i], places) for axis in "XYZ"),
            str(columns_of_checks["rays"][i]),
        )
        for i in range(min(total, max_rows))
    ]
    rows.append(("",) * 8)
    for name, summarise in (
        ("RMS", lambda x: math.sqrt((x**2).mean())),
        ("mean", np.mean),
        ("largest", lambda x: x[np.abs(x).argmax()]),
    ):
        columns = (columns_of_checks[f"{kind}{axis}"] for kind in "ds" for axis in "XYZ")
        columns = (
            x[np.isfinite(x)] if np.isfinite(x).any() else np.full(1, np.nan) for x in columns
        )
        rows.append((name, *(fixed(float(summarise(column)), places) for column in columns), ""))
    lines = [
        *heading(f"Check points: intersected − given, in {unit}"),
        *table(("point", "dX", "dY", "dZ", "σX", "σY", "σZ", "rays"), rows, "lrrrrrrr"),
    ]
    if total > max_rows:
        lines.append(
            f"{total - max_rows} more rows are in checks.csv; the summary is of all {total}."
        )
    return lines


CONTROL_HEADER = ("point", "dX", "dY", "dZ", "σX", "σY", "σZ", "p %")
MEASUREMENT_HEADER = ("image", "point", "dx", "dy", "σx", "σy", "p %")
PREDICTION_LEGEND = (
    "Each point, and each measurement, as predicted by all other observations: predicted − given, "
    "the σ of this difference without blunders, and the probability of a larger one by chance. "
    "Without check points, these differences take their place. –: not predicted."
)


def predicted_rows(
    columns: Mapping[str, np.ndarray], names: Sequence[str], axes: str
) -> list[tuple[str, ...]]:
    """Predicted control points or measurements as text, the least probable first."""
    sigma = np.concatenate([columns[f"s{axis}"] for axis in axes])
    places = column_decimals(sigma)
    order = np.argsort(np.nan_to_num(columns["probability"], nan=1.0), kind="stable")
    return [
        (
            *(str(columns[name][i]) for name in names),
            *(fixed(float(columns[f"{kind}{axis}"][i]), places) for kind in "ds" for axis in axes),
            significant(100 * float(columns["probability"][i]), 2),
        )
        for i in order
    ]


def predicted_control(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """Control points predicted from all other observations, and their image measurements."""
    points, rays = (adjustment.table(name) for name in ("control", "control_measurements"))
    if not points:
        return []
    unit = clean(adjustment.network.object_unit)
    rows = predicted_rows(points, ("id",), "XYZ")
    lines = [*heading(f"Control predicted from all other observations, in {unit}")]
    lines += table(CONTROL_HEADER, rows[:max_rows], "lrrrrrrr")
    if len(rows) > max_rows:
        lines.append(f"{len(rows) - max_rows} more, less improbable, are in the JSON.")
    if rays:
        listed = predicted_rows(rays, ("image", "point"), "xy")
        number_shown = min(max_rows, MEASUREMENTS_SHOWN)
        lines += ["", f"Image measurements of control, in {adjustment.image_unit}"]
        lines += table(MEASUREMENT_HEADER, listed[:number_shown], "llrrrrr")
        if len(listed) > number_shown:
            lines.append(f"{len(listed) - number_shown} more, less improbable, are in the JSON.")
    return [*lines, "", *paragraph(PREDICTION_LEGEND)]


# Predicted control points or measurements on a page, as in a report.
ROWS_OF_PAGE = 200
# Image measurements of control in a report, the least probable first: half a page.
MEASUREMENTS_SHOWN = 40


def distances(adjustment: "Adjustment", max_rows: int) -> list[str]:
    """Measured distances against those of the adjusted points."""
    columns = adjustment.residuals
    rows_of = np.flatnonzero(columns["kind"] == "distance")
    if not len(rows_of):
        return []
    row_of = {id: i for i, id in enumerate(adjustment.points["id"])}
    places = column_decimals(columns["sigma"][rows_of])
    rows = []
    for i in rows_of[:max_rows]:
        # A distance has its points in the columns of image and point.
        a, b = (adjustment.point_values[row_of[columns[end][i]]] for end in ("image", "point"))
        adjusted = float(np.linalg.norm(a - b))
        v, r = columns["v"][i], columns["r"][i]
        # σ of the adjusted distance: Q_l̂ = Q_l − Q_v, and r = (Q_v·P)ᵢᵢ
        sigma = adjustment.sigma0 * columns["sigma"][i] * math.sqrt(max(1 - r, 0))
        values = (adjusted - v, columns["sigma"][i], adjusted, sigma, v)
        rows.append(
            (
                columns["image"][i],
                columns["point"][i],
                *(fixed(float(x), places) for x in values),
                fixed(float(r), 3),
                fixed(float(columns["tau"][i]), 2),
            )
        )
    header = ("from", "to", "measured", "σ a priori", "adjusted", "σ", "v", "r", "τ")
    lines = [
        *heading(f"Distances in {clean(adjustment.network.object_unit)}"),
        *table(header, rows, "llrrrrrrr"),
    ]
    if len(rows_of) > max_rows:
        lines.append(f"… and {len(rows_of) - max_rows} more: all are in residuals.csv.")
    return lines
