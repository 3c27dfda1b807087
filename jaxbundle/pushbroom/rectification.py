"""Rectification of an image to a map (the command `correct`), block by block.

For a block of the map, ground points at a grid of nodes give, by linear interpolation, the point of
every pixel on the ellipsoid and its vertical; the height, constant or from a terrain model, is then
added. Every point is projected into the image, starting from the interpolated image position, or
by a search if that does not converge, and the image is resampled there.

An image by rational polynomials (`RpcImage`) needs neither start nor search.

A point is hidden by other terrain if the ray of its image position ends before it:
optionally the first intersection of every pixel's ray is computed, and points farther from it than
half a map pixel are not shown.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.geometry.ellipsoid import earth_fixed, up
from jaxbundle.geometry.vectors import Triple, difference, dot, length
from jaxbundle.pushbroom.error_propagation import east_north, horizontal
from jaxbundle.pushbroom.ground_to_image import project_from, project_points
from jaxbundle.pushbroom.image import LinePose, PushbroomImage
from jaxbundle.pushbroom.image_to_ground import ground_point
from jaxbundle.pushbroom.pieces import sample
from jaxbundle.pushbroom.prepared import ScannerGeometry, Search, scanner_of
from jaxbundle.pushbroom.rpc.image import RpcImage, are_occluded_in_rpc, project_to_rpc
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.pushbroom.surfaces import GroundSurface, Height, Plane
from jaxbundle.pushbroom.terrain import Terrain, bilinear
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar, present

BLOCK_SIZE = 256
"""Pixels of a block of the map along each side: a usual tile of GeoTIFF, in which maps are written,
and 0.5 MB a coordinate. The shapes of compiled programs follow from it."""
NODE_STEP = 16
"""Pixels between the nodes of a block, a divisor of `BLOCK_SIZE`. The sagitta of the Earth's
curvature between nodes, (16·10 m)²/8R = 0.5 mm for pixels of 10 m, grows with the square of the
distance of nodes and of the size of pixels."""


class MapNodes(NamedTuple):
    """Ground points at the nodes of a block: on the ellipsoid (Z = 0), and the vertical there."""

    X: Float[AnyArray, "3 n n"]
    up: Float[AnyArray, "3 n n"]


class Places(NamedTuple):
    """Image positions of the pixels of a block; NaN outside."""

    line: Float[AnyArray, "rows columns"]
    pixel: Float[AnyArray, "rows columns"]


def geographic_nodes(
    surface: GroundSurface, longitude: np.ndarray, latitude: np.ndarray
) -> MapNodes:
    """Nodes at longitudes and latitudes, radians."""
    place = longitude, latitude, np.zeros_like(longitude)
    return MapNodes(*map(np.asarray, _ground_and_up(surface.earth, place)))


_ground_and_up = compile_once(
    lambda earth, place: (jnp.stack(earth_fixed(earth, place)), jnp.stack(up(place))), ()
)


def local_nodes(x: np.ndarray, y: np.ndarray) -> MapNodes:
    """Nodes at X and Y of a local frame, metres."""
    zero = np.zeros_like(x)
    return MapNodes(np.stack([x, y, zero]), np.stack([zero, zero, zero + 1]))


def block_places(
    image: PushbroomImage | RpcImage,
    search: Search | None,
    surface: GroundSurface,
    nodes: MapNodes,
    occlusion: bool = False,
) -> Places | None:
    """Image positions of the pixels of a block; None if none of them is near the image.

    With `occlusion` pixels hidden by other terrain have none. `search`: of a rigorous image.
    """
    if isinstance(image, RpcImage):
        occlusion = occlusion and isinstance(surface, Terrain)
        places = _rpc_places(occlusion, image.rpc, surface, nodes)
        found = _keep_inside(image, *map(np.asarray, places))
        return found if np.isfinite(found.line).any() else None
    search = present(search)
    # start values only: between the heights of terrain an image position moves by pixels
    level = np.asarray(_level(surface))
    raised = nodes.X + level * nodes.up
    # Nodes up to 512 lines and pixels outside have positions too, so that they enclose its edges.
    found = project_points(image, search, raised.reshape(3, -1), margin=2.0 * BLOCK_SIZE)
    starts = np.stack([found.line[0], found.pixel[0]])
    seen = np.isfinite(starts[0])
    if not seen.any():
        return None
    starts = _fill_unseen_nodes(starts.reshape(2, *nodes.X.shape[1:]))
    scanner = scanner_of(image)
    line, pixel, ground = map(np.asarray, _places(scanner, search, surface, nodes, starts))
    lost = np.isnan(line)
    if lost.any():
        # on a rough trajectory the interpolated start may not converge
        line, pixel = line.copy(), pixel.copy()
        line[lost], pixel[lost] = _search(image, search, ground[:, lost], starts[0].size)
    if occlusion and isinstance(surface, Terrain):
        positions = line, pixel, ground, _half_pixel(nodes)
        hidden = np.asarray(_are_occluded(scanner, search, surface, *positions))
        line = np.where(hidden, np.nan, line)
    return _keep_inside(image, line, pixel)


def _keep_inside(
    image: PushbroomImage | RpcImage,
    line: Float[np.ndarray, "rows columns"],
    pixel: Float[np.ndarray, "rows columns"],
) -> Places:
    """Positions outside the image become NaN."""
    inside = (line >= -0.5) & (line < image.lines - 0.5)
    inside &= (pixel >= -0.5) & (pixel < image.pixels - 0.5)
    return Places(np.where(inside, line, np.nan), np.where(inside, pixel, np.nan))


@partial(compile_once, static=0)
def _rpc_places(
    occlusion: bool, rpc: Rpc, surface: GroundSurface, nodes: MapNodes
) -> tuple[Array, Array]:
    ground = _ground(surface, nodes)
    line, pixel = project_to_rpc(rpc, surface, ground)
    if occlusion:
        hidden = are_occluded_in_rpc(rpc, surface, line, pixel, ground, _half_pixel(nodes))
        line = jnp.where(hidden, jnp.nan, line)
    return line, pixel


def _search(
    image: PushbroomImage, search: Search, X: Float[np.ndarray, "3 n"], portion: int
) -> Float[np.ndarray, "2 n"]:
    """Lines and pixels of points [3, n] by a search of the image, in batches of points."""
    places = np.empty((2, X.shape[1]))
    for k in range(0, X.shape[1], portion):
        few = X[:, k : k + portion]
        n = few.shape[1]
        full = np.pad(few, ((0, 0), (0, portion - n)), mode="edge")
        # of one shape, so that one program serves any number of points
        found = project_points(image, search, full, margin=0.0)
        places[:, k : k + n] = np.asarray(found.line)[0, :n], np.asarray(found.pixel)[0, :n]
    return places


def block_errors(
    truth: PushbroomImage, search: Search, surface: GroundSurface, nodes: MapNodes, places: Places
) -> Float[np.ndarray, "2 rows columns"]:
    """East and north map errors of the pixels of a block, metres.

    A pixel shows the image at its position; the truth locates that position on the surface.

    **Arguments:** `truth` with its `search`; `places` in the tested image.
    """
    return np.asarray(_errors(scanner_of(truth), search, surface, nodes, places))


@partial(compile_once, static=())
def _errors(
    truth: ScannerGeometry, search: Search, surface: GroundSurface, nodes: MapNodes, places: Places
) -> Float[Array, "2 rows columns"]:
    ground = jnp.moveaxis(_ground(surface, nodes), 0, -1)

    def error(line: Scalar, pixel: Scalar, X: Float[Array, "3"]) -> Float[Array, "2"]:
        true = _locate(truth, search, surface, line, pixel)
        return horizontal(east_north(surface, true), true, tuple(X))

    # row by row: the state of a ray's traversal of terrain stays in the cache
    errors_of_row = lambda row: jax.vmap(error)(*row)
    return jnp.moveaxis(jax.lax.map(errors_of_row, (*places, ground)), -1, 0)


def _locate(
    image: ScannerGeometry, search: Search, surface: GroundSurface, line: Scalar, pixel: Scalar
) -> Triple:
    """The point seen at an image position, by the pieces of the search."""
    numbers, _, (P, V) = sample(search.pieces, image.times.time(line))
    pose = LinePose(jnp.stack(P), numbers[:9].reshape(3, 3).T, jnp.stack(V))
    return ground_point(pose, image.optics.slopes(pixel), surface, image.corrections)


@partial(compile_once, static=())
def _are_occluded(
    image: ScannerGeometry,
    search: Search,
    surface: GroundSurface,
    line: Float[AnyArray, "rows columns"],
    pixel: Float[AnyArray, "rows columns"],
    ground: Float[AnyArray, "3 rows columns"],
    half_pixel: Scalar,
) -> Bool[Array, "rows columns"]:
    """Whether the rays of image positions end before their points [3, rows, columns].

    A ray without heights on its way to the point hides nothing. Half a pixel of the map, metres, is
    what the interpolation between nodes and of the terrain may differ by without a shadow.
    """

    def is_occluded(line: Scalar, pixel: Scalar, X: Float[Array, "3"]) -> bool | Bool[AnyArray, ""]:
        _, _, (P, _) = sample(search.pieces, image.times.time(line))
        gap = difference(X, _locate(image, search, surface, line, pixel))
        return (dot(gap, difference(X, P)) > 0) & (length(gap) > half_pixel)

    row_is_occluded = lambda row: jax.vmap(is_occluded)(*row)
    return jax.lax.map(row_is_occluded, (line, pixel, jnp.moveaxis(ground, 0, -1)))


def _half_pixel(nodes: MapNodes) -> Scalar:
    """Half the distance of neighbouring pixels, metres: on the ellipsoid, where it does not depend
    on the heights of the terrain and its gaps."""
    return length(nodes.X[:, 0, 1] - nodes.X[:, 0, 0]) / NODE_STEP / 2


def _fill_unseen_nodes(starts: Float[np.ndarray, "2 n n"]) -> Float[np.ndarray, "2 n n"]:
    """Positions of unseen nodes, from a plane through the others: sufficient as start values.

    Were they left out, pixels beside the outermost seen node would have no start at all.
    """
    seen = np.isfinite(starts[0])
    if seen.all():
        return starts
    i, j = np.indices(seen.shape)
    A = np.stack([np.ones(seen.size), i.ravel(), j.ravel()], 1)
    plane, *_ = np.linalg.lstsq(A[seen.ravel()], starts[:, seen].T, rcond=None)
    return np.where(seen, starts, (A @ plane).T.reshape(starts.shape))


def _level(surface: GroundSurface) -> Scalar:
    """A representative height of the surface."""
    if isinstance(surface, Terrain):
        return (surface.lowest + surface.highest) / 2
    return surface.level if isinstance(surface, Height | Plane) else 0.0


@partial(compile_once, static=())
def _places(
    image: ScannerGeometry,
    search: Search,
    surface: GroundSurface,
    nodes: MapNodes,
    starts: Float[AnyArray, "2 n n"],
) -> tuple[Array, Array, Array]:
    ground = _ground(surface, nodes)
    return *project_from(image, search, tuple(ground), *_spread(starts)), ground


def _ground(surface: GroundSurface, nodes: MapNodes) -> Float[Array, "3 rows columns"]:
    """The points of all pixels, [3, BLOCK_SIZE, BLOCK_SIZE]."""
    X, vertical = _spread(nodes.X), _spread(nodes.up)
    if isinstance(surface, Terrain):
        x, y, _ = surface.grid(tuple(nodes.X))
        height = bilinear(surface.heights, *_spread(jnp.stack([x, y])))
    else:
        height = _level(surface)
    return X + height * vertical


def _spread(nodes: Float[AnyArray, "k n n"]) -> Float[Array, "k rows columns"]:
    """From nodes to all pixels, linear in between: [k, n, n] to [k, BLOCK_SIZE, BLOCK_SIZE]."""
    return jnp.einsum("ri,kij,cj->krc", WEIGHTS, nodes, WEIGHTS)


# Of the nodes along one side, [BLOCK_SIZE, nodes]: hat functions.
WEIGHTS = np.maximum(
    1 - np.abs(np.arange(BLOCK_SIZE)[:, None] / NODE_STEP - np.arange(BLOCK_SIZE // NODE_STEP + 1)),
    0,
)
