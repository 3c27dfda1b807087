"""One set of rendered photographs, with bad ones among them, calibrated once."""

import board_photographs as taken
import cv2
import numpy as np
import pytest
import render

from jaxbundle.calibration import calibrate

VIEWS = 12


@pytest.fixture(scope="package")
def folder(tmp_path_factory):
    """Twelve photographs of a chessboard, and six files that cannot be used."""
    folder = tmp_path_factory.mktemp("photographs")
    pictures = taken.rendered(render.LENS, taken.poses(VIEWS))
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"photo_{i:02d}.png"), picture)
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "text.jpg").write_text("no photograph")
    cv2.imwrite(str(folder / "grey.png"), np.full((360, 480), 120, np.uint8))
    cv2.imwrite(str(folder / "turned.png"), np.ascontiguousarray(pictures[0].T[:, ::-1]))
    other = taken.rendered(render.LENS, taken.poses(1), render.chessboard(7, 5, 0.035))[0]
    cv2.imwrite(str(folder / "other.png"), other)
    (folder / "notes.txt").write_text("not looked at")
    return folder


@pytest.fixture(scope="package")
def calibration(folder):
    return calibrate([folder], taken.BOARD)
