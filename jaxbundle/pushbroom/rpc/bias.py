"""Bias compensation of RPCs with control points, in the image (Grodecki, Dial, 2003, PE&RS 69(1)).

    line   + v = l + a₀ + a₁·l̂ + a₂·ŝ + a₃·l̂² + a₄·l̂ŝ + a₅·ŝ²,        sample + v = s + b₀ + b₁·l̂ + …

(l, s) the image of a control point by the coefficients, (l̂, ŝ) the same minus offset, divided by
scale. `"shift"` estimates only a₀, b₀, `"affine"` three of each, `"quadratic"` all. With the σ of
the measurement and of the control point, G = ∂(l, s)/∂(east, north, up), the weights of a point are

    P = (diag(σ²) + G·Σ·Gᵀ)⁻¹.

For correlated observations (Baarda, 1968), with Q the cofactors of the unknowns:

    Qv = P⁻¹ − A·Q·Aᵀ,      r = diag(Qv·P),      w = (P·v)ᵢ/√(P·Qv·P)ᵢᵢ.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.choices import RPC_BIASES
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, earth_fixed, geodetic
from jaxbundle.geometry.vectors import Vector, point_on_ray
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.exchanged_columns import refuse_exchanged
from jaxbundle.pushbroom.rpc.fitting import RpcCheck, RpcTable, check_rpc, fit_rpc, plain_table
from jaxbundle.pushbroom.rpc.polynomials import DOMAIN_MARGIN, Rpc, Scalar, project, project_points
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

# Unknowns of each axis: the terms of a polynomial of degree 0, 1, 2 in (l̂, ŝ).
MODELS = dict(zip(RPC_BIASES, (1, 3, 6), strict=True))
CONTROL = Source("control points")


class RpcBias(eqx.Module):
    """a₀, a₁, … and b₀, b₁, …, in pixels: 1, 3 or 6 of each for the degrees 0, 1, 2; those of a
    higher degree than was estimated are 0."""

    line: Float[AnyArray, " terms"] | tuple[Scalar, ...]
    sample: Float[AnyArray, " terms"] | tuple[Scalar, ...]


class BiasFit(eqx.Module):
    """An estimated bias: cofactors (a₀…, then b₀…), σ0, and for lines and samples of each control
    point residuals (pixels), redundancy numbers, w (σ a priori). σ0 is NaN without redundancy.
    """

    bias: RpcBias
    cofactor: Float[np.ndarray, "u u"]
    sigma0: float
    redundancy: int
    residuals: Float[np.ndarray, "n 2"]
    redundancy_numbers: Float[np.ndarray, "n 2"]
    w: Float[np.ndarray, "n 2"]

    @property
    def covariance(self) -> Float[np.ndarray, "u u"]:
        """σ0²·Q, a posteriori; a priori (σ0 = 1) without redundancy."""
        return self.cofactor * (self.sigma0**2 if self.redundancy else 1.0)


def project_compensated(
    rpc: Rpc, bias: RpcBias, longitude: Scalar, latitude: Scalar, height: Scalar
) -> tuple[Scalar, Scalar]:
    """Line and sample of one point, radians and metres, with the bias."""
    line, sample = project(rpc, longitude, latitude, height)
    terms = bias_terms(rpc, line, sample)
    # Scalars, as in `rpc`: `terms` are more than the coefficients of a lower degree.
    return (
        line + sum(a * term for a, term in zip(bias.line, terms)),
        sample + sum(b * term for b, term in zip(bias.sample, terms)),
    )


def fit_bias(
    rpc: Rpc,
    control: RpcTable,
    *,
    model: str = "shift",
    sigma: float | Float[np.ndarray, "n 2"] = 1.0,
    ground_sigma: Float[np.ndarray, "n 3"] | None = None,
    earth: Ellipsoid = WGS84,
    source: Source = CONTROL,
) -> BiasFit:
    """The bias estimated from control points.

    **Arguments:** `control` as given and as measured; `sigma` of the measurements, in pixels;
    `ground_sigma` of the points east, north, up, metres (none if None); `source` names rows.

    **Raises:** `InputError` for an unknown model, too few points, collinear points, invalid
    numbers, exchanged lines and samples, and points or measurements outside the domain of the
    coefficients.
    """
    require_x64()
    if model not in MODELS:
        raise InputError(f"unknown bias {model!r}; one of {', '.join(MODELS)} is expected")
    control = plain_table(control)
    n, k = len(control.line), MODELS[model]
    for name, column in zip(control._fields, control):
        if (bad := ~np.isfinite(column)).any():
            raise InputError(f"{source(int(bad.argmax()))}: the {name} is not a finite number")
    if n < k:
        raise InputError(f"{source.name}: {n} control points; {model!r} needs {k}; give more")
    sigma = np.broadcast_to(np.asarray(sigma, float), (n, 2))
    if (bad := ~(sigma > 0).all(1)).any():
        raise InputError(f"{source(int(bad.argmax()))}: σ must be positive, in pixels")
    # Snooping leaves out one point after the other: the next number of a program stays the same.
    padding = round_up(n) - n
    padded = (np.pad(column, (0, padding), mode="edge") for column in control[:3])
    computed, G = (np.asarray(a)[:n] for a in images_and_slopes(rpc, earth, *padded))
    if (bad := ~np.isfinite(computed).all(1)).any():
        raise InputError(
            f"{source(int(bad.argmax()))}: the coefficients have no image of this point; check "
            "longitude, latitude, height and their order"
        )
    measured = np.stack([control.line, control.sample], 1)
    refuse_exchanged(measured, computed, source.name, columns=("line", "sample"))
    check_domain(rpc, control, source)
    # With numbers of NumPy: JAX would compile every operation for each number of points.
    terms = np.stack(bias_terms(domain_of_bias(rpc), *computed.T), 1)[:, :k]
    singular = np.linalg.svd(terms, compute_uv=False)
    # 1e-6 of 10 000 pixels is a hundredth of a pixel: points so near a line do not fix its sides
    if singular[-1] < 1e-6 * singular[0]:
        curve = "line" if model == "affine" else "conic section"
        raise InputError(
            f"{source.name}: all points on one {curve}, which leaves {model!r} undetermined; give "
            "others, or use 'shift'"
        )
    ground = np.zeros((n, 3)) if ground_sigma is None else np.asarray(ground_sigma, float)
    cofactors = np.einsum("nij,nj,nkj->nik", G, ground**2, G)
    cofactors = cofactors + sigma[:, :, None] ** 2 * np.eye(2)
    return _adjust(terms, measured - computed, cofactors)


def _adjust(
    terms: Float[np.ndarray, "n k"],
    difference: Float[np.ndarray, "n 2"],
    cofactors: Float[np.ndarray, "n 2 2"],
) -> BiasFit:
    """Least squares of measured minus computed positions with P⁻¹ of each, `cofactors`.

    Line and sample of a point are correlated by its ground coordinates: P has a block of 2 × 2 a
    point, and of Qv only these blocks are needed.
    """
    n, k = terms.shape
    A = np.zeros((n, 2, 2 * k))
    A[:, 0, :k] = A[:, 1, k:] = terms
    P = np.linalg.inv(cofactors)
    PA = P @ A
    Q = np.linalg.inv(np.einsum("nia,nib->ab", A, PA))
    x = Q @ np.einsum("nia,ni->a", PA, difference)
    v = A @ x - difference
    Qv = cofactors - A @ Q @ np.swapaxes(A, 1, 2)
    r = np.clip(np.einsum("nij,nji->ni", Qv, P), 0.0, 1.0)
    test = np.einsum("nij,njk,nki->ni", P, Qv, P)
    free = r > 1e-8  # r = 0 exactly, up to rounding: the point has no test
    Pv = np.einsum("nij,nj->ni", P, v)
    w = np.where(free, Pv / np.sqrt(np.where(free, test, 1.0)), np.nan)
    redundancy = 2 * n - 2 * k
    vtpv = float(np.sum(v * Pv))
    sigma0 = float(np.sqrt(vtpv / redundancy)) if redundancy else np.nan
    full = lambda a: jnp.asarray(np.r_[a, np.zeros(max(3 - k, 0))])
    return BiasFit(
        RpcBias(full(x[:k]), full(x[k:])),
        Q,
        sigma0,
        redundancy,
        v,
        r,
        w,
    )


def apply_bias(rpc: Rpc, bias: RpcBias) -> tuple[Rpc, RpcCheck | None]:
    """Coefficients including the bias, and the residuals of a fit (None for a shift, which is
    exact).

    A shift changes the offsets. Any other bias mixes two fractions of different denominators: the
    coefficients are refitted over the domain of the old ones.
    """
    if not np.any(np.r_[bias.line[1:], bias.sample[1:]]):
        shifted_offsets = (rpc.line_offset + bias.line[0], rpc.sample_offset + bias.sample[0])
        return eqx.tree_at(lambda r: (r.line_offset, r.sample_offset), rpc, shifted_offsets), None
    # 12³ points for 39 unknowns an axis
    side = np.linspace(-1, 1, 12)
    L, P, H = (a.ravel() for a in np.meshgrid(side, side, side))
    place = (
        np.radians(float(rpc.longitude_offset) + float(rpc.longitude_scale) * L),
        np.radians(float(rpc.latitude_offset) + float(rpc.latitude_scale) * P),
        float(rpc.height_offset) + float(rpc.height_scale) * H,
    )
    l, s, _ = (np.asarray(a) for a in project_points(rpc, *place))
    line, sample = (np.asarray(a) for a in _compensated(rpc, bias, *place))
    _, l_hat, s_hat, *_ = bias_terms(rpc, l, s)
    reach = 1 + DOMAIN_MARGIN
    # Corners of the box of ground coordinates may be outside the image.
    rows_inside = np.flatnonzero((abs(l_hat) <= reach) & (abs(s_hat) <= reach))
    # A multiple of 128 of the 1000 to 1728 points: most images share a compiled fit.
    number = max(len(rows_inside) // 128 * 128, min(len(rows_inside), 128))
    rows = rows_inside[np.linspace(0, len(rows_inside) - 1, number).astype(int)]
    table = RpcTable(*(np.asarray(column)[rows] for column in (*place, line, sample)))
    fitted = fit_rpc(table).rpc
    return fitted, check_rpc(fitted, table)


def check_domain(rpc: Rpc, control: RpcTable, source: Source) -> None:
    """Refuse points outside the domain of the coefficients: another area, another image,
    swapped.

    **Arguments:** `source` names the rows of `control`.

    **Raises:** `InputError` naming the row, what is outside, and the domain."""
    longitude, latitude, height, line, sample = control
    axes = (
        ("longitude", np.degrees(longitude), "°", "look at coordinates and their order"),
        ("latitude", np.degrees(latitude), "°", "look at coordinates and their order"),
        ("height", height, " m", "heights are above the ellipsoid"),
        ("line", line, "", "look at the measurement, and that the file is of this image"),
        ("sample", sample, "", "look at the measurement, and that the file is of this image"),
    )
    for name, values, unit, remedy in axes:
        centre, scale = (float(getattr(rpc, f"{name}_{part}")) for part in ("offset", "scale"))
        difference = values - centre
        if name == "longitude":
            difference = difference - 360 * np.round(difference / 360)
        reach = (1 + DOMAIN_MARGIN) * abs(scale)
        is_outside = np.abs(difference) > reach
        if is_outside.any():
            row = int(is_outside.argmax())
            raise InputError(
                f"{source(row)}: {name} {values[row]:.9g}{unit} is outside the domain of the "
                f"coefficients, {centre - reach:.9g} to {centre + reach:.9g}{unit}; {remedy}"
            )


class BiasDomain(NamedTuple):
    """The offsets and scales of the coefficients that a bias belongs to."""

    line_offset: Scalar
    line_scale: Scalar
    sample_offset: Scalar
    sample_scale: Scalar


def domain_of_bias(rpc: Rpc) -> BiasDomain:
    """The offsets and scales of coefficients."""
    return BiasDomain(*(float(getattr(rpc, name)) for name in BiasDomain._fields))


def bias_terms(rpc: Rpc | BiasDomain, line: Scalar, sample: Scalar) -> tuple[Scalar, ...]:
    """1, l̂, ŝ, l̂², l̂ŝ, ŝ²: what the coefficients of a bias are multiplied by."""
    l = (line - rpc.line_offset) / rpc.line_scale
    s = (sample - rpc.sample_offset) / rpc.sample_scale
    return 1.0 + 0 * l, l, s, l * l, l * s, s * s


_compensated = compile_once(jax.vmap(project_compensated, (None, None, 0, 0, 0)), ())


@partial(compile_once, static=())
def images_and_slopes(
    rpc: Rpc,
    earth: Ellipsoid,
    longitude: Float[AnyArray, " n"],
    latitude: Float[AnyArray, " n"],
    height: Float[AnyArray, " n"],
) -> tuple[Array, Array]:
    """(l, s) [n, 2] and their derivatives by east, north, up [n, 2, 3]."""

    def shifted_image(shift: Float[Array, "3"], place: Vector) -> tuple[Array, Array]:
        """(l, s) of a point moved by (east, north, up), as value and as `has_aux` of JAX."""
        east, north, _ = place
        s, c, z, k = jnp.sin(east), jnp.cos(east), jnp.sin(north), jnp.cos(north)
        X = earth_fixed(earth, place)
        for axis, size in zip(((-s, c, 0.0), (-z * c, -z * s, k), (k * c, k * s, z)), shift):
            X = point_on_ray(X, axis, size)
        value = jnp.stack(project(rpc, *geodetic(earth, X)))
        return value, value

    def image_and_slopes(*place: Scalar) -> tuple[Array, Array]:
        G, value = jax.jacfwd(shifted_image, has_aux=True)(jnp.zeros(3), place)
        return value, G

    return jax.vmap(image_and_slopes)(longitude, latitude, height)
