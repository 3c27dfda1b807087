"""Rectification of an image to a map (the command `correct`), block by block.

For a block of the map, ground points at a grid of nodes give, by linear interpolation, the point of
every pixel on the ellipsoid and its vertical; the height h, constant or from a terrain model, is
then added. Image positions are smooth functions of the place and of h, terrain is not: they are
computed at nodes of the block and at five heights from its lowest to its highest one,

    t = (h − middle)/half,      f(t) = a₀ + a₁·t + a₂·t²,

the a of every pixel by linear interpolation between the nodes, from t = −1, 0, 1. The heights
t = ±½ and every second node, which coarser nodes would have interpolated, tell the error: nodes are
32 pixels apart, or 16, and if the error is still above the tolerance every point is projected
itself, starting from the interpolated position, or by a search if that does not converge. What is
used has a quarter of the tested error or less, as nodes half as far apart have.

A point is hidden by other terrain if the ray of its image position ends before it:
optionally the first intersection of every pixel's ray is computed, and points farther from it than
half a map pixel are not shown.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.geometry.ellipsoid import earth_fixed, vertical
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
from jaxbundle.types import AnyArray, Scalar, not_none

BLOCK_SIZE = 256
"""Pixels of a block of the map along each side: a usual tile of GeoTIFF, in which maps are written,
and 0.5 MB a coordinate. The shapes of compiled programs follow from it."""
NODE_STEP = 16
"""Pixels between the nodes of a block, a divisor of `BLOCK_SIZE`. The sagitta of the Earth's
curvature between nodes, (16·10 m)²/8R = 0.5 mm for pixels of 10 m, grows with the square of the
distance of nodes and of the size of pixels."""
TOLERANCE = 0.02
"""Pixels of the image by which interpolated positions may be wrong where they are tested: a fifth
of 0.1 pixel, to which images are measured at best. GDAL's default is 0.125. Of an image with RPC of
4000 × 4000 pixels, 20° off the nadir, nodes 32 pixels apart serve down to 0.005, 16 apart to 0.001;
every pixel by itself takes 1.7 times as long (3.05 s of processor instead of 1.75)."""
HEIGHTS = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
"""Heights of a block at which positions are computed, t above."""


class MapNodes(NamedTuple):
    """Ground points at the nodes of a block: on the ellipsoid (Z = 0), and the vertical there."""

    X: Float[AnyArray, "3 n n"]
    vertical: Float[AnyArray, "3 n n"]


class Places(NamedTuple):
    """Image positions of the pixels of a block; NaN outside."""

    line: Float[AnyArray, "rows columns"]
    pixel: Float[AnyArray, "rows columns"]


def geographic_nodes(
    surface: GroundSurface, longitude: np.ndarray, latitude: np.ndarray
) -> MapNodes:
    """Nodes at longitudes and latitudes, radians."""
    place = longitude, latitude, np.zeros_like(longitude)
    return MapNodes(*map(np.asarray, _ground_and_vertical(surface.earth, place)))


_ground_and_vertical = compile_once(
    lambda earth, place: (jnp.stack(earth_fixed(earth, place)), jnp.stack(vertical(place))), ()
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
    tolerance: float = TOLERANCE,
) -> Places | None:
    """Image positions of the pixels of a block; None if none of them is near the image.

    With `occlusion` pixels hidden by other terrain have none. `search`: of a rigorous image;
    `tolerance`: of interpolated positions, pixels of the image; 0: all are projected.
    """
    heights = _heights(surface, nodes)
    if isinstance(image, RpcImage):
        project = lambda X: _project_by_rpc(image.rpc, surface, X)
        project_all = lambda: _rpc_places(image.rpc, surface, nodes, heights.height)
    else:
        starts = _find_starts(image, not_none(search), surface, nodes)
        if starts is None:
            return None
        scanner = scanner_of(image)
        project = lambda X: _project_near(scanner, search, X, starts)
        project_all = lambda: _scanner_places(
            image, not_none(search), nodes, heights.height, starts
        )
    places = _interpolated_places(image, project, nodes, heights, tolerance)
    if places is None:
        return None
    line, pixel = places or project_all()
    if occlusion and isinstance(surface, Terrain):
        hidden = _hidden(image, search, surface, nodes, heights.height, (line, pixel))
        line = jnp.where(hidden, jnp.nan, line)
    inside_places = _keep_inside(image, np.asarray(line), np.asarray(pixel))
    return inside_places if np.isfinite(inside_places.line).any() else None


class BlockHeights(NamedTuple):
    """The heights of the pixels of a block; the middle of them, and half of their range."""

    height: Float[AnyArray, "rows columns"]
    middle: Scalar
    half_range: Scalar


# Positions [2, heights, n, n] of points [3, heights, n, n].
Projection = Callable[[AnyArray], Float[np.ndarray, "2 heights n n"]]


def _interpolated_places(
    image: PushbroomImage | RpcImage,
    project: Projection,
    nodes: MapNodes,
    heights: BlockHeights,
    tolerance: float,
) -> tuple[AnyArray, AnyArray] | tuple[()] | None:
    """Interpolated positions; none if they are not within the tolerance; None if the block is
    beside the image."""
    h = np.asarray(heights.middle) + HEIGHTS * np.asarray(heights.half_range)
    # A terrain model without a height here.
    if not np.isfinite(h).all():
        return None
    for stride in (2, 1):
        X, vertical = (a[:, None, ::stride, ::stride] for a in nodes)
        values = np.asarray(project(X + h[:, None, None] * vertical))
        if np.isfinite(values).all():
            if _is_beside(image, values):
                return None
            if tolerance == 0:
                break
            coefficients, error = _fit_heights(values)
            if error <= tolerance:
                return _evaluate(coefficients, heights)
    return ()


def _is_beside(image: PushbroomImage | RpcImage, values: Float[np.ndarray, "2 h n n"]) -> bool:
    """Whether no pixel of a block is in the image, by the positions of its nodes.

    Between two nodes the position is within their range, extended by a tenth of it: far more than
    the bend that any tolerance allows."""
    low, high = values.min((1, 2, 3)), values.max((1, 2, 3))
    margin = 0.1 * (high - low) + 1
    return any(
        high[k] + margin[k] < -0.5 or low[k] - margin[k] > size - 0.5
        for k, size in enumerate((image.lines, image.pixels))
    )


@partial(compile_once, static=())
def _fit_heights(
    values: Float[AnyArray, "2 5 n n"],
) -> tuple[Float[Array, "2 3 n n"], Float[Array, ""]]:
    """The coefficients a₀, a₁, a₂ at the nodes, and the largest error where they are tested."""
    low, lower, middle, upper, high = jnp.moveaxis(values, 1, 0)
    a = middle, (high - low) / 2, (high + low) / 2 - middle
    parabola = lambda t: a[0] + t * (a[1] + t * a[2])
    bend = jnp.maximum(jnp.abs(parabola(-0.5) - lower).max(), jnp.abs(parabola(0.5) - upper).max())
    n = values.shape[-1]
    weights = hat_functions(n, 2)
    coarse = values[..., ::2, ::2].reshape(-1, n // 2 + 1, n // 2 + 1)
    interpolated = jnp.einsum("ri,kij,cj->krc", weights, coarse, weights).reshape(values.shape)
    return jnp.stack(a, 1), bend + jnp.abs(interpolated - values).max()


@partial(compile_once, static=())
def _evaluate(
    coefficients: Float[AnyArray, "2 3 n n"], heights: BlockHeights
) -> tuple[Array, Array]:
    """Positions of all pixels at their heights."""
    n = coefficients.shape[-1]
    t = (heights.height - heights.middle) / heights.half_range
    a0, a1, a2 = jnp.moveaxis(
        _interpolate_nodes(coefficients.reshape(6, n, n)).reshape(2, 3, BLOCK_SIZE, BLOCK_SIZE),
        1,
        0,
    )
    line, pixel = a0 + t * (a1 + t * a2)
    return line, pixel


def _find_starts(
    image: PushbroomImage, search: Search, surface: GroundSurface, nodes: MapNodes
) -> Float[np.ndarray, "2 n n"] | None:
    """Positions of the nodes in a rigorous image; None if it sees none of them."""
    # Start values only: between the heights of terrain an image position moves by pixels.
    raised_nodes = nodes.X + np.asarray(_representative_height(surface)) * nodes.vertical
    # Nodes up to 512 lines and pixels outside have positions too, so that they enclose its edges.
    projected = project_points(image, search, raised_nodes.reshape(3, -1), margin=2.0 * BLOCK_SIZE)
    starts = np.stack([projected.line[0], projected.pixel[0]])
    if not np.isfinite(starts[0]).any():
        return None
    return _fill_unseen_nodes(starts.reshape(2, *nodes.X.shape[1:]))


def _scanner_places(
    image: PushbroomImage,
    search: Search,
    nodes: MapNodes,
    height: Float[AnyArray, "rows columns"],
    starts: Float[np.ndarray, "2 n n"],
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of all pixels of a block in a rigorous image, each projected."""
    line, pixel, ground = map(
        np.asarray, _project_block(scanner_of(image), search, nodes, height, starts)
    )
    is_lost = np.isnan(line) & np.isfinite(ground[0])
    if is_lost.any():
        # On a rough trajectory the interpolated start may not converge.
        line, pixel = line.copy(), pixel.copy()
        line[is_lost], pixel[is_lost] = _search(image, search, ground[:, is_lost], starts[0].size)
    return line, pixel


