"""Whatever is in a file, reading it ends in a network, a camera or one line of complaint.

Valid files of every format are cut, garbled, and given numbers nobody expects; what comes out must
be an `InputError` or something that could be read. Warnings are errors here, so an overflow is a
failure as well.
"""

import shutil
import tempfile
from functools import cache
from pathlib import Path

import pytest
from exchange_cases import CAMERAS, network
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxbundle.errors import InputError
from jaxbundle.io import read_cameras, read_network, write_project
from jaxbundle.io.bal import write_bal
from jaxbundle.io.bundler import write_bundler
from jaxbundle.io.colmap import write_colmap
from jaxbundle.io.opencv_file import write_opencv
from jaxbundle.network.tables import Camera, Network

EXAMPLE = Path(__file__).parents[2] / "examples" / "convergent4" / "convergent4.txt"
ODD = ["nan", "-1", "1e400", "999999999999999999", "1000000000000000000000", "0", "-0.5", "", "x",
       "1_0", "inf", "'", '"', "[", "<a>", "\x00", "é", "\n", ",", "-99"]  # fmt: skip


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """The function that gives a folder with a valid input of a kind, and nothing else."""
    return cache(lambda kind: made(kind, tmp_path_factory.mktemp(kind)))


def made(kind: str, folder: Path) -> Path:
    net, snavely = network("opencv", ("a", "b", "c")), network("snavely", ("0", "1", "2"), 0)
    match kind:
        case "colmap":
            write_colmap(net, folder)
        case "colmap-text":
            write_colmap(net, folder, text=True)
        case "bal":
            write_bal(snavely, folder / "problem.bal")
        case "bundler":
            write_bundler(network("snavely", ("a", "b", "c"), 0), folder / "bundle.out")
        case "project":
            write_project(net, folder)
        case "photo-list":
            shutil.copy(EXAMPLE, folder)
        case "opencv":
            write_opencv(CAMERAS["opencv"], folder / "camera.yaml")
        case "json":
            write_opencv(CAMERAS["opencv"], folder / "camera.json")
        case "photomodeler":
            from test_photomodeler import export

            (folder / "export.txt").write_text(export(control=((3, 0.02),)))
        case "bingo":
            from test_bingo import GEO, IMAGE

            (folder / "image.dat").write_text(IMAGE)
            (folder / "geoin.dat").write_text(GEO)
        case "metashape":
            from test_metashape import PIXEL, xml

            text = xml(transform=True).replace("<b1>", "<b2>2.5</b2><b1>")
            (folder / "cameras.xml").write_text(text.replace("<calibration", PIXEL, 1))
        case "column-map":
            from test_column_map import write

            write(folder)
    return folder


def read(kind: str, folder: Path):
    """What a folder holds, read as this kind."""
    match kind:
        case "opencv" | "json":
            return read_cameras(next(folder.iterdir()))
        case "colmap-text":
            return read_network(folder, "colmap")
        case "colmap" | "project" | "bingo":
            return read_network(folder, kind)
        case "column-map":
            return read_network(folder / "map.toml", kind)
        case _:
            (file,) = (p for p in folder.iterdir() if p.name != "list.txt")
            settings = ["sigma_image=1"] if kind == "photo-list" else []
            return read_network(file, kind, settings)


def garbled(data: bytes, how: str, a: float, b: float, odd: str) -> bytes:
    """The contents of a file with something done to it; a, b in [0, 1] say where."""
    i, j = sorted((int(a * len(data)), int(b * len(data))))
    match how:
        case "cut":
            return data[:i]
        case "without a part":
            return data[:i] + data[j:]
        case "a part twice":
            return data[:j] + data[i:]
        case "bytes":
            return data[:i] + bytes((255 - x) for x in data[i : i + 9]) + data[i + 9 :]
        case "a word":
            begin = max(data.rfind(c, 0, i) for c in (b" ", b"\n", b",", b">")) + 1
            ends = [e for e in (data.find(c, i) for c in (b" ", b"\n", b",", b"<")) if e >= 0]
            return data[:begin] + odd.encode() + data[min(ends, default=len(data)) :]
        case "zeros":
            return data[:i] + bytes(8) + data[i + 8 :]
        case "ones":
            return data[:i] + b"\xff" * 8 + data[i + 8 :]


KINDS = ("colmap", "colmap-text", "bal", "bundler", "project", "photo-list", "opencv", "json",
         "photomodeler", "bingo", "metashape", "column-map")  # fmt: skip
HOW = ("cut", "without a part", "a part twice", "bytes", "a word", "a word", "zeros", "ones")


@pytest.mark.parametrize("kind", KINDS)
def test_a_valid_input_is_read(kind, valid):
    found = read(kind, valid(kind))
    assert isinstance(found, Network) or isinstance(found[0], Camera)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(
    which=st.integers(0, 9), how=st.sampled_from(HOW), odd=st.sampled_from(ODD),
    a=st.floats(0, 1), b=st.floats(0, 1),
)  # fmt: skip
def test_a_garbled_input_is_read_or_refused(kind, valid, which, how, odd, a, b):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(valid(kind), folder, dirs_exist_ok=True)
        files = sorted(folder.iterdir())
        file = files[which % len(files)]
        file.write_bytes(garbled(file.read_bytes(), how, a, b, odd))
        try:
            read(kind, folder)
        except InputError as error:
            assert "\n" not in str(error) and len(str(error)) < 1000
