"""Photographs of flat test objects, rendered: perspective, distortion, blur, noise.

Every pixel is divided into `FINE` × `FINE` places, no two of them in one line with the edges of the
pixel, so that edges along rows and columns are as fine as others. The ray of each place, by the
camera's own model, meets the plane Z = 0, where a pattern says how bright it is. The mean of a
pixel's places, blurred, with noise and rounded to 8 bits, is the photograph.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from jaxbundle.cameras import default_parameters, get_model, image_ray, project
from jaxbundle.geometry import matrix_from_omega_phi_kappa

FINE = 4
BLACK, WHITE, GROUND = 0.1, 0.9, 0.55


@dataclass(frozen=True)
class Lens:
    """A camera in pixels: model, parameters in its order, image size."""

    parameters: tuple[float, ...]
    size: tuple[int, int] = (480, 360)
    model: str = "opencv"

    @classmethod
    def of(cls, size=(480, 360), model="opencv", **given):
        names = get_model(model).parameters
        return cls(
            tuple({**default_parameters(get_model(model)), **given}[n] for n in names), size, model
        )

    def image_of(self, M, X0, X):
        """Image points [n, 2] of object points [n, 3]."""
        return np.asarray(_project(get_model(self.model), self.parameters, M, X0, np.asarray(X)))

    @functools.cached_property
    def rays(self):
        """Rays [rows, columns, 3] of the fine places."""
        w, h = self.size
        i, j = np.meshgrid(np.arange(w * FINE), np.arange(h * FINE))
        u = (i + (j % FINE + 0.5) / FINE) / FINE - 0.5
        v = (j + (i % FINE + 0.5) / FINE) / FINE - 0.5
        return np.asarray(_rays(get_model(self.model), self.parameters, u, v))


@functools.partial(jax.jit, static_argnums=0)
def _rays(model, p, u, v):
    return jnp.stack(image_ray(model, p, u, v), -1)


@functools.partial(jax.jit, static_argnums=0)
def _project(model, p, M, X0, X):
    return jnp.stack(project(model, p, *(M @ (X - X0).T)), -1)


LENS = Lens.of(
    fx=620.0, fy=621.0, cx=242.3, cy=177.8, k1=-0.12, k2=0.05, p1=4e-4, p2=-3e-4
)


def pose(omega=0.0, phi=0.0, kappa=0.0, middle=(0.0, 0.0), distance=1.0):
    """M and X0 of a camera that looks at `middle` of the plane Z = 0 from a distance; degrees."""
    M = np.asarray(matrix_from_omega_phi_kappa(np.radians([omega, phi, kappa])))
    return M, np.array([*middle, 0.0]) + distance * M[2]


def photograph(lens, M, X0, pattern, blur=0.7, noise=2.0, seed=0):
    """The photograph [rows, columns], uint8, of a pattern (X, Y) → brightness 0 … 1."""
    d = lens.rays @ M
    t = -X0[2] / d[..., 2]
    grey = np.where(t > 0, pattern(X0[0] + t * d[..., 0], X0[1] + t * d[..., 1]), GROUND)
    h, w = grey.shape[0] // FINE, grey.shape[1] // FINE
    grey = grey.reshape(h, FINE, w, FINE).mean((1, 3))
    grey = 255 * (ndimage.gaussian_filter(grey, blur) if blur else grey)
    grey = grey + noise * np.random.default_rng(seed).normal(size=grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def chessboard(columns, rows, square):
    """A board with `columns` × `rows` inner corners, the first of them at (0, (rows − 1)·square),
    the square beyond which, to the upper left, is black; a white margin around."""

    def pattern(X, Y):
        i, j = np.floor(X / square) + 1, np.floor(rows - Y / square)
        inside = (i >= 0) & (i <= columns) & (j >= 0) & (j <= rows)
        margin = (i >= -1) & (i <= columns + 1) & (j >= -1) & (j <= rows + 1)
        black = (i + j) % 2 == 0
        return np.where(inside & black, BLACK, np.where(margin, WHITE, GROUND))

    return pattern


def discs(centres, radius, bright=False, margin=None):
    """Discs at `centres` [n, 2] on a sheet that ends `margin` beyond them."""
    centres = np.asarray(centres)
    margin = 4 * radius if margin is None else margin
    low, high = centres.min(0) - margin, centres.max(0) + margin
    disc, sheet = (WHITE, BLACK) if bright else (BLACK, WHITE)

    def pattern(X, Y):
        out = np.where((X > low[0]) & (X < high[0]) & (Y > low[1]) & (Y < high[1]), sheet, GROUND)
        for x, y in centres:
            out[(X - x) ** 2 + (Y - y) ** 2 < radius**2] = disc
        return out

    return pattern


def print_of(picture, width, margin):
    """A picture [rows, columns], uint8, printed `width` wide with its lower left corner at the
    origin, with a white margin."""
    rows, columns = picture.shape
    scale = columns / width

    def pattern(X, Y):
        i, j = np.floor(X * scale).astype(int), rows - 1 - np.floor(Y * scale).astype(int)
        inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        grey = picture[np.clip(j, 0, rows - 1), np.clip(i, 0, columns - 1)] / 255
        sheet = (X > -margin) & (X < width + margin) & (Y > -margin)
        sheet &= Y < rows / scale + margin
        return np.where(inside, BLACK + (WHITE - BLACK) * grey, np.where(sheet, WHITE, GROUND))

    return pattern
