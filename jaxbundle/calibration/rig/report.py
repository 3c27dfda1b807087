"""The report of a rig as text, and its dict for JSON."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.calibration.report import MAPS_HEADER, coverage_dict, map_rows, maps_dict
from jaxbundle.calibration.verdict import (
    coverage_in_words,
)
from jaxbundle.io.text.csv_tables import table_rows
from jaxbundle.network.columns import count
from jaxbundle.network.kinds.continuous_time import RATE
from jaxbundle.report import observations
from jaxbundle.report.layout import (
    clean,
    estimate,
    facts,
    fixed,
    heading,
    paragraph,
    table,
)

if TYPE_CHECKING:
    from jaxbundle.calibration.rig.mounting import Mounting
    from jaxbundle.calibration.rig.result import RigCalibration
    from jaxbundle.leastsquares.quality.error_components import ErrorModel


# Base and angles of a mounting.
MOUNTED = ("bx", "by", "bz", "ω", "φ", "κ")


def rig_text(rig: "RigCalibration") -> str:
    """The mountings of a rig and its cameras in the common adjustment."""
    unit = clean(rig.object_unit)
    lines = [f"Rig of {len(rig.names)} cameras, reference {clean(rig.names[0])}", "=" * 100]
    lines += facts(rig_facts(rig, unit))
    for title, m in mounting_titles(rig).items():
        lines += heading(title)
        lines += table(("", "value", "σ", "unit"), mounting_rows(m, unit), "lrrl")
        lines += ["", "Correlations", *table(("", *MOUNTED), correlation_rows(m), "l" + "r" * 6)]
    if rig.clocks:
        lines += heading("Clocks: common time = t + offset + rate·(t − middle) + read-out·line")
        lines += table(("camera", "unknown", "value", "σ", "unit"), clock_rows(rig), "llrrl")
        for name, clock in rig.clocks.items():
            for unknown, why in clock.held.items():
                lines += paragraph(f"- {unknown} of {clean(name)}: {why}", hanging=2)
    lines += heading("Advice on the mountings")
    for item in rig.advice:
        lines += paragraph(f"- {item}", hanging=2)
    for name in rig.names:
        lines += heading(f"Camera {clean(name)} in the rig")
        lines += table(("parameter", "value", "σ"), rig_parameter_rows(rig, name), "lrr")
        coverage_words = coverage_in_words(rig.coverage(name))
        lines += [
            "",
            *paragraph(
                f"{coverage_words.capitalize()}. Uncertainty of a projected point (σ, pixels):"
            ),
        ]
        lines += table(MAPS_HEADER, map_rows(rig.reported_maps(name), unit), "lrr")
    # Residuals with |τ| above 3 are listed: one in 370 without blunders.
    lines += observations.residuals(rig, 3.0, "pope")
    lines += [*observations.redundancy(rig), *observations.removals(rig)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def rig_facts(rig: "RigCalibration", unit: str) -> list[tuple[str, str]]:
    """Epochs, σ0, RMS, the board, and excluded or contradicting epochs."""
    odd = (*rig.left_out, *rig.contradicting)
    return [
        ("Epochs", f"{len(rig.epochs)} used, {len(rig.left_out)} left out"),
        ("σ0", f"{rig.sigma0:.4f}, redundancy {rig.redundancy}"),
        ("RMS", ", ".join(f"{clean(name)} {rms:.4f} px" for name, rms in rig.rms.items())),
        (
            "Board",
            "its points estimated, inner constraints"
            if rig.rig.points_free
            else "exact"
            if rig.rig.point_sigma is None
            else f"known with σ {rig.rig.point_sigma:g} {unit}",
        ),
        *_wand_facts(rig, unit),
        *_tied_facts(rig),
        *((clean(epoch), clean(why)) for epoch, why in odd),
    ]


def _wand_facts(rig: "RigCalibration", unit: str) -> list[tuple[str, str]]:
    """The adjusted length of the wand, and what was given."""
    if rig.rig.wand is None or rig.wand_length is None:
        return []
    value, sigma = estimate(*rig.wand_length)
    is_removed = any(blunder.kind == "distance" for blunder in rig.removed)
    given_length = (
        f"{rig.rig.wand.length:g} was given" + ", which contradicts the boards" * is_removed
    )
    frames = count(len(rig.rig.wand.perpendicular_axes), "frame")
    of_boards = rig.rig.epoch < rig.rig.wand.first_row
    views = np.unique(np.stack([rig.rig.epoch, rig.rig.camera], 1)[of_boards], axis=0)
    is_simultaneous = np.bincount(views[:, 0]).max(initial=0) > 1
    remark = "" if is_simultaneous else "; no board is seen by two cameras at the same time"
    return [("Wand", f"{value} ± {sigma} {unit}, {given_length}; {frames}{remark}")]


def _tied_facts(rig: "RigCalibration") -> list[tuple[str, str]]:
    """Which boards are fixed to each other, and which cameras only the motion of the rig ties."""
    words = lambda names: ", ".join(map(clean, names))
    rows = [("Fixed to each other", words(body)) for body in rig.bodies if len(body) > 1]
    for tie in rig.ties:
        (cameras_a, cameras_b), (boards_a, boards_b) = tie.cameras, tie.boards
        open_directions = f"; {count(tie.open, 'direction')} left open" if tie.open else ""
        rows.append(
            (
                "Tied by motion",
                f"{words(cameras_a)} ({words(boards_a)}) and {words(cameras_b)} "
                f"({words(boards_b)}), {tie.epochs} epochs{open_directions}",
            )
        )
    return rows


def mounting_titles(rig: "RigCalibration") -> dict[str, "Mounting"]:
    """The mountings and the places of the boards by whose they are, and in whose frame."""
    titles = {
        f"Mounting of {clean(name)} in the frame of {clean(rig.names[0])}": mounting
        for name, mounting in rig.mountings.items()
    }
    first_board = {name: body[0] for body in rig.bodies for name in body}
    return titles | {
        f"Board {clean(name)} in the frame of board {clean(first_board[name])}": place
        for name, place in rig.placements.items()
    }


def correlation_rows(m: "Mounting") -> list[tuple[str, ...]]:
    """Correlations of base and angles, below the diagonal."""
    return [
        (name, *(fixed(x, 2) for x in row[:k]), *[""] * (6 - k))
        for k, (name, row) in enumerate(zip(MOUNTED, m.correlation))
        if k
    ]


def mounting_rows(m: "Mounting", unit: str) -> list[tuple[str, str, str, str]]:
    """Base and angles of a mounting: name, value, σ, unit."""
    units = [unit] * 3 + ["deg"] * 3
    rows = [
        (label, *estimate(value, sigma), unit_of_number)
        for label, value, sigma, unit_of_number in zip(
            MOUNTED, [*m.base, *m.angles], m.sigma, units
        )
    ]
    return [*rows, ("length", *estimate(m.length, m.length_sigma), unit)]


def rig_parameter_rows(rig: "RigCalibration", name: str) -> list[tuple[str, str, str]]:
    """The free parameters of a camera in the rig: name, value, σ."""
    return [(n, *estimate(rig.parameters[name][n], s)) for n, s in rig.stated_sigma[name].items()]


def clock_rows(rig: "RigCalibration") -> list[tuple[str, str, str, str, str]]:
    """The unknowns of clocks that were estimated: camera, name, value, σ, unit."""
    return [
        (clean(name), unknown, *estimate(*clock.values[unknown]), "" if unknown == RATE else "s")
        for name, clock in rig.clocks.items()
        for unknown in clock.estimated
    ]


def _rig_quality(rig: "RigCalibration", name: str) -> dict:
    return {
        "coverage": coverage_dict(rig.coverage(name)),
        "uncertainty": maps_dict(rig.reported_maps(name)),
    }


def _mounting_dict(m: "Mounting") -> dict:
    return {
        "base": m.base.tolist(),
        "sigma_base": m.sigma[:3].tolist(),
        "angles": m.angles.tolist(),
        "sigma_angles": m.sigma[3:].tolist(),
        "rotation": m.rotation.tolist(),
        "covariance": m.covariance.tolist(),
        "correlation": m.correlation.tolist(),
        "length": m.length,
        "sigma_length": m.length_sigma,
    }


def _correlated_mounting(m: "Mounting", model: "ErrorModel | None") -> dict:
    """σ of a mounting under correlated errors; nothing without a model."""
    if model is None:
        return {}
    return {
        "sigma_base_correlated": m.sigma[:3].tolist(),
        "sigma_angles_correlated": m.sigma[3:].tolist(),
        "covariance_correlated": m.covariance.tolist(),
        "sigma_length_correlated": m.length_sigma,
    }


def _correlated_sigma(rig: "RigCalibration", camera: str, parameter: str) -> dict:
    """σ of a parameter under correlated errors; nothing without a model, or where it is held."""
    sigma = rig.correlated_sigma[camera].get(parameter)
    return {} if rig.error_model is None or sigma is None else {"sigma_correlated": sigma}


def rig_dict(rig: "RigCalibration", brief: bool = False) -> dict:
    """The rig as plain dicts and numbers: object unit, degrees, pixels; residuals, in the unit of
    the models, as of `adjust`; `brief` leaves them out."""
    residual_columns = {} if brief else rig.residuals
    residuals = [dict(zip(residual_columns, row)) for row in table_rows(residual_columns)]
    return {
        "reference": rig.names[0],
        "unit": rig.object_unit,
        "epochs": list(rig.epochs),
        "left_out": dict(rig.left_out),
        "contradicting": dict(rig.contradicting),
        "sigma0": rig.sigma0,
        "observations": rig.result.counts.observations,
        "unknowns": rig.result.counts.unknowns,
        "redundancy": rig.redundancy,
        "removed": [{"kind": r.kind, "name": r.name, "test": r.test} for r in rig.removed],
        "rms": rig.rms,
        "mountings": {
            name: _mounting_dict(m) | _correlated_mounting(rig.mountings[name], rig.error_model)
            for name, m in rig.classical_mountings.items()
        },
        "boards": {
            "bodies": [list(body) for body in rig.bodies],
            "places": {name: _mounting_dict(m) for name, m in rig.placements.items()},
        },
        "clocks": {name: clock.to_dict() for name, clock in rig.clocks.items()},
        "ties_by_motion": [dataclasses.asdict(tie) for tie in rig.ties],
        "separate_boards": [list(names) for names in rig.separate],
        "advice": rig.advice,
        "cameras": {
            name: {
                n: {"value": value, "sigma": rig.sigma[name].get(n)}
                | _correlated_sigma(rig, name, n)
                for n, value in rig.parameters[name].items()
            }
            for name in rig.names
        },
        "quality": {name: _rig_quality(rig, name) for name in rig.names},
        "error_components": []
        if rig.error_model is None
        else [size.to_dict(rig.image_unit) for size in rig.error_model.sizes],
    } | ({} if brief else {"residuals": residuals})
