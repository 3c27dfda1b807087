"""Start values of one camera from many views of known points: focal lengths and poses.

A flat object gives a homography a view, [x y 1]ᵀ ~ H·[X Y 1]ᵀ, a solid one a projection matrix,
[x y 1]ᵀ ~ P·[X Y Z 1]ᵀ, both by the normalised direct linear transformation (Hartley 1997). Where
the camera is not known, its focal lengths follow from the first two columns h₁, h₂ of all H, which
are images of perpendicular directions of equal length (Zhang 2000): with ω = diag(1/fx², 1/fy², 1)

    h₁ᵀ·ω·h₂ = 0,        h₁ᵀ·ω·h₁ = h₂ᵀ·ω·h₂

or from the rows of the P; the principal point stands still and distortion is neglected. A known
camera first turns the image points into directions.

Here x' and y' are those of the computer vision frame, x right, y down, looking along +z; the
poses returned are ours, [r, s, q] = M·X + t with q < 0 in front.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxbundle import cameras
from jaxbundle.batches.normal import ByPoint, CameraUnknowns, Sightings, gram
from jaxbundle.batches.small_cholesky import backward, cholesky, forward, rows_of
from jaxbundle.cameras import CameraModel
from jaxbundle.geometry import quaternion_from_matrix
from jaxbundle.geometry.vectors import cross

ByView = Float[Array, " views"]
# The three elements of a column of H or P, of all views.
Column = Sequence[ByView]
# From the computer vision frame to ours.
FLIP = (1.0, -1.0, -1.0)


@dataclasses.dataclass(frozen=True)
class StartSettings:
    """Which views give start values, and what is taken where they give none.

    **Fields:**

    - `min_points_flat`, `min_points_solid`: of a view, as many as determine H or P.
    - `min_pivot`: views with a smaller scaled pivot, with points on a line (in a plane), are
      excluded; far above rounding.
    - `min_width`: an extent across below this fraction of that along is rounding: the points
      lie on the line.
    - `ordinary_focal`: focal length, in lengths of the image, where the views determine none: a
      field of view of 45°.
    - `min_focal`, `max_focal`: in lengths of the image, fields of view of 169° and 1.1°; others are
      no solution of the equations.
    - `steepest`: −cos of the angle to the axis, 75°, beyond which the plane coordinates of a
      fisheye's points are so long that they alone would decide the pose.
    """

    min_points_flat: int = 4
    min_points_solid: int = 6
    min_pivot: float = 1e-10
    min_width: float = 1e-7
    ordinary_focal: float = 1.2
    min_focal: float = 0.05
    max_focal: float = 50.0
    steepest: float = -0.25


def start_values(
    model: CameraModel,
    flat: bool,
    is_known: bool,
    sightings: Sightings,
    interior: Float[Array, " parameters"],
    size: float,
    settings: StartSettings | None = None,
) -> tuple[Sightings, CameraUnknowns]:
    """`sightings` without the views that cannot be used, and start values.

    **Arguments:** `flat`: the object is a plane Z = 0; `is_known`: `interior` [parameters] is a
    camera to begin with, otherwise its focal lengths are sought; `size`: a length of the image.
    """
    settings = settings or StartSettings()
    x, y, front = _ideal(model, is_known, sightings, interior, settings.steepest)
    fitted = Sightings(sightings.point, sightings.xy, sightings.weight * front)
    columns, usable = _fit(fitted, x, y, 2 if flat else 3, settings)
    weight = sightings.weight * usable[:, None]
    sightings = Sightings(sightings.point, sightings.xy, weight)
    if is_known:
        fx = fy = 1.0
    else:
        fx, fy = (_focal_of_flat if flat else _focal_of_solid)(columns, usable)
        good = lambda f: (f > settings.min_focal * size) & (f < settings.max_focal * size)
        fx = jnp.where(good(fx), fx, jnp.where(good(fy), fy, settings.ordinary_focal * size))
        fy = jnp.where(good(fy), fy, fx)
        names = model.principal_distance
        focal_lengths = (fx, fy) if len(names) == 2 else (0.5 * (fx + fy),)
        for name, f in zip(names, focal_lengths):
            interior = interior.at[model.parameters.index(name)].set(f)
    # K⁻¹·H or K⁻¹·P; excluded views get the pose R = 1 at a distance, whose image exists
    a = [(c[0] / fx, c[1] / fy, c[2]) for c in columns]
    axes, shift = (_pose_of_flat if flat else _pose_of_solid)(a)
    # Rows of M, a view each.
    M = [
        [jnp.where(usable, s * axes[j][i], s * (i == j)) for j in range(3)]
        for i, s in enumerate(FLIP)
    ]
    far_translation = (0.0, 0.0, -1.0)
    t = jnp.stack([jnp.where(usable, s * c, f) for s, c, f in zip(FLIP, shift, far_translation)], 1)
    matrices = jnp.stack([jnp.stack(row, -1) for row in M], 1)
    return sightings, CameraUnknowns(interior, jax.vmap(quaternion_from_matrix)(matrices), t)


def _ideal(
    model: CameraModel,
    is_known: bool,
    sightings: Sightings,
    interior: Float[Array, " parameters"],
    steepest: float,
) -> tuple[ByPoint, ByPoint, Bool[Array, "views points"]]:
    """Image points without distortion: directions if the camera is known, else pixels; and which
    have a plane coordinate (those of a fisheye far to the side have none)."""
    u, v = sightings.xy[..., 0], sightings.xy[..., 1]
    if is_known:
        r, s, q = cameras.image_ray(model, tuple(interior), u, v)
        front = jnp.less(q, steepest)
        return jnp.where(front, -r / q, 0.0), jnp.where(front, s / q, 0.0), front
    x0, y0 = [interior[model.parameters.index(name)] for name in model.principal_point] or (0, 0)
    x, y = u - x0, v - y0
    return x, y if model.axes == "down" else -y, jnp.isfinite(x)


def _fit(
    sightings: Sightings, x: ByPoint, y: ByPoint, axes: int, settings: StartSettings
) -> tuple[Sequence[Column], Bool[Array, " views"]]:
    """Columns (arrays of a view each) of H (2 axes) or P (3), w > 0 at the points; usable views."""
    nil = jnp.zeros_like(sightings.weight)
    X, middle, size = _normalise(
        sightings.weight, [sightings.point[:, i] + nil for i in range(axes)]
    )
    wide = lambda c: jnp.max(jnp.abs(c), 1, keepdims=True) > settings.min_width
    X = [jnp.where(wide(c), c, 0.0) for c in X]
    (x, y), (mx, my), k = _normalise(sightings.weight, (x, y))
    solution, usable = _direct_linear(sightings.weight, X, x, y, settings.min_pivot)
    h = [*solution, jnp.ones_like(mx)]
    # [(X − X̄)/size, 1] in the units of the object, then x = k·x̃ + mx
    columns = [[c / size for c in h[i :: axes + 1]] for i in range(axes)]
    last_column = [
        c - sum(column[j] * m for column, m in zip(columns, middle))
        for j, c in enumerate(h[axes :: axes + 1])
    ]
    columns = [(k * c[0] + mx * c[2], k * c[1] + my * c[2], c[2]) for c in (*columns, last_column)]
    min_points = settings.min_points_flat if axes == 2 else settings.min_points_solid
    return columns, usable & (jnp.sum(sightings.weight, 1) >= min_points)


def _normalise(
    weight: ByPoint, axes: Sequence[ByPoint]
) -> tuple[list[ByPoint], list[ByView], ByView]:
    """Coordinates about their mean, of mean square 1 an axis together; mean and size a view."""
    number = jnp.maximum(jnp.sum(weight, 1), 1.0)
    mean = [jnp.sum(jnp.where(weight > 0, a, 0.0), 1) / number for a in axes]
    centred = [jnp.where(weight > 0, a - m[:, None], 0.0) for a, m in zip(axes, mean)]
    square = sum(jnp.sum(c * c, 1) for c in centred) / (len(axes) * number)
    size = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return [c / size[:, None] for c in centred], mean, size


def _direct_linear(
    weight: ByPoint, X: Sequence[ByPoint], x: ByPoint, y: ByPoint, min_pivot: float
) -> tuple[list[ByView], Bool[Array, " views"]]:
    """Rows of H or P, without the last element, which is 1, row after row; usable views."""
    nil = jnp.zeros_like(weight)
    # x·(h₃ᵀX + 1) = h₁ᵀX, linear in H: its last element is 1, since after the reduction to the
    # centroids the points are in front of the camera
    homogeneous, zeros = [*X, weight], [nil] * (len(X) + 1)
    rows_x = [*homogeneous, *zeros, *(-x * c for c in X), x]
    rows_y = [*zeros, *homogeneous, *(-y * c for c in X), y]
    n = len(rows_x) - 1
    N = rows_of(gram(rows_x, rows_y))
    scale = [1 / jnp.sqrt(N[i][i]) for i in range(n)]
    L = cholesky([[scale[i] * scale[j] * N[i][j] for j in range(i + 1)] for i in range(n)])
    solution = backward(L, forward(L, [scale[i] * N[i][n] for i in range(n)]))
    solution = [s * c for s, c in zip(scale, solution)]
    pivots = jnp.stack([1 / L[i][i] ** 2 for i in range(n)])
    usable = jnp.all(jnp.isfinite(jnp.stack(solution)), 0) & jnp.all(pivots > min_pivot, 0)
    return solution, usable


def _focal_of_flat(columns: Sequence[Column], usable: Bool[Array, " views"]) -> tuple[Array, Array]:
    """fx, fy by least squares of two equations a view (Zhang 2000)."""
    h, v = _unit(columns[0]), _unit(columns[1])
    d, e = (_unit([a + s * b for a, b in zip(*columns[:2])]) for s in (1, -1))
    # h ⟂ v and, as |h| = |v|, (h + v) ⟂ (h − v): both linear in 1/fx², 1/fy²
    rows = [(p[0] * q[0], p[1] * q[1], -p[2] * q[2]) for p, q in ((h, v), (d, e))]
    total = lambda i, j: sum(jnp.sum(jnp.where(usable, r[i] * r[j], 0.0)) for r in rows)
    a, b, c, p, q = total(0, 0), total(0, 1), total(1, 1), total(0, 2), total(1, 2)
    determinant = a * c - b * b
    inverse_square = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    fx, fy = (1 / jnp.sqrt(jnp.abs(w)) for w in inverse_square)
    return fx, fy


def _focal_of_solid(
    columns: Sequence[Column], usable: Bool[Array, " views"]
) -> tuple[Array, Array]:
    """fx, fy as the median over the views: the rows of P belong to perpendicular directions."""
    rows = list(zip(*columns[:3]))
    third = _unit(rows[2])
    length = _norm(rows[2])

    def median(row: Column) -> Array:
        # The third row of P is that of R, so the rest of the first has the length f.
        component = _dot(row, third)
        f = _norm([a - component * b for a, b in zip(row, third)]) / length
        return jnp.nanmedian(jnp.where(usable, f, jnp.nan))

    return median(rows[0]), median(rows[1])


def _pose_of_flat(columns: Sequence[Column]) -> tuple[tuple[Column, ...], list[ByView]]:
    """Columns of R, and t, from K⁻¹·H; the first two made perpendicular without preference."""
    size = 2 / (_norm(columns[0]) + _norm(columns[1]))
    axis_1, axis_2 = _perpendicular(_unit(columns[0]), _unit(columns[1]))
    axis_3: Any = cross(cast(Any, axis_1), cast(Any, axis_2))
    return (axis_1, axis_2, axis_3), [size * c for c in columns[2]]


def _pose_of_solid(columns: Sequence[Column]) -> tuple[tuple[Column, ...], list[ByView]]:
    """Columns of R, and t, from K⁻¹·P."""
    rows = list(zip(*columns[:3]))
    size = 1 / _norm(rows[2])
    third = _unit(rows[2])
    perpendicular = [
        _unit([a - _dot(row, third) * b for a, b in zip(row, third)]) for row in rows[:2]
    ]
    axis_1, axis_2 = _perpendicular(*perpendicular)
    return tuple(zip(axis_1, axis_2, third)), [size * c for c in columns[3]]


def _perpendicular(a: Column, b: Column) -> tuple[list[ByView], list[ByView]]:
    """Two unit vectors turned towards or from each other by the same angle."""
    p = _unit([x + y for x, y in zip(a, b)])
    q = _unit([x - y for x, y in zip(a, b)])
    root = jnp.sqrt(0.5)
    return [root * (x + y) for x, y in zip(p, q)], [root * (x - y) for x, y in zip(p, q)]


def _dot(a: Column, b: Column) -> ByView:
    return sum((p * q for p, q in zip(a[1:], b[1:])), a[0] * b[0])


def _norm(a: Column) -> ByView:
    return jnp.sqrt(_dot(a, a))


def _unit(a: Column) -> list[ByView]:
    length = _norm(a)
    return [p / length for p in a]
