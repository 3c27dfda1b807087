"""The result of a reconstruction: its parts, what was left out, what is doubtful."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.display import print_in_one_screen
from jaxbundle.network.columns import count
from jaxbundle.reconstruction.adjusting import WRONG_MISFIT
from jaxbundle.reconstruction.block import BlockFacts
from jaxbundle.reconstruction.control_table import ControlTable
from jaxbundle.report.correlated import first_facts, stated_sigma_of
from jaxbundle.report.head import count_points
from jaxbundle.report.layout import significant
from jaxbundle.results import TableMethods


@dataclasses.dataclass(frozen=True)
class ReconstructedPart:
    """Connected photographs, adjusted: `name`; `factors` of the σ of kinds of measurements; facts
    about the `block`; the table of `control`, None without, or if it could not be used, with the
    reason in `no_control`. The colours of the points are those of the network."""

    name: str
    adjustment: Adjustment
    factors: Mapping[str, float]
    block: BlockFacts
    control: ControlTable | None = None
    no_control: str = ""

    @property
    def misfit(self) -> float:
        """How many times worse than their σ from matching measurements of the worst kind fit."""
        return max(self.factors.values(), default=1.0)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Reconstruction(TableMethods):
    """`parts`, the largest first; photographs in none of them, with the reason; notes; `warnings`:
    why a result may be wrong, the worst first; verified `pairs`, by the names of their photographs:
    matches, agreeing matches, kind; `photographs`: the examined files, by name;
    `name` of the whole."""

    parts: tuple[ReconstructedPart, ...]
    left_out: Mapping[str, str]
    notes: tuple[str, ...]
    pairs: tuple[tuple[str, str, int, int, str], ...]
    photographs: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    name: str = ""

    @property
    def converged(self) -> bool:
        """Whether all parts have a solution."""
        return all(part.adjustment.converged for part in self.parts)

    def to_dict(self) -> dict[str, Any]:
        """Parts, warnings, and what was left out, as in JSON; each part has its `adjustment`."""
        return {
            "name": self.name,
            "parts": [
                {
                    "name": part.name,
                    "images": list(part.adjustment.network.images.id),
                    "sigma0": part.adjustment.sigma0,
                    "sigma_factors": dict(part.factors),
                    "removed": len(part.adjustment.removed),
                    "replication": None
                    if part.adjustment.replication is None
                    else part.adjustment.replication.brief(),
                    "global_test_passed": part.adjustment.global_test()["passed"],
                    "block": part.block.as_dict(),
                    "control": None if part.control is None else part.control.as_dict(),
                    "control_not_used": part.no_control,
                }
                for part in self.parts
            ],
            "warnings": list(self.warnings),
            "left_out": dict(self.left_out),
            "notes": list(self.notes),
            "pairs": len(self.pairs),
        }

    def table(self) -> dict[str, np.ndarray]:
        """One row a part: columns part, photographs, points, sigma0, misfit. The tables of a part
        are those of its `adjustment`."""
        parts = [(part, part.adjustment) for part in self.parts]
        return {
            "part": np.array([part.name for part in self.parts], dtype=object),
            "photographs": np.array(
                [len(adjustment.network.images) for _, adjustment in parts], dtype=int
            ),
            "points": np.array(
                [len(adjustment.network.points) for _, adjustment in parts], dtype=int
            ),
            "sigma0": np.array([adjustment.sigma0 for _, adjustment in parts], dtype=float),
            "misfit": np.array([part.misfit for part in self.parts], dtype=float),
        }

    def prefix(self, part: ReconstructedPart) -> str:
        """What precedes a sentence about a part; empty if it is the only one."""
        return f"{part.name}: " if len(self.parts) > 1 else ""

    def report(self) -> str:
        """The summary, and the report of every part."""
        parts = [f"{part.name}\n\n{part.adjustment.report()}" for part in self.parts]
        return "\n\n".join([str(self), *parts])

    def __str__(self) -> str:
        lines = [f"warning: {sentence}" for sentence in self.warnings]
        lines += [
            f"{self.prefix(part)}{count(len(part.adjustment.network.images), 'photograph')}, "
            f"{count(count_points(part.adjustment), 'point')}, "
            f"RMS of image residuals {significant(part.adjustment.image_rms, 2)} px, "
            f"σ0 {part.adjustment.sigma0:.3f}{distances_found(part.adjustment)}"
            for part in self.parts
        ]
        lines += [
            f"warning: {self.prefix(part)}{sentence}"
            for part in self.parts
            for sentence in (*part.adjustment.weakness.lines, *part.adjustment.doubts)
        ]
        lines += [
            f"{self.prefix(part)}{name}: {words}"
            for part in self.parts
            for name, words in first_facts(part.adjustment)
        ]
        for part in self.parts:
            if part.control is not None:
                lines.append(part.control.sigma)
                lines += [f"control: {sentence}" for sentence in part.control.notes]
        lines += [f"left out {name}: {why}" for name, why in self.left_out.items()]
        return "\n".join([*lines, *self.notes])


def principal_distances(result: Adjustment) -> dict[str, dict]:
    """Value and σ, by camera."""
    return {
        id: camera["parameters"]["fx"]
        for id, camera in result.cameras.items()
        if "fx" in camera["parameters"]
    }


def distances_found(result: Adjustment) -> str:
    """The free principal distances, with their σ."""
    return "".join(
        f", principal distance {c['value']:.2f} ± {stated_sigma_of(c):.2f} px ({id})"
        for id, c in principal_distances(result).items()
        if c["free"] and c["sigma"]  # 0 of an exact fit says nothing
    )


def misfit_in_words(part: ReconstructedPart) -> str:
    """Measurements that contradict each other by far more than their σ."""
    # Without a χ² test, which estimated factors would always pass, they are themselves the verdict.
    wrong = part.misfit >= WRONG_MISFIT
    return (
        f"{'most likely wrong' if wrong else 'doubtful'}: measurements fit {part.misfit:.1f} times "
        "worse than their σ from matching: the object repeats itself or moves, or the camera model "
        "does not fit the lens; compare the result with the object"
    )
