"""The result of an adjustment as JSON (the fields are listed in docs/result.md).

σ are a posteriori, w uses the a priori σ. A missing number (the σ of a held camera parameter, the
MDB of an uncontrolled observation) is null; the σ of a fixed point and of held parameters of an
exterior orientation are 0.
"""

import json
import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.io.text.csv_tables import table_rows, take_portions
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment
    from jaxbundle.adjustment.second_minima.evidence import SecondMinimum
    from jaxbundle.network.tables import Camera
    from jaxbundle.report.verdict import Verdict


# Of the parameters of a camera: classical, and under correlated errors where these are known.
CORRELATIONS = ("correlations", "correlations_correlated")


def result_dict(adjustment: "Adjustment", brief: bool = False) -> dict:
    """The result as plain dicts and numbers; `brief` leaves points and residuals out."""
    counts = adjustment.counts
    head = {
        "converged": adjustment.converged,
        "termination": adjustment.termination,
        "iterations": adjustment.iterations,
        "method": adjustment.method,
        "reduction": adjustment.reduction,
        "observations": counts.observations,
        "pseudo_observations": counts.pseudo_observations,
        "unknowns": counts.unknowns,
        "datum": adjustment.network.datum,
        "defect": counts.datum,
        "redundancy": counts.redundancy,
        "residual_domain": adjustment.network.residuals,
        "units": {
            "object": adjustment.network.object_unit,
            "image": adjustment.network.image_unit,
            "angle": adjustment.network.angle_unit,
            "residuals": {
                camera.id: get_model(camera.model).unit for camera in adjustment.network.cameras
            },
        },
        "warnings": list(adjustment.warnings),
        "notes": list(adjustment.notes),
        "left_out": [
            {"kind": note.thing, "names": list(note.names), "reason": note.why}
            for note in adjustment.problem.network.left_out
        ],
    }
    if not adjustment.converged:
        return head | {"undetermined": list(adjustment.undetermined)}
    head |= {"sigma0": adjustment.sigma0, "vtpv": adjustment.vtpv, "sigma": "a posteriori"}
    head["image_rms"] = adjustment.image_rms
    head |= {"sigma_factors": adjustment.sigma_factors, "robust": adjustment.robust}
    head |= {"robust_scale": adjustment.robust_scale, "global_test": adjustment.global_test()}
    head |= {
        "cameras": {
            network_camera.id: _camera(adjustment.cameras[network_camera.id], network_camera)
            for network_camera in adjustment.problem.network.cameras
        },
        "images": _images(adjustment),
        "further_unknowns": adjustment.further_unknowns,
        "far_points": _far_points(adjustment),
        "removed": [{"kind": r.kind, "name": r.name, "test": r.test} for r in adjustment.removed],
        "suspects": [
            {"kind": s.kind, "name": s.name, "test": s.test, "weight": s.weight}
            for s in adjustment.suspects
        ],
        "eliminated": [
            {"camera": name.id, "parameter": name.parameter} for name in adjustment.eliminated
        ],
    }
    head |= {"second_minima": [_second_minimum(adjustment, s) for s in adjustment.second_minima]}
    head |= {"check_points": _check_points(adjustment)}
    if adjustment.control_prediction is not None:
        head |= {"control_prediction": _control_prediction(adjustment)}
    if adjustment.error_model is not None:
        sizes, unit = adjustment.error_model.sizes, adjustment.image_unit
        head |= {"error_components": [size.to_dict(unit) for size in sizes]}
        head |= {"sigma_ratio": adjustment.sigma_ratio}
    if adjustment.replication is not None:
        head |= {"replication": adjustment.replication.brief()}
    if brief:
        return head
    return head | {
        "verdict": verdict_dict(adjustment.verdict),
        "variance_components": _variance_components(adjustment),
        "points": dict(_points(adjustment.points)),
        "residuals": list(_residuals(adjustment.residuals)),
    }


def unsolved_text(error: NotSolvedError) -> str:
    """The JSON text of an adjustment that ended without an `Adjustment`."""
    head = {"converged": False, "termination": str(error), "undetermined": [*error.undetermined]}
    return json.dumps(head, ensure_ascii=False) + "\n"


def result_text(
    adjustment: "Adjustment", brief: bool = False, further_entries: Mapping = MappingProxyType({})
) -> Iterator[str]:
    """The result as JSON text, one line that ends with a line feed, in pieces: 2 000 000
    image points take 1 GB. `further_entries`: beside those of `result_dict`."""
    # Without the long tables, which would need their memory at once.
    head = result_dict(adjustment, brief=True) | dict(further_entries)
    if brief or not adjustment.converged:
        yield _text(head) + "\n"
        return
    summary = {"verdict": verdict_dict(adjustment.verdict)}
    summary |= {"variance_components": _variance_components(adjustment)}
    # The two long tables are written in portions between the braces of the rest.
    yield _text({**summary, **head})[:-1]
    yield ', "points": {'
    yield from _join(
        _text(dict(portion))[1:-1] for portion in take_portions(_points(adjustment.points))
    )
    yield '}, "residuals": ['
    yield from _join(
        _text(portion)[1:-1] for portion in take_portions(_residuals(adjustment.residuals))
    )
    yield "]}\n"


def _text(value: Any) -> str:
    return json.dumps(without_nan(value), ensure_ascii=False)


def _join(pieces: Iterator[str]) -> Iterator[str]:
    for number, piece in enumerate(pieces):
        yield ", " + piece if number else piece


