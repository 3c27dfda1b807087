"""Replication: a network in two halves that share no image point, each adjusted alone.

The difference of an unknown of both halves has a covariance that follows from all observations,

    δ = D·e,   D = D₁ − D₂,   C = D·Σ·Dᵀ,   d² = δᵀC⁻¹δ

with d²/n about 1 where Σ is right (Helmert's replication; Förstner and Wrobel 2016, section 4.6).
Observations that both halves need, such as control, cancel by this. With the Σ of independent
errors d² shows how much too small classical σ are, with that of the error model whether it holds.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS as CORRELATIONS
from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings, correlated_errors
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import REPLICATION
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.formats import as_network
from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.leastsquares.quality.correlation import squared_difference
from jaxbundle.leastsquares.quality.error_components import ErrorModel, effects, first_rows
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.columns import count
from jaxbundle.network.sightings import keep_images, keep_points
from jaxbundle.network.tables import Network
from jaxbundle.report.layout import heading, paragraph, significant, table
from jaxbundle.results import TableMethods, rows_of
from jaxbundle.types import Progress

MIN_RAYS_OF_IMAGE = 8
"""Image points of a photograph in a half: four determine its orientation, as many are redundant."""
MIN_IMAGES = 3
"""Photographs of a half: two determine no interior orientation."""


LEGEND = (
    "Differences of the interior orientations of two halves that share no image point. d² is their "
    "square over its covariance; the mean of d²/n is 1 where σ are right. Halves by photographs of "
    "one camera share the remainder of its lens model, halves by points all that belongs to "
    "photographs: they cannot show these errors."
)


@dataclasses.dataclass(frozen=True)
class Difference:
    """Differences of the interior orientation of two halves, with their covariances: classical, of
    independent errors with the σ0 of the whole network, and of its error model (None without)."""

    names: tuple[tuple[str, str], ...]
    difference: Float[np.ndarray, " n"]
    classical: Float[np.ndarray, "n n"]
    correlated: Float[np.ndarray, "n n"] | None

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
    reason."""

    by: str
    splits: tuple[Difference, ...]
    failed: tuple[str, ...]
    model: ErrorModel | None

    @property
    def dof(self) -> int:
        """Compared parameters of a split."""
        return max((len(split.names) for split in self.splits), default=0)

    @property
    def ratio(self) -> float:
        """The mean d²/n of the classical covariance; 1 where it is right."""
        return float(np.mean([split.d2 / len(split.names) for split in self.splits]))

    @property
    def ratio_correlated(self) -> float:
        """The mean d²/n of the covariance of the error model."""
        return float(np.mean([split.d2_correlated / len(split.names) for split in self.splits]))

    def table(self) -> dict[str, np.ndarray]:
        """One row a parameter of a split: columns split, camera, parameter, difference, sigma,
        sigma_correlated."""
        rows = []
        for number, split in enumerate(self.splits, 1):
            classical = np.sqrt(np.diag(split.classical))
            other = split.correlated
            correlated = (
                np.full(len(classical), np.nan) if other is None else np.sqrt(np.diag(other))
            )
            for (camera, name), d, s, m in zip(
                split.names, split.difference, classical, correlated
            ):
                rows.append((number, camera, name, float(d), float(s), float(m)))
        columns = zip(*rows) if rows else [()] * 6
        names = ("split", "camera", "parameter", "difference", "sigma", "sigma_correlated")
        return {name: np.array(column) for name, column in zip(names, columns)}

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON."""
        return {
            "by": self.by,
            "dof": self.dof,
            "d2": [split.d2 for split in self.splits],
            "d2_correlated": [split.d2_correlated for split in self.splits],
            "error_components": []
            if self.model is None
            else [size._asdict() for size in self.model.sizes],
            "parameters": rows_of(self.table()),
            "failed": list(self.failed),
        }

    def __str__(self) -> str:
        number = count(len(self.splits), "split")
        lines = [
            f"Halves by {self.by}: {number}, {count(self.dof, 'parameter')}",
            f"d²/n with classical σ              {self.ratio:.2f}",
        ]
        if self.model is not None:
            lines.append(f"d²/n with σ of correlated errors   {self.ratio_correlated:.2f}")
        return "\n".join([*lines, *(f"not adjusted: {why}" for why in self.failed)])

    def report(self) -> str:
        """The summary, every split, and the differences of its parameters."""
        lines = [*str(self).splitlines()]
        for number, split in enumerate(self.splits, 1):
            n, classical = len(split.names), np.sqrt(np.diag(split.classical))
            title = f"Split {number}: d²/n {split.d2 / n:.2f} with classical σ"
            correlated = np.full(n, np.nan)
            if split.correlated is not None:
                correlated = np.sqrt(np.diag(split.correlated))
                title += f", {split.d2_correlated / n:.2f} with those of correlated errors"
            rows = [
                (
                    f"{camera} {name}",
                    significant(d, 3),
                    significant(s, 2),
                    f"{d / s:.1f}",
                    significant(m, 2),
                    f"{d / m:.1f}",
                )
                for (camera, name), d, s, m in zip(
                    split.names, split.difference, classical, correlated
                )
            ]
            header = ("parameter", "difference", "σ", "in σ", "σ correlated", "in it")
            lines += ["", *heading(title), *table(header, rows, "lrrrrr")]
        lines += ["", *paragraph(LEGEND)]
        return "\n".join(lines)


def replicate(
    given: Adjustment | Network | str | Path,
    *,
    by: str = "photographs",
    repeat: int = 1,
    seed: int = 0,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    snooping: str | None = None,
    settings: CorrelationSettings = CORRELATIONS,
    progress: Progress | None = None,
) -> Replication:
    """Adjust disjoint halves of a network and compare the interior orientations they give.

    **Arguments:**

    - `given`: a result; or a network, or the path of one (`format`, `overrides` and `control` as of
      `jaxbundle.read_network`), which is adjusted first, with `snooping` as of `jaxbundle.adjust`.
    - `by`: `"points"`, `"photographs"` (of calibrations also called `"views"`): random halves;
      `"runs"`: the first half of the photographs, in their order, against the second.
    - `repeat`: number of random splits; runs have one. `seed`: of them.
    - `settings`: of the error components.
    - `progress(stage, done, total)`: called before every split.

    **Raises:** `InputError` for too few photographs; `NotSolvedError` if the network or no pair of
    halves can be adjusted.
    """
    one_of("by", by, REPLICATION)
    repeat = 1 if by == "runs" else integer("repeat", repeat, least=1)
    seed = integer("seed", seed, least=0)
    if not isinstance(given, Adjustment):
        known = as_network(given, format=format, overrides=overrides, control=control)
        given = adjust(known, snooping=snooping)
    network = readjustable_network(given)
    if len(network.images) < 2 * MIN_IMAGES and by != "points":
        raise InputError(
            f"{len(network.images)} photographs: halves of them need {2 * MIN_IMAGES} or more; "
            'halves by "points" can be made'
        )
    if not any(given.camera_covariance(camera.id)[0] for camera in network.cameras):
        raise InputError("no camera has a free parameter: there is nothing to compare")
    model = correlated_errors(given.cofactors.solution, given.problem, settings)
    splits, failed = [], []
    for number, second in enumerate(_splits(network, by, repeat, seed)):
        if progress is not None:
            progress("adjusting halves", number, repeat)
        try:
            halves = [_half(network, rays) for rays in (~second, second)]
            alone = [adjust(half) for half, _ in halves]
            if not all(one.converged for one in alone):
                raise NotSolvedError("a half did not converge")
            splits.append(_difference(given, model, alone, [rays for _, rays in halves]))
        except (InputError, NotSolvedError) as error:
            failed.append(f"split {number + 1}: {error}")
    if not splits:
        raise NotSolvedError(f"no halves of the network can be adjusted alone: {failed[0]}")
    return Replication(by, tuple(splits), tuple(failed), model)


def _splits(
    network: Network, by: str, repeat: int, seed: int
) -> Iterator[Bool[np.ndarray, " rays"]]:
    """Which image points belong to the second half, for every split."""
    rng, rays = np.random.default_rng(seed), network.observations
    if by == "runs":
        yield rays.image >= len(network.images) // 2
        return
    number, of = (
        (len(network.points), rays.point) if by == "points" else (len(network.images), rays.image)
    )
    for _ in range(repeat):
        yield (rng.permutation(number) % 2 == 1)[of]


def _half(
    network: Network, keep: Bool[np.ndarray, " rays"]
) -> tuple[Network, Int[np.ndarray, " rays"]]:
    """The network of some image points, without what they do not determine, and their rows in the
    whole network."""
    rays, tie = network.observations, network.points.has_role("tie")
    rows = np.flatnonzero(keep)
    while True:
        of_image = np.bincount(rays.image[rows], minlength=len(network.images))
        of_point = np.bincount(rays.point[rows], minlength=len(network.points))
        good = (of_image[rays.image[rows]] >= MIN_RAYS_OF_IMAGE) & (
            (of_point[rays.point[rows]] > 1) | ~tie[rays.point[rows]]
        )
        if good.all():
            break
        rows = rows[good]
    half = network.replace(observations=rays.take(np.isin(np.arange(len(rays)), rows)))
    half = keep_images(half, of_image > 0)
    if len(half.images) < MIN_IMAGES:
        raise InputError(f"a half has {len(half.images)} photographs")
    half = keep_points(half, (of_point > 0) | ~tie).replace(datum_points=())
    return half, rows


def _difference(
    result: Adjustment,
    model: ErrorModel | None,
    alone: list[Adjustment],
    rows: list[Int[np.ndarray, " rays"]],
) -> Difference:
    names = [
        (camera.id, name)
        for camera in result.problem.network.cameras
        for name in result.camera_covariance(camera.id)[0]
        if all(name in _free_in(one, camera.id) for one in alone)
    ]
    values = [np.array([one.camera_parameters(c)[n] for c, n in names]) for one in alone]
    whole = result.inspection.solution
    number = sum(np.asarray(v).size for v in whole.residuals.values())
    D = np.zeros((len(names), number))
    extra = []
    # the image points that the readjustable network took over
    used = np.flatnonzero(result.problem.used)
    for sign, one, of in zip((1, -1), alone, rows):
        found = one.inspection.solution
        mine = effects(found, _unit_rows(one, found, names))
        rest = _add_rows(D, sign, mine, result, one, used[of])
        extra.append(rest)
    white = whole.sigma0**2 * (D @ D.T + sum(x @ x.T for x in extra))
    correlated = None
    if model is not None:
        correlated = model.theta[0] * (D @ D.T) + sum(x @ x.T for x in extra)
        for theta, component in zip(model.theta[1:], model.components):
            if theta > 0:
                B = np.asarray(component.root.T @ D.T)
                correlated = correlated + theta * B.T @ B
    return Difference(tuple(names), values[0] - values[1], white, correlated)


def _free_in(one: Adjustment, camera: str) -> list[str]:
    known = [c.id for c in one.problem.network.cameras]
    return one.camera_covariance(camera)[0] if camera in known else []


def _unit_rows(
    one: Adjustment, found: Solution, names: list[tuple[str, str]]
) -> dict[str, Float[np.ndarray, "n rows width"]]:
    """One for the parameter of each name, by table."""
    rows = {t.name: np.zeros((len(names), t.rows, t.space.width)) for t in found.problem.tables}
    order = [camera.id for camera in one.problem.network.cameras]
    for k, (camera, name) in enumerate(names):
        table, row = one.problem.table_of_camera(order.index(camera))
        rows[table.name][k, row, table.parameters.index(name)] = 1.0
    return rows


def _add_rows(
    D: Float[np.ndarray, "n rows"],
    sign: int,
    mine: Float[np.ndarray, "n rows"],
    result: Adjustment,
    one: Adjustment,
    rays: Int[np.ndarray, " rays"],
) -> Float[np.ndarray, "n rest"]:
    """Add the effects of a half's observations to those of the whole network; returns those of
    observations that have no row there."""
    whole, half = result.inspection.solution, one.inspection.solution
    into, out = first_rows(whole), first_rows(half)
    place = np.full(len(result.problem.image), -1)
    set_of = {}
    for name, of in result.problem.image_rows.items():
        place[of] = into[name] + 2 * np.arange(len(of))
        set_of[name] = of
    rest = []
    for o in half.problem.observations:
        n, r = np.asarray(half.residuals[o.name]).shape
        block = mine[:, out[o.name] : out[o.name] + n * r]
        if o.name in one.problem.image_rows:
            at = place[rays[one.problem.image_rows[o.name]]]
            for axis in range(2):
                D[:, at + axis] += sign * block[:, axis::2]
        elif o.name in whole.residuals and np.asarray(whole.residuals[o.name]).shape == (n, r):
            D[:, into[o.name] : into[o.name] + n * r] += sign * block
        else:
            rest.append(block)
    return np.concatenate([np.zeros((len(D), 0)), *rest], 1)