def _hidden(
    image: PushbroomImage | RpcImage,
    search: Search | None,
    surface: Terrain,
    nodes: MapNodes,
    height: Float[AnyArray, "rows columns"],
    places: tuple[AnyArray, AnyArray],
) -> Bool[AnyArray, "rows columns"]:
    """Which pixels are hidden by other terrain."""
    ground = _raise(nodes, height)
    if isinstance(image, RpcImage):
        return _are_occluded_in_rpc(image.rpc, surface, *places, ground, _half_pixel(nodes))
    positions = *places, ground, _half_pixel(nodes)
    return _are_occluded(scanner_of(image), not_none(search), surface, *positions)


def _keep_inside(
    image: PushbroomImage | RpcImage,
    line: Float[np.ndarray, "rows columns"],
    pixel: Float[np.ndarray, "rows columns"],
) -> Places:
    """Positions outside the image become NaN."""
    is_inside = (line >= -0.5) & (line < image.lines - 0.5)
    is_inside &= (pixel >= -0.5) & (pixel < image.pixels - 0.5)
    return Places(np.where(is_inside, line, np.nan), np.where(is_inside, pixel, np.nan))


@partial(compile_once, static=())
def _rpc_places(
    rpc: Rpc, surface: GroundSurface, nodes: MapNodes, height: Float[AnyArray, "rows columns"]
) -> tuple[Array, Array]:
    """Positions of all pixels of a block by the polynomials."""
    return project_to_rpc(rpc, surface, _ground(nodes, height))


