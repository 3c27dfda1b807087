r"""`compare`: the common unknowns of two adjustments, and those that differ significantly.

The unknowns x of the same names are brought into one datum and subtracted,

    d = S_b·x_b − S_a·T·x_a,        C_d = S_a·C_a·S_aᵀ + S_b·C_b·S_bᵀ

T the similarity that takes the points of a to those of b, S = I − G·(G_hᵀG_h)⁻¹·G_hᵀ the
S-transformation that refers coordinates to the points h in common (G the Helmert matrix); without a
similarity T = S = I. The adjustments are independent of each other: where they share measurements,
d has a smaller covariance than C_d, and nothing is tested. Of one unknown and of several together

    t = d/σ_d  ~  t(ν),        F = dᵀ·C_d⁺·d/h  ~  F(h, ν)

h the rank of C_d, ν of Welch and Satterthwaite, 1/ν = q²/r_a + (1 − q)²/r_b, with q the part of a
in the variance (tr(C_d⁺C_a)/h for several) and r the redundancies.

Source: Baarda (1973), S-transformations and criterion matrices; Pelzer (1971), Zur Analyse
geodätischer Deformationsmessungen (the test of congruency); Welch (1947), Biometrika 34, 28–35.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.common_frame import (
    CommonFrame,
    CommonRows,
    FramedAdjustment,
    common_frames,
    common_rows,
    points_that_hold,
)
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import number, show
from jaxbundle.display import print_anywhere
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import f_tail, level_of_one
from jaxbundle.network.columns import count
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.report.layout import fixed
from jaxbundle.results import TableMethods, rows_of


@print_anywhere
@dataclasses.dataclass(frozen=True)
class Congruency:
    """A test that several differences are 0 together: F, its degrees of freedom `rank` and
    `freedom` (ν), the probability of a larger one by chance."""

    f: float
    rank: int
    freedom: float

    @property
    def probability(self) -> float:
        return f_tail(self.f, self.rank, self.freedom)

    def __str__(self) -> str:
        return f"F = {self.f:.4g} ({self.rank}, {self.freedom:.0f}), p = {self.probability:.2g}"


@print_anywhere
@dataclasses.dataclass(frozen=True)
class AdjustmentComparison(TableMethods):
    """Two adjustments compared: one row an unknown that both have.

    - `kind` (camera, image, point), `id`, `parameter` and `unit` of every row;
    - `a` (after the similarity), `b`, `difference` b − a, `sigma` of the difference, `t`,
      `probability` of a larger |t| by chance, `differs`: whether it is significant; NaN and False
      where nothing is tested;
    - `similarity`: τ = (t, ω, s) from a to b (`geometry.similarity`), None where there is none, and
      `held_by`, the points it was found on;
    - `tests`: of all coordinates together ("points"), and of the parameters of each camera;
    - `shared`: image points that both have measured alike; if there are any nothing is tested;
    - `significance`: of all rows together (Šidák);
    - `modelled`: which of "a" and "b" have an error model: their σ are those under correlated
      errors.
    """

    kind: np.ndarray
    id: np.ndarray
    parameter: np.ndarray
    unit: np.ndarray
    a: Float[np.ndarray, " n"]
    b: Float[np.ndarray, " n"]
    difference: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    t: Float[np.ndarray, " n"]
    probability: Float[np.ndarray, " n"]
    differs: np.ndarray
    similarity: Float[np.ndarray, "7"] | None
    held_by: tuple[str, ...]
    tests: dict[str, Congruency]
    shared: int
    significance: float
    modelled: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.id)

    def table(self) -> dict[str, np.ndarray]:
        """Columns by name, one row an unknown."""
        names = (
            "kind",
            "id",
            "parameter",
            "unit",
            "a",
            "b",
            "difference",
            "sigma",
            "t",
            "probability",
            "differs",
        )
        return {name: getattr(self, name) for name in names}

    def to_dict(self) -> dict[str, Any]:
        """Rows and tests as plain dicts and numbers."""
        return {
            "unknowns": rows_of(self.table()),
            "similarity": None if self.similarity is None else self.similarity.tolist(),
            "held_by": list(self.held_by),
            "tests": {
                name: {
                    "f": test.f,
                    "rank": test.rank,
                    "freedom": test.freedom,
                    "probability": test.probability,
                }
                for name, test in self.tests.items()
            },
            "shared": self.shared,
            "significance": self.significance,
            "modelled": list(self.modelled),
        }

    def __repr__(self) -> str:
        return (
            f"<AdjustmentComparison of {count(len(self), 'unknown')}, "
            f"{int(self.differs.sum())} significantly different>"
        )

    def __str__(self) -> str:
        """What was compared, the tests, and the largest differences in σ."""
        number = lambda kind: len(set(self.id[self.kind == kind]))
        things = {kind: number(kind) for kind in ("camera", "image", "point")}
        counts_in_words = ", ".join(count(n, kind) for kind, n in things.items() if n)
        lines = [f"{counts_in_words} in common, {count(len(self), 'unknown')}"]
        if self.similarity is not None:
            lines.append(
                f"a was moved by a similarity found on {count(len(self.held_by), 'point')}"
                f": scale {np.exp(self.similarity[6]):.8g}"
            )
        if self.modelled:
            lines.append(f"σ under correlated errors of {' and '.join(self.modelled)}")
        if self.shared:
            lines.append(
                f"{count(self.shared, 'image point')} of both are the same measurements: "
                "the σ of differences are too large; nothing is tested"
            )
        lines += [f"{name}: {test}" for name, test in self.tests.items()]
        if not self.shared:
            lines.append(
                f"{int(self.differs.sum())} of {len(self)} differ significantly "
                f"({self.significance:g} for all together)"
            )
        sigma = np.where(self.sigma > 0, self.sigma, np.nan)
        ratio = np.abs(self.difference / sigma)
        rows = np.argsort(-ratio, kind="stable")[:12]  # half a screen; NaN (σ unknown) is last
        lines.append(f"{'':24}{'a':>16}{'b':>16}{'b − a':>12}{'σ':>11}{'b − a in σ':>11}")
        for k in rows:
            name = f"{self.parameter[k]} of {self.kind[k]} {self.id[k]}"
            in_sigma = fixed(float(ratio[k]), 2)
            lines.append(
                f"{name[:24]:24}{self.a[k]:16.8g}{self.b[k]:16.8g}{self.difference[k]:12.4g}"
                f"{self.sigma[k]:11.3g}{in_sigma:>11}{' *' * bool(self.differs[k])}"
            )
        if len(self) > len(rows):
            lines.append(
                f"and {count(len(self) - len(rows), 'unknown')} that differ by less of their σ"
            )
        return "\n".join(lines)


def compare(
    a: Adjustment,
    b: Adjustment,
    *,
    similarity: bool | None = None,
    held_by: Sequence[str] = (),
    significance: float = 0.05,
) -> AdjustmentComparison:
    """Compare two adjustments of cameras, images or points of the same names: two epochs of an
    object, two calibrations with their networks, or one network adjusted in two ways.

    **Arguments:**

    - `similarity`: whether coordinates are compared after a similarity (of seven parameters, or six
      if both networks have their own scale). Default: if the observations of one of them leave its
      datum open.
    - `held_by`: ids of the points it is found on, such as those known to be stable; default: all
      common points.
    - `significance`: the probability that any row is called different by chance.

    **Raises:** `InputError` if they have nothing in common, different units, or too few points for
    a similarity; `NotSolvedError` if one has no result.
    """
    for name, argument in (("a", a), ("b", b)):
        if not isinstance(argument, Adjustment):
            raise InputError(
                f"{name} must be an Adjustment, but is {show(argument)}: jaxbundle.adjust "
                "or jaxbundle.load_adjustment gives one"
            )
    if similarity not in (None, True, False):
        raise InputError(f"similarity must be True, False or None, but is {show(similarity)}")
    significance = number("significance", significance, "between 0 and 1", lambda x: 0 < x < 1)
    units = {
        "object_unit": (a.network.object_unit, b.network.object_unit),
        "image_unit": (a.image_unit, b.image_unit),
    }
    for name, (of_a, of_b) in units.items():
        if of_a != of_b:
            raise InputError(
                f"a and b differ in their {name}: {of_a!r} and {of_b!r}; "
                "compare networks in the same unit"
            )
    rows = common_rows(a, b)
    if similarity is None:
        similarity = len(rows.points) > 0 and bool(a.counts.datum or b.counts.datum)
    frames, tau, holding_points = (None, None), None, ()
    if similarity:
        holding_points = points_that_hold(rows.points, held_by)
        frames, tau = common_frames(a, b, holding_points)
    elif held_by:
        raise InputError("held_by: no similarity is estimated, so no points hold one")
    framed_a, framed_b = (
        FramedAdjustment(r, f, r.problem, b.problem) for r, f in zip((a, b), frames)
    )
    return _compare(a, b, framed_a, framed_b, rows, tau, holding_points, significance)


def _compare(
    a: Adjustment,
    b: Adjustment,
    framed_a: FramedAdjustment,
    framed_b: FramedAdjustment,
    rows: CommonRows,
    tau: Float[np.ndarray, "7"] | None,
    holding_points: tuple[str, ...],
    significance: float,
) -> AdjustmentComparison:
    # ω, φ, κ of both near those of b, so that a difference is never a whole turn.
    place = {id: k for k, id in enumerate(b.problem.network.images.id)}
    angles_of_b = b.image_values[[place[id] for id in rows.images], 3:].reshape(-1, 3)
    estimates = []
    for part in _portions(rows, _most_together(a, b)):
        angles = angles_of_b if part.images else np.zeros((0, 3))
        estimates.append((framed_a.estimate(part, angles), framed_b.estimate(part, angles)))
    x_a, x_b = (np.concatenate([pair[side][0] for pair in estimates]) for side in (0, 1))
    v_a, v_b = (
        np.clip(np.concatenate([np.diagonal(pair[side][1]) for pair in estimates]), 0, None)
        for side in (0, 1)
    )
    shared = _count_shared(a, b)
    table = _rows_of(b, rows, x_a, x_b, v_a, v_b)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(table["sigma"] > 0, table["difference"] / table["sigma"], np.nan)
        q = np.where(table["sigma"] > 0, v_a / (v_a + v_b), np.nan)
    p, tests = np.full(len(t), np.nan), {}
    if shared:
        # With common measurements the differences are smaller than their σ: no test would fail.
        t = np.full(len(t), np.nan)
    else:
        freedom = partial(_freedom, r=(a.redundancy, b.redundancy))
        p = np.array(
            [np.nan if np.isnan(x) else f_tail(x * x, 1, freedom(y)) for x, y in zip(t, q)]
        )
        C_a, C_b = (estimates[0][side][1] for side in (0, 1))
        tests = _test_together(
            x_b - x_a, C_a, C_b, rows, len(estimates) == 1, framed_a.frame, freedom
        )
    tested = np.zeros(0) if shared else table["sigma"]
    level = level_of_one(significance, int((tested > 0).sum()))
    return AdjustmentComparison(
        **table,
        t=t,
        probability=p,
        differs=np.nan_to_num(p, nan=1.0) < level,
        similarity=tau,
        held_by=holding_points,
        tests=tests,
        shared=shared,
        significance=significance,
        modelled=tuple(n for n, r in (("a", a), ("b", b)) if r.error_model is not None),
    )


def _test_together(
    d: Float[np.ndarray, " n"],
    C_a: Float[np.ndarray, "n n"],
    C_b: Float[np.ndarray, "n n"],
    rows: CommonRows,
    is_whole: bool,
    frame: CommonFrame | None,
    freedom: Callable[[float], float],
) -> dict[str, Congruency]:
    """The tests of each camera and of all points; of these only if all are in one portion,
    `is_whole`. The similarity of the frame has taken its parameters out of the points'
    differences."""
    tests = {}
    for camera in dict.fromkeys(id for id, _ in rows.cameras):
        positions = np.array([k for k, (id, _) in enumerate(rows.cameras) if id == camera])
        tests[f"camera {camera}"] = _congruency(d, C_a, C_b, positions, freedom)
    if is_whole and rows.points:
        positions = np.arange(len(rows.cameras) + 6 * len(rows.images), len(d))
        rank_lost = 0 if frame is None else int(np.asarray(frame.projection).any(1).sum())
        tests["points"] = _congruency(d, C_a, C_b, positions, freedom, rank_lost)
    return {name: test for name, test in tests.items() if test is not None}


def _most_together(a: Adjustment, b: Adjustment) -> int:
    """Points whose covariance is formed together. That of 500, of 1500 coordinates, has 18 MB and
    grows with the square of their number; under an error model the effects of all observations on
    them are formed, of 1 GB at most."""
    observations = [r.counts.observations for r in (a, b) if r.error_model is not None]
    return min(500, max(2**27 // (3 * max(observations, default=1)), 10))


def _portions(rows: CommonRows, most_together: int) -> list[CommonRows]:
    """The rows whose covariance is formed together: cameras and images with points; points of
    several portions have no common test."""
    step = most_together
    parts = [rows.points[k : k + step] for k in range(0, len(rows.points), step)] or [[]]
    return [
        dataclasses.replace(rows, points=parts[0]),
        *(CommonRows([], [], part) for part in parts[1:]),
    ]


def _rows_of(
    b: Adjustment,
    rows: CommonRows,
    x_a: Float[np.ndarray, " n"],
    x_b: Float[np.ndarray, " n"],
    v_a: Float[np.ndarray, " n"],
    v_b: Float[np.ndarray, " n"],
) -> dict:
    """Columns of the table: names, values in the units of b, σ of the differences."""
    images, points = len(rows.images), len(rows.points)
    kind = ["camera"] * len(rows.cameras) + ["image"] * 6 * images + ["point"] * 3 * points
    id = [c for c, _ in rows.cameras] + np.repeat(rows.images, 6).tolist()
    name = [p for _, p in rows.cameras] + [*EXTERIOR] * images + [*"XYZ"] * points
    unit = [""] * len(rows.cameras)
    length, angle = b.network.object_unit, b.network.angle_unit
    unit += ([length] * 3 + [angle] * 3) * images + [length] * 3 * points
    scale = np.ones(len(kind))
    scale[np.isin(name, EXTERIOR[3:]) & (np.array(kind) == "image")] = b.angle_scale
    origin = np.zeros(len(kind))
    cameras = len(rows.cameras)
    pose = np.concatenate([b.problem.origin, np.zeros(3)])
    origin[cameras:] = np.concatenate([np.tile(pose, images), np.tile(b.problem.origin, points)])
    column = lambda values: np.array(values, dtype=object)
    return {
        "kind": column(kind),
        "id": column(id + np.repeat(rows.points, 3).tolist()),
        "parameter": column(name),
        "unit": column(unit),
        "a": (x_a + origin) * scale,
        "b": (x_b + origin) * scale,
        "difference": (x_b - x_a) * scale,
        "sigma": np.sqrt(v_a + v_b) * scale,
    }


def _congruency(
    d: Float[np.ndarray, " n"],
    C_a: Float[np.ndarray, "n n"],
    C_b: Float[np.ndarray, "n n"],
    positions: Int[np.ndarray, " k"],
    freedom: Callable[[float], float],
    rank_lost: int = 0,
    null: float = 1e-9,
) -> Congruency | None:
    """The test that these differences are 0 together; None where nothing is free. `rank_lost`: the
    rank removed by a similarity; `null`: eigenvalues of the correlation matrix below this part of
    the largest are 0. Rounding of propagated covariances is about 1e-12 of it, combinations that
    the observations determine are far above."""
    C_a, C_b = C_a[np.ix_(positions, positions)], C_b[np.ix_(positions, positions)]
    diagonal = np.diagonal(C_a + C_b)
    free = diagonal > 0
    if not free.any():
        return None
    D = 1 / np.sqrt(diagonal[free])
    scaled = lambda C: D[:, None] * C[np.ix_(free, free)] * D
    values, vectors = np.linalg.eigh(scaled(C_a + C_b))
    # The eigenvalues that belong to the similarity are the smallest, and 0 but for rounding; they
    # are counted out by number, since rounding may exceed `null` in a large network.
    is_determined = (values > null * values[-1]) & (np.arange(len(values)) >= rank_lost)
    whitened = (vectors[:, is_determined] / np.sqrt(values[is_determined])).T
    rank = int(is_determined.sum())
    f = float(((whitened @ (D * d[positions][free])) ** 2).sum() / rank)
    part = float(np.trace(whitened @ scaled(C_a) @ whitened.T) / rank)
    return Congruency(f, rank, freedom(part))


def _freedom(part: float, r: tuple[int, int]) -> float:
    """Welch's degrees of freedom of a sum of two variances, the first of which is `part`."""
    return 1 / (part**2 / r[0] + (1 - part) ** 2 / r[1])


def _count_shared(a: Adjustment, b: Adjustment) -> int:
    """Image points that both adjustments have with the same coordinates."""
    # To the last digit: two measurements of a point in one photograph are never equal.

    def measured(r: Adjustment) -> set[tuple[str, str, float, float]]:
        network, observations = r.problem.network, r.problem.network.observations
        images, points = network.images.id, network.points.id
        return {
            (images[i], points[p], x, y)
            for i, p, (x, y) in zip(
                observations.image.tolist(), observations.point.tolist(), observations.xy.tolist()
            )
        }

    return len(measured(a) & measured(b))
