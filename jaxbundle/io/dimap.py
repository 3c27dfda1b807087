"""DIMAP metadata of SPOT 5 scenes (level 1A): ephemeris, corrected attitudes, look angles.

By the SPOT 123-4-5 Geometry Handbook (GAEL-P135-DOC-001), with angles in radians:

    u = M·[−tan ψ_Y, tan ψ_X, −1]                                                      (5a)
    M = Mp·Mr·My,   Rx(−pitch)·Ry(−roll)·Rz(yaw) in the notation used here             (11)
    X = P + s·[X₂ Y₂ Z₂]·u,    Z₂ = P/|P|,  X₂ = V × Z₂/|…|,  Y₂ = Z₂ × X₂             (7)
    t = t_centre + period·(line − line_centre)

Its camera frame and its orbital frame are ours; its pitch and roll have the other sign. Lines count
from 1 there, from 0 here. Positions and velocities by Lagrange's polynomial through eight rows; the
attitudes, turned into Earth-fixed quaternions at their own times, by slerp. Where they end a little
before the image does (`ancillary.extrapolation_limit`), the angles go on linearly.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.csv_tables import read_text
from jaxbundle.io.scanner import Scanner
from jaxbundle.network.columns import shown
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import (
    attitude_table,
    check_covered,
    check_times,
    position_table,
    told_extrapolation,
)
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.interpolation import interpolate
from jaxbundle.pushbroom.scanner import AngleTable, LineTimes
from jaxbundle.pushbroom.trajectory import Trajectory, orbital_frame

ORDER = 7


def read_dimap(path: str | Path) -> Scanner:
    """The pushbroom image of a SPOT 5 scene, `METADATA.DIM`.

    **Raises:** `InputError` naming file, element and its number: what is missing, no number, no
    time, not as many look angles as pixels, times that do not increase.
    """
    file = _Dimap(Path(path))
    lines, pixels = (file.number(f"Raster_Dimensions/{n}") for n in ("NROWS", "NCOLS"))
    check_size(lines, pixels, f"{path}: Raster_Dimensions")
    lines, pixels = int(lines), int(pixels)
    setting = "Sensor_Configuration//"
    period = file.number(f"{setting}LINE_PERIOD")
    centre = file.number(f"{setting}SCENE_CENTER_LINE") - 1
    epoch = file.time(f"{setting}SCENE_CENTER_TIME")
    if period <= 0:
        raise InputError(f"{path}: LINE_PERIOD is {period:g} s; a positive number is expected")
    times = LineTimes(jnp.asarray(-period * centre), jnp.asarray(period))

    t, orbit = file.rows(
        "Ephemeris/Points/Point", [f"{a}/{b}" for a in ("Location", "Velocity") for b in "XYZ"],
        epoch,
    )  # fmt: skip
    source = points = Source(f"{path}, Ephemeris", None, "point")
    options = {"method": "lagrange", "order": min(ORDER, len(t) - 1), "gap": np.inf}
    both = position_table(t, orbit, **options, source=source)
    position = position_table(t, orbit[:, :3], **options, source=source)

    rows, angles = file.rows(
        "Corrected_Attitudes/Corrected_Attitude/Angles",
        ["PITCH", "ROLL", "YAW"], epoch,
    )  # fmt: skip
    source = Source(f"{path}, Corrected_Attitude", None, "row")
    check_times(rows, source)
    when = np.asarray(times.time(jnp.arange(lines, dtype=float)))
    warnings = told_extrapolation(rows, when, source)
    rows, angles = _continued(rows, angles, when[0], when[-1])
    check_covered(position, rows, points, "attitude row")
    state = np.asarray(jax.vmap(lambda at: interpolate(both, at))(rows))
    frame = np.asarray(jax.vmap(orbital_frame)(state[:, :3], state[:, 3:]))
    turn = Rotation.from_matrix(frame) * Rotation.from_euler("XYZ", angles * [-1, -1, 1])
    attitude = attitude_table(rows, np.roll(turn.as_quat(), 1, axis=1), source=source)

    psi = file.numbers(
        "Instrument_Look_Angles_List/Instrument_Look_Angles/Look_Angles_List/Look_Angles",
        ["PSI_X", "PSI_Y"],
    )  # fmt: skip
    if len(psi) != pixels:
        raise InputError(f"{path}: {len(psi)} Look_Angles for {pixels} columns; one a column")
    optics = AngleTable(jnp.asarray(-psi[:, 1]), jnp.asarray(psi[:, 0]))
    image = make_image(
        Trajectory(position, attitude), times, optics, lines, pixels, sources=(points, source)
    )
    name = file.text("Dataset_Id/DATASET_NAME", Path(path).stem)
    return Scanner(name, image, WGS84, warnings)


class _Dimap:
    """An XML document whose elements are asked for by their path, anywhere in it."""

    def __init__(self, path):
        self.path = path
        try:
            self.root = ET.fromstring(read_text(path))
        except ET.ParseError as error:
            raise InputError(f"{path}: not valid XML: {error}") from None

    def text(self, key, default=None):
        found = self.root.findtext(f".//{key}", default)
        if found is None:
            raise InputError(f"{self.path}: {key} is missing; DIMAP of SPOT 5 is expected")
        return found.strip()

    def number(self, key):
        return _number(self.text(key), f"{self.path}: {key}")

    def time(self, key):
        return _time(self.text(key), f"{self.path}: {key}")

    def numbers(self, key, names):
        """The columns of elements that stand there again and again; of the first list of them."""
        *parents, last = key.split("/")
        parent = self.root.find(f".//{'/'.join(parents)}")
        elements = [] if parent is None else parent.findall(last)
        if not elements:
            raise InputError(f"{self.path}: {key} is missing; DIMAP of SPOT 5 is expected")
        return np.array([
            [_number(e.findtext(name, ""), f"{self.path}: {last} {k}, {name}") for name in names]
            for k, e in enumerate(elements, 1)
        ])

    def rows(self, key, names, epoch):
        """Seconds since the epoch, and the columns."""
        values = self.numbers(key, names)
        last = key.split("/")[-1]
        elements = self.root.findall(f".//{key}")[: len(values)]
        times = [
            _time(e.findtext("TIME", ""), f"{self.path}: {last} {k}, TIME")
            for k, e in enumerate(elements, 1)
        ]
        return np.array([(t - epoch) / np.timedelta64(1, "ns") * 1e-9 for t in times]), values


def _number(text, where):
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{where} is {shown(text)}; a finite number is expected")
    return value


def _time(text, where):
    try:
        time = np.datetime64(text.strip().removesuffix("Z"), "ns")
    except ValueError:
        time = np.datetime64("NaT")
    if np.isnat(time):
        raise InputError(f"{where} is {shown(text)}; a time such as 2008-03-04T12:31:03.081912")
    return time


def _continued(t, angles, first, last):
    """The rows with more before and after them where these are needed, on straight lines."""
    if len(t) < 2:
        return t, angles
    end = (t[-1], t[-1] - t[-2], angles[-1], angles[-1] - angles[-2], last)
    start = (t[0], t[0] - t[1], angles[0], angles[0] - angles[1], first)
    for k, (at, step, value, change, reached) in enumerate((end, start)):
        steps = 1 + np.arange(max(np.ceil((reached - at) / step), 0))
        more = at + steps * step, value + steps[:, None] * change
        if k:
            t, angles = np.r_[more[0][::-1], t], np.vstack([more[1][::-1], angles])
        else:
            t, angles = np.r_[t, more[0]], np.vstack([angles, more[1]])
    return t, angles
