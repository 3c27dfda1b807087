"""Scanner images written as model states of usgscsm, which `csm_state` reads.

A state has an even table of positions and one of quaternions (camera → body), both interpolated by
Lagrange's polynomial of degree 7, so that the tables continue four rows beyond the image; detectors
on a straight line, distorted by cubic polynomials; and no corrections. So

- the step of the tables is halved until the polynomials follow the trajectory between the rows, or
  until three more halvings come no nearer: polynomials through tables that are coarser than those
  of the image oscillate by chance; and n rows leave some n·ε/2 of the distance from the Earth's
  centre, since their times differ in the last digits;
- rows beyond the tables of the image continue its first and last rows by a polynomial;
- corrections (aberration, refraction, light time) go into the attitude: with the point X on the
  ground of the pixels u of a time, the rotation that turns their sights best into X − P (Kabsch,
  1976), at a middle height, and what a rotation of the middle line leaves into the optics. What
  differs from line to line and with the height remains, and is told;
- optics are lines, or the cubic polynomials `transverse` that come nearest.

`StateFit` has what remains of each.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.scanner.csm_state import MODEL
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.pushbroom.image import PushbroomImage, pose_at
from jaxbundle.pushbroom.image_to_ground import ground_point
from jaxbundle.pushbroom.interpolation import span
from jaxbundle.pushbroom.scanner import slopes_of
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# Degree of `m_platformFlag` 1: with as many rows on each side, four beyond the ends.
DEGREE, SIDE_ROWS = 7, 4
# Halvings of the step that come no nearer, before the search for it ends.
MAX_HALVINGS = 3
# From our camera frame, which looks along −z, to that of the state.
TURN = np.diag([1.0, -1.0, -1.0])


class _Source(NamedTuple):
    """What is written: the image, its Earth, a height of the ground, and the sights (ξ, η) of its
    pixels with the corrections in the middle of the image."""

    image: PushbroomImage
    earth: Ellipsoid
    height: float
    sights: Float[np.ndarray, "2 pixels"]


class StateFit(NamedTuple):
    """The largest differences of a state from its image: metres on the ground, of which those of
    the `trajectory` between the rows, of `optics` and of `corrections`; `rows` of the tables."""

    ground: float
    trajectory: float
    optics: float
    corrections: float
    rows: int


def write_csm_state(
    path: str | Path,
    image: PushbroomImage,
    earth: Ellipsoid | None,
    height: float = 0.0,
    name: str = "jaxbundle",
    tolerance: float = 2e-7,
    max_rows: int = 2**16,
) -> StateFit:
    """Write an image as a model state of usgscsm (`USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL` and JSON).

    **Arguments:** `height`: above the ellipsoid, of the ground where the corrections hold;
    `tolerance`: metres on the ground that the trajectory may differ between the rows of its tables,
    unless they have `max_rows`: 65 536 take 10 MB.

    **Raises:** `InputError` for an image in a local frame, or above a triaxial ellipsoid.
    """
    if earth is None or earth.a != earth.b:
        raise InputError(f"{path}: a model state needs an ellipsoid of revolution")
    first_time, last_time = (float(image.times.time(line)) for line in (-0.5, image.lines - 0.5))
    first_time, last_time = np.clip([first_time, last_time], *_covered_interval(image))
    distance = _longest_sight(image, earth, height)
    sights = _corrected_sights(image, earth, height)
    source = _Source(image, earth, height, sights)
    # 16 intervals of a second: usual tables have 1 to 100 rows a second
    intervals = int(max(16, np.ceil(16 * (last_time - first_time))))
    best, halvings_without_gain = None, 0
    while best is None or intervals + 2 * SIDE_ROWS + 1 <= max_rows:
        t, P, R = _tables(source, first_time, last_time, intervals)
        middles = first_time + (last_time - first_time) * (np.arange(intervals) + 0.5) / intervals
        true_poses = _poses(source, middles)
        # Of the middles of intervals, in which the error is largest.
        P_found = _interpolate_middles(t, P - P[0], middles) + P[0]
        R_found = Rotation.from_quat(_interpolate_middles(t, R.as_quat(), middles))
        error = np.linalg.norm(P_found - true_poses[0], axis=1).max()
        error += distance * (R_found.inv() * Rotation.from_matrix(true_poses[1])).magnitude().max()
        error += len(t) * np.finfo(float).eps / 2 * np.linalg.norm(P[0])
        if best is None or error < best[0]:
            best, halvings_without_gain = (float(error), t, P, R), 0
        else:
            halvings_without_gain += 1
        if error <= tolerance or halvings_without_gain == MAX_HALVINGS:
            break
        intervals *= 2
    assert best is not None
    trajectory, *tables = best
    optics, tangent = _optics(sights)
    corrections = _residual_corrections(source)
    lens = tangent * distance
    fit = StateFit(trajectory + lens + corrections, trajectory, lens, corrections, len(tables[0]))
    state = _state(image, earth, (tables[0], tables[1], tables[2]), name) | optics
    state |= _description(image, earth, height, distance)
    write_text(Path(path), f"{MODEL}\n{json.dumps(state, indent=1, sort_keys=True)}\n")
    return fit


def _covered_interval(image: PushbroomImage) -> tuple[float, float]:
    """The times that both tables cover."""
    trajectory = image.trajectory
    ends = [span(trajectory.position), span(trajectory.attitude.table)]
    return max(float(a) for a, _ in ends), min(float(b) for _, b in ends)


def _tables(
    source: _Source, first_time: float, last_time: float, n: int
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows 3"], Rotation]:
    """Rows of the image and `SIDE_ROWS` on each side, continued where the image has none."""
    step = (last_time - first_time) / n
    t = first_time + step * np.arange(-SIDE_ROWS, n + SIDE_ROWS + 1)
    low, high = _covered_interval(source.image)
    # Rounding of the ends.
    is_covered = (t >= low - 1e-9 * step) & (t <= high + 1e-9 * step)
    P, R = np.full((len(t), 3), np.nan), np.full((len(t), 3, 3), np.nan)
    P[is_covered], R[is_covered] = _poses(source, np.clip(t[is_covered], low, high))
    q = Rotation.from_matrix(np.where(is_covered[:, None, None], R, np.eye(3))).as_quat()
    # One sign along the table: q and −q are the same rotation.
    for k in np.flatnonzero(is_covered)[1:]:
        q[k] *= np.sign(q[k] @ q[k - 1]) or 1.0
    covered_rows = np.flatnonzero(is_covered)
    for values in (P, q):
        origin = values[covered_rows[0]].copy()
        for k in np.flatnonzero(~is_covered):
            nearest_rows = covered_rows[:5] if k < covered_rows[0] else covered_rows[-5:]
            # Of degree 4: a row of the tables is a thousandth of an orbit or of a jitter.
            values[k] = origin + _lagrange(t[nearest_rows], values[nearest_rows] - origin, t[k])
    return t, P, Rotation.from_quat(q)


def _interpolate_middles(
    t: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, "rows k"],
    times: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n k"]:
    """Lagrange's polynomial through four rows on each side of the middles of intervals."""
    signs = np.cumprod(np.r_[1, np.sign(np.einsum("nk,nk->n", values[1:], values[:-1]))])
    if values.shape[1] == 4:
        values = values * signs[:, None]
    i = np.searchsorted(t, times, side="right") - 1
    k = np.arange(1 - SIDE_ROWS, SIDE_ROWS + 1)
    weights = _weights(k.astype(float), 0.5)
    return np.einsum("j,njk->nk", weights, values[i[:, None] + k])


