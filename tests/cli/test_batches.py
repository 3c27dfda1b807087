"""Which lines count as the result of an existing input."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from batch_cameras import images_of, write_cameras
from pyarrow.parquet import read_table

from jaxbundle.batches import work
from jaxbundle.batches.run_on_files import _difference, key_of, run_batch
from jaxbundle.errors import InputError
from jaxbundle.io.writing.fingerprints import of_input
from jaxbundle.system.paths import relative_path

EXAMPLE = Path(__file__).parents[2] / "examples" / "convergent4"
FREE = ["fx", "fy", "k1"]
"""As in `test_batch_command`: the same compiled program."""


def keys(file: Path):
    return [json.loads(line)["key"] for line in file.read_text().splitlines()]


@pytest.fixture
def images():
    return images_of(4)


@pytest.fixture
def start(tmp_path, images, monkeypatch):
    """A run in another folder: path of the cameras, file, and how to run again."""
    monkeypatch.chdir(tmp_path)
    path = write_cameras(tmp_path / "cameras.npz", images)
    file = tmp_path / "results.jsonl"

    def again(inputs=(path,), **options):
        return run_batch(inputs, file, **dict(free=FREE) | options)

    assert again() == {"converged": 4}
    return path, file, again


def test_a_key_is_the_same_however_the_path_is_written(start, tmp_path, monkeypatch):
    path, file, again = start
    assert keys(file) == [f"cameras.npz#serial {i}" for i in range(4)]
    (tmp_path / "sub").mkdir()
    (tmp_path / "same").symlink_to(tmp_path)
    for folder in (".", "./", "sub/..", "same", tmp_path):
        spelling = f"{folder}/cameras.npz"
        assert again([spelling]) == {"converged": 4, "skipped": 4}, spelling
    assert again(["./cameras.npz", path]) == {"converged": 4, "skipped": 4}
    monkeypatch.chdir(tmp_path / "sub")
    assert again(["../cameras.npz"]) == {"converged": 4, "skipped": 4}
    monkeypatch.chdir(tmp_path.parent)
    inside = Path(tmp_path.name)
    assert run_batch([inside / "cameras.npz"], inside / "same" / "results.jsonl", free=FREE) == {
        "converged": 4, "skipped": 4,
    }  # fmt: skip
    assert key_of(tmp_path / "model" / "", file) == "model"
    assert key_of(tmp_path / "a.toml", tmp_path / "out" / "results.jsonl") == "../a.toml"


def test_a_path_on_another_drive_is_absolute(monkeypatch, tmp_path):
    """As `os.path.relpath` of Windows says: `ValueError`."""

    def no_way(path, start):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", no_way)
    assert relative_path(tmp_path / "a.tif", "elsewhere") == str(tmp_path / "a.tif")
    assert key_of(tmp_path / "a.toml", tmp_path / "b.jsonl") == (tmp_path / "a.toml").as_posix()


@pytest.mark.parametrize("options, said", [
    (dict(model="kannala-brandt"), "model was opencv, is kannala-brandt"),
    (dict(free=["fx", "fy"]), "free was fx,fy,k1, is fx,fy"),
    (dict(free=None), "is fx,fy,cx,cy,k1,k2,p1,p2,k3"),
    (dict(brief=True), "brief was False, is True"),
])  # fmt: skip
def test_other_settings_are_refused(start, options, said):
    _, file, again = start
    before = file.read_bytes()
    with pytest.raises(InputError) as error:
        again(**options)
    assert said in str(error.value) and "has 4 of these" in str(error.value)
    assert "--json-lines" in str(error.value) and "--renew" in str(error.value)
    assert file.read_bytes() == before


def test_renewed_are_those_of_other_settings_or_data_alone(start, images):
    path, file, again = start
    lines = file.read_text().splitlines()
    images[2] += np.random.default_rng(1).normal(0, 0.1, images[2].shape)
    # More cameras, another type, no mask: the others are what they were.
    write_cameras(path, np.concatenate([images, images[:1]]), visible=np.ones((5, 6, 20), int))
    with pytest.raises(InputError, match="has 1 of .*serial 2: the measurements were others"):
        again()
    assert again(renew=True) == {"converged": 5, "skipped": 3}
    after = file.read_text().splitlines()
    assert after[:3] == [lines[0], lines[1], lines[3]]
    assert keys(file)[3:] == ["cameras.npz#serial 2", "cameras.npz#serial 4"]
    write_cameras(path, images, object_points=images_of(1)[0, 0, :, [0, 1, 1]].T)
    with pytest.raises(InputError, match="has 4 of .*the measurements were others"):
        again()


def test_snooping_is_a_setting_of_its_lines(start, images):
    path, file, again = start
    with pytest.raises(InputError, match="snooping was None, is pope"):
        again(snooping="pope")
    images[1, :, 7] += 30
    write_cameras(path, images)
    file.unlink()
    assert again() == {"converged": 3, "misfit": 1}
    # A misfit has its values: it is not computed again.
    assert again(retry=True) == {"converged": 3, "misfit": 1, "skipped": 4}
    assert again(snooping="pope", renew=True) == {"converged": 4}
    row = [json.loads(line) for line in file.read_text().splitlines()][1]
    assert row["removed"] == [[view, 7] for view in range(6)]
    assert row["settings"]["snooping"] == "pope" and "remark" not in row
    with pytest.raises(InputError, match="snooping was pope, is None"):
        again()


@pytest.mark.parametrize("given, said", [
    ({"correlated": True}, "correlated was True, is None"), ({}, ""),
])  # fmt: skip
def test_correlated_errors_are_a_setting_of_their_lines(given, said):
    without = work.Work(("a",), {}, lambda _: "data", lambda *_: [])
    assert _difference({"settings": given, "data": "data"}, without, 0) == said


def test_the_limit_of_iterations_matters_where_it_was_reached(start):
    _, file, again = start
    assert again(max_iterations=50) == {"converged": 4, "skipped": 4}
    file.unlink()
    assert again(max_iterations=2) == {"iteration limit": 4}
    with pytest.raises(InputError, match="max_iterations was 2, is 100"):
        again()
    assert again(max_iterations=2) == {"iteration limit": 4, "skipped": 4}
    assert again(retry=True) == {"converged": 4}
    assert again(retry=True) == {"converged": 4, "skipped": 4}


def test_a_file_of_an_earlier_version_is_understood(start):
    _, file, again = start
    old = [json.loads(line) for line in file.read_text().splitlines()]
    for row in old:
        del row["settings"], row["data"]
    file.write_text("".join(json.dumps(row) + "\n" for row in old))
    with pytest.raises(InputError, match="does not say what it was computed from"):
        again()
    # What is not asked for is left alone.
    elsewhere = old[0] | {"key": "elsewhere.npz#1"}
    file.write_text(json.dumps(elsewhere) + "\n" + json.dumps(old[0]) + "\n")
    assert again(renew=True) == {"converged": 4}
    assert len(keys(file)) == 5 and keys(file)[0] == "elsewhere.npz#1"


def test_lines_of_odd_content_are_no_results_of_these(start):
    _, file, again = start
    row = json.loads(file.read_text().splitlines()[0])
    for odd in (dict(status=[1]), dict(settings=3), dict(settings={"free": None}), dict(data={})):
        file.write_text(json.dumps(row | odd) + "\n")
        if "status" in odd:
            assert again() == {"converged": 3, "[1]": 1, "skipped": 1}
        else:
            with pytest.raises(InputError, match="has 1 of these"):
                again()


def test_a_rewritten_network_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "network_row", lambda *path, **options: {"status": "converged"})
    project = shutil.copytree(EXAMPLE, tmp_path / "block") / "project.toml"
    file = tmp_path / "results.jsonl"
    assert run_batch([project, project.parent], file) == {"converged": 2}
    assert keys(file) == ["block/project.toml", "block"]
    for path in (project, project.parent / "observations.csv"):
        assert run_batch([project, project.parent], file)["skipped"] == 2
        path.write_text(path.read_text() + "# looked through\n")
        with pytest.raises(InputError, match="block/project.toml: its files were others"):
            run_batch([project, project.parent], file)
        assert run_batch([project, project.parent], file, renew=True) == {"converged": 2}


@pytest.mark.parametrize(
    ("input", "part"),
    [
        ("opensfm", "opensfm/reconstruction.json"),
        ("Ori-All", "Ori-All/Orientation-1.jpg.xml"),
        ("mrcal", "mrcal/a.cameramodel"),
        ("realityscan", "realityscan/1.xmp"),
        ("mav0", "mav0/cam1/sensor.yaml"),
        ("opensfm/reconstruction.json", "opensfm/tracks.csv"),
        ("a.phc", "a.eor"),
        ("a [1].psx", "a [1].files/0/chunk.zip"),
        ("a.opf", "tracks 1.bin"),
        ("vins.yaml", "cam0.yaml"),
        ("bundle.out", "list.txt"),
    ],
)
def test_the_fingerprint_of_a_network_is_of_all_it_is_read_from(input, part, tmp_path):
    texts = {
        "a.opf": '{"items": [{"resources": [{"uri": "points.gltf"}]}]}',
        "points.gltf": '{"buffers": [{"uri": "tracks%201.bin"}]}',
        "vins.yaml": "cam0_calib: cam0.yaml\n",
    }
    for name in (input, part, *texts):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if not (tmp_path / name).exists() and Path(name).suffix:
            (tmp_path / name).write_text(texts.get(name, "1"))
    first = of_input(tmp_path / input)
    (tmp_path / part).write_text("2")
    assert of_input(tmp_path / input) != first


def test_the_fingerprint_of_a_network_is_of_its_files(tmp_path):
    model = tmp_path / "sparse"
    model.mkdir()
    for name in ("cameras.bin", "images.bin", "points3D.bin", "photo.jpg"):
        (model / name).write_bytes(name.encode())
    first = of_input(model)
    (model / "photo.jpg").write_bytes(b"another")
    os.utime(model / "cameras.bin", (0, 0))
    assert of_input(model) == of_input(shutil.copytree(model, tmp_path / "copy")) == first
    (model / "points3D.bin").write_bytes(b"another")
    assert of_input(model) != first
    bad = tmp_path / "bad.toml"
    found = set()
    for text in (b"", b"[project", b"\xff", b'a = "\\u0000"', b'a = ["bad.toml", "..", "no.csv"]'):
        bad.write_bytes(text)
        found.add(of_input(bad))
    assert len(found) == 5


@pytest.mark.parametrize("options", [dict(portion=0), dict(max_iterations=0), dict(free="fx")])
def test_bad_options_are_refused(start, options):
    with pytest.raises(InputError, match=next(iter(options))):
        start[2](**options)


def test_inputs_are_looked_at_before_anything_is_written(tmp_path):
    file = tmp_path / "results.jsonl"
    with pytest.raises(InputError, match="none.toml"):
        run_batch([EXAMPLE, tmp_path / "none.toml"], file)
    assert not file.exists()


def test_the_table_of_the_docs(start, tmp_path):
    """docs/calibrate.md reads the file as a table."""
    docs = (Path(__file__).parents[2] / "docs" / "calibrate.md").read_text(encoding="utf-8")
    (code,) = (c for c in re.findall(r"```python\n(.*?)```", docs, re.S) if "pandas" in c)
    found = {}
    exec(code, found)
    table = found["table"]
    assert table.index.tolist() == keys(tmp_path / "results.jsonl")
    assert table["status"].eq("converged").all()
    assert table["parameters.fx.value"].between(850, 1150).all()


def test_the_population_beside_the_lines(start, command, tmp_path):
    """Table, summary and page of the same lines; what cannot be written is refused first."""
    path, file, _ = start
    (tmp_path / "made.csv").write_text("id,made,batch\n" + "".join(
        f"serial {i},2026-05-0{i + 1},{i % 2}\n" for i in range(4)
    ))  # fmt: skip
    given = ("batch", path, "--json-lines", file, "--free", ",".join(FREE))
    told = command(*given, "--table", "cameras.csv", "--summary", "population.json", "--against",
                   "made.csv", "--html", "page.html")  # fmt: skip
    assert told.status == 0, told.err
    table = [line.split(",") for line in Path("cameras.csv").read_text().splitlines()]
    names = table[0]
    assert {"key", "status", "rms", "fx", "sigma_fx", "farthest", "made", "batch"} <= {*names}
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    for cells, row in zip(table[1:], rows, strict=True):
        found = dict(zip(names, cells))
        assert found["key"] == row["key"]
        assert float(found["fx"]) == row["parameters"]["fx"]["value"]
        assert float(found["batch"]) == int(row["key"][-1]) % 2
    summary = json.loads(Path("population.json").read_text())
    assert summary["status"] == {"converged": 4} and summary["parameters"]["fx"]["cameras"] == 4
    assert summary["correlations"] == []  # of four cameras nothing is said
    assert "Parameters of the population" in Path("page.html").read_text()
    before = file.read_bytes()
    for wrong, said in (
        (("--table", "cameras.txt"), "ends with .csv or .parquet"),
        (("--table", path), "part of the input"),
        (("--summary", "made.csv"), "is not JSON"),
        (("--against", "made.csv"), "as well"),
        (("--against", "none.csv", "--table", "a.csv"), "none.csv"),
    ):
        told = command(*given, *wrong)
        assert told.status == 2 and said in told.err and told.err.count("\n") == 1, wrong
    assert file.read_bytes() == before


def test_a_table_as_parquet(start, command):
    path, file, _ = start
    given = ("batch", path, "--json-lines", file, "--free", ",".join(FREE))
    assert command(*given, "--table", "cameras.parquet").status == 0
    table = read_table("cameras.parquet").to_pydict()
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert table["key"] == [row["key"] for row in rows]
    assert table["fx"] == [row["parameters"]["fx"]["value"] for row in rows]


def test_a_model_in_millimetres_needs_the_size_of_a_pixel(images, tmp_path):
    path = write_cameras(tmp_path / "cameras.npz", images)
    with pytest.raises(InputError, match="model 'brown' is in mm: give .*--pixel-size"):
        run_batch([path], tmp_path / "results.jsonl", model="brown")


@pytest.mark.further
@pytest.mark.parametrize("model", ["eucm", "radial-spline-3-80", "division"])
def test_other_models_without_start_values(images, tmp_path, model):
    """Of perspective cameras: the residuals are the noise."""
    path, file = write_cameras(tmp_path / "cameras.npz", images), tmp_path / "results.jsonl"
    given = {"eucm": ["fx", "fy", "alpha"], "division": ["fx", "fy", "k"]}
    run_batch([path], file, model=model, free=given.get(model, ["fx", "fy", "s3"]))
    for line in file.read_text().splitlines():
        assert 0.1 < json.loads(line)["rms"] < 0.2
