"""The report of a refinement as text and as a document for JSON."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.leastsquares.quality.global_test import describe_test
from jaxbundle.leastsquares.quality.reliability import minimal_detectable
from jaxbundle.refinement.tables import UNIT_OF_WEIGHT, has_upright_checks
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.refinement.refining import Refinement


def to_json(result: "Refinement") -> dict:
    """The result as plain values: unknowns, correlations, points, image points, checks."""
    inspection = result.inspection
    document = {
        "sigma0": result.sigma0,
        "robust_sigma0": result.robust_sigma0,
        "redundancy": result.redundancy,
        "counts": result.counts(),
        "rays": {str(k): n for k, n in result.rays().items()},
        "steps": inspection.steps,
        "global_test": result.global_test(),
        "warnings": list(result.warnings),
        "unknowns": _unknowns_as_rows(result),
        "correlation": result.correlation.tolist(),
        "points": [
            {
                "id": result.points.id[k],
                "role": result.points.role[k],
                "X": X,
                "sigma": s,
                "axes": list(result.points.axis_names_of(k)),
            }
            for k, X, s in zip(
                inspection.declared.rays.points,
                result.positions.tolist(),
                inspection.point_sigma.tolist(),
            )
        ],
        "image_points": [
            {**row, "v": row["v"].tolist(), "r": row["r"].tolist(), "w": row["w"].tolist()}
            for row in result.image_points()
        ],
        "removed": [{"observation": b.name, "test": b.test} for b in result.removed],
    }
    if heights := result.terrain_heights():
        document["terrain_heights"] = heights
    if result.distances():
        document["distances"] = result.distances()
    if result.check is not None:
        c = result.check
        document["check_points"] = [
            {"id": id, "difference": d, "sigma": s, "rays": int(n)}
            for id, d, s, n in zip(c.id, c.difference.tolist(), c.sigma.tolist(), c.rays)
        ]
        document["check_rms"] = c.rms.tolist()
    return document


def _unknowns_as_rows(result: "Refinement") -> list[dict]:
    """The unknowns that points share, with their changes and σ in the units of reports."""
    factor = np.array([name.factor for name in result.names])
    return [
        {
            "of": n.owner,
            "name": n.parameter,
            "unit": n.unit,
            "change": value,
            "sigma": s,
            "prior_sigma": None if np.isinf(p) else p,
        }
        for n, value, s, p in zip(
            result.names,
            (factor * result.estimate).tolist(),
            (factor * result.inspection.sigma).tolist(),
            (factor * result.prior_sigma).tolist(),
        )
    ]


def report(
    result: "Refinement", verdict: str = "", *, min_correlation: float = 0.9, most: int = 12
) -> str:
    """The report: the `verdict` if given, input, warnings, unknowns, correlations, blunders,
    checks.

    Correlations above `min_correlation` (the σ of one unknown is 1/√(1 − 0.9²) = 2.3 times what it
    would be with the other known), image points and terrain heights are listed, the `most` largest.
    """
    used_points = [row for row in result.image_points() if not row["removed"]]
    lines = [*_summary(result, verdict), *_fits(result, used_points)]
    if result.warnings:
        lines += ["", "Warnings", *(f"  {warning}" for warning in result.warnings)]
    lines += ["", "Unknowns", *_unknowns(result)]
    C, names = result.correlation, result.names
    i, j = np.nonzero(np.triu(np.abs(C) > min_correlation, 1))
    if len(i):
        lines += ["", f"Correlations above {min_correlation:g}"]
        order = np.argsort(-np.abs(C[i, j]), kind="stable")[:most]
        lines += [f"  {C[a, b]:8.4f}  {names[a]} — {names[b]}" for a, b in zip(i[order], j[order])]
    heights = _heights_beside_image_points(result)
    nouns = "Image points and terrain heights" if heights else "Image points"
    lines += ["", f"{nouns} with the largest tests", *_tests([*used_points, *heights], most)]
    if result.removed:
        lines += ["", "Removed as blunders"]
        lines += [f"  {b.name}: |w| = {b.test:.1f}" for b in result.removed]
    if result.check is not None:
        lines += ["", *_checks(result)]
    return "\n".join(lines) + "\n"


def _summary(result: "Refinement", verdict: str) -> list[str]:
    """The lines that say what was adjusted, and how well it fits."""
    inspection = result.inspection
    roles = [result.points.role[k] for k in result.inspection.declared.rays.points]
    counts = ", ".join(f"{roles.count(role)} {role}" for role in ("control", "tie"))
    frames = 0 if result.frames is None else len(result.frames.images)
    rpc = len(result.inputs.rpc)
    rays = ", ".join(f"{n} with {k}" for k, n in result.rays().items())
    sums = result.counts()
    redundancy = sums.pop("redundancy")
    return [
        "Refinement of scanner images",
        "",
        *([f"verdict          {verdict}"] if verdict else []),
        f"scanner images   {len(result.images)}{f', {rpc} with RPC' if rpc else ''}, "
        f"photographs {frames}",
        f"points           {counts}; {sum(k * n for k, n in result.rays().items())} image points",
        f"points by rays   {rays}",
        f"counts           {', '.join(f'{word} {n}' for word, n in sums.items() if n)}",
        f"sigma0           {result.sigma0:.4f} (robust {result.robust_sigma0:.4f})   redundancy "
        f"{redundancy}, {inspection.steps} steps",
        f"chi2 test        {describe_global_test(result)}",
    ]


def describe_global_test(result: "Refinement") -> str:
    """The conclusion of the χ² test; a terrain model that does not fit is its first cause."""
    fit = result.terrain_fit
    cause = "the terrain model does not fit" if fit is not None and fit.is_contradicted else ""
    return describe_test(result.global_test(), UNIT_OF_WEIGHT, further_cause=cause)


def _fits(result: "Refinement", used_points: list[dict]) -> Iterator[str]:
    """The residuals of every image, and of the terrain model."""
    scanner_ids = [image.id for image in result.images]
    by_image = {id: [] for id in result.inputs.ids}
    for row in used_points:
        by_image[row["image"]].append(row["v"])
    for id, v in by_image.items():
        if v:
            v = np.array(v)
            unit = "lines, pixels" if id in scanner_ids else "camera's unit"
            rms = np.sqrt((v**2).mean(0))
            yield (f"RMS of image {id}: {rms[0]:.3f} {rms[1]:.3f} ({unit})")
    heights = [row for row in result.terrain_heights() if not row["removed"]]
    if heights:
        v = np.array([row["v"] for row in heights])
        yield (f"RMS of {len(v)} terrain heights: {np.sqrt((v**2).mean()):.3f} m")


def _unknowns(result: "Refinement") -> Iterator[str]:
    sigma = result.inspection.sigma
    yield f"  {'':46s} {'change':>13s} {'sigma':>11s} {'prior':>10s}"
    for name, value, s, p in zip(result.names, result.estimate, sigma, result.prior_sigma):
        prior = "free" if np.isinf(p) else f"{p * name.factor:.4g}"
        yield (
            f"  {str(name):46s} {value * name.factor:13.5f} {s * name.factor:11.5f} {prior:>10s} "
            f"{name.unit}"
        )


def _heights_beside_image_points(result: "Refinement") -> list[dict]:
    """The terrain heights used as rows of image points, whose second coordinate is missing."""
    return [
        {"image": "terrain (m)", "point": row["point"]}
        | {name: np.array([row[name], np.nan]) for name in ("v", "r", "w")}
        for row in result.terrain_heights()
        if not row["removed"]
    ]


def _tests(rows: list[dict], number: int) -> Iterator[str]:
    worst = np.nan_to_num(np.abs([row["w"] for row in rows]).reshape(-1, 2)).max(1)
    yield f"  {'image':12s} {'point':12s} {'v':>17s} {'r':>11s} {'w':>15s} {'MDB/σ':>13s}"
    for row in (rows[k] for k in np.argsort(-worst, kind="stable")[:number]):
        pair = lambda values, form: " ".join(
            format(x, form) if np.isfinite(x) else f"{'–':>{form.split('.')[0]}}" for x in values
        )
        mdb = pair(minimal_detectable(np.ones(1), row["r"]), "6.1f")
        yield (
            f"  {row['image']:12s} {row['point']:12s} {pair(row['v'], '8.3f')} "
            f"{pair(row['r'], '5.2f')} {pair(row['w'], '7.2f')} {mdb}"
        )


def _checks(result: "Refinement") -> Iterator[str]:
    c = not_none(result.check)
    names = ("east", "north", "up") if has_upright_checks(result.images[0].earth) else "XYZ"
    yield f"Check points, computed − given ({', '.join(names)}; m)"
    for id, d, s, n in zip(c.id, c.difference, c.sigma, c.rays):
        cells = " ".join(
            "        – ±    – " if np.isnan(x) else f"{x:9.3f} ±{y:6.3f}" for x, y in zip(d, s)
        )
        yield f"  {id:12s} {cells}  {n} image{'' if n == 1 else 's'}"
    yield "  RMS          " + " ".join("–" if np.isnan(x) else f"{x:.3f}" for x in c.rms)
