"""Control points and satellite positions in the adjustment of a reconstruction.

1. The block is adjusted without control (`adjusting`), in the system of the satellite positions or
   in an arbitrary one; without positions the similarity that fits most of the control moves it.
2. Every control point is intersected from its rays. A ray that misses the point of the others is a
   wrong measurement; if it ends at another control point of its photograph, a wrong name.
3. The intersected points are compared with the given coordinates by leave-one-out prediction
   (`orientation.control_consistency`), which estimates the σ of control where none is given.
4. Everything is adjusted together: control with its σ, satellite positions with theirs and an
   offset between the two systems. Check points are intersected and compared; control that
   contradicts the rest is compared as tie points.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.bundle.result import Adjustment
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.leastsquares.any_distance import derivative
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.further import Antennas, ExteriorPriors
from jaxbundle.network.sightings import keep_points
from jaxbundle.network.tables import Distances, Network, Points, Source
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation import many
from jaxbundle.orientation.alignment import similarity_of_most
from jaxbundle.orientation.control_consistency import Assessment, Discrepancies, assess
from jaxbundle.orientation.sights import ideal_points
from jaxbundle.reconstruction.adjusting import Weighted, adjust_determined
from jaxbundle.reconstruction.block import camera_positions
from jaxbundle.reconstruction.control_table import ControlPoint, ControlTable, describe_sigma
from jaxbundle.reconstruction.named import Named
from jaxbundle.types import present

OFFSET, OFFSET_HEIGHT = 10.0, 100.0
"""Prior σ of the offset between satellite positions and control, metres: in the plane the error
common to the code solutions of one flight; in height geoid undulations reach 107 m (EGM2008)."""
WRONG = 5.0
"""A ray that misses its point by more, in σ of the measurement, is a wrong measurement."""
ASSUMED = 2.0
"""σ of control that its residuals do not determine, and the smallest estimated one, in pixels on
the ground: what is marked and identified in photographs is hardly more exact, unless it is stated.
"""
CONTRADICTORY_HEIGHTS = 3.0
"""Heights that are all 0 are unknown if the heights of the block differ by more, in σ."""
COMPARED_TOGETHER, PAIRED_RAYS = 100, 8
"""Largest number of control points with a joint covariance, and of rays of one point of which every
pair is tried: 28 pairs."""
ENOUGH_CONTROL = 3
"""Minimum control points of a block without satellite positions."""


@dataclasses.dataclass(frozen=True)
class Given:
    """What is given about the frame: control and check `points` with `named` measurements
    (photographs by their row in `names`), the `system` of their coordinates; satellite `positions`
    [photographs, 3] and their σ in this system, NaN: unknown."""

    points: Points
    named: Named
    names: tuple[str, ...]
    system: str = ""
    positions: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]] | None = None


@dataclasses.dataclass(frozen=True)
class Measured:
    """The measurements of one point in oriented photographs: rows of `Named`, of the network's
    images; directions as unit vectors in object space; the angle of a pixel along each; σ, pixels;
    whether each agrees with the point, and the point intersected from those."""

    rows: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    rays: Float[np.ndarray, "n 3"]
    pixel: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    good: Bool[np.ndarray, " n"]
    position: Float[np.ndarray, "3"]


def georeference(
    found: Weighted, given: Given, significance: float, tell: Callable[[str], None]
) -> tuple[Weighted, ControlTable]:
    """The adjustment with control and positions, and the table of control and check points.

    **Raises:** `InputError` or `NotSolvedError` if control does not determine the frame.
    """
    tell("control points")
    block = _Block(found.adjustment, given)
    measured = block.resolve()
    control, heights = _without_unknown_heights(block)
    usable = [k for k, id in enumerate(control.id)
              if control.role[k] != "check" and block.is_determined(id, measured[id])]
    if not block.has_positions:
        block.move(usable, control)
        measured = block.resolve()
    pixel = block.ground_sample_distance
    usable, assessed = _assess_all(block, control, usable, ASSUMED * pixel)
    choice = _choose(block, control, measured, usable, assessed, ASSUMED * pixel)
    if not block.has_positions and choice.used.sum() < ENOUGH_CONTROL:
        raise InputError(
            f"expected {ENOUGH_CONTROL} control points without contradictions, got "
            f"{choice.used.sum()}: " + list_some((f"{id}: {why}" for id, why in
                                                  choice.why.items()), 5, str)
        )  # fmt: skip
    doubtful = [pair for pair in block.removed() if pair[1] not in control.id]
    result, _, _ = adjust_determined(
        block.with_control(control, choice), snooping="pope", significance=significance,
        doubtful=doubtful,
    )  # fmt: skip
    if not result.converged:
        raise NotSolvedError(f"with control: {result.termination}", list(result.undetermined))
    used = (np.asarray(result.problem.data.image_weight) > 0).any(1)
    fixed = [id for id, role in zip(control.id, control.role) if role == "fixed"]
    free = np.array([role == "control" for role in control.role])
    words = describe_sigma(control.sigma[free], choice.assessed(free), fixed, "m")
    positions = camera_positions(result)
    prior = np.array([OFFSET, OFFSET, OFFSET_HEIGHT])
    notes = [heights] * bool(heights) + choice.remarks()
    notes += [] if positions is None else positions.contradictions(prior, "m")
    table = ControlTable(tuple(_tabulate(result, block, control, choice)), words, tuple(notes), "m")
    return dataclasses.replace(found, adjustment=result, agreeing=int(used.sum())), table


def _assess_all(
    block: "_Block", control: Points, usable: Sequence[int], assumed: float
) -> tuple[list[int], Assessment]:
    """The usable points in the order of their assessment: very many in groups that spread over all
    of them, since time grows with the cube of their number."""
    number = max(1, -(-len(usable) // COMPARED_TOGETHER))
    groups = [list(usable[first::number]) for first in range(number)]
    found = [assess(block.compare(group, control), assumed) for group in groups]
    join = lambda name: np.concatenate([getattr(one, name) for one in found])
    return [k for group in groups for k in group], Assessment(
        join("used"), join("sigma"), found[0].redundancy, join("error"), join("error_sigma"),
        join("probability"), found[0].assumed, max(one.factor for one in found),
    )  # fmt: skip


@dataclasses.dataclass
class Choice:
    """The measurements of the points; which points are `used`; σ of control [n, 3], the unknown
    ones estimated; the reason for points that are not used, and remarks about wrong measurements,
    by id; the `assessment` of those that could be compared."""

    measured: dict[str, Measured]
    used: Bool[np.ndarray, " n"]
    sigma: Float[np.ndarray, "n 3"]
    why: dict[str, str]
    wrong: dict[str, list[str]]
    assessment: Assessment

    def assessed(self, rows) -> Assessment:
        """The assessment with the σ of some of the points."""
        return dataclasses.replace(self.assessment, sigma=self.sigma[rows])

    def remarks(self) -> list[str]:
        """What is wrong, by point."""
        found = [f"{id} in {said}" for id, lines in self.wrong.items() for said in lines]
        return [*found, *(f"{id} is not used: {why}" for id, why in self.why.items())]


class _Added(NamedTuple):
    """Named points of the final network, and their measurements, σ in pixels."""

    id: tuple[str, ...]
    role: tuple[str, ...]
    position: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    image: Int[np.ndarray, " rays"]
    point: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    spread: Float[np.ndarray, "rays 2"]


def _without_unknown_heights(block: "_Block") -> tuple[Points, str]:
    """Control whose heights are all 0 without heights, if satellite positions contradict them; and
    what was decided."""
    points = block.given.points
    heights = points.position[:, 2]
    if len(points) < ENOUGH_CONTROL or heights.any() or np.isfinite(points.sigma[:, 2]).any():
        return points, ""
    if not block.has_positions:
        return points, ("the heights of all control points are 0: used as the file states them; "
                        "their residuals show how far the ground is from this plane")  # fmt: skip
    rows = [block.determined[id] for id in points.id if id in block.determined]
    spread = block.network.images.sigma[:, 2]
    sigma = float(np.nanmedian(spread[np.isfinite(spread)]))
    middle = float(np.median(block.X[rows, 2])) if rows else 0.0
    if abs(middle) <= CONTRADICTORY_HEIGHTS * sigma:
        return points, (f"the heights of all control points are 0, {abs(middle):.1f} m from those "
                        "by the satellite positions: used as the file states them")  # fmt: skip
    free = points.sigma.copy()
    free[:, 2] = np.inf
    return dataclasses.replace(points, sigma=free), (
        f"the heights of all control points are 0, but {middle:.1f} ± {sigma:.1f} m by the "
        "satellite positions: taken as unknown, control is used in the plane only (state sZ for "
        "heights that are 0)"
    )


def _choose(
    block: "_Block", control: Points, measured: dict[str, Measured], usable: Sequence[int],
    assessed: Assessment, assumed: float,
) -> Choice:  # fmt: skip
    """Which points and measurements are used."""
    sigma = control.sigma.copy()
    for k in range(3):
        unknown = np.isnan(sigma[:, k])
        among = np.isnan(control.sigma[list(usable), k])
        sigma[unknown, k] = assessed.sigma[among, k][0] if among.any() else assumed
    sigma[np.isfinite(control.sigma)] *= assessed.factor
    found = Choice(dict(measured), np.zeros(len(control), bool), sigma, {}, {}, assessed)
    at = {k: n for n, k in enumerate(usable)}
    shift = np.zeros(3)
    agreed = [k for k, n in at.items() if assessed.used[n]]
    if agreed:
        X = block.X[[block.determined[control.id[k]] for k in agreed]]
        shift = np.median(X - control.position[agreed], axis=0)
    for k, id in enumerate(control.id):
        one = measured[id]
        if not len(one.rows):
            found.why[id] = "in no oriented photograph"
        elif k in at:
            n = at[k]
            found.used[k] = assessed.used[n]
            if not assessed.used[n]:
                found.why[id] = _describe_error(assessed, n)
        elif one.good.any():
            found.used[k] = control.role[k] != "check"
        else:
            _settle_by_coordinates(block, found, k, control, shift)
        if found.measured[id].good.any() or id not in found.why:
            _name_wrong(block, found, id)
    _name_exchanged(block, control, found, [k for k, n in at.items() if not assessed.used[n]])
    return found


def _describe_error(assessed: Assessment, n: int) -> str:
    error, sigma = assessed.error[n], assessed.error_sigma[n]
    there = np.isfinite(error)
    parts = (f"{axis} {e:+.2f}" for axis, e in zip("XYZ", error) if np.isfinite(e))
    ratio, length = np.max(np.abs(error / sigma)[there]), np.linalg.norm(error[there])
    return (
        f"the other points and the photographs put it {length:.2f} m from its "
        f"coordinates ({', '.join(parts)} m), {ratio:.1f} times the σ of this prediction"
    )


def _settle_by_coordinates(
    block: "_Block", found: Choice, k: int, control: Points, shift: Float[np.ndarray, "3"]
) -> None:
    """A point whose rays do not meet, or that has only one: its rays are compared with its
    coordinates."""
    id, one = control.id[k], found.measured[control.id[k]]
    X = control.position[k] + shift
    if np.isinf(control.sigma[k, 2]):
        depth = [block.X[row, 2] for row in block.determined.values()]
        X[2] = np.median(depth) if depth else X[2]
    distance = np.linalg.norm(X - block.X0[one.image], axis=1)
    spread = np.sqrt((np.where(np.isfinite(found.sigma[k]), found.sigma[k], 0.0) ** 2).sum())
    off = block.misses(one, X)
    agree = off < WRONG * np.hypot(one.sigma, spread / (distance * one.pixel))
    if control.role[k] == "check" or (len(one.rows) > 1 and agree.sum() != 1):
        number = count(len(one.rows), "ray")
        found.why[id] = (f"its {number} do not meet" if len(one.rows) > 1 else
                         "a check point needs two rays, it has 1")  # fmt: skip
    elif agree.any():
        found.measured[id] = dataclasses.replace(one, good=agree)
        found.used[k] = True
    else:
        ground = off[0] * one.pixel[0] * distance[0]
        found.why[id] = (f"its only ray, in {block.name_of(one, 0)}, misses its coordinates by "
                         f"{off[0]:.0f} px, {ground:.1f} m")  # fmt: skip


def _name_wrong(block: "_Block", found: Choice, id: str) -> None:
    """Remarks about the measurements of a point that do not agree with the others."""
    one = found.measured[id]
    X = one.position
    if not np.isfinite(X).all():
        return
    off = block.misses(one, X)
    for n in np.flatnonzero(~one.good).tolist():
        passes = np.linalg.norm(np.cross(X - block.X0[one.image[n]], one.rays[n]))
        said = (f"{block.name_of(one, n)} is a wrong measurement and not used: {off[n]:.0f} px "
                "from where the other photographs see it, its ray passes at "
                f"{passes:.2f} m")  # fmt: skip
        other = block.seen_there(one, n, id, found.measured)
        found.wrong.setdefault(id, []).append(
            said + (f"; it is at the place of {other}: a wrong name" if other else "")
        )


def _name_exchanged(block: "_Block", control: Points, found: Choice, bad: Sequence[int]) -> None:
    """Pairs of contradictory points whose coordinates fit if they are exchanged."""
    for i in bad:
        for j in bad:
            X = block.X[block.determined[control.id[i]]]
            off = X - control.position[j]
            sigma = np.where(np.isfinite(found.sigma[j]), found.sigma[j], np.inf)
            if i != j and np.all(np.abs(off) < WRONG * np.hypot(sigma, block.offset_sigma)):
                found.why[control.id[i]] += f"; it fits the coordinates of {control.id[j]}"


def _tabulate(result: Adjustment, block: "_Block", control: Points, choice: Choice):
    """The rows of the table."""
    final = _Block(result, block.given)
    checks, points = result.check_points, result.problem.network.points.id
    compared = {} if checks is None else {id: k for k, id in enumerate(checks.id)}
    snooped = [one.name for one in result.removed]
    for k, id in enumerate(control.id):
        one = dataclasses.replace(final.measure(id), good=choice.measured[id].good)
        X, residual = np.full(3, np.nan), np.full(3, np.nan)
        if id in compared:
            X = present(checks).position[compared[id]]
        elif id in final.of_id:
            X = final.X[final.of_id[id]]
        if np.isfinite(X).all():
            residual = np.where(np.isinf(choice.sigma[k]), np.nan, X - control.position[k])
        off = final.misses(one, X)[one.good]
        used = "held exactly" if control.role[k] == "fixed" else "used"
        verdict = used if choice.used[k] else "left out"
        verdict = "check" if control.role[k] == "check" else verdict
        reasons = [*([choice.why[id]] if id in choice.why else []), *choice.wrong.get(id, [])]
        reasons += [f"data snooping removed {name}" for name in snooped
                    if f"point {id} " in f"{name} "]  # fmt: skip
        yield ControlPoint(
            id, control.role[k], bool(choice.used[k]) and id in points,
            int(one.good.sum()), control.position[k],
            np.full(3, np.nan) if control.role[k] == "fixed" else choice.sigma[k], residual,
            float(np.sqrt((off**2).mean())) if len(off) else np.nan,
            ": ".join([verdict, "; ".join(reasons)]) if reasons else verdict,
        )  # fmt: skip


class _Block:
    """The adjusted block: orientations, and intersections in it."""

    def __init__(self, result: Adjustment, given: Given):
        self.result, self.given = result, given
        self.network: Network = result.problem.network
        values = result.image_values
        self.X0, self.angles = values[:, :3], values[:, 3:]
        self.M = np.asarray(many.matrices(self.angles))
        self.X, self.A = result.point_values, np.eye(3)
        self.cameras = tuple(
            dataclasses.replace(c, parameters=result.camera_parameters(c.id))
            for c in self.network.cameras
        )  # fmt: skip
        self.row = {id: k for k, id in enumerate(self.network.images.id)}
        points = self.network.points.id
        known = np.all(np.isfinite(self.X), axis=1)
        named = set(given.points.id)
        self.determined = {id: k for k, id in enumerate(points) if id in named and known[k]}
        observed = np.all(np.isfinite(self.network.images.sigma[:, :3]), axis=1)
        self.has_positions = int(observed.sum()) > 2
        self.of_id = {id: k for k, id in enumerate(points)}

    def measure(self, id: str) -> Measured:
        """The measurements of a point; all of them agree for now."""
        named, names = self.given.named, self.given.names
        rows = [k for k, name in enumerate(named.name)
                if name == id and names[named.image[k]] in self.row]  # fmt: skip
        rows = np.array(rows, int)
        image = np.array([self.row[names[named.image[k]]] for k in rows], int)
        if not len(rows):
            nothing = np.zeros(0)
            return Measured(rows, image, np.zeros((0, 3)), nothing, nothing, np.zeros(0, bool),
                            np.full(3, np.nan))  # fmt: skip
        camera = self.network.images.camera[image]
        ends = [self._ideal(camera, named.xy[rows] + shift) for shift in ([0, 0], [0.5, 0.5])]
        pixel = np.linalg.norm(ends[1] - ends[0], axis=1) / np.hypot(0.5, 0.5)
        rays = np.einsum("nij,ni->nj", self.M[image],
                         np.pad(ends[0], ((0, 0), (0, 1)), constant_values=-1.0))  # fmt: skip
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        good = np.isfinite(rays).all(1)
        sigma = named.sigma[rows].mean(1)
        return Measured(rows, image, rays, pixel, sigma, good, np.full(3, np.nan))

    def _ideal(self, camera, xy) -> Float[np.ndarray, "n 2"]:
        xy, _ = from_image_unit(self.cameras, camera, xy, np.ones_like(xy), "px")
        found = np.full_like(xy, np.nan)
        for c in np.unique(camera):
            found[camera == c] = ideal_points(self.cameras[c], xy[camera == c])
        return found

    def misses(self, one: Measured, X) -> Float[np.ndarray, " n"]:
        """Distances of the projections of X from its measurements, pixels."""
        away = X - self.X0[one.image]
        along = np.einsum("ni,ni->n", away, one.rays)
        across = np.linalg.norm(np.cross(away, one.rays), axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(along > 0, across / along / one.pixel, np.inf)

    def resolve(self) -> dict[str, Measured]:
        """By point, the measurements that agree on one position of it, and that position.

        σ of the measurements are multiplied by the robust scale of all their misclosures, if this
        is larger than 1: a point is identified worse than it is measured."""
        measured = {id: self.measure(id) for id in self.given.points.id}
        first = {id: self._consistent(one) for id, one in measured.items()}
        off = [self.misses(one, one.position)[one.good] / one.sigma[one.good]
               / np.sqrt(1 - 1.5 / one.good.sum()) for one in first.values()
               if one.good.sum() > 1]  # fmt: skip
        # the median of a Rayleigh distribution is 1.1774 σ
        scale = max(1.0, float(np.median(np.concatenate(off))) / 1.1774) if off else 1.0
        if scale == 1.0:
            return first
        return {id: self._consistent(dataclasses.replace(one, sigma=scale * one.sigma))
                for id, one in measured.items()}  # fmt: skip

    def _consistent(self, one: Measured) -> Measured:
        """The largest set of rays that meet, more than half of them, from the best pair."""
        usable = np.flatnonzero(np.isfinite(one.rays).all(1))
        best = np.zeros(len(one.rows), bool)
        closest = np.inf
        tried = usable[many.spread(len(usable), PAIRED_RAYS)]
        for i in tried:
            for j in tried[tried > i]:
                pair = np.isin(np.arange(len(one.rows)), [i, j])
                off = self.misses(one, self._meet(one, pair)) / one.sigma
                good = off < WRONG
                if good[[i, j]].all() and (good.sum(), -np.median(off[good])) > (
                    best.sum(), -closest
                ):  # fmt: skip
                    best, closest = good, np.median(off[good])
        if best.sum() < 2 or 2 * best.sum() <= len(usable):
            return dataclasses.replace(one, good=np.zeros(len(one.rows), bool))
        return dataclasses.replace(one, good=best, position=self._meet(one, best))

    def _meet(self, one: Measured, use) -> Float[np.ndarray, "3"]:
        """The point nearest to some rays, by the angle at which they miss it."""
        weight, X0 = np.ones(use.sum()), self.X0[one.image[use]]
        P = np.eye(3) - one.rays[use][:, :, None] * one.rays[use][:, None, :]
        X = X0[0]
        for _ in range(3):
            N = (P * weight[:, None, None]).sum(0)
            if np.linalg.cond(N) > 1e12:
                return np.full(3, np.nan)
            X = np.linalg.solve(N, np.einsum("n,nij,nj->i", weight, P, X0))
            weight = 1 / np.maximum(((X - X0) ** 2).sum(1), 1e-30)
        return X

    def move(self, places: Sequence[int], points: Points) -> None:
        """Move the block by the similarity that fits most of the control points."""
        ids = [points.id[k] for k in places]
        target = points.position[list(places)]
        if len(ids) < ENOUGH_CONTROL or np.isinf(points.sigma[list(places)]).any():
            raise InputError(
                f"control points with heights in at least two photographs: expected "
                f"{ENOUGH_CONTROL}, got {len(ids)} in this part; without satellite positions they "
                "alone give the frame"
            )
        found = similarity_of_most(self.X[[self.determined[id] for id in ids]], target)
        if found is None:
            raise InputError("the control points are on a line: they leave a rotation open")
        A, t = found
        R = A / np.cbrt(np.linalg.det(A))
        self.X0, self.X, self.M = self.X0 @ A.T + t, self.X @ A.T + t, self.M @ R.T
        self.angles, self.A = np.asarray(many.angles(self.M)), A

    @property
    def ground_sample_distance(self) -> float:
        """The length of a pixel at the named points, the median."""
        found = [one.pixel * np.linalg.norm(X - self.X0[one.image], axis=1)
                 for one, X in ((self.measure(id), self.X[k]) for id, k in self.determined.items())]
        return float(np.median(np.concatenate(found))) if found else 1.0

    def compare(self, places: Sequence[int], points: Points) -> Discrepancies:
        """Coordinates from the block minus given ones, and their joint cofactors."""
        rows = [self.determined[points.id[k]] for k in places]
        if not rows:
            nothing = np.zeros((0, 3))
            return Discrepancies(nothing, np.zeros((0, 3, 0, 3)), nothing, np.zeros((0, 3, 0)))
        X, given = self.X[rows], points.position[list(places)]
        C = self._joint_cofactors(rows)
        n, sigma = len(rows), points.sigma[list(places)].copy()
        if self.has_positions:
            C = C + np.diag(self.offset_sigma**2)[None, :, None, :]
            G = np.zeros((n, 3, 0))
        else:
            # the generators of a similarity about the middle: shift, rotation, scale
            x = (X - X.mean(0)) / max(np.ptp(X, axis=0).max(), 1e-12)
            turn = np.cross(np.eye(3)[None], x[:, None]).transpose(0, 2, 1)
            G = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), turn, x[:, :, None]], 2)
        fixed = np.array([points.role[k] == "fixed" for k in places])
        sigma[fixed] = 0.0
        return Discrepancies(X - given, C, sigma, G)

    def _joint_cofactors(self, rows) -> Float[np.ndarray, "n 3 n 3"]:
        """The covariance of the coordinates of some points among each other."""
        problem, n = self.result.problem, len(rows)
        tables = {t.name: np.zeros((3 * n, t.rows, t.space.width)) for t in problem.system.tables}
        lengths = problem.layout.lengths
        for k, row in enumerate(rows):
            D = np.eye(3)
            if lengths is not None:
                at = np.append(np.asarray(self.result.values.point)[row], lengths[row])
                D = np.asarray(derivative(jnp.asarray(at)))
            tables["point"][3 * k : 3 * k + 3, row] = self.A @ D
        Q = self.result.cofactors.solution.propagate_rows(tables)
        return self.result.sigma0**2 * np.asarray(Q).reshape(n, 3, n, 3)

    def removed(self) -> list[tuple[str, str]]:
        """Image and point, by id, of the image points without weight."""
        problem = self.result.problem
        gone = ~(np.asarray(problem.data.image_weight) > 0).any(1)
        images, points = self.network.images.id, self.network.points.id
        return [(images[i], points[p]) for i, p in
                zip(problem.image[gone].tolist(), problem.point[gone].tolist())]  # fmt: skip

    def is_determined(self, id: str, one: Measured) -> bool:
        """Whether a point was adjusted with the block, from the measurements that agree."""
        if id not in self.determined or one.good.sum() < 2:
            return False
        off = self.misses(one, self.X[self.determined[id]])[one.good]
        return bool((off < WRONG * one.sigma[one.good]).all())

    def name_of(self, one: Measured, n: int) -> str:
        """The photograph of a measurement."""
        return self.network.images.id[one.image[n]]

    def seen_there(self, one: Measured, n: int, id: str, measured: dict[str, Measured]) -> str:
        """Another point at the place of a measurement: measured in the same photograph, or
        intersected from others; empty without."""
        for other, its in measured.items():
            there = its.rows[its.image == one.image[n]]
            xy = self.given.named.xy
            near = np.linalg.norm(xy[there] - xy[one.rows[n]], axis=1) < WRONG * one.sigma[n]
            if other != id and (near.any() or self.misses(one, its.position)[n] < WRONG *
                                one.sigma[n]):  # fmt: skip
                return other
        return ""

    @property
    def offset_sigma(self) -> Float[np.ndarray, "3"]:
        """σ of the system of the block against that of control."""
        offset = np.array([OFFSET, OFFSET, OFFSET_HEIGHT])
        return offset if self.has_positions else np.zeros(3)

    def with_control(self, control: Points, choice: Choice) -> Network:
        """The network at the solution with control, its measurements and positions."""
        whole, network = self.network, readjustable_network(self.result)
        named, ids, distances = set(control.id), network.points.id, network.distances
        ends = [(ids[a], ids[b]) for a, b in distances.points]
        network = keep_points(network, np.array([id not in named for id in network.points.id]))
        row = {id: k for k, id in enumerate(network.points.id)}
        at = np.array([row.get(id, -1) for id in whole.points.id])
        rays = whole.observations.take(at[whole.observations.point] >= 0)
        added = self._measured_points(control, choice, len(row))
        xy, sigma = from_image_unit(
            self.cameras, whole.images.camera[added.image], added.xy, added.spread, "px"
        )
        images, moved = network.images, [self.of_id[id] for id in network.points.id]
        row |= {id: len(row) + k for k, id in enumerate(added.id) if added.role[k] != "check"}
        here = np.array([a in row and b in row for a, b in ends], bool)
        return network.replace(
            images=dataclasses.replace(images, position=self.X0, angles=self.angles),
            points=Points(
                (*network.points.id, *added.id), (*network.points.role, *added.role),
                np.concatenate([self.X[moved], added.position]),
                np.concatenate([network.points.sigma, added.sigma]),
            ),
            observations=dataclasses.replace(
                rays, image=np.concatenate([rays.image, added.image]),
                point=np.concatenate([at[rays.point], added.point]),
                xy=np.concatenate([rays.xy, xy]), sigma=np.concatenate([rays.sigma, sigma]),
                source=Source("observations"),
            ),
            further=(*(one for one in network.further if not isinstance(one, ExteriorPriors)),
                     *self._positions(choice)),
            distances=Distances(
                np.array([[row[a], row[b]] for (a, b), keep in zip(ends, here) if keep],
                         int).reshape(-1, 2),
                distances.value[here], distances.sigma[here], distances.source.take(here),
            ),
            datum="control", datum_points=(), object_unit="m", warnings=whole.warnings,
            notes=whole.notes,
        )  # fmt: skip

    def _measured_points(self, control: Points, choice: Choice, first: int) -> _Added:
        """Control and check points that can be determined, with their good measurements."""
        ids, roles, position, sigma, rows, point = [], [], [], [], [], []
        image, spread = [], []
        for k, id in enumerate(control.id):
            one = choice.measured[id]
            # a point with wrong coordinates is a good tie point
            role = "check" if control.role[k] == "check" else "tie"
            role = control.role[k] if choice.used[k] else role
            if one.good.sum() < (1 if choice.used[k] else 2):
                continue
            there = np.isfinite(one.position).all()
            start = one.position if there else self.on_ray(one)
            free = np.isinf(choice.sigma[k]) | (role == "tie")
            position.append(np.where(free, start, control.position[k]))
            exact = role in ("fixed", "tie")
            sigma.append(np.full(3, np.nan) if exact else choice.sigma[k])
            rows += one.rows[one.good].tolist()
            image += one.image[one.good].tolist()
            spread += one.sigma[one.good].tolist()
            point += [first + len(ids)] * int(one.good.sum())
            ids.append(id)
            roles.append(role)
        return _Added(
            tuple(ids), tuple(roles), np.reshape(position, (-1, 3)), np.reshape(sigma, (-1, 3)),
            np.array(image, int), np.array(point, int), self.given.named.xy[np.array(rows, int)],
            np.repeat(np.reshape(spread, (-1, 1)), 2, 1),
        )  # fmt: skip

    def on_ray(self, one: Measured) -> Float[np.ndarray, "3"]:
        """A place on the first good ray, at the distance of the points around."""
        first = int(np.flatnonzero(one.good)[0])
        X0, rays = self.X0[one.image[first]], self.network.observations
        seen = self.X[rays.point[rays.image == one.image[first]]]
        depth = np.nanmedian(np.linalg.norm(seen - X0, axis=1))
        return X0 + depth * one.rays[first]

    def _positions(self, choice: Choice) -> list[Antennas]:
        """Satellite positions as observations, with an offset on the axes that control has."""
        if self.given.positions is None:
            return []
        names = {name: k for k, name in enumerate(self.given.names)}
        rows = np.array([names[id] for id in self.network.images.id])
        X, sigma = (one[rows] for one in self.given.positions)
        there = np.flatnonzero(np.isfinite(X).all(1) & np.isfinite(sigma).all(1))
        if not len(there):
            return []
        axes = [a for k, a in enumerate("XYZ") if np.isfinite(choice.sigma[choice.used, k]).any()]
        prior = dict(zip("XYZ", (OFFSET, OFFSET, OFFSET_HEIGHT)))
        settings = {"free": [f"shift_{a}" for a in axes],
                    "sigma": {f"shift_{a}": prior[a] for a in axes}}  # fmt: skip
        return [Antennas(
            image=tuple(self.network.images.id[k] for k in there), position=X[there],
            covariance=np.einsum("ni,ij->nij", sigma[there] ** 2, np.eye(3)),
            strip=("all",) * len(there), time=np.full(len(there), np.nan), settings=settings,
        )]  # fmt: skip
