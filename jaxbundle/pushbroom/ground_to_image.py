"""Ground → image: all lines and pixels that see a point, or a status if there are none.

The point X is seen at the time t by the pixel u where

    r + ξ(u)·q = 0,    s + η(u)·q = 0,        [r, s, q] = Rᵀ(t)·(X − P(t)),    q < 0.

In the footprint of the image `project_points` starts from polynomials
(`footprint`), elsewhere from a search of the whole image (`passages`). Newton's
method continues with the polynomials of `pieces` (`newton`).

`project_near` is the textbook method for one point near a known image position, with the
trajectory itself. Its derivatives are exact by the implicit function theorem.

With corrections, X is replaced by its apparent position (`apparent_point`).
"""

from collections.abc import Callable
from enum import IntEnum
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbundle.arguments import without_masks
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, normal
from jaxbundle.geometry.vectors import Vector, difference, dot, rotate_back
from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.pushbroom.corrections import Corrections, apparent_point
from jaxbundle.pushbroom.detector_line import fit_line
from jaxbundle.pushbroom.footprint import make_footprint
from jaxbundle.pushbroom.image import LinePose, PushbroomImage, pose_at
from jaxbundle.pushbroom.newton import first_indices, gather, refine, scatter
from jaxbundle.pushbroom.passages import find_passages
from jaxbundle.pushbroom.pieces import make_pieces, sample, sample_times
from jaxbundle.pushbroom.prepared import ScannerGeometry, Search, scanner_of
from jaxbundle.pushbroom.scanner import Pair
from jaxbundle.pushbroom.search_settings import DEFAULTS, SearchSettings
from jaxbundle.system.devices import batch_size
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


class ProjectionStatus(IntEnum):
    """Whether a point is in the image, and if not, why."""

    SEEN = 0
    BEFORE = 1
    AFTER = 2
    BESIDE = 3
    HIDDEN = 4
    NOT_CONVERGED = 5

    @property
    def meaning(self) -> str:
        """The status in words."""
        return _MEANING[self]


_MEANING = {
    ProjectionStatus.SEEN: "in the image",
    ProjectionStatus.BEFORE: "behind the first line",
    ProjectionStatus.AFTER: "ahead of the last line",
    ProjectionStatus.BESIDE: "beside the line of detectors",
    ProjectionStatus.HIDDEN: "on the other side of the Earth, or behind the camera",
    ProjectionStatus.NOT_CONVERGED: "no place found: the trajectory is too rough",
}


class Projected(eqx.Module):
    """Lines and pixels that see the points, in order of time; NaN for unused places.

    `count`: their number, with passages after the last place, which were not refined and may be
    outside the image. `status`: the `ProjectionStatus` of the point.
    """

    line: Float[AnyArray, "most n"]
    pixel: Float[AnyArray, "most n"]
    count: Int[AnyArray, " n"]
    status: Int[AnyArray, " n"]


def make_search(
    image: PushbroomImage,
    earth: Ellipsoid | None = WGS84,
    settings: SearchSettings = DEFAULTS,
) -> Search:
    """Prepare an image for `project_points`; `earth` is None in a local frame.

    **Raises:** `InputError` if no pieces represent the trajectory.
    """
    pieces = make_pieces(image, earth, settings)
    samples = sample_times(pieces, settings.search_times)
    line = fit_line(image.optics, image.pixels)
    footprint = None
    if settings.with_footprint:
        footprint = make_footprint(image, pieces, samples, line, earth, settings)
    if footprint is None:
        samples = sample_times(pieces, settings.fine_search_times)
    return Search(pieces, footprint, samples, line, earth, settings)


@without_masks
def project_points(
    image: PushbroomImage,
    search: Search,
    X: Float[AnyArray, "3 n"],
    most: int = 1,
    margin: float = 0.0,
) -> Projected:
    """The positions of points in the whole image, the first `most` of each.

    **Arguments:** `search` of the same image, by `make_search`; X in metres, coordinates first;
    positions outside the image by up to `margin` lines and pixels count as inside. Points inside
    the image are about ten times as fast as those outside, which must be searched for.
    """
    if jnp.ndim(X) != 2 or jnp.shape(X)[0] != 3:  # noqa: PLR2004 - coordinates
        raise InputError(f"X: expected the shape [3, n], coordinates first, got {jnp.shape(X)}")
    # Whole numbers and single precision are coordinates too.
    X = jnp.asarray(X, float)
    return _project_points(scanner_of(image), search, X, most, margin)


@partial(jax.jit, static_argnames="most")
def _project_points(
    image: ScannerGeometry,
    search: Search,
    X: Float[AnyArray, "3 n"],
    most: int,
    margin: float | Array,
) -> Projected:
    """One program for all margins: an omitted default would be compiled in."""
    find = lambda X: _find_positions(image, search, X, most, margin)
    return _map_chunks(find, tuple(X), batch_size(*search.settings.points_at_once))


