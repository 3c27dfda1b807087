"""Image support data (ISD) of the Community Sensor Model, line scanners, as ALE writes them (JSON).

What the fields mean is what usgscsm makes of them:

- lines and samples: (0.5, 0.5) is the centre of the first pixel, here (0, 0);
- `line_scan_rate`: rows of line L₀, start t₀ after the centre time, period p: line l here is taken
  at t₀ + p·(l + 1 − L₀);
- `instrument_pointing`, `body_rotation`: scalar-first quaternions, v_to = R(q)·v_J2000, then the
  constant rotation; here R_body·R_pointingᵀ;
- `sensor_orientation` of older files: scalar-last, camera → body;
- `focal2pixel_lines`, `focal2pixel_samples`: millimetres → pixels from `detector_center`;
- the camera looks along the line (x, y, f), here along −z, x along the detectors, y forward;
- positions and radii in km, or in their `unit` (m of the older `sensor_position`).

Tables are resampled evenly, positions by Hermite's cubics, rotations by slerp, and interpolated by
Lagrange's polynomial of degree 7. Which way along its line the camera looks is told by the planet:
it is in front. No correction is set, as usgscsm applies none.
"""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.csv_tables import read_text
from jaxbundle.io.scanner import Scanner
from jaxbundle.network.columns import shown
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import attitude_table, check_times, position_table
from jaxbundle.pushbroom.image import check_size, make_image
from jaxbundle.pushbroom.scanner import AngleTable, FocalLine, LineTimes
from jaxbundle.pushbroom.trajectory import Trajectory

MODEL = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
UNITS = {"m": 1.0, "km": 1000.0}
FEWEST, ORDER = 25, 7
"""Positions are resampled to so many rows at least."""
ALIGNED = 1e-9
ORTHOGONAL = 1e-4
"""Products of the rows of a rotation may differ by this from those of axes, as quaternions do."""
ROUNDING = 5e-7
"""Seconds since J2000 are rounded to 6e-8 s; tables may end that much inside the first line."""


def read_csm(path: str | Path) -> Scanner:
    """The pushbroom image of an ISD.

    **Raises:** `InputError` naming file and field: what is missing, of another kind, not a number,
    a distortion that is not known here.
    """
    isd = _Isd(Path(path))
    name = isd.get("name_model", MODEL)
    if name != MODEL:
        raise InputError(f"{path}: name_model is {shown(name)}; {MODEL} is expected")
    lines, pixels = (isd.number(key) for key in ("image_lines", "image_samples"))
    check_size(lines, pixels, f"{path}: image_lines, image_samples")
    lines, pixels = int(lines), int(pixels)
    times = _line_times(isd, lines)
    t, P, (rows, R) = _states(isd)
    middle = float(times.time((lines - 1) / 2))
    optics, turn = _optics(isd, pixels, *_middle(t, P, rows, R, middle))
    ends = [float(times.time(line)) for line in (0.0, lines - 1.0)]
    t, rows = (_reaching(table, *ends) for table in (t, rows))
    q = np.roll((R * turn).as_quat(), 1, axis=1)
    degree = lambda n: {"method": "lagrange", "order": min(ORDER, n - 1), "gap": np.inf}
    sources = isd.source("instrument_position"), isd.source("instrument_pointing")
    position = position_table(t, P, **degree(len(t)), source=sources[0])
    attitude = attitude_table(rows, q, **degree(len(rows)), source=sources[1])
    image = make_image(
        Trajectory(position, attitude), times, optics, lines, pixels, sources=sources
    )
    return Scanner(str(isd.get("name_sensor", Path(path).stem)), image, _earth(isd))


