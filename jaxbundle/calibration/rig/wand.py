"""Cameras around a room, calibrated by a wand: markers on a stick, at known distances, waved about.

Cameras stand still; every frame has the markers at other places, which are points of a network, and
their known distances are observations of it. Interior orientations are given, held or free. The
frame is that of the first camera, the scale that of the wand.

The lengths l_i of the wand are the same in all frames, and so are their errors: however many frames
there are, the scale is known as well as by each length once, and a base b with

    C_b + σ_s²·b·bᵀ,        σ_s = σ_l/√(Σ l_i²)

where C_b is its covariance from the adjustment, in which lengths of frames are independent.

Sources: Borghese and Cerveri (2000), Calibrating a video camera pair with a rigid bar, Pattern
Recognition 33; Mitchelson and Hilton (2003), Wand-based multiple camera studio calibration.
"""

import dataclasses
import functools
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import positive, show
from jaxbundle.calibration.rig.mounting import Mounting, mounting_of, table_of_mountings
from jaxbundle.calibration.rig.wand_images import are_images, measure_wand, replaced_sigma
from jaxbundle.calibration.rig.wand_markers import Mark, Marks, WandSettings, name_markers
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
from jaxbundle.measure.moving_blobs import BlobSettings
from jaxbundle.network.build import make_network
from jaxbundle.network.columns import count, did_you_mean, is_missing, list_some
from jaxbundle.network.tables import Camera, Network
from jaxbundle.results import TableMethods
from jaxbundle.types import Progress

