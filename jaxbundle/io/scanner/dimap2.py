"""DIMAP 2 and 3 of Pléiades, Pléiades Neo, SPOT 6 and 7, sensor (primary) level: `DIM_….XML`.

`Geometric_Data/Refined_Model` has the rigorous model:

    X = P + s·R(q)·[ψ_y, −ψ_x, 1]·(±1), towards the Earth
    ψ = XLOS_0 + XLOS_1·(u + u₀) + …,     t(l) = START + LINE_PERIOD·l

- lines l and pixels u here from 0; u₀ = FIRST_COL − 1 of Pléiades (`Swath_Range`), 0 of the others;
- positions LOCATION_XYZ in metres, Earth-fixed; q = (Q0, Q1, Q2, Q3) scalar first, camera → Earth;
- of Pléiades q is a polynomial of (t − OFFSET)/SCALE, t in seconds of the day of START; of the
  others a table;
- LINE_PERIOD in the unit that it states, else in milliseconds (Pléiades) or microseconds (the
  others): the unit that leads from START to END, if one does.

The first products of Pléiades (`PHR_DIMAP_Document`, 2012 to 2019) have the same model in
`Geometric_Data/Sensor_Model_Characteristics`, under other names (`EARLY`). Images that were
projected have the model of the camera, too, but other pixels: they are refused by their level.

The attitude contains aberration and light time: no correction is set.
"""

import xml.etree.ElementTree as ET
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.scanner.dimap_keys import DIMAP2, DIMAP2_DOCUMENT
from jaxbundle.io.scanner.product_tables import Tables, trajectory_of
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.scanner.sight_frames import polynomial_optics, sight_frame
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.io.text.xml_fields import XmlFields, number_in, seconds
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import check_times, normalise_quaternions
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.scanner import LineTimes

MODEL = "Geometric_Data/Refined_Model"
EARLY_MODEL = "Geometric_Data/Sensor_Model_Characteristics"
# Units of LINE_PERIOD by METADATA_PROFILE, if START and END do not determine them.
PROFILES = {"PHR": 1e-3, "PNEO": 1e-6, "S6": 1e-6, "S7": 1e-6}
TIME_UNITS = {
    **dict.fromkeys(("s", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "microsecond", "microseconds"), 1e-6),
}
# Levels whose pixels are those of the camera.
LEVELS = ("SENSOR", "PRIMARY")


class Names(NamedTuple):
    """Where a form of the document has the parts of the model."""

    range: str
    period: str
    points: str
    location: str
    time: str
    polynomials: str
    coefficients: str
    first_column: str


NAMES = Names(
    f"{MODEL}/Time/Time_Range",
    f"{MODEL}/Time/Time_Stamp/LINE_PERIOD",
    f"{MODEL}/Ephemeris/Point_List/Point",
    "LOCATION_XYZ",
    "TIME",
    f"{MODEL}/Attitudes/Polynomial_Quaternions",
    f"{MODEL}/Attitudes/Polynomial_Quaternions/Q{{}}/COEFFICIENTS",
    f"{MODEL}/Geometric_Calibration/Instrument_Calibration/Swath_Range/FIRST_COL",
)
EARLY = Names(
    f"{EARLY_MODEL}/UTC_Sensor_Model_Range",
    f"{EARLY_MODEL}/SENSOR_LINE_PERIOD",
    f"{EARLY_MODEL}/Sensor_Ephemeris/Point_List/Point",
    "LOCATION_VALUES",
    "UTC_TIME",
    f"{EARLY_MODEL}/Sensor_Attitudes",
    f"{EARLY_MODEL}/Sensor_Attitudes/Polynomial_Models/Q{{}}/COEFFICIENTS",
    f"{EARLY_MODEL}/Sensor_Viewing_Model/Position_In_Retina/FIRST_COL",
)


