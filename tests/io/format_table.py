"""What the readers of keyed files know: a table of their keys, from the declarations themselves.

    python tests/io/format_table.py

`used`: keys that a reader uses; `left`: those that it may leave, with a reason in its module;
`warned`: those that it does not read and says so. Every other key is a warning, or refused if its
name may change the geometry. `samples`: small files in the tests, and those of `make mutations`.
"""

import importlib
import pkgutil

from foreign_samples import SAMPLES
from readers import READERS

import jaxbundle.io.cameras
import jaxbundle.io.networks
from jaxbundle.io.formats import CAMERA_KINDS, FORMATS, TARGETS
from jaxbundle.io.text.known_keys import Keys


def declarations() -> dict[str, list[Keys]]:
    """The keys that each module declares."""
    found: dict[str, list[Keys]] = {}
    for package in (jaxbundle.io.networks, jaxbundle.io.cameras):
        for module in pkgutil.iter_modules(package.__path__):
            loaded = importlib.import_module(f"{package.__name__}.{module.name}")
            keys = {id(value): value for value in vars(loaded).values() if isinstance(value, Keys)}
            if keys:
                found[module.name] = list(keys.values())
    return found


def table() -> str:
    """Rows of modules, and the number of inputs and outputs."""
    lines = ["| reader | objects | used | left | warned |", "|---|---|---|---|---|"]
    for name, keys in declarations().items():
        numbers = (len({*(k for one in keys for k in part(one))}) for part in
                   (lambda k: k.used, lambda k: k.left, lambda k: k.warned))  # fmt: skip
        lines.append(f"| {name} | {len(keys)} | {' | '.join(map(str, numbers))} |")
    return "\n".join(
        [
            *lines, "",
            f"{len(FORMATS)} inputs of networks, {len(TARGETS)} outputs of networks, "
            f"{len(CAMERA_KINDS)} of cameras; {len(SAMPLES)} keyed samples, {len(READERS)} readers "
            "with a valid sample that is damaged",
        ]
    )  # fmt: skip


if __name__ == "__main__":
    print(table())
