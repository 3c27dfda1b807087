"""Start values of the principal distance and K1 of unknown lenses, from matches.

1. From the coplanarity condition of a few pairs (`interior`).
2. From these, those with which the rotations of many pairs close around three photographs
   (`closing`), if enough pairs do.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbundle.network.tables import Camera
from jaxbundle.orientation import many
from jaxbundle.tiepoints.closing import Interior, Oriented, close_rotations, find_loops
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.interior import CANDIDATES, estimate_interior
from jaxbundle.tiepoints.matching import Matches
from jaxbundle.tiepoints.search import ideal_features, present_size, verify
from jaxbundle.tiepoints.verification import LEAST, SLOTS, SUFFICIENT_MATCHES, Pair

WIDEST_SHARE = 0.6
"""Pairs for the coplanarity condition: those with at least this part of the largest number of
matches, and others with fewer, which have longer bases."""
MOST_ALIKE = 5
"""Minimum number of the former."""
OF_THE_LENS = ("fx", "fy", "k1")
LOOP_PAIRS = 60
"""Number of pairs for closing rotations."""
BELIEVED_RATIO = 1.5
"""Ratio to the principal distance stated by the files above which that of the matches is not
believed: flat objects and nearly parallel views hardly determine it (half of it on a beach),
whereas files are wrong by that much only if a photograph was cropped."""


def start_cameras(
    cameras: Sequence[Camera],
    of: Sequence[int],
    lens: Sequence[int],
    known: Sequence[bool],
    features: Sequence[Features],
    matches: Sequence[Matches],
) -> tuple[list[Camera], list[str]]:
    """Cameras with the principal distance and K1 of consistent pairs of their lens, and notes.

    **Arguments:** `lens` of every camera; `known`: whether its principal distance is stated by the
    files: then it is also the result if that of the matches contradicts it (`BELIEVED_RATIO`).
    """
    better, notes = list(cameras), []
    for number in dict.fromkeys(lens):
        own = [c for c in range(len(cameras)) if lens[c] == number]
        found = [_once(m) for m in matches if {of[k] for k in m.images} <= set(own)]
        first, name, told = cameras[own[0]], cameras[own[0]].id, known[own[0]]
        xy = _centre(cameras, of, features, _choose_pairs(found))
        begin = dataclasses.replace(first, parameters={**first.parameters, "cx": 0.0, "cy": 0.0})
        start = estimate_interior(begin, xy, told)
        better = with_lens(better, own, start.camera)
        if start.pairs:
            middle = first.parameters["fx"] if told else start.camera.parameters["fx"]
            better = _close(better, own, of, features, _choose_loops(found), middle)
            p = better[own[0]].parameters
            said = f"start values from matches: principal distance {p['fx']:.0f} px"
            stated = first.parameters["fx"]
            if told and not 1 / BELIEVED_RATIO < p["fx"] / stated < BELIEVED_RATIO:
                better = with_lens(better, own, _without_distortion(first))
                notes.append(
                    f"camera {name}: {said}, but {stated:.0f} px by the files: that of "
                    "the files is used"
                )
            else:
                notes.append(f"camera {name}: {said}, k1 {p['k1']:.3f}")
        elif not told:
            notes.append(
                f"camera {name}: the principal distance is a guess: no two of its "
                "photographs agree on one"
            )
    return better, notes


def _without_distortion(camera: Camera) -> Camera:
    return dataclasses.replace(camera, parameters={**camera.parameters, "k1": 0.0})


def with_lens(cameras: Sequence[Camera], own: Sequence[int], camera: Camera) -> list[Camera]:
    """The cameras; those at positions `own` with the principal distance and K1 of `camera`."""
    same = {name: camera.parameters[name] for name in OF_THE_LENS if name in camera.parameters}
    with_it = lambda c: dataclasses.replace(c, parameters={**c.parameters, **same})
    return [with_it(c) if k in own else c for k, c in enumerate(cameras)]


def _close(cameras, own, of, features, matches, middle: float) -> list[Camera]:
    """The cameras, a lens with the interior orientation with which rotations close, with a
    principal distance near the `middle`."""
    lens = cameras[own[0]]

    def with_interior(x: Interior) -> list[Camera]:
        f = float(np.exp(x[0]))
        changed = {**lens.parameters, "fx": f, "fy": f, "k1": float(x[1])}
        return with_lens(cameras, own, dataclasses.replace(lens, parameters=changed))

    def orient(x: Interior) -> Oriented:
        pairs = verify(with_interior(x), of, features, matches, lambda *_: None)
        pairs = [_thin(pair) for pair in pairs if pair.kind != "rotation"]
        return Oriented(pairs, _matches_of(pairs, own, of, features, with_interior))

    start = np.array([np.log(lens.parameters["fx"]), lens.parameters["k1"]])
    return with_interior(close_rotations(orient, start, np.log(middle)))


def _thin(pair: Pair) -> Pair:
    return dataclasses.replace(pair, matches=pair.matches[many.spread(len(pair), SLOTS)])


def _matches_of(pairs: Sequence[Pair], own, of, features, with_interior):
    """A function of ln c and K1: the coordinates, c = 1, of the matches of pairs."""
    if not pairs:
        return lambda x: []
    sides = [(k, rows) for p in pairs for k, rows in zip(p.images, p.matches.T)]
    uv = np.concatenate([features[k].xy[rows] for k, rows in sides])
    camera = np.concatenate([np.full(len(rows), of[k]) for k, rows in sides])
    ends = np.cumsum([len(rows) for _, rows in sides])[:-1]

    def ideal(x: Interior):
        xy, cameras = np.empty_like(uv), with_interior(x)
        for c in own:
            xy[camera == c] = ideal_features(cameras[c], uv[camera == c])
        each = np.split(xy, ends)
        return list(zip(each[::2], each[1::2]))

    return ideal


def _once(matches: Matches) -> Matches:
    """The unique matches, if they are enough."""
    use = matches.single
    return matches.take(use) if use.sum() >= SUFFICIENT_MATCHES else matches


def _centre(cameras, of, features, matches):
    """Matches of pairs, relative to the image centres."""
    centred = lambda k: features[k].xy - _middle(cameras[of[k]])
    return [tuple(centred(k)[rows] for k, rows in zip(m.images, m.rows.T)) for m in matches]


def _middle(camera: Camera):
    return (np.array(present_size(camera)) - 1) / 2


def _choose_pairs(own):
    """The pairs with the most matches, and as many others with enough, by photograph in turn."""
    own = sorted(own, key=lambda found: -len(found.rows))
    if not own:
        return []
    most = len(own[0].rows)
    first = [found for found in own if len(found.rows) >= WIDEST_SHARE * most][:MOST_ALIKE]
    enough = [found for found in own if SUFFICIENT_MATCHES <= len(found.rows) < WIDEST_SHARE * most]
    others = CANDIDATES - MOST_ALIKE
    step = max(1, len(enough) // others)
    return first + enough[: others * step : step]


def _choose_loops(own: Sequence[Matches]) -> list[Matches]:
    """The pairs of loops of three photographs, those whose weakest pair has the most matches, each
    next to others."""
    number = {m.images: len(m.rows) for m in own if len(m.rows) >= LEAST}
    loops = find_loops(list(number))
    weakest = np.array(list(number.values()), int)[loops].min(1)
    loops = loops[np.argsort(-weakest, kind="stable")]
    pairs = np.array(list(number)).reshape(-1, 2)
    new, chosen = np.ones(len(loops), bool), np.zeros(len(pairs), bool)
    while new.any() and chosen.sum() < LOOP_PAIRS:
        reached = np.any(np.isin(pairs, pairs[chosen]), axis=1) if chosen.any() else ~chosen
        next_to = new & np.any(reached[loops], axis=1)
        if not next_to.any():
            break
        first = np.argmax(next_to)
        chosen[loops[first]], new[first] = True, False
    return [m for m in own if m.images in set(map(tuple, pairs[chosen].tolist()))]
