"""The centre of a target, a light or dark spot, in a photograph.

1. The spot, its window and threshold: `spots`.
2. Centre by weighted grey values: with g the grey value, b that of the background, f that of the
   target, over the spot and its blurred edge,

       w = (g − b)/(f − b)        x̄ = Σw·x/Σw        σ² = σg²/(f − b)²·Σ(x − x̄)²/(Σw)²

3. Centre by an ellipse: a blurred disc fitted to the grey values about its rim,

       g = G + m·(p − x) + C·Φ(d/τ)        d = ρ·(1 − ρ)/|M·(p − x)|,  ρ² = (p − x)ᵀ·M·(p − x)

   with d the distance of the pixel p inside the ellipse ρ = 1 (Sampson, 1982), G and m the ground
   and its change, C the contrast, τ the blur of lens and pixel. Nothing is interpolated; the
   covariance follows from the residuals. (Blur σ makes a disc of radius r smaller by about σ²/2r,
   and an encoding of the grey values shifts its rim; its centre is unchanged by both.)

Both centres are those of the ellipse, not of the circle: `circle_centre_shift`.
"""

import dataclasses

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Bool, Float, Int, Real

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.measure.spots import MARGIN, Spot, find_spot

# x, y, the three elements of M, G, C, ln τ, and the two of m.
UNKNOWNS = 10
Theta = Float[np.ndarray, " 10"]
Pixels = Float[np.ndarray, " pixels"]


@dataclasses.dataclass(frozen=True)
class DiscSettings:
    """How a blurred disc is fitted to the rim of a target.

    Half and double were tried on rendered discs (`tests/measure/test_corner_accuracy.py`), 48 with
    an RMS error of 0.0075 pixel: no difference, but for half of `reach`, 0.0079, and of
    `max_sector_shift`, 0.0077.

    **Fields:**

    - `reach`: pixels are used to this distance from the rim, in τ, and one more, but not beyond
      `MARGIN` pixels outside, nor 0.8 of the shorter semi-axis inside. Φ(−3.5) = 0.02 %: the
      blurred step is complete.
    - `sectors`, even: of the rim, compared with each other and left out singly.
    - `max_sector_shift`: of a sector in standard deviations, beyond which it is left out: Φ(−3.5)
      is once in 130 targets of 16 sectors.
    - `min_seen`: part of the rim that must be used. Half of an ellipse hardly determines its centre
      across the gap.
    - `max_steps`, `last_step`: end of the iterations: evaluations, and the change of the centre in
      pixels; the next is then far smaller (Gauss-Newton), and σ of a good target 0.005.
    """

    reach: float = 3.5
    sectors: int = 16
    max_sector_shift: float = 3.5
    min_seen: float = 0.6
    max_steps: int = 15
    last_step: float = 1e-3


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Target:
    """The measured centre of a target.

    **Fields:** `xy` and its `covariance`, pixels, with `sigma` their standard deviations; `bright`:
    lighter than its surroundings; `threshold`, `contrast`, `noise`: grey values; `axes`, `angle`:
    semi-axes (the longer first) in pixels and the direction of the longer one in radians, x right,
    y down.
    """

    xy: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    axes: Float[np.ndarray, "2"]
    angle: float
    bright: bool
    threshold: float
    contrast: float
    noise: float

    @property
    def sigma(self) -> Float[np.ndarray, "2"]:
        """Standard deviations of the coordinates, pixels."""
        return np.sqrt(np.diagonal(self.covariance))


def centre_by_grey_values(
    grey: Real[np.ndarray, "rows columns"], near: Real[np.ndarray, "2"]
) -> Target:
    """The centre of the target nearest to `near` (column, row) as the centre of its grey values.

    **Arguments:** `grey` [rows, columns]; `near`: within a few pixels of the target.

    **Raises:** `InputError` if no target stands out, or it is cut by the edge of the image.
    """
    spot = find_spot(np.asarray(grey, float), np.asarray(near, float))
    xy, second_moments, total = _moments(spot)
    from_centre = _places(spot) - xy[:, None, None]
    region = _region(spot)
    from_centre = (from_centre * region).reshape(2, -1)
    covariance = (spot.noise / (spot.contrast * total)) ** 2 * from_centre @ from_centre.T
    return _target(spot, xy, covariance, *_axes_of(second_moments))


def centre_by_ellipse(
    grey: Real[np.ndarray, "rows columns"],
    near: Real[np.ndarray, "2"],
    settings: DiscSettings | None = None,
) -> Target:
    """The centre of the target nearest to `near` (column, row) by an ellipse through its
    edge; arguments and errors as in `centre_by_grey_values`."""
    settings = settings or DiscSettings()
    spot = find_spot(np.asarray(grey, float), np.asarray(near, float))
    xy, second_moments, _ = _moments(spot)
    centre, covariance, axes, angle, share_seen = _fit_disc(
        spot, xy, *_axes_of(second_moments), settings
    )
    where = "at ({:.1f}, {:.1f})".format(*(xy + spot.corner))
    if share_seen < settings.min_seen:
        raise InputError(f"{where}: the edge of the target is not fully visible")
    # The centre of grey values is that of the ellipse, but for a neighbour in the window.
    if not np.isfinite(covariance).all() or np.linalg.norm(centre - xy) > 0.3 * axes[0] + 1:
        raise InputError(f"{where}: the edge of the target is not an ellipse")
    return _target(spot, centre, covariance, axes, angle)


