"""The measured points of a board in one photograph."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.errors import InputError
from jaxbundle.measure.boards import Board
from jaxbundle.measure.corner_quality import TOO_SMALL
from jaxbundle.measure.saddles import Saddles


@dataclasses.dataclass(frozen=True)
class BoardPoints:
    """The points of a board in a photograph, in the order of `Board.ids`: pixels and their
    covariance, NaN for missing points; `negative`: light squares on dark ground."""

    xy: Float[np.ndarray, "points 2"]
    covariance: Float[np.ndarray, "points 2 2"]
    negative: bool = False


def make_points(fits: Saddles, rows: Int[np.ndarray, " n"], board: Board) -> BoardPoints:
    """The points in these rows of a board; those that could not be measured are missing.

    **Raises:** `InputError` if fewer than four are left."""
    good = fits.why == ""
    if good.sum() < min(4, len(board.ids)):
        reasons = sorted({why for why in fits.why if why}) or [TOO_SMALL]
        raise InputError(f"the points of the {board} cannot be measured: {' or '.join(reasons)}")
    xy, covariance = np.full((len(board.ids), 2), np.nan), np.full((len(board.ids), 2, 2), np.nan)
    xy[rows[good]], covariance[rows[good]] = fits.xy[good], fits.covariance[good]
    return BoardPoints(xy, covariance)
