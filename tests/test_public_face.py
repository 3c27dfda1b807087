"""Every command is a function of `jaxbundle` of the same name, which takes what the command takes
and returns a result."""

import importlib
import inspect
import json
import re
from pathlib import Path

import pytest
import stubs

import jaxbundle
from jaxbundle import cli

ROOT = Path(__file__).parents[1]
PROJECT = ROOT / "examples" / "convergent4" / "project.toml"
SHELL_ONLY = {"completion"}
"""A script for a shell has no meaning in Python."""
PRESENTATION = {
    "brief", "browser", "csv", "force", "html", "json", "out", "plot", "plots", "quiet", "save",
    "verbose",
    # jaxbundle.accept and jaxbundle.certificate of the result
    "accept", "certificate", "details", "lengths",
    # jaxbundle.io.write_geopackage and write_geojson of the result
    "crs", "gis",
}  # fmt: skip
"""Options about files and screen, for which a result has methods or functions."""


@pytest.mark.parametrize("command", sorted({*cli.COMMANDS} - SHELL_ONLY - {"pushbroom"}))
def test_every_command_is_a_function(command):
    name = command.replace("-", "_")
    function = getattr(jaxbundle, name)
    assert inspect.isfunction(function)
    assert name in jaxbundle.__all__
    assert "return" in inspect.get_annotations(function)


@pytest.mark.parametrize(
    "command",
    ["camera", "cloud", "explore", "orient", "plan", "reconstruct", "stability", "surface"],
)
def test_a_function_takes_the_options_of_its_command(command):
    module = importlib.import_module(f"jaxbundle.cli.{command}")
    called = getattr(module, command, None) or getattr(module, f"{command}_command")
    options = {*inspect.signature(called).parameters} - PRESENTATION
    # the settings of a project have one name in all functions; the rest is about the output
    names = {"set": "overrides", "files": {"camera": "camera"}.get(command, "calibrations"),
             "file": "cloud", "input": "network" if command == "orient" else "input",
             "dsm": "size" if command == "cloud" else "dsm"}  # fmt: skip
    expected = {names.get(name, name) for name in options}
    if command == "reconstruct":
        expected -= {"surface"}  # another function
    assert expected <= {*inspect.signature(getattr(jaxbundle, command)).parameters}


@pytest.mark.parametrize(
    "command", ["info", "locate", "project", "correct", "simulate", "accuracy", "refine", "tie"]
)
def test_every_command_of_line_scanners_is_a_function(command):
    function = getattr(jaxbundle.pushbroom, command)
    assert inspect.isfunction(function)
    assert command in jaxbundle.pushbroom.__all__


@pytest.mark.parametrize("command", ["fit", "apply", "compensate"])
def test_every_command_of_coefficients_is_a_function(command):
    room, module = jaxbundle.pushbroom.rpc, importlib.import_module("jaxbundle.cli.pushbroom.rpc")
    function = getattr(room, command)
    options = {*inspect.signature(getattr(module, command)).parameters} - PRESENTATION
    assert options <= {*inspect.signature(function).parameters}
    assert command in room.__all__


@pytest.mark.further
def test_functions_take_the_path_of_a_network_with_the_settings_of_its_command():
    given = jaxbundle.read_network(PROJECT, overrides=["sigma_image=0.5"])
    for path in (PROJECT, str(PROJECT)):
        found = jaxbundle.adjust(path, overrides=["sigma_image=0.5"])
        assert found.sigma0 == jaxbundle.adjust(given).sigma0
    assert len(jaxbundle.orient(PROJECT).network.images) == 4
    with pytest.raises(jaxbundle.InputError, match="overrides.*of a file"):
        jaxbundle.adjust(given, overrides=["sigma_image=0.5"])
    with pytest.raises(jaxbundle.InputError, match="nowhere.toml: no such file"):
        jaxbundle.orient("nowhere.toml")
    with pytest.raises(jaxbundle.InputError, match="network must be a Network or the path"):
        jaxbundle.adjust(3)


@pytest.mark.parametrize("package", stubs.PACKAGES)
def test_types_for_editors_are_those_of_the_names(package):
    assert stubs.path_of(package).read_text() == stubs.stub_of(package), "run `make stubs`"
    for name in importlib.import_module(package).__all__:
        assert getattr(importlib.import_module(package), name) is not None


def python_of(path):
    """The Python of a page, a notebook or a script."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return text
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        return "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")
    return "\n".join(re.findall(r"^```(?:python|pycon)\n(.*?)^```$", text, re.M | re.S))


def is_public(module, name):
    """Of the `__all__` of a room, or a room or a namespace of functions itself."""
    room = importlib.import_module(module)
    if name == "*" or not name:
        return hasattr(room, "__all__")
    return name in getattr(room, "__all__", ()) or inspect.ismodule(getattr(room, name, None))


USERS = [
    *ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("notebooks/*.ipynb"),
    *ROOT.glob("examples/**/*.py"),
]  # fmt: skip


def test_pages_notebooks_and_examples_use_public_names_only():
    namespaces = {f"jaxbundle.geometry.{name}" for name in ("affine", "ellipsoid", "similarity")}
    private, seen = [], 0
    for path in USERS:
        text = python_of(path)
        imports = re.findall(
            r"^ *(?:>>> )?from (jaxbundle[\w.]*) import (\([^)]*\)|[^\n#]*)", text, re.M
        )
        used = [
            (module, name.split(" as ")[0].strip())
            for module, names in imports
            for name in names.strip("()").split(",")
            if name.strip()
        ]
        used += [
            (f"jaxbundle.{room}", name)
            for room, name in re.findall(r"\bjaxbundle\.([a-z_]+)\.([A-Za-z]\w*)", text)
            if (ROOT / "jaxbundle" / room).is_dir()
        ]
        seen += len(used)
        private += [
            f"{path.name}: {module}.{name}"
            for module, name in used
            if module not in namespaces and not is_public(module, name)
        ]
    assert seen > 50
    assert not private
