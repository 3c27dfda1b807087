"""The layout is the architecture: a module imports only from packages above it in this list."""

import ast
import graphlib
import re
from pathlib import Path

import pytest

LAYERS = (
    "errors",
    "choices",
    "lazy",
    "types",
    "arguments",
    "system",
    "float64",
    "display",
    "results",
    "implicit",
    "geometry",
    "leastsquares",
    "cameras",
    "network",
    "planning",
    "orientation",
    "pushbroom",
    "photographs",
    "measure",
    "refinement",
    "io",
    "surfaces",
    "plotting",
    "report",
    "adjustment",
    "network_design",
    "batches",
    "tiepoints",
    "reconstruction",
    "calibration",
    "certificates",
    "explorer",
    "commands",
    "cli",
    "__main__",
)
PACKAGE = Path(__file__).parent.parent / "jaxbundle"
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")
OPTIONAL = {
    "matplotlib", "pandas", "cv2", "pyproj", "rasterio", "erfa", "sgp4", "ezdxf", "laspy", "plotly",
    "PIL", "pyarrow", "xarray", "anywidget", "traitlets",
}  # fmt: skip
LIGHT = {"geometry", "cameras"}


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path: Path):
    """(module, inside a function) of every import; relative ones made absolute. Those of
    `if TYPE_CHECKING:` are left out: they never run."""
    tree = ast.parse(path.read_text())
    unread = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for statement in block.body
        for node in ast.walk(statement)
    }
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    package = ("jaxbundle", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(tree):
        if id(node) in unread:
            continue
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) in inside
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, node.module or ""))
            file = PACKAGE.parent.joinpath(*module.split("."))
            for alias in node.names:
                whole = (file / f"{alias.name}.py").exists() or module == "jaxbundle"
                yield f"{module}.{alias.name}" if whole else module, id(node) in inside


@pytest.fixture(scope="module")
def imported() -> dict[Path, list[tuple[str, bool]]]:
    return {path: list(imports(path)) for path in FILES}


def refused(imported, wrong) -> list[str]:
    """The imports of which `wrong(path, module, inside)` holds, as lines to read."""
    return [
        f"{path.relative_to(PACKAGE)} imports {module}"
        for path, found in imported.items()
        for module, inside in found
        if wrong(path, module, inside)
    ]


def test_imports_go_up(imported):
    def wrong(path, module, _):
        parts = module.split(".")
        if parts[0] != "jaxbundle" or len(parts) == 1 or parts[1] not in LAYERS:
            return False
        return LAYERS.index(parts[1]) > LAYERS.index(layer_of(path))

    assert refused(imported, wrong) == []


def test_rooms_of_the_engine_go_up(imported):
    """Modules of the engine import only upwards; declarations, spaces, problems and solutions are
    exempt."""
    rooms = ("indexing", "equations", "iterations", "datum", "quality")
    engine = PACKAGE / "leastsquares"
    assert {p.name for p in engine.iterdir() if (p / "__init__.py").exists()} == set(rooms)

    def wrong(path, module, _):
        parts = module.split(".")
        if engine not in path.parents or parts[:2] != ["jaxbundle", "leastsquares"]:
            return False
        of = [room for room in (path.parent.name, *parts[2:3]) if room in rooms]
        return len(of) == 2 and rooms.index(of[1]) > rooms.index(of[0])

    assert refused(imported, wrong) == []


def test_every_room_has_its_place():
    assert {layer_of(path) for path in FILES} == set(LAYERS)


def test_a_class_name_stands_once():
    """A reader who meets it knows what it is."""
    places = {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(path.relative_to(PACKAGE))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_nothing_imports_in_a_circle(imported):
    """Neither at the top nor inside a function."""
    names = {path: ".".join(("jaxbundle", *path.relative_to(PACKAGE).with_suffix("").parts))
             for path in FILES}  # fmt: skip
    needs = {names[path]: {module for module, _ in found} for path, found in imported.items()}
    sorter = graphlib.TopologicalSorter({name: needs[name] & set(needs) for name in needs})
    sorter.prepare()


def test_optional_packages_are_imported_where_needed(imported):
    wrong = lambda _, module, inside: not inside and module.split(".")[0] in OPTIONAL
    assert refused(imported, wrong) == []


def test_no_private_imports(imported):
    def wrong(_, module, __):
        parts = module.split(".")
        private = any(p.startswith("_") and not p.startswith("__") for p in parts)
        return parts[0] != "jaxbundle" and private

    assert refused(imported, wrong) == []


def test_geometry_and_cameras_know_no_solver(imported):
    solvers = {"optimistix", "lineax"}
    wrong = lambda path, module, _: layer_of(path) in LIGHT and module.split(".")[0] in solvers
    assert refused(imported, wrong) == []


def test_the_page_of_the_architecture_names_files_that_are_there():
    root = PACKAGE.parent
    page = (root / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"[\w/]+\.(?:py|md)\b", page))
    there = [f"/{p.relative_to(root)}" for room in ("jaxbundle", "tests", "docs")
             for p in (root / room).rglob("*.*")]  # fmt: skip
    assert len(named) > 30
    assert {name for name in named if not any(path.endswith(f"/{name}") for path in there)} == set()
