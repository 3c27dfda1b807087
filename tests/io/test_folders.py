"""Folders of results never overwrite foreign files, and are complete however the program ends."""

import errno
import json
import os
import signal
from pathlib import Path

import exchange_cases
import pytest
from full_disk import files_end_at
from typer.testing import CliRunner

from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.networks.bundler import write_bundler
from jaxbundle.io.results.coordinates import write_coordinates
from jaxbundle.io.writing import folders
from jaxbundle.io.writing.folders import INSIDE, MARKER, check_folder, read_marker, replace_folder
from jaxbundle.system.temporaries import remove_temporaries

OLD = {"report.txt": "old", "network/points.csv": "1", "histogram.png": "h"}
NEWER = {"report.txt": "newer", "network/points.csv": "2", "network/deep/x": "3", "plan.png": "p"}


def write(folder, files, by="adjust", force=False, names=tuple(NEWER)):
    with replace_folder(folder, by, names, force) as new:
        for name, text in files.items():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            (new / name).write_text(text)


def content(folder) -> dict[str, str]:
    """The text of all files, by name, without the marker."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {name: path.read_text() for name, path in found.items() if name != MARKER}


@pytest.fixture
def out(tmp_path):
    write(tmp_path / "out", OLD)
    return tmp_path / "out"


@pytest.mark.parametrize("made", [False, True])
def test_a_new_or_an_empty_folder_is_written(tmp_path, made):
    place = tmp_path / "a" / "b"
    if made:
        place.mkdir(parents=True)
    write(place, OLD)
    assert content(place) == OLD
    assert {*read_marker(place).files} == {*OLD}
    assert [p.name for p in place.parent.iterdir()] == ["b"]


def test_the_same_command_replaces_its_files_and_touches_no_other(out):
    (out / "notes.txt").write_text("mine")
    (out / "network" / "mine").write_text("mine")
    (out / "link").symlink_to("notes.txt")
    before = os.stat(out / "notes.txt")
    write(out, NEWER)
    mine = {"notes.txt": "mine", "network/mine": "mine", "link": "mine"}
    assert content(out) == NEWER | mine
    assert os.stat(out / "notes.txt").st_ino == before.st_ino
    write(out, {})
    assert content(out) == mine and not (out / "network" / "deep").exists()
    assert [p.name for p in out.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("by, change, said", [
    ("orient", None, "a folder of jaxbundle adjust, not orient; .*--force .*replace .*report.txt"),
    ("adjust", "report.txt", "report.txt: already there, and not as jaxbundle adjust wrote it"),
    ("adjust", "plan.png", "plan.png: already there, and not as jaxbundle adjust wrote it"),
    ("adjust", MARKER, "not a folder of jaxbundle adjust: .*report.txt.*: already there; give"),
])  # fmt: skip
def test_what_is_not_its_own_needs_force(out, by, change, said):
    if change:
        (out / change).write_text("mine")
    (out / "notes.txt").write_text("mine")
    before = content(out)
    for refuse in (lambda: write(out, NEWER, by), lambda: check_folder(out, by, [*NEWER])):
        with pytest.raises(InputError, match=said) as found:
            refuse()
        assert "\n" not in str(found.value)
        assert content(out) == before
    check_folder(out, by, [*NEWER], force=True)
    write(out, NEWER, by, force=True)
    # without a marker histogram.png is nobody's, and stays
    stays = {"histogram.png": "h"} if change == MARKER else {}
    assert content(out) == NEWER | {"notes.txt": "mine"} | stays


def test_patterns_are_named_and_replaced_by_force(tmp_path):
    for name in ("residuals_1.png", "mine.png"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=r"residuals_1.png: already there.*replace it$"):
        write(tmp_path, {"x": ""}, names=["residuals_*.png"])
    with pytest.raises(InputError, match="mine.png: already there"):
        write(tmp_path, {"mine.png": ""}, names=["residuals_*.png"], force=True)
    write(tmp_path, {"x": ""}, names=["residuals_*.png"], force=True)
    assert content(tmp_path) == {"x": "", "mine.png": "mine"}


def test_a_folder_of_somebody_else(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="it contains notes.txt; .*to write into it all the same"):
        check_folder(tmp_path, "adjust", [*NEWER])
    write(tmp_path, NEWER, force=True)
    assert content(tmp_path) == NEWER | {"notes.txt": "mine"}


def test_the_input_is_not_replaced_even_by_force(out):
    for path in (out / "network" / "points.csv", out / "plan.png"):
        with pytest.raises(InputError, match="part of the input and would be overwritten"):
            check_folder(out, "adjust", ["plan.png"], [path], force=True)
    check_folder(out, "adjust", ["*.png"], [out.parent / "plan.png", out / "notes.txt"])


@pytest.mark.parametrize("name, make", [
    ("report.txt", lambda path: path.mkdir()),
    ("network", lambda path: path.write_text("mine")),
    ("network", lambda path: path.symlink_to("..")),
])  # fmt: skip
def test_folders_files_and_links_in_the_way(tmp_path, name, make):
    make(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: .*move it away"):
        write(tmp_path, NEWER, force=True)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_marker_leads_nowhere_else(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "x").write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    (out / "link").symlink_to("../elsewhere")
    files = dict.fromkeys(("../mine", str(tmp_path / "mine"), "link/x", "a\0b", ""), "0")
    (out / MARKER).write_text(json.dumps({"command": "adjust", "files": files}))
    assert read_marker(out).files == {}
    write(out, OLD, force=True)
    assert content(tmp_path)["mine"] == content(tmp_path)["elsewhere/x"] == "mine"
    for damaged in (b"", b"[]", b'{"command": 1, "files": []}', b"\xff", b"[" * 5000):
        (out / MARKER).write_bytes(damaged)
        assert read_marker(out) is None


def test_a_link_to_a_folder_stays_one(out):
    link = out.parent / "link"
    link.symlink_to("out")
    write(link, NEWER)
    assert link.is_symlink() and content(out) == NEWER
    ahead = out.parent / "ahead"
    ahead.symlink_to("not_yet")
    write(ahead, NEWER)
    assert ahead.is_symlink() and content(out.parent / "not_yet") == NEWER


def test_a_folder_that_cannot_be_moved_to_from_beside(out, monkeypatch):
    """A mount point: its parent folder is on another disk."""
    rename = Path.rename

    def refuse(path, target):
        if path.name == INSIDE:
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refuse)
    write(out, NEWER)
    assert content(out) == NEWER and {*os.listdir(out)} == {"report.txt", "plan.png", "network",
                                                            MARKER}  # fmt: skip


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit(143), MemoryError, ValueError])
def test_what_fails_leaves_no_trace(out, error):
    with pytest.raises(type(error) if isinstance(error, BaseException) else error):
        with replace_folder(out, "adjust", NEWER) as new:
            (new / "report.txt").write_text("half")
            raise error
    with pytest.raises(InputError, match=f"^{out}/a/report.txt: odd$"):
        with replace_folder(out / "a" / "b", "adjust", NEWER, force=True) as new:
            raise InputError(f"{new.parent.parent / 'report.txt'}: odd")
    assert content(out) == OLD and {*os.listdir(out.parent)} == {"out"}


def in_child(action) -> int:
    """Run something in another process; its exit status."""
    child = os.fork()
    if not child:
        try:
            action()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_full_disk_leaves_the_old_result_whole(out):
    with files_end_at(3), pytest.raises(InputError, match=f"^{out}: cannot be written: File too"):
        write(out, NEWER)
    assert content(out) == OLD and {*os.listdir(out.parent)} == {"out"}


@pytest.mark.parametrize("inside", [False, True])
def test_a_kill_at_any_rename_leaves_old_or_new(tmp_path, inside):
    """Killed before the n-th rename, for every n: the old files or the new ones are all there, in
    the folder once the next command has recovered it, with the user's own files untouched."""
    real, mine, outcomes = os.rename, {"notes.txt": "mine", "network/mine": "mine"}, []
    for n in range(20):
        out = tmp_path / str(n) / "out"
        write(out, OLD)
        for name, text in mine.items():
            (out / name).write_text(text)
        left = [n]

        def rename(a, b, left=left, **options):
            if not left[0]:
                os.kill(os.getpid(), signal.SIGKILL)
            left[0] -= 1
            real(a, b, **options)

        def action(out=out, rename=rename):
            if inside:
                folders._make_work_folder = lambda real: (real / INSIDE).mkdir() or real / INSIDE
            os.rename = rename
            write(out, NEWER)

        ended = in_child(action)
        everything = sorted(content(out.parent).values())
        assert all(everything.count(text) >= 1 for text in (*OLD.values(), *mine.values())) or all(
            everything.count(text) >= 1 for text in (*NEWER.values(), *mine.values())
        )
        folders.recover(out)
        assert {*os.listdir(out.parent)} == {"out"} and not (out / INSIDE).exists()
        found = content(out)
        assert {name: found.pop(name) for name in mine} == mine
        assert found in (OLD, NEWER) and {*read_marker(out).files} == {*found}
        outcomes.append(found == NEWER)
        if ended == 0:
            break
    # killed within the exchange more often than it has files, and once not at all
    assert ended == 0 and len(outcomes) > len(OLD) + len(NEWER) and outcomes.count(False) > 5


