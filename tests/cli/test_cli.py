"""The command line as a user sees it: exit status, one line of error, nothing half-written."""

import dataclasses
import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import jaxbundle
from jaxbundle.io import exchange
from jaxbundle.io.cameras.result_json import read_calibrated

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "convergent4"


def run(*arguments, cwd=ROOT):
    command = [sys.executable, "-m", "jaxbundle", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd)


@pytest.fixture
def project(tmp_path):
    """A copy of the example that may be damaged."""
    folder = tmp_path / "network"
    shutil.copytree(EXAMPLE, folder)
    return folder


def edit(path: Path, old: str, new: str):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.slow
def test_adjust_writes_everything(command, tmp_path):
    out, file = tmp_path / "out", tmp_path / "result.json"
    page = tmp_path / "page.html"
    done = command("adjust", EXAMPLE / "project.toml", "--json", file, "--out", out, "--html", page)
    assert done.status == 0, done.err
    assert done.err == ""
    result = json.loads(file.read_text())
    assert result["converged"] is True
    assert result["redundancy"] == 23 and result["observations"] == 80
    assert result["unknowns"] == 64 and result["defect"] == 7
    assert result["sigma0"] == pytest.approx(0.63128 / 0.7, rel=1e-5)
    c = result["cameras"]["cam"]["parameters"]["c"]
    assert c["value"] == pytest.approx(18.528014315, abs=0.002 * 0.0453)
    assert c["sigma"] == pytest.approx(0.0453018675, rel=1e-3)
    assert set(result["images"]["DSC_037"]["kappa"]) == {"value", "sigma"}
    assert len(result["residuals"]) == 80
    assert sum(row["r"] for row in result["residuals"]) == pytest.approx(23, abs=1e-6)
    written = {p.name for p in out.iterdir()}
    expected = {"report.txt", "report.html", "result.json", "cameras.csv", "images.csv",
                "points.csv", "residuals.csv", "plan.png", "histogram.png"}  # fmt: skip
    assert expected <= written
    assert {name for name in written if name.startswith(".")} == {".jaxbundle"}
    assert (out / "report.txt").read_text().strip() in done.out
    assert page.read_bytes() == (out / "report.html").read_bytes()
    for given in ("project.toml", "images.csv", "points.csv", "observations.csv"):
        assert hashlib.sha256((EXAMPLE / given).read_bytes()).hexdigest() in page.read_text()


def test_results_of_cameras_in_mm_are_compared(command, convergent4, tmp_path):
    """Their area in mm follows from the size of images and pixels in the file."""
    network = convergent4.network
    sized = dataclasses.replace(
        network.cameras[0], image_size=(3000, 2000), pixel_size=(0.0078, 0.0079)
    )
    result = jaxbundle.adjust(network.replace(cameras=(sized,)))
    file = tmp_path / "result.json"
    file.write_text(json.dumps(result.to_dict(brief=True)))
    ((camera, _),) = read_calibrated(file)
    assert camera.image_size == (3000, 2000) and camera.pixel_size == (0.0078, 0.0079)
    done = command("compare", file, file)
    assert done.status == 0, done.err


@pytest.mark.slow
def test_json_alone_on_stdout(convergent4):
    done = run("adjust", EXAMPLE / "project.toml", "--json", "-", "--brief", "--cores", 1)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert "points" not in result and "residuals" not in result
    assert result["sigma0"] == pytest.approx(0.63128 / 0.7, rel=1e-5)
    table = convergent4.cameras["cam"]
    c, x0 = (table["free"].index(name) for name in ("c", "x0"))
    found = result["cameras"]["cam"]["correlations"]["c"]["x0"]
    assert found == pytest.approx(table["correlations"][c, x0], abs=1e-6)


def test_of_estimated_sigma_correlated_errors_are_looked_for(command):
    """As `reconstruct` does with the network that it writes."""
    project, estimated = EXAMPLE / "project.toml", "sigma_origin=estimated"
    done = command("adjust", project, "--set", estimated)
    assert done.status == 0 and "Correlated errors" in done.out, done.err
    assert "not looked for" in " ".join(done.out.split())  # four photographs
    done = command("adjust", project, "--set", estimated, "--no-correlated")
    assert done.status == 0 and "Correlated errors" not in done.out, done.err


