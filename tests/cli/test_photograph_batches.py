"""`jaxbundle batch` of folders of photographs, a camera each."""

import json
import os
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import render
from board_photographs import poses

from jaxbundle.batches import work as batches
from jaxbundle.batches.run_on_files import run_batch
from jaxbundle.errors import InputError
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.measure.boards import Board
from jaxbundle.measure.views import search_board
from jaxbundle.system.workers import Failed, Workers

EXAMPLE = Path(__file__).parents[2] / "examples" / "board"
BOARD = Board(9, 6, 0.03)
FREE = ["fx", "fy", "cx", "cy", "k1"]
VIEWS = 7


def folder_of(path: Path, numbers) -> Path:
    path.mkdir()
    for number in numbers:
        shutil.copy(EXAMPLE / f"photo_{number:02d}.jpg", path)
    return path


def rows(file: Path) -> list[dict]:
    return [json.loads(line) for line in file.read_text().splitlines()]


@pytest.fixture
def searched(monkeypatch):
    """Photographs that are searched, here and at once."""
    found = []

    class Here(Workers):
        def run(self, tasks):
            for path, board in tasks:
                found.append(path.name)
                yield (path, board), search_board(path, board)

    monkeypatch.setattr(batches, "Workers", Here)
    return found


@pytest.mark.further
def test_a_folder_a_camera(command, tmp_path, monkeypatch):
    """In separate processes, from the command; a bad folder has its line, the others theirs."""
    monkeypatch.chdir(tmp_path)
    folder_of(tmp_path / "first", range(1, 8))
    (tmp_path / "first" / "text.jpg").write_text("no photograph")
    shutil.copy(tmp_path / "first" / "photo_01.jpg", tmp_path / "first" / "z.jpg")
    folder_of(tmp_path / "bad", [13])
    (tmp_path / "none").mkdir()
    folder_of(tmp_path / "second", range(7, 14))
    told = command(
        "batch", "first", "bad", "none", "second", "--board", "9x6", "--square", 0.03, "--free",
        ",".join(FREE), "--json-lines", "results.jsonl", "--table", "cameras.csv",
    )  # fmt: skip
    assert told.status == 0, told.err
    assert "2 converged, 2 bad input" in told.out and "no photographs in this folder" in told.out
    first, bad, none, second = rows(Path("results.jsonl"))
    assert [row["key"] for row in (first, bad, none, second)] == ["first", "bad", "none", "second"]
    assert "inner corners" in bad["error"] and none["status"] == "bad input"
    for row, used in ((first, 7), (second, 6)):
        assert row["views"] == used == len(row["photographs"]) == len(row["poses"])
        assert row["image_size"] == [480, 360] and row["views_left_out"] == []
        fx = row["parameters"]["fx"]
        assert abs(fx["value"] - 620) < 4 * fx["sigma"] < 4
        assert row["rms"] < 0.06
    left = first["photographs_not_used"]
    assert "not an image" in left["text.jpg"]
    assert left["z.jpg"] == "is the same file as photo_01.jpg"
    assert list(second["photographs_not_used"]) == ["photo_13.jpg"]
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == [
        "cameras.csv", "results.jsonl", "results.jsonl.corners",
    ]  # fmt: skip


def test_no_photograph_is_searched_twice_and_a_changed_one_is_noticed(searched, tmp_path):
    folders = [folder_of(tmp_path / "a", range(1, 8)), folder_of(tmp_path / "b", range(6, 13))]
    file = tmp_path / "results.jsonl"
    again = lambda **options: run_batch(
        folders, file, **dict(board=BOARD, free=FREE, brief=True) | options
    )
    assert again() == {"converged": 2}
    assert len(searched) == 12  # two are in both
    assert again() == {"converged": 2, "skipped": 2}
    before = rows(file)
    # Killed before its line was written, moved and copied: corners are there.
    file.write_text(file.read_text().splitlines()[0] + "\n")
    os.utime(folders[1] / "photo_08.jpg", (0, 0))
    assert again() == {"converged": 2, "skipped": 1}
    assert rows(file) == before and len(searched) == 12
    shutil.copy(EXAMPLE / "photo_02.jpg", folders[1] / "photo_12.jpg")
    with pytest.raises(InputError, match="has 1 of .*, b: its photographs were others"):
        again()
    with pytest.raises(InputError, match="board was Board.*9.*, is Board.*8"):
        again(board=Board(8, 6, 0.03))
    os.remove(folders[1] / "photo_12.jpg")
    shutil.copy(EXAMPLE / "photo_13.jpg", folders[1])
    assert again(renew=True) == {"converged": 2, "skipped": 1}
    assert searched[12:] == ["photo_13.jpg"] and rows(file)[0] == before[0]
    assert again(part=(2, 2)) == {"converged": 1, "skipped": 1}
    with pytest.raises(InputError, match="I from 1 to N"):
        again(part=(3, 2))
    (tmp_path / "results.jsonl.corners").write_text("a diary " * 1000)
    with pytest.raises(InputError, match=r"results.jsonl.corners: .*remove it"):
        again()


