"""Cofactors, redundancy numbers and tests of a refinement; data snooping.

With a row of J split into a (shared unknowns) and b (its point), ã = a − b·V⁻¹·W, Q = S⁻¹:

    h = ã·Q·ãᵀ + b·V⁻¹·bᵀ,    r = 1 − h,    w = (v/σ)/√r                 (Baarda, 1968)
    Q_pp = V⁻¹ + V⁻¹·W·Q·Wᵀ·V⁻¹                                          points

Snooping removes the observation with the greatest |w| above its critical value, an image point
with both coordinates, adjusts again, and so on: one at a time, since a blunder spoils its
neighbours. It keeps its row with weight zero.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.distributions import critical_w
from jaxbundle.leastsquares.reliability import UNCONTROLLED
from jaxbundle.refinement.equations import System, Unknowns, compiled_rescaled
from jaxbundle.refinement.solver import Reduced, normal, polished, solve

Weak = Callable[[System, Unknowns], list[str]]
"""Sentences on what is not determined."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the kinds of rows begin: image points, control coordinates, priors, exterior."""

    image: slice
    control: slice
    prior: slice
    exterior: slice


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Statistics at a solution; cofactors are to be multiplied by σ0².

    `v` = v/σ, `r` and `w` of every row (NaN without weight or where r is 0); `hat` its 1 − r.
    """

    system: System
    unknowns: Unknowns
    steps: int
    v: Float[np.ndarray, " rows"]
    r: Float[np.ndarray, " rows"]
    w: Float[np.ndarray, " rows"]
    cofactor: Float[np.ndarray, "m m"]
    point_cofactor: Float[np.ndarray, "points 3 3"]
    redundancy: int

    @property
    def layout(self) -> Layout:
        return layout_of(self.system)

    @property
    def sigma0(self) -> float:
        """σ0 a posteriori; 1 without redundancy."""
        return float(np.sqrt(self.v @ self.v / self.redundancy)) if self.redundancy > 0 else 1.0

    @property
    def sigma(self) -> Float[np.ndarray, " m"]:
        """σ of the shared unknowns."""
        return self.sigma0 * np.sqrt(np.diagonal(self.cofactor))

    @property
    def point_sigma(self) -> Float[np.ndarray, "points 3"]:
        """σ of the points along their axes."""
        return self.sigma0 * np.sqrt(np.diagonal(self.point_cofactor, axis1=1, axis2=2))


@dataclasses.dataclass(frozen=True)
class Blunder:
    """A removed observation: kind, "image" or "control", its row of such, its |w|."""

    kind: str
    row: int
    test: float


def layout_of(system: System) -> Layout:
    """Where the kinds of rows begin."""
    sizes = [2 * sum(len(rays.point) for rays in system.rays), 3 * len(system.X),
             len(system.prior), 6 * len(system.frames)]  # fmt: skip
    ends = np.cumsum([0, *sizes]).tolist()
    return Layout(*(slice(a, b) for a, b in zip(ends, ends[1:])))


def weights(system: System) -> Float[np.ndarray, " rows"]:
    """1/σ of every row."""
    parts = [np.asarray(rays.weight).ravel() for rays in system.rays]
    parts += [np.asarray(system.control).ravel(), np.asarray(system.prior)]
    parts += [np.asarray(rays.prior_weight) for rays in system.frames]
    return np.concatenate(parts)


def count_redundancy(system: System) -> int:
    """Rows with weight less free unknowns."""
    free = np.asarray(system.free)
    observed = np.zeros(len(free), bool)
    for rays in system.rays:
        observed[np.asarray(rays.point)] |= (np.asarray(rays.weight) > 0).any(1)
    unknown = (free > 0) & (observed[:, None] | (np.asarray(system.control) > 0))
    return int((weights(system) > 0).sum() - len(system.prior) - unknown.sum())


def adjust(system: System, start: Unknowns, weak: Weak) -> Inspection:
    """Solve and inspect.

    **Raises:** `NotSolvedError` that says, by `weak(system, unknowns)`, what is not determined.
    """
    redundancy = count_redundancy(system)
    first = solve(system, start, jnp.asarray(float(redundancy)))
    system = compiled_rescaled(system, first.unknowns)
    found = solve(system, first.unknowns, jnp.asarray(float(redundancy)))
    steps = int(first.steps + found.steps)
    system, unknowns = polished(system, found.unknowns)
    reduced, v = normal(system, unknowns)
    if not np.isfinite(np.asarray(reduced.lower)).all() or redundancy < 0:
        reasons = weak(system, found.unknowns)
        told = reasons[0] if reasons else "more unknowns than observations"
        if reasons[1:]:
            told += f", and {len(reasons) - 1} more directions"
        raise NotSolvedError(
            f"the adjustment is singular: {told}; hold some, give them a prior σ, or add points",
            reasons,
        )
    if not bool(found.settled):
        raise NotSolvedError(
            f"the adjustment did not settle in {steps} steps; look at start values and "
            "blunders"
        )
    return _inspect(system, unknowns, steps, reduced, v, redundancy)


def _inspect(system, unknowns, steps, reduced, v, redundancy) -> Inspection:
    h, Q, Qp = (np.asarray(x) for x in _hat(reduced))
    used = weights(system) > 0
    r = np.where(used, np.clip(1 - h, 0, 1), np.nan)
    v = np.asarray(v)
    with np.errstate(invalid="ignore"):
        w = np.where(r > UNCONTROLLED, v / np.sqrt(np.where(r > UNCONTROLLED, r, 1.0)), np.nan)
    free = np.asarray(system.free)
    Qp = Qp * free[:, :, None] * free[:, None, :]
    return Inspection(system, unknowns, steps, v, r, w, Q, Qp, redundancy)


@eqx.filter_jit
def _hat(reduced: Reduced):
    J, Q, Vi = reduced.jacobian, reduced.cofactor, reduced.point_cofactor
    h = jnp.einsum("rm,mn,rn->r", reduced.tilde, Q, reduced.tilde)
    h += jnp.einsum("ri,rij,rj->r", J.point, Vi[J.of], J.point)
    G = jnp.einsum("pij,pjm->pim", Vi, reduced.coupling)
    return h, Q, Vi + jnp.einsum("pim,mn,pjn->pij", G, Q, G)


def critical_value(found: Inspection, test: str, significance: float) -> float:
    """The greatest |w| that is no blunder."""
    tested = int(np.isfinite(found.w[: found.layout.control.stop]).sum())
    return critical_w(test, significance, tested, found.redundancy, found.sigma0)


def snoop(
    found: Inspection, test: str, significance: float, weak: Weak, limit: int | None = None
) -> tuple[Inspection, list[Blunder]]:
    """Remove blunders, the worst first, until none is left (or `limit` of them)."""
    removed = []
    while found.redundancy >= 2 and (limit is None or len(removed) < limit):
        worst = _worst(found)
        if not worst.test > critical_value(found, test, significance):
            break
        removed.append(worst)
        found = adjust(without(found.system, worst), found.unknowns, weak)
    return found, removed


def _worst(found: Inspection) -> Blunder:
    w, rows = np.nan_to_num(np.abs(found.w)), found.layout
    image = w[rows.image].reshape(-1, 2).max(1, initial=0.0)
    control = w[rows.control]
    if control.max(initial=0.0) > image.max(initial=0.0):
        return Blunder("control", int(control.argmax()), float(control.max()))
    return Blunder("image", int(image.argmax()), float(image.max(initial=0.0)))


def without(system: System, blunder: Blunder) -> System:
    """The system with the weight of an observation zero; a tie point left with one ray goes."""
    if blunder.kind == "control":
        control = np.array(system.control)
        control.ravel()[blunder.row] = 0.0
        return eqx.tree_at(lambda s: s.control, system, jnp.asarray(control))
    sizes = [len(rays.point) for rays in system.rays]
    tables = [np.array(rays.weight) for rays in system.rays]
    points = [np.asarray(rays.point) for rays in system.rays]
    flat, of = np.concatenate(tables), np.concatenate(points)
    flat[blunder.row] = 0.0
    p = of[blunder.row]
    left = (of == p) & (flat > 0).any(1)
    free = np.array(system.free)
    if left.sum() < 2 and ((free[p] > 0) & (np.asarray(system.control)[p] == 0)).any():
        flat[of == p] = 0.0
        free[p] = 0.0
    tables = [jnp.asarray(part) for part in np.split(flat, np.cumsum(sizes)[:-1])]
    rays = [eqx.tree_at(lambda r: r.weight, r, w) for r, w in zip(system.rays, tables)]
    scanners = len(system.scanners)
    return dataclasses.replace(
        system, scanners=tuple(rays[:scanners]), frames=tuple(rays[scanners:]),
        free=jnp.asarray(free),
    )  # fmt: skip