@pytest.mark.parametrize("place", ["out", "a/b"])
def test_an_interrupt_of_the_command_line_leaves_no_trace(out, place):
    """It ends the process without an exception, and removes what is temporary."""

    def action():
        with replace_folder(out.parent / place, "adjust", NEWER) as new:
            (new / "report.txt").write_text("half")
            remove_temporaries(1)
            os._exit(7)

    assert in_child(action) == 7
    assert content(out) == OLD and {*os.listdir(out.parent)} == {"out"}


def test_two_runs_do_not_write_one_folder(out):
    with replace_folder(out, "adjust", NEWER):
        with pytest.raises(InputError, match=f"^{out}: another run is writing it"):
            write(out, NEWER)
    assert content(out) == {}


def test_every_command_with_a_folder_refuses_a_foreign_one(tmp_path, monkeypatch):
    """One implementation: the same refusal, before anything is read or computed."""
    import jaxbundle.cli.adjust  # noqa: F401
    import jaxbundle.cli.orient  # noqa: F401
    import jaxbundle.cli.plan  # noqa: F401
    import jaxbundle.cli.pushbroom.refine  # noqa: F401
    import jaxbundle.cli.pushbroom.simulate  # noqa: F401
    from jaxbundle.cli.app import app

    monkeypatch.setattr(jaxbundle, "use_cores", lambda *_: None)  # JAX runs in this process
    examples = Path(__file__).parents[2] / "examples"
    project = examples / "convergent4" / "project.toml"
    out = tmp_path / "other"
    out.mkdir()
    mine = {name: "mine" for name in ("images.csv", "points.csv", "report.txt", "scanner.toml",
                                      "residuals_1.png", "result.json")}  # fmt: skip
    for name, text in mine.items():
        (out / name).write_text(text)
    block = "--c 50 --image 36,24 --area 400,300 --sigma-image 0.002 --height 100".split()
    for command, *arguments in (
        ("adjust", project), ("orient", project), ("plan", *block),
        ("pushbroom simulate", examples / "line_scanner" / "flight.toml"),
    ):  # fmt: skip
        done = CliRunner().invoke(app, [*command.split(), *map(str, arguments), "--out", str(out)])
        assert isinstance(done.exception, InputError), (command, done.output)
        message = str(done.exception)
        assert message.startswith(f"--out {out}: not a folder of jaxbundle {command}: {out}/")
        assert ": already there; give a new folder, or --force " in message
        assert content(out) == mine


