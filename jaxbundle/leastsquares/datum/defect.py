"""The datum defect: the motions of a problem left open by its observations, and their constraints.

Computed once at the start values, on the host, from one compiled survey of the motions of every
table and their effect on observations.
"""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.datum.by_table import directions_of_motions
from jaxbundle.leastsquares.datum.conditions import MIN_RELATIVE_MOTION, free_of_tables, of_groups
from jaxbundle.leastsquares.datum.motions import ROTATION, SCALE, SIMILARITY_PARAMETERS
from jaxbundle.leastsquares.equations.linearise import differentiate
from jaxbundle.leastsquares.indexing.plan import Datum, Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Data, Declared, lay_out_data, prepare
from jaxbundle.system.programs import compile_once
from jaxbundle.types import not_none

# Relative size of J·G below which a direction counts as open. Rounding gives about 1e-14, more if
# coordinates are much larger than the network; what fixes a datum by less than 1e-10 of its
# observations' own terms is no observation of it. Values from 1e-12 to 1e-8 decide alike.
MAX_OPEN_EFFECT = 1e-10


class CannotHold(InputError):
    """The chosen unknowns cannot fix the datum; `defect` of its parameters are open."""

    def __init__(self, defect: int):
        super().__init__(
            f"the chosen unknowns cannot fix the datum, of which {defect} parameters are open"
        )
        self.defect = defect


class Survey(NamedTuple):
    """The effect of the motions at the start values, including padded rows.

    `products`: J·G of all observations that are not invariant, part by part; `squares`: the sums of
    squares of the cancelling terms; `held`: G on held unknowns; `moves`, `free`: G and free
    directions by table, [rows, width, …]; `of_groups`: G by group, 0 for held unknowns."""

    products: tuple[Float[Array, "rows motions"], ...]
    squares: Float[Array, " motions"]
    held: Float[Array, "rows motions"]
    moves: Tangent
    free: Tangent
    of_groups: Tangent


def survey_motions(
    declared: Declared, plan: Plan, data: Data, real: dict[str, Bool[np.ndarray, " rows"]]
) -> Survey:
    """See `Survey`; `real`: by table, which rows are not padding."""
    moves = directions_of_motions(declared, data.start)
    return _survey(declared, plan, data, real, moves)


@compile_once
def _survey(
    declared: Declared,
    plan: Plan,
    data: Data,
    real: dict[str, Bool[np.ndarray, " rows"]],
    moves: Tangent,
) -> Survey:
    chunked, prepared = lay_out_data(plan, data), prepare(declared, data.start)
    motions = len(not_none(declared.motions).names)
    everywhere = {
        name: jnp.concatenate(
            [moves[m.table] if m.rows is None else moves[m.table][m.rows] for m in group.members], 1
        )
        for name, group in plan.groups.items()
    }
    products, squares = [], jnp.zeros(motions)
    for number, part in enumerate(plan.parts):
        # Conditions such as points on a figure are invariant only where they hold: the residuals
        # of start values would pass for observations of the scale.
        if declared.kinds[part.set_name].invariant:
            continue
        _, touches, E = differentiate(declared, plan, number, prepared, chunked)
        blocks = [
            (J, everywhere[t.group][t.row, t.start : t.stop][:, None])
            for t, J in zip(part.touches, touches)
        ]
        if E is not None:
            blocks.append((E, everywhere[not_none(plan.eliminated)][part.eliminated]))
        if not blocks:  # Held tables only: it determines nothing.
            continue
        # |J|·|G|: the size of the terms that cancel, for the scale of what remains.
        total = lambda rows: reduce(jnp.add, rows).reshape(-1, motions)
        product, terms = (total([f(J) @ f(G) for J, G in blocks]) for f in (jnp.asarray, abs))
        # Non-finite values at the start are ignored here; the solver will report them.
        is_finite = jnp.isfinite(terms).all(1, keepdims=True)
        products.append(jnp.where(is_finite, product, 0.0))
        squares += jnp.where(is_finite, terms**2, 0.0).sum(0)
    free = free_of_tables(declared, plan, data.start)
    held_rows = [
        jnp.where((free[name] > 0)[..., None] | ~real[name][:, None, None], 0.0, rows)
        for name, rows in moves.items()
    ]
    held_rows = jnp.concatenate([rows.reshape(-1, motions) for rows in held_rows])
    return Survey(tuple(products), squares, held_rows, moves, free, of_groups(plan, moves))


