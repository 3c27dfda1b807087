"""Semi-global aggregation of matching costs on a grid of nodes.

    L(p, d) = C(p, d) + min(L(p', d), L(p', d ± 1) + P₁, min L(p') + P₂) − min L(p')

from node to node p' → p in eight directions, and the sum of all eight: a change of one step costs
P₁, any larger one P₂. With little texture the neighbours decide.

Source: Hirschmüller (2008), Stereo processing by semiglobal matching, equation 13.
"""

import numpy as np
from jaxtyping import Float

SMALL_CHANGE, LARGE_CHANGE = 0.08, 0.5
"""P₁ and P₂ for costs 1 − ρ."""


def aggregate(
    cost: Float[np.ndarray, "rows columns k"],
    small: float = SMALL_CHANGE,
    large: float = LARGE_CHANGE,
) -> Float[np.ndarray, "rows columns k"]:
    """The sum of the costs of all eight paths."""
    total = np.zeros_like(cost)
    for axis in (0, 1):
        turned = np.moveaxis(cost, axis, 0)
        out = np.moveaxis(total, axis, 0)
        shifts = (0, 1, -1) if axis == 0 else (0,)
        for shift in shifts:
            for order in (1, -1):
                _sweep(turned[::order], out[::order], shift, small, large)
    return total


def _sweep(cost, total, shift, small, large):
    """Along one direction: from line to line, each moved by `shift` nodes."""
    before = None
    for line, out in zip(cost, total):
        if before is None:
            path = line.copy()
        else:
            came = _move(before, shift)
            least = came.min(1, keepdims=True)
            path = np.minimum(came, least + large)
            np.minimum(path[:, 1:], came[:, :-1] + small, out=path[:, 1:])
            np.minimum(path[:, :-1], came[:, 1:] + small, out=path[:, :-1])
            path += line - least
        out += path
        before = path


def _move(a, shift):
    """Shifted rows; missing costs are 0."""
    if shift == 0:
        return a
    out = np.zeros_like(a)
    if shift > 0:
        out[1:] = a[:-1]
    else:
        out[:-1] = a[1:]
    return out
