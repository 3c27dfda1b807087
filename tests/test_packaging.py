"""Contents of the distribution: licence, metadata, types, and extras that are used."""

import hashlib
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from jaxbundle import __version__
from jaxbundle.errors import InputError
from jaxbundle.system.examples import EXAMPLES, write_example

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
APACHE = "cfc7749b96f63bd31c3c42b5c471bf756814053e847c10f3eb003417bc523d30"
"""SHA-256 of LICENSE-2.0.txt as the Apache Software Foundation publishes it."""
MODULES = {"pillow": "PIL", "opencv-python-headless": "cv2", "pyerfa": "erfa"}
"""Distributions whose module has another name."""


def test_licence_authors_and_addresses_are_told():
    assert PROJECT["license"] == "Apache-2.0"
    (name,) = PROJECT["license-files"]
    assert hashlib.sha256((ROOT / name).read_bytes()).hexdigest() == APACHE
    assert all(author["name"] for author in PROJECT["authors"])
    assert {"Source", "Issues"} <= {*PROJECT["urls"]}
    assert all(url.startswith("https://") for url in PROJECT["urls"].values())


def test_the_version_stands_in_one_place_and_the_others_follow():
    assert PROJECT["dynamic"] == ["version"] and "version" not in PROJECT
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {__version__}\n" in (ROOT / "CHANGELOG.md").read_text()


ROOMS = """
import pkgutil, jaxbundle
rooms = [found.name for found in pkgutil.iter_modules(jaxbundle.__path__) if found.ispkg]
assert {*rooms} <= {*dir(jaxbundle)}
print(*(getattr(jaxbundle, room).__name__ for room in rooms))
try:
    jaxbundle.leastsquare
except AttributeError as error:
    print(error)
"""


def test_subpackages_are_attributes_of_the_package():
    """Of a process that has imported nothing but the package."""
    found = subprocess.run([sys.executable, "-c", ROOMS], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    rooms, message = found.stdout.splitlines()
    assert {"jaxbundle.io", "jaxbundle.leastsquares", "jaxbundle.surfaces"} <= {*rooms.split()}
    assert message == "module 'jaxbundle' has no attribute 'leastsquare'"


def test_type_checkers_are_told_of_the_annotations():
    assert (ROOT / "jaxbundle" / "py.typed").is_file()


def test_packages_of_extras_are_imported():
    used = set()
    for path in (ROOT / "jaxbundle").rglob("*.py"):
        used |= {*re.findall(r"^\s*(?:import|from) (\w+)", path.read_text(), re.MULTILINE)}
    for extra in ("plots", "tables", "images", "geo", "files"):
        for requirement in PROJECT["optional-dependencies"][extra]:
            package = re.match(r"[\w-]+", requirement)[0]
            assert MODULES.get(package, package) in used, f"{package} is imported nowhere"


# --- examples -------------------------------------------------------------------------------


def test_the_wheel_takes_the_examples_from_where_they_are():
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    taken = build["targets"]["wheel"]["force-include"]
    assert taken == {f"examples/{name}": f"jaxbundle/examples/{name}" for name in EXAMPLES}
    assert not (ROOT / "jaxbundle" / "examples").exists()


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_written_whole(command, tmp_path, name):
    told = command("example", name, tmp_path / name)
    assert told.status == 0 and f"jaxbundle {EXAMPLES[name].command.split()[1]}" in told.out
    files = lambda folder: {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    assert files(tmp_path / name) == files(ROOT / "examples" / name)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_examples_are_listed_and_only_new_folders_written(command, tmp_path):
    assert all(name in command("example").out for name in EXAMPLES)
    assert command("example", "convergent4").status == 2
    (tmp_path / "empty").mkdir()
    write_example("line_scanner", tmp_path / "empty")
    for folder, why in (("empty", "is not empty"), ("empty/flight.toml", "is no folder"),
                        ("none/new", "there is no folder")):  # fmt: skip
        with pytest.raises(InputError, match=why):
            write_example("convergent4", tmp_path / folder)
    with pytest.raises(InputError, match="no example 'four'.*convergent4"):
        write_example("four", tmp_path / "four")
    assert not (tmp_path / "four").exists()


def test_the_demo_installs_what_it_needs_alone(tmp_path):
    """And the tests what they need; nothing where `make install` has been."""
    make = shutil.which("make")
    if make is None:
        pytest.skip("make is missing")
    call = lambda target: subprocess.run(
        [make, "-n", target, f"VENV={tmp_path}"], cwd=ROOT, capture_output=True, text=True,
        check=True,
    ).stdout  # fmt: skip
    demo, whole = call("demo"), call("install")
    assert ".[plots,tables]" in demo and ".[tests]" not in demo and "echo \"Installing" in demo
    assert ".[tests]" in whole and "echo \"Installing" in whole
    (tmp_path / "installed").touch()
    assert "-m pip install" not in subprocess.run(
        [make, "install-demo", f"VENV={tmp_path}"], cwd=ROOT, capture_output=True, text=True,
        check=True,
    ).stdout  # fmt: skip
