"""Help for a misspelt name."""

from collections.abc import Iterable
from difflib import get_close_matches


def closest_name(name: str, known_names: Iterable[str]) -> str | None:
    """The most similar of the known names, whatever their case; None if none is similar."""
    by_folded = {k.casefold(): k for k in known_names}
    matches = get_close_matches(str(name).casefold(), by_folded, n=1)
    return by_folded[matches[0]] if matches else None


def closest(name: str, known_names: Iterable[str]) -> str:
    """`": did you mean 'K1'?"` for the most similar of the known names, or `"."`."""
    similar = closest_name(name, known_names)
    return "." if similar is None else f": did you mean {similar!r}?"