def project_from(
    image: PushbroomImage | ScannerGeometry, search: Search, X: Vector, line: Scalar, pixel: Scalar
) -> tuple[Array, Array]:
    """Line and pixel of points near the given positions, without search; arrays of one shape.

    NaN if Newton's method does not converge.
    """
    return _project_from(scanner_of(image), search, X, line, pixel)


@partial(compile_once, static=())
def _project_from(
    image: ScannerGeometry, search: Search, X: Vector, line: Scalar, pixel: Scalar
) -> tuple[Array, Array]:
    flattened = [
        jnp.ravel(a) for a in jnp.broadcast_arrays(*X, image.times.time(line), pixel * 1.0)
    ]
    refine_chunk = lambda args: refine(image, search, args[:3], *args[3:])
    size = batch_size(*search.settings.points_at_once)
    t, u, settled = _map_chunks(refine_chunk, tuple(flattened), size)
    shape = jnp.broadcast_shapes(*(jnp.shape(a) for a in (*X, line, pixel)))
    settled_only = lambda a: jnp.where(settled, a, jnp.nan).reshape(shape)
    return settled_only(image.times.line(t)), settled_only(u)


def project_near(
    image: PushbroomImage,
    X: Float[AnyArray, "3"],
    line: Scalar,
    pixel: Scalar,
    earth: Ellipsoid | None = WGS84,
) -> tuple[Scalar, Scalar]:
    """Line and pixel of one point near an image position; differentiable in image and point, to any
    order."""
    fixed = stop_gradient((image, X))

    def newton(_: int, tu: Float[Array, "2"]) -> Float[Array, "2"]:
        J = jax.jacfwd(_misclosure_near)(tu, earth, fixed)
        return tu - jnp.linalg.solve(J, _misclosure_near(tu, earth, fixed))

    start = stop_gradient(jnp.stack([fixed[0].times.time(line), pixel * 1.0]))
    # Measured on a restless satellite: from 10 lines away two steps reach rounding, from 290 three
    # (errors 8, 9e-5, 4e-12 lines). The others are a reserve for rough trajectories.
    tu = jax.lax.fori_loop(0, 7, newton, start)
    # Derivatives go around the iteration: at the root F = 0, dx = −(∂F/∂x)⁻¹·dF.
    t, u = implicit_root(_misclosure_near, solve_dense, tu, earth, (image, X))
    return image.times.line(t), u


def _misclosure_near(
    tu: Float[Array, "2"],
    earth: Ellipsoid | None,
    data: tuple[PushbroomImage, Float[AnyArray, "3"]],
) -> Float[Array, "2"]:
    (image, X), (t, u) = data, tu
    return misclosure(image, X, t, u, earth)


def misclosure(
    image: PushbroomImage,
    X: Float[AnyArray, "3"],
    t: Scalar,
    u: Scalar,
    earth: Ellipsoid | None,
) -> Float[Array, "2"]:
    """Slopes of the ray to X at the time t minus those of the pixel u."""
    slopes = image.optics.slopes(u)
    return misclosure_of(pose_at(image, t), slopes, X, image.corrections, earth)


def misclosure_of(
    pose: LinePose,
    slopes: Pair,
    X: Float[AnyArray, "3"],
    corrections: Corrections,
    earth: Ellipsoid | None,
) -> Float[Array, "2"]:
    """Slopes of the ray to X from a pose minus given ones."""
    P, R, V = pose
    r, s, q = rotate_back(R, difference(apparent_point(corrections, earth, P, V, X), P))
    xi, eta = slopes
    return jnp.stack([-r / q - xi, -s / q - eta])


def _map_chunks(
    function: Callable[[tuple[Array, ...]], PyTree[Array]], arrays: tuple[Array, ...], size: int
) -> PyTree[Array]:
    """The function of arrays [n], whose values are [..., n], by chunks."""
    n = arrays[0].shape[0]
    if n <= size:
        return function(arrays)
    chunks = -(-n // size)
    to_chunks = lambda a: jnp.pad(a, (0, chunks * size - n), mode="edge").reshape(chunks, size)
    values = jax.lax.map(function, tuple(to_chunks(a) for a in arrays))
    from_chunks = lambda a: jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1)[..., :n]
    return jax.tree.map(from_chunks, values)


