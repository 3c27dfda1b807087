"""Cameras by what photographs say of themselves."""

import dataclasses
from pathlib import Path

import pytest

from jaxbundle.photographs.exif import Exif
from jaxbundle.reconstruction.photographs import Photograph, assign_cameras


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
