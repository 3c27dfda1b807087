"""A board of others, if the folder of real data is next to the checkout."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "shared" / "data" / "real" / "small" / "charuco_inverted"


@pytest.mark.further
@pytest.mark.skipif(not FOLDER.is_dir(), reason="the folder ../shared/data/real is not here")
def test_a_white_on_black_board_is_calibrated(tmp_path):
    """Rendered with fx 620, fy 621, cx 319.5, cy 239.5, no distortion; nothing was found."""
    result = tmp_path / "result.json"
    done = subprocess.run(
        [sys.executable, "-m", "jaxbundle", "calibrate", FOLDER, "--kind", "charuco", "--board",
         "4x5", "--square", "0.03", "--marker", "0.0225", "--json", result],
        capture_output=True, text=True, cwd=Path(__file__).parents[2], check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "light squares on dark ground" in done.stdout and "in 8 of 8 photographs" in done.stdout
    (camera,) = json.loads(result.read_text())["cameras"].values()
    for name, true in (("fx", 620.0), ("fy", 621.0), ("cx", 319.5), ("cy", 239.5)):
        found = camera["parameters"][name]
        assert abs(found["value"] - true) < 3.5 * found["sigma"]
        assert found["sigma"] < 1
