"""Prints the oldest versions that pyproject.toml allows, for pip (`make test-oldest`).

A bound such as "jax>=0.10" becomes "jax==0.10".
"""

import re
import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def oldest(requirement: str) -> str:
    """A requirement as a constraint on the oldest version it allows."""
    name, version = re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\d.]+)", requirement).groups()
    return f"{name}=={version}"


if __name__ == "__main__":
    for requirement in PROJECT["dependencies"]:
        print(oldest(requirement))