@pytest.mark.further
def test_charuco_boards_with_missing_corners(searched, tmp_path):
    """Every photograph shows another part of the board: from less than half of it to all but a
    corner; the camera is within its σ."""
    board = Board(10, 7, 0.027, "charuco")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = cv2.aruco.CharucoBoard((10, 7), 0.027, 0.75 * 0.027, dictionary)
    picture = drawn.generateImage((1000, 700), marginSize=0)
    pattern = render.print_of(picture, 10 * 0.027, 0.03)
    (tmp_path / "camera").mkdir()
    # only the distortion that is free: the corners are too precise to hide another
    lens = render.Lens.of(fx=620.0, fy=621.0, cx=242.3, cy=177.8, k1=-0.12)
    for i, (M, X0) in enumerate(poses(VIEWS, turned=False, middle=(0.135, 0.0945))):
        taken = render.photograph(lens, M, X0, pattern, seed=i)
        taken[:, (70 * (i % 3)) :][:, :90] = 128
        cv2.imwrite(f"{tmp_path}/camera/{i}.png", taken)
    file = tmp_path / "results.jsonl"
    assert run_batch([tmp_path / "camera"], file, board=board, free=FREE) == {"converged": 1}
    (row,) = rows(file)
    with KeptCorners(tmp_path / "results.jsonl.corners") as kept:
        looks = [kept.look(kept.content(p), board) for p in (tmp_path / "camera").iterdir()]
    seen = np.array([~np.isnan(xy).any(1) for _, xy in looks])
    assert row["views"] == VIEWS and 20 < seen.sum(1).min() < 27 and (seen.sum(1) < 54).sum() > 4
    assert row["redundancy"] == 2 * seen.sum() - 6 * VIEWS - len(FREE)
    truth = dict(zip(["fx", "fy", "cx", "cy"], lens.parameters))
    for name, value in truth.items():
        found = row["parameters"][name]
        assert abs(found["value"] - value) < 4 * found["sigma"], name


def test_what_a_process_dies_of_spoils_its_task_alone():
    with Workers(signal.raise_signal, 1) as workers:
        found = dict(workers.run([0, signal.SIGKILL, 9999]))
        found |= dict(workers.run([signal.SIGCONT]))
    assert found[0] is None and found[signal.SIGCONT] is None
    assert found[signal.SIGKILL] == Failed("its worker process died (signal 9)")
    assert "ValueError" in found[9999].why or "OSError" in found[9999].why


@pytest.mark.parametrize("quiet", [pytest.param((), marks=pytest.mark.further), ("--quiet",)])
def test_a_photograph_without_memory_is_named_and_searched_again(
    command, tmp_path, monkeypatch, quiet
):
    """The result of the others is kept; the missing photograph is said, with the way to add it."""
    folder, lacks = folder_of(tmp_path / "first", range(1, 8)), ["photo_03.jpg"]

    class Short(Workers):
        def run(self, tasks):
            for path, board in tasks:
                why = f"{path}: not enough memory for 480 × 360 pixels"
                short = path.name in lacks
                yield (path, board), Failed(why) if short else search_board(path, board)

    monkeypatch.setattr(batches, "Workers", Short)
    file = tmp_path / "results.jsonl"
    run = ("batch", folder, "--board", "9x6", "--square", 0.03, "--free", ",".join(FREE),
           "--json-lines", file, *quiet)  # fmt: skip
    told = command(*run)
    assert told.status == 0 and rows(file)[0]["photographs_not_searched"] == ["photo_03.jpg"]
    assert "not enough memory" in rows(file)[0]["photographs_not_used"]["photo_03.jpg"]
    for words in ("1 photograph was not searched", "first/photo_03.jpg: ", "not enough memory",
                  "--retry"):  # fmt: skip
        assert words in told.err, told
    lacks.clear()
    told = command(*run)  # skipped, and still said
    assert "first/photo_03.jpg: " in told.err and rows(file)[0]["views"] == 6
    told = command(*run, "--retry")
    assert (told.status, told.err) == (0, "") and rows(file)[0]["views"] == 7
    assert "photographs_not_searched" not in rows(file)[0]


def test_a_shortage_of_memory_in_a_process_says_its_own_words():
    with Workers(short_of_memory, 1) as workers:
        ((_, found),) = workers.run(["photo.jpg"])
    assert found == Failed("photo.jpg: not enough memory")


def short_of_memory(name):
    raise MemoryError(f"{name}: not enough memory")