def without_nan(value: Any) -> Any:
    """NaN and infinity do not exist in JSON: null."""
    if isinstance(value, dict):
        return {key: without_nan(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(document: Mapping[str, Any]) -> str:
    """A document as JSON text of one line, ended by a line feed; what is not finite is null."""
    return json.dumps(without_nan(dict(document)), ensure_ascii=False) + "\n"


def verdict_dict(verdict: "Verdict") -> dict:
    """A verdict (`report.verdict`) as plain dicts."""
    state, words, findings = verdict
    return {
        "state": state,
        "words": words,
        "findings": [{"about": f.about, "state": f.state, "words": f.words} for f in findings],
    }


def _camera(table: dict, camera: "Camera") -> dict:
    free_names = table["free"]
    by_name = lambda C: {
        a: {b: float(C[i, j]) for j, b in enumerate(free_names) if j != i}
        for i, a in enumerate(free_names)
    }
    return {
        "model": table["model"],
        "image_size": camera.image_size and list(camera.image_size),
        "pixel_size": camera.pixel_size and list(camera.pixel_size),
        "parameters": table["parameters"],
        **{name: by_name(table[name]) for name in CORRELATIONS if name in table},
    }


def _estimate(value: float, sigma: float) -> dict:
    return {"value": value, "sigma": sigma}


def _images(adjustment: "Adjustment") -> dict:
    columns = {name: column.tolist() for name, column in adjustment.images.items()}
    correlated = lambda name, i: (
        {"sigma_correlated": columns[f"s{name}_correlated"][i]}
        if f"s{name}_correlated" in columns
        else {}
    )
    return {
        image: {
            name: _estimate(columns[name][i], columns[f"s{name}"][i]) | correlated(name, i)
            for name in EXTERIOR
        }
        | {"rays": columns["rays"][i], "rms": columns["rms"][i]}
        for i, image in enumerate(columns["id"])
    }


def _variance_components(adjustment: "Adjustment") -> dict:
    return {
        name: {
            "observations": c.observations,
            "redundancy": c.redundancy,
            "vtpv": c.vtpv,
            "sigma": c.sigma,
            "factor": c.factor,
            "estimated": list(c.estimated),
            "unit": c.unit,
        }
        for name, c in adjustment.variance_components.items()
    }


def _points(table: Mapping[str, np.ndarray]) -> Iterator[tuple[str, dict]]:
    for row in table_rows(table):
        point = dict(zip(table, row))
        estimates = {axis: _estimate(point[axis], point[f"s{axis}"]) for axis in "XYZ"}
        if "sX_correlated" in point:
            for axis, entry in estimates.items():
                entry["sigma_correlated"] = point[f"s{axis}_correlated"]
        yield (
            point["id"],
            {"role": point["role"]} | estimates | {"rays": point["rays"], "rms": point["rms"]},
        )


def _second_minimum(adjustment: "Adjustment", minimum: "SecondMinimum") -> dict:
    return {
        "ambiguity": minimum.ambiguity,
        "images": list(minimum.images),
        "vtpv": minimum.vtpv,
        "other_vtpv": minimum.other_vtpv,
        "difference": minimum.difference,
        "evidence": minimum.evidence,
        "probability": minimum.probability,
        "ambiguous": minimum.ambiguous,
        "taken": minimum.taken,
        "turn": minimum.turn * adjustment.angle_scale,
        "shift": minimum.shift,
    }


def _far_points(adjustment: "Adjustment") -> dict:
    far_points = adjustment.far_points
    if far_points is None:
        return {}
    columns = {name: column.tolist() for name, column in adjustment.table("far_points").items()}
    inverse = zip(far_points.inverse_distance.tolist(), far_points.sigma_inverse_distance.tolist())
    return {
        "origin": dict(zip("XYZ", far_points.origin.tolist())),
        "points": {
            point: {
                "direction": {axis: columns[f"u{axis}"][i] for axis in "XYZ"},
                "sigma_direction": columns["su"][i],
                "inverse_distance": _estimate(*estimate),
                "at_infinity": columns["at_infinity"][i],
            }
            for i, (point, estimate) in enumerate(zip(columns["id"], inverse))
        },
    }


def _residuals(table: Mapping[str, np.ndarray]) -> Iterator[dict]:
    for row in table_rows(table):
        yield dict(zip(table, row))


def _control_prediction(adjustment: "Adjustment") -> dict:
    points, rays = (adjustment.table(name) for name in ("control", "control_measurements"))
    error = lambda row, axes: (
        {a: {"error": row[f"d{a}"], "sigma": row[f"s{a}"]} for a in axes}
        | {"probability": row["probability"]}
    )
    row_dicts = lambda table: (dict(zip(table, row)) for row in table_rows(table))
    return {
        "points": {row["id"]: error(row, "XYZ") for row in row_dicts(points)},
        "measurements": [
            {"image": row["image"], "point": row["point"]} | error(row, "xy")
            for row in row_dicts(rays)
        ],
    }


def _check_points(adjustment: "Adjustment") -> dict:
    table = {name: column.tolist() for name, column in adjustment.table("checks").items()}
    if not table:
        return {}
    rms = not_none(adjustment.check_points).rms.tolist()
    return {
        "rms": dict(zip("XYZ", rms)),
        "points": {
            point: {
                axis: _estimate(table[axis][i], table[f"s{axis}"][i])
                | {"difference": table[f"d{axis}"][i]}
                for axis in "XYZ"
            }
            | {"rays": table["rays"][i]}
            for i, point in enumerate(table["id"])
        },
    }
