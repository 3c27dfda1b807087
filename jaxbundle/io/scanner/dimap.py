"""DIMAP metadata of SPOT 5 scenes (level 1A): ephemeris, corrected attitudes, look angles.

By the SPOT 123-4-5 Geometry Handbook (GAEL-P135-DOC-001), with angles in radians:

    u = M·[−tan ψ_Y, tan ψ_X, −1]                                                      (5a)
    M = Mp·Mr·My,   Rx(−pitch)·Ry(−roll)·Rz(yaw) in the notation used here             (11)
    X = P + s·[X₂ Y₂ Z₂]·u,    Z₂ = P/|P|,  X₂ = V × Z₂/|…|,  Y₂ = Z₂ × X₂             (7)
    t = t_centre + period·(line − line_centre)

Its camera frame and its orbital frame are ours; its pitch and roll have the other sign. Lines count
from 1 there, from 0 here. Positions and velocities by Lagrange's polynomial through eight rows; the
attitudes, converted to Earth-fixed quaternions at their times, by slerp. If they end a little
before the image (`ancillary.extrapolation_limit`), the angles are extrapolated linearly.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.scanner.csm_trajectory import LAGRANGE_ORDER
from jaxbundle.io.scanner.dimap_keys import DIMAP1, DIMAP1_DOCUMENT
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.io.text.xml_fields import XmlFields
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import (
    attitude_table,
    check_covered,
    check_times,
    position_table,
    warn_of_extrapolation,
)
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.interpolation import interpolate
from jaxbundle.pushbroom.scanner import AngleTable, LineTimes
from jaxbundle.pushbroom.trajectory import Trajectory, orbital_frame


def read_dimap(file: XmlFields) -> ScannerInput:
    """The pushbroom image of a SPOT 5 scene, `METADATA.DIM`.

    **Raises:** `InputError` naming file, element and its number: a missing one, an invalid number
    or time, a different number of look angles and pixels, times that do not increase, another
    level than 1A.
    """
    path = file.path
    level = file.text("Data_Processing/PROCESSING_LEVEL", "1A")
    if level.upper() != "1A":
        raise InputError(
            f"{path}: PROCESSING_LEVEL is {show(level)}: an image that was resampled; expected one "
            "of level 1A, which has the pixels of the camera"
        )
    unknown = UnknownKeys()
    unknown.check_tree(file.root, {file.root.tag: DIMAP1_DOCUMENT, **DIMAP1}, path)
    lines, pixels = (file.number(f"Raster_Dimensions/{n}") for n in ("NROWS", "NCOLS"))
    check_size(lines, pixels, f"{path}: Raster_Dimensions")
    lines, pixels = int(lines), int(pixels)
    setting = "Sensor_Configuration//"
    period = file.number(f"{setting}LINE_PERIOD")
    centre = file.number(f"{setting}SCENE_CENTER_LINE") - 1
    epoch = file.time(f"{setting}SCENE_CENTER_TIME")
    if period <= 0:
        raise InputError(f"{path}: LINE_PERIOD is {period:g} s; expected a positive number")
    times = LineTimes(jnp.asarray(-period * centre), jnp.asarray(period))

    key = "Ephemeris/Points/Point"
    t = file.times(key, epoch)
    orbit = file.columns(key, [f"{a}/{b}" for a in ("Location", "Velocity") for b in "XYZ"])
    source = points = Source(f"{path}, Ephemeris", None, "point")
    options = {"method": "lagrange", "order": min(LAGRANGE_ORDER, len(t) - 1), "gap": np.inf}
    state_table = position_table(t, orbit, **options, source=source)
    position = position_table(t, orbit[:, :3], **options, source=source)

    key = "Corrected_Attitudes/Corrected_Attitude/Angles"
    rows, angles = file.times(key, epoch), file.columns(key, ["PITCH", "ROLL", "YAW"])
    source = Source(f"{path}, Corrected_Attitude", None, "row")
    check_times(rows, source)
    line_times = np.asarray(times.time(jnp.arange(lines, dtype=float)))
    warnings = warn_of_extrapolation(rows, line_times, source)
    rows, angles = _extrapolate(rows, angles, line_times[0], line_times[-1])
    # The frame of an attitude is that of the orbit at its time.
    check_covered(position, rows, points, "attitude row")
    state = np.asarray(jax.vmap(lambda time: interpolate(state_table, time))(rows))
    frame = np.asarray(jax.vmap(orbital_frame)(state[:, :3], state[:, 3:]))
    # Equation (11).
    rotation = Rotation.from_matrix(frame) * Rotation.from_euler("XYZ", angles * [-1, -1, 1])
    attitude = attitude_table(rows, np.roll(rotation.as_quat(), 1, axis=1), source=source)

    psi = file.columns(
        "Instrument_Look_Angles_List/Instrument_Look_Angles/Look_Angles_List/Look_Angles",
        ["PSI_X", "PSI_Y"],
    )
    if len(psi) != pixels:
        raise InputError(f"{path}: {len(psi)} Look_Angles for {pixels} columns; one a column")
    optics = AngleTable(jnp.asarray(-psi[:, 1]), jnp.asarray(psi[:, 0]))  # across, along: (5a)
    image = make_image(
        Trajectory(position, attitude), times, optics, lines, pixels, sources=(points, source)
    )
    name = file.text("Dataset_Id/DATASET_NAME", path.stem)
    messages = (*warnings, *_describe_unused(file), *unknown.messages())
    return ScannerInput(name, image, WGS84, messages)


def _describe_unused(file: XmlFields) -> list[str]:
    """Warnings about what the file has of other bands, and shifts between them."""
    warnings = []
    bands = file.root.findall(".//Instrument_Look_Angles_List/Instrument_Look_Angles")
    if len(bands) > 1:
        warnings.append(
            f"{file.path}: {len(bands)} bands have look angles of their own; those of the first, "
            f"{bands[0].findtext('BAND_INDEX', '').strip() or 'without a number'}, are used"
        )
    for name in ("DEREGISTRATION_VALUE", "COUPLED_DEREGISTRATION_VALUE"):
        value = file.number(name, 0.0)
        if value:
            warnings.append(
                f"{file.path}: {name} {value:g}, a shift between arrays of detectors, is not "
                "applied: the look angles are those of the array itself"
            )
    return warnings


def _extrapolate(
    t: Float[np.ndarray, " n"],
    angles: Float[np.ndarray, "n 3"],
    first_time: float,
    last_time: float,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    """The rows, extrapolated linearly before `first_time` and after `last_time` if required, in
    steps of the table."""
    if len(t) < 2:
        return t, angles
    end = (t[-1], t[-1] - t[-2], angles[-1], angles[-1] - angles[-2], last_time)
    start = (t[0], t[0] - t[1], angles[0], angles[0] - angles[1], first_time)
    for k, (edge_time, step, value, change, limit_time) in enumerate((end, start)):
        steps = 1 + np.arange(max(np.ceil((limit_time - edge_time) / step), 0))
        extra_rows = edge_time + steps * step, value + steps[:, None] * change
        if k:
            t, angles = np.r_[extra_rows[0][::-1], t], np.vstack([extra_rows[1][::-1], angles])
        else:
            t, angles = np.r_[t, extra_rows[0]], np.vstack([angles, extra_rows[1]])
    return t, angles
