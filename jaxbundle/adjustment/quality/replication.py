"""Replication: a network in two halves that share no image point, each adjusted alone.

The difference of an unknown of both halves has a covariance that follows from all observations,

    δ = D·e,   D = D₁ − D₂,   C = D·Σ·Dᵀ,   d² = δᵀC⁻¹δ

with d²/n about 1 where Σ is right (Helmert's replication; Förstner and Wrobel 2016, section 4.6).
Observations that both halves need, such as control, cancel by this. With the Σ of independent
errors d² shows how much too small classical σ are, with that of the error model whether it holds.

A half is the problem of the whole network, in which the image points of the other half keep σ that
are 1000 times larger (`FAINT`): what only they determine stays determined, so that the plan and all
compiled programs are those of the whole network, and they add 1e-6 of their information to the
half. Its adjustment is one Gauss-Newton step from the solution of the whole, with the residuals v
there,

    x₁ = x̂ − D₁·v

A half moves by a few σ, over which the observations are nearly linear: iterated, halves of six
photographs end within 0.05 σ of it. And it has an answer where iterations have none, as in halves
of a block that fall into parts.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares import problem as engine
from jaxbundle.leastsquares.quality.correlation import squared_difference
from jaxbundle.leastsquares.quality.distributions import chi2_tail
from jaxbundle.leastsquares.quality.error_components import ErrorModel
from jaxbundle.leastsquares.quality.error_effects import effects, stack_rows
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.columns import count
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.tables import Network
from jaxbundle.report.correlated import (
    DIFFERENCE_HEADER,
    REPLICATION_LEGEND,
    difference_rows,
    not_looked_for,
)
from jaxbundle.report.layout import heading, paragraph, table
from jaxbundle.results import TableMethods, rows_of

# Image points of a photograph in a half: four determine its orientation, as many are redundant.
MIN_RAYS_OF_IMAGE = 8
# Photographs of a camera in a half: two hardly determine an interior orientation.
MIN_IMAGES = 3
# Factor of the weights 1/σ of image points of the other half: its square, 1e-6, is far below the
# share of a half in the information on a camera. The images of the other half keep pivots of this
# size, times those of the conditions of a rig, 1e-6, above `PIVOT`, 1e-13.
FAINT = 1e-3
# Simulations at once: 80 MB of errors for 100 000 rows.
PORTION = 100


@dataclasses.dataclass(frozen=True)
class HalvesDifference:
    """Differences of the interior orientation of two halves, with their covariances: classical, of
    independent errors with the σ0 of the whole network, and of its error model (None without)."""

    names: tuple[tuple[str, str], ...]
    difference: Float[np.ndarray, " n"]
    classical: Float[np.ndarray, "n n"]
    correlated: Float[np.ndarray, "n n"] | None

    @property
    def sigma(self) -> Float[np.ndarray, " n"]:
        """Classical σ of the differences."""
        return np.sqrt(np.diag(self.classical))

    @property
    def sigma_correlated(self) -> Float[np.ndarray, " n"]:
        """σ of the differences by the error model; NaN without."""
        if self.correlated is None:
            return np.full(len(self.names), np.nan)
        return np.sqrt(np.diag(self.correlated))

    @property
    def d2(self) -> float:
        """δᵀC⁻¹δ of the classical covariance."""
        return squared_difference(self.difference, self.classical)

    @property
    def d2_correlated(self) -> float:
        """δᵀC⁻¹δ of the covariance of the error model; NaN without."""
        if self.correlated is None:
            return float("nan")
        return squared_difference(self.difference, self.correlated)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Replication(TableMethods):
    """The result of `replicate`: `by` what the halves were formed, the difference of each split,
    the error `model` of the whole network, and splits that could not be adjusted, with the
    reason; `band`: in which the mean d²/n of the covariance of the error model lies with 95 % if
    the model holds, from simulated errors (None where they were not simulated); `image_unit`: that
    of the components."""

    by: str
    splits: tuple[HalvesDifference, ...]
    failed: tuple[str, ...]
    model: ErrorModel | None
    band: tuple[float, float] | None = None
    image_unit: str = "px"

    @property
    def dof(self) -> int:
        """Compared parameters of a split."""
        return max((len(split.names) for split in self.splits), default=0)

    @property
    def d2(self) -> float:
        """The mean d² of the classical covariance; NaN without a split."""
        return self.dof * self.ratio

    @property
    def d2_correlated(self) -> float:
        """The mean d² of the covariance of the error model; NaN without."""
        return self.dof * self.ratio_correlated

    @property
    def ratio(self) -> float:
        """The mean d²/n of the classical covariance; 1 where it is right."""
        return _mean(split.d2 / len(split.names) for split in self.splits)

    @property
    def ratio_correlated(self) -> float:
        """The mean d²/n of the covariance of the error model."""
        return _mean(split.d2_correlated / len(split.names) for split in self.splits)

    @property
    def probability(self) -> float:
        """That halves differ by as much by chance, by the error model, or by the classical
        covariance without one (χ² of a split; the largest of several is not tested)."""
        d2 = self.d2 if self.model is None else self.d2_correlated
        return chi2_tail(d2, self.dof) if np.isfinite(d2) else float("nan")

    @property
    def sentence(self) -> str:
        """The factor in words; why there is none."""
        parts = "several jobs" if self.by == "jobs" else f"two halves of the {self.by}"
        if not self.splits:
            return f"{parts} cannot be compared: {'; '.join(self.failed)}"
        beginning = f"cameras from {parts} differ by {np.sqrt(self.ratio):.2f} classical σ"
        if self.model is not None:
            beginning += f", by {np.sqrt(self.ratio_correlated):.2f} σ under correlated errors"
        # As times of σ, the root of d²/n; the quantiles of a root are the roots of the quantiles.
        low, high = (1.0, 1.0) if self.band is None else np.sqrt(self.band)
        expected = f"{low:.2f} to {high:.2f}" if low < high else "1"
        return f"{beginning} (RMS of {count(self.dof, 'parameter')}; {expected} expected)"

    def table(self) -> dict[str, np.ndarray]:
        """One row a parameter of a split: columns split, camera, parameter, difference, sigma,
        sigma_correlated."""
        rows = []
        for number, split in enumerate(self.splits, 1):
            columns = (split.names, split.difference, split.sigma, split.sigma_correlated)
            for (camera, name), d, s, m in zip(*columns):
                rows.append((number, camera, name, float(d), float(s), float(m)))
        columns = zip(*rows) if rows else [()] * 6
        names = ("split", "camera", "parameter", "difference", "sigma", "sigma_correlated")
        return {name: np.array(column) for name, column in zip(names, columns)}

    def brief(self) -> dict[str, Any]:
        """`by`, the compared parameters `dof` of a split, and the means of `d2`, `d2_correlated`
        over the splits, with those of each, and the interval in which the latter is `expected`: as
        in the JSON of an adjustment."""
        return {
            "by": self.by,
            "dof": self.dof,
            "d2": self.d2,
            "d2_correlated": self.d2_correlated,
            "expected": None if self.band is None else [self.dof * d2 for d2 in self.band],
            "splits": [
                {"d2": split.d2, "d2_correlated": split.d2_correlated} for split in self.splits
            ],
            "failed": list(self.failed),
        }

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON."""
        return self.brief() | {
            "error_components": []
            if self.model is None
            else [size.to_dict(self.image_unit) for size in self.model.sizes],
            "parameters": rows_of(self.table()),
        }

    def __str__(self) -> str:
        number = count(len(self.splits), "split")
        title = f"Halves by {self.by}: {number}"
        if self.by == "jobs":
            title = f"Jobs of one camera: {count(len(self.splits), 'pair')}"
        lines = [
            f"{title}, {count(self.dof, 'parameter')}; d²/n: square of their difference in σ, 1 "
            "where σ are right",
            f"d²/n with classical σ              {self.ratio:.2f}",
        ]
        if self.model is not None:
            lines.append(f"d²/n with σ of correlated errors   {self.ratio_correlated:.2f}")
        if self.band is not None:
            low, high = self.band
            lines.append(f"expected of these, with 95 %       {low:.2f} to {high:.2f}")
        if self.model is not None and (lacking := not_looked_for(self.model)):
            lines.append(lacking)
        return "\n".join([*lines, *(f"not adjusted: {why}" for why in self.failed)])

    def report(self) -> str:
        """The summary, every split, and the differences of its parameters."""
        lines = [*str(self).splitlines()]
        for number, split in enumerate(self.splits, 1):
            n = len(split.names)
            title = f"Split {number}: d²/n {split.d2 / n:.2f} with classical σ"
            if split.correlated is not None:
                title += f", {split.d2_correlated / n:.2f} with those of correlated errors"
            rows = difference_rows(split)
            lines += ["", *heading(title), *table(DIFFERENCE_HEADER, rows, "lrrrrr")]
        lines += ["", *paragraph(REPLICATION_LEGEND)]
        return "\n".join(lines)


