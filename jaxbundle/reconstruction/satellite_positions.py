"""Satellite positions of photographs: their system, and whether they define the frame."""

from collections.abc import Sequence

import numpy as np

from jaxbundle.photographs.places import MapPositions, map_positions
from jaxbundle.reconstruction.control import Control
from jaxbundle.reconstruction.photographs import Photograph

# Of positions that are too near each other for a direction and a scale (`map_positions`).
NARROW = (
    "satellite positions of the photographs extend over less than 8 σ: they do not define the frame"
)


def find_positions(
    photographs: Sequence[Photograph], control: Control | None
) -> tuple[MapPositions | None, list[str]]:
    """The satellite positions of the photographs in the system of control, else in their UTM zone,
    and what is done with them."""
    places = [p.exif.place for p in photographs]
    number_with_position = sum(place is not None for place in places)
    if control is None:
        positions = map_positions(places)
        if positions is None:
            return None, [
                f"satellite positions of {number_with_position} photographs are not used: expected "
                "three or more with heights"
            ] * bool(number_with_position)
        if not positions.define_frame:
            return positions, [NARROW]
        return positions, [f"satellite positions of the photographs: {positions.words}"]
    notes = [f"control in {control.system or 'a system that its file does not name'}"]
    if not number_with_position:
        return None, [
            *notes,
            "no satellite positions in the photographs: control alone gives the frame",
        ]
    positions = map_positions(places, control.system)
    if positions is None:
        return None, [
            *notes,
            f"satellite positions of {number_with_position} photographs are not used: they need "
            "heights, three photographs, and a system of control in metres",
        ]
    # A system without a name is taken for the UTM zone of the positions, unless it is far from them
    if not control.system:
        difference = np.nanmedian(positions.X, 0) - np.median(control.points.position, axis=0)
        distance = float(np.hypot(*difference[:2]))
        # Metres in their UTM zone: a block from the air is smaller, another system is farther.
        if distance > 10_000:
            return None, [
                *notes,
                "satellite positions of the photographs are not used: they are "
                f"{distance / 1000:.0f} km from control in {positions.system}; name the "
                "system of control in the first line of gcp_list.txt",
            ]
    # They stay observations, but control alone gives the frame.
    notes += [] if positions.define_frame else [NARROW]
    return positions, [
        *notes,
        f"satellite positions of {int(np.isfinite(positions.X[:, 0]).sum())} "
        f"photographs with their σ, in {positions.words}",
    ]
