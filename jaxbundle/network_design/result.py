"""A designed network: before and after, the gain, and the proof."""

import dataclasses
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.choices import ORDERS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import NotSolvedError
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import EXTERIOR, Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.network_design.aims import Aim, smallest_redundancy
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.design_json import design_dict
from jaxbundle.network_design.proof import Proof, prove
from jaxbundle.network_design.realise import problem_of
from jaxbundle.network_design.search import Step
from jaxbundle.results import TableMethods
from jaxbundle.types import not_none


@dataclasses.dataclass(frozen=True)
class DesignState:
    """A network with its visible targets: `network` with simulated measurements, `exact` without
    noise; the `aim`, NaN if it is not determined; targets `lost`, with fewer than two rays."""

    network: Network
    exact: Network
    aim: float
    lost: tuple[str, ...] = ()

    @cached_property
    def smallest_redundancy(self) -> float:
        """The smallest redundancy number of an image coordinate; NaN if the network cannot be
        adjusted."""
        problem = problem_of(self.exact)
        return np.nan if problem is None else smallest_redundancy(problem)

    @property
    def rays(self) -> int:
        """Measured image points."""
        return len(self.network.observations)

    @property
    def photographs(self) -> int:
        """Stations with visible targets."""
        return len(self.network.images)


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Design(TableMethods):
    """A designed network.

    `order`: "zero", "first", "second", "third"; `path`: the aim by iteration, and the projection
    centres; `converged`: whether the last round of the search did; `bound`: no selection of as many
    photographs has a smaller aim (second order); `dropped`: ids of photographs not selected;
    `weights`: of all candidates; `tried`: positions [n, 3] and the aim with a photograph there
    (third order).
    """

    order: str
    aim: Aim
    conditions: Conditions
    before: DesignState
    after: DesignState
    path: tuple[Step, ...] = ()
    converged: bool = True
    bound: float | None = None
    dropped: tuple[str, ...] = ()
    weights: dict[str, float] = dataclasses.field(default_factory=dict)
    tried: tuple[Float[np.ndarray, "tried 3"], Float[np.ndarray, " tried"]] | None = None
    added: tuple[str, ...] = ()

    @property
    def network(self) -> Network:
        """The designed network with simulated measurements, ready for `jaxbundle.adjust`."""
        return self.after.network

    @property
    def gain(self) -> float:
        """Ratio of the aims before and after; NaN if the start does not determine the aim."""
        return self.before.aim / self.after.aim

    @cached_property
    def proof(self) -> Proof:
        """Proof with 200 simulated networks (`prove`)."""
        return self.prove()

    def prove(self, draws: int = 200, seed: int = 0) -> Proof:
        """Simulate and adjust the designed network repeatedly, and compare with the prediction.

        **Raises:** `NotSolvedError` if it cannot be adjusted."""
        problem = problem_of(self.after.exact)
        if problem is None:
            raise NotSolvedError("design: the designed network cannot be adjusted")
        return prove(problem, self.aim, draws, seed)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON; with the proof if it was made."""
        return without_nan(design_dict(self, self.__dict__.get("proof")))

    def table(self) -> dict[str, np.ndarray]:
        """One row a photograph: columns image, X0, Y0, Z0, omega, phi, kappa in the units of the
        network."""
        images, unit = self.network.images, ANGLE_UNITS[self.network.angle_unit]
        orientation = np.column_stack([images.position, images.angles / unit])
        return {"image": np.array(images.id, dtype=object), **dict(zip(EXTERIOR, orientation.T))}

    @property
    def board_poses(self) -> Float[np.ndarray, "images 4 4"]:
        """The frame of the targets in that of the camera, for every photograph: the positions of a
        board in front of a fixed camera. In the axes of a camera with z towards the scene and
        y down."""
        from jaxbundle.geometry import matrix_from_omega_phi_kappa

        # From y up and z backwards, as in photogrammetry, to y down and z forwards, as in computer
        # vision.
        images, flip = self.network.images, np.diag([1.0, -1.0, -1.0])
        poses = np.tile(np.eye(4), (len(images), 1, 1))
        for pose, X0, angles in zip(poses, images.position, images.angles):
            M = flip @ np.asarray(matrix_from_omega_phi_kappa(angles))
            pose[:3, :3], pose[:3, 3] = M, -M @ X0
        return poses

    def __str__(self) -> str:
        points = self.aim.of == "points" and self.aim.measure != "reliability"
        unit = f" [{self.after.network.object_unit}]" if points else ""
        lines = [f"Design of {ORDERS[self.order]}", f"aim: {self.aim}", ""]
        lines.append(f"{'':22}{'before':>14}{'after':>14}")
        rows = [
            (f"aim{unit}", self.before.aim, self.after.aim),
            ("photographs", self.before.photographs, self.after.photographs),
            ("image points", self.before.rays, self.after.rays),
        ]
        if self.aim.measure == "reliability":
            states = self.before, self.after
            rows.append(("smallest redundancy", *(state.smallest_redundancy for state in states)))
        for name, a, b in rows:
            show = lambda x: f"{x:14d}" if isinstance(x, int) else f"{x:14.4g}"
            lines.append(f"{name:22}{show(a)}{show(b)}")
        lines += ["", *self._remarks()]
        return "\n".join(lines)

    def _remarks(self) -> Iterator[str]:
        if np.isnan(self.before.aim):
            yield "gain: the start does not determine the aim"
        elif self.gain > 1 + 1e-9:  # beyond rounding
            yield f"gain: the aim is {self.gain:.3g} times smaller"
        else:
            yield "gain: none; the start is as good as any found"
        for name, state in (("before", self.before), ("after", self.after)):
            if state.lost:
                yield (
                    f"{name}: {len(state.lost)} targets have fewer than two rays and are "
                    f"excluded: {list_some(state.lost)}"
                )
        if self.bound:
            yield (
                f"no {self.after.photographs} photographs of these have an aim below "
                f"{self.bound:.4g} ({100 * (1 - self.bound / self.after.aim):.0f} % less)"
            )
        if self.dropped:
            yield f"not needed: {list_some(self.dropped)}"
        for id in self.added:
            images = self.after.network.images
            X0 = images.position[images.id.index(id)]
            yield f"new photograph {id}: {X0[0]:.4g}, {X0[1]:.4g}, {X0[2]:.4g}"
        if not self.converged:
            yield "the search did not converge; give more iterations"
        if "proof" in self.__dict__:
            yield f"proof: {not_none(self.proof)}"
