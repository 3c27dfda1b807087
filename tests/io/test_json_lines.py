"""A file of results is kept whole, every key once, and written by one run at a time."""

import json
import math
import os
import stat
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

from jaxbundle.errors import InputError
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.results.parquet import write_parquet
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.writing.locks import hold_lock


def rows(path: Path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_kept_and_dropped(tmp_path):
    file = tmp_path / "results.jsonl"
    lines = JsonLines(file)
    lines.append([{"key": "a", "status": "converged", "rms": float("nan")}])
    lines.append([{"key": "b", "status": "singular"}])
    assert file.read_text().splitlines()[0].endswith('"rms": null}')
    whole = file.read_text()
    file.write_text(whole + '{"key": "c", "stat')
    assert JsonLines(file).heads.keys() == {"a", "b"} and file.read_text() == whole
    file.write_text(whole.rstrip("\n"))  # only the line feed was lost
    assert JsonLines(file).heads.keys() == {"a", "b"} and file.read_text() == whole
    file.write_text(whole + whole)
    assert "b" in JsonLines(file) and file.read_text() == whole
    JsonLines(file).drop(["b"])
    assert JsonLines(file).heads == {"a": {"status": "converged"}}
    assert [row["key"] for row in rows(file)] == ["a"]
    file.write_text("[1, 2]\n" + whole)
    with pytest.raises(InputError, match="line 1"):
        JsonLines(file)


@pytest.mark.parametrize("text", [
    "my notes\n", "my notes", '{"key": "a", "sta\n', '{"a": 1}', '{"precious": [1, 2', '{"key": 1}',
])  # fmt: skip
def test_a_file_of_something_else_is_not_taken_for_a_torn_line(tmp_path, text):
    """It stays unchanged, even if it does not end with a line feed."""
    file = tmp_path / "notes.txt"
    file.write_text(text)
    with pytest.raises(InputError, match="line 1: not a result"):
        JsonLines(file)
    assert file.read_text() == text


def test_a_file_that_is_a_link_stays_one(tmp_path):
    file, link = tmp_path / "results.jsonl", tmp_path / "link.jsonl"
    link.symlink_to(file)
    lines = JsonLines(link)
    lines.append([{"key": key, "status": "converged"} for key in "ab"])
    lines.drop("a")
    assert link.is_symlink() and [row["key"] for row in rows(file)] == ["b"]


def test_a_name_of_other_bytes_than_text_is_found_again(tmp_path):
    file, key = tmp_path / "results.jsonl", os.fsdecode(b"camera \xe9")
    JsonLines(file).append([{"key": key, "status": "converged"}])
    assert key in JsonLines(file)


def test_one_at_a_time(tmp_path):
    file, link = tmp_path / "results.jsonl", tmp_path / "link.jsonl"
    link.symlink_to(file)
    for _ in range(2):
        with hold_lock(file):
            JsonLines(file).append([{"key": "a", "status": "converged"}])
            JsonLines(file).drop("a")  # another file of the same name
            for same in (file, link):
                with pytest.raises(InputError, match="another run is writing"), hold_lock(same):
                    pass
            with hold_lock(tmp_path / "other.jsonl"):
                pass
        assert sorted(os.listdir(tmp_path)) == ["link.jsonl", "results.jsonl"]
    (tmp_path / ".results.jsonl.lock").write_text("")  # of a killed run
    with hold_lock(link):
        pass
    assert sorted(os.listdir(tmp_path)) == ["link.jsonl", "results.jsonl"]


def test_no_lock_to_be_had_is_said(tmp_path):
    with pytest.raises(InputError, match="there is no folder .*nowhere"):
        with hold_lock(tmp_path / "nowhere" / "results.jsonl"):
            pass
    with hold_lock("/dev/null"):
        assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_a_pipe_takes_lines():
    read, write = os.pipe()
    with open(read, "rb") as end:
        with hold_lock(f"/dev/fd/{write}"):
            JsonLines(f"/dev/fd/{write}").append([{"key": "a"}])
        os.close(write)
        assert json.loads(end.read()) == {"key": "a"}


def test_a_tail_of_zeros_is_cut(tmp_path):
    path = tmp_path / "results.jsonl"
    path.write_bytes(b'{"key": "a"}\n' + bytes(50))
    assert [*JsonLines(path).heads] == ["a"] and path.read_bytes() == b'{"key": "a"}\n'


def test_what_is_not_finite_is_null_in_tuples_too():
    document = {"a": (1.0, math.nan), "b": [(math.inf,)]}
    assert without_nan(document) == {"a": [1.0, None], "b": [[None]]}


def test_words_that_are_missing_are_null_in_parquet(tmp_path):
    words = np.array(["a", None, "None"], object)
    write_parquet(tmp_path / "t.parquet", {"word": words})
    found = pyarrow.parquet.read_table(tmp_path / "t.parquet")["word"]
    assert found.to_pylist() == ["a", None, "None"]
