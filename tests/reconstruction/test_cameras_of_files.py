"""Cameras by what photographs say of themselves."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.photographs.exif import Exif
from jaxbundle.reconstruction.photographs import Photograph, assign_cameras, find_photographs


def photographs(*exif):
    return [Photograph(Path(f"{k}.jpg"), f"{k}.jpg", str(k), e) for k, e in enumerate(exif)]


WIDE = Exif((3000, 2000), "Maker", "X1", 24.0, 36.0)
LONG = Exif((3000, 2000), "Maker", "X1", 50.0, 75.0)
UPRIGHT = Exif((2000, 3000), "Maker", "X1", 24.0, 36.0)
ZOOMED = Exif((3000, 2000), "Maker", "X1", 24.0), Exif((3000, 2000), "Maker", "X1", 50.0)
NAMELESS = Exif((3000, 2000))


@pytest.mark.parametrize("exif, ids, of, lens", [
    ([WIDE, WIDE], ["Maker X1"], (0, 0), (0,)),
    ([WIDE, LONG, WIDE], ["Maker X1 1", "Maker X1 2"], (0, 1, 0), (0, 1)),
    ([*ZOOMED], ["Maker X1 1", "Maker X1 2"], (0, 1), (0, 1)),
    ([WIDE, UPRIGHT], ["Maker X1 1", "Maker X1 2"], (0, 1), (0, 0)),
    ([NAMELESS], ["camera"], (0,), (0,)),
])  # fmt: skip
def test_one_camera_for_each_focal_length_and_format(exif, ids, of, lens):
    """Numbered where there are several; both formats share a lens."""
    found = assign_cameras(photographs(*exif))
    assert [camera.id for camera in found.cameras] == ids
    assert found.camera_of == of and found.lens == lens
    for camera, k in zip(found.cameras, range(len(ids))):
        columns, rows = camera.image_size
        assert (camera.parameters["cx"], camera.parameters["cy"]) == (
            (columns - 1) / 2,
            (rows - 1) / 2,
        )
        assert camera.image_size == exif[of.index(k)].size


def test_two_cameras_of_one_model():
    """By their serial numbers, or by the folders of their photographs."""
    exif = [dataclasses.replace(WIDE, serial=serial) for serial in ("1", "2", "1")]
    assert assign_cameras(photographs(*exif)).camera_of == (0, 1, 0)
    left, right = (
        dataclasses.replace(p, path=Path(side) / p.path)
        for p, side in zip(photographs(WIDE, WIDE), ("left", "right"))
    )
    assert assign_cameras([left, right]).camera_of == (0, 0)
    found = assign_cameras([left, right], per_folder=True)
    assert [camera.id for camera in found.cameras] == ["left", "right"]
    assert found.camera_of == found.lens == (0, 1)


def test_as_much_of_the_folders_as_tells_files_and_cameras_apart(tmp_path):
    """Two cameras, left and right, on two days, and a name that is unique."""
    random = np.random.default_rng(0)
    files = ["day1/left/a.png", "day1/right/a.png", "day2/left/a.png", "day2/left/b.png"]
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / file), random.integers(0, 256, (64, 64), np.uint8))
    found, _ = find_photographs([tmp_path / file for file in files])
    names = ["day1/left/a.png", "right/a.png", "day2/left/a.png", "b.png"]
    assert [photograph.name for photograph in found] == names
    cameras = assign_cameras(found, per_folder=True).cameras
    assert [camera.id for camera in cameras] == ["day1/left", "right", "day2/left"]


def test_files_that_cannot_be_used_are_left_out_with_the_reason(tmp_path):
    """Icons, damaged files, copies; the reason does not repeat the path."""
    random = np.random.default_rng(0)
    for name, size in {"a": 64, "b": 64, "icon": 63}.items():
        grey = random.integers(0, 256, (size, 80), np.uint8)
        cv2.imwrite(str(tmp_path / f"{name}.png"), grey)
    (tmp_path / "copy.png").write_bytes((tmp_path / "a.png").read_bytes())
    (tmp_path / "damaged.png").write_bytes((tmp_path / "a.png").read_bytes()[:20])
    found, left_out = find_photographs([tmp_path])
    assert [photograph.name for photograph in found] == ["a.png", "b.png"]
    assert left_out.keys() == {"icon.png", "copy.png", "damaged.png"}
    assert left_out["icon.png"] == "80 × 63 pixels are too few"
    assert left_out["copy.png"] == "the same file as a.png"
    assert str(tmp_path) not in left_out["damaged.png"]
    (tmp_path / "b.png").unlink()
    with pytest.raises(InputError, match=r"1 of 4 photographs .*icon.png \(80 × 63 pixels are"):
        find_photographs([tmp_path])
