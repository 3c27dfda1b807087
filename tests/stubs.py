"""The types of names that packages import on first use: `__init__.pyi` beside the table of names
in their `__init__.py`. `make stubs` writes them; a test compares them with the tables."""

import importlib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(
    ".".join(path.parent.relative_to(ROOT).parts)
    for path in (ROOT / "jaxbundle").rglob("__init__.py")
    if "_HOME = {" in path.read_text()
)
HEAD = "# Written by `make stubs` from the names in __init__.py.\n# ruff: noqa: I001\n"


def path_of(package: str) -> Path:
    return ROOT.joinpath(*package.split("."), "__init__.pyi")


def stub_of(package: str) -> str:
    """The text of a stub: every name, and the subpackages, which are imported on use as well."""
    module = importlib.import_module(package)
    homes = {name: home for home, names in module._HOME.items() for name in names}
    lines = [f"from {home} import {name} as {name}" for name, home in homes.items()]
    rooms = [p.parent.name for p in path_of(package).parent.glob("*/__init__.py")]
    lines += [f"from {package} import {room} as {room}" for room in rooms if room not in homes]
    version = "\n__version__: str\n" if hasattr(module, "__version__") else ""
    names = "".join(f'    "{name}",\n' for name in sorted(homes))
    return f"{HEAD}{chr(10).join(sorted(lines))}\n{version}\n__all__ = [\n{names}]\n"


if __name__ == "__main__":
    for name in PACKAGES:
        path_of(name).write_text(stub_of(name))
