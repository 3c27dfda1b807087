"""Mistakes in all control points at once: wrong axes or units of their coordinates, wrong columns
or axes of their image points."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Points
from jaxbundle.orientation.control_axes import describe_wrong_axes
from jaxbundle.orientation.settings import DEFAULTS
from jaxbundle.reconstruction.oriented_block import MIN_CONTROL, MeasuredPoint, OrientedBlock


def refuse_wrong_axes(block: OrientedBlock, control: Points, usable: Sequence[int]) -> str:
    """Refuse control that fits the block with other axes or units alone. Where its own errors could
    be why it fits better with them, that it does, in words; else empty.

    **Raises:** `InputError`."""
    places = [k for k in usable if not np.isinf(control.sigma[k]).any()]
    rows = [block.row_of_determined[control.id[k]] for k in places]
    positions = block.X[rows], control.position[places]
    if wrong := describe_wrong_axes(*positions, "m"):
        raise InputError(wrong)
    doubt = describe_wrong_axes(*positions, "m", times_better=DEFAULTS.doubted_axes)
    return f"{doubt}; or its errors are that large" if doubt else ""


def refuse_wrong_columns(block: OrientedBlock, measured: Mapping[str, MeasuredPoint]) -> None:
    """Refuse image points of control whose rays do not meet: with the mistake of their columns or
    axes without which they would, or because too few points are left.

    **Raises:** `InputError`."""
    several = [point for point in measured.values() if len(point.rows) > 1]
    meeting = _number_meeting(measured)
    if meeting >= MIN_CONTROL and 2 * meeting >= len(several):
        return
    if len(several) - meeting < MIN_CONTROL:
        return  # too few of them to say more than that control is missing
    misses = np.array([block.smallest_miss(point) for point in several if point.good.sum() < 2])
    words = (
        f"of {count(len(several), 'control point')} measured in two photographs or more the rays "
        f"of {meeting} meet"
    )
    # Infinite where they meet behind a camera.
    if len(finite := misses[np.isfinite(misses)]):
        words += (
            f"; the nearest two of the others miss each other by {np.median(finite):.0f} pixels "
            "(median)"
        )
    exchanged, upwards = block.frame.named.xy[:, ::-1], _upwards(block)
    for xy, mistake in (
        (exchanged, "u and v exchanged"),
        (upwards, "v counted from the other edge"),
    ):
        named = dataclasses.replace(block.frame.named, xy=xy)
        frame = dataclasses.replace(block.frame, named=named)
        others = OrientedBlock(block.result, frame, block.settings).resolve()
        if _number_meeting(others) >= max(MIN_CONTROL, 2 * meeting):
            raise InputError(f"{words}; with {mistake} those of {_number_meeting(others)} meet")
    if meeting < MIN_CONTROL and not block.has_positions:
        raise InputError(
            f"{words}: check the names of points and photographs, and that u and v are pixels of "
            "the photographs as they are given"
        )


def _number_meeting(measured: Mapping[str, MeasuredPoint]) -> int:
    return sum(bool(point.good.sum() > 1) for point in measured.values())


def _upwards(block: OrientedBlock) -> Float[np.ndarray, "n 2"]:
    """The image points of control with v counted in the other direction, in photographs of known
    size."""
    named, xy = block.frame.named, block.frame.named.xy.copy()
    for k, image in enumerate(named.image):
        row = block.row.get(block.frame.names[image])
        camera = None if row is None else block.cameras[block.network.images.camera[row]]
        if camera is not None and camera.image_size is not None:
            xy[k, 1] = camera.image_size[1] - 1 - xy[k, 1]
    return xy
