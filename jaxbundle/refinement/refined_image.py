"""The refined image: changes applied to trajectory, mounting and optics.

Positions are changed at the rows of their table, which is exact for changes linear in time. The
attitude, R(t)·exp([a + ȧ·(t − t₀) + s(t)]×), becomes a table of quaternions for slerp: the rows of
the old table and the knots of the spline, halved until slerp follows within 1e-9. An attitude in
the orbital frame is turned back by what the moved positions turn this frame: 10 m from 500 km would
move the ground by 0.7 m.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.geometry import (
    matrix_from_rotation_vector,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
)
from jaxbundle.pushbroom.ancillary import attitude_table
from jaxbundle.pushbroom.image import PushbroomImage, no_offsets
from jaxbundle.pushbroom.interpolation import TimeTable, span
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable, FocalLine, Optics
from jaxbundle.pushbroom.trajectory import (
    AttitudeTable,
    Trajectory,
    attitude_at,
    orbital_frame,
    position_at,
    velocity_at,
)
from jaxbundle.refinement.freedom import Change, Form, change_image, change_optics
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


def refined_image(image: PushbroomImage, form: Form, change: Change) -> PushbroomImage:
    """An image without offsets that equals `image` with its changes."""
    # Without the jitter, which has no middle: the attitude is computed time by time below.
    without_jitter = change_image(
        image, form, change._replace(jitter=0 * change.jitter), image.middle_time
    )
    return PushbroomImage(
        Trajectory(
            _position(without_jitter), _attitude(image, form, change, _position(without_jitter))
        ),
        image.times,
        _optics(image, change),
        without_jitter.mounting,
        no_offsets(),
        image.corrections,
        image.lines,
        image.pixels,
    )


def _position(changed: PushbroomImage) -> TimeTable:
    table, offsets = changed.trajectory.position, changed.offsets
    dt = (table.times - changed.middle_time)[:, None]
    values = table.values + offsets.position + dt * offsets.position_rate
    rates = None if table.rates is None else table.rates + offsets.position_rate
    return dataclasses.replace(table, values=values, rates=rates)


@compile_once
def _rotations(
    image: PushbroomImage,
    form: Form,
    change: Change,
    position: TimeTable,
    times: Float[AnyArray, " n"],
) -> Float[Array, "n 3 3"]:
    """R of the platform in the frame of the attitude table, changed, at many times; `position`: the
    changed table."""
    old = image.trajectory
    new = Trajectory(position, old.attitude)
    begin, end = (old.position.times[k] for k in (0, -1))

    def turned_frame(t: Scalar) -> Float[Array, "3 3"]:
        # Rows of the attitude may be beyond those of the positions, where no line is.
        t = jnp.clip(t, begin, end)
        frame = lambda table: orbital_frame(position_at(table, t), velocity_at(table, t))
        return frame(new).T @ frame(old)

    def rotation(t: Scalar) -> Float[Array, "3 3"]:
        offsets = image.offsets
        turn = offsets.attitude + change.attitude + form.spline.evaluate(change.jitter, t)
        turn += (t - image.middle_time) * (offsets.attitude_rate + change.attitude_rate)
        R = attitude_at(old.attitude, t) @ matrix_from_rotation_vector(turn)
        return turned_frame(t) @ R if old.attitude.reference == "orbit" else R

    return jax.vmap(rotation)(times)


def _attitude(
    image: PushbroomImage, form: Form, change: Change, position: TimeTable
) -> AttitudeTable:
    old = image.trajectory.attitude
    rows = np.asarray(old.table.times)
    begin, last = (float(image.times.time(line)) for line in (-0.5, image.lines - 0.5))
    # Two rows more than the image needs, so that readers may interpolate otherwise.
    start = max(np.searchsorted(rows, begin, side="right") - 1 - 2, 0)
    end = min(np.searchsorted(rows, last) + 2, len(rows) - 1)
    covered = np.clip([begin, last], *span(old.table))
    # An extrapolated end becomes a row.
    times = np.union1d(rows[start : end + 1], covered[(covered < rows[0]) | (covered > rows[-1])])
    centres = form.spline.centres
    times = np.union1d(times, centres[(centres > begin) & (centres < last)])
    gaps = rows[1:][np.diff(rows) > old.table.gap]
    R = lambda t: _pad(lambda t: _rotations(image, form, change, position, t), t)
    rotations, pending = R(times), np.ones(len(times) - 1, bool)
    while pending.any():
        pending_intervals = np.flatnonzero(pending)
        middle = (times[pending_intervals] + times[pending_intervals + 1]) / 2
        rotation_at_middle = R(middle)
        turn = _turns(rotations[pending_intervals], rotations[pending_intervals + 1])
        rotation_halfway = rotations[pending_intervals] @ _pad(_exponentials, turn / 2)
        # 1e-9 rad is a millimetre from 1000 km. The error of slerp is largest in the middle; each
        # halving leaves a quarter of it.
        is_wrong = np.linalg.norm(_turns(rotation_halfway, rotation_at_middle), axis=1) > 1e-9
        # A gap has no values to be followed.
        is_wrong &= ~np.isin(times[pending_intervals + 1], gaps)
        # Both halves of a split interval are checked again.
        order = np.argsort(np.r_[times, middle[is_wrong]], kind="stable")
        is_split = np.zeros(len(times) - 1, bool)
        is_split[pending_intervals[is_wrong]] = True
        pending = np.repeat(is_split, 1 + is_split)
        times = np.r_[times, middle[is_wrong]][order]
        rotations = np.concatenate([rotations, rotation_at_middle[is_wrong]])[order]
        if len(times) > 200_000:  # 20 MB of text: noise, not an attitude
            raise InputError(
                "attitude: more than 200000 rows would be needed to write it; the "
                "table is too rough between its rows"
            )
    quaternions = _pad(_quaternions, rotations)
    # 1 % more than the longest step, or times rounded in a file would make a gap of it
    longest = float(np.diff(times).max()) if not len(gaps) else old.table.gap
    return attitude_table(
        times, quaternions, method="slerp", reference=old.reference, gap=1.01 * longest
    )


def _turns(
    a: Float[np.ndarray, "n 3 3"], b: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Rotation vectors from matrices a to b."""
    return _pad(_logarithms, a.transpose(0, 2, 1) @ b)