def _mean(values: Iterator[float]) -> float:
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else float("nan")


def random_halves(
    network: Network, by: str, repeat: int, seed: int
) -> Iterator[Bool[np.ndarray, " rays"]]:
    """Which image points belong to the second half, for every split. Simultaneous photographs of a
    rig stay together: only they determine its mountings."""
    rng, rays = np.random.default_rng(seed), network.observations
    exposure = _exposures(network)
    if by == "runs":
        # Of each camera by itself: photographs of several may follow each other.
        camera, is_later = network.images.camera, np.zeros(len(network.images), bool)
        for c in np.unique(camera):
            images_of_camera = np.flatnonzero(camera == c)
            times = exposure[images_of_camera]
            is_later[images_of_camera] = times >= np.sort(times)[len(images_of_camera) // 2]
        yield is_later[rays.image]
        return
    number, group_of_ray = len(network.points), rays.point
    if by != "points":
        number, group_of_ray = int(exposure.max(initial=-1)) + 1, exposure[rays.image]
    for _ in range(repeat):
        yield (rng.permutation(number) % 2 == 1)[group_of_ray]


def _exposures(network: Network) -> Int[np.ndarray, " images"]:
    """The number of the exposure of every image, in their order: one of simultaneous images."""
    epoch_of: dict[str, tuple[str, str]] = {}
    for rigs in network.further:
        if isinstance(rigs, Rigs):
            epoch_of |= dict(zip(rigs.image, zip(rigs.rig, rigs.epoch)))
    number: dict[Any, int] = {}
    keys = [epoch_of.get(id, (id,)) for id in network.images.id]
    return np.array([number.setdefault(key, len(number)) for key in keys], int)


def compare_halves(
    solution: Solution,
    problem: NetworkProblem,
    in_second: Bool[np.ndarray, " rays"],
    model: ErrorModel | None,
) -> HalvesDifference:
    """The interior orientations of two halves of a solved network, each adjusted alone.

    **Arguments:** `in_second`: the image points of the second half; `model`: of the errors of the
    whole network.

    **Raises:** `NotSolvedError` if a half has too few photographs, or is not determined.
    """
    return difference_of(solution, *effects_of_halves(solution, problem, in_second), model)


def difference_of(
    solution: Solution,
    names: tuple[tuple[str, str], ...],
    effects: Float[np.ndarray, "n rows"],
    model: ErrorModel | None,
) -> HalvesDifference:
    """The difference of two halves from its `effects_of_halves`."""
    correlated = None if model is None else model.of_effects(effects)
    difference = -effects @ stack_rows(solution, solution.residuals)
    return HalvesDifference(names, difference, solution.sigma0**2 * effects @ effects.T, correlated)


def effects_of_halves(
    solution: Solution, problem: NetworkProblem, in_second: Bool[np.ndarray, " rays"]
) -> tuple[tuple[tuple[str, str], ...], Float[np.ndarray, "n rows"]]:
    """Camera and name of the parameters that both halves determine, and D of their differences: the
    effects of one σ of every observation.

    **Raises:** `NotSolvedError` as `compare_halves`."""
    halves = [problem.used & ~in_second, problem.used & in_second]
    names = compared_parameters(problem, halves)
    if not names:
        raise NotSolvedError(
            f"no camera has {MIN_IMAGES} photographs with {MIN_RAYS_OF_IMAGE} image points in both"
        )
    D = []
    for keep in halves:
        scale = np.where(keep, 1.0, FAINT)[:, None]
        data = problem.with_image_weights(problem.data, problem.image_weights * scale)
        half = engine.with_data(problem, data)
        half_solution = Solution(half, solution.values)
        if not half_solution.determined:
            raise NotSolvedError("a half does not determine its unknowns")
        of_half = effects(half_solution, _unit_rows(problem, names))
        D.append(of_half * _row_scale(solution, problem, scale))
    return tuple((camera, name) for camera, name, _ in names), D[0] - D[1]


def expected_band(
    model: ErrorModel,
    effects: Sequence[Float[np.ndarray, "n rows"]],
    draws: int = 400,
    seed: int = 0,
) -> tuple[float, float]:
    """The interval in which the mean d²/n of some splits lies with 95 % if the error model holds:
    errors drawn from it, with the sizes estimated again from each draw.

    **Arguments:** `effects`: D of the difference of each split; `draws`: the quantile of 2.5 % of
    400 is the tenth value, known to 7 % of its distance from the mean (of a normal
    distribution)."""
    rng = np.random.default_rng(seed)
    parts = [model.parts_of(D) for D in effects]
    ratios = []
    for begin in range(0, draws, PORTION):
        errors, theta = model.draw(min(PORTION, draws - begin), rng)
        of_splits = [
            [
                squared_difference(D @ e, np.tensordot(t, C, 1)) / len(D)
                for D, C in zip(effects, parts)
            ]
            for e, t in zip(errors, model.widening * theta)
        ]
        ratios += np.mean(of_splits, 1).tolist()
    low, high = np.quantile(ratios, [0.025, 0.975])
    return float(low), float(high)


def compared_parameters(
    problem: NetworkProblem, halves: list[Bool[np.ndarray, " rays"]]
) -> list[tuple[str, str, tuple[Any, int, int]]]:
    """Camera and name of the free parameters of the cameras that are in both halves; their table,
    row, and column among the unknowns of the row."""
    compared = []
    for c, camera in enumerate(problem.network.cameras):
        rays = [
            np.bincount(problem.image[keep & (problem.camera == c)]) >= MIN_RAYS_OF_IMAGE
            for keep in halves
        ]
        if min(of_half.sum() for of_half in rays) < MIN_IMAGES:
            continue
        table, row = problem.table_of_camera(c)
        parameters, free = problem.free_parameters(c)
        compared += [(camera.id, parameters[k], (table, row, int(k))) for k in free]
    return compared


def _unit_rows(
    problem: NetworkProblem, names: list[tuple[str, str, tuple[Any, int, int]]]
) -> dict[str, Float[np.ndarray, "n rows width"]]:
    """One for the parameter of each name, by table."""
    rows: dict[str, np.ndarray] = {}
    for n, (*_, (of_camera, row, k)) in enumerate(names):
        declared_table = problem.table(of_camera.name)
        rows.setdefault(
            of_camera.name, np.zeros((len(names), declared_table.rows, declared_table.space.width))
        )
        rows[of_camera.name][n, row, k] = 1.0
    return rows


def _row_scale(
    solution: Solution, problem: NetworkProblem, scale: Float[np.ndarray, "rays 1"]
) -> Float[np.ndarray, " rows"]:
    """σ of the whole network over those of a half, of all rows of observations."""
    by_set = {o.name: np.ones_like(solution.residuals[o.name]) for o in problem.observations}
    for name, rays in problem.image_rows.items():
        by_set[name] = by_set[name] * scale[rays]
    return np.concatenate([by_set[o.name].ravel() for o in problem.observations])
