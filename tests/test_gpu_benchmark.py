"""The benchmark for GPUs needs no package beyond those of the solver, and says what it left out."""

import os
import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
WITHOUT = """
import sys

class Blocked:
    names = {"rich", "typer", "cv2", "matplotlib", "pandas", "PIL", "pyproj", "rasterio", "xarray"}

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"{name} is not installed", name=name)

sys.meta_path.insert(0, Blocked())
import calibration, gpu, pushbroom
import jaxbundle
jaxbundle.enable_x64()
gpu.SCENES["arc"] = "arc", 5, 50
gpu._problem("arc", None)
jaxbundle.calibrate_batch, jaxbundle.leastsquares.solve
"""


def test_no_other_package_is_needed():
    found = subprocess.run(
        [sys.executable, "-c", WITHOUT], cwd=BENCHMARKS, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(BENCHMARKS.parent)},
    )  # fmt: skip
    assert found.returncode == 0, found.stderr[-2000:]


def test_what_there_is_no_time_for_is_left_out():
    found = subprocess.run(
        [sys.executable, "gpu.py", "--parts", "bal 16", "arc", "--seconds", "1"],
        cwd=BENCHMARKS, capture_output=True, text=True,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr[-2000:]
    assert "left out: no problem-16-22106-pre.txt (--bal FOLDER)" in found.stdout
    assert "left out: no time left" in found.stdout
