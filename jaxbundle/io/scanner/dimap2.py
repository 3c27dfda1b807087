"""DIMAP 2 and 3 of Pléiades, Pléiades Neo, SPOT 6 and 7, sensor (primary) level: `DIM_….XML`.

`Geometric_Data/Refined_Model` has the rigorous model:

    X = P + s·R(q)·[ψ_y, −ψ_x, 1]·(±1), towards the Earth
    ψ = XLOS_0 + XLOS_1·(u + u₀) + …,     t(l) = START + LINE_PERIOD·l

- lines l and pixels u here from 0; u₀ = FIRST_COL − 1 of Pléiades (`Swath_Range`), 0 of the others;
- positions LOCATION_XYZ in metres, Earth-fixed; q = (Q0, Q1, Q2, Q3) scalar first, camera → Earth;
- of Pléiades q is a polynomial of (t − OFFSET)/SCALE, t in seconds of the day of START; of the
  others a table;
- LINE_PERIOD in milliseconds (Pléiades) or microseconds (the others): the unit that leads from
  START to END, if one does.

The attitude contains aberration and light time: no correction is set.
"""

import xml.etree.ElementTree as ET

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.scanner.product_tables import Tables, trajectory_of
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.scanner.sight_frames import polynomial_optics, sight_frame
from jaxbundle.io.text.xml_fields import XmlFields, number_in, seconds
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import check_times, normalise_quaternions
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.scanner import LineTimes

MODEL = "Geometric_Data/Refined_Model"
# Units of LINE_PERIOD by METADATA_PROFILE, if START and END do not determine them.
PROFILES = {"PHR": 1e-3, "PNEO": 1e-6, "S6": 1e-6, "S7": 1e-6}


def read_dimap2(file: XmlFields) -> ScannerInput:
    """The pushbroom image of a DIMAP 2 file of sensor level.

    **Raises:** `InputError` naming file and element: a missing one, an invalid number or time,
    tables that end too long before the image.
    """
    path = file.path
    lines, pixels = (file.number(f"Raster_Dimensions/{n}") for n in ("NROWS", "NCOLS"))
    check_size(lines, pixels, f"{path}: Raster_Dimensions")
    lines, pixels = int(lines), int(pixels)
    epoch = file.time(f"{MODEL}/Time/Time_Range/START")
    period = _period(file, lines, epoch)
    times = LineTimes(jnp.zeros(()), jnp.asarray(period))
    points = f"{MODEL}/Ephemeris/Point_List/Point"
    t = file.times(points, epoch)
    P = np.array([_read_location(file, e, k) for k, e in enumerate(file.elements(points), 1)])
    positions = Source(f"{path}, Point_List", None, "point")
    attitude = Source(f"{path}, Attitudes", None, "quaternion")
    last = period * (lines - 1)
    rows, R, lengths = _attitudes(file, epoch, last, attitude)
    for times_of, source in ((t, positions), (rows, attitude)):
        if len(times_of) < 2:
            raise InputError(f"{source.name}: {len(times_of)} row; 2 at least")
        check_times(times_of, source)
    tables = Tables(t, P, rows, R, positions, attitude)
    x, y, warnings = _look_angles(file)
    u = np.arange(pixels)
    # the optics are polynomials about a mean direction in the middle of the image
    frame = sight_frame(
        np.stack([np.polyval(p[::-1], u) for p in (y, -x)]), *tables.directions(last / 2)
    )
    trajectory, told = trajectory_of(tables, frame.turn, period * np.arange(lines))
    image = make_image(
        trajectory,
        times,
        polynomial_optics(frame, y, -x),
        lines,
        pixels,
        sources=(positions, attitude),
    )
    name = file.text("Dataset_Identification/DATASET_NAME", path.stem)
    return ScannerInput(name, image, WGS84, (*lengths, *warnings, *told))


def _period(file: XmlFields, lines: int, epoch: np.datetime64) -> float:
    """The period of the lines in seconds."""
    period = file.number(f"{MODEL}/Time/Time_Stamp/LINE_PERIOD")
    span = seconds(file.time(f"{MODEL}/Time/Time_Range/END"), epoch)
    # 5 % and a line: not critical, since the units are a factor of 1000 apart
    fits = lambda unit: (
        period > 0 and abs(unit * period * (lines - 0.5) - span) <= 0.05 * span + unit * period
    )
    profile = file.text("Metadata_Identification/METADATA_PROFILE", "").partition("_")[0]
    known = (PROFILES[profile],) if profile in PROFILES else ()
    # With few lines several units fit: that of the product is tried first.
    for unit in (*known, 1.0, 1e-3, 1e-6):
        if fits(unit):
            return unit * period
    # where START and END contradict it: the unit documented for the product
    if known and period > 0:
        return known[0] * period
    raise InputError(
        f"{file.path}: LINE_PERIOD is {period:g} and START to END {span:g} s for {lines} lines; a "
        "period in seconds, milliseconds or microseconds that fits is expected"
    )