BROKEN = {
    "missing table": ("images.csv", None, None, ["images.csv"]),
    "missing column": ("points.csv", "id,role,X,Y,Z", "id,role,X,Y,H", ["points.csv", "H"]),
    "text in a number": ("observations.csv", "-4.98644", "minus five", ["observations.csv", "x"]),
    "not a number": ("observations.csv", "-4.98644", "nan", ["observations.csv", "x"]),
    "unknown point": ("observations.csv", "DSC_037,1,", "DSC_037,77,", ["observations.csv", "77"]),
    "unknown image": ("observations.csv", "DSC_037,1,", "DSC_999,1,", ["observations", "DSC_999"]),
    "unknown camera": ("images.csv", "DSC_037,cam", "DSC_037,cma", ["images.csv", "cma", "cam"]),
    "unknown model": ("project.toml", '"brown"', '"brwon"', ["brwon", "brown"]),
    "unknown key": ("project.toml", "sigma_image", "sigma_imge", ["sigma_imge", "sigma_image"]),
    "zero principal distance": ("project.toml", "c = 18.556", "c = 0.0", ["c"]),
    "negative sigma": (
        "project.toml", "sigma_image = 0.0007", "sigma_image = -1.0", ["sigma_image"]
    ),
    "duplicate point": ("points.csv", "\n2,tie", "\n1,tie", ["points.csv", "'1'"]),
    "unfixed datum": ("project.toml", '"inner"', '"control"', ["datum", "rotation", "scale"]),
}


@pytest.mark.parametrize("case", BROKEN)
@pytest.mark.slow
def test_bad_input_ends_with_one_helpful_line(command, project, tmp_path, case):
    name, old, new, words = BROKEN[case]
    if old is None:
        (project / name).unlink()
    else:
        edit(project / name, old, new)
    out = tmp_path / "out"
    done = command("adjust", project / "project.toml", "--json", out / "r.json", "--out", out)
    assert done.status == 2, done.err
    assert len(done.err.strip().splitlines()) == 1 and "Traceback" not in done.err
    for word in words:
        assert word in done.err
    assert not out.exists() and done.out == ""


def test_one_image_alone_is_not_solved(command, project):
    for name in ("images.csv", "observations.csv"):
        lines = (project / name).read_text().splitlines()
        kept = [line for line in lines if line.startswith(("id,", "image,", "DSC_037"))]
        (project / name).write_text("\n".join(kept) + "\n")
    done = command("adjust", project / "project.toml", "--json", "-", "--out", project / "out")
    assert done.status == 3
    assert "DSC_037" in done.err and "X0" in done.err
    assert len(done.err.strip().splitlines()) == 1
    told = json.loads(done.out)
    assert told["converged"] is False and "X0 of image DSC_037" in told["undetermined"]
    assert json.loads((project / "out" / "result.json").read_text()) == told


def test_listed_sigmas_of_the_thesis_are_refused_with_the_way_on(command):
    done = command("adjust", EXAMPLE / "convergent4.txt")
    assert done.status == 2
    for word in ("line 6", "DSC_037", "'3'", "--set sigma_image="):
        assert word in done.err


def test_unknown_option_is_bad_usage(command):
    done = command("adjust", EXAMPLE / "project.toml", "--jsn", "x")
    assert done.status == 2
    assert "--jsn" in done.err and "Traceback" not in done.err


@pytest.mark.parametrize("arguments, status, said", [
    ([], 2, "Usage"),
    (["--version"], 0, jaxbundle.__version__),
])  # fmt: skip
def test_without_a_command(command, arguments, status, said):
    done = command(*arguments)
    assert done.status == status and said in done.out


@pytest.mark.parametrize("error, status", [
    (OSError("the disk\nis full"), 2), (OverflowError("too large"), 2),
    (RecursionError("too deep"), 2), (MemoryError(), 2),
    (RuntimeError("RESOURCE_EXHAUSTED: Out of memory"), 2),
])  # fmt: skip
def test_what_nobody_thought_of_ends_in_one_line(command, error, status, monkeypatch):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(exchange, "convert", fail)
    done = command("convert", EXAMPLE, "nowhere")
    lines = done.err.splitlines()
    assert done.status == status and len(lines) == 1 and lines[0].startswith("jaxbundle: ")


