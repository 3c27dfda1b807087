"""Camera stations and targets of a simulated network.

Generators of stations (a ring around an object, an aerial block) and of targets (a grid, a cloud)
for `jaxbundle.simulate`. Lengths are in the object unit, angles in radians.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbundle.arguments import integer, number, numeric_array, positive, show, vector
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.geometry import omega_phi_kappa_from_matrix
from jaxbundle.system.programs import compile_once
from jaxbundle.types import Numbers

COORDINATES = "finite coordinates X, Y, Z"
# `numpy.random.SeedSequence` mixes seeds into a pool of 128 bits.
LARGEST_SEED = 2**128


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Stations:
    """Exterior orientations: projection centres [I, 3] and ω, φ, κ [I, 3] in radians.

    `a + b` are the stations of both, in this order.
    """

    position: Float[np.ndarray, "images 3"]
    angles: Float[np.ndarray, "images 3"]

    def __post_init__(self) -> None:
        for name in ("position", "angles"):
            object.__setattr__(self, name, rows_of_three(getattr(self, name), f"stations: {name}"))
        if len(self.position) != len(self.angles):
            raise InputError(
                f"stations: {len(self.position)} positions but {len(self.angles)} rows of angles; "
                "give one for each"
            )

    def __len__(self) -> int:
        return len(self.position)

    def __add__(self, other: "Stations") -> "Stations":
        return Stations(
            np.concatenate([self.position, other.position]),
            np.concatenate([self.angles, other.angles]),
        )


def rows_of_three(values: ArrayLike, name: str) -> Float[np.ndarray, "rows 3"]:
    """Finite numbers [rows, 3], or an error that names them."""
    values = numeric_array(name, values, "numbers [rows, 3]").astype(float)
    if values.ndim != 2 or values.shape[1] != 3 or not len(values):
        raise InputError(f"{name} has the shape {values.shape}; expected [rows, 3]")
    for row, k in np.argwhere(~np.isfinite(values))[:1]:
        raise InputError(f"{name}, row {row + 1}: {values[row, k]} is not a finite number")
    return values


def stations_looking_at(
    position: Float[np.ndarray, "images 3"],
    look_at: Float[np.ndarray, "3"] | Float[np.ndarray, "images 3"],
    *,
    roll: float | Numbers = 0.0,
    up: Numbers = (0.0, 0.0, 1.0),
) -> Stations:
    """Stations whose optical axes pass through given points.

    **Arguments:**

    - `position`: projection centres [I, 3].
    - `look_at`: one point [3] for all, or one each [I, 3].
    - `roll`: rotation of the camera about its axis, radians, added to κ. Without roll the
      image's x axis is perpendicular to `up`, and `up` points to its upper half; a camera that
      looks along `up` has its x axis along X of the object space.
    """
    position = rows_of_three(position, "stations: position")
    look_at = numeric_array("look_at", look_at, "coordinates X, Y, Z").astype(float)
    if look_at.shape not in ((3,), position.shape) or not np.isfinite(look_at).all():
        raise InputError(
            f"look_at must be finite coordinates [3], or {list(position.shape)}, one point for "
            f"each station, but is {show(look_at.tolist())}"
        )
    up_direction = vector("up", up, 3, "a direction X, Y, Z")
    if not up_direction.any():
        raise InputError("up must be a direction X, Y, Z, but is 0, 0, 0")
    angle = vector(
        "roll", roll, len(position), f"an angle, or one for each of {len(position)} stations"
    )
    # The camera looks along −z, so z points from the object back to the camera.
    z = position - look_at
    length = np.linalg.norm(z, axis=1, keepdims=True)
    for row in np.flatnonzero(length[:, 0] == 0)[:1]:
        raise InputError(f"stations: station {row + 1} is at the point it looks at")
    z = z / length
    # Where the camera looks along `up`, x is that of the object space: the cross product is zero
    # but for rounding.
    x = np.cross(up_direction, z)
    is_parallel = np.linalg.norm(x, axis=1, keepdims=True) < 1e-9 * np.linalg.norm(up_direction)
    x_direction = np.array([1.0, 0.0, 0.0])
    x = np.where(is_parallel, x_direction - (z @ x_direction)[:, None] * z, x)
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    c, s = np.cos(angle), np.sin(angle)
    c, s = (np.broadcast_to(v, len(position))[:, None] for v in (c, s))
    matrices = np.stack([c * x + s * y, -s * x + c * y, z], 1)
    return Stations(position, _angles(matrices))


def ring_of_stations(
    stations: int,
    radius: float,
    height: float = 0.0,
    look_at: Numbers = (0.0, 0.0, 0.0),
    *,
    roll_every: int = 0,
) -> Stations:
    """Stations evenly on a horizontal circle around the vertical through `look_at`.

    **Arguments:** `radius` and `height` above `look_at`, object unit; `roll_every`: every n-th
    camera is rolled by 90° (2: every other one; 0: none). Without rolled cameras, or an object with
    depth, the principal point is poorly determined.
    """
    stations = integer("stations", stations)
    radius, height = positive("radius", radius), number("height", height)
    roll_every = integer("roll_every", roll_every, least=0)
    middle = vector("look_at", look_at, 3, COORDINATES)
    azimuth = 2 * np.pi * np.arange(stations) / stations
    offset = np.stack(
        [radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(stations, height)], 1
    )
    # The n-th, 2n-th, … camera, so that the first one is upright.
    is_rolled = np.arange(1, stations + 1) % roll_every == 0 if roll_every else np.zeros(stations)
    return stations_looking_at(middle + offset, middle, roll=np.pi / 2 * is_rolled)


def aerial_block(
    strips: int,
    images_per_strip: int,
    *,
    height: float,
    footprint: tuple[float, float],
    forward_overlap: float = 0.6,
    side_overlap: float = 0.3,
    centre: Numbers = (0.0, 0.0, 0.0),
    heading: float = 0.0,
    tilt: float = 0.0,
) -> Stations:
    """Vertical or oblique photographs in parallel strips, every other strip flown back.

    **Arguments:**

    - `height`: of flight above `centre`, object unit.
    - `footprint`: size of a photograph on the ground (along x, along y of the image), object
      unit; strips are flown along the image's x axis.
    - `forward_overlap`, `side_overlap`: fractions of the footprint.
    - `heading`: direction of the first strip, radians counter-clockwise from X.
    - `tilt`: of the optical axis forward, radians, so that strips flown in opposite directions
      look at each other. Vertical photographs alone cannot determine the principal distance:
      scaling heights with c changes no image coordinate.

    **Returns:** strips × images_per_strip stations, centred above `centre`.
    """
    strips = integer("strips", strips)
    images_per_strip = integer("images_per_strip", images_per_strip)
    size = vector("footprint", footprint, 2, "two lengths, along and across the flight")
    if not (size > 0).all():
        raise InputError(f"footprint must be two positive lengths, but is {size.tolist()}")
    middle = vector("centre", centre, 3, COORDINATES)
    height, heading, tilt = (
        number(name, value)
        for name, value in (("height", height), ("heading", heading), ("tilt", tilt))
    )
    below_one = lambda x: -np.inf < x < 1
    forward_overlap = number("forward_overlap", forward_overlap, "a fraction below 1", below_one)
    side_overlap = number("side_overlap", side_overlap, "a fraction below 1", below_one)
    # Strips are flown to and fro: images of every other one are turned by 180° about the vertical.
    base, spacing = size[0] * (1 - forward_overlap), size[1] * (1 - side_overlap)
    strip, place = np.divmod(np.arange(strips * images_per_strip), images_per_strip)
    is_reversed = strip % 2 == 1
    along = base * (place - (images_per_strip - 1) / 2) * np.where(is_reversed, -1, 1)
    across = spacing * (strip - (strips - 1) / 2)
    c, s = np.cos(heading), np.sin(heading)
    offset = np.stack(
        [c * along - s * across, s * along + c * across, np.full(len(strip), float(height))], 1
    )
    direction = np.where(is_reversed, -1, 1)[:, None] * np.array([c, s, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    x = np.cos(tilt) * direction + np.sin(tilt) * up
    z = np.cos(tilt) * up - np.sin(tilt) * direction
    return Stations(middle + offset, _angles(np.stack([x, np.cross(z, x), z], 1)))


def _angles(matrices: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, "images 3"]:
    """ω, φ, κ of rotation matrices."""
    return np.asarray(_all_angles(matrices), float)


_all_angles = compile_once(jax.vmap(omega_phi_kappa_from_matrix), ())


def grid_of_targets(
    columns: int,
    rows: int,
    spacing: float | tuple[float, float],
    *,
    relief: float = 0.0,
    seed: int = 0,
    centre: Numbers = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "points 3"]:
    """Targets on a horizontal grid, row by row: [columns·rows, 3], object unit.

    **Arguments:** `spacing` along X and Y; `relief`: heights vary at random (by `seed`) within
    ± relief; 0 gives a plane.
    """
    columns, rows = integer("columns", columns), integer("rows", rows)
    dx, dy = vector("spacing", spacing, 2, "one positive length, or two along X and Y")
    if not min(dx, dy) > 0:
        raise InputError(f"spacing must be positive, but is {show(spacing)}")
    relief = number("relief", relief, "0 or a positive length", lambda x: 0 <= x < np.inf)
    middle = vector("centre", centre, 3, COORDINATES)
    seed = integer("seed", seed, least=0, most=LARGEST_SEED)
    x = dx * (np.arange(columns) - (columns - 1) / 2)
    y = dy * (np.arange(rows) - (rows - 1) / 2)
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    z = np.random.default_rng(seed).uniform(-relief, relief, len(xy))
    return middle + np.concatenate([xy, z[:, None]], 1)


def cloud_of_targets(
    points: int,
    size: float | Numbers,
    *,
    seed: int = 0,
    centre: Numbers = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "points 3"]:
    """Targets at random in a box of the given `size` (one edge, or three): [points, 3]."""
    points = integer("points", points)
    half_size = vector("size", size, 3, "one length of an edge, or three") / 2
    if (half_size < 0).any():
        raise InputError(
            f"size must be 0 or positive lengths, but is {show((2 * half_size).tolist())}"
        )
    middle = vector("centre", centre, 3, COORDINATES)
    rng = np.random.default_rng(integer("seed", seed, least=0, most=LARGEST_SEED))
    return middle + rng.uniform(-half_size, half_size, (points, 3))
