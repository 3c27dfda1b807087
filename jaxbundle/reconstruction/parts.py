"""Connected photographs: unconnected parts of a set are reconstructed separately."""

from collections.abc import Sequence

from jaxbundle.tiepoints.matching import FeatureMatches
from jaxbundle.tiepoints.pair_graph import label_connected
from jaxbundle.tiepoints.verification import Pair

# Minimum photographs of a part; two if there are only two in all. Between two alone no loop and no
# point of three rays could contradict wrong matches.
SMALLEST_PART = 3


def group_connected(number: int, pairs: Sequence[Pair]) -> list[list[int]]:
    """Groups of photographs connected by verified pairs, the largest first."""
    groups: dict[int, list[int]] = {}
    for k, label in enumerate(label_connected(number, [pair.images for pair in pairs]).tolist()):
        groups.setdefault(label, []).append(k)
    return sorted(groups.values(), key=lambda g: (-len(g), g[0]))


def why_alone(
    k: int, names: Sequence[str], matches: Sequence[FeatureMatches], pairs: Sequence[Pair]
) -> str:
    """The reason why a photograph is in no part."""
    overlapping = sorted({names[j] for p in pairs if k in p.images for j in p.images if j != k})
    if overlapping:
        return f"it overlaps only with {', '.join(overlapping[:3])}"
    largest_number, best = max(
        ((len(m.rows), m.images) for m in matches if k in m.images), default=(0, None)
    )
    if best is None or not largest_number:
        return "it has no matches with any other photograph"
    partner = names[best[0] if best[1] == k else best[1]]
    return (
        f"it has too few matches with any other photograph: {largest_number} with {partner}, but "
        "too few of them agree on one object"
    )