def _weights(nodes: Float[np.ndarray, " n"], position: float) -> Float[np.ndarray, " n"]:
    """Lagrange's weights of nodes at a position."""
    return np.array(
        [
            np.prod(
                [
                    (position - other_node) / (node - other_node)
                    for other_node in nodes
                    if other_node != node
                ]
            )
            for node in nodes
        ]
    )


def _lagrange(
    t: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"], time: float
) -> Float[np.ndarray, " k"]:
    return _weights((t - t[0]) / (t[1] - t[0]), (time - t[0]) / (t[1] - t[0])) @ values


def _poses(
    source: _Source, times: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """P and R, camera → Earth-fixed, that a model without corrections needs."""
    # Of few shapes, so that few programs are compiled.
    size = 256 << max(int(np.ceil(np.log2(len(times) / 256))), 0)
    padded = np.asarray(times)[np.minimum(np.arange(size), len(times) - 1)]
    u = _some_pixels(source.image)
    P, R, d = (np.asarray(a)[: len(times)] for a in _rays(*source[:3], padded, u))
    return P, _fit_rotations(
        d, _unit_sights(source.sights[:, u])
    ) if source.image.corrections.any else R


def _some_pixels(image: PushbroomImage) -> np.ndarray:
    """Five pixels along the line."""
    return np.rint(np.linspace(0, image.pixels - 1, 5)).astype(int)


def _unit_sights(slopes: Float[np.ndarray, "2 k"]) -> Float[np.ndarray, "k 3"]:
    c = np.stack([*slopes, np.full(slopes.shape[1], -1.0)], 1)
    return c / np.linalg.norm(c, axis=1, keepdims=True)


def _fit_rotations(
    d: Float[np.ndarray, "n k 3"], c: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """The rotations that turn the sights c of the camera best into the directions d."""
    U, _, V = np.linalg.svd(np.einsum("nki,kj->nij", d, c))
    U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
    return U @ V


@compile_once
def _rays(
    image: PushbroomImage,
    earth: Ellipsoid,
    height: Scalar,
    times: Float[AnyArray, " n"],
    pixels: Int[AnyArray, " k"],
) -> tuple[Array, Array, Array]:
    """P, R, and unit vectors [n, k, 3] to the points of pixels at the height, Earth-fixed."""
    surface = Height(level=height, earth=earth)

    def rays_at(t: Scalar) -> tuple[Array, Array, Array]:
        pose = pose_at(image, t)

        def direction(u: Scalar) -> Array:
            X = ground_point(pose, image.optics.slopes(u), surface, image.corrections)
            d = jnp.stack([*X]) - pose.P
            return d / jnp.linalg.norm(d)

        return jnp.asarray(pose.P), jnp.asarray(pose.R), jax.vmap(direction)(pixels * 1.0)

    return jax.lax.map(rays_at, times, batch_size=64)


def _corrected_sights(
    image: PushbroomImage, earth: Ellipsoid, height: float
) -> Float[np.ndarray, "2 pixels"]:
    """(ξ, η) of all pixels; with what the corrections do beside a rotation in the middle line."""
    u = np.arange(image.pixels)
    slopes = np.stack([np.asarray(v) for v in slopes_of(image.optics, jnp.asarray(u * 1.0))])
    if not image.corrections.any:
        return slopes
    _, _, d = _rays(image, earth, height, np.asarray(image.middle_time)[None], u)
    R = _fit_rotations(np.asarray(d), _unit_sights(slopes))[0]
    r, s, q = R.T @ np.asarray(d)[0].T
    return np.stack([-r / q, -s / q])


def _residual_corrections(source: _Source) -> float:
    """Metres on the ground that the corrections differ from a rotation of each line, 500 m higher
    and lower, too."""
    image, earth, height, sights = source
    if not image.corrections.any:
        return 0.0
    first_time, last_time = (float(image.times.time(line)) for line in (0.0, image.lines - 1.0))
    times, u = np.linspace(first_time, last_time, 9), _some_pixels(image)
    _, R = _poses(source, times)
    model_directions = np.einsum("nij,kj->nki", R, _unit_sights(sights[:, u]))
    largest = 0.0
    for level in (height - 500.0, height, height + 500.0):
        d = np.asarray(_rays(image, earth, level, times, u)[2])
        angle = np.linalg.norm(np.cross(model_directions, d), axis=2).max()
        largest = max(largest, float(angle) * _longest_sight(image, earth, level))
    return largest


def _longest_sight(image: PushbroomImage, earth: Ellipsoid, height: float) -> float:
    """The longest sight of the middle line, metres."""
    pose = pose_at(image, image.middle_time)
    surface = Height(level=height, earth=earth)
    X = [
        np.stack([*ground_point(pose, image.optics.slopes(u), surface, image.corrections)])
        for u in (0.0, (image.pixels - 1) / 2, image.pixels - 1.0)
    ]
    return float(max(np.linalg.norm(x - np.asarray(pose.P)) for x in X))


def _optics(sights: Float[np.ndarray, "2 pixels"]) -> tuple[dict[str, Any], float]:
    """The fields of the optics, in units of a pixel, and the largest error of a sight's tangent.

    Undistorted (x, y)/f = (ξ, −η); detectors lie at x = u − middle, y = 0.
    """
    xi, eta = sights
    u = np.arange(len(xi), dtype=float)
    f = (len(xi) - 1) / abs(xi[-1] - xi[0])
    sign = np.sign(xi[-1] - xi[0])
    x, y = f * xi, -f * eta
    middle = float(np.mean(u - sign * x))
    distorted = sign * (u - middle)
    row = float(np.mean(y))
    common_fields = {
        "m_focalLength": f,
        "m_zDirection": 1.0,
        "m_iTransL": [0.0, 0.0, 1.0],
        "m_iTransS": [0.0, float(sign), 0.0],
        "m_detectorSampleOrigin": middle + 0.5,
        "m_detectorLineSumming": 1.0,
        "m_detectorSampleSumming": 1.0,
        "m_startingDetectorLine": 0.0,
        "m_startingDetectorSample": 0.0,
    }
    straight_error = max(np.abs(x - distorted).max(), np.abs(y - row).max())
    # In pixels: above the rounding of a line of 1e5 of them, some 1e-11, and a nanometre on the
    # ground for pixels of a metre.
    if straight_error < 1e-9:
        fields = {"m_detectorLineOrigin": -row, "m_distortionType": 0}
        return common_fields | fields | {"m_opticalDistCoeffs": [0.0, 0.0, 0.0]}, straight_error / f
    # Distorted x = a(x), y = y − b(x) = 0: cubics of the undistorted x, in units of the half line.
    half_line = max(np.abs(x).max(), 1.0)
    powers = np.stack([(x / half_line) ** k for k in range(4)], 1)
    scale = half_line ** np.arange(4)
    a, b = (np.linalg.lstsq(powers, v, rcond=None)[0] for v in (distorted, y))
    residual = np.hypot(powers @ a - distorted, powers @ b - y).max()
    terms = np.zeros((2, 10))
    terms[0, [0, 1, 3, 6]], terms[1, [0, 1, 3, 6]] = a / scale, -b / scale
    terms[1, 2] = 1.0
    fields = {"m_detectorLineOrigin": 0.0, "m_distortionType": 1}
    return common_fields | fields | {"m_opticalDistCoeffs": terms.ravel().tolist()}, float(
        residual / f
    )


def _state(
    image: PushbroomImage,
    earth: Ellipsoid,
    tables: tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows 3"], Rotation],
    name: str,
) -> dict[str, Any]:
    """The fields of trajectory and times."""
    t, P, R = tables
    step = float(t[1] - t[0])
    velocity = np.gradient(P, step, axis=0)
    q = (R * Rotation.from_matrix(TURN)).as_quat()
    q *= np.cumprod(np.r_[1, np.sign(np.einsum("nk,nk->n", q[1:], q[:-1]))])[:, None]
    lines, starts, periods = _line_times(image)
    return {
        "m_modelName": MODEL,
        "m_imageIdentifier": name,
        "m_sensorName": name,
        "m_sensorIdentifier": "",
        "m_platformIdentifier": "",
        "m_platformFlag": 1,
        "m_ikCode": 0,
        "m_nLines": image.lines,
        "m_nSamples": image.pixels,
        "m_intTimeLines": lines,
        "m_intTimeStartTimes": starts,
        "m_intTimes": periods,
        "m_startingEphemerisTime": 0.0,
        "m_centerEphemerisTime": 0.0,
        "m_t0Ephem": float(t[0]),
        "m_dtEphem": step,
        "m_t0Quat": float(t[0]),
        "m_dtQuat": step,
        "m_numPositions": P.size,
        "m_numQuaternions": q.size,
        "m_positions": P.ravel().tolist(),
        "m_velocities": velocity.ravel().tolist(),
        "m_quaternions": q.ravel().tolist(),
        "m_majorAxis": float(earth.a),
        "m_minorAxis": float(earth.c),
        "m_currentParameterValue": [0.0] * 16,
        "m_parameterType": [2] * 16,
        "m_covariance": np.eye(16).ravel().tolist(),
        "m_sunPosition": [0.0] * 3,
        "m_sunVelocity": [0.0] * 3,
    }


def _line_times(image: PushbroomImage) -> tuple[list[float], list[float], list[float]]:
    """Line (its first is 1), time and period of parts with one period: line l, counted from 0, is
    taken at t₀ + p·(l + 1 − L₀)."""
    if image.times.table is None:
        return [1.0], [float(image.times.first)], [float(image.times.period)]
    t = np.asarray(image.times.table)
    steps = np.diff(t)
    steps = np.r_[steps, steps[-1:]]
    # Parts end where the time of a line is not that of its part, to a nanosecond: 8 µm of a track.
    lines, k = [0], 0
    while k < len(t):
        is_deviating = np.abs(t[k:] - t[k] - steps[k] * np.arange(len(t) - k)) > 1e-9
        if not is_deviating.any():
            break
        k += int(is_deviating.argmax())
        lines.append(k)
    return [k + 1.0 for k in lines], t[lines].tolist(), steps[lines].tolist()


def _description(
    image: PushbroomImage, earth: Ellipsoid, height: float, distance: float
) -> dict[str, Any]:
    """Fields that describe the image without being used for its geometry."""
    times = [float(image.times.time(line)) for line in (0.0, image.lines - 1.0)]
    surface = Height(level=height, earth=earth)
    pose = pose_at(image, image.middle_time)
    ground_at = lambda u: np.stack(
        [*ground_point(pose, image.optics.slopes(u), surface, image.corrections)]
    )
    ends = ground_at(0.0), ground_at(image.pixels - 1.0)
    swath = float(np.linalg.norm(ends[1] - ends[0]))
    return {
        "m_referencePointXyz": ground_at((image.pixels - 1) / 2).tolist(),
        "m_gsd": swath / (image.pixels - 1),
        "m_halfSwath": swath / 2,
        "m_halfTime": (times[1] - times[0]) / 2,
        "m_flyingHeight": distance,
        "m_minElevation": -10000.0,
        "m_maxElevation": 10000.0,
    }
