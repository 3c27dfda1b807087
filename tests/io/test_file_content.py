"""Special files are refused, zero bytes end the reading, numbers and nesting beyond all bounds are
reported with file and line: in every reader of text."""

import json
import os
import re
import shutil
import tracemalloc

import pytest
from test_hostile_files import KINDS, made, read

from jaxbundle.errors import InputError
from jaxbundle.io.networks.photomodeler_camera import header_camera
from jaxbundle.io.text.csv_tables import read_text, read_toml
from jaxbundle.io.text.rows import TextRow
from jaxbundle.io.writing.fingerprints import of_input
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.system.file_content import check_plain, parse_json, parse_toml, read_content

BINARY = ("colmap", "camera-stack")
LARGE = 2**30
LONG = "9" * 400


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in BINARY])
def test_a_tail_of_zeros_is_refused_early(kind, tmp_path):
    """1 GB on paper, a hole on the disk: no more of it is in memory than the valid part."""
    folder = made(kind, tmp_path)
    for file in folder.iterdir():
        os.truncate(file, LARGE)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=re.escape(str(folder))) as found:
            read(kind, folder)
        assert tracemalloc.get_traced_memory()[1] < 60e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(found.value) and len(str(found.value)) < 400


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in BINARY])
def test_a_number_of_400_digits_is_read_or_refused_with_its_file(kind, tmp_path):
    """Numbers of every file in turn; the message names a file, and is not an arithmetic error."""
    (tmp_path / "valid").mkdir()
    valid = made(kind, tmp_path / "valid")
    for name in sorted(path.name for path in valid.iterdir()):
        text = (valid / name).read_text()
        places = [m.span() for m in re.finditer(r"(?<![\w.])-?\d+(?![\w.])", text)]
        for first, last in places[:: max(1, len(places) // 8)]:
            folder = shutil.copytree(valid, tmp_path / "copy", dirs_exist_ok=True)
            (folder / name).write_text(text[:first] + LONG + text[last:])
            try:
                read(kind, folder)
            except InputError as error:
                # what refers to an id may be what is wrong then
                assert str(folder) in str(error) and len(str(error)) < 700, (name, first)


def test_an_exponent_of_400_digits_is_zero():
    row = TextRow("file", 1, f"7.4 3.6 2.6 7.2 5.4 4.9e-{LONG} 0 0 0 0")
    values, half = header_camera(row)
    assert values[5] == 0 and half[5] == pytest.approx(0.5e-5)


@pytest.mark.parametrize("parse, text, line", [
    (parse_toml, f"a = 1\nb = {LONG}\n", 2),
    (parse_toml, f"a = \"{LONG}\"\nb = [1,\n {'9' * 9000}]\n", 3),
    (parse_toml, "x = 1\n" + ".".join("a" * 1000) + " = 1\n", 2),
    (parse_toml, "[" + ".".join("a" * 1000) + "]\nb = 1\n", 1),
    (parse_toml, "# [[[[\na = " + "[" * 100 + "]" * 100 + "\n", 2),
    (parse_toml, "a = 1\nb = " + "[" * 5000 + "]" * 5000 + "\n", 2),
    (parse_toml, "a = 1\nb = " + "{a=" * 1000 + "1" + "}" * 1000 + "\n", 2),
    (parse_json, "{\n\"a\": 1,\n\"b\": " + "[" * 1000 + "]" * 1000 + "}", 3),
    (parse_json, "{\"a\":\n" * 100_000, 65),
    (parse_json, f"{{\n\"b\": {LONG}}}", 2),
    (parse_json, f"[1,\n\"{LONG}\",\n-{'9' * 9000}]", 3),
])  # fmt: skip
def test_the_line_of_what_is_beyond_bounds(parse, text, line):
    with pytest.raises(InputError, match=rf"^file, line {line}: not valid (TOML|JSON): "):
        parse("file", text)


def test_long_numbers_in_quotes_and_usual_depths_are_read():
    assert parse_toml("f", f"a = \"{LONG}\"\nb.c.d = [[1], [2.5]]\n")["b"]["c"]["d"] == [[1], [2.5]]
    assert parse_json("f", json.dumps({"a": LONG, "b": 10**300})) == {"a": LONG, "b": 10**300}


@pytest.mark.parametrize("name", ["/proc/self/maps", "/sys/kernel/notes", "/dev/zero", "fifo"])
def test_special_files_are_refused(name, tmp_path):
    path = tmp_path / name
    if name == "fifo":
        os.mkfifo(path)
    elif not path.exists():
        pytest.skip(f"there is no {name} here")
    for use in (read_text, read_toml, read_photograph, check_plain):
        with pytest.raises(InputError, match=f"{path}: .*a plain file"):
            use(path)
    (tmp_path / "link.csv").symlink_to(path)
    (tmp_path / "p").mkdir()
    folder = made("project", tmp_path / "p")
    for table in (str(path), "../link.csv"):
        text = (folder / "project.toml").read_text()
        (folder / "project.toml").write_text(re.sub('points = ".*"', f'points = "{table}"', text))
        assert of_input(folder)
        with pytest.raises(InputError, match="give a plain file"):
            read("project", folder)


def test_a_pipe_given_open_is_read():
    reader, writer = os.pipe()
    os.write(writer, b"a,b\n")
    os.close(writer)
    try:
        assert read_text(f"/dev/fd/{reader}") == "a,b\n"
    finally:
        os.close(reader)


@pytest.mark.parametrize("name, said", [
    ("none", "no such file"), ("file/below", "no such file"), ("a\0b", "no such file"),
    ("x" * 300, "cannot be read: File name too long"), ("loop", "cannot be read: Too many levels"),
    (".", "is a folder; expected a file"),
])  # fmt: skip
def test_errors_of_the_system_are_a_line(name, said, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError, match=said) as found:
        read_content(tmp_path / name)
    assert "\n" not in str(found.value)
