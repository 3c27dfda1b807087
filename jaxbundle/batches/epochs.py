"""Epochs of a rig: which photographs are simultaneous, and which contradict the mounting.

Simultaneous photographs have equal file names, or else equal last numbers in them (left_017.jpg,
right_017.jpg).
"""

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.network.columns import list_some

# Minimum number of epochs shared by two cameras: of two mountings that differ, nothing says which
# is wrong; of three, two agree.
MIN_SHARED_EPOCHS = 3


def contradicting(
    rms: Float[np.ndarray, " epochs"],
    seen: Bool[np.ndarray, " epochs"],
    shared: Bool[np.ndarray, " epochs"],
) -> Int[np.ndarray, " bad"]:
    """Epochs that contradict the mounting; `rms` in pixels, `seen` by any camera, `shared` by
    several."""
    if not shared.any():
        return np.zeros(0, int)
    # An epoch contradicts from three times the median RMS of all, and from a pixel. Larger: small
    # movements between the exposures remain; smaller: epochs of blurred photographs are lost.
    limit = max(3.0 * float(np.median(rms[seen])), 1.0)
    rms = np.where(shared, rms, 0.0)
    # At once only those above half of the worst, which affects the others through the mounting.
    return np.flatnonzero(rms > max(limit, 0.5 * rms.max()))


def epoch_keys(
    names: Mapping[str, tuple[str, ...]], connected: bool = True
) -> dict[str, list[str]]:
    """The epoch of every photograph of every camera: equal file names, or equal last numbers.

    **Arguments:** `connected`: whether every camera must share epochs with the first, if through
    others; otherwise it suffices that any two do.

    **Raises:** `InputError` if neither pairs them.
    """
    whole = lambda name: re.sub(r"\.\w+$", "", name.rsplit("/", 1)[-1])

    def number(name: str) -> str:
        found = re.findall(r"\d+", whole(name))
        return found[-1].lstrip("0") or "0" if found else ""

    # Equal names first: numbers of two cameras may be equal by chance.
    some = None
    for key in (whole, number):
        keys = {camera: [key(name) for name in given] for camera, given in names.items()}
        once = all("" not in k and len({*k}) == len(k) for k in keys.values())
        first, *others = ({*k} for k in keys.values())
        if once and all(
            len(first & other) >= min(MIN_SHARED_EPOCHS, len(first)) for other in others
        ):
            return keys
        if once and len(keys) > 2 and _connected(keys):
            return keys
        if once and some is None and not connected and _any_shared(keys):
            some = keys
    if some is not None:
        return some
    shown = "; ".join(f"{camera}: {list_some(given, 2)}" for camera, given in names.items())
    raise InputError(
        f"the photographs of the cameras cannot be paired by their names ({shown}): name "
        "simultaneous ones alike, or give them the same last number"
    )


def _any_shared(keys: Mapping[str, Sequence[str]]) -> bool:
    """Whether any two cameras share an epoch."""
    each = [{*k} for k in keys.values()]
    return len(set().union(*each)) < sum(map(len, each))


def _connected(keys: Mapping[str, Sequence[str]]) -> bool:
    """Whether every camera shares epochs with the first, directly or through others."""
    sets = {name: {*k} for name, k in keys.items()}
    reached = [next(iter(sets))]
    for name in reached:
        reached += [
            other
            for other in sets
            if other not in reached and len(sets[name] & sets[other]) >= MIN_SHARED_EPOCHS
        ]
    return len(reached) == len(sets)
