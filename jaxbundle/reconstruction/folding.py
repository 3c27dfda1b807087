"""Results in which different parts of an object that repeats itself are superimposed.

1. Most measurements agree with a right result.
2. Two photographs from nearly one direction share most points in the field of both. Superimposed
   parts share at most those that repeat themselves (Zach, Irschara and Bischof 2008, What can
   missing correspondences tell us about 3D structure and motion?). A blurred photograph lacks most
   points of its neighbours, but they have its own: a pair contradicts a result only if this is so
   in neither direction.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera, Network
from jaxbundle.orientation import batched
from jaxbundle.reconstruction.adjusting import WeightedAdjustment
from jaxbundle.tiepoints.track_measurement import Measurements
from jaxbundle.tiepoints.verified_pairs import ideal_features, required_image_size


@dataclasses.dataclass(frozen=True)
class SuperpositionSettings:
    """Settings of the search for superimposed parts of an object."""

    min_agreeing: float = 1 / 3
    """Minimum share of measurements that agree with a result. Smaller: folded results,
    with which the measurements of one layer agree, pass; larger: right ones of objects that move or
    repeat themselves in part are refused."""
    max_angle: float = np.radians(15.0)
    """Maximum angle between the rays to a point with which it is expected in both photographs,
    radians: SIFT still finds most features. Larger: points that cannot be found count as missing;
    smaller: fewer pairs can be compared."""
    max_scale: float = 1.5
    """Maximum ratio of the lengths of these rays: half an octave of SIFT."""
    min_points: int = 50
    """Minimum expected points of a pair, both directions together: a tenth of them are five; if
    every second one is found again in a right pair, fewer than five are found with a probability of
    2e-10."""
    min_of_each: int = 10
    """Minimum expected points of each photograph in the other one: a tenth of them is one; if every
    second one is found again in a right pair, none is found with a probability of 1e-3."""
    min_shared: float = 0.1
    """Share of the expected points below which a pair is contradictory. Superimposed parts that
    repeat themselves share some points; right pairs share most, blurred ones less."""
    max_pairs: int = 3
    """Number of contradictory pairs from which a result is refused: one photograph with something
    close in front of it may cause one or two."""
    max_pair_share: float = 0.15
    """The same as a share of all pairs that can be compared, whichever is more: in a facade that is
    folded (`chain` of the benchmarks) 17 of 24 are."""


def refuse_folded(
    weighted: WeightedAdjustment,
    measured: Measurements,
    names: Sequence[str],
    settings: SuperpositionSettings = SuperpositionSettings(),
) -> None:
    """Refuse a result that disagrees with most measurements in its photographs, of those that
    could take part."""
    placed = set(weighted.adjustment.network.images.id)
    rows = np.isin(measured.image, [k for k, name in enumerate(names) if name in placed])
    rays = np.bincount(measured.track[rows])
    number = int(rays[rays > 1].sum()) - weighted.unused_features
    if weighted.agreeing_rays < settings.min_agreeing * number:
        raise _folded(
            f"only {weighted.agreeing_rays} of {number} measurements in "
            f"{count(len(placed), 'photograph')} agree with one object",
            names,
        )


def refuse_superimposed(
    result: Adjustment,
    measured: Network,
    matched_pairs: set[tuple[int, int]],
    names: Sequence[str],
    settings: SuperpositionSettings = SuperpositionSettings(),
) -> list[str]:
    """Pairs of photographs that contradict a result, as notes.

    **Arguments:** `measured`: the network with all measurements; `matched_pairs`: by the
    positions of their photographs in `names`.

    **Raises:** `NotSolvedError` if there are many of them.
    """
    expected, shared = count_shared_points(result, measured, settings)
    row = {name: k for k, name in enumerate(names)}
    place = [row[id] for id in result.network.images.id]
    compared, contradictory = 0, []
    number, common = expected + expected.T, shared + shared.T
    clear = (number >= settings.min_points) & (
        np.minimum(expected, expected.T) >= settings.min_of_each
    )
    shares_few = shared < settings.min_shared * expected
    for i, j in np.argwhere(np.triu(clear, 1)).tolist():
        if (min(place[i], place[j]), max(place[i], place[j])) in matched_pairs:
            compared += 1
            # In one direction only: a blurred photograph, which lacks the points of the other.
            if shares_few[i, j] and shares_few[j, i]:
                contradictory.append((i, j))
    contradictory.sort(key=lambda pair: -number[pair])
    sentences = [
        f"{common[i, j]} of {number[i, j]} points expected in both {names[place[i]]} and "
        f"{names[place[j]]} were found"
        for i, j in contradictory
    ]
    bad = len(contradictory)
    if bad >= max(settings.max_pairs, settings.max_pair_share * compared):
        raise _folded(f"{sentences[0]}, and too few in {bad} of {compared} such pairs", names)
    return [
        f"{words}: something hides them, or parts of the object are superimposed"
        for words in sentences[:5]
    ]


def count_shared_points(
    result: Adjustment,
    measured: Network,
    settings: SuperpositionSettings = SuperpositionSettings(),
) -> tuple[Int[np.ndarray, "images images"], Int[np.ndarray, "images images"]]:
    """The points of every photograph (rows) that should also be in every other one (columns), and
    those of them that are measured there."""
    network, values = result.network, result.image_values
    X0, M = values[:, :3], np.asarray(batched.matrices(values[:, 3:]))
    X = np.asarray(result.point_values)
    is_known = np.all(np.isfinite(X), axis=1)
    is_used = result.problem.used & is_known[result.problem.point]
    n = len(X0)
    agreeing = _points_of_images(n, result.problem.image[is_used], result.problem.point[is_used])
    measured_points = _points_of_images(n, *_measured_rays(network, measured))
    to_points = [X[points] - X0[i] for i, points in enumerate(agreeing)]
    distances = [np.linalg.norm(d, axis=1) for d in to_points]
    farthest = np.array([lengths.max(initial=0.0) for lengths in distances])
    fields = [
        _field_of_view(dataclasses.replace(c, parameters=result.camera_parameters(c.id)))
        for c in network.cameras
    ]
    expected, shared = np.zeros((2, n, n), int)
    for j in range(n):
        # Measured counts, even if it was removed as a gross error: what is missing was not found.
        is_measured = np.zeros(len(X), bool)
        is_measured[agreeing[j]] = is_measured[measured_points[j]] = True
        # Within both limits the base is shorter than the rays: others have no expected points.
        is_near = np.linalg.norm(X0 - X0[j], axis=1) < farthest
        for i in np.flatnonzero(is_near & (np.arange(n) != j)):
            d = X[agreeing[i]] - X0[j]
            length = np.linalg.norm(d, axis=1)
            cosine = (d * to_points[i]).sum(1) / (length * distances[i])
            is_alike = cosine > np.cos(settings.max_angle)
            is_alike &= (length < settings.max_scale * distances[i]) & (
                distances[i] < settings.max_scale * length
            )
            is_alike &= _is_in_field(d @ M[j].T, fields[network.images.camera[j]])
            expected[i, j], shared[i, j] = is_alike.sum(), is_measured[agreeing[i][is_alike]].sum()
    return expected, shared


def _points_of_images(
    number: int, image: Int[np.ndarray, " rays"], point: Int[np.ndarray, " rays"]
) -> list[Int[np.ndarray, " _"]]:
    """The points of every image."""
    order = np.argsort(image, kind="stable")
    return np.split(point[order], np.searchsorted(image[order], np.arange(1, number)))


def _measured_rays(
    network: Network, measured: Network
) -> tuple[Int[np.ndarray, " rays"], Int[np.ndarray, " rays"]]:
    """Image and point, in the network, of the measurements that belong to both."""
    image = {id: k for k, id in enumerate(network.images.id)}
    point = {id: k for k, id in enumerate(network.points.id)}
    images = np.array([image.get(id, -1) for id in measured.images.id])
    points = np.array([point.get(id, -1) for id in measured.points.id])
    i, p = images[measured.observations.image], points[measured.observations.point]
    is_in_both = (i >= 0) & (p >= 0)
    return i[is_in_both], p[is_in_both]


def _field_of_view(camera: Camera) -> Float[np.ndarray, "2 2"]:
    """Limits of x and y, c = 1, of the middle of each side: the corners of a lens with distortion
    reach farther, which costs a few points."""
    columns, rows = required_image_size(camera)
    u, v = (columns - 1) / 2, (rows - 1) / 2
    ideal = ideal_features(camera, np.array([[0, v], [2 * u, v], [u, 0], [u, 2 * v]]))
    return np.stack([ideal.min(0), ideal.max(0)])


def _is_in_field(
    d: Float[np.ndarray, "n 3"], field: Float[np.ndarray, "2 2"]
) -> Bool[np.ndarray, " n"]:
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = -d[:, :2] / d[:, 2:]
        return (d[:, 2] < 0) & ((xy > field[0]) & (xy < field[1])).all(1)


def _folded(finding: str, names: Sequence[str]) -> NotSolvedError:
    return NotSolvedError(
        f"not solved: {finding}: the object repeats itself, and parts of it would be superimposed; "
        "take photographs with shorter bases, or leave out those that show only repeated parts",
        list(names),
    )