_logarithms = compile_once(jax.vmap(rotation_vector_from_matrix), ())
_exponentials = compile_once(jax.vmap(matrix_from_rotation_vector), ())
_quaternions = compile_once(jax.vmap(quaternion_from_matrix), ())


def _pad(
    function: Callable[[np.ndarray], AnyArray], rows: Float[np.ndarray, "n ..."]
) -> Float[np.ndarray, "n ..."]:
    """The function of rows padded to few shapes, to compile little: 2048 rows, which take no time,
    or that times a power of 2."""
    n = len(rows)
    size = 2048 << max(int(np.ceil(np.log2(n / 2048))), 0)
    return np.asarray(function(np.asarray(rows)[np.minimum(np.arange(size), n - 1)]))[:n]


def _optics(image: PushbroomImage, change: Change) -> Optics:
    """Optics of the same kind if possible, else a table of angles."""
    changed_optics = change_optics(image, change)
    base, e = image.optics, change.focal_length
    if isinstance(base, FocalLine):
        parameters = base.parameters
        # A longer principal distance is the same only without distortion.
        candidate = dataclasses.replace(base, parameters=jnp.asarray(parameters).at[0].mul(1 + e))
    elif isinstance(base, AnglePolynomial):
        candidate = _sum(base, e, changed_optics.polynomials)
    else:
        candidate = base
    u = jnp.arange(image.pixels, dtype=float)
    target = _slopes(changed_optics, u)
    # The same up to rounding: a nanometre in a kilometre.
    if float(jnp.abs(_slopes(candidate, u) - target).max()) <= 1e-12:
        return candidate
    return AngleTable(jnp.arctan(target[0]), jnp.arctan(target[1]))


@compile_once
def _slopes(optics: Optics, u: Float[AnyArray, " pixels"]) -> Float[Array, "2 pixels"]:
    return jnp.stack(jax.vmap(optics.slopes)(u))


def _sum(base: AnglePolynomial, e: Scalar, added_polynomial: AnglePolynomial) -> AnglePolynomial:
    """base/(1 + e) + added as one polynomial about the middle of `base`."""
    total = []
    for own_coefficients, added_coefficients in (
        (base.across, added_polynomial.across),
        (base.along, added_polynomial.along),
    ):
        # û of `added_polynomial` as a polynomial of û of `base`, (û·half + middle − middle′)/half′
        line = np.array([float(base.middle - added_polynomial.middle), float(base.half)]) / float(
            added_polynomial.half
        )
        shifted = np.polynomial.Polynomial(np.asarray(added_coefficients))(
            np.polynomial.Polynomial(line)
        ).coef
        total.append(
            jnp.asarray(
                np.polynomial.polynomial.polyadd(
                    np.asarray(own_coefficients) / (1 + float(e)), shifted
                )
            )
        )
    total_across, total_along = total
    return AnglePolynomial(total_across, total_along, base.middle, base.half)
