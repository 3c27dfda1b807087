"""Procedural texture: fractal noise with edges, and grey values of it at any width.

A periodic tile holds fractal noise, whose amplitude falls with the wavelength λ as 1/f, and flat
patches with sharp edges at several scales. A pyramid of means over 2 × 2 texels has the tile at
twice, four times … the texel; between its levels it is interpolated linearly. So a sample is the
mean grey value of a patch of about the requested `width`, without shift, since a mean is
symmetrical about its centre.

Two rotated copies of the tile at scales with an irrational ratio, and a much larger one, prevent
repetition; with a `period` the texture repeats, like brickwork.

Source: Williams (1983), Pyramidal parametrics.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.arguments import integer, number, positive
from jaxbundle.errors import InputError

Mask = Callable[[np.ndarray, np.ndarray], Bool[np.ndarray, "..."]]


@dataclasses.dataclass(frozen=True)
class Texture:
    """Grey values, 0 to 1, on a surface.

    **Arguments:**

    - `texel`: size of the finest detail in the object unit; half the ground sampling distance of
      the photographs shows detail at all their scales.
    - `seed`: of the noise. `side`: texels of the tile, a power of two.
    - `mean`, `contrast`: mean and standard deviation of the grey values.
    - `period`: the texture repeats after this length in both directions; None: never.
    - `blank`: a function of the two surface coordinates, true without texture.
    """

    texel: float
    seed: int = 0
    side: int = 1024
    mean: float = 0.5
    contrast: float = 0.18
    period: float | None = None
    blank: Mask | None = None

    def __post_init__(self) -> None:
        positive("texture: texel", self.texel)
        side = integer("texture: side", self.side, least=16, most=1 << 14)
        if side & (side - 1):
            raise InputError(f"texture: side must be a power of two, but is {side}")
        number("texture: contrast", self.contrast)
        if self.period is not None:
            positive("texture: period", self.period)

    def __call__(
        self, s: Float[np.ndarray, " n"], t: Float[np.ndarray, " n"], width: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Grey values of patches of the given widths at surface coordinates, object unit."""
        grey_values = np.empty(len(s))
        # Batches of 2¹² to 2¹⁷ samples, whose arrays stay in the cache, take the same time; a
        # million at once takes twice as long.
        batch = 1 << 15
        for begin in range(0, len(s), batch):
            part = slice(begin, begin + batch)
            grey_values[part] = self._grey(s[part], t[part], width[part])
        return grey_values

    def _grey(
        self, s: Float[np.ndarray, " n"], t: Float[np.ndarray, " n"], width: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        if self.period is None:
            total = np.zeros(len(s))
            # Rotation (radians), scale and share of the copies of the tile. Scales with irrational
            # ratios, near the golden section and a fourteenth, never repeat together; the squares
            # of the shares have the sum 1, that of the variances of independent copies.
            copies = (1.0, 1.0, 0.62), (0.7236, 0.6180, 0.62), (2.1, 0.0731, 0.48)
            for angle, scale, share in copies:
                texel = self.texel / scale
                x = (np.cos(angle) * s - np.sin(angle) * t) / texel
                y = (np.sin(angle) * s + np.cos(angle) * t) / texel
                total += share * _interpolate(self.pyramid, x, y, width / texel)
        else:
            texel = self.period / self.side
            total = _interpolate(self.pyramid, s / texel, t / texel, width / texel)
        grey = np.clip(self.mean + self.contrast * total, 0.0, 1.0)
        if self.blank is not None:
            grey = np.where(self.blank(s, t), self.mean, grey)
        return grey

    @cached_property
    def pyramid(self) -> tuple[Float[np.ndarray, "side side"], ...]:
        """The tile, of mean 0 and standard deviation 1, and its means over 2 × 2, 4 × 4, …"""
        levels = [make_tile(self.side, self.seed)]
        while len(levels[-1]) > 2:
            a = levels[-1]
            levels.append((a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]) / 4)
        return tuple(levels)


def make_tile(side: int, seed: int) -> Float[np.ndarray, "side side"]:
    """A periodic tile of fractal noise and flat patches with edges, mean 0, deviation 1."""
    rng = np.random.default_rng(seed)
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    f[0, 0] = np.inf  # 1/f = 0: no constant part

    def noise(spectrum: Float[np.ndarray, "side half"]) -> Float[np.ndarray, "side side"]:
        """Periodic noise of this amplitude spectrum, standard deviation 1."""
        white = np.fft.rfft2(rng.standard_normal((side, side)))
        a = np.fft.irfft2(white * spectrum, s=(side, side))
        return a / a.std()

    tile = noise(1 / f)
    # Patches are the signs of noise that ends at 6, 24, 96 and 384 cycles a tile: photographs at
    # all distances then see sharp edges. At 0.6 of the noise's deviation both remain visible.
    for octave in range(4):
        low = 1.5 / side * 4**octave
        patches = noise(np.exp(-((f / (4 * low)) ** 2)) * (f < np.inf))
        tile += 0.6 * np.sign(patches)
    tile -= tile.mean()
    return (tile / tile.std()).astype(np.float32)


def _interpolate(
    pyramid: Sequence[Float[np.ndarray, "side side"]],
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
    width: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Linear between the two levels next to the width, bilinear in both."""
    # Texels of level k are means of 2ᵏ × 2ᵏ: the level of a width is its logarithm. Centres of
    # texels are at k + 1/2, hence the half below.
    level = np.clip(np.log2(np.maximum(width, 1e-30)), 0, len(pyramid) - 1)
    low = np.floor(level).astype(int)
    total = np.zeros(len(x))
    for k in range(low.min(), min(low.max() + 1, len(pyramid) - 1) + 1):
        share = 1 - np.abs(level - k)
        indices = np.flatnonzero(share > 0)
        whole_chunk = len(indices) == len(x)
        selection = slice(None) if whole_chunk else indices
        size = 0.5**k
        total[selection] += share[selection] * _bilinear(
            pyramid[k], x[selection] * size - 0.5, y[selection] * size - 0.5
        )
    return total


def _bilinear(
    tile: Float[np.ndarray, "side side"], x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Values of a periodic tile; its texel (0, 0) has its centre at (0, 0)."""
    # `& (side − 1)` is the remainder of a power of two, also of negative numbers; numpy gathers by
    # one flat index faster than by two.
    side = len(tile)
    column, row = np.floor(x), np.floor(y)
    fx, fy = (x - column).astype(np.float32), (y - row).astype(np.float32)
    column, row = column.astype(np.int64) & (side - 1), row.astype(np.int64) & (side - 1)
    next_column, next_row = (column + 1) & (side - 1), ((row + 1) & (side - 1)) * side
    row, flat = row * side, tile.ravel()
    upper = flat[row + column]
    upper += (flat[row + next_column] - upper) * fx
    lower = flat[next_row + column]
    lower += (flat[next_row + next_column] - lower) * fx
    return upper + (lower - upper) * fy