_project_by_rpc = compile_once(lambda *arguments: jnp.stack(project_to_rpc(*arguments)), ())
_are_occluded_in_rpc = compile_once(are_occluded_in_rpc, ())


@partial(compile_once, static=())
def _project_near(
    image: ScannerGeometry,
    search: Search,
    X: Float[AnyArray, "3 heights n n"],
    starts: Float[AnyArray, "2 m m"],
) -> Float[Array, "2 heights n n"]:
    """Positions of points above nodes in a rigorous image, from those of the nodes."""
    stride = (starts.shape[-1] - 1) // (X.shape[-1] - 1)
    start = jnp.broadcast_to(starts[:, None, ::stride, ::stride], (2, *X.shape[1:]))
    return jnp.stack(project_from(image, search, tuple(X), *start))


def _search(
    image: PushbroomImage, search: Search, X: Float[np.ndarray, "3 n"], portion: int
) -> Float[np.ndarray, "2 n"]:
    """Lines and pixels of points [3, n] by a search of the image, in batches of points."""
    places = np.empty((2, X.shape[1]))
    for k in range(0, X.shape[1], portion):
        batch = X[:, k : k + portion]
        n = batch.shape[1]
        padded = np.pad(batch, ((0, 0), (0, portion - n)), mode="edge")
        # Of one shape, so that one program serves any number of points.
        projected = project_points(image, search, padded, margin=0.0)
        places[:, k : k + n] = np.asarray(projected.line)[0, :n], np.asarray(projected.pixel)[0, :n]
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
    ground = jnp.moveaxis(_ground(nodes, _heights_of(surface, nodes)), 0, -1)

    def error(line: Scalar, pixel: Scalar, X: Float[Array, "3"]) -> Float[Array, "2"]:
        true = _locate(truth, search, surface, line, pixel)
        return horizontal(east_north(surface, true), true, tuple(X))

    # Row by row: the state of a ray's traversal of terrain stays in the cache.
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
    is_seen = np.isfinite(starts[0])
    if is_seen.all():
        return starts
    i, j = np.indices(is_seen.shape)
    A = np.stack([np.ones(is_seen.size), i.ravel(), j.ravel()], 1)
    plane, *_ = np.linalg.lstsq(A[is_seen.ravel()], starts[:, is_seen].T, rcond=None)
    return np.where(is_seen, starts, (A @ plane).T.reshape(starts.shape))


