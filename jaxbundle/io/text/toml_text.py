"""Values as the text of a TOML file."""

import json
import re
from collections.abc import Iterable, Mapping

import numpy as np


def assignments(table: Mapping) -> Iterable[str]:
    """The lines `key = value` of a table."""
    return (f"{_key(key)} = {toml_value(value)}" for key, value in table.items())


def _key(key: str) -> str:
    """A key, in quotes if required."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(str(key))


def toml_value(value) -> str:
    """A text, number, list or inline table, exact to the last digit."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return f"{{ {', '.join(assignments(value))} }}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