class _Isd:
    """A JSON document whose fields are asked for by their path, "a.b"."""

    def __init__(self, path):
        self.path = path
        text = read_text(path)
        try:
            self.document = json.loads(text)
        except RecursionError:
            raise InputError(f"{path}: not valid JSON: brackets are nested too deeply") from None
        except ValueError as error:
            raise InputError(f"{path}: not valid JSON: {error}") from None
        if not isinstance(self.document, dict):
            raise InputError(f"{path}: an object with the fields of an ISD is expected")

    def get(self, key: str, default: Any = None) -> Any:
        value = self.document
        for part in key.split("."):
            if not isinstance(value, dict) or part not in value:
                return default
            value = value[part]
        return value

    def number(self, key: str, default: float | None = None) -> float:
        return float(self.array(key, (), default))

    def array(self, key: str, shape: tuple[int | None, ...], default: Any = None) -> np.ndarray:
        """Numbers of a shape; None in it is any length."""
        value = self.get(key, default)
        if value is None:
            raise InputError(f"{self.path}: {key} is missing")
        try:
            array = np.array(value, float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        fits = array.ndim == len(shape) and all(
            n in (None, m) for n, m in zip(shape, array.shape)
        )
        if not fits or not np.isfinite(array).all():
            size = " × ".join("n" if n is None else str(n) for n in shape)
            kind = f"an array {size} of finite numbers" if shape else "a finite number"
            raise InputError(f"{self.path}: {key} is {shown(value)}; {kind} is expected")
        return array

    def source(self, key: str) -> Source:
        return Source(f"{self.path}, {key}")


def _earth(isd):
    unit = _unit(isd, "radii", "km")
    a, c = (unit * isd.number(f"radii.{key}") for key in ("semimajor", "semiminor"))
    if not min(a, c) > 0:
        raise InputError(f"{isd.path}: radii must be positive")
    return Ellipsoid(a, a, c)


def _unit(isd, key, default):
    unit = isd.get(f"{key}.unit", default)
    if unit not in UNITS:
        raise InputError(f"{isd.path}: {key}.unit is {shown(unit)}; m or km is expected")
    return UNITS[unit]


def _line_times(isd, lines):
    rates = isd.array("line_scan_rate", (None, 3))
    if not len(rates) or (rates[:, 2] <= 0).any():
        raise InputError(f"{isd.path}: line_scan_rate needs rows of a positive period")
    first, start, period = rates.T
    if len(rates) == 1:
        return LineTimes(jnp.asarray(start[0] + period[0] * (1 - first[0])), jnp.asarray(period[0]))
    l = np.arange(lines)
    row = np.clip(np.searchsorted(first, l + 0.5, side="right") - 1, 0, None)
    t = start[row] + period[row] * (l + 1 - first[row])
    check_times(t, Source(f"{isd.path}, line_scan_rate", None, "line"))
    return LineTimes(jnp.zeros(()), jnp.zeros(()), jnp.asarray(t))


def _states(isd):
    """Times and positions in the body's frame; times and rotations camera → body."""
    if "sensor_position" in isd.document and "instrument_position" not in isd.document:
        P = isd.array("sensor_position.positions", (None, 3)) * _unit(isd, "sensor_position", "m")
        t = isd.number("t0_ephemeris") + isd.number("dt_ephemeris") * np.arange(len(P))
        q = isd.array("sensor_orientation.quaternions", (None, 4))
        rows = isd.number("t0_quaternion") + isd.number("dt_quaternion") * np.arange(len(q))
        return t, P, (rows, _rotations(isd, "sensor_orientation", q))
    body = _turns(isd, "body_rotation")
    pointing = _turns(isd, "instrument_pointing")
    given = _times(isd, "instrument_position")
    P = isd.array("instrument_position.positions", (len(given), 3))
    P = P * _unit(isd, "instrument_position", "km")
    if len(given) < 2:
        raise InputError(f"{isd.path}: instrument_position has {len(given)} row; 2 at least")
    t = np.linspace(given[0], given[-1], max(FEWEST, len(given)))
    if isd.get("instrument_position.velocities") is not None:
        V = isd.array("instrument_position.velocities", (len(given), 3))
        P = CubicHermiteSpline(given, P, V * _unit(isd, "instrument_position", "km"))(t)
    else:
        P = np.stack([np.interp(t, given, p) for p in P.T], 1)
    rows = _times(isd, "instrument_pointing")
    rows = np.linspace(rows[0], rows[-1], max(2, len(rows)))
    return t, body(t).apply(P), (rows, body(rows) * pointing(rows).inv())


def _times(isd, key):
    """Seconds since the centre time."""
    t = isd.array(f"{key}.ephemeris_times", (None,)) - isd.number("center_ephemeris_time")
    check_times(t, isd.source(key))
    return t


def _reaching(t, first, last):
    """The times of a table, its ends moved by no more than rounding to reach the lines."""
    t = t.copy()
    if 0 < t[0] - first < ROUNDING:
        t[0] = first
    if 0 < last - t[-1] < ROUNDING:
        t[-1] = last
    return t


def _turns(isd, key):
    """The rotation from J2000 into a frame as a function of times."""
    t = _times(isd, key)
    R = _rotations(isd, key, isd.array(f"{key}.quaternions", (len(t), 4))[:, [1, 2, 3, 0]])
    fixed = isd.array(f"{key}.constant_rotation", (9,), np.eye(3).ravel()).reshape(3, 3)
    if not np.abs(fixed @ fixed.T - np.eye(3)).max() < ORTHOGONAL or np.linalg.det(fixed) < 0:
        raise InputError(
            f"{isd.path}: {key}.constant_rotation is no rotation; nine numbers of an orthogonal "
            "matrix are expected, row by row"
        )
    constant = Rotation.from_matrix(fixed)
    if len(t) == 1:
        rate = isd.array(f"{key}.angular_velocities", (1, 3), np.zeros((1, 3)))[0]
        return lambda at: constant * Rotation.from_rotvec(np.outer(at - t[0], rate)) * R[0]
    slerp = Slerp(t, R)
    return lambda at: constant * slerp(np.clip(at, t[0], t[-1]))


def _rotations(isd, key, scalar_last):
    if not len(scalar_last) or (np.abs(np.linalg.norm(scalar_last, axis=1) - 1) > 1e-4).any():
        raise InputError(f"{isd.path}: {key}.quaternions must be unit quaternions")
    return Rotation.from_quat(scalar_last)


def _middle(t, P, rows, R, middle):
    """At the middle line, in the camera's frame: the direction down, and that of flight."""
    here, after = (np.array([np.interp(middle + dt, t, p) for p in P.T]) for dt in (0, 1e-3))
    camera = Slerp(rows, R)(np.clip(middle, rows[0], rows[-1])).inv()
    return camera.apply(-here), camera.apply(after - here)


def _optics(isd, pixels, down, forward):
    """The optics, and the rotation from its camera frame into that of the ISD."""
    f = isd.number("focal_length_model.focal_length")
    if f == 0:
        raise InputError(f"{isd.path}: focal_length_model.focal_length is 0; millimetres, please")
    x, y = _focal_plane(isd, np.arange(pixels))
    kind, undistorted = _distortion(isd, x, y)
    sights = np.stack([x / f, y / f])
    look = np.array([*sights[:, pixels // 2], 1.0])
    # the camera frame here looks along −z: turned about x, or as it is and seen from behind
    ahead = look @ down > 0
    turn = Rotation.from_matrix(np.diag([1.0, -1, -1]) if ahead else np.eye(3))
    signs = np.array([1.0, -1.0]) if ahead else np.array([-1.0, -1.0])
    along = signs * (sights[:, -1] - sights[:, 0])
    angle = np.arctan2(along[1], along[0])
    about = lambda angle: turn * Rotation.from_rotvec([0, 0, angle])
    if about(angle).inv().apply(forward)[1] < 0:
        angle += np.pi
    c, s = np.cos(angle), np.sin(angle)
    plane = lambda x, y: np.array([[c, s], [-s, c]]) @ (signs[:, None] * [x, y])
    X, Y = plane(x, y)
    pitch = (X[-1] - X[0]) / (pixels - 1)
    straight = np.abs(Y - Y[0]).max() < ALIGNED * max(np.abs(X).max(), abs(f))
    if kind == "radial" and f > 0 and straight:
        K = -isd.array("optical_distortion.radial.coefficients", (None,))
        model = get_model("usgs")
        given = {"c": f, **{f"K{k}": value for k, value in enumerate(K)}}
        parameters = jnp.asarray([given.get(name, 0.0) for name in model.parameters])
        place = (jnp.asarray(v) for v in (pitch, -X[0] / pitch, Y[0]))
        return FocalLine(parameters, *place, "usgs"), about(angle)
    psi = np.arctan(plane(*undistorted) / f)
    return AngleTable(*map(jnp.asarray, psi)), about(angle)


def _focal_plane(isd, u):
    """Where the pixels are in the focal plane, mm, x and y of the ISD."""
    to_line, to_sample = (isd.array(f"focal2pixel_{k}", (3,)) for k in ("lines", "samples"))
    summing = isd.number("detector_sample_summing", 1)
    sample = (u + 0.5) * summing + isd.number("starting_detector_sample", 0)
    line = isd.number("starting_detector_line", 0)
    A = np.stack([to_line[1:], to_sample[1:]])
    if abs(np.linalg.det(A)) < 1e-12 * np.abs(A).max() ** 2 or not A.any():
        raise InputError(f"{isd.path}: focal2pixel_lines and focal2pixel_samples are dependent")
    offset = np.stack([
        np.full(len(u), line - isd.number("detector_center.line") - to_line[0]),
        sample - isd.number("detector_center.sample") - to_sample[0],
    ])  # fmt: skip
    return np.linalg.solve(A, offset)


def _distortion(isd, x, y):
    """Its kind, and the coordinates free of it, mm."""
    given = isd.document.setdefault("optical_distortion", {"radial": {"coefficients": [0.0]}})
    kind = next(iter(given), None) if isinstance(given, dict) else None
    where = f"optical_distortion.{kind}"
    coefficients = lambda n: isd.array(f"{where}.coefficients", (n,))
    match kind:
        case "radial":
            k = np.r_[coefficients(None), 0, 0, 0]
            if len(k) > 6:
                raise InputError(f"{isd.path}: {where}: at most 3 coefficients are known")
            r2 = x * x + y * y
            part = 1 - (k[0] + r2 * (k[1] + r2 * k[2]))
            return kind, (x * part, y * part)
        case "lrolrocnac":
            return kind, (x, y / (1 + coefficients(1)[0] * y * y))
        case "kplo_shadowcam":
            return kind, (x, y * (1 + coefficients(1)[0] * y * y))
        case "kaguyalism":
            r = np.sqrt(x * x + y * y)
            radial = lambda axis: polyval(r, isd.array(f"{where}.{axis}", (None,)))
            shift = lambda axis: radial(axis) + isd.number(f"{where}.boresight_{axis}")
            return kind, (x + shift("x"), y + shift("y"))
        case "transverse":
            a, b = (isd.array(f"{where}.{axis}", (None,)) for axis in "xy")
            a, b = (np.r_[c, np.zeros(10)][:10] for c in (a, b))
            return kind, _transverse(isd, a, b, x, y)
    raise InputError(
        f"{isd.path}: optical_distortion {shown(kind)} is not known; radial, transverse, "
        "lrolrocnac, kplo_shadowcam or kaguyalism is expected"
    )


def _transverse(isd, a, b, x, y):
    """The place that the cubic polynomials a and b distort to (x, y)."""
    u, v = x, y
    for _ in range(100):
        terms = np.stack([
            u**0, u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3,
        ])  # fmt: skip
        du, dv = x - a @ terms, y - b @ terms
        u, v = u + du, v + dv
        if max(np.abs(du).max(), np.abs(dv).max()) < 1e-13 * (1 + np.abs(x).max()):
            return u, v
    raise InputError(f"{isd.path}: optical_distortion.transverse cannot be undone; look at it")
