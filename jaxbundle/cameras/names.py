"""Help for a misspelt name."""

from collections.abc import Iterable
from difflib import get_close_matches


def closest(name: str, known: Iterable[str]) -> str:
    """`": did you mean 'K1'?"` for the most similar of the known names, or `"."`."""
    by_folded = {k.casefold(): k for k in known}
    matches = get_close_matches(str(name).casefold(), by_folded, n=1)
    return f": did you mean {by_folded[matches[0]]!r}?" if matches else "."
