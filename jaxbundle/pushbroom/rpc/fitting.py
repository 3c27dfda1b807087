"""Rational polynomial coefficients fitted to a table, given or computed by a rigorous model.

For the lines, and likewise for the samples, with T the 20 terms of a point, y its normalised line
and c = (a, b) the 20 coefficients of the numerator and the 19 free ones of the denominator,

    v = a·T/(1 + b·T') − y,        Σv² + τ²·|D·c|² → min.

The start is linear, a·T − y·b·T' = y (Tao and Hu, 2001, PE&RS 67(12)); Gauss-Newton steps follow,
halved until the sum decreases and no denominator vanishes at a point.

The unknowns are nearly dependent, so τ keeps them small (Tikhonov), except the constant and the
three linear terms of the numerator, for which D is a thousand times smaller. τ is the largest that
predicts each point from all others about as well as the best τ (PRESS, Allen, 1974;
`RpcFitSettings`), or the next larger one with which the steps converge:

    PRESS(τ) = mean (vᵢ/(1 − hᵢ))²,        h = diag J·(N + τ²D²)⁻¹·Jᵀ,    N = Jᵀ·J.

The covariance is that of the effect of table noise on the coefficients,

    Σ = σ²·(N + τ²D²)⁻¹·N·(N + τ²D²)⁻¹,

σ by default a posteriori with redundancy n − Σhᵢ. The bias of the ridge is not noise: it appears in
the residuals, like everything that rational polynomials of degree 3 cannot represent.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import numeric_array
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.rpc.polynomials import TERMS, Rpc, monomials, project_points
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

UNKNOWNS = 2 * TERMS - 1
# One more than unknowns: a redundancy.
MIN_POINTS = UNKNOWNS + 1
# In units of the largest singular value: in steps of √10 down to rounding.
CANDIDATE_RIDGES = 10.0 ** np.arange(-1.0, -15.25, -0.5)
TABLE = Source("table")


@dataclasses.dataclass(frozen=True)
class RpcFitSettings:
    """How coefficients are fitted.

    Measured by the RMS at other points than the fitted ones: of a smooth satellite image (7e-6
    pixels, a table without noise), and of a table of 720 points with a noise of 0.3 pixels (0.07
    and 0.05 pixels of lines and samples).

    - `linear_damping`: D of the constant and linear terms of the numerator, 1 for all others: they
      carry the image, and no ridge shall shrink them. With noise half costs 0.04 pixels of the
      lines, double 0.02.
    - `relative_press`: a larger ridge is taken if its RMS of predicted residuals is at most this
      multiple of the least: half of the excess changes nothing, double costs 0.05 pixels of the
      samples.
    - `sufficient_residual`: or if it is within so many pixels of the least; this is the accuracy of
      a fit without noise, half and double of it too.
    - `start_ridge`: of the linear start, in units of the largest singular value. Not critical.
    - `ridge_steps`: Gauss–Newton steps in which the ridge is chosen anew; then it stays, so that
      the sum that is minimised stays the same. Two or six change nothing in these cases.
    - `max_steps`: of all with one ridge. An image whose oscillations polynomials cannot follow
      needs up to 60, or a larger ridge.
    - `max_halvings`: of a step; 30 leave a billionth of it. Not critical.
    - `relative_change`, `absolute_change`: converged if the last full step moves no point by more
      than this fraction of the RMS residual plus so many pixels. Not critical.
    """

    linear_damping: float = 1e-3
    relative_press: float = 1.05
    sufficient_residual: float = 1e-5
    start_ridge: float = 1e-2
    ridge_steps: int = 3
    max_steps: int = 30
    max_halvings: int = 30
    relative_change: float = 1e-3
    absolute_change: float = 1e-8


DEFAULTS = RpcFitSettings()


class RpcTable(NamedTuple):
    """Ground points and their image positions: radians, metres, lines, samples."""

    longitude: Float[np.ndarray, " n"]
    latitude: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    line: Float[np.ndarray, " n"]
    sample: Float[np.ndarray, " n"]


class RpcCheck(NamedTuple):
    """Computed minus given lines and samples of a table, their RMS and largest amount, in
    pixels."""

    residuals: Float[np.ndarray, "n 2"]
    rms: Float[np.ndarray, "2"]
    largest: Float[np.ndarray, "2"]
    table: RpcTable

    @property
    def worst(self) -> int:
        """The row of the largest residual."""
        return int(np.abs(self.residuals).max(1).argmax())


class RpcFit(eqx.Module):
    """Fitted coefficients, and for lines and samples: covariance (numerator, then denominator from
    its second coefficient), σ of a line or sample in pixels, redundancy, ridge τ.
    """

    rpc: Rpc
    covariance: Float[np.ndarray, "2 39 39"]
    sigma: Float[np.ndarray, "2"]
    redundancy: Float[np.ndarray, "2"]
    ridge: Float[np.ndarray, "2"]
    check: RpcCheck
    converged: bool


def plain_table(table: RpcTable) -> RpcTable:
    """A table of floats; masked ones are NaN."""
    return RpcTable(
        *(numeric_array(name, c, "numbers").astype(float) for name, c in table._asdict().items())
    )


def fit_rpc(
    table: RpcTable,
    *,
    ridge: float | None = None,
    sigma: float | None = None,
    source: Source = TABLE,
    settings: RpcFitSettings = DEFAULTS,
) -> RpcFit:
    """The coefficients that fit a table best.

    **Arguments:** `ridge` τ in units of the normalised equations, automatic if None; `sigma` of the
    table's lines and samples in pixels, a posteriori if None; `source` names rows in messages.

    **Raises:** `InputError` for fewer than 40 points, invalid numbers, points at one height, or
    of one longitude, latitude, line or sample.
    """
    require_x64()
    table = plain_table(table)
    _check_table(table, source)
    offsets = _offsets(table)
    _check_ranges(offsets, source)
    places = _normalise(table, offsets)
    T = np.stack(np.broadcast_arrays(*monomials(*places[:3])), 1)
    (line, *of_line), (sample, *of_sample) = (
        _fit_axis(T, y, offsets[f"{name}_scale"], ridge, sigma, settings)
        for name, y in zip(("line", "sample"), places[3:])
    )
    full = lambda c: (jnp.asarray(c[:TERMS]), jnp.asarray(np.r_[1.0, c[TERMS:]]))
    rpc = Rpc(*full(line), *full(sample), **{k: jnp.asarray(v) for k, v in offsets.items()})
    covariance, sigmas, redundancy, ridges, settled = map(np.array, zip(of_line, of_sample))
    return RpcFit(
        rpc, covariance, sigmas, redundancy, ridges, check_rpc(rpc, table), bool(settled.all())
    )


def fit_image(
    image: PushbroomImage,
    earth: Ellipsoid,
    heights: tuple[float, float],
    *,
    size: tuple[int, int, int] = (15, 15, 7),
    ridge: float | None = None,
) -> tuple[RpcFit, RpcCheck]:
    """The coefficients of an image between two heights, and a check at other positions and heights.

    **Arguments:** `size` of the grid: lines, pixels, heights; the check has twice as many lines and
    pixels, and heights half way between those of the grid.
    """
    low, high = heights
    lines, pixels, layers = size
    levels = np.linspace(low, high, layers)
    fit = fit_rpc(image_table(image, earth, levels, (lines, pixels)), ridge=ridge)
    middle_levels = (levels[1:] + levels[:-1]) / 2
    check_table = image_table(image, earth, middle_levels, (2 * lines, 2 * pixels))
    return fit, check_rpc(fit.rpc, check_table)


def image_table(
    image: PushbroomImage,
    earth: Ellipsoid,
    heights: Float[np.ndarray, " layers"],
    size: tuple[int, int],
) -> RpcTable:
    """A grid of `size` lines × pixels over the whole image, on the ground at each height.

    **Raises:** `InputError` if a ray misses.
    """
    lines = np.repeat(np.linspace(0, image.lines - 1, size[0]), size[1])
    pixels = np.tile(np.linspace(0, image.pixels - 1, size[1]), size[0])
    layers = []
    for height in heights:
        place = np.asarray(_ground(image, earth, jnp.asarray(float(height)), lines, pixels))
        if (bad := np.isnan(place).any(0)).any():
            row = int(bad.argmax())
            raise InputError(
                f"the ray of line {lines[row]:g}, pixel {pixels[row]:g} misses the height "
                f"{height:g} m; check attitude, mounting and heights"
            )
        layers.append(np.stack([*place, lines, pixels]))
    return RpcTable(*np.concatenate(layers, axis=1))


def check_rpc(rpc: Rpc, table: RpcTable) -> RpcCheck:
    """The residuals of coefficients with respect to a table."""
    line, sample, _ = project_points(rpc, table.longitude, table.latitude, table.height)
    v = np.stack([np.asarray(line) - table.line, np.asarray(sample) - table.sample], 1)
    return RpcCheck(v, np.sqrt(np.mean(v**2, 0)), np.abs(v).max(0), table)


@partial(compile_once, static=())
def _ground(
    image: PushbroomImage,
    earth: Ellipsoid,
    height: Scalar,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
) -> Float[Array, "3 n"]:
    X = locate_points(image, Height(level=height, earth=earth), lines, pixels)
    return jnp.stack(geodetic(earth, tuple(X)))


def _check_table(table: RpcTable, source: Source) -> None:
    n = len(table.line)
    for name, column in zip(table._fields, table):
        if column.shape != (n,):
            raise InputError(f"{source.name}: {name} has the shape {column.shape}; ({n},) expected")
        if (bad := ~np.isfinite(column)).any():
            raise InputError(f"{source(int(bad.argmax()))}: the {name} is not a finite number")
    if n < MIN_POINTS:
        raise InputError(
            f"{source.name}: {n} points for {UNKNOWNS} coefficients of each axis; give at least "
            f"{MIN_POINTS}, over the whole image and several heights"
        )


def _check_ranges(offsets: dict[str, float], source: Source) -> None:
    for name in RpcTable._fields:
        middle, half_range = offsets[f"{name}_offset"], offsets[f"{name}_scale"]
        # Of equal numbers no more than rounding is left, as of longitudes by whole turns.
        if half_range <= 1e-12 * max(abs(middle), 1.0):
            degrees = "°" if name in ("longitude", "latitude") else ""
            raise InputError(
                f"{source.name}: every {name} is {middle + 0.0:g}{degrees}; give points at several "
                f"{name}s"
            )


def _offsets(table: RpcTable) -> dict[str, float]:
    """Middle and half range of each column; longitudes and latitudes in degrees."""
    # The mean direction: an area may cross the date line.
    mean = np.angle(np.mean(np.exp(1j * table.longitude)))
    east = np.degrees(mean + np.angle(np.exp(1j * (table.longitude - mean))))
    columns = {
        "line": table.line,
        "sample": table.sample,
        "longitude": east,
        "latitude": np.degrees(table.latitude),
        "height": table.height,
    }
    offsets = {}
    for name, column in columns.items():
        low, high = float(column.min()), float(column.max())
        offsets |= {f"{name}_offset": (low + high) / 2, f"{name}_scale": (high - low) / 2}
    offsets["longitude_offset"] = (offsets["longitude_offset"] + 180) % 360 - 180
    return offsets


def _normalise(table: RpcTable, offsets: dict[str, float]) -> list[np.ndarray]:
    """The columns longitude, latitude, height, line, sample in units of their scales."""
    east = np.degrees(table.longitude) - offsets["longitude_offset"]
    columns = {
        "longitude": east - 360 * np.round(east / 360),
        "latitude": np.degrees(table.latitude) - offsets["latitude_offset"],
    }
    columns |= {
        name: getattr(table, name) - offsets[f"{name}_offset"]
        for name in ("height", "line", "sample")
    }
    return [column / offsets[f"{name}_scale"] for name, column in columns.items()]


def _fit_axis(
    T: Float[np.ndarray, "n 20"],
    y: Float[np.ndarray, " n"],
    scale: float,
    ridge: float | None,
    sigma: float | None,
    settings: RpcFitSettings,
) -> tuple[np.ndarray, np.ndarray, float, float, float, bool]:
    """c [39], its covariance, σ in pixels, redundancy, τ, settled; y in units of `scale` pixels."""
    D = np.r_[np.full(4, settings.linear_damping), np.ones(UNKNOWNS - 4)]
    U, s, Vt = np.linalg.svd(np.hstack([T, -y[:, None] * T[:, 1:]]) / D, full_matrices=False)
    # Strongly damped: the linear equations weigh points by their denominators and may be far off.
    start_tau = max(s[0] * settings.start_ridge, ridge or 0.0)
    start = _solve_with_ridge(U, s, Vt, D, y, start_tau)
    c, tau, settled = first_result = _iterate(start, T, y, D, scale, ridge, settings)
    while ridge is None and not settled and tau < s[0] * CANDIDATE_RIDGES[0]:
        # Chosen by its linear prediction, it may be too small for the iteration to come to an end.
        tau *= CANDIDATE_RIDGES[0] / CANDIDATE_RIDGES[1]
        c, _, settled = _iterate(start, T, y, D, scale, tau, settings)
    if not settled:
        c, tau, settled = first_result
    v, J = map(np.asarray, _value_and_jacobian(c, T, y))
    U, s, Vt = np.linalg.svd(J / D, full_matrices=False)
    # n − Σh, the effective number of unknowns of a ridge regression
    redundancy = len(y) - float(np.sum(s**2 / (s**2 + tau**2)))
    if sigma is None:
        sigma = scale * float(np.sqrt(np.sum(v**2) / redundancy))
    # (N + τ²D²)⁻¹·Jᵀ = D⁻¹·V·diag(s/(s² + τ²))·Uᵀ, and UᵀU = I
    root_cofactor = Vt.T * (s / (s**2 + tau**2)) / D[:, None]
    return (
        c,
        (sigma / scale) ** 2 * root_cofactor @ root_cofactor.T,
        sigma,
        redundancy,
        tau,
        settled,
    )


def _iterate(
    c: Float[np.ndarray, "39"],
    T: Float[np.ndarray, "n 20"],
    y: Float[np.ndarray, " n"],
    D: Float[np.ndarray, "39"],
    scale: float,
    ridge: float | None,
    settings: RpcFitSettings,
) -> tuple[Float[np.ndarray, "39"], float, bool]:
    """Gauss-Newton steps from c: c, τ, and whether it has settled."""
    settled, tau = False, ridge or 0.0
    for k in range(settings.max_steps):
        v, J = map(np.asarray, _value_and_jacobian(c, T, y))
        U, s, Vt = np.linalg.svd(J / D, full_matrices=False)
        # Solved for the new c, not for the step: the ridge pulls the coefficients towards zero.
        target = J @ c - v
        if ridge is None and k < settings.ridge_steps:
            tau = _choose_ridge(U, s, target, scale, settings)
        step = _solve_with_ridge(U, s, Vt, D, target, tau) - c
        c = c + _shorten(c, step, T, y, tau * D, settings.max_halvings)
        limit = settings.relative_change * np.sqrt(np.mean(v**2)) + settings.absolute_change / scale
        settled = bool(np.abs(J @ step).max() < limit)
        if settled and k >= settings.ridge_steps:
            break
    return c, tau, settled


def _shorten(
    c: Float[np.ndarray, "39"],
    step: Float[np.ndarray, "39"],
    T: Float[np.ndarray, "n 20"],
    y: Float[np.ndarray, " n"],
    ridge: Float[np.ndarray, "39"],
    halvings: int,
) -> Float[np.ndarray, "39"]:
    """The step, halved until the sum of squares falls and no denominator vanishes."""

    def square(c: Float[np.ndarray, "39"]) -> float:
        denominator = 1 + T[:, 1:] @ c[TERMS:]
        v = T @ c[:TERMS] / np.where(denominator > 0, denominator, 1.0) - y
        return np.sum(v**2) + np.sum((ridge * c) ** 2) if (denominator > 0).all() else np.inf

    start_square = square(c)
    for _ in range(halvings):
        # At the minimum the sum changes by rounding only: relative, and absolute of an exact fit.
        new_square = square(c + step)
        if new_square < np.inf and new_square <= start_square * (1 + 1e-12) + 1e-28:
            return step
        step = step / 2
    if start_square == np.inf:
        raise InputError(
            "the denominator vanishes within the table: no rational polynomials fit it; "
            "look for wrong rows, or give a larger ridge"
        )
    return 0 * step


def _solve_with_ridge(
    U: Float[np.ndarray, "n 39"],
    s: Float[np.ndarray, "39"],
    Vt: Float[np.ndarray, "39 39"],
    D: Float[np.ndarray, "39"],
    y: Float[np.ndarray, " n"],
    tau: float,
) -> Float[np.ndarray, "39"]:
    """The least squares solution of U·diag(s)·Vᵀ·D·c = y with the ridge τ."""
    return Vt.T @ (s / (s**2 + tau**2) * (U.T @ y)) / D


def _choose_ridge(
    U: Float[np.ndarray, "n 39"],
    s: Float[np.ndarray, "39"],
    y: Float[np.ndarray, " n"],
    scale: float,
    settings: RpcFitSettings,
) -> float:
    """The largest candidate ridge that predicts as well as the best."""
    part = U.T @ y
    press = []
    for tau in s[0] * CANDIDATE_RIDGES:
        filter_factors = s**2 / (s**2 + tau**2)
        h = (U**2) @ filter_factors
        # vᵢ/(1 − hᵢ) is the residual of a point that took no part
        press.append(np.sqrt(np.mean(((y - U @ (filter_factors * part)) / (1 - h)) ** 2)))
    press = np.array(press)
    limit = settings.relative_press * press.min() + settings.sufficient_residual / scale
    return float(s[0] * CANDIDATE_RIDGES[(press <= limit).argmax()])


@partial(compile_once, static=())
def _value_and_jacobian(
    c: Float[AnyArray, "39"], T: Float[AnyArray, "n 20"], y: Float[AnyArray, " n"]
) -> tuple[Float[Array, " n"], Float[Array, "n 39"]]:
    """v and ∂v/∂c of all points; reverse mode, one row of J for a value each."""

    def misclosure(
        c: Float[Array, "39"], T: Float[Array, "20"], y: Scalar
    ) -> tuple[Scalar, Scalar]:
        v = (c[:TERMS] @ T) / (1 + c[TERMS:] @ T[1:]) - y
        return v, v

    J, v = jax.vmap(jax.jacrev(misclosure, has_aux=True), (None, 0, 0))(c, T, y)
    return v, J