def read_dimap2(file: XmlFields) -> ScannerInput:
    """The pushbroom image of a DIMAP 2 file of sensor level.

    **Raises:** `InputError` naming file and element: a missing one, an invalid number or time,
    an image that was projected, tables that end too long before the image.
    """
    path = file.path
    _check_level(file)
    names = NAMES if file.find(MODEL) is not None else EARLY
    unknown = UnknownKeys()
    unknown.check_tree(file.root, {file.root.tag: DIMAP2_DOCUMENT, **DIMAP2}, path)
    lines, pixels = (file.number(f"Raster_Dimensions/{n}") for n in ("NROWS", "NCOLS"))
    check_size(lines, pixels, f"{path}: Raster_Dimensions")
    lines, pixels = int(lines), int(pixels)
    epoch = file.time(f"{names.range}/START")
    period = _period(file, names, lines, epoch)
    times = LineTimes(jnp.zeros(()), jnp.asarray(period))
    t = file.times(names.points, epoch, names.time)
    points = enumerate(file.elements(names.points), 1)
    P = np.array([_read_location(file, names.location, e, k) for k, e in points])
    positions = Source(f"{path}, Point_List", None, "point")
    attitude = Source(f"{path}, Attitudes", None, "quaternion")
    last_time = period * (lines - 1)
    rows, R, length_warnings = _attitudes(file, names, epoch, last_time, attitude)
    for times_of, source in ((t, positions), (rows, attitude)):
        if len(times_of) < 2:
            raise InputError(f"{source.name}: {len(times_of)} row; 2 at least")
        check_times(times_of, source)
    tables = Tables(t, P, rows, R, positions, attitude)
    x, y, warnings = _look_angles(file, names)
    u = np.arange(pixels)
    # The optics are polynomials about a mean direction in the middle of the image.
    frame = sight_frame(
        np.stack([np.polyval(p[::-1], u) for p in (y, -x)]), *tables.directions(last_time / 2)
    )
    trajectory, trajectory_warnings = trajectory_of(
        tables, frame.rotation, period * np.arange(lines)
    )
    image = make_image(
        trajectory,
        times,
        polynomial_optics(frame, y, -x),
        lines,
        pixels,
        sources=(positions, attitude),
    )
    name = file.text("Dataset_Identification/DATASET_NAME", path.stem)
    return ScannerInput(
        name, image, WGS84, (*length_warnings, *warnings, *trajectory_warnings, *unknown.messages())
    )


def _check_level(file: XmlFields) -> None:
    """Refuse an image that was projected, whose pixels are no longer those of the camera."""
    for key in ("Raster_CRS/RASTER_GEOMETRY", "PROCESSING_LEVEL"):
        level = file.text(key, "")
        if level and level.upper() not in LEVELS:
            raise InputError(
                f"{file.path}: {key} is {show(level)}: an image that was projected; expected one "
                "of sensor (primary) level. For this one use RPC, or the map as it is"
            )


def _unit(file: XmlFields, element: ET.Element | None, units: dict[str, float]) -> float | None:
    """The unit that an element states; None if it states none."""
    unit_name = None if element is None else element.get("unit")
    if element is None or unit_name is None:
        return None
    if unit_name.strip().lower() not in units:
        raise InputError(
            f"{file.path}: {element.tag} is in {show(unit_name)}; expected one of "
            f"{', '.join(units)}"
        )
    return units[unit_name.strip().lower()]


def _period(file: XmlFields, names: Names, lines: int, epoch: np.datetime64) -> float:
    """The period of the lines in seconds."""
    period = file.number(names.period)
    stated_unit = _unit(file, file.find(names.period), TIME_UNITS)
    if stated_unit is not None and period > 0:
        return stated_unit * period
    span = seconds(file.time(f"{names.range}/END"), epoch)
    # 5 % and a line: not critical, since the units are a factor of 1000 apart
    fits = lambda unit: (
        period > 0 and abs(unit * period * (lines - 0.5) - span) <= 0.05 * span + unit * period
    )
    profile = file.text("Metadata_Identification/METADATA_PROFILE", "").partition("_")[0]
    product_units = (PROFILES[profile],) if profile in PROFILES else ()
    # With few lines several units fit: that of the product is tried first.
    for unit in (*product_units, 1.0, 1e-3, 1e-6):
        if fits(unit):
            return unit * period
    # Where START and END contradict it: the unit documented for the product.
    if product_units and period > 0:
        return product_units[0] * period
    name = names.period.rpartition("/")[2]
    raise InputError(
        f"{file.path}: {name} is {period:g} and START to END {span:g} s for {lines} lines; "
        "expected a period in seconds, milliseconds or microseconds that fits"
    )


def _read_location(file: XmlFields, name: str, element: ET.Element, k: int) -> list[float]:
    """The position of the k-th point, metres."""
    where = f"{file.path}: Point {k}, {name}"
    _unit(file, element.find(name), {"m": 1.0})
    words = element.findtext(name, "").replace(",", " ").split()
    if len(words) != 3:
        raise InputError(f"{where} has {len(words)} numbers; expected 3")
    return [number_in(word, where) for word in words]


# Times, rotations camera → Earth, warnings.
Attitudes = tuple[Float[np.ndarray, " n"], Rotation, tuple[str, ...]]


