"""The choice of solver for the reduced system of the kept groups: dense, banded, or iterative.

Two rows of a group share a block of the reduced matrix only if observations or eliminated rows
tie them. In the reverse order of Cuthill and McKee (1969; George 1971), tied rows are close
together: a drive along a street, a traverse, or successive strips become a
narrow band. Cut into super-blocks as wide as the band, the matrix is block tridiagonal. The group
with most unknowns is ordered in this way; all others are a border.

Of the solvers whose factor fits into memory, the one with the lowest operation count is chosen:
n³/3 for a dense factor, a few m³ for each super-block of m unknowns, and for conjugate gradients
about forty passes over all observations, without pairs of incidences. The dense one is preferred
unless another needs at most a third of its operations (`PlanningSettings.required_gain`).
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Int

from jaxbundle.leastsquares.indexing.indices import as_column
from jaxbundle.leastsquares.indexing.settings import PLANNING, PlanningSettings
from jaxbundle.types import not_none

FACTORS = ("dense", "banded")
Rows = Int[np.ndarray, " n"]


class Band(eqx.Module):
    """`place`: the position of every row of `group` in the band (the last for padding);
    super-blocks of `width` rows."""

    group: str = eqx.field(static=True)
    place: Int[Array, " rows"]
    width: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)


def plan_reduction(
    shapes: dict[str, tuple[int, int]],
    couplings: Callable[[str], tuple[Rows, Rows]],
    observations: int,
    solvers: Sequence[str],
    settings: PlanningSettings,
) -> tuple[str | None, Band | None]:
    """The solver for kept groups of these shapes (rows, width), None if none of `solvers` fits into
    memory, and the band if it is banded; a single one of `solvers` is used regardless.

    `couplings(group)`: row and column of its blocks beside the diagonal."""
    unknowns = sum(n * w for n, w in shapes.values())
    if not shapes or (len(solvers) > 1 and unknowns < settings.always_dense_below):
        return "dense", None
    group = max(shapes, key=lambda g: np.prod(shapes[g]))
    (row, column), (rows, w) = couplings(group), shapes[group]
    band = find_band(group, row, column, rows, w, settings) if "banded" in solvers else None
    solver = solvers[0]
    if len(solvers) > 1:
        solver = choose_reduction(band, w, unknowns, observations, solvers, settings)
    return solver, band if solver == "banded" else None


def find_band(
    group: str,
    row: Rows,
    column: Rows,
    rows: int,
    w: int,
    settings: PlanningSettings = PLANNING,
) -> Band:
    """A narrow band of the blocks (row, column) of a group of `rows` rows of `w` unknowns each."""
    from scipy import sparse  # imported here: a tenth of a second
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    # Ordered by rows of the group, not by unknowns: a row keeps its unknowns together.
    links = sparse.coo_matrix((np.ones(len(row)), (row, column)), (rows, rows))
    place = np.empty(rows, np.int32)
    place[reverse_cuthill_mckee((links + links.T).tocsr(), symmetric_mode=True)] = np.arange(rows)
    # The band is as wide as its widest block: one long link, as of a closed loop, widens all of it.
    width = max(
        int(np.abs(place[row] - place[column]).max(initial=0)), -(-settings.min_super_block // w)
    )
    blocks = rows // width + 1  # The last position is empty.
    return Band(group, as_column(place, ("group", group), blocks * width - 1), width, blocks)


def choose_reduction(
    band: Band | None,
    w: int,
    unknowns: int,
    observations: int,
    solvers: Sequence[str],
    settings: PlanningSettings = PLANNING,
) -> str | None:
    """The solver for this number of unknowns, those of the band in blocks of `w`; None: none
    fits."""
    per_observation = settings.conjugate_gradient_steps * settings.conjugate_gradient_work
    # By solver: operations, and elements of the factor.
    n, work = float(unknowns), {"iterative": (per_observation * observations, 0.0)}
    work["dense"] = n**3 / 3, n**2
    if band is not None:
        place: Any = band.place  # not an array yet (`as_column`)
        m, in_band = float(band.width * w), len(place.rows) * w
        # Super-blocks: L (m³/3), C by substitution (m³), C·Cᵀ (2·m³); then, of the border of q
        # unknowns, X (C·X, substitution), XᵀX and the corner.
        q = n - in_band
        border = 3 * in_band * m * q + 2 * in_band * q**2 + q**3 / 3
        work["banded"] = band.blocks * 10 / 3 * m**3 + border, 3 * band.blocks * m**2 + n * q
    fits = {
        name: work[name][0] for name in solvers if work[name][1] <= settings.max_factor_elements
    }
    cheapest = min(fits, key=fits.__getitem__, default=None)
    return (
        "dense"
        if "dense" in fits and fits["dense"] < settings.required_gain * fits[not_none(cheapest)]
        else cheapest
    )