COLUMNS = "frame, x, y, marker, sx and sy (σ)"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class WandCalibration(TableMethods):
    """Cameras calibrated by a wand; **Fields:** `adjustment`: the result of all observations;
    `names` of the cameras, the first is the reference; `scale_sigma`: relative σ of the scale, by
    the lengths of the wand; `notes`: what was not used; `markers` by camera, with their names;
    `lengths` between them."""

    adjustment: Adjustment
    names: tuple[str, ...]
    scale_sigma: float = 0.0
    notes: tuple[str, ...] = ()
    markers: Mapping[str, Marks] = dataclasses.field(default_factory=dict, repr=False)
    lengths: Mapping[tuple[str, str], float] = dataclasses.field(default_factory=dict)

    @property
    def converged(self) -> bool:
        return self.adjustment.converged

    @functools.cached_property
    def mountings(self) -> dict[str, Mounting]:
        """The mounting of every camera but the first in the frame of that, with its covariance."""
        row = {name: k for k, name in enumerate(self.adjustment.problem.network.images.id)}
        reference_row, *other_rows = (row[name] for name in self.names)
        C = np.asarray(self.adjustment.covariance_of(_Mountings(reference_row, tuple(other_rows))))
        mountings_found = {}
        for k, name in enumerate(self.names[1:]):
            pose = _relative(self.adjustment.values["image"], reference_row, other_rows[k])
            covariance, base = (
                C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6].copy(),
                np.asarray(pose.position),
            )
            covariance[:3, :3] += self.scale_sigma**2 * np.outer(base, base)
            mountings_found[name] = mounting_of(PoseValue(*map(np.asarray, pose)), covariance)
        return mountings_found

    def network(self) -> Network:
        """The cameras on their mountings as a network of one image each, as of a
        `RigCalibration`: to write for other programs (`jaxbundle.io`)."""
        cameras = {
            camera_of_network.id: camera_of_network
            for camera_of_network in self.adjustment.problem.network.cameras
        }
        adjusted = [
            dataclasses.replace(cameras[name], parameters=self.adjustment.camera_parameters(name))
            for name in self.names
        ]
        mountings = self.mountings.values()
        return network_of_rig(
            Path("rig"),
            adjusted,
            [np.eye(3), *(mounting.rotation for mounting in mountings)],
            [np.zeros(3), *(mounting.base for mounting in mountings)],
            self.adjustment.network.object_unit,
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
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


@dataclasses.dataclass(frozen=True)
class _Mountings:
    """Bases and small turns of cameras in the frame of the first, as a function of all unknowns;
    equal ones share a program.

    Poses of networks are in the datum of all points (inner constraints): only relative ones, and
    their σ, do not depend on it."""

    reference_row: int
    other_rows: tuple[int, ...]

    def __call__(self, values: Mapping[str, Any]) -> Array:
        changes = []
        for k in self.other_rows:
            pose = _relative(values["image"], self.reference_row, k)
            R = matrix_from_quaternion(pose.rotation)
            turn = rotation_vector_from_matrix(R @ jax.lax.stop_gradient(R).T)
            changes += [jnp.asarray(pose.position), turn]
        return jnp.concatenate(changes)


def _relative(images: PoseValue, reference_row: int, k: int) -> PoseValue:
    """The pose of an image in the frame of another one."""
    M = matrix_from_quaternion(images.rotation[reference_row])
    R = matrix_from_quaternion(images.rotation[k]) @ M.T
    base = M @ (images.position[k] - images.position[reference_row])
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
    blobs: BlobSettings | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> WandCalibration:
    """Calibrate cameras that stand still by a wand of known length, waved before them.

    **Arguments:**

    - `markers` by the name of the camera, the first is the reference: a folder of photographs, a
      list of them, or a video; or a table, or the path of a CSV, with the columns frame, x, y
      (pixels), and optional ones: marker (its name), sx and sy (σ, pixels). Frames of one name, or
      of images one number, are simultaneous.
    - `cameras`: interior orientation by name; what is `free` of it is estimated as well.
    - `lengths`: between two markers, by their names: `{("A", "B"): 0.5}`; or that of a wand of two.
    - `sigma_length` of these, the same error in all frames; `sigma_image` in pixels (default: a
      unit of weight; of markers in images in proportion to the measured σ, times what their
      residuals say: a variance component).
    - `settings`: how markers without names (all in images) are told apart: three in a line,
      unevenly spaced, by their distances; two that look alike by their rays. `blobs`: what a marker
      is in an image, such as `BlobSettings(dark=True)`.
    - `progress(stage, done, total)`: frames searched. `options`: of `jaxbundle.adjust`.

    Cameras are oriented one after the other: each needs frames that it shares with one before it.

    **Raises:** `InputError` naming camera, frame and marker; `NotSolvedError` if the cameras do not
    hang together.
    """
    positive("sigma_length", sigma_length)
    if sigma_image is not None:
        positive("sigma_image", sigma_image)
    if not isinstance(markers, Mapping) or len(markers) < 2:
        raise InputError("markers: expected those of two cameras at least, by their names")
    for name in markers:
        if name not in cameras:
            raise InputError(
                f"cameras: none {name!r}{did_you_mean(name, cameras)}; expected the interior "
                "orientation of every camera"
            )
    images = {name: source for name, source in markers.items() if are_images(source)}
    tables = {name: _marks(name, source) for name, source in markers.items() if name not in images}
    frames = {
        name: [*dict.fromkeys(m.frame for m in marks_of_camera)]
        for name, marks_of_camera in tables.items()
    }
    pairs, notes, measured = _pairs(lengths, tables), [], {}
    if images:
        measured_and_notes = measure_wand(
            images, cameras, frames, blobs or BlobSettings(), progress
        )
        measured, notes = measured_and_notes
    if sigma_image is not None:
        measured = {
            name: replaced_sigma(marks_of_camera, sigma_image)
            for name, marks_of_camera in measured.items()
        }
    marks = {name: (measured if name in images else tables)[name] for name in markers}
    marks, remarks = name_markers(marks, cameras, pairs, settings or WandSettings())
    notes += remarks
    network_of_marks = lambda marks: _network(
        marks, cameras, pairs, sigma_length, sigma_image, object_unit
    )
    network, remarks = network_of_marks(marks)
    result = adjust(network, **options)
    if images and sigma_image is None and result.converged:
        # σ by the noise of the grey values: compression smooths it, and shifts centres by more.
        # They are weights of the markers among each other; residuals give their size
        factor = _residuals_over_sigma(result, images)
        for name in images:
            marks[name] = [m._replace(sx=factor * m.sx, sy=factor * m.sy) for m in marks[name]]
        result = adjust(network_of_marks(marks)[0], **options)
        remarks += [f"σ of markers in images: {factor:.2f} times what the noise says, by residuals"]
    longest = max(pairs.values())
    # Nobody waves a wand of ten metres; in millimetres it would be one of a centimetre at least.
    if object_unit == "m" and longest > 10:
        remarks += [f"the wand is {longest:g} m long: is this in mm? Lengths and σ are of one unit"]
    scale = sigma_length / float(np.sqrt(np.sum(np.square([*pairs.values()]))))
    return WandCalibration(result, tuple(markers), scale, (*notes, *remarks), marks, pairs)


def _residuals_over_sigma(result: Adjustment, cameras: Collection[str]) -> float:
    """√(Σ(v/σ)²/Σr) of the image points of some cameras: the size of their σ (a variance
    component)."""
    table = result.residuals
    rows = (table["kind"] == "image") & np.isin(table["image"].astype(str), [*cameras])
    ratio, r = (table["v"] / table["sigma"])[rows], table["r"][rows]
    is_tested = np.isfinite(ratio) & (r > 0)
    factor = float(np.sqrt((ratio[is_tested] ** 2).sum() / max(r[is_tested].sum(), 1.0)))
    # Exact images leave nothing.
    return factor if factor > 0 else 1.0


def _marks(camera: str, source: Any) -> Marks:
    """The markers of a camera that are given in a table.

    **Raises:** `InputError` naming file or camera, frame and column."""
    source_in_words = (
        str(source) if isinstance(source, str | Path) else f"markers of camera {camera!r}"
    )
    table = read_csv(Path(source)).values if isinstance(source, str | Path) else source
    if not isinstance(table, Mapping):
        raise InputError(
            f"{source_in_words}: got {show(source)}; expected a table with the columns {COLUMNS}, "
            "or its path, or images"
        )
    for name in ("frame", "x", "y"):
        if name not in table:
            raise InputError(
                f"{source_in_words}: column {name!r} is missing; expected columns: {COLUMNS}"
            )
    number = len(table["frame"])
    if not number:
        raise InputError(f"{source_in_words}: no markers; expected rows with {COLUMNS}")
    columns = [table.get(name, [""] * number) for name in ("frame", "marker", "x", "y", "sx", "sy")]
    marks, frames_and_markers = [], set()
    for frame, name, x, y, *sigma in zip(*columns):
        where = f"{source_in_words}, frame {frame}"
        xy = _numbers(x, y)
        if not np.isfinite(xy).all():
            raise InputError(f"{where}: got x {show(x)}, y {show(y)}; expected pixels")
        sigma_xy = _numbers(*(np.nan if is_missing(s) else s for s in sigma))
        if not all(is_missing(s) or sigma_value > 0 for s, sigma_value in zip(sigma, sigma_xy)):
            raise InputError(
                f"{where}: got sx {show(sigma[0])}, sy {show(sigma[1])}; expected a positive σ in "
                "pixels, or nothing"
            )
        marker = "" if is_missing(name) else str(name)
        if marker and (str(frame), marker) in frames_and_markers:
            raise InputError(f"{where}: marker {marker!r} is there twice")
        frames_and_markers.add((str(frame), marker))
        marks.append(Mark(str(frame), marker, *xy, *sigma_xy))
    nameless = next((mark for mark in marks if not mark.marker), None)
    if nameless is not None and any(mark.marker for mark in marks):
        raise InputError(
            f"{source_in_words}, frame {nameless.frame}: a marker has no name, others have; "
            "expected a name for each, or for none"
        )
    return marks


def _numbers(x: Any, y: Any) -> tuple[float, float]:
    """Two numbers, NaN if one of them is none."""
    try:
        return float(x), float(y)
    except (TypeError, ValueError):
        return np.nan, np.nan


def _pairs(
    lengths: float | Mapping[tuple[str, str], float], marks: Mapping[str, Marks]
) -> dict[tuple[str, str], float]:
    """The known lengths by their markers."""
    names = sorted(
        {mark.marker for marks_of_camera in marks.values() for mark in marks_of_camera} - {""}
    )
    if not isinstance(lengths, Mapping):
        # The markers of a wand of two need no names.
        names = names or ["A", "B"]
        if len(names) != 2:
            raise InputError(
                f"lengths: one is given, of two markers, but the markers are {list_some(names)}; "
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
    for marks_of_camera in marks.values():
        for mark in marks_of_camera:
            point = f"{mark.frame}:{mark.marker}"
            rays[point] = rays.get(point, 0) + 1
    # One ray and one known distance are as many observations as a point has unknowns: such a point
    # would be met exactly, and on either of two places along its ray.
    seen_points = {point for point, number in rays.items() if number > 1}
    rows = [
        (camera, f"{frame}:{name}", x, y, *(s if np.isfinite(s) else None for s in sigma))
        for camera, marks_of_camera in marks.items()
        for frame, name, x, y, *sigma in marks_of_camera
        if f"{frame}:{name}" in seen_points
    ]
    frames = dict.fromkeys(
        mark.frame for marks_of_camera in marks.values() for mark in marks_of_camera
    )
    known_lengths = [
        (f"{frame}:{a}", f"{frame}:{b}", length)
        for frame in frames
        for (a, b), length in pairs.items()
        if {f"{frame}:{a}", f"{frame}:{b}"} <= seen_points
    ]
    if not known_lengths:
        raise InputError(
            "no frame shows both ends of a known length to two cameras: are frames of equal names "
            "simultaneous?"
        )
    number_alone, names = len(rays) - len(seen_points), list(marks)
    network = make_network(
        [dataclasses.replace(cameras[name], id=name) for name in names],
        {"id": names, "camera": names},
        {"id": sorted(seen_points), "role": ["tie"] * len(seen_points)},
        dict(zip(("image", "point", "x", "y", "sx", "sy"), map(list, zip(*rows)))),
        {
            **dict(zip(("from", "to", "value"), map(list, zip(*known_lengths)))),
            "sigma": [sigma_length] * len(known_lengths),
        },
        datum="inner",
        residuals="measured",
        image_unit="px",
        sigma_image=sigma_image,
        object_unit=object_unit,
        angle_unit="deg",
        name="wand",
    )
    remark = f"{count(number_alone, 'marker')} seen by one camera only, not used"
    return network, [remark] * bool(number_alone)
