"""Errors of the orientation of images that `pushbroom refine` has adjusted.

The unknowns of an image move its projections: with RPC (Grodecki and Dial, 2003) by the terms of
its bias,

    ∂(line, sample)/∂(aₖ, bₖ) = mₖ(l̂, ŝ),

of a rigorous image by the derivative of v = S·g (`refinement.kinds`) at the projected point, since
v is the first Newton step towards it. The refined image is taken for the one that the unknowns
belong to: it differs by their estimates, of which the product with an error is of second order. But
(l̂, ŝ) are those of the given coefficients: compensated ones have offsets and scales of their own.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.networks.orientation_covariance import OrientationCovariance, Unknown
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.bias import BiasDomain, bias_terms
from jaxbundle.pushbroom.rpc.polynomials import Rpc, project
from jaxbundle.refinement.freedom import Form, Freedom, make_form, names
from jaxbundle.refinement.kinds import MeasuredLine, ScannerPoint, lines_of
from jaxbundle.refinement.rpc_points import TERM_NAMES, names_of_terms
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


@dataclasses.dataclass(frozen=True)
class GroundOrientation:
    """The unknowns of an image that are not held, their places among all that it may have, and the
    joint covariance of the images of its refinement; `form`: of a rigorous image; `domain`: of an
    image with RPC."""

    joint: OrientationCovariance
    unknowns: tuple[Unknown, ...]
    columns: tuple[int, ...]
    form: Form | None = None
    domain: BiasDomain | None = None


def _orientation(
    joint: OrientationCovariance,
    all_unknowns: tuple[Unknown, ...],
    form: Form | None = None,
    domain: BiasDomain | None = None,
) -> GroundOrientation:
    owners = {unknown[:2] for unknown in all_unknowns}
    strange = [u for u in joint.unknowns if u[:2] in owners and u not in all_unknowns]
    if strange:
        # Left out it would count as held, and σ would be too small.
        raise InputError(
            f"{' '.join(strange[0][:2])} has no unknown {strange[0][2]!r}; the names are those "
            "that pushbroom refine writes"
        )
    # Without a row in the covariance: held in the refinement, so that it has no error.
    is_held = joint.index(all_unknowns) < 0
    columns = tuple(np.flatnonzero(~is_held).tolist())
    return GroundOrientation(joint, tuple(all_unknowns[k] for k in columns), columns, form, domain)


def rpc_orientation(joint: OrientationCovariance, id: str, domain: BiasDomain) -> GroundOrientation:
    """Of an image with RPC; `domain` of the coefficients that were refined.

    **Raises:** `InputError` for unknowns that it cannot have."""
    all_terms = tuple(("image", id, name) for name in names_of_terms(len(TERM_NAMES)))
    return _orientation(joint, all_terms, domain=domain)


def scanner_orientation(
    joint: OrientationCovariance,
    id: str,
    sensor: str,
    image: PushbroomImage,
    earth: Ellipsoid | None,
    knot_spacing: float,
) -> GroundOrientation:
    """Of a rigorous image; `knot_spacing` of its jitter, seconds.

    **Raises:** `InputError` for unknowns that it cannot have."""
    names_of = lambda *owner: [name for *known, name in joint.unknowns if (*known,) == owner]
    jitter = any(" jitter " in name for name in names_of("image", id))
    look = {"across": 0, "along": 0}
    for word in look:
        # Coefficients are counted by their largest exponent: lower ones may be held, and not listed
        look_angles = [name for name in names_of("sensor", sensor) if f"look angle {word}" in name]
        # One without a number is refused below, like all that is not known.
        exponents = [text for name in look_angles if (text := name.rpartition("^")[2]).isdecimal()]
        look[word] = max((int(text) + 1 for text in exponents), default=0)
    # Only which unknowns there are matters here: σ are those of the covariance.
    freedom = Freedom(
        jitter=(1.0, 1.0, 1.0) if jitter else (0.0, 0.0, 0.0),
        knot_spacing=knot_spacing,
        look_across=(1.0,) * look["across"],
        look_along=(1.0,) * look["along"],
    )
    form = make_form(image, earth, freedom)
    owners = (name.owner.partition(" ") for name in names(form.sizes, id, sensor))
    parameters = (name.parameter for name in names(form.sizes, id, sensor))
    all_unknowns = tuple((kind, owner, name) for (kind, _, owner), name in zip(owners, parameters))
    return _orientation(joint, all_unknowns, form)


def scanner_derivative(
    orientation: GroundOrientation,
    image: PushbroomImage,
    earth: Ellipsoid | None,
    X: Float[np.ndarray, "n 3"],
    places: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2 k"]:
    """∂(u, v) of points, in the coordinates of the trajectory and projected to `places` (u, v), by
    the unknowns; pixels per radian, metre, ...."""
    form = orientation.form
    assert form is not None
    kind = ScannerPoint(image.corrections, earth, form.sizes)
    number = sum(form.sizes)
    # At changes of 0, since the image is the refined one.
    zero = np.zeros(form.image_unknowns), np.zeros(number - form.image_unknowns)
    # `refinement` has (line, pixel), a view (u, v) = (pixel, line): turned round, and back below
    lines, _ = lines_of(kind, image, form, np.zeros(3), *zero, X, places[:, ::-1])
    B = np.asarray(_by_unknowns(kind, number, form.image_unknowns, X, lines))
    return B[:, ::-1, list(orientation.columns)]


@compile_once
def _by_unknowns(
    kind: ScannerPoint, number: int, number_of_own: int, X: Float[Array, "n 3"], lines: MeasuredLine
) -> Float[Array, "n 2 k"]:
    def residual(
        p: Float[Array, " k"], X: Float[Array, "3"], line: MeasuredLine
    ) -> Float[AnyArray, "2"]:
        return kind(p[:number_of_own], p[number_of_own:], X, line)

    return jax.vmap(jax.jacfwd(residual), (None, 0, 0))(jnp.zeros(number), X, lines)


def bias_derivative(
    rpc: Rpc, domain: BiasDomain, longitude: Scalar, latitude: Scalar, h: Scalar
) -> Float[Array, "2 12"]:
    """∂(sample, line) of one point by all terms of a bias, of lines before those of samples."""
    terms = jnp.stack(bias_terms(domain, *project(rpc, longitude, latitude, h)))
    # Rows are (u, v) = (sample, line), columns as `names_of_terms`: those of lines first.
    zeros = jnp.zeros_like(terms)
    return jnp.stack([jnp.concatenate([zeros, terms]), jnp.concatenate([terms, zeros])])
