"""Cameras around a room, calibrated by a wand: markers on a stick, at known distances, waved about.

Cameras stand still; every frame has the markers at other places, which are points of a network, and
their known distances are observations of it. Interior orientations are given, held or free. The
frame is that of the first camera, the scale that of the wand.

Sources: Borghese and Cerveri (2000), Calibrating a video camera pair with a rigid bar, Pattern
Recognition 33; Mitchelson and Hilton (2003), Wand-based multiple camera studio calibration.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import positive, show
from jaxbundle.calibration.rig.mounting import Mounting, mounting_of, table_of_mountings
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
)
from jaxbundle.io.networks.rig_result import network_of_rig
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.leastsquares import PoseValue
from jaxbundle.network.build import make_network
from jaxbundle.network.columns import count, did_you_mean, list_some
from jaxbundle.network.tables import Camera, Network
from jaxbundle.results import TableMethods

# A marker in an image: frame, name of the marker, x, y (pixels).
Marks = list[tuple[str, str, float, float]]
COLUMNS = "frame, x, y and marker"


@dataclasses.dataclass(frozen=True)
class WandSettings:
    """How markers of a wand without names are told apart.

    **Fields:** `min_ratio`: of the longer to the shorter of the two distances from the middle
    marker. Perspective changes a ratio in the image by the ratio of the depths of the ends: a wand
    of a third of its distance, pointing at the camera, by 1.4.
    """

    min_ratio: float = 1.5


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class WandCalibration(TableMethods):
    """Cameras calibrated by a wand; **Fields:** `adjustment`: the result of all observations;
    `names` of the cameras, the first is the reference; `notes`: what was not used."""

    adjustment: Adjustment
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def converged(self) -> bool:
        return self.adjustment.converged

    @property
    def mountings(self) -> dict[str, Mounting]:
        """The mounting of every camera but the first in the frame of that, with its covariance."""
        row = {name: k for k, name in enumerate(self.adjustment.problem.network.images.id)}
        # poses of the network are in the datum of all points (inner constraints): only relative
        # ones, and their σ, do not depend on it
        first, found = row[self.names[0]], {}
        for name in self.names[1:]:
            at = _relative(self.adjustment.values["image"], first, row[name])
            R = matrix_from_quaternion(at.rotation)

            def change(values: Mapping[str, Any], k: int = row[name], R: Array = R) -> Array:
                moved = _relative(values["image"], first, k)
                turn = rotation_vector_from_matrix(matrix_from_quaternion(moved.rotation) @ R.T)
                return jnp.concatenate([jnp.asarray(moved.position), turn])

            C = self.adjustment.covariance_of(change)
            found[name] = mounting_of(PoseValue(*map(np.asarray, at)), np.asarray(C))
        return found

    def network(self) -> Network:
        """The cameras on their mountings as a network of one image each, as of a
        `RigCalibration`: to write for other programs (`jaxbundle.io`)."""
        cameras = {one.id: one for one in self.adjustment.problem.network.cameras}
        adjusted = [
            dataclasses.replace(cameras[name], parameters=self.adjustment.camera_parameters(name))
            for name in self.names
        ]
        mountings = self.mountings.values()
        return network_of_rig(
            Path("rig"),
            adjusted,
            [np.eye(3), *(one.rotation for one in mountings)],
            [np.zeros(3), *(one.base for one in mountings)],
        )

    def table(self) -> dict[str, np.ndarray]:
        """One row a mounting: columns camera, X0, Y0, Z0 (of the base, object unit), omega, phi,
        kappa (degrees), their σ (sX0, …), base and sbase (its length)."""
        return table_of_mountings(self.mountings)

    def report(self) -> str:
        return f"{self}\n\n{self.adjustment.report()}"

    def to_dict(self) -> dict[str, Any]:
        """The mountings, and the result of the adjustment (`adjustment`), as dicts and numbers."""
        return {
            "reference": self.names[0],
            "mountings": {
                name: {
                    "base": m.base.tolist(),
                    "angles": m.angles.tolist(),
                    "rotation": m.rotation.tolist(),
                    "covariance": m.covariance.tolist(),
                    "length": m.length,
                    "sigma_length": m.length_sigma,
                }
                for name, m in self.mountings.items()
            },
            "notes": list(self.notes),
            "adjustment": self.adjustment.to_dict(),
        }

    def __str__(self) -> str:
        unit = self.adjustment.problem.network.object_unit
        lines = [
            f"{count(len(self.names), 'camera')} by a wand, reference {self.names[0]}, σ0 "
            f"{self.adjustment.sigma0:.3f}"
        ]
        for name, m in self.mountings.items():
            base = ", ".join(f"{x:.6g} ± {s:.2g}" for x, s in zip(m.base, m.sigma))
            turn = ", ".join(f"{x:.5g} ± {s:.2g}" for x, s in zip(m.angles, m.sigma[3:]))
            lines.append(f"{name}: base {base} {unit}; ω, φ, κ {turn} deg")
        return "\n".join([*lines, *(f"note: {said}" for said in self.notes)])


def _relative(images: PoseValue, first: int, k: int) -> PoseValue:
    """The pose of an image in the frame of another one."""
    M = matrix_from_quaternion(images.rotation[first])
    R = matrix_from_quaternion(images.rotation[k]) @ M.T
    base = M @ (images.position[k] - images.position[first])
    return PoseValue(base, quaternion_from_matrix(R))


def calibrate_wand(
    markers: Mapping[str, Any],
    cameras: Mapping[str, Camera],
    lengths: float | Mapping[tuple[str, str], float],
    *,
    sigma_length: float,
    sigma_image: float | None = None,
    object_unit: str = "m",
    settings: WandSettings | None = None,
    **options: Any,
) -> WandCalibration:
    """Calibrate cameras that stand still by a wand of known length, waved before them.

    **Arguments:**

    - `markers` by the name of the camera, the first is the reference: a table, or the path of a
      CSV, with the columns frame, x, y (pixels) and marker (its name). Frames of one name are
      simultaneous. Without `marker`, of a wand of three markers in a line, unevenly spaced, they
      are told apart by their distances.
    - `cameras`: interior orientation by name; what is `free` of it is estimated as well.
    - `lengths`: between two markers, by their names: `{("A", "B"): 0.5}`; or that of a wand of two.
    - `sigma_length` of these, `sigma_image` in pixels (default: a unit of weight).
    - `options`: of `jaxbundle.adjust`.

    Cameras are oriented one after the other: each needs frames that it shares with one before it.

    **Raises:** `InputError` naming camera, frame and marker; `NotSolvedError` if the cameras do not
    hang together.
    """
    positive("sigma_length", sigma_length)
    if not isinstance(markers, Mapping) or len(markers) < 2:
        raise InputError("markers: those of two cameras at least are expected, by their names")
    for name in markers:
        if name not in cameras:
            raise InputError(
                f"cameras: none {name!r}{did_you_mean(name, cameras)}; expected the interior "
                "orientation of every camera"
            )
    marks = {name: _marks(name, given) for name, given in markers.items()}
    pairs, notes = _pairs(lengths, marks), []
    for name, own in marks.items():
        if own and not own[0][1]:
            marks[name], said = _told_apart(name, own, pairs, settings or WandSettings())
            notes += said
    network, said = _network(marks, cameras, pairs, sigma_length, sigma_image, object_unit)
    return WandCalibration(adjust(network, **options), tuple(markers), (*notes, *said))


def _marks(camera: str, given: Any) -> Marks:
    """The measurements of a camera."""
    table = read_csv(Path(given)).values if isinstance(given, str | Path) else given
    if not isinstance(table, Mapping):
        raise InputError(
            f"markers of camera {camera!r}: got {show(given)}; expected a table with the columns "
            f"{COLUMNS}, or its path"
        )
    for name in ("frame", "x", "y"):
        if name not in table:
            where = given if isinstance(given, str | Path) else f"markers of camera {camera!r}"
            raise InputError(f"{where}: column {name!r} is missing; expected columns: {COLUMNS}")
    names = table.get("marker", [""] * len(table["frame"]))
    found, seen = [], set()
    for frame, name, x, y in zip(table["frame"], names, table["x"], table["y"]):
        try:
            xy = float(x), float(y)
        except (TypeError, ValueError):
            xy = np.nan, np.nan
        where = f"markers of camera {camera!r}, frame {frame}"
        if not np.isfinite(xy).all():
            raise InputError(f"{where}: got x {show(x)}, y {show(y)}; expected pixels")
        if str(name) and (str(frame), str(name)) in seen:
            raise InputError(f"{where}: marker {name!r} is there twice")
        seen.add((str(frame), str(name)))
        found.append((str(frame), str(name), *xy))
    without = next((mark for mark in found if not mark[1]), None)
    if without is not None and any(name for _, name, *_ in found):
        raise InputError(
            f"markers of camera {camera!r}, frame {without[0]}: a marker has no name, others have; "
            "expected a name for each, or for none"
        )
    return found


def _pairs(
    lengths: float | Mapping[tuple[str, str], float], marks: Mapping[str, Marks]
) -> dict[tuple[str, str], float]:
    """The known lengths by their markers."""
    names = sorted({name for own in marks.values() for _, name, *_ in own} - {""})
    if not isinstance(lengths, Mapping):
        if len(names) != 2:
            raise InputError(
                "lengths: one is given, of two markers, but the markers are "
                f"{list_some(names) or 'without names'}; "
                'expected the length of each pair, such as {("A", "B"): 0.5}'
            )
        lengths = {(names[0], names[1]): lengths}
    for pair, length in lengths.items():
        of_two = isinstance(pair, tuple) and len({*pair}) == len(pair) == 2
        if not (of_two and all(isinstance(name, str) for name in pair)):
            raise InputError(
                f'lengths: of {show(pair)}; expected two markers, such as {{("A", "B"): 0.5}}'
            )
        positive(f"lengths: of {' and '.join(pair)}", length)
        for name in pair if names else ():
            if name not in names:
                raise InputError(f"lengths: there is no marker {name!r}{did_you_mean(name, names)}")
    return dict(lengths)


def _told_apart(
    camera: str,
    marks: Marks,
    pairs: Mapping[tuple[str, str], float],
    settings: WandSettings,
) -> tuple[Marks, list[str]]:
    """Names of markers in a line by the ratio of their distances; frames with another number of
    them are not used."""
    names = sorted({name for pair in pairs for name in pair})
    size = {frozenset(pair): length for pair, length in pairs.items()}
    if len(names) != 3 or len(size) < 2:
        raise InputError(
            f"markers of camera {camera!r} have no names (marker): only three in a line, whose "
            "distances are given, can be told apart"
        )
    # the pair that is not given, or the longest, are the ends
    others = [frozenset(n for n in names if n != one) for one in names]
    middle = max(range(3), key=lambda k: size.get(others[k], np.inf))
    ends = [name for name in names if name != names[middle]]
    away = [size[frozenset((names[middle], end))] for end in ends]
    if max(away) < settings.min_ratio * min(away):
        raise InputError(
            f"markers of camera {camera!r} have no names (marker), and the middle one is nearly "
            f"half way between the others ({away[0]:g}, {away[1]:g}): they cannot be told apart"
        )
    frames: dict[str, list[tuple[float, float]]] = {}
    for frame, _, x, y in marks:
        frames.setdefault(frame, []).append((x, y))
    found, left = [], 0
    for frame, seen in frames.items():
        if len(seen) != 3:
            left += 1
            continue
        xy = np.array(seen)
        apart = np.linalg.norm(xy[:, None] - xy, axis=2)
        # the middle one is opposite to the longest side
        centre = int(np.argmin(apart.sum(1)))
        near, far = sorted((k for k in range(3) if k != centre), key=lambda k: apart[centre, k])
        order = ends if away[0] < away[1] else ends[::-1]
        by = {centre: names[middle], near: order[0], far: order[1]}
        found += [(frame, by[k], *seen[k]) for k in range(3)]
    said = f"camera {camera!r}: {count(left, 'frame')} without exactly three markers not used"
    return found, [said] * bool(left)


def _network(
    marks: Mapping[str, Marks],
    cameras: Mapping[str, Camera],
    pairs: Mapping[tuple[str, str], float],
    sigma_length: float,
    sigma_image: float | None,
    object_unit: str,
) -> tuple[Network, list[str]]:
    """The network of all frames, of markers that two cameras see at least."""
    rays: dict[str, int] = {}
    for own in marks.values():
        for frame, name, *_ in own:
            rays[f"{frame}:{name}"] = rays.get(f"{frame}:{name}", 0) + 1
    # one ray and one known distance are as many observations as a point has unknowns: such a point
    # would be met exactly, and on either of two places along its ray
    seen = {point for point, number in rays.items() if number > 1}
    rows = [
        (camera, f"{frame}:{name}", x, y)
        for camera, own in marks.items()
        for frame, name, x, y in own
        if f"{frame}:{name}" in seen
    ]
    frames = dict.fromkeys(frame for own in marks.values() for frame, *_ in own)
    known = [
        (f"{frame}:{a}", f"{frame}:{b}", length)
        for frame in frames
        for (a, b), length in pairs.items()
        if {f"{frame}:{a}", f"{frame}:{b}"} <= seen
    ]
    if not known:
        raise InputError(
            "no frame shows both ends of a known length to two cameras: are frames of equal names "
            "simultaneous?"
        )
    alone, names = len(rays) - len(seen), list(marks)
    network = make_network(
        [dataclasses.replace(cameras[name], id=name) for name in names],
        {"id": names, "camera": names},
        {"id": sorted(seen), "role": ["tie"] * len(seen)},
        dict(zip(("image", "point", "x", "y"), map(list, zip(*rows)))),
        {
            **dict(zip(("from", "to", "value"), map(list, zip(*known)))),
            "sigma": [sigma_length] * len(known),
        },
        datum="inner",
        residuals="measured",
        image_unit="px",
        sigma_image=sigma_image,
        object_unit=object_unit,
        angle_unit="deg",
        name="wand",
    )
    said = f"{count(alone, 'marker')} seen by one camera only, not used"
    return network, [said] * bool(alone)