def _target(
    spot: Spot,
    xy: Float[np.ndarray, "2"],
    covariance: Float[np.ndarray, "2 2"],
    axes: Float[np.ndarray, "2"],
    angle: float,
) -> Target:
    return Target(
        xy=xy + spot.corner,
        covariance=covariance,
        axes=np.asarray(axes),
        angle=float(angle),
        bright=spot.contrast > 0,
        threshold=spot.threshold,
        contrast=abs(spot.contrast),
        noise=spot.noise,
    )


def _region(spot: Spot) -> Bool[np.ndarray, "rows columns"]:
    return scipy.ndimage.binary_dilation(spot.inside, np.ones((3, 3)), iterations=MARGIN)


def _places(spot: Spot) -> Float[np.ndarray, "2 rows columns"]:
    rows, columns = np.indices(spot.grey.shape)
    return np.stack([columns, rows]).astype(float)


def _moments(
    spot: Spot,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float]:
    """Centre, second central moments and sum of the relative grey values."""
    w = np.where(_region(spot), (spot.grey - spot.background) / spot.contrast, 0.0)
    places, total = _places(spot), w.sum()
    xy = (w * places).sum((1, 2)) / total
    from_centre = np.where(spot.inside, places - xy[:, None, None], 0.0).reshape(2, -1)
    return xy, from_centre @ from_centre.T / spot.inside.sum(), total


