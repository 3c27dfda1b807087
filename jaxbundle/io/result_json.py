"""The result of an adjustment as JSON (the fields are listed in docs/result.md).

σ are a posteriori, w uses the a priori σ. A number that does not exist (the σ of a camera parameter
that is held, the MDB of an uncontrolled observation) is null; the σ of a fixed point and of what is
held of an exterior orientation are 0.
"""

import json
import math

from jaxbundle.cameras import get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.tables import EXTERIOR


def result_dict(adjustment, brief: bool = False) -> dict:
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
    }
    if not adjustment.converged:
        return head | {"undetermined": list(adjustment.undetermined)}
    head |= {"sigma0": adjustment.sigma0, "vtpv": adjustment.vtpv, "sigma": "a posteriori"}
    head |= {"sigma_factors": adjustment.sigma_factors, "robust": adjustment.robust}
    head |= {
        "cameras": {name: _camera(table) for name, table in adjustment.cameras.items()},
        "images": _images(adjustment),
        "removed": [
            {"kind": r.kind, "name": r.name, "test": r.test} for r in adjustment.removed
        ],
        "eliminated": [
            {"camera": name.id, "parameter": name.parameter} for name in adjustment.eliminated
        ],
    }
    if not brief:
        head |= {
            "points": _points(adjustment.points),
            "residuals": _residuals(adjustment.residuals),
            "variance_components": {
                name: {
                    "observations": c.observations,
                    "redundancy": c.redundancy,
                    "vtpv": c.vtpv,
                    "sigma": c.sigma,
                    "factor": c.factor,
                    "estimated": list(c.estimated),
                }
                for name, c in adjustment.variance_components.items()
            },
        }
    return head | {"check_points": _checks(adjustment)}


def unsolved_text(error: NotSolvedError) -> str:
    """The JSON text of an adjustment that ended before there was an `Adjustment`."""
    head = {"converged": False, "termination": str(error), "undetermined": [*error.undetermined]}
    return json.dumps(head, ensure_ascii=False) + "\n"


def result_text(adjustment, brief: bool = False) -> str:
    """The result as JSON text: one line that ends with a line feed."""
    return json.dumps(without_nan(result_dict(adjustment, brief)), ensure_ascii=False) + "\n"


def without_nan(value):
    """NaN and infinity do not exist in JSON: null."""
    if isinstance(value, dict):
        return {key: without_nan(v) for key, v in value.items()}
    if isinstance(value, list):
        return [without_nan(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _camera(table: dict) -> dict:
    free, C = table["free"], table["correlations"]
    correlations = {
        a: {b: float(C[i, j]) for j, b in enumerate(free) if j != i} for i, a in enumerate(free)
    }
    return {
        "model": table["model"],
        "parameters": table["parameters"],
        "correlations": correlations,
    }


def _estimate(value, sigma) -> dict:
    return {"value": value, "sigma": sigma}


def _images(adjustment) -> dict:
    columns = {name: column.tolist() for name, column in adjustment.images.items()}
    return {
        image: {name: _estimate(columns[name][i], columns[f"s{name}"][i]) for name in EXTERIOR}
        | {"rays": columns["rays"][i], "rms": columns["rms"][i]}
        for i, image in enumerate(columns["id"])
    }


def _points(table) -> dict:
    columns = {name: column.tolist() for name, column in table.items()}
    return {
        point: {"role": columns["role"][i]}
        | {axis: _estimate(columns[axis][i], columns[f"s{axis}"][i]) for axis in "XYZ"}
        | {"rays": columns["rays"][i]}
        for i, point in enumerate(columns["id"])
    }


def _residuals(table) -> list:
    columns = [column.tolist() for column in table.values()]
    return [dict(zip(table, row)) for row in zip(*columns)]


def _checks(adjustment) -> dict:
    table = {name: column.tolist() for name, column in adjustment.table("checks").items()}
    if not table:
        return {}
    rms = adjustment.check_points.rms.tolist()
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
