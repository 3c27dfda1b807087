"""Rigorous geometry of WorldView scenes, levels Basic 1B and Stereo 1B: DigitalGlobe's XML or IMD.

`isd`, or the files of `pvl`, holds the groups of the Imagery Support Data: IMD (size, times),
EPH, ATT, GEO (the camera).

    X = P + R·C + s·R·Q·[x, y, c],     [x, y] = [x₀, y₀] + p·u·[sin θ, −cos θ]
    t(l) of TLCLIST, linear in between, seconds since TLCTIME

- P (EPHEMLIST) metres, Earth-fixed; R (ATTLIST) of scalar-last quaternions, body → Earth; both at
  STARTTIME + TIMEINTERVAL·(index − 1);
- C (PERSPECTIVE_CENTER) metres, in the body; Q (QCS1 … QCS4, scalar last) camera → body;
- c (PD), the centre of the first detector x₀, y₀ (DETORIGINX, DETORIGINY) and the pitch p of
  detectors (DETPITCH) in millimetres; θ (DETROTANGLE) degrees; u the pixel, l the line, here both
  from 0 at the centres of the first.

The attitude is that of the arriving light: light time, aberration and refraction are switched on,
unless the RPC of the file say otherwise (`rpc_check`). Optical distortion, decreasing times, and
products resampled to a map are refused.
"""

import xml.etree.ElementTree as ET

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.scanner.csm_trajectory import slerp
from jaxbundle.io.scanner.product_tables import Tables, trajectory_of
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.scanner.sight_frames import polynomial_optics, sight_frame
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import XmlFields, number_in, seconds
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import check_times, normalise_quaternions
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.scanner import LineTimes

LEVELS = ("basic1b", "stereo1b")
# Of products whose RPC say nothing else: a file of WorldView-1 agrees with its RPC to 0.05 m with
# all three, to 0.7 m without refraction.
CORRECTIONS = Corrections(light_time=True, aberration=True, refraction=True)

HEAD: dict[str, str] = dict.fromkeys(
    (
        *("SATID", "REVNUMBER", "STRIPID", "TYPE", "VERSION", "GENERATIONTIME", "NUMPOINTS"),
        *("EFFECTIVETIME", "MODELGENERATIONTIME", "GEOMODELLEVEL", "CATID", "NUMTLC"),
    ),
    "of the delivery, or the length of a list that follows",
)
GREY_VALUES = "grey values, no geometry"
SUMMARY = "summaries of angles and sizes, which follow from the model"
KEYS: dict[str, Keys] = {
    "isd": Keys(
        ("IMD", "EPH", "ATT", "GEO"),
        {
            "TIL": "files that together are the image",
            "STE": SUMMARY,
            "RPB": "RPC, with which the model is compared",
            "README": "of the delivery, or the length of a list that follows",
        },
    ),
    "IMD": Keys(
        ("IMAGEDESCRIPTOR", "NUMROWS", "NUMCOLUMNS", "PRODUCTORDERID", "IMAGE"),
        {
            **HEAD,
            **dict.fromkeys(("PRODUCT*", "CHILDCATALOGID", "OUTPUTFORMAT"), "of the delivery"),
            **dict.fromkeys(
                (
                    *("BANDID", "RADIOMETRICLEVEL", "RADIOMETRICENHANCEMENT", "BITSPERPIXEL"),
                    *("COMPRESSIONTYPE", "JPEGPROFILENAME", "PANSHARPENALGORITHM"),
                    *("NUMBEROFLOOKS", "NUMLOOKS", "CLOUDCOVER"),
                ),
                GREY_VALUES,
            ),
            "BAND_*": "corners of the image and calibration of the grey values",
        },
    ),
    "IMAGE": Keys(
        ("TLCTIME", "TLCLISTList", "AVGLINERATE", "SCANDIRECTION"),
        {
            **HEAD,
            **dict.fromkeys(("MIN*", "MAX*", "MEAN*", "ROWUNCERTAINTY", "COLUNCERTAINTY"), SUMMARY),
            "MODE": "of the order",
            "FIRSTLINETIME": "the time of the first line, which TLCLIST has, too",
            **dict.fromkeys(
                (
                    *("EXPOSUREDURATION", "TDILEVEL", "PNIIRS", "CLOUDCOVER", "RESAMPLINGKERNEL"),
                    "CCDBIAS",
                ),
                GREY_VALUES,
            ),
            "POSITIONKNOWLEDGESRC": "of the delivery",
            "ATTITUDEKNOWLEDGESRC": "of the delivery",
        },
    ),
    "TLCLISTList": Keys(("TLCLIST",)),
    "EPH": Keys(("STARTTIME", "TIMEINTERVAL", "EPHEMLISTList"), HEAD),
    "EPHEMLISTList": Keys(("EPHEMLIST",)),
    "ATT": Keys(("STARTTIME", "TIMEINTERVAL", "ATTLISTList"), HEAD),
    "ATTLISTList": Keys(("ATTLIST",)),
    "GEO": Keys(
        (
            *("PRINCIPAL_DISTANCE", "OPTICAL_DISTORTION", "PERSPECTIVE_CENTER"),
            *("CAMERA_ATTITUDE", "DETECTOR_MOUNTING"),
        ),
        HEAD,
    ),
    "PRINCIPAL_DISTANCE": Keys(("PD",), HEAD),
    "OPTICAL_DISTORTION": Keys(
        ("ALISTList", "BLISTList", "ALIST", "BLIST"),
        {**HEAD, "POLYORDER": "the length of a list that follows"},
    ),
    "ALISTList": Keys(("ALIST",)),
    "BLISTList": Keys(("BLIST",)),
    "PERSPECTIVE_CENTER": Keys(("CX", "CY", "CZ"), HEAD),
    "CAMERA_ATTITUDE": Keys(("QCS1", "QCS2", "QCS3", "QCS4"), HEAD),
    "DETECTOR_MOUNTING": Keys(("BAND_*",), HEAD),
    "BAND_*": Keys(("DETECTOR_ARRAY",), {"BANDID": "the name of the band", **HEAD}),
    "DETECTOR_ARRAY": Keys(
        ("DETORIGINX", "DETORIGINY", "DETROTANGLE", "DETPITCH"), {"DETARRID": "a number", **HEAD}
    ),
}