def _representative_height(surface: GroundSurface) -> Scalar:
    """A representative height of the surface."""
    if isinstance(surface, Terrain):
        return (surface.lowest + surface.highest) / 2
    return surface.level if isinstance(surface, Height | Plane) else 0.0


@partial(compile_once, static=())
def _project_block(
    image: ScannerGeometry,
    search: Search,
    nodes: MapNodes,
    height: Float[AnyArray, "rows columns"],
    starts: Float[AnyArray, "2 n n"],
) -> tuple[Array, Array, Array]:
    ground = _ground(nodes, height)
    return *project_from(image, search, tuple(ground), *_interpolate_nodes(starts)), ground


def block_heights(surface: GroundSurface, nodes: MapNodes) -> Float[np.ndarray, "rows columns"]:
    """The heights of the pixels of a block, NaN where the terrain has none."""
    return np.asarray(_heights(surface, nodes).height)


@partial(compile_once, static=())
def _heights(surface: GroundSurface, nodes: MapNodes) -> BlockHeights:
    """Heights of the pixels of a block, NaN where the terrain has none."""
    height = _heights_of(surface, nodes)
    low, high = jnp.nanmin(height), jnp.nanmax(height)
    # A metre on flat ground, whose position no range describes.
    return BlockHeights(height, (low + high) / 2, jnp.maximum((high - low) / 2, 1.0))


def _heights_of(surface: GroundSurface, nodes: MapNodes) -> Float[Array, "rows columns"]:
    if isinstance(surface, Terrain):
        x, y, _ = surface.grid(tuple(nodes.X))
        return jnp.asarray(bilinear(surface.heights, *_interpolate_nodes(jnp.stack([x, y]))))
    return jnp.broadcast_to(_representative_height(surface), (BLOCK_SIZE, BLOCK_SIZE)) * 1.0


def _ground(nodes: MapNodes, height: Float[AnyArray, "rows columns"]) -> Float[Array, "3 r c"]:
    """The points of all pixels, [3, BLOCK_SIZE, BLOCK_SIZE]."""
    return _interpolate_nodes(nodes.X) + height * _interpolate_nodes(nodes.vertical)


_raise = compile_once(_ground, ())


def _interpolate_nodes(nodes: Float[AnyArray, "k n n"]) -> Float[Array, "k rows columns"]:
    """From nodes to all pixels, linear in between: [k, n, n] to [k, BLOCK_SIZE, BLOCK_SIZE]."""
    weights = hat_functions(BLOCK_SIZE, BLOCK_SIZE // (nodes.shape[-1] - 1))
    return jnp.einsum("ri,kij,cj->krc", weights, nodes, weights)


def hat_functions(size: int, step: int) -> Float[np.ndarray, "size nodes"]:
    """Weights of linear interpolation at whole numbers, between nodes `step` apart along a side."""
    nodes = np.arange(-(-(size - 1) // step) + 1)
    return np.maximum(1 - np.abs(np.arange(size)[:, None] / step - nodes), 0)