def _attitudes(
    file: XmlFields, names: Names, epoch: np.datetime64, last_time: float, source: Source
) -> Attitudes:
    if names is EARLY or file.find(names.polynomials) is not None:
        return _polynomial_attitudes(file, names, epoch, last_time, source)
    key = f"{MODEL}/Attitudes/Quaternion_List/Quaternion"
    values = file.columns(key, ("Q0", "Q1", "Q2", "Q3"))
    return file.times(key, epoch), *_rotations(values, source)


def _polynomial_attitudes(
    file: XmlFields, names: Names, epoch: np.datetime64, last_time: float, source: Source
) -> Attitudes:
    """The attitudes of a polynomial, as a table from a second before the image to one after."""
    key = names.polynomials
    start = seconds(epoch, epoch.astype("datetime64[D]"))
    offset, scale = (_seconds(file, f"{key}/{name}") for name in ("OFFSET", "SCALE"))
    offset -= start
    day = 86400.0
    offset -= day * np.round(offset / day)  # a strip over midnight
    if scale == 0:
        raise InputError(f"{file.path}: SCALE of {key.rpartition('/')[2]} is 0")
    # Through eight rows Lagrange's polynomial of degree 7 is exact for those of low degree;
    # the division by their length is no polynomial, and the reason for more rows.
    rows = np.linspace(-1.0, last_time + 1.0, 65)
    parts = [file.numbers(names.coefficients.format(k)) for k in range(4)]
    values = np.stack([np.polyval(c[::-1], (rows - offset) / scale) for c in parts], 1)
    return rows, *_rotations(values, source)


def _seconds(file: XmlFields, key: str) -> float:
    """A time in the unit that it states, seconds by default."""
    unit = _unit(file, file.find(key), TIME_UNITS)
    return file.number(key) * (1.0 if unit is None else unit)


def _rotations(
    values: Float[np.ndarray, "n 4"], source: Source
) -> tuple[Rotation, tuple[str, ...]]:
    values, lengths = normalise_quaternions(values, source)
    return Rotation.from_quat(np.roll(values, -1, axis=1)), lengths


def _look_angles(
    file: XmlFields, names: Names
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4"], tuple[str, ...]]:
    """ψ_x and ψ_y as polynomials of the pixel, and a warning if there are several bands."""
    key = f"{MODEL}/Geometric_Calibration/Instrument_Calibration"
    bands = file.root.findall(f".//{key}/Band_Calibration_List/Band_Calibration")
    shift = file.number(names.first_column, 1.0) - 1 if not bands else 0.0
    angles = f"{key}/{'Band_Calibration_List/Band_Calibration/' if bands else ''}"
    angles += "Polynomial_Look_Angles"
    polynomials = []
    for axis in "XY":
        if names is EARLY:
            values = _early_angles(file, axis)
        else:
            rows = [f"{angles}/{axis}LOS_{k}" for k in range(4)]
            values = [file.number(row, None if k == 0 else 0.0) for k, row in enumerate(rows)]
        # ψ(u + u₀) as a polynomial of u
        shifted = np.polynomial.Polynomial(values)(np.polynomial.Polynomial([shift, 1.0])).coef
        polynomials.append(np.r_[shifted, np.zeros(4 - len(shifted))])
    warnings = []
    if len(bands) > 1:
        warnings.append(
            f"{file.path}: {len(bands)} bands have different look angles; those of the first, "
            f"{bands[0].findtext('BAND_ID', '').strip() or 'without a name'}, are used"
        )
    biases = [file.number(f"Instrument_Biases/{n}", 0.0) for n in ("YAW", "PITCH", "ROLL")]
    if any(biases):
        warnings.append(
            f"{file.path}: Instrument_Biases (yaw, pitch, roll {biases[0]:g}, {biases[1]:g}, "
            f"{biases[2]:g}) are not applied: no document says whether the attitudes contain them; "
            "compare with the RPC of the product"
        )
    return *polynomials, tuple(warnings)


def _early_angles(file: XmlFields, axis: str) -> list[float]:
    """ψ_x or ψ_y as a polynomial of the column of the focal plane, of degree 3 at most."""
    key = f"{EARLY_MODEL}/Sensor_Viewing_Model/Viewing_Directions/Psi{axis}_Model/COEFFICIENTS"
    values = file.numbers(key).tolist()
    if not 1 <= len(values) <= 4:
        raise InputError(f"{file.path}: {key} has {len(values)} numbers; expected 1 to 4")
    return values
