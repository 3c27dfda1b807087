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
BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]
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


# --- workflows, recipe, images --------------------------------------------------------------


def test_addresses_are_in_one_place():
    """To be set at publication in pyproject.toml; the recipe takes them from there."""
    hosts = {re.match(r"https://[^/]+", url)[0] for url in PROJECT["urls"].values()}
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no repository")
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if name == "pyproject.toml" or not path.is_file():
            continue
        content = path.read_bytes()
        for host in hosts:
            assert host.encode() not in content, name


def test_workflows_are_valid_and_test_every_python():
    import yaml

    pythons = set()
    for path in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert document["permissions"] == {"contents": "read"}, path
        assert True in document or "on" in document  # YAML 1.1 reads "on" as a truth
        for name, job in document["jobs"].items():
            assert job["steps"] and job["runs-on"], (path.name, name)
            for need in [job["needs"]] if isinstance(job.get("needs"), str) else []:
                assert need in document["jobs"]
            for step in job["steps"]:
                assert ("run" in step) != ("uses" in step), (path.name, step)
                assert "@" in step.get("uses", "@")
            pythons |= {*job.get("strategy", {}).get("matrix", {}).get("python", [])}
    first = int(PROJECT["requires-python"].removeprefix(">=3."))
    assert pythons == {f"3.{minor}" for minor in range(first, 15)}


def test_workflows_run_tests_that_are_there():
    text = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    named = re.findall(r"\btests/[\w/.]+", text)
    assert len(named) > 10 and all((ROOT / name).exists() for name in named)
    extras = {word for group in re.findall(r'"\.\[([\w,]+)\]"', text) for word in group.split(",")}
    assert extras <= {*PROJECT["optional-dependencies"]}


def rendered_recipe() -> dict:
    """The conda recipe as conda-build's templates give it (functions load_file_data,
    load_file_regex)."""
    import jinja2
    import yaml

    folder = ROOT / "packaging" / "conda"

    def load_file_data(name, from_recipe_dir):
        assert from_recipe_dir
        return tomllib.loads((folder / name).read_text(encoding="utf-8"))

    def load_file_regex(load_file, regex_pattern, from_recipe_dir):
        assert from_recipe_dir
        return re.search(regex_pattern, (folder / load_file).read_text(encoding="utf-8"))

    text = (folder / "meta.yaml").read_text(encoding="utf-8")
    template = jinja2.Environment().from_string(text)
    return yaml.safe_load(
        template.render(
            load_file_data=load_file_data, load_file_regex=load_file_regex, PYTHON="python"
        )
    )


def test_the_recipe_of_conda_is_pyproject_toml():
    recipe = rendered_recipe()
    assert recipe["package"] == {"name": PROJECT["name"], "version": __version__}
    run = recipe["requirements"]["run"]
    assert run[0] == f"python {PROJECT['requires-python']}"
    # conda-forge has flatbuffers as that of another language
    of_conda = {"flatbuffers": "python-flatbuffers"}
    wanted = [re.fullmatch(r"([\w.-]+)(>=[\d.]+)", one) for one in PROJECT["dependencies"]]
    assert run[1:] == [f"{of_conda.get(name, name)} {least}" for name, least in
                       (one.groups() for one in wanted)]  # fmt: skip
    assert recipe["requirements"]["host"] == [run[0], "pip", *BUILD["requires"]]
    assert recipe["build"]["entry_points"] == ["jaxbundle = jaxbundle.__main__:main"]
    assert recipe["about"]["dev_url"] == PROJECT["urls"]["Source"]
    assert (ROOT / recipe["about"]["license_file"]).is_file()
    assert recipe["build"]["script"].startswith("python -m pip install . --no-deps")


@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.cuda"])
def test_images_take_what_the_build_needs(name):
    lines = (ROOT / "packaging" / name).read_text(encoding="utf-8").splitlines()
    copied = {source for line in lines if line.startswith("COPY") for source in line.split()[1:-1]}
    built = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    included = {path.split("/")[0] for path in built["targets"]["wheel"]["force-include"]}
    assert copied >= {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], *included}
    assert copied >= {*built["targets"]["wheel"]["packages"]}
    kept = (ROOT / ".dockerignore").read_text().splitlines()
    assert {f"!{one}" for one in copied} <= {*kept}
    (extras,) = re.findall(r'"/source\[([\w,]+)\]"', "\n".join(lines))
    assert {*extras.split(",")} <= {*PROJECT["optional-dependencies"]}
    assert lines[-2:] == ['ENTRYPOINT ["jaxbundle"]', 'CMD ["--help"]']
    # docker run --user: another user than that of the image, who keeps programs and fonts
    text = "\n".join(lines)
    (writable,) = re.findall(r"install -d -m 1777 (\S+)", text)
    caches = re.findall(r"(?:CACHE_DIR|CONFIGDIR)=(\S+)", text)
    assert len(caches) == 2 and all(Path(one).parent == Path(writable) for one in caches)
