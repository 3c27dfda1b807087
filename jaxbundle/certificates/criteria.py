"""Acceptance criteria as text: QUANTITY COMPARISON NUMBER [UNIT], such as "sigma(c) < 2 um".

    criterion  = quantity ("<" | "<=" | ">" | ">=") number [unit]
    quantity   = name ["(" argument ")"]
    name       = letters, digits, "_" and ".", such as sigma0, check.rms, LME
    argument   = a parameter, or KIND:ID:NAME, with * for all

Nothing is evaluated: a criterion is four fields of one regular expression.
"""

import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.system.terminals import in_utf8

FORM = "expected QUANTITY < NUMBER UNIT, such as 'sigma(c) < 2 um' or 'sigma0 < 1.2'"
PATTERN = re.compile(
    r"""\s*(?P<name>[A-Za-z][\w.]*)\s*
    (?:\(\s*(?P<argument>[^()]+?)\s*\)\s*)?
    (?P<comparison><=|>=|<|>|≤|≥)\s*
    (?P<limit>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*
    (?P<unit>[^\W\d]\w*|%)?\s*""",
    re.VERBOSE,
)
COMPARISONS = {"<": "<", "<=": "<=", "≤": "<=", ">": ">", ">=": ">=", "≥": ">="}


class Criterion(NamedTuple):
    """A criterion: its text; quantity `name` and `argument` (empty without one); `comparison`,
    one of <, <=, >, >=; `limit` in `unit`."""

    text: str
    name: str
    argument: str
    comparison: str
    limit: float
    unit: str

    @property
    def quantity(self) -> str:
        """The quantity as it was written."""
        return f"{self.name}({self.argument})" if self.argument else self.name

    @property
    def upper(self) -> bool:
        """Whether the limit is an upper one."""
        return self.comparison.startswith("<")

    def holds(self, value: float) -> bool:
        """Whether a value, in the unit of the limit, meets it; a value that is no number does
        not."""
        if math.isnan(value):
            return False
        if self.upper:
            return value <= self.limit if self.comparison == "<=" else value < self.limit
        return value >= self.limit if self.comparison == ">=" else value > self.limit


def read_criterion(text: str) -> Criterion:
    """A criterion from its text.

    **Raises:** `InputError`, with the form that is expected."""
    # Of a locale without UTF-8 a command line has bytes for ≤ and µ.
    text = in_utf8(text) if isinstance(text, str) else text
    match = PATTERN.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise InputError(f"criterion {show(text)}: {FORM}")
    unit = (match["unit"] or "").replace("µ", "u").replace("μ", "u")
    limit = float(match["limit"])
    if not math.isfinite(limit):
        raise InputError(f"criterion {show(text)}: the limit must be a finite number")
    return Criterion(
        " ".join(text.split()),
        match["name"],
        match["argument"] or "",
        COMPARISONS[match["comparison"]],
        limit,
        unit,
    )


def read_criteria(texts: Iterable[str] | str) -> list[Criterion]:
    """Criteria from their texts, one or several.

    **Raises:** `InputError`; also for one that is given twice."""
    texts_given: Sequence[str] = [texts] if isinstance(texts, str) else list(texts)
    criteria = [read_criterion(text) for text in texts_given]
    texts_of = [criterion.text for criterion in criteria]
    for text in texts_of:
        if texts_of.count(text) > 1:
            raise InputError(f"criterion {text!r}: is given twice")
    return criteria
