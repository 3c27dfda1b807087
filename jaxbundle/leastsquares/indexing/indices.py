"""Index arrays of a plan during planning on the host, and their finishing.

Three rules apply to all of them:

- −1 means none. Every list that is indexed ends with at least one empty row, and −1
  becomes the number of that row.
- Every array knows along which list its first axis runs (`along`), so that padding to round
  sizes, or to the common size of several devices, is one function for all.
- Padding is −1 in an index and a given value in a column.
"""

import dataclasses
from collections.abc import Callable, Hashable, Iterable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree


@dataclasses.dataclass
class PlanIndex:
    """Row numbers into the list `into`, whose items are `times` rows each."""

    rows: np.ndarray
    along: Hashable
    into: Hashable
    times: int = 1


@dataclasses.dataclass
class PlanColumn:
    """Values along a list; `fill`: the value of what fills it up to the size of the list."""

    rows: np.ndarray
    along: Hashable
    fill: float = 0.0


def as_index(rows: np.ndarray, along: Hashable, into: Hashable, times: int = 1) -> Any:
    """A `PlanIndex`, typed as the array that `finish` makes of it."""
    return PlanIndex(rows, along, into, times)


def as_column(rows: np.ndarray, along: Hashable, fill: float = 0.0) -> Any:
    """A `PlanColumn`, likewise."""
    return PlanColumn(rows, along, fill)


Sizes = dict[Hashable, int]


def is_leaf(x: Any) -> bool:
    return isinstance(x, PlanIndex | PlanColumn)


def count(plan: PyTree) -> Sizes:
    """The sizes of all lists of a plan, including an empty last row."""
    sizes: Sizes = {}
    for leaf in jax.tree.leaves(plan, is_leaf=is_leaf):
        if is_leaf(leaf):
            sizes[leaf.along] = len(leaf.rows) + 1
    return sizes


def common(all_sizes: Iterable[Sizes], rounder: Callable[[Hashable, int], int]) -> Sizes:
    """Rounded sizes that hold each of these."""
    largest: Sizes = {}
    for sizes in all_sizes:
        for key, size in sizes.items():
            largest[key] = max(size, largest.get(key, 0))
    return {key: rounder(key, size) for key, size in largest.items()}


def fill_up(n: int, min_size: int = 64) -> np.ndarray:
    """The numbers of n rows, the last one repeated up to the next power of two: many small arrays
    of all sizes share few compiled programs. `min_size`: a size that takes no time anyway."""
    size = max(1 << max(n - 1, 0).bit_length(), min_size)
    return np.minimum(np.arange(size), max(n - 1, 0))


def round_up(number: int, steps: int = 8) -> int:
    """The next number of the form m·2ⁿ with `steps` ≤ m < 2·`steps`; small ones as they are.
    `steps` is a power of two.

    With 8 steps between one power of two and the next less than an eighth is added, 4.5 % on
    average. 4 would double both; 16 would compile twice as many programs in a session."""
    step = 1 << max(number.bit_length() - steps.bit_length(), 0)
    return -(-number // step) * step


def finish(plan: PyTree, sizes: Sizes) -> Any:
    """The plan in arrays of these sizes, −1 replaced by the last row of its list."""

    def finish_leaf(leaf: Any) -> Any:
        if not is_leaf(leaf):
            return leaf
        # Padding points to the empty last row: it may be read and added to, but means nothing. No
        # mask is needed in the loops.
        nothing = -1 if isinstance(leaf, PlanIndex) else leaf.fill
        rows = np.asarray(leaf.rows)
        filling = np.full((sizes[leaf.along] - len(rows), *rows.shape[1:]), nothing, rows.dtype)
        rows = np.concatenate([rows, filling])
        if isinstance(leaf, PlanIndex):
            # `times`: an item of the list is a chunk; the last row of the last chunk is the empty
            # one.
            rows = np.where(rows < 0, sizes[leaf.into] * leaf.times - 1, rows).astype(np.int32)
        return rows

    return jax.tree.map(finish_leaf, plan, is_leaf=is_leaf)