def read_worldview(file: XmlFields) -> ScannerInput:
    """The pushbroom image of a DigitalGlobe XML file.

    **Raises:** `InputError` naming file and element: missing, not a number, a product of
    another level, tables that end too long before the image.
    """
    path = file.path
    level = file.text("IMD/IMAGEDESCRIPTOR", "Basic1B")
    if level.lower() not in LEVELS:
        raise InputError(
            f"{path}: IMAGEDESCRIPTOR is {show(level)}; only Basic1B and Stereo1B have the "
            "geometry of the camera, use the RPC of others"
        )
    unknown = UnknownKeys()
    unknown.check_tree(file.root, {file.root.tag: KEYS["isd"], **KEYS}, path)
    lines, pixels = file.number("IMD/NUMROWS"), file.number("IMD/NUMCOLUMNS")
    check_size(lines, pixels, f"{path}: NUMROWS, NUMCOLUMNS")
    lines, pixels = int(lines), int(pixels)
    epoch = file.time("IMD/IMAGE/TLCTIME")
    times = _line_times(file, lines)
    # Of a row are used: index, position, velocity; index, quaternion. Covariances follow.
    t, P, _ = _table(file, "EPH", "EPHEMLIST", 7, epoch)
    rows, values, source = _table(file, "ATT", "ATTLIST", 5, epoch)
    values, length_warnings = normalise_quaternions(values, source)
    R = Rotation.from_quat(values)
    centre = [file.number(f"GEO/PERSPECTIVE_CENTER/C{axis}") for axis in "XYZ"]
    # Ephemerides are those of the satellite, lines of sight begin in its camera.
    P = P[:, :3] + slerp(rows, R, t).apply(centre)
    lens = np.array([file.number(f"GEO/CAMERA_ATTITUDE/QCS{k}") for k in range(1, 5)])
    (lens,), lens_warnings = normalise_quaternions(
        lens[None], Source(f"{path}, QCS1 to QCS4", None, "row")
    )
    x, y, warnings = _detectors(file)
    tables = Tables(
        t, P, rows, R * Rotation.from_quat(lens), Source(f"{path}, EPHEMLIST", None, "row"), source
    )
    u = np.arange(pixels)
    down, forward = tables.directions(float(times.time((lines - 1) / 2)))
    frame = sight_frame(np.stack([np.polyval(p[::-1], u) for p in (x, y)]), down, forward)
    line_times = np.asarray(times.time(jnp.arange(lines, dtype=float)))
    trajectory, trajectory_warnings = trajectory_of(tables, frame.rotation, line_times)
    image = make_image(
        trajectory,
        times,
        polynomial_optics(frame, x, y),
        lines,
        pixels,
        corrections=CORRECTIONS,
        sources=(tables.positions, tables.attitude),
    )
    name = file.text("IMD/PRODUCTORDERID", path.stem) or path.stem
    return ScannerInput(
        name,
        image,
        WGS84,
        (*length_warnings, *lens_warnings, *warnings, *trajectory_warnings, *unknown.messages()),
    )


