"""Every result offers the same methods (`jaxbundle.results.ReportedResult`)."""

import dataclasses
import json

import numpy as np
import pytest

import jaxbundle
from jaxbundle import calibration, refinement
from jaxbundle.calibration.stability import stability
from jaxbundle.pushbroom import ScannerTable
from jaxbundle.results import ReportedResult

METHODS = ("converged", "report", "to_dict", "save", "_repr_html_")
CLASSES = (
    jaxbundle.Acceptance, jaxbundle.Certificate, jaxbundle.LengthTest,
    jaxbundle.PositionalAccuracy, jaxbundle.UncertaintyBudget,
    jaxbundle.Adjustment, jaxbundle.AdjustmentComparison, jaxbundle.BatchCalibration,
    jaxbundle.BatchRun, jaxbundle.Budget, jaxbundle.Calibration, jaxbundle.CalibrationComparison,
    jaxbundle.CameraDescription, jaxbundle.CloudResult, jaxbundle.Design, jaxbundle.HandEye,
    jaxbundle.Influence,
    jaxbundle.Oriented, jaxbundle.PlannedBlock, jaxbundle.Reconstruction, jaxbundle.RigBatch,
    jaxbundle.Stability, jaxbundle.Surface, ScannerTable, calibration.Calibrations,
    calibration.ModelComparison, calibration.RigCalibration, refinement.Refinement,
)  # fmt: skip


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_class_of_results_has_the_methods(kind):
    fields = {name for one in kind.__mro__ for name in getattr(one, "__annotations__", ())}
    missing = [name for name in METHODS if not hasattr(kind, name) and name not in fields]
    assert not missing
    assert kind.__str__ is not object.__str__


def camera(**parameters):
    values = {"fx": 800.0, "fy": 800.0, "cx": 320.0, "cy": 240.0} | parameters
    return jaxbundle.Camera("cam", "opencv", values, image_size=(640, 480))


def examples(convergent4):
    C = (["fx", "fy", "cx", "cy"], np.eye(4) * 0.01)
    cloud = jaxbundle.surfaces.cloud
    covariance = np.tile(np.eye(3) * 1e-4, (3, 1, 1))
    points = cloud.Cloud(
        np.eye(3), covariance, np.full(3, 2), np.zeros(3, int), np.zeros((3, 2)), ("a",)
    )
    yield convergent4
    yield jaxbundle.compare(convergent4, convergent4)
    yield jaxbundle.accept(convergent4, "sigma0 < 1.2")
    yield jaxbundle.uncertainty_budget(convergent4, "camera:cam:c")
    yield jaxbundle.camera(camera(k1=-0.1))
    yield jaxbundle.compare(camera(), camera(fx=801.0))
    yield jaxbundle.compare((camera(), C), (camera(fx=801.0), C))
    yield stability([(camera(), C), (camera(fx=800.2), C)])
    yield jaxbundle.plan(100, (68, 104), (300, 300), 0.003, height=1000, network=False)
    yield jaxbundle.cloud(points, size=1.0)
    yield jaxbundle.BatchRun(("a.npz",), "results.jsonl", {"converged": 3, "skipped": 2})
    yield ScannerTable({"line": [0.0, np.nan], "status": ["found", "off"]}, {"scanner": "s"})
    yield jaxbundle.orient(convergent4.network)


def test_results_say_and_write_what_they_are(convergent4, tmp_path):
    number = 0
    for result in filter(None, examples(convergent4)):
        name = type(result).__name__
        assert isinstance(result, ReportedResult), name
        assert bool(np.all(result.converged)), name
        assert str(result) and result.report(), name
        assert "<" in result._repr_html_(), name
        if isinstance(result, jaxbundle.Adjustment):
            assert result.to_dict()["sigma0"] == result.sigma0
            json.dumps(result.to_dict(), allow_nan=False)
            continue
        if isinstance(result, jaxbundle.BatchRun):
            continue  # its population is in the file
        assert len(result.to_pandas()) == len(next(iter(result.table().values()))) > 0, name
        path = tmp_path / f"{name}.json"
        result.save(path)
        assert json.loads(path.read_text()) == json.loads(json.dumps(result.to_dict())), name
        assert [p.name for p in tmp_path.iterdir() if p.suffix != ".json"] == [], name
        number += 1
    assert number > 7


def test_a_name_that_is_not_utf_8_is_written_as_it_can_be(tmp_path):
    named = dataclasses.replace(camera(), id="caf\udce9")
    jaxbundle.camera(named).save(tmp_path / "camera.json")
    assert "caf\ufffd" in (tmp_path / "camera.json").read_text(encoding="utf-8")


def test_a_result_that_cannot_be_written_says_where(tmp_path):
    with pytest.raises(jaxbundle.InputError, match="nowhere.*cannot be written"):
        jaxbundle.camera(camera()).save(tmp_path / "nowhere" / "camera.json")
