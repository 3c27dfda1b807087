"""What is known of the mountings of a rig before its calibration: as in a project.

    [rig]
    mounting.right = { position = [0.5, 0, 0], sigma_position = [inf, 0.001, 0.001] }
    bases = [{ cameras = ["left", "right"], length = 0.5, sigma = 1e-4 }]

Positions are in the unit of the board, in the frame of the reference camera, angles in degrees
(`jaxbundle.network.kinds.mountings`).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.text.sections import read_sections
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.kinds.mountings import Base, GivenMounting, read_bases, read_mountings

SECTION, KEYS = "rig", ("mounting", "bases")


class KnownMountings(NamedTuple):
    """What is known of mountings by the name of the camera, and of distances of cameras."""

    mountings: Mapping[str, GivenMounting]
    bases: Sequence[Base]

    def positions(self, cameras: Sequence[str]) -> dict[int, Float[np.ndarray, "3"]]:
        """The given positions, by the index of the camera."""
        return {
            cameras.index(name): mounting.position
            for name, mounting in self.mountings.items()
            if mounting.position is not None
        }


NOTHING_KNOWN = KnownMountings({}, ())


def known_mountings(
    mountings: Mapping[str, Any] | str | Path | None,
    bases: Sequence[Mapping[str, Any]],
    cameras: Sequence[str],
) -> KnownMountings:
    """What is given of the mountings of some cameras, the first of which is the reference.

    **Arguments:** `mountings` by camera, or a file with a section `[rig]`; `bases`.

    **Raises:** `InputError` naming file, camera and key.
    """
    where = ""
    if isinstance(mountings, str | Path):
        where = f"{mountings}: "
        file = read_sections(Path(mountings), {SECTION: KEYS}, (SECTION,))
        section = file.document[SECTION]
        mountings, bases = section.get("mounting", {}), [*section.get("bases", ()), *bases]
    try:
        known = KnownMountings(
            read_mountings(SECTION, {} if mountings is None else mountings, np.pi / 180),
            read_bases(SECTION, bases),
        )
        for name in (*known.mountings, *(name for base in known.bases for name in base.cameras)):
            if name not in cameras:
                raise InputError(f"no camera {name!r} is given{did_you_mean(name, cameras)}")
        if cameras[0] in known.mountings:
            raise InputError(
                f"mounting.{cameras[0]}: {cameras[0]!r} is the reference camera, which the others "
                "are mounted to; give theirs, or another camera first"
            )
    except InputError as error:
        raise InputError(f"{where}{error}") from None
    return known