def _line_times(file: XmlFields, lines: int) -> LineTimes:
    pairs = file.elements("IMD/IMAGE/TLCLISTList/TLCLIST")
    pairs = np.array([_numbers(file, e, "TLCLIST", 2) for e in pairs])
    # One pair gives only where the lines begin.
    if len(pairs) == 1:
        rate = file.number("IMD/IMAGE/AVGLINERATE")
        if file.text("IMD/IMAGE/SCANDIRECTION", "Forward").lower() != "forward":
            rate = -rate
        first_lines, t, slope = pairs[0, 0], pairs[0, 1], np.array([1 / rate if rate else np.inf])
    else:
        first_lines, t = pairs[:, 0], pairs[:, 1]
        if (np.diff(first_lines) <= 0).any():
            raise InputError(f"{file.path}: the lines of TLCLIST do not increase")
        slope = np.diff(t) / np.diff(first_lines)
    if not ((slope > 0) & np.isfinite(slope)).all():
        raise InputError(
            f"{file.path}: the times of TLCLIST, AVGLINERATE, SCANDIRECTION go backwards; the "
            "first line must be the first in time"
        )
    # 1e-9 of the period, as the file rounds its times: one rate, which needs no table
    if np.ptp(slope) <= 1e-9 * slope[0]:
        start = np.ravel(t)[0] - slope[0] * np.ravel(first_lines)[0]
        return LineTimes(jnp.asarray(start), jnp.asarray(slope[0]))
    l = np.arange(lines)
    k = np.clip(np.searchsorted(first_lines, l, side="right") - 1, 0, len(slope) - 1)
    return LineTimes(
        jnp.zeros(()), jnp.zeros(()), jnp.asarray(t[k] + slope[k] * (l - first_lines[k]))
    )


def _table(
    file: XmlFields, group: str, name: str, value_count: int, epoch: np.datetime64
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows n"], Source]:
    """Seconds since the epoch, the values of the rows, and the source of the table."""
    rows = file.elements(f"{group}/{name}List/{name}")
    values = np.array(
        [_numbers(file, e, f"{name} {k}", value_count) for k, e in enumerate(rows, 1)]
    )
    start = seconds(file.time(f"{group}/STARTTIME"), epoch)
    t = start + file.number(f"{group}/TIMEINTERVAL") * (values[:, 0] - 1)
    source = Source(f"{file.path}, {name}", None, "row")
    if len(t) < 2:
        raise InputError(f"{source.name}: {len(t)} row; 2 at least")
    check_times(t, source)
    return t, values[:, 1:], source


def _numbers(file: XmlFields, element: ET.Element, name: str, value_count: int) -> list[float]:
    """The first numbers of an element with more numbers."""
    words = (element.text or "").replace(",", " ").split()
    if len(words) < value_count:
        raise InputError(f"{file.path}: {name} has {len(words)} numbers; expected {value_count}")
    return [number_in(word, f"{file.path}: {name}") for word in words[:value_count]]


def _detectors(
    file: XmlFields,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], tuple[str, ...]]:
    """x/c and y/c as polynomials of the pixel, and a warning if bands differ."""
    for name in ("ALIST", "BLIST"):
        # Early files have the coefficients without a list around them.
        elements = file.root.findall(f".//GEO/OPTICAL_DISTORTION//{name}")
        text = " ".join(word for e in elements for word in e.itertext()).replace(",", " ")
        if any(number_in(word, f"{file.path}: {name}") != 0 for word in text.split()):
            raise InputError(f"{file.path}: OPTICAL_DISTORTION ({name}) is not supported; use RPC")
    mounting = file.find("GEO/DETECTOR_MOUNTING")
    bands = [] if mounting is None else [b for b in mounting if b.tag.startswith("BAND_")]
    if not bands:
        raise file.missing_error("GEO/DETECTOR_MOUNTING/BAND_")
    names = ("DETORIGINX", "DETORIGINY", "DETROTANGLE", "DETPITCH")
    values = [
        [
            number_in(band.findtext(f"DETECTOR_ARRAY/{n}", ""), f"{file.path}: {band.tag}, {n}")
            for n in names
        ]
        for band in bands
    ]
    x0, y0, angle, pitch = values[0]
    c = file.number("GEO/PRINCIPAL_DISTANCE/PD")
    if c == 0 or pitch == 0:
        raise InputError(f"{file.path}: PD and DETPITCH must not be 0, in millimetres")
    other_bands = [band.tag for band, v in zip(bands, values) if v != values[0]]
    warnings = (
        ()
        if not other_bands
        else (
            f"{file.path}: the detectors of {', '.join(other_bands)} differ in position from "
            f"those of {bands[0].tag}, which are used",
        )
    )
    direction = pitch * np.array([np.sin(np.radians(angle)), -np.cos(np.radians(angle))])
    return np.array([x0, direction[0]]) / c, np.array([y0, direction[1]]) / c, warnings
