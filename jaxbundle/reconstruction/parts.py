"""Connected photographs: unconnected parts of a set are reconstructed separately."""

from collections.abc import Sequence

from jaxbundle.tiepoints.verification import Pair

SMALLEST_PART = 3
"""Minimum photographs of a part; two if there are only two in all."""


def group_connected(number: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Groups of photographs connected by verified pairs, the largest first."""
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
    """The reason why a photograph is in no part."""
    mine = [pair for pair in pairs if k in pair.images]
    if mine:
        with_it = sorted({names[j] for pair in mine for j in pair.images if j != k})
        return f"it overlaps only with {', '.join(with_it[:3])}"
    found = [(len(m.rows), m.images) for m in matches if k in m.images]
    most, best = max(found, default=(0, None))
    if best is None or not most:
        return "it has no matches with any other photograph"
    other = names[best[0] if best[1] == k else best[1]]
    return (
        f"it has too few matches with any other photograph: {most} with {other}, but "
        "too few of them agree on one object"
    )
