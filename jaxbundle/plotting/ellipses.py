"""Error ellipses of points: which of them are drawn, how large, and their outlines."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Float, Int

from jaxbundle.plotting.style import round_number

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


@dataclass(frozen=True)
class EllipseSettings:
    """Which error ellipses of points are drawn, and how large.

    **Fields:**

    - `dimensions`: 2 for ellipses of X and Y, 3 for ellipsoids.
    - `largest`, `sampled`: of more points than these together, the largest ones, and at most so
      many others, spread evenly. An image of 1000 pixels has room for about 300 ellipses that can
      be told apart.
    - `smallest`, `widest`: limits of the median largest half-axis, as parts of the size of the
      network: longer than the mark of its point, and not so long that neighbours lie across each
      other.
    - `longest`: points with a longer half-axis are marked, and their ellipses not drawn: a few of
      poorly determined points would cover the network. Of a tenth, the whole ellipse is a fifth of
      the drawing.
    """

    dimensions: int = 2
    largest: int = 20
    sampled: int = 280
    smallest: float = 0.012
    widest: float = 0.03
    longest: float = 0.1


PLAN = EllipseSettings()
# Sections of an ellipsoid are three ellipses, and points behind each other share their place in the
# picture: a fifth as many. None is hidden by the mark of its own point.
PERSPECTIVE = EllipseSettings(3, 10, 50, 0.02, 0.06)
# A drawing that can be turned and enlarged.
SCENE = EllipseSettings(3)
# Probability that a normally distributed error of 2 or 3 coordinates is inside its 1σ ellipse or
# ellipsoid: 1 − exp(−1/2), and erf(√½) − √(2/π)·exp(−1/2).
PROBABILITY = {2: "39 %", 3: "20 %"}


class Ellipses(NamedTuple):
    """Error ellipses to draw: the rows of their points, the number of points that have one, and the
    factor of their exaggeration; the rows of points whose ellipses are too wide, and how many of
    the rows are the largest of the others."""

    rows: Int[np.ndarray, " drawn"]
    total: int
    factor: float
    wide: Int[np.ndarray, " wide"] = np.zeros(0, int)
    largest: int = 0

    @property
    def exaggeration(self) -> str:
        """The factor in words."""
        return f"× {self.factor:,.12g}".replace(",", " ")

    @property
    def selection(self) -> str:
        """Which ones are drawn if there are more."""
        number_drawn, wide = len(self.rows), len(self.wide)
        if number_drawn == self.total:
            return ""
        words = f"of {number_drawn} of {self.total} points"
        if wide:
            words += f" (too wide to be drawn: {wide})"
        if number_drawn + wide < self.total:
            rest_in_words = " of the rest" if wide else ""
            others = number_drawn - self.largest
            words += f": the {self.largest} largest{rest_in_words} and {others} others"
        return words


def choose_ellipses(adjustment: "Adjustment", size: float, settings: EllipseSettings) -> Ellipses:
    """The error ellipses of points for a network of this size, in a visible and comparable size: a
    half-axis of half the median distance of neighbours, within the limits of the `settings`."""
    dimensions = settings.dimensions
    covariance = adjustment.point_covariance[:, :dimensions, :dimensions]
    is_known = np.isfinite(covariance).all((1, 2))
    half_axis = np.zeros(len(covariance))
    half_axis[is_known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[is_known])[:, -1], 0))
    candidate_rows = np.flatnonzero(adjustment.located & (half_axis > 0))
    if not len(candidate_rows):
        return Ellipses(candidate_rows, 0, 1.0)
    places, half_axis = adjustment.point_values[candidate_rows], half_axis[candidate_rows]
    rows = thin_out(places, half_axis, size, settings)
    neighbour = median_neighbour(places[rows, :dimensions])
    reach = np.clip(0.45 * neighbour, settings.smallest * size, settings.widest * size)
    longest = settings.longest * size
    # One in twenty at most is too wide.
    middle, large_axis = np.quantile(half_axis, [0.5, 0.95], method="lower")
    factor = round_number(min(reach / middle, longest / large_axis))
    wide = factor * half_axis > longest
    usual_rows = np.flatnonzero(~wide)
    rows = usual_rows[thin_out(places[usual_rows], half_axis[usual_rows], size, settings)]
    largest = settings.largest if len(rows) < len(usual_rows) else 0
    return Ellipses(
        candidate_rows[rows], len(candidate_rows), factor, candidate_rows[wide], largest
    )


def thin_out(
    xyz: Float[np.ndarray, "n 3"],
    large: Float[np.ndarray, " n"],
    size: float,
    settings: EllipseSettings,
) -> Int[np.ndarray, " drawn"]:
    """The rows to draw, ascending: all if they are few, else the largest, and of the others the
    first in each cell of a grid across the two wider axes, whose cells have room for an ellipse of
    a network of this `size`."""
    if len(large) <= settings.largest + settings.sampled:
        return np.arange(len(large))
    largest_rows, other_rows = np.split(np.argsort(-large, kind="stable"), [settings.largest])
    other_rows = np.sort(other_rows)
    low, high = np.quantile(xyz, [0.01, 0.99], axis=0)
    wide = np.argsort(low - high)[:2]
    sides = np.maximum((high - low)[wide], 1e-12 * max(float((high - low).max()), 1e-300))
    # Two half-axes, and half of one between neighbours; along a line cells are as many as ellipses.
    room = 2.5 * settings.smallest * size
    sampled = np.clip(np.prod(np.maximum(sides / room, 1)), 1, settings.sampled)
    cells = np.maximum(np.sqrt(sampled * sides / sides[::-1]).astype(int), 1)
    cells = np.minimum(cells, int(sampled))
    cell = np.clip((xyz[other_rows][:, wide] - low[wide]) / sides * cells, 0, cells - 1).astype(int)
    _, sample = np.unique(cell[:, 0] * cells[1] + cell[:, 1], return_index=True)
    return np.sort(np.concatenate([largest_rows, other_rows[sample[: settings.sampled]]]))


def error_ellipses(adjustment: "Adjustment", ellipses: Ellipses, corners: int = 49) -> np.ndarray:
    """Closed polygons [drawn, corners, 2] of ellipses of X and Y."""
    half_axes = _half_axes(adjustment, ellipses, 2)
    offsets = half_axes @ _circle(corners)
    return adjustment.point_values[ellipses.rows, None, :2] + offsets.transpose(0, 2, 1)


def principal_sections(
    adjustment: "Adjustment", ellipses: Ellipses, corners: int = 33
) -> np.ndarray:
    """Closed polygons [3·drawn, corners, 3]: the sections of error ellipsoids by the planes of two
    of their axes."""
    half_axes = _half_axes(adjustment, ellipses, 3)
    offsets = np.stack(
        [half_axes[:, :, pair] @ _circle(corners) for pair in ([0, 1], [0, 2], [1, 2])]
    )
    sections = adjustment.point_values[ellipses.rows, None] + offsets.transpose(0, 1, 3, 2)
    return sections.reshape(-1, corners, 3)


def _half_axes(
    adjustment: "Adjustment", ellipses: Ellipses, dimensions: int
) -> Float[np.ndarray, "drawn d d"]:
    """The exaggerated half-axes of the first coordinates' ellipses, as columns."""
    covariance = adjustment.point_covariance[ellipses.rows, :dimensions, :dimensions]
    square, direction = np.linalg.eigh(0.5 * (covariance + covariance.transpose(0, 2, 1)))
    return ellipses.factor * direction * np.sqrt(np.clip(square, 0, None))[:, None, :]


def _circle(corners: int) -> Float[np.ndarray, "2 corners"]:
    t = np.linspace(0, 2 * np.pi, corners)
    return np.stack([np.cos(t), np.sin(t)])


def median_neighbour(places: Float[np.ndarray, "n d"], max_sample: int = 400) -> float:
    """The median distance to the nearest other place, of a sample of at most `max_sample`;
    infinite if there is one place only."""
    different_places = np.unique(places, axis=0)
    if len(different_places) < 2:
        return np.inf
    sample = places[:: -(-len(places) // max_sample)]
    tree = scipy.spatial.KDTree(different_places)
    distances, _ = tree.query(sample, 2)  # the first is the place itself
    return float(np.median(distances[:, 1]))