def test_a_level_of_significance_is_between_0_and_1(command):
    done = command("adjust", EXAMPLE / "project.toml", "--snooping", "pope", "--significance", "1")
    assert done.status == 2 and "--significance must be a number between 0 and 1" in done.err


def test_a_global_test_far_from_passed_is_the_last_line(command, project):
    edit(project / "project.toml", "sigma_image = 0.0007", "sigma_image = 0.0001")
    done = command("adjust", project / "project.toml")
    assert done.status == 0 and "Warnings" in done.out
    last = done.out.splitlines()[-1]
    assert last.startswith("warning: χ² test clearly failed: vᵀPv/redundancy is 39.9 (σ0 6.31)")


def test_not_converged_says_so(command, tmp_path):
    file = tmp_path / "result.json"
    done = command("adjust", EXAMPLE / "project.toml", "--max-iterations", "2", "--json", file)
    assert done.status == 3
    assert "iteration limit" in done.err
    result = json.loads(file.read_text())
    assert result["converged"] is False
    assert "sigma0" not in result and "cameras" not in result


@pytest.mark.further
@pytest.mark.slow
def test_orient_writes_a_project_with_start_values(command, project, tmp_path):
    images = (project / "images.csv").read_text().splitlines()
    bare = [images[0], *(",".join(row.split(",")[:2] + [""] * 6) for row in images[1:])]
    (project / "images.csv").write_text("\n".join(bare) + "\n")
    done = command("orient", project / "project.toml", "--out", tmp_path / "oriented")
    assert done.status == 0, done.err
    assert "placed 4 images of 4 and 10 points of 10" in done.out
    found = jaxbundle.read_network(tmp_path / "oriented")
    given = jaxbundle.read_network(EXAMPLE)
    # the approximate points that were left give the frame; those of the example are good to 1e-3
    assert abs(found.images.position - given.images.position).max() < 0.05


def test_orient_names_what_is_missing(command, project):
    rays = (project / "observations.csv").read_text().splitlines()
    (project / "observations.csv").write_text("\n".join([rays[0], *rays[1:4], rays[12]]) + "\n")
    images = (project / "images.csv").read_text().splitlines()
    bare = [images[0], *(",".join(row.split(",")[:2] + [""] * 6) for row in images[1:])]
    (project / "images.csv").write_text("\n".join(bare) + "\n")
    done = command("orient", project / "project.toml")
    assert done.status == 3 and done.out == ""
    assert "no start values found" in done.err and done.err.count("\n") == 1


@pytest.mark.parametrize(
    "options, said",
    [
        (("--join", "nonsense", 2, 0), "'nonsense'"),
        (("--join", "127.0.0.1:99999", 2, 0), "'127.0.0.1:99999'"),
        (("--join", "127.0.0.1:0", 2, 0), "'127.0.0.1:0'"),
        (("--join", "127.0.0.1:9922", 2, 5), "process 5 of 2"),
        (("--join", "127.0.0.1:9922", 2, -1), "process must be a whole number from 0"),
        (("--join", "no.machine.invalid:9922", 2, 1), "no machine 'no.machine.invalid'"),
        (("--join", "127.0.0.1:9922", 2, 0, "--cluster"), "give one of them"),
        (("--join", "127.0.0.1:9922", 2, 0, "--json", "-"), "give a file"),
        (("--join", "127.0.0.1:9922", 2, 0, "--json", "/dev/stdout"), "give a file"),
    ],
)
def test_processes_that_cannot_be_joined(command, options, said):
    done = command("adjust", EXAMPLE / "project.toml", "--quiet", *options)
    assert done.status == 2
    assert said in done.err and "Traceback" not in done.err
    assert not done.out


@pytest.mark.further
def test_a_cluster_that_is_none_ends_the_process():
    done = run("adjust", EXAMPLE / "project.toml", "--quiet", "--cluster")
    assert done.returncode == 2 and not done.stdout
    assert "no SLURM variables" in done.stderr and done.stderr.count("\n") == 1