def find_open_motions(survey: Survey) -> Float[np.ndarray, "motions defect"]:
    """The combinations of the declared motions that change no observation and no held unknown.

    Computed from the singular values of J·G, its columns scaled by the size of their terms, so that
    neither units nor the number of observations matter."""
    held_rows = np.asarray(survey.held)
    held_rows = held_rows[np.isfinite(held_rows).all(1)]
    scale = np.sqrt(np.asarray(survey.squares) + (held_rows**2).sum(0))
    # A motion without any effect gets the scale of the others by the size of its displacements:
    # combinations of motions of very different sizes would be nearly parallel.
    displacement = np.sqrt(sum((np.asarray(x) ** 2).sum((0, 1)) for x in survey.moves.values()))
    displacement = np.where(displacement > 0, displacement, 1.0)
    scale = np.where(
        scale > 0, scale, displacement * ((scale / displacement).max(initial=0.0) or 1.0)
    )
    held_rows = held_rows / scale
    # A held unknown that moves at all holds: every row counts the same.
    size = np.linalg.norm(held_rows, axis=1, keepdims=True)
    rows = [held_rows / np.where(size > 0, size, 1.0), *map(np.asarray, survey.products)]
    scales = [np.ones_like(scale), *[scale] * len(survey.products)]
    # Directions with J·G = 0. Of the Gram matrix (JG)ᵀJG eigenvalues below 1e-16 of the largest are
    # noise: open and weak (1e-8) would look alike; hence the triangle of a QR.
    _, singular, directions = np.linalg.svd(_triangle(rows, scales))
    return directions[singular < MAX_OPEN_EFFECT].T / scale[:, None]


def _triangle(
    parts: Sequence[Float[np.ndarray, "rows n"]], scales: Sequence[Float[np.ndarray, " n"]]
) -> Float[np.ndarray, "n n"]:
    """R of the QR of all rows of the parts, their columns divided by the scales: it has their
    singular values, of which a Gram matrix would lose half of the digits."""
    n = parts[0].shape[1]
    R = np.zeros((n, n))
    for rows, scale in zip(parts, scales):
        # 10 000 rows of seven motions at a time: half a megabyte, whatever the problem.
        for begin in range(0, len(rows), 10_000):
            part = rows[begin : begin + 10_000] / scale
            R = np.asarray(np.linalg.qr(np.concatenate([R, part]), mode="r"))
    return R


def make_datum(
    plan: Plan,
    survey: Survey,
    gauge: Float[np.ndarray, "motions defect"],
    weight: dict[str, np.ndarray],
    minimal: bool,
    real: dict[str, Bool[np.ndarray, " rows"]],
) -> Datum:
    """The datum fixed by the unknowns with a `weight` (by table, [rows, width]); `minimal`: by as
    many of them as the defect, chosen well spread. `real`: see `survey_motions`.

    **Raises:** `CannotHold`."""
    along_gauge = lambda moves: {name: np.asarray(rows) @ gauge for name, rows in moves.items()}
    moves, free = along_gauge(survey.moves), {t: np.asarray(f) for t, f in survey.free.items()}
    weight = {name: np.asarray(w) * free[name] for name, w in weight.items()}
    defect = gauge.shape[1]
    directions = [moves[t].reshape(-1, defect) for t in weight]
    candidates = [w.ravel() for w in weight.values()]
    size = np.sqrt(sum((rows**2).sum(0) for rows in directions))
    candidate_rows = [rows * c[:, None] for rows, c in zip(directions, candidates)]
    R = _triangle(candidate_rows, [size] * len(candidate_rows))
    if np.isfinite(R).all():  # otherwise the solver will report it
        singular = np.linalg.svd(R, compute_uv=False)
        if singular[-1] <= MIN_RELATIVE_MOTION * singular[0]:
            raise CannotHold(defect)
        # The same directions, orthonormal on the datum unknowns: BᵀG is then the unit matrix.
        orthonormal = np.linalg.inv(R) / size[:, None]
        gauge, directions = gauge @ orthonormal, [rows @ orthonormal for rows in directions]
    if minimal:
        # Any independent ones hold the datum. In their own units, unlike pins: coordinates, whose
        # motions are the largest numbers, come before angles.
        picked = _pick_rows(np.concatenate(directions), np.concatenate(candidates))
        cuts = np.cumsum([w.size for w in weight.values()])[:-1]
        weight = {
            t: part.reshape(weight[t].shape) for t, part in zip(weight, np.split(picked, cuts))
        }
    # Pins make the reduced matrix regular (`elimination.reduced_system`); the solution does not
    # depend on which are chosen.
    pins = _choose_pins(plan, along_gauge({name: survey.of_groups[name] for name in plan.kept}))
    held_unknowns = {t: (1 - free[t]) * real[t][:, None] for t, rows in moves.items() if rows.any()}
    held_unknowns = {t: mask for t, mask in held_unknowns.items() if mask.any()}
    turned = _leaves_scale_but_no_rotation(survey.moves, gauge, weight)
    datum = Datum(*jax.device_put((gauge, weight, pins, held_unknowns)))
    return dataclasses.replace(datum, turned=turned)


