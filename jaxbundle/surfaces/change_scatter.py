"""The scatter and the correlation of the errors that cells have of their own: s, q and ρ of
`change`."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.signal import fftconvolve

from jaxbundle.leastsquares.quality.distributions import normal_quantile
from jaxbundle.surfaces.change_settings import DEFAULTS, ChangeSettings
from jaxbundle.surfaces.change_tiles import (
    Cells,
    EstimatedSharedErrors,
    SharedErrorEquations,
    SurfaceTile,
)
from jaxbundle.surfaces.height_cells import Grid
from jaxbundle.surfaces.scatter import robust_sigma


def scatter_of(
    usable: list[tuple[int, int]],
    read_tile: Callable[[tuple[int, int]], SurfaceTile],
    t: Float[np.ndarray, " k"],
    settings: ChangeSettings,
) -> tuple[Float[np.ndarray, "2*reach+1 2*reach+1"], float]:
    """ρ of cells by their distance, and the scatter of cells over their σ, from some tiles: without
    what shared errors explain, which is no correlation of cells."""
    chosen_tiles = sample_of(usable, settings)
    fields, unchanged_cells = _unchanged_cells(chosen_tiles, read_tile, t)
    # Changed cells would bend t, and what is left of shared errors would pass for scatter.
    for _ in range(settings.reweightings):
        unchanged = SharedErrorEquations(np.zeros((len(t), len(t))), np.zeros(len(t)))
        for corner, cells in zip(chosen_tiles, unchanged_cells):
            tile = read_tile(corner)
            unchanged.add(tile, tile.from_core(cells))
        fields, unchanged_cells = _unchanged_cells(chosen_tiles, read_tile, unchanged.solve(1.0)[0])
    rho = correlation_of(
        [np.where(q, f, 0.0) for f, q in zip(fields, unchanged_cells)], unchanged_cells, settings
    )
    return rho, float(robust_sigma(np.concatenate([f[q] for f, q in zip(fields, unchanged_cells)])))


def sample_of(corners: list[tuple[int, int]], settings: ChangeSettings) -> list[tuple[int, int]]:
    """Some tiles, evenly spread."""
    number = min(len(corners), settings.sampled_tiles)
    return [corners[k] for k in np.unique(np.linspace(0, len(corners) - 1, number).astype(int))]


def scatter_of_stable(
    corners: list[tuple[int, int]],
    read_tile: Callable[[tuple[int, int]], SurfaceTile],
    stable: Cells,
    reduction: "EstimatedSharedErrors",
    cells_as_one: float,
    level: float,
) -> tuple[float, float] | None:
    """s and q from the residuals of stable cells; None for too few."""
    residuals, shares = [], []
    for corner in corners:
        tile = read_tile(corner)
        d, sigma, LP = reduction(tile)
        cells = tile.in_core(tile.known & stable[tile.rows, tile.columns])
        residuals.append(np.abs(d[cells] / sigma[cells]))
        shares.append(np.sum(LP[:, cells] ** 2, axis=0) / sigma[cells] ** 2)
    v, h = np.concatenate(residuals), float(np.mean(np.concatenate(shares)))
    if len(v) * (1 - h) / cells_as_one <= 1 / level:
        return None
    s = np.sqrt(np.mean(v**2) / (1 - h))
    q = np.quantile(v, 1 - level) / (normal_quantile(1 - level / 2) * np.sqrt(1 - h))
    return float(reduction.scale * s), float(reduction.scale * q)


def _unchanged_cells(
    corners: list[tuple[int, int]],
    read_tile: Callable[[tuple[int, int]], SurfaceTile],
    t: Float[np.ndarray, " k"],
) -> tuple[list[Grid], list[Cells]]:
    """Of every tile the differences over their σ, without what shared errors explain, and which
    cells are not beyond three times their scatter."""
    fields = []
    for corner in corners:
        tile = read_tile(corner)
        remainder = ((tile.d - np.tensordot(t, tile.L, 1)) / tile.own)[tile.core]
        fields.append(remainder if len(corners) == 1 else remainder.astype(np.float32))
    of_cells = np.concatenate([f[np.isfinite(f)] for f in fields])
    limit = 3 * robust_sigma(of_cells)
    # Unchanged cells are about 0; if most cells have changed together none may be, and those about
    # their median show the same scatter. At least half of them are within one σ there: never none,
    # of which the scatter, and with it every σ, would be NaN.
    middle = float(np.median(of_cells))
    if abs(middle) > limit:
        fields = [f - middle for f in fields]
    with np.errstate(invalid="ignore"):
        return fields, [np.abs(f) <= limit for f in fields]


def correlation_of(
    w: Grid | list[Grid],
    is_known: Cells | list[Cells],
    settings: ChangeSettings = DEFAULTS,
) -> Float[np.ndarray, "2*reach+1 2*reach+1"]:
    """ρ of errors by the distance of cells, 1 in the middle, from normalised residuals of a grid,
    or of several parts.

    Products are averaged over all pairs of known cells at a distance, up to a quarter of the sides:
    beyond it there are too few (Box and Jenkins, 1976). Errors of matching are correlated in
    stripes, too, where a slope passes through the pixels, and negatively half a stripe apart: no
    distance or sign is left out, since sums of many cells depend on all.
    """
    parts = list(zip(w, is_known)) if isinstance(w, list) else [(w, is_known)]
    shape = np.max([np.shape(a) for a, _ in parts], axis=0)
    reach = min(settings.reach, *((n - 1) // 4 for n in shape))
    total, number = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
    for a, is_known_in_part in parts:
        total += _pairs(np.where(is_known_in_part, a, 0.0), reach)
        # Counts: what FFT leaves of a 0 would be a divisor.
        number += np.round(_pairs(np.asarray(is_known_in_part, float), reach))
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(number > 0, total / number, 0.0)
    # Over its value in the middle, so that σ given too large or small do not count.
    middle = rho[reach, reach]
    rho = rho / middle if middle > 0 else np.zeros_like(rho)
    k = np.arange(-reach, reach + 1)
    rho[np.hypot(k[:, None], k) > reach] = 0.0
    rho[reach, reach] = 1.0
    return rho


def _pairs(a: Grid, reach: int) -> Float[np.ndarray, "m m"]:
    """Sums of the products of all pairs of cells by their distance."""
    # A tile at the edge may be smaller than the reach, which is that of the largest.
    a = np.pad(a, [(0, max(reach + 1 - n, 0)) for n in a.shape])
    around = tuple(slice(n - 1 - reach, n + reach) for n in a.shape)
    return fftconvolve(a, a[::-1, ::-1], "full")[around]