def _read_location(file: XmlFields, element: ET.Element, k: int) -> list[float]:
    """The position of the k-th point, metres."""
    where = f"{file.path}: Point {k}, LOCATION_XYZ"
    words = element.findtext("LOCATION_XYZ", "").replace(",", " ").split()
    if len(words) != 3:
        raise InputError(f"{where} has {len(words)} numbers; 3 are expected")
    return [number_in(word, where) for word in words]


# Times, rotations camera → Earth, warnings.
Attitudes = tuple[Float[np.ndarray, " n"], Rotation, tuple[str, ...]]


def _attitudes(file: XmlFields, epoch: np.datetime64, last: float, source: Source) -> Attitudes:
    if file.find(f"{MODEL}/Attitudes/Polynomial_Quaternions") is not None:
        return _polynomial(file, epoch, last, source)
    key = f"{MODEL}/Attitudes/Quaternion_List/Quaternion"
    values = file.columns(key, ("Q0", "Q1", "Q2", "Q3"))
    return file.times(key, epoch), *_rotations(values, source)


def _polynomial(file: XmlFields, epoch: np.datetime64, last: float, source: Source) -> Attitudes:
    """The attitudes of a polynomial, as a table from a second before the image to one after."""
    key = f"{MODEL}/Attitudes/Polynomial_Quaternions"
    start = seconds(epoch, epoch.astype("datetime64[D]"))
    offset = file.number(f"{key}/OFFSET") - start
    day = 86400.0
    offset -= day * np.round(offset / day)  # a strip over midnight
    scale = file.number(f"{key}/SCALE")
    if scale == 0:
        raise InputError(f"{file.path}: SCALE of Polynomial_Quaternions is 0")
    # Through eight rows Lagrange's polynomial of degree 7 is exact for those of low degree;
    # the division by their length is no polynomial, and the reason for more rows.
    rows = np.linspace(-1.0, last + 1.0, 65)
    parts = [file.numbers(f"{key}/Q{k}/COEFFICIENTS") for k in range(4)]
    values = np.stack([np.polyval(c[::-1], (rows - offset) / scale) for c in parts], 1)
    return rows, *_rotations(values, source)


def _rotations(
    values: Float[np.ndarray, "n 4"], source: Source
) -> tuple[Rotation, tuple[str, ...]]:
    values, lengths = normalise_quaternions(values, source)
    return Rotation.from_quat(np.roll(values, -1, axis=1)), lengths


def _look_angles(
    file: XmlFields,
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4"], tuple[str, ...]]:
    """ψ_x and ψ_y as polynomials of the pixel, and a warning if there are several bands."""
    key = f"{MODEL}/Geometric_Calibration/Instrument_Calibration"
    bands = file.root.findall(f".//{key}/Band_Calibration_List/Band_Calibration")
    shift = file.number(f"{key}/Swath_Range/FIRST_COL", 1.0) - 1 if not bands else 0.0
    names = [[n for n in (f"{axis}LOS_{k}" for k in range(4))] for axis in "XY"]
    angles = f"{key}/{'Band_Calibration_List/Band_Calibration/' if bands else ''}"
    angles += "Polynomial_Look_Angles"
    polynomials = []
    for row in names:
        values = [file.number(f"{angles}/{n}", None if k == 0 else 0.0) for k, n in enumerate(row)]
        # ψ(u + u₀) as a polynomial of u
        moved = np.polynomial.Polynomial(values)(np.polynomial.Polynomial([shift, 1.0])).coef
        polynomials.append(np.r_[moved, np.zeros(len(row) - len(moved))])
    warnings = (
        ()
        if len(bands) < 2
        else (
            f"{file.path}: {len(bands)} bands have different look angles; those of the first, "
            f"{bands[0].findtext('BAND_ID', '').strip() or 'without a name'}, are used",
        )
    )
    return *polynomials, warnings
