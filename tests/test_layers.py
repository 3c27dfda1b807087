"""The layout is the architecture: a module imports only from packages above it in this list."""

import ast
import re
from pathlib import Path

import pytest

LAYERS = (
    "errors",
    "types",
    "file_content",
    "arguments",
    "temporaries",
    "interrupts",
    "float64",
    "configuration",
    "implicit",
    "geometry",
    "leastsquares",
    "cameras",
    "network",
    "planning",
    "orientation",
    "pushbroom",
    "measure",
    "adjustment",
    "statistics",
    "refinement",
    "io",
    "gradients",
    "plotting",
    "report",
    "result_tables",
    "result",
    "solution",
    "far_points",
    "oriented",
    "repeated",
    "bundle",
    "calibration",
    "batches",
    "targets",
    "cli",
    "__main__",
)
PACKAGE = Path(__file__).parent.parent / "jaxbundle"
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")
OPTIONAL = {
    "matplotlib", "pandas", "cv2", "pyproj", "rasterio", "erfa", "sgp4", "ezdxf", "laspy", "plotly",
}  # fmt: skip
LIGHT = {"geometry", "cameras"}


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path: Path):
    """(module, inside a function) of every import; relative ones made absolute."""
    tree = ast.parse(path.read_text())
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    package = ("jaxbundle", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) in inside
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, node.module or ""))
            if module.strip(".") == "jaxbundle":
                for alias in node.names:
                    yield f"jaxbundle.{alias.name}", id(node) in inside
            else:
                yield module, id(node) in inside


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_up(path):
    own = LAYERS.index(layer_of(path))
    for module, _ in imports(path):
        parts = module.split(".")
        if parts[0] == "jaxbundle" and len(parts) > 1 and parts[1] in LAYERS:
            assert LAYERS.index(parts[1]) <= own, f"{path} imports {module}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_optional_packages_are_imported_where_needed(path):
    for module, inside in imports(path):
        assert inside or module.split(".")[0] not in OPTIONAL, f"{path} imports {module} at the top"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_private_imports(path):
    for module, _ in imports(path):
        parts = module.split(".")
        outside = parts[0] != "jaxbundle"
        private = any(p.startswith("_") and not p.startswith("__") for p in parts)
        assert not (outside and private), f"{path} imports {module}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_geometry_and_cameras_know_no_solver(path):
    if layer_of(path) in LIGHT:
        for module, _ in imports(path):
            assert module.split(".")[0] not in {"optimistix", "lineax"}, f"{path} imports {module}"


def test_the_page_of_the_architecture_names_files_that_are_there():
    root = PACKAGE.parent
    page = (root / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"[\w/]+\.(?:py|md)\b", page))
    there = [f"/{p.relative_to(root)}" for room in ("jaxbundle", "tests", "docs")
             for p in (root / room).rglob("*.*")]  # fmt: skip
    assert len(named) > 30
    assert {name for name in named if not any(path.endswith(f"/{name}") for path in there)} == set()
