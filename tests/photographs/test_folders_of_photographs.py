"""What a folder of photographs contains: nothing is dropped without a word."""

import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.measure.views import photographs
from jaxbundle.photographs import photograph_size, read_photograph
from jaxbundle.photographs.folders import describe_other_files, list_photographs
from jaxbundle.reconstruction.photographs import find_photographs, name_other_files

GREY = np.random.default_rng(0).integers(0, 255, (80, 100), np.uint8)
HEIC = b"\0\0\0\x18ftypheic" + bytes(200)


@pytest.fixture
def folder(tmp_path):
    for name in ("a.jpg", "b.JPG", "c.webp", "d.bmp"):
        cv2.imwrite(str(tmp_path / name), np.roll(GREY, len(name) + ord(name[0]), 1))
    for name in ("IMG_1.HEIC", "wrong.jpg"):
        (tmp_path / name).write_bytes(HEIC + name.encode())
    for name in ("a.NEF", "alone.CR3"):
        cv2.imwrite(str(tmp_path / "preview.tif"), GREY)
        (tmp_path / "preview.tif").replace(tmp_path / name)
    for name in ("gcp_list.txt", "log.txt", "flight.mp4", ".DS_Store", "._a.jpg", "Thumbs.db"):
        (tmp_path / name).write_text("no photograph")
    (tmp_path / "more").mkdir()
    cv2.imwrite(str(tmp_path / "more" / "e.png"), GREY)
    (tmp_path / "tables").mkdir()
    return tmp_path


def test_photographs_that_cannot_be_read_are_named_with_the_remedy(folder):
    found, left_out = find_photographs([folder])
    assert [p.name for p in found] == ["a.jpg", "b.JPG", "c.webp", "d.bmp"]
    assert set(left_out) == {"IMG_1.HEIC", "wrong.jpg", "alone.CR3"}
    for name in ("IMG_1.HEIC", "wrong.jpg"):
        assert "pip install pillow-heif" in left_out[name] and "convert" in left_out[name]
    # its preview could be read, but is no photograph
    assert "raw files are not read: develop them" in left_out["alone.CR3"]
    with pytest.raises(InputError, match="alone.CR3: raw files are not read"):
        read_photograph(folder / "alone.CR3")


def test_other_files_are_summed_up_without_hidden_ones(folder):
    (said,) = name_other_files([folder])
    assert said == (
        f"{folder}: not read: 1 raw file beside photographs of the same name; 1 folder with "
        "photographs (more/); give them, too; 3 other files (2 .txt, 1 .mp4)"
    )
    assert describe_other_files(folder / "more") == ""
    assert folder / "a.NEF" not in list_photographs(folder)


def test_a_board_is_searched_in_all_of_them(folder):
    """Photographs that cannot be read are among those without a board, by name."""
    names = {path.name for path in photographs([folder])}
    assert names == {"a.jpg", "b.JPG", "c.webp", "d.bmp", "IMG_1.HEIC", "wrong.jpg", "alone.CR3"}


def test_heic_is_read_by_the_plugin_of_pillow(tmp_path, monkeypatch):
    """A stand-in for the plugin, which registers a reader of another format."""
    from PIL import Image, PpmImagePlugin

    ppm = b"P5 100 80 255\n" + GREY.tobytes()
    (tmp_path / "a.heic").write_bytes(HEIC + ppm)

    def open_heic(file, name):
        file.seek(len(HEIC))
        return PpmImagePlugin.PpmImageFile(file, name)

    def register():
        Image.register_open("HEIF", open_heic, lambda prefix: prefix[4:8] == b"ftyp")

    monkeypatch.setattr(Image, "ID", list(Image.ID))
    monkeypatch.setattr(Image, "OPEN", dict(Image.OPEN))
    with pytest.raises(InputError, match="a.heic: HEIC is read after pip install"):
        photograph_size(tmp_path / "a.heic")
    monkeypatch.setitem(sys.modules, "pillow_heif", SimpleNamespace(register_heif_opener=register))
    assert photograph_size(tmp_path / "a.heic") == (100, 80)


def test_a_folder_of_heic_ends_with_the_remedy(tmp_path, command):
    for k in range(3):
        (tmp_path / f"IMG_{k}.HEIC").write_bytes(HEIC + bytes([k]))
    told = command("reconstruct", tmp_path, "--out", tmp_path / "out")
    assert told.status == 2 and "0 of 3 photographs can be used" in told.err
    assert "IMG_0.HEIC (HEIC is read after pip install pillow-heif" in told.err


def test_unknown_tags_of_tiff_are_not_told(tmp_path):
    """By OpenCV, in a process of its own: dozens of lines for a folder."""
    from PIL import Image, TiffImagePlugin

    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[34855] = 160
    for k in range(2):
        Image.fromarray(np.roll(GREY, 9 * k, 1)).save(tmp_path / f"{k}.tif", tiffinfo=tags)
    command = [sys.executable, "-m", "jaxbundle", "calibrate", tmp_path]
    told = subprocess.run(
        [*command, "--board", "4x3", "--square", "1"], capture_output=True, encoding="utf-8"
    )
    assert told.returncode == 2 and "TIFF" not in told.stderr
    assert "no photograph of 2" in told.stderr
