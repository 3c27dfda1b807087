"""Surfaces of known shape, and where rays meet them first.

A `HeightField` is a function Z(X, Y), a `Rectangle` a part of a plane in any direction. With the
height of a ray's point above the field, f(t) = z(t) − Z(x(t), y(t)), and a bound L of its slope,
f cannot vanish within a step of

    f/(|d_z| + L·√(d_x² + d_y²)),

so no summit is stepped over (sphere tracing). Blocks of rays are traced first by their central ray,
with f reduced by the distance of the others. The last steps use the secant method.

Source: Hart (1996), Sphere tracing.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import positive, vector
from jaxbundle.errors import InputError
from jaxbundle.types import present

BLOCKS = (32, 8)
"""Sides of the blocks of rays, rows and columns, before single rays."""
STEPS, SECANTS = 400, 12
NEAR_SURFACE = 1e-3
"""A ray is traced to f below this fraction of the relief, then by secants."""
GRAZING_TOLERANCE = 1e-9
"""Like `NEAR_SURFACE`, if the secants diverge because the ray grazes a summit."""
ON_SURFACE = 1e-9
"""Tolerance of f for a point on the surface, relative to the length of the ray."""
SAMPLES = 256
"""Samples per side for bounds of height and slope if these are not given."""
ALLOWANCE = 1.3
"""Margin of slopes and heights between the samples."""


@dataclasses.dataclass(frozen=True)
class HeightField:
    """The surface Z = `height(X, Y)`, a function of arrays, within `extent` (Xmin, Ymin, Xmax,
    Ymax).

    **Arguments:** `bounds`: lowest and highest Z; `steepest`: largest slope, metres per metre;
    sampled if not given. A step in the heights needs a finite slope, such as 20.
    """

    height: Callable[[np.ndarray, np.ndarray], np.ndarray]
    extent: tuple[float, float, float, float]
    bounds: tuple[float, float] | None = None
    steepest: float | None = None

    def __post_init__(self):
        west, south, east, north = vector("extent", self.extent, 4, "Xmin, Ymin, Xmax, Ymax")
        if not (west < east and south < north):
            raise InputError(f"extent {self.extent} is empty; expected: Xmin, Ymin, Xmax, Ymax")
        if self.bounds is None or self.steepest is None:
            x, y = np.linspace(west, east, SAMPLES), np.linspace(south, north, SAMPLES)
            Z = self.height(*np.meshgrid(x, y))
            slope = np.hypot(*np.gradient(Z, y, x)).max()
            spare = (ALLOWANCE - 1) * np.ptp(Z) + 1e-6 * (east - west)
            if self.bounds is None:
                object.__setattr__(self, "bounds", (Z.min() - spare, Z.max() + spare))
            if self.steepest is None:
                object.__setattr__(self, "steepest", ALLOWANCE * slope + 1e-3)

    def distances(self, o, d) -> Float[np.ndarray, "rows columns"]:
        """Lengths of rays `o + t·d` [rows, columns, 3] to the surface; inf: it is missed."""
        rows, columns = d.shape[:2]
        start = np.zeros((rows, columns))
        for side in BLOCKS:
            if min(rows, columns) >= 2 * side:
                start = np.maximum(start, self._block_starts(o, d, side))
        t = self._follow(o.reshape(-1, 3), d.reshape(-1, 3), start.ravel(), 0.0, 0.0)
        return t.reshape(rows, columns)

    def coordinates(self, X):
        """The two coordinates of the texture, those of the plane."""
        return X[..., 0], X[..., 1]

    def axes(self, X, size):
        """Normals of points, coordinates first, and the directions of the texture's coordinates;
        slopes are taken over `size`."""
        x, y = X[..., 0], X[..., 1]
        here = self.height(x, y)
        slopes = (self.height(x + size, y) - here) / size, (self.height(x, y + size) - here) / size
        return (-slopes[0], -slopes[1], 1.0), np.eye(3)[:2]

    def _block_starts(self, o, d, side):
        """Lengths within which no ray of a block meets the surface, spread over its rays."""
        rows, columns = d.shape[:2]
        r, c = (np.minimum(np.arange(n) // side * side + side // 2, n - 1) for n in (rows, columns))
        away = lambda a: np.linalg.norm(a - a[r[:, None], c[None]], axis=2)
        first = lambda n: np.arange(0, n, side)
        widest = lambda a: np.maximum.reduceat(
            np.maximum.reduceat(a, first(rows), 0), first(columns), 1
        )
        middle = lambda a: a[np.ix_(r[::side], c[::side])].reshape(-1, 3)
        spread = lambda a: np.nan_to_num(widest(away(a)), nan=np.inf).ravel()
        slack = np.hypot(1.0, present(self.steepest))
        t = self._follow(
            middle(o),
            middle(d),
            np.zeros(len(r[::side]) * len(c[::side])),
            slack * spread(o),
            slack * spread(d),
            last=False,
        )
        t = np.where(np.isfinite(t), t, 0.0).reshape(len(r[::side]), len(c[::side]))
        return t[np.arange(rows)[:, None] // side, np.arange(columns)[None] // side]

    def _follow(self, o, d, start, near, spread, last=True):
        """Lengths to where f − near − spread·t is about 0 (`last`: exactly); inf where a ray
        leaves the bounds."""
        low, high = present(self.bounds)
        relief = max(high - low, 1e-9 * (self.extent[2] - self.extent[0]))
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = np.abs(d[:, 2]) + present(self.steepest) * np.hypot(d[:, 0], d[:, 1])
            enter = np.where(o[:, 2] > high, (high - o[:, 2]) / d[:, 2], 0.0)
            leave = np.where(d[:, 2] < 0, (low - o[:, 2]) / d[:, 2], (high - o[:, 2]) / d[:, 2])
        usable = np.isfinite(d).all(1) & (enter >= 0) & np.isfinite(enter)
        t = np.full(len(d), np.inf)
        t[usable] = np.maximum(start, enter - 1e-3 * relief)[usable]
        near, spread = np.broadcast_to(near, len(d)), np.broadcast_to(spread, len(d))
        leave = leave + relief
        ends = (reach + spread, near, spread, leave)
        t = self._march(o, d, t, np.flatnonzero(usable), ends, NEAR_SURFACE * relief)
        if not last:
            return t
        found = self._settle(o, d, t)
        lost = np.flatnonzero(np.isfinite(t) & ~np.isfinite(found))
        if len(lost):  # a ray that grazes a summit goes on
            t = self._march(o, d, t, lost, ends, GRAZING_TOLERANCE * relief)
            with np.errstate(invalid="ignore"):
                on = self._above(o[lost], d[lost], t[lost]) <= GRAZING_TOLERANCE * relief
            found[lost] = self._inside(o[lost], d[lost], np.where(on, t[lost], np.inf))
        return found

    def _march(self, o, d, t, active, ends, close):
        """Lengths at which the rays that are active have come close; inf where they leave."""
        reach, near, spread, leave = ends
        for _ in range(STEPS):
            f = self._above(o[active], d[active], t[active])
            f = f - near[active] - spread[active] * t[active]
            on = f > close
            active, f = active[on], f[on]
            t[active] += f / reach[active]
            gone = t[active] > leave[active]
            t[active[gone]] = np.inf
            active = active[~gone]
            if not len(active):
                break
        return t

    def _settle(self, o, d, t):
        """By secants onto the surface; inf outside the extent."""
        chosen = np.flatnonzero(np.isfinite(t))
        o, d, here = o[chosen], d[chosen], t[chosen]
        f = self._above(o, d, here)
        with np.errstate(invalid="ignore", divide="ignore"):
            step = np.where(f == 0, 0.0, f / (np.abs(d[:, 2]) + 1e-12))
            for _ in range(SECANTS):
                other = here + step
                g = self._above(o, d, other)
                step = np.where(g == f, 0.0, -g * (other - here) / (g - f))
                step = np.where(np.isfinite(step), step, 0.0)
                here, f = other, g
                if (np.abs(f) <= ON_SURFACE * here).all():
                    break
        good = (np.abs(f) <= 1e3 * ON_SURFACE * here) & (here > 0)
        t = np.full(len(t), np.inf)
        t[chosen] = self._inside(o, d, np.where(good, here, np.inf))
        return t

    def _inside(self, o, d, t):
        with np.errstate(invalid="ignore"):
            X, Y = (o[:, k] + t * d[:, k] for k in (0, 1))
            west, south, east, north = self.extent
            return np.where((X >= west) & (X <= east) & (Y >= south) & (Y <= north), t, np.inf)

    def _above(self, o, d, t):
        return o[:, 2] + t * d[:, 2] - self.height(o[:, 0] + t * d[:, 0], o[:, 1] + t * d[:, 1])


@dataclasses.dataclass(frozen=True)
class Rectangle:
    """A part of a plane: a corner [3] and the two edges [3] from it, at right angles."""

    corner: tuple[float, float, float]
    along: tuple[float, float, float]
    across: tuple[float, float, float]

    def __post_init__(self):
        a, b = (
            vector(name, getattr(self, name), 3, "coordinates X, Y, Z")
            for name in ("along", "across")
        )
        vector("corner", self.corner, 3, "coordinates X, Y, Z")
        positive("length of along", float(np.linalg.norm(a)))
        positive("length of across", float(np.linalg.norm(b)))
        if abs(a @ b) > 1e-9 * np.linalg.norm(a) * np.linalg.norm(b):
            raise InputError("a rectangle's edges must be at right angles")

    def distances(self, o, d):
        """Lengths of rays `o + t·d` [rows, columns, 3] to the rectangle; inf: it is missed."""
        normal, axes = self.axes(o, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            t = ((np.asarray(self.corner) - o) @ normal) / (d @ normal)
            s = self._from_corner(o + t[..., None] * d, axes)
            length = [np.linalg.norm(self.along), np.linalg.norm(self.across)]
            inside = ((s >= 0) & (s <= length)).all(-1) & (t > 0)
        return np.where(inside, t, np.inf)

    def coordinates(self, X):
        """The two coordinates of the texture, from the corner along the edges."""
        s = self._from_corner(X, self.axes(X, 0.0)[1])
        return s[..., 0], s[..., 1]

    def axes(self, X, size):
        """The normal, and the unit vectors of the texture's coordinates."""
        unit = lambda v: np.asarray(v, float) / np.linalg.norm(v)
        a, b = unit(self.along), unit(self.across)
        return np.cross(a, b), np.stack([a, b])

    def _from_corner(self, X, axes):
        return (X - np.asarray(self.corner)) @ axes.T


Shape = HeightField | Rectangle