def test_tables_of_line_scanners_do_not_replace_their_input(tmp_path):
    import jaxbundle.cli.pushbroom  # noqa: F401
    from jaxbundle.cli.app import app

    table, scanner = tmp_path / "points.csv", tmp_path / "scanner.toml"
    table.write_text("longitude,latitude,height,line,sample\n")
    scanner.write_text('[position]\ntable = "positions.csv"\n')
    (tmp_path / "positions.csv").write_text("t,X,Y,Z\n")
    for command, output in (
        (f"locate {scanner} --points {table} --csv", table),
        (f"project {scanner} --points {table} --json", tmp_path / "positions.csv"),
        (f"accuracy {scanner} --csv", scanner),
        (f"rpc fit {table} --out", table),
        (f"rpc compensate {scanner} --control {table} --out", table),
        (f"correct {scanner} {table} --out", table),
    ):
        before = output.read_text()
        done = CliRunner().invoke(app, ["pushbroom", *command.split(), str(output)])
        assert f"{output}: is part of the input and would be overwritten" in str(done.exception)
        assert output.read_text() == before


@pytest.mark.parametrize("name, beside", [("bundle.out", "list.txt"), ("p.csv", "p_images.csv")])
def test_two_files_that_belong_together_are_both_replaced_or_none(tmp_path, name, beside):
    network = exchange_cases.network("snavely", ("a", "b", "c"))
    write_both = write_bundler if name.endswith("out") else write_coordinates
    for file in (name, beside):
        (tmp_path / file).write_text("old")
    said = f"^{tmp_path}/({name}|{beside}): cannot be written: File too large"
    with files_end_at(100), pytest.raises(InputError, match=said):  # some files have room
        write_both(network, tmp_path / name)
    assert content(tmp_path) == {name: "old", beside: "old"}
    write_both(network, tmp_path / name)
    assert "old" not in content(tmp_path).values() and len(content(tmp_path)) == 2


def test_a_list_of_names_that_is_there_is_renewed(tmp_path):
    """Otherwise names of other images would be taken for those of this network."""
    (tmp_path / "list.txt").write_text("x\ny\nz\n")
    write_bundler(exchange_cases.network("snavely", ("0", "1", "2")), tmp_path / "bundle.out")
    assert read_network(tmp_path / "bundle.out").images.id == ("0", "1", "2")