def _find_positions(
    image: ScannerGeometry, search: Search, X: Vector, max_positions: int, margin: float | Array
) -> Projected:
    """The positions of a chunk of points, a triple of arrays.

    With a footprint, Newton's method from its polynomials finds the positions of its points, and
    the others are searched for in batches until none is left.
    """
    if search.footprint is None:
        return _search(image, search, X, max_positions, margin)
    start = search.footprint.start(difference(X, search.pieces.origin))
    t, u, settled = refine(image, search, X, *start)
    # A position is known to be the only one in the image, between the heights, on this side of the
    # Earth; positions in the margin were not tested when the footprint was made.
    is_unique = (
        settled & _is_in_image(image, t, u, 0.0) & search.footprint.contains_height(search.earth, X)
    )
    is_unique &= _is_above_horizon(search, X)
    in_first_place = lambda v: jnp.full((max_positions, v.size), jnp.nan).at[0].set(v)
    count = is_unique.astype(int)
    projected = Projected(
        in_first_place(image.times.line(t)), in_first_place(u), count, jnp.zeros_like(count)
    )

    def search_on(state: tuple[Projected, Array]) -> tuple[Projected, Array]:
        projected, is_done = state
        indices = first_indices(
            ~is_done, min(batch_size(*search.settings.searched_at_once), is_done.size)
        )
        searched = _search(image, search, gather(X, indices), max_positions, margin)
        return scatter(projected, searched, indices), is_done.at[indices].set(True, mode="drop")

    return jax.lax.while_loop(lambda s: ~jnp.all(s[1]), search_on, (projected, is_unique))[0]


def _search(
    image: ScannerGeometry, search: Search, X: Vector, max_positions: int, margin: float | Array
) -> Projected:
    """The positions of arbitrary points."""

    def refine_passage(
        positions: tuple[Array, ...], args: tuple[Array, Array]
    ) -> tuple[tuple[Array, ...], None]:
        line, pixel, number, is_lost = positions
        start, is_present = args
        middle = jnp.zeros_like(start) + (image.pixels - 1) / 2
        t, u, settled = jax.lax.cond(
            jnp.any(is_present),
            lambda: refine(image, search, X, start, middle),
            lambda: (start, start, start != start),
        )
        is_seen = is_present & settled & _is_in_image(image, t, u, margin)
        fills_place = is_seen & (number == jnp.arange(max_positions)[:, None])
        line = jnp.where(fills_place, image.times.line(t), line)
        return (
            line,
            jnp.where(fills_place, u, pixel),
            number + is_seen,
            is_lost | (is_present & ~settled),
        ), None

    def search_on(state: tuple[Array, ...]) -> tuple[Array, ...]:
        *positions, tried_count, _, _, _, _ = state
        starts, count, *where = find_passages(image, search, X, max_positions, margin, tried_count)
        is_wanted = positions[2] < max_positions
        is_present = (count > tried_count + jnp.arange(max_positions)[:, None]) & is_wanted
        # A loop: all passages share one compiled Newton's method.
        positions, _ = jax.lax.scan(refine_passage, tuple(positions), (starts, is_present))
        return (
            *positions,
            jnp.where(is_wanted, tried_count + max_positions, tried_count),
            count,
            *where,
        )

    def is_open(state: tuple[Array, ...]) -> Bool[Array, ""]:
        _, _, number, _, tried_count, count, *_ = state
        return jnp.any((number < max_positions) & (tried_count < count))

    # The first passages may be beside the line of detectors, and later ones in the image: the
    # search goes on after them until the places are full or no passage is left.
    zeros = jnp.zeros(jnp.shape(X[0]), int)
    no_position, all_false = jnp.full((max_positions, zeros.size), jnp.nan), zeros > 0
    state = (
        no_position,
        no_position,
        zeros,
        all_false,
        zeros,
        zeros + 1,
        all_false,
        all_false,
        all_false,
    )
    state = jax.lax.while_loop(is_open, search_on, state)
    line, pixel, number, is_lost, tried_count, count, ahead, behind, hidden = state
    # Passages after the last place were not refined: they may be outside the image.
    number = number + jnp.maximum(count - tried_count, 0)
    # In the order of what explains most: hidden before lost, lost before beside.
    status = jnp.select(
        [number > 0, hidden, is_lost, count > 0, ahead, behind],
        [
            jnp.asarray(int(s))
            for s in (
                ProjectionStatus.SEEN,
                ProjectionStatus.HIDDEN,
                ProjectionStatus.NOT_CONVERGED,
                ProjectionStatus.BESIDE,
                ProjectionStatus.AFTER,
                ProjectionStatus.BEFORE,
            )
        ],
        int(ProjectionStatus.HIDDEN),
    )
    return Projected(line, pixel, number, status)


def _is_in_image(
    image: ScannerGeometry,
    t: Float[AnyArray, " n"],
    u: Float[AnyArray, " n"],
    margin: float | Array,
) -> Bool[AnyArray, "..."]:
    """Whether positions are in the image, or outside by up to `margin` lines and pixels."""
    edge = 0.5 + margin
    first_time, last_time = image.times.time(-edge), image.times.time(image.lines - 1 + edge)
    return (t >= first_time) & (t < last_time) & (u >= -edge) & (u < image.pixels - 1 + edge)


def _is_above_horizon(search: Search, X: Vector) -> bool | Bool[AnyArray, " n"]:
    """Whether the camera is above the horizon of the points at the middle of the image."""
    if search.earth is None:
        return jnp.ones(jnp.shape(X[0]), bool)
    _, _, (P, _) = sample(search.pieces, search.samples[len(search.samples) // 2])
    return dot(normal(search.earth, X), difference(P, X)) > 0
