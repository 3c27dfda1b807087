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
    is_seen: Bool[np.ndarray, " epochs"],
    shared: Bool[np.ndarray, " epochs"],
) -> Int[np.ndarray, " bad"]:
    """Epochs that contradict the mounting; `rms` in pixels, `is_seen` by any camera, `shared` by
    several."""
    if not shared.any():
        return np.zeros(0, int)
    # An epoch contradicts from three times the median RMS of all, and from a pixel. Larger: small
    # movements between the exposures remain; smaller: epochs of blurred photographs are lost.
    limit = max(3.0 * float(np.median(rms[is_seen])), 1.0)
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
    without_suffix = lambda name: re.sub(r"\.\w+$", "", name.rsplit("/", 1)[-1])

    def number(name: str) -> str:
        numbers = re.findall(r"\d+", without_suffix(name))
        return numbers[-1].lstrip("0") or "0" if numbers else ""

    # Equal names first: numbers of two cameras may be equal by chance.
    fallback = None
    for key in (without_suffix, number):
        keys = {
            camera: [key(name) for name in names_of_camera]
            for camera, names_of_camera in names.items()
        }
        are_unique = all("" not in k and len({*k}) == len(k) for k in keys.values())
        keys_of_first, *keys_of_others = ({*k} for k in keys.values())
        if are_unique and all(
            len(keys_of_first & keys_of_other) >= min(MIN_SHARED_EPOCHS, len(keys_of_first))
            for keys_of_other in keys_of_others
        ):
            return keys
        if are_unique and len(keys) > 2 and _connected(keys):
            return keys
        if are_unique and fallback is None and not connected and _any_shared(keys):
            fallback = keys
    if fallback is not None:
        return fallback
    names_in_words = "; ".join(
        f"{camera}: {list_some(names_of_camera, 2)}" for camera, names_of_camera in names.items()
    )
    raise InputError(
        f"the photographs of the cameras cannot be paired by their names ({names_in_words}): name "
        "simultaneous ones alike, or give them the same last number"
    )


def _any_shared(keys: Mapping[str, Sequence[str]]) -> bool:
    """Whether any two cameras share an epoch."""
    keys_of_each = [{*k} for k in keys.values()]
    return len(set().union(*keys_of_each)) < sum(map(len, keys_of_each))


def _connected(keys: Mapping[str, Sequence[str]]) -> bool:
    """Whether every camera shares epochs with the first, directly or through others."""
    sets = {name: {*k} for name, k in keys.items()}
    reached = [next(iter(sets))]
    for name in reached:
        reached += [
            other_camera
            for other_camera in sets
            if other_camera not in reached
            and len(sets[name] & sets[other_camera]) >= MIN_SHARED_EPOCHS
        ]
    return len(reached) == len(sets)
