"""Values as the text of a TOML file."""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np


def assignments(table: Mapping) -> Iterable[str]:
    """The lines `key = value` of a table."""
    is_bare_key = lambda key: re.fullmatch(r"[A-Za-z0-9_-]+", key)  # other keys need quotes
    return (
        f"{key if is_bare_key(key) else toml_value(str(key))} = {toml_value(value)}"
        for key, value in table.items()
    )


def toml_value(value: Any) -> str:
    """A text, number, list or inline table, exact to the last digit."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool | str):
        # A basic string of TOML is one of JSON, but for DEL, which TOML does not allow.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return f"{{ {', '.join(assignments(value))} }}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
