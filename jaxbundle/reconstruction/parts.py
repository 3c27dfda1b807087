"""Photographs that belong together: parts of a set that nothing connects are made apart."""

from collections.abc import Sequence

from jaxbundle.tiepoints.verification import Pair

SMALLEST = 3
"""Photographs of a part; two where there are no more altogether."""


def connected(number: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Groups of photographs that verified pairs connect, the largest first."""
    root = list(range(number))

    def of(k):
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    for pair in pairs:
        a, b = (of(k) for k in pair.images)
        root[max(a, b)] = min(a, b)
    groups: dict[int, list[int]] = {}
    for k in range(number):
        groups.setdefault(of(k), []).append(k)
    return sorted(groups.values(), key=lambda g: (-len(g), g[0]))


def why_alone(k: int, names: Sequence[str], matches, pairs: Sequence[Pair]) -> str:
    """Why a photograph is in no part, in words."""
    mine = [pair for pair in pairs if k in pair.images]
    if mine:
        with_it = sorted({names[j] for pair in mine for j in pair.images if j != k})
        return f"it shows the same as {', '.join(with_it[:3])} alone, no other photograph does"
    found = [(len(m.rows), m.images) for m in matches if k in m.images]
    most, best = max(found, default=(0, None))
    if best is None or not most:
        return "nothing in it is found in any other photograph"
    other = names[best[0] if best[1] == k else best[1]]
    return (
        f"it shares too little with any other photograph: {most} places look alike in {other}, but "
        "too few of them agree on one object"
    )
