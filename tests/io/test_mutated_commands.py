"""Damaged inputs through commands: a refusal is one line that names the file, status 2 or 3, and
leaves every output as it was."""

import hashlib
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from mutations import mutate_folder
from readers import READERS
from test_mutations import rng_of

SECONDS, MEMORY = 60, 4 << 30
"""Of a process: JAX reserves address space of its own."""


class Case(NamedTuple):
    """Arguments of a command: {} is the input, {o} the folder of outputs, which are there."""

    reader: str
    arguments: tuple[str, ...]
    input: str = ""


CASES = {
    "convert bal": Case("bal", ("convert", "{}", "{o}/model", "--to", "colmap", "--force",
                                "--image-size", "900,700"), "problem.bal"),
    "convert colmap": Case("colmap", ("convert", "{}", "{o}/n.csv", "--force")),
    "convert project": Case("project", ("convert", "{}", "{o}/transforms.json", "--force")),
    "convert transforms": Case("transforms", ("convert", "{}", "{o}/model", "--to", "mrcal",
                                              "--force"), "*.json"),
    "convert kalibr": Case("kalibr", ("convert", "{}", "{o}/model", "--force"), "*.yaml"),
    "convert camera": Case("opencv", ("convert", "{}", "{o}/camera.toml", "--force"), "*.yaml"),
    "convert ISD": Case("csm-frame", ("convert", "{}", "{o}/n.ply", "--force"), "*.json"),
    "convert AliceVision": Case("alicevision", ("convert", "{}", "{o}/n.ply", "--force"), "*"),
    "camera": Case("opencv", ("camera", "{}", "--plot", "{o}/camera.png"), "*.yaml"),
    "cloud": Case("cloud las", ("cloud", "{}", "--out", "{o}/cloud.ply", "--cube", "1"), "c.las"),
}  # fmt: skip
"""Commands that read files and do not adjust."""
PROCESSES = {
    "adjust": Case("project of an example", ("adjust", "{}", "--out", "{o}/model", "--quiet"),
                   "project.toml"),
    "adjust photographs": Case("photo-list", ("adjust", "{}", "--json", "{o}/n.json", "--brief",
                                              "--set", "sigma_image=1"), "*.txt"),
    "orient": Case("project of an example", ("orient", "{}", "--out", "{o}/model"),
                   "project.toml"),
    **CASES,
}  # fmt: skip


def tree(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha1(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def prepare(case: Case, valid: Path, folder: Path, number: int) -> tuple[list[str], Path]:
    """The arguments for a damaged input, with outputs of before in their folder."""
    given, out = folder / "given", folder / "out"
    given.mkdir(parents=True)
    (out / "model").mkdir(parents=True)
    for name in ("n.csv", "n_images.csv", "transforms.json", "camera.toml", "n.ply", "n.json",
                 "camera.png", "cloud.ply", "model/kept.txt"):  # fmt: skip
        (out / name).write_text("of before")
    mutate_folder(valid, given, rng_of(case.reader, number, 7))
    input = next(iter(sorted(given.glob(case.input))), given / "gone") if case.input else given
    return [word.format(input, o=out) for word in case.arguments], out


def check(status: int, out: str, err: str, folder: Path, before: dict, after: dict) -> None:
    assert status in (0, 2, 3), (status, err)
    assert "Traceback" not in err + out
    if status:
        # warnings about the input come before the reason
        *others, last = err.strip().splitlines()
        assert last.startswith("jaxbundle: ") and str(folder) in last, err
        assert all("warning" in line or "%" in line for line in others), err
        assert after == before
    assert not [name for name in after if name.endswith(".tmp")]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The valid input of every reader that a case has."""
    folders = {}
    for reader in {case.reader for case in PROCESSES.values()}:
        folders[reader] = tmp_path_factory.mktemp("valid")
        READERS[reader].make(folders[reader])
    return folders


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore")
def test_a_refusal_writes_nothing(name, made, tmp_path, command):
    case, refused = CASES[name], 0
    for number in range(8):
        folder = tmp_path / str(number)
        arguments, out = prepare(case, made[case.reader], folder, number)
        before = tree(out)
        done = command(*arguments)
        check(done.status, done.out, done.err, folder, before, tree(out))
        refused += done.status != 0
    assert refused, "no case of these is refused: nothing is tested"


@pytest.mark.further
@pytest.mark.parametrize("name", PROCESSES)
def test_a_refusal_of_a_process_writes_nothing(name, made, tmp_path):
    case = PROCESSES[name]
    limits = lambda: (
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS)),
    )
    for number in range(100, 103):
        folder = tmp_path / str(number)
        arguments, out = prepare(case, made[case.reader], folder, number)
        before = tree(out)
        done = subprocess.run(
            [sys.executable, "-m", "jaxbundle", *arguments], capture_output=True, text=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, preexec_fn=limits,
        )  # fmt: skip
        check(done.returncode, done.stdout, done.stderr, folder, before, tree(out))
