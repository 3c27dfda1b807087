"""Which control points and measurements of them a reconstruction uses, and why not the others.

Every point is compared with its given coordinates by leave-one-out prediction
(`orientation.control_consistency`), which estimates the σ of control where none is given; a ray
that ends at another control point of its photograph is a wrong name.

σ of control here: NaN is to be estimated, infinity an axis without control; `fixed` points are
exact.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.network.columns import count
from jaxbundle.network.tables import Points
from jaxbundle.orientation.control_consistency import Assessment, assess
from jaxbundle.reconstruction.oriented_block import (
    MIN_CONTROL,
    MeasuredPoint,
    OrientedBlock,
)


@dataclasses.dataclass
class ControlChoice:
    """The measurements of the points; which points are `used`; σ of control [n, 3], the unknown
    ones estimated; the reason for points that are not used, and remarks about wrong measurements,
    by id; the `assessment` of those that could be compared."""

    points: dict[str, MeasuredPoint]
    used: Bool[np.ndarray, " n"]
    sigma: Float[np.ndarray, "n 3"]
    reasons: dict[str, str]
    errors: dict[str, list[str]]
    assessment: Assessment

    def assessed(self, rows: Bool[np.ndarray, " n"]) -> Assessment:
        """The assessment with the σ of some of the points."""
        return dataclasses.replace(self.assessment, sigma=self.sigma[rows])

    def remarks(self) -> list[str]:
        """What is wrong, by point."""
        wrong = [f"{id} in {remark}" for id, lines in self.errors.items() for remark in lines]
        return [*wrong, *(f"{id} is not used: {why}" for id, why in self.reasons.items())]


def has_doubtful_heights(points: Points) -> bool:
    """Whether the heights of control are all 0, several, and no σ is stated for them: spreadsheets
    and forms write 0 for what is not known."""
    heights = points.position[:, 2]
    has_stated_height = np.isfinite(points.sigma[:, 2]) | (np.array(points.role) == "fixed")
    return len(points) >= MIN_CONTROL and not heights.any() and not has_stated_height.any()


def without_unknown_heights(block: OrientedBlock) -> tuple[Points, str]:
    """Control whose heights are all 0 without heights, if satellite positions contradict them; and
    what was decided."""
    points = block.frame.points
    if not has_doubtful_heights(points):
        return points, ""
    if not block.has_positions:
        return points, (
            "the heights of all control points are 0: used as the file states them, with a σ not "
            "below that in the plane (state sZ for heights that are 0)"
        )
    rows = [block.row_of_determined[id] for id in points.id if id in block.row_of_determined]
    sigma_of_heights = block.network.images.sigma[:, 2]
    sigma = float(np.nanmedian(sigma_of_heights[np.isfinite(sigma_of_heights)]))
    middle = float(np.median(block.X[rows, 2])) if rows else 0.0
    if abs(middle) <= block.settings.contradictory_heights * sigma:
        return points, (
            f"the heights of all control points are 0, {abs(middle):.1f} m from those "
            "by the satellite positions: used as the file states them"
        )
    free = points.sigma.copy()
    free[:, 2] = np.inf  # infinite: not controlled, in all that follows
    return dataclasses.replace(points, sigma=free), (
        f"the heights of all control points are 0, but {middle:.1f} ± {sigma:.1f} m by the "
        "satellite positions: taken as unknown, control is used in the plane only (state sZ for "
        "heights that are 0)"
    )


def assess_control(
    block: OrientedBlock, control: Points, usable: Sequence[int], assumed: float
) -> tuple[list[int], Assessment]:
    """The usable points in the order of their assessment: very many in groups that spread over all
    of them, since time grows with the cube of their number. Estimated σ are then the mean of those
    of the groups by their redundancy, σ² = Σ r·σ²/Σ r, and assumed if those of all groups are; the
    factor of stated σ is the largest."""
    number = max(1, -(-len(usable) // block.settings.compared_together))
    groups = [list(usable[begin::number]) for begin in range(number)]
    of_groups = [assess(block.compare(group, control), assumed) for group in groups]
    join = lambda name: np.concatenate([getattr(of_group, name) for of_group in of_groups])
    order, sigma = [k for group in groups for k in group], join("sigma")
    redundancy = np.sum([of_group.redundancy for of_group in of_groups], axis=0)
    for part, axes in enumerate(([0, 1], [2])):
        estimated = _is_estimated(control, axes)
        total = sum(
            # One σ for all of them in a group.
            of_group.redundancy[part] * of_group.sigma[:, axes][estimated[group]][0] ** 2
            for group, of_group in zip(groups, of_groups)
            if of_group.redundancy[part]
        )
        if redundancy[part]:
            sigma[:, axes] = np.where(
                estimated[order], np.sqrt(total / redundancy[part]), sigma[:, axes]
            )
    lacking = np.all([of_group.assumed for of_group in of_groups], axis=0)
    return order, Assessment(
        join("used"),
        sigma,
        (float(redundancy[0]), float(redundancy[1])),
        join("error"),
        join("error_sigma"),
        join("probability"),
        (bool(lacking[0]), bool(lacking[1])),
        max(of_group.factor for of_group in of_groups),
    )


def with_heights_as_in_plane(
    control: Points, usable: Sequence[int], assessed: Assessment
) -> Points:
    """Control with the σ in the plane as that of heights, where these have a smaller one: a block
    that bends to a plane of zeros leaves no residuals that would show their errors; `usable`: the
    points of the assessment."""
    sigma = control.sigma.copy()
    estimated = _is_estimated(control, [2])[:, 0]
    # All estimated ones have one σ; of stated ones the largest.
    in_plane, is_estimated = assessed.sigma[:, 0], _is_estimated(control, [0])[list(usable), 0]
    plane = float(in_plane[is_estimated if is_estimated.any() else slice(None)].max())
    if not estimated.any() or assessed.sigma[:, 2].max() >= plane:
        return control
    sigma[estimated, 2] = plane
    return dataclasses.replace(control, sigma=sigma)


def _is_estimated(control: Points, axes: Sequence[int]) -> Bool[np.ndarray, "n axes"]:
    """Whether σ of points on some axes is to be estimated: not stated, and not 0 of fixed ones."""
    fixed = np.array([role == "fixed" for role in control.role], bool)
    return np.isnan(control.sigma[:, axes]) & ~fixed[:, None]


def choose_control(
    block: OrientedBlock,
    control: Points,
    measured: dict[str, MeasuredPoint],
    usable: Sequence[int],
    assessed: Assessment,
    assumed: float,
) -> ControlChoice:
    """Which points and measurements are used."""
    sigma = control.sigma.copy()
    for k in range(3):
        unknown = np.isnan(sigma[:, k])
        estimated = _is_estimated(control, [k])[list(usable), 0]
        sigma[unknown, k] = assessed.sigma[estimated, k][0] if estimated.any() else assumed
    # Stated σ that most points contradict are multiplied by one factor, estimated ones fit already.
    sigma[np.isfinite(control.sigma)] *= assessed.factor
    choice = ControlChoice(dict(measured), np.zeros(len(control), bool), sigma, {}, {}, assessed)
    row = {k: n for n, k in enumerate(usable)}
    # The offset of satellite positions against control, by the points that agree.
    shift = np.zeros(3)
    agreed = [k for k, n in row.items() if assessed.used[n]]
    if agreed:
        X = block.X[[block.row_of_determined[control.id[k]] for k in agreed]]
        shift = np.median(X - control.position[agreed], axis=0)
    for k, id in enumerate(control.id):
        point = measured[id]
        if not len(point.rows):
            choice.reasons[id] = "in no oriented photograph"
        elif k in row:
            n = row[k]
            choice.used[k] = assessed.used[n]
            if not assessed.used[n]:
                choice.reasons[id] = _describe_error(assessed, n)
        elif point.good.any():
            # Snooping took it from the block, and its rays meet in the frame of control.
            choice.used[k] = control.role[k] != "check"
        else:
            _settle_by_coordinates(block, choice, k, control, shift)
        _name_wrong(block, choice, id)
    _name_exchanged(block, control, choice, {k: n for k, n in row.items() if not assessed.used[n]})
    return choice


def _describe_error(assessed: Assessment, n: int) -> str:
    error, sigma = assessed.error[n], assessed.error_sigma[n]
    is_finite = np.isfinite(error)
    parts = (f"{axis} {e:+.2f}" for axis, e in zip("XYZ", error) if np.isfinite(e))
    ratio, length = np.max(np.abs(error / sigma)[is_finite]), np.linalg.norm(error[is_finite])
    return (
        f"the other points and the photographs put it {length:.2f} m from its "
        f"coordinates ({', '.join(parts)} m), {ratio:.1f} times the σ of this prediction"
    )


def _settle_by_coordinates(
    block: OrientedBlock,
    choice: ControlChoice,
    k: int,
    control: Points,
    shift: Float[np.ndarray, "3"],
) -> None:
    """A point whose rays do not meet, or that has only one: its rays are compared with its
    coordinates."""
    id, point = control.id[k], choice.points[control.id[k]]
    X = control.position[k] + shift
    # Without a height, that of the points around.
    if np.isinf(control.sigma[k, 2]):
        heights = [block.X[row, 2] for row in block.row_of_determined.values()]
        X[2] = np.median(heights) if heights else X[2]
    sigma_of_coordinates = np.sqrt(
        (np.where(np.isfinite(choice.sigma[k]), choice.sigma[k], 0.0) ** 2).sum()
    )
    misses = block.misses(point, X)
    # σ of the measurement and, in pixels, of the coordinates
    sigma = np.hypot(point.sigma, sigma_of_coordinates / block.pixel_length(point, X))
    agree = misses < block.settings.wrong_ray * sigma
    # If exactly one of several rays that do not meet passes the coordinates, that one is right.
    if control.role[k] == "check" or (len(point.rows) > 1 and agree.sum() != 1):
        number = count(len(point.rows), "ray")
        choice.reasons[id] = (
            f"its {number} do not meet"
            if len(point.rows) > 1
            else "a check point needs two rays, it has 1"
        )
    elif agree.any():
        # Without a position: two rays that do not meet do not tell which of the others is wrong.
        choice.points[id] = dataclasses.replace(point, good=agree)
        choice.used[k] = True
    else:
        passes = block.distances(point, X)[0]
        choice.reasons[id] = (
            f"its only ray, in {block.name_of(point, 0)}, misses its coordinates by "
            f"{misses[0]:.0f} px, {passes:.1f} m"
        )


def _name_wrong(block: OrientedBlock, choice: ControlChoice, id: str) -> None:
    """Remarks about the measurements of a point that do not agree with the others."""
    point = choice.points[id]
    X = point.position
    if not np.isfinite(X).all():
        return
    misses, passes = block.misses(point, X), block.distances(point, X)
    for n in np.flatnonzero(~point.good).tolist():
        message = (
            f"{block.name_of(point, n)} is a wrong measurement and not used: {misses[n]:.0f} px "
            "from where the other photographs see it, and its ray misses the point by "
            f"{passes[n]:.2f} m"
        )
        other_point = block.seen_there(point, n, id, choice.points)
        choice.errors.setdefault(id, []).append(
            message
            + (f"; it is at the place of {other_point}: a wrong name" if other_point else "")
        )


def _name_exchanged(
    block: OrientedBlock, control: Points, choice: ControlChoice, bad: Mapping[int, int]
) -> None:
    """Pairs of contradictory points whose coordinates fit if they are exchanged.

    **Arguments:** `bad`: rows of the contradictory points, and in the assessment."""
    assessed, fitting = choice.assessment, block.settings.wrong_ray
    for i, n in bad.items():
        # From the others: the offset of satellite positions is that of the points that agree.
        predicted = control.position[i] + assessed.error[n]
        # σ² of the prediction without that of the coordinates of this point
        of_prediction = np.maximum(assessed.error_sigma[n] ** 2 - choice.sigma[i] ** 2, 0.0)
        for j in bad:
            difference, sigma = predicted - control.position[j], choice.sigma[j]
            # Axes that are not controlled at both points tell nothing.
            is_comparable = np.isfinite(difference) & np.isfinite(sigma)
            is_within = np.abs(difference) < fitting * np.sqrt(of_prediction + sigma**2)
            if i != j and is_comparable.any() and is_within[is_comparable].all():
                choice.reasons[control.id[i]] += f"; it fits the coordinates of {control.id[j]}"