def _leaves_scale_but_no_rotation(
    moves: Tangent, gauge: Float[np.ndarray, "motions defect"], weight: dict[str, np.ndarray]
) -> bool:
    """Whether the open motions of a similarity scale the datum unknowns, and turn none of them."""
    if len(gauge) != len(SIMILARITY_PARAMETERS):
        return False

    def size(motions: slice) -> float:
        parts = [np.asarray(moves[t])[..., motions] @ gauge[motions] for t in weight]
        weighted = [weight[t][..., None] * part for t, part in zip(weight, parts)]
        return max(float(np.nanmax(abs(part), initial=0.0)) for part in weighted)

    return size(SCALE) > 0 and size(ROTATION) <= MIN_RELATIVE_MOTION * size(SCALE)


def _choose_pins(
    plan: Plan, G: dict[str, Float[np.ndarray, "rows w defect"]]
) -> dict[str, np.ndarray]:
    """As many kept unknowns as the defect, chosen well spread; every kind of direction is
    normalised by its size, unless that is rounding."""
    rows, shapes = [], []
    # Coordinates of a large block move by kilometres in a rotation, its angles by radians: without
    # this all pins would be coordinates.
    size = {name: np.sqrt((G[name] ** 2).mean((0, 2), keepdims=True)) for name in plan.kept}
    smallest_size = max(1e-300, MAX_OPEN_EFFECT * max(x.max() for x in size.values()))
    for name in plan.kept:
        sized = G[name] / np.maximum(size[name], smallest_size)
        rows.append(sized.reshape(-1, sized.shape[2]))
        shapes.append(G[name].shape[:2])
    all_rows = np.concatenate(rows)
    free = np.concatenate([np.asarray(plan.groups[g].free).ravel() for g in plan.kept])
    picked = _pick_rows(all_rows, free)
    cuts = np.cumsum([len(r) for r in rows])[:-1]
    return {
        name: part.reshape(shape)
        for name, part, shape in zip(plan.kept, np.split(picked, cuts), shapes)
    }


def _pick_rows(
    G: Float[np.ndarray, "rows defect"], candidates: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " rows"]:
    """1 for as many independent rows of G as it has columns, 0 for the others."""
    # Pivoting by the largest row, of an orthonormal basis: the unknowns that hold the datum best
    # (D-optimal step by step), e.g. points far apart.
    q, _ = np.linalg.qr(G)
    rows = q * candidates[:, None]
    is_chosen = np.zeros(len(rows))
    for _ in range(G.shape[1]):
        pick = np.argmax((rows**2).sum(1))
        direction = rows[pick] / np.linalg.norm(rows[pick])
        rows = rows - np.outer(rows @ direction, direction)
        is_chosen[pick] = 1.0
    return is_chosen
