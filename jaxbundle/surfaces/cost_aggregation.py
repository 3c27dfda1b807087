"""Semi-global aggregation of matching costs on a grid of nodes.

    L(p, d) = C(p, d) + min(L(p', d), L(p', d ± 1) + P₁, min L(p') + P₂) − min L(p')

from node to node p' → p in eight directions, and the sum of all eight: a change of one step costs
P₁, any larger one P₂. With little texture the neighbours decide.

Source: Hirschmüller (2008), Stereo processing by semiglobal matching, equation 13.
"""

import numpy as np
from jaxtyping import Float


def aggregate(
    cost: Float[np.ndarray, "rows columns k"], small: float, large: float
) -> Float[np.ndarray, "rows columns k"]:
    """The sum of the costs of all eight paths; `small` and `large`: P₁ and P₂."""
    total = np.zeros_like(cost)
    for axis in (0, 1):
        turned = np.moveaxis(cost, axis, 0)
        out = np.moveaxis(total, axis, 0)
        # The four diagonals run from row to row, with a shift of one column.
        shifts = (0, 1, -1) if axis == 0 else (0,)
        for shift in shifts:
            for order in (1, -1):
                _sweep(turned[::order], out[::order], shift, small, large)
    return total


def _sweep(
    cost: Float[np.ndarray, "lines nodes k"],
    total: Float[np.ndarray, "lines nodes k"],
    shift: int,
    small: float,
    large: float,
) -> None:
    """Along one direction: from line to line, each moved by `shift` nodes."""
    previous_path = None
    for line, out in zip(cost, total):
        if previous_path is None:
            path = line.copy()
        else:
            shifted_path = _move(previous_path, shift)
            smallest_cost = shifted_path.min(1, keepdims=True)
            path = np.minimum(shifted_path, smallest_cost + large)
            np.minimum(path[:, 1:], shifted_path[:, :-1] + small, out=path[:, 1:])
            np.minimum(path[:, :-1], shifted_path[:, 1:] + small, out=path[:, :-1])
            # Min L(p') is subtracted: it changes no decision, and without it L grows with the path.
            path += line - smallest_cost
        out += path
        previous_path = path


def _move(a: Float[np.ndarray, "nodes k"], shift: int) -> Float[np.ndarray, "nodes k"]:
    """The nodes of a line shifted by one; a node at the edge has no predecessor, and its path
    begins with 0."""
    if shift == 0:
        return a
    out = np.zeros_like(a)
    if shift > 0:
        out[1:] = a[:-1]
    else:
        out[:-1] = a[1:]
    return out