def _axes_of(second_moments: Float[np.ndarray, "2 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Semi-axes and angle of the ellipse with these second moments: an axis a has a²/4, and the
    area of a pixel adds its own, 1/12."""
    values, vectors = np.linalg.eigh(second_moments + np.eye(2) / 12)
    x, y = vectors[:, 1]
    return 2 * np.sqrt(values[::-1]), np.arctan2(y, x)


def _fit_disc(
    spot: Spot,
    xy: Float[np.ndarray, "2"],
    axes: Float[np.ndarray, "2"],
    angle: float,
    settings: DiscSettings,
) -> tuple[Theta, Float[np.ndarray, "2 2"], Float[np.ndarray, "2"], float, float]:
    """Centre, its covariance, semi-axes, angle, and the part of the rim that was used."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    M = turn @ np.diag(np.asarray(axes) ** -2.0) @ turn.T
    theta = np.array([*xy, M[0, 0], M[0, 1], M[1, 1], spot.background, spot.contrast, 0.0, 0, 0])
    # Changes of the unknowns that move the rim by a pixel, or the grey values by as much as the
    # noise: N is then well scaled.
    contrast = abs(spot.contrast)
    curved = 2 / axes[1] ** 3
    scale = np.array([1, 1, curved, curved, curved, contrast, contrast, 1, spot.noise, spot.noise])
    places, grey = _places(spot).reshape(2, -1), spot.grey.ravel()
    theta, A, r, weight, sector = _iterate(theta, scale, places, grey, 1.0, settings)
    consistent = _consistent_sectors(A, r, weight, sector, settings)
    if not consistent.all():
        theta, A, r, weight, sector = _iterate(theta, scale, places, grey, consistent, settings)
    # Grey values are rounded: variance 1/12.
    noise = max(np.sqrt(r @ r / max(weight.sum() - UNKNOWNS, 1)), 12**-0.5)
    inverse = np.linalg.inv(_normal_matrix(A))
    excess = _excess(A, r, inverse, sector, noise, settings.sectors)
    covariance = (noise * excess) ** 2 * inverse[:2, :2]
    share_seen = np.unique(sector[weight > 0]).size / settings.sectors
    values, vectors = np.linalg.eigh([[theta[2], theta[3]], [theta[3], theta[4]]])
    angle = np.arctan2(vectors[1, 0], vectors[0, 0])
    angle = np.remainder(angle + np.pi / 2, np.pi) - np.pi / 2
    return theta[:2], covariance, values**-0.5, angle, share_seen


def _iterate(
    theta: Theta,
    scale: Theta,
    places: Float[np.ndarray, "2 pixels"],
    grey: Pixels,
    consistent: float | Pixels,
    settings: DiscSettings,
) -> tuple[Theta, Float[np.ndarray, "10 pixels"], Pixels, Pixels, Int[np.ndarray, " pixels"]]:
    """The disc that fits the consistent pixels: its parameters, scaled derivatives, residuals,
    pixels used, and the sectors of all.

    Gauss-Newton, since the start by moments is within a pixel; steps are shortened to a pixel, to
    a factor of 1.5 of the blur, and until the conic is an ellipse."""
    step = 0
    while True:
        g, J, d, sector, minor = _blurred_disc(theta, places, settings.sectors)
        reach = settings.reach * np.exp(theta[7]) + 1
        weight = consistent * ((d < min(reach, 0.8 * minor)) & (d > -min(reach, MARGIN)))
        if not weight.any():
            raise InputError("no pixel is at the edge of the target")
        r = weight * (grey - g)
        A = J * (weight * scale[:, None])
        change = scale * np.linalg.solve(_normal_matrix(A), A @ r)
        change[:2] = np.clip(change[:2], -1, 1)
        change[7] = np.clip(change[7], -0.4, 0.4)
        while not _is_ellipse(*(theta + change)[2:5]) and np.abs(change).max() > 1e-12:
            change = change / 2
        theta = theta + change
        # A pixel's area alone has τ = 1/√12 = 0.29; a blur of half the disc leaves no rim.
        theta[7] = np.clip(theta[7], np.log(0.35), np.log(0.5 * minor + 1))
        step += 1
        is_still = np.abs(change[:2]).max() < settings.last_step
        if step == settings.max_steps or step > 3 and is_still:
            return theta, A, r, weight, sector


def _normal_matrix(A: Float[np.ndarray, "10 pixels"]) -> Float[np.ndarray, "10 10"]:
    """A·Aᵀ, and a millionth of its trace on the diagonal: few pixels may leave a level open."""
    N = A @ A.T
    return N + 1e-6 * np.trace(N) * np.eye(UNKNOWNS)


def _is_ellipse(A: float, B: float, C: float) -> bool:
    # A·C = B² is a pair of lines; 1 % away from it 1/|M·(p − x)| is still harmless
    return A > 0 and C > 0 and A * C > 1.01 * B * B


def _blurred_disc(
    theta: Theta, places: Float[np.ndarray, "2 pixels"], sectors: int
) -> tuple[Pixels, Float[np.ndarray, "10 pixels"], Pixels, Int[np.ndarray, " pixels"], float]:
    """Grey values of the pixels, their derivatives [unknowns, pixels], distances from the rim,
    sector, and the shorter semi-axis."""
    x, y, A, B, C, ground, contrast, lntau, mx, my = theta
    tau = np.exp(lntau)
    u, v = places[0] - x, places[1] - y
    gu, gv = A * u + B * v, B * u + C * v
    rho = np.sqrt(np.maximum(u * gu + v * gv, 1e-6))
    slope = np.maximum(np.hypot(gu, gv), 1e-9)
    d = rho * (1 - rho) / slope
    z = d / tau
    step, density = scipy.special.ndtr(z), np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    f = contrast * density / tau
    J = np.stack(
        [
            f * gu / slope,
            f * gv / slope,
            -f * u * u / (2 * slope),
            -f * u * v / slope,
            -f * v * v / (2 * slope),
            np.ones_like(u),
            step,
            -contrast * z * density,
            u,
            v,
        ]
    )
    sector = ((np.arctan2(v, u) / np.pi + 1) / 2 * sectors).astype(int) % sectors
    half_trace, half_difference = (A + C) / 2, np.hypot((A - C) / 2, B)
    return (
        ground + contrast * step + mx * u + my * v,
        J,
        d,
        sector,
        (half_trace + half_difference) ** -0.5,
    )


def _consistent_sectors(
    J: Float[np.ndarray, "10 pixels"],
    r: Pixels,
    weight: Pixels,
    sector: Int[np.ndarray, " pixels"],
    settings: DiscSettings,
) -> Pixels:
    """1 for pixels of sectors whose rim agrees with the ellipse, within the noise or the scatter of
    all."""
    normal = np.hypot(J[0], J[1]) * weight
    information = np.bincount(sector, normal**2, settings.sectors)
    shift = np.bincount(sector, normal * r * np.sign(J[6]), settings.sectors)
    z = shift / np.sqrt(np.maximum(information, 1e-12))
    noise = np.sqrt(max(r @ r / max(weight.sum() - UNKNOWNS, 1), 1 / 12))
    scatter = max(NORMAL_SIGMA_BY_MAD * np.median(np.abs(z)), noise)
    return (np.abs(z) < settings.max_sector_shift * scatter)[sector].astype(float)


def _excess(
    A: Float[np.ndarray, "10 pixels"],
    r: Pixels,
    inverse: Float[np.ndarray, "10 10"],
    sector: Int[np.ndarray, " pixels"],
    noise: float,
    sectors: int,
) -> float:
    """By how much the centres from opposite pairs of sectors scatter more than the noise says (1:
    not); what is alike on opposite sides does not move the centre."""
    score = np.stack([np.bincount(sector, a * r, sectors) for a in A])
    pairs = inverse[:2] @ (score[:, : sectors // 2] + score[:, sectors // 2 :])
    ratio = np.einsum("is,ij,js->", pairs, np.linalg.inv(inverse[:2, :2]), pairs)
    ratio /= (sectors - 2) * noise**2
    # χ²/f has the σ √(2/f), and the pairs have f = sectors coordinates: only beyond 3 of it
    sigma_of_ratio = np.sqrt(2 / sectors)
    return np.sqrt(ratio) if ratio > 1 + 3 * sigma_of_ratio else 1.0
