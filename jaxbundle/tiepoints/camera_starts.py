"""Start values of the principal distance and K1 of unknown lenses, from matches.

1. From the coplanarity condition of a few pairs (`coplanarity`).
2. From these, those with which the rotations of many pairs close around three photographs
   (`closure`), if enough pairs do.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.network.tables import Camera
from jaxbundle.orientation import batched
from jaxbundle.tiepoints.coplanarity import CoplanaritySettings, estimate_interior
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.interior_from_loops import (
    ClosureSettings,
    Interior,
    OrientedPairs,
    close_rotations,
    find_loops,
)
from jaxbundle.tiepoints.matching import FeatureMatches
from jaxbundle.tiepoints.verification import MATCH_SLOTS, Pair, VerificationSettings
from jaxbundle.tiepoints.verified_pairs import ideal_features, required_image_size, verify


@dataclasses.dataclass(frozen=True)
class CameraStartSettings:
    """Settings of the start values of unknown cameras."""

    min_share: float = 0.6
    """Pairs for the coplanarity condition: those with at least this part of the largest number of
    matches, and others with fewer, which have longer bases."""
    most_alike: int = 5
    """Maximum number of the former among the `coplanarity.candidates`, a third of them: neighbours
    have the most matches, but the narrowest angles."""
    loop_pairs: int = 60
    """Number of pairs for closing rotations: of 12 photographs with all pairs nearly all (66). The
    time of a search grows with it, its σ falls with the root."""
    believed_ratio: float = 1.5
    """Ratio to the principal distance stated by the files above which that of the matches is not
    believed: flat objects and nearly parallel views hardly determine it (on a beach, matches gave
    half of it), whereas files are wrong by that much only if a photograph was cropped."""
    coplanarity: CoplanaritySettings = CoplanaritySettings()
    closure: ClosureSettings = ClosureSettings()


def start_cameras(
    cameras: Sequence[Camera],
    camera_of: Sequence[int],
    lens: Sequence[int],
    is_stated: Sequence[bool],
    features: Sequence[Features],
    matches: Sequence[FeatureMatches],
    settings: CameraStartSettings = CameraStartSettings(),
    verification: VerificationSettings | None = None,
) -> tuple[list[Camera], list[str]]:
    """Cameras with the principal distance and K1 of consistent pairs of their lens, and notes.

    **Arguments:** `camera_of`: the camera of every photograph; `lens` of every camera; `is_stated`:
    whether its principal distance is stated by the files: then it is also the result if that of the
    matches contradicts it (`CameraStartSettings.believed_ratio`).
    """
    verification = verification or VerificationSettings()
    better, notes, sufficient = list(cameras), [], verification.sufficient_matches
    # Relative to the image centres, which are taken as principal points.
    size = lambda k: np.array(required_image_size(cameras[camera_of[k]]))
    centred = lambda k: features[k].xy - (size(k) - 1) / 2
    for number in dict.fromkeys(lens):
        cameras_of_lens = [c for c in range(len(cameras)) if lens[c] == number]
        # The unique matches, if they are enough.
        pairs = [
            m.take(m.unique) if m.unique.sum() >= sufficient else m
            for m in matches
            if {camera_of[k] for k in m.images} <= {*cameras_of_lens}
        ]
        first_camera, name, has_stated = (
            cameras[cameras_of_lens[0]],
            cameras[cameras_of_lens[0]].id,
            is_stated[cameras_of_lens[0]],
        )
        xy = [
            tuple(centred(k)[rows] for k, rows in zip(m.images, m.rows.T))
            for m in _choose_pairs(pairs, settings, sufficient)
        ]
        begin = dataclasses.replace(
            first_camera, parameters={**first_camera.parameters, "cx": 0.0, "cy": 0.0}
        )
        start = estimate_interior(begin, xy, has_stated, settings.coplanarity)
        better = with_lens(better, cameras_of_lens, start.camera)
        if start.pairs:
            prior = first_camera.parameters["fx"] if has_stated else start.camera.parameters["fx"]
            chosen_pairs = _choose_loops(pairs, settings.loop_pairs, verification.min_matches)
            search = np.log(prior), settings.closure, verification
            better = _close(better, cameras_of_lens, camera_of, features, chosen_pairs, *search)
            p = better[cameras_of_lens[0]].parameters
            message = f"start values from matches: principal distance {p['fx']:.0f} px"
            stated_distance, ratio = first_camera.parameters["fx"], settings.believed_ratio
            if has_stated and not 1 / ratio < p["fx"] / stated_distance < ratio:
                plain = dataclasses.replace(
                    first_camera, parameters={**first_camera.parameters, "k1": 0.0}
                )
                better = with_lens(better, cameras_of_lens, plain)
                notes.append(
                    f"camera {name!r}: {message}, but {stated_distance:.0f} px by the files: that "
                    "of the files is used"
                )
            else:
                notes.append(f"camera {name!r}: {message}, k1 {p['k1']:.3f}")
        elif not has_stated:
            notes.append(
                f"camera {name!r}: the principal distance is a guess: no two of its "
                "photographs agree on one"
            )
    return better, notes


def with_lens(cameras: Sequence[Camera], positions: Sequence[int], camera: Camera) -> list[Camera]:
    """The cameras; those at `positions` with the principal distance and K1 of `camera`."""
    names = [name for name in ("fx", "fy", "k1") if name in camera.parameters]
    lens_parameters = {name: camera.parameters[name] for name in names}
    with_same = lambda c: dataclasses.replace(c, parameters={**c.parameters, **lens_parameters})
    return [with_same(c) if k in positions else c for k, c in enumerate(cameras)]


def _close(
    cameras: Sequence[Camera],
    cameras_of_lens: Sequence[int],
    camera_of: Sequence[int],
    features: Sequence[Features],
    matches: Sequence[FeatureMatches],
    middle: float,
    settings: ClosureSettings,
    verification: VerificationSettings,
) -> list[Camera]:
    """The cameras, those at positions `cameras_of_lens` with the interior orientation with which
    rotations close; `middle`: ln c before."""
    lens = cameras[cameras_of_lens[0]]

    def with_interior(x: Interior) -> list[Camera]:
        f = float(np.exp(x[0]))
        changed = {**lens.parameters, "fx": f, "fy": f, "k1": float(x[1])}
        return with_lens(cameras, cameras_of_lens, dataclasses.replace(lens, parameters=changed))

    def orient(x: Interior) -> OrientedPairs:
        quiet = lambda *_: None
        pairs = verify(with_interior(x), camera_of, features, matches, quiet, verification)
        # Only the matches that refine a rotation in every evaluation of the search.
        pairs = [
            dataclasses.replace(
                pair, matches=pair.matches[batched.evenly_spaced(len(pair), MATCH_SLOTS)]
            )
            for pair in pairs
            if pair.kind != "rotation"
        ]
        return OrientedPairs(
            pairs, _ideal_matches(pairs, cameras_of_lens, camera_of, features, with_interior)
        )

    start = np.array([np.log(lens.parameters["fx"]), lens.parameters["k1"]])
    return with_interior(close_rotations(orient, start, middle, settings))


def _ideal_matches(
    pairs: Sequence[Pair],
    cameras_of_lens: Sequence[int],
    camera_of: Sequence[int],
    features: Sequence[Features],
    with_interior: Callable[[Interior], list[Camera]],
) -> Callable[[Interior], list[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]]]:
    """A function of ln c and K1: the coordinates, c = 1, of the matches of pairs."""
    if not pairs:
        return lambda _: []
    sides = [(k, rows) for p in pairs for k, rows in zip(p.images, p.matches.T)]
    uv = np.concatenate([features[k].xy[rows] for k, rows in sides])
    camera = np.concatenate([np.full(len(rows), camera_of[k]) for k, rows in sides])
    ends = np.cumsum([len(rows) for _, rows in sides])[:-1]

    # One call for each camera instead of two for each pair.
    def ideal_with(x: Interior) -> list[tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]]:
        xy, cameras = np.empty_like(uv), with_interior(x)
        for c in cameras_of_lens:
            xy[camera == c] = ideal_features(cameras[c], uv[camera == c])
        by_side = np.split(xy, ends)
        return list(zip(by_side[::2], by_side[1::2]))

    return ideal_with


def _choose_pairs(
    pairs: Sequence[FeatureMatches], settings: CameraStartSettings, sufficient: int
) -> list[FeatureMatches]:
    """The pairs with the most matches, and others with enough, spread over their numbers."""
    pairs = sorted(pairs, key=lambda m: -len(m.rows))
    if not pairs:
        return []
    many_matches = settings.min_share * len(pairs[0].rows)
    most_alike = [m for m in pairs if len(m.rows) >= many_matches][: settings.most_alike]
    other_pairs = [m for m in pairs if sufficient <= len(m.rows) < many_matches]
    number = settings.coplanarity.candidates - settings.most_alike
    step = max(1, len(other_pairs) // number)
    return most_alike + other_pairs[: number * step : step]


def _choose_loops(
    pairs_of_lens: Sequence[FeatureMatches], max_pairs: int, min_matches: int
) -> list[FeatureMatches]:
    """The pairs of loops of three photographs, those whose weakest pair has the most matches, each
    next to others."""
    number = {m.images: len(m.rows) for m in pairs_of_lens if len(m.rows) >= min_matches}
    loops = find_loops(list(number))
    weakest = np.array(list(number.values()), int)[loops].min(1)
    loops = loops[np.argsort(-weakest, kind="stable")]
    pairs = np.array(list(number)).reshape(-1, 2)
    new, is_chosen = np.ones(len(loops), bool), np.zeros(len(pairs), bool)
    # Each loop has at least a photograph in common with chosen ones, so that they can share pairs:
    # k loops of k + 2 photographs with 2k + 1 pairs are independent, those apart need 3k pairs. To
    # demand a common pair chose the same 60 pairs of three rendered sets of 24 photographs.
    while is_chosen.sum() < max_pairs:
        is_reached = (
            np.any(np.isin(pairs, pairs[is_chosen]), axis=1) if is_chosen.any() else ~is_chosen
        )
        next_to = new & np.any(is_reached[loops], axis=1)
        if not next_to.any():
            break
        first_loop = np.argmax(next_to)
        is_chosen[loops[first_loop]], new[first_loop] = True, False
    return [m for m in pairs_of_lens if m.images in set(map(tuple, pairs[is_chosen].tolist()))]
