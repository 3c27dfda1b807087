"""The result of a rig: the mountings of its cameras, and the jointly adjusted cameras."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle import plotting
from jaxbundle.adjustment import result_tables
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.quality import DRAWN, GRID, Coverage, UncertaintyMap
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.advice import advise_rig
from jaxbundle.calibration.rig.clocks import Clock
from jaxbundle.calibration.rig.connections import Connections
from jaxbundle.calibration.rig.declare import WAND_LENGTH, Rig, used_rays
from jaxbundle.calibration.rig.errors import rig_errors
from jaxbundle.calibration.rig.mounting import (
    POSE,
    Mounting,
    mounting_of,
    placement_of,
    table_of_mountings,
)
from jaxbundle.calibration.rig.next_view import NextView, next_view
from jaxbundle.calibration.rig.quality import rig_coverage, rig_points, rig_uncertainty
from jaxbundle.calibration.rig.synchronize import clocks_of
from jaxbundle.cameras import get_model
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.io.networks.rig_result import network_of_rig
from jaxbundle.leastsquares import Result
from jaxbundle.leastsquares.quality.error_components import ErrorModel, Errors, IndependentErrors
from jaxbundle.network.blunders import Removed, either_of
from jaxbundle.network.kinds.continuous_time import CLOCK
from jaxbundle.network.tables import Camera, Network, units_of
from jaxbundle.results import TableMethods
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class RigCalibration(TableMethods):
    """Cameras of a rig, calibrated together.

    **Attributes:**

    - `names` of the cameras; `cameras`: their separate calibrations, but of those that see only a
      wand; `mountings`, `parameters`, `sigma` of the common
      adjustment, by camera;
    - `board`: its points [points, 3]; of several boards `bodies` and `placements`;
    - `ties`: cameras that only the motion of the rig ties (`MotionTie`); `separate`: boards of a
      body that nothing relates; `advice`;
    - `clocks` of cameras that are not synchronised (`Clock`);
    - `epochs`; `left_out`, and `contradicting` ones that were kept: epoch and reason; `removed` by
      data snooping; `residuals`: a table like that of an `Adjustment`; `rms` (pixels) by camera;
    - `error_model`: of errors that image points share; `covariance`, `mountings`, `placements` and
      `uncertainty` are under it, `sigma` and `classical_mountings` are not;
    - `rig`: the input, `result`: that of the engine (`jaxbundle.leastsquares.Result`); `sigma0`,
      `redundancy`, `converged`.
    """

    weights = None
    eliminated = ()

    def __init__(
        self,
        cameras: dict[str, Calibration],
        rig: Rig,
        result: Result,
        left_out: Sequence[tuple[str, str]],
        contradicting: Sequence[tuple[str, str]] = (),
        connections: Connections | None = None,
        held_clocks: Mapping[str, Mapping[str, str]] | None = None,
    ):
        self.cameras, self.rig, self.result = cameras, rig, result
        self._maps: dict[tuple, UncertaintyMap] = {}
        self._covariances: dict[tuple, np.ndarray] = {}
        self.left_out, self.contradicting = tuple(left_out), tuple(contradicting)
        self.ties = () if connections is None else connections.ties
        self.separate = () if connections is None else connections.separate
        self._next_views: dict[str, NextView | None] = {}
        self._held_clocks = dict(held_clocks or {})

    @property
    def names(self) -> list[str]:
        return [camera.id for camera in self.rig.cameras]

    @property
    def epochs(self) -> tuple[str, ...]:
        epochs = zip(self.rig.epoch_of_rows, self._stays)
        return tuple(dict.fromkeys(epoch for epoch, stays in epochs if stays))

    @property
    def _stays(self) -> list[bool]:
        """Which poses were not excluded."""
        excluded = dict(self.left_out)
        return [epoch not in excluded for epoch in self.rig.epochs]

    @property
    def converged(self) -> bool:
        return self.result.converged

    @property
    def sigma0(self) -> float:
        return self.result.sigma0

    @property
    def redundancy(self) -> int:
        return self.result.counts.redundancy

    @property
    def image_unit(self) -> str:
        """The unit of image coordinates in the adjustment: that of the camera models."""
        return units_of(self.rig.cameras)

    @property
    def object_unit(self) -> str:
        """The unit of object coordinates."""
        return next(iter(self.cameras.values())).adjustment.network.object_unit

    @functools.cached_property
    def used(self) -> Bool[np.ndarray, " n"]:
        """Which image points were not removed."""
        return used_rays(self.rig, self.result.problem)

    @functools.cached_property
    def rms(self) -> dict[str, float]:
        """√(Σ|v|²/points) in pixels, by camera."""
        v, rms_of = self.rig.in_order(self.result.solution.residuals) * self.rig.sigma, {}
        for k, name in enumerate(self.names):
            camera = self.rig.cameras[k]
            residuals_of_camera = v[self.used & (self.rig.camera == k)]
            residuals_of_camera = residuals_of_camera / np.array(
                unit_size(get_model(camera.model), camera.pixel_size)
            )
            rms_of[name] = float(np.sqrt((residuals_of_camera**2).sum(1).mean()))
        return rms_of

    @functools.cached_property
    def residuals(self) -> dict[str, np.ndarray]:
        """One row per observation: kind, image (camera and epoch), point, axis, unit, v, sigma (a
        priori), r, w (Baarda), tau (Pope), mdb, external."""
        rig, reliability, weight = (
            self.rig,
            self.result.solution.reliability,
            self.result.problem.weights,
        )
        ids = np.array(rig.ids, dtype=object)
        photographs = [self._photograph(*row) for row in zip(rig.camera, rig.epoch)]
        rows = rig.in_order
        parts = [
            result_tables.KindRows(
                "image",
                np.array(photographs, dtype=object),
                ids[rig.point],
                ("x", "y"),
                rows({table.image_set: weight(table.image_set) for table, _ in rig.sets}),
                tuple(rows(getattr(reliability, name)) for name in result_tables.TESTED),
                [(1.0, self.image_unit)] * 2,
            )
        ]
        if rig.point_sigma is not None:
            blank = np.full(rig.number_of_board_points, "", dtype=object)
            parts.append(
                result_tables.KindRows(
                    "control",
                    blank,
                    ids[: len(blank)],
                    tuple("XYZ"),
                    weight("control"),
                    tuple(getattr(reliability, name)["control"] for name in result_tables.TESTED),
                    [(1.0, self.object_unit)] * 3,
                )
            )
        return result_tables.concatenate([result_tables.residual_rows(self, p) for p in parts])

    def pope(self, w: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """τ = w/σ0."""
        return w / self.sigma0

    def _photograph(self, camera: int, epoch: int) -> str:
        name = self.rig.epochs[epoch]
        # Of cameras that are not synchronised an epoch is a photograph, and named with its camera.
        return name if self.rig.trajectory is not None else f"{self.names[camera]} {name}"

    @property
    def removed(self) -> list[Removed]:
        """Observations removed by data snooping."""
        rig, removals = self.rig, []
        rows_of = {table.image_set: rows for table, rows in rig.sets}
        for blunder in self.result.removed:
            if blunder.set == "control":
                axis = not_none(blunder.residual)  # coordinates are tested individually
                name = f"{'XYZ'[axis]} of point {rig.ids[blunder.row]}"
                removals.append(Removed("control", 3 * blunder.row + axis, name, blunder.test))
                continue
            if blunder.set == WAND_LENGTH:
                removals.append(
                    Removed("distance", blunder.row, "the length of the wand", blunder.test)
                )
                continue
            rows = rows_of[blunder.set][list(blunder.rows)]
            points_and_views = zip(rig.point[rows], rig.camera[rows], rig.epoch[rows])
            names = [
                f"point {rig.ids[p]} in image {self._photograph(k, e)}"
                for p, k, e in points_and_views
            ]
            other_rows = tuple(rows[1:].tolist())
            removals.append(
                Removed("image", int(rows[0]), either_of(names), blunder.test, other_rows)
            )
        return removals

    @property
    def board(self) -> Float[np.ndarray, "points 3"]:
        """Adjusted coordinates of the board, object unit; of several boards those of all, each in
        the frame of its own."""
        return self.values("point") + not_none(self.rig.centroids)[self.rig.board_of_points]

    @functools.cached_property
    def clocks(self) -> dict[str, Clock]:
        """The clocks of cameras that are not synchronised, by camera; empty otherwise."""
        if self.rig.trajectory is None:
            return {}
        covariance = self.errors.covariance(CLOCK)
        return clocks_of(self.rig, self.values(CLOCK), covariance, self._held_clocks)

    @functools.cached_property
    def wand_length(self) -> tuple[float, float] | None:
        """The adjusted length of the wand and its σ; None without a wand."""
        if self.rig.wand is None:
            return None
        (x, *_), (x2, *_) = self.values("point")[-2:]
        C = self.errors.covariance("point")
        return float(x2 - x), float(np.sqrt(C[-1, 0, 0]))

    def values(self, table: str) -> Any:
        """The adjusted rows of a table of unknowns; of "epoch" the poses of all epochs."""
        if table == "epoch":
            return jax.tree.map(np.asarray, self.rig.poses(self.result.minimum.values))
        return jax.tree.map(np.asarray, self.result.minimum.values[table])

    @functools.cached_property
    def parameters(self) -> dict[str, dict[str, float]]:
        """Parameters of every camera by name."""
        by_camera = {}
        for k, name in enumerate(self.names):
            table, row = self.rig.row_of(k)
            names = get_model(self.rig.cameras[k].model).parameters
            by_camera[name] = dict(zip(names, self.values(table)[row].tolist()))
        return by_camera

    @functools.cached_property
    def sigma(self) -> dict[str, dict[str, float]]:
        """Classical σ of the free parameters of every camera, a posteriori."""
        return self._sigma(classical=True)

    @functools.cached_property
    def correlated_sigma(self) -> dict[str, dict[str, float]]:
        """`sigma` under the error model; the same without one."""
        return self._sigma(classical=False)

    @property
    def stated_sigma(self) -> dict[str, dict[str, float]]:
        """The larger of both, which is shown."""
        return {
            name: {n: max(s, self.correlated_sigma[name][n]) for n, s in sigma_of_camera.items()}
            for name, sigma_of_camera in self.sigma.items()
        }

    def _sigma(self, classical: bool) -> dict[str, dict[str, float]]:
        by_camera = {}
        for k, name in enumerate(self.names):
            table = self.result.problem.table(self.rig.row_of(k)[0])
            C = self.covariance(name, classical=classical)
            sigma = np.sqrt(np.clip(np.diagonal(C)[POSE:], 0, None)).tolist()
            free = self.rig.cameras[k].free
            by_camera[name] = {n: s for n, s in zip(table.parameters, sigma) if n in free}
        return by_camera

    @functools.cached_property
    def error_model(self) -> ErrorModel | None:
        """Errors that image points share, if they were looked for in the cameras by themselves;
        None where they cannot be found."""
        settings = [calibration.adjustment.correlations for calibration in self.cameras.values()]
        if not self.converged or any(settings_of_camera is None for settings_of_camera in settings):
            return None
        return rig_errors(self.rig, self.result.solution, not_none(settings[0]))

    @functools.cached_property
    def errors(self) -> Errors:
        """The covariance of everything that follows from the observations: by the error model where
        there is one, else of independent errors."""
        return self.error_model or self._independent

    @property
    def _independent(self) -> IndependentErrors:
        return IndependentErrors(self.result.solution, self.sigma0**2)

    def covariance(self, *names: str, classical: bool = False) -> Float[np.ndarray, "k k"]:
        """The joint covariance of cameras: for each the mounting (δb, δθ) and the parameters that
        are free in some camera of its model; zero for held ones. `classical`: of independent
        errors, also where an error model is known."""
        key = (classical or self.error_model is None, *names)
        if key not in self._covariances:
            problem = self.result.problem
            places = [
                (self.names.index(name), *self.rig.row_of(self.names.index(name))) for name in names
            ]
            widths = [POSE + problem.table(table).space.width for _, table, _ in places]
            number, starts = sum(widths), np.cumsum([0, *widths])
            rows = {t.name: np.zeros((number, t.rows, t.space.width)) for t in problem.tables}
            for start, width, (k, table, row) in zip(starts, widths, places):
                rows["mounting"][start : start + POSE, k] = np.eye(POSE)
                rows[table][start + POSE : start + width, row] = np.eye(width - POSE)
            # Unit rows for the wanted unknowns: only these columns of the cofactor matrix are
            # computed.
            errors = self._independent if classical else self.errors
            self._covariances[key] = errors.propagate_rows(rows)
        return self._covariances[key]

    @functools.cached_property
    def mountings(self) -> dict[str, Mounting]:
        """The mounting of every camera but the reference, the first."""
        return self._mountings(classical=False)

    @functools.cached_property
    def classical_mountings(self) -> dict[str, Mounting]:
        """`mountings` with the covariance of independent errors."""
        return self._mountings(classical=True)

    def _mountings(self, classical: bool) -> dict[str, Mounting]:
        mountings = {}
        for k, name in enumerate(self.names[1:], 1):
            pose = jax.tree.map(lambda x, k=k: x[k], self.values("mounting"))
            C = self.covariance(name, classical=classical)
            mountings[name] = mounting_of(pose, C[:POSE, :POSE])
        return mountings

    @functools.cached_property
    def placements(self) -> dict[str, Mounting]:
        """The place of every board in the frame of the first board of its body, by name: its
        origin, and the rotation from that frame to its own; none for boards that are bodies of
        their own."""
        if self.rig.place is None:
            return {}
        centroids = not_none(self.rig.centroids)
        covariance, values = self.errors.covariance("board"), self.values("board")
        return {
            name: placement_of(
                jax.tree.map(lambda x, j=j: x[j], values),
                covariance[j],
                centroids[j],
                centroids[first_board],
            )
            for j, (name, first_board) in enumerate(zip(self.rig.boards, self.rig.body))
            if first_board != j
        }

    @property
    def bodies(self) -> list[tuple[str, ...]]:
        """The boards that are fixed to each other, of one body each; the first is its frame."""
        boards = self.rig.boards
        return [
            tuple(
                name
                for name, body_of_board in zip(boards, self.rig.body)
                if body_of_board == first_board
            )
            for first_board in dict.fromkeys(self.rig.body)
        ]

    @functools.cached_property
    def advice(self) -> list[str]:
        """What would determine the mountings better, in words."""
        return advise_rig(self)

    def next_view(self, name: str) -> NextView | None:
        """The place of a board that would determine the mounting of a camera best, with the σ that
        follows; None if there is none that it sees together with another camera."""
        if name not in self._next_views:
            self._next_views[name] = next_view(self, name)
        return self._next_views[name]

    def camera(self, name: str) -> Camera:
        """A camera with the parameters of the common adjustment, held."""
        declared_camera = self.rig.cameras[self.names.index(name)]
        if name in self.cameras:
            declared_camera = self.cameras[name].camera
        return dataclasses.replace(declared_camera, parameters=self.parameters[name])

    def network(self) -> Network:
        """The cameras on their mountings as a network of one image each, the reference at the
        origin, looking along Z with Y down: to write for other programs (`jaxbundle.io`)."""
        cameras = [dataclasses.replace(self.camera(name), id=name) for name in self.names]
        mountings = self.mountings.values()
        return network_of_rig(
            Path("rig"),
            cameras,
            [np.eye(3), *(mounting.rotation for mounting in mountings)],
            [np.zeros(3), *(mounting.base for mounting in mountings)],
            self.object_unit,
        )

    @property
    def distance(self) -> float:
        """The median distance of the boards from the reference camera, object unit."""
        stays = np.flatnonzero(self._stays)
        if self.rig.place is None:
            relative_position = self.values("epoch").position[stays]
        else:
            rows = np.stack([self.rig.epoch, self.rig.board_of_points[self.rig.point]], 1)
            epoch, board = np.unique(rows[np.isin(self.rig.epoch, stays)], axis=0).T
            relative_position = self.values("epoch").position[epoch] - self._centres[board]
        return float(np.median(np.linalg.norm(relative_position, axis=1)))

    @property
    def _centres(self) -> Float[np.ndarray, "boards 3"]:
        """The centroids of the boards in the frames of their bodies."""
        place = self.values("board")
        P = np.asarray(_matrices(place.rotation))
        return -np.einsum("nij,nj->ni", P, place.position)

    def coverage(self, name: str) -> Coverage:
        """Where in the image of a camera the rig has points."""
        return rig_coverage(self, name)

    def uncertainty(
        self, name: str, distance: float = np.inf, frame: str = "rig", grid: tuple[int, int] = GRID
    ) -> UncertaintyMap:
        """Uncertainty of a projected point over the image of a camera, pixels; frames: see
        `jaxbundle.calibration.rig.quality`."""
        key = (name, distance, frame, grid)
        if key not in self._maps:
            self._maps[key] = rig_uncertainty(self, name, distance, frame, grid)
        return self._maps[key]

    def reported_maps(self, name: str) -> list[UncertaintyMap]:
        """At the distance of the board, at ten times that, at infinity; and without mounting."""
        frames_and_distances = (
            ("rig", self.distance),
            ("rig", 10 * self.distance),
            ("rig", np.inf),
            ("rotation", np.inf),
        )
        return [self.uncertainty(name, distance, frame) for frame, distance in frames_and_distances]

    def plot_coverage(self, name: str, ax: "Axes | None" = None) -> "Axes":
        """Coverage of the image of a camera by points of the rig; matplotlib axes."""
        size = not_none(self.camera(name).image_size)
        return plotting.coverage_map(self.coverage(name), rig_points(self, name), size, name, ax)

    def plot_uncertainty(
        self, name: str, distance: float = np.inf, frame: str = "rig", ax: "Axes | None" = None
    ) -> "Axes":
        """σ of a projected point over the image of a camera; matplotlib axes."""
        uncertainty = self.uncertainty(name, distance, frame, DRAWN)
        size = not_none(self.camera(name).image_size)
        return plotting.uncertainty_image(uncertainty, size, self.object_unit, name, ax)

    def report(self) -> str:
        """The full report as text."""
        from jaxbundle.calibration.rig.report import rig_text

        return rig_text(self)

    def to_dict(self, brief: bool = False) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON."""
        from jaxbundle.calibration.rig.report import rig_dict

        return rig_dict(self, brief)

    def table(self) -> dict[str, np.ndarray]:
        """One row a mounting: columns camera, X0, Y0, Z0 (of the base, object unit), omega,
        phi, kappa (degrees), their σ (sX0, …), base and sbase (its length)."""
        return table_of_mountings(self.mountings)

    def __str__(self) -> str:
        lines = [
            f"Rig of {len(self.names)} cameras, {len(self.epochs)} epochs, σ0 "
            f"{self.sigma0:.3f}, reference {self.names[0]}"
        ]
        for name, m in self.mountings.items():
            lines.append(f"{name}: base {m.length:.6g} ± {m.length_sigma:.2g}")
        for name, clock in self.clocks.items():
            lines += [f"clock of {name}: {sentence}" for sentence in clock.in_words()]
        return "\n".join(lines)


@partial(compile_once, static=())
def _matrices(rotation: Float[AnyArray, "n 4"]) -> Float[Array, "n 3 3"]:
    return jax.vmap(matrix_from_quaternion)(rotation)
