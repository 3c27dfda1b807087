"""The result of a calibration: the camera, its adjustment, and its accuracy."""

import dataclasses
import functools
from functools import partial
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle import plotting
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.calibration import quality
from jaxbundle.calibration.advice import (
    ADVICE,
    advice,
    many_not_used,
    misfitting_views,
    often_removed,
    suggest,
)
from jaxbundle.calibration.affinity import MissingAffinity, find_missing_affinity
from jaxbundle.calibration.bias import CalibrationBias, find_bias
from jaxbundle.calibration.mapping_error import MappingError, mapping_error
from jaxbundle.calibration.quality import Coverage, CrossValidation, UncertaintyMap
from jaxbundle.cameras import get_model
from jaxbundle.display import print_anywhere
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.blunders import removed_rays
from jaxbundle.network.tables import Camera
from jaxbundle.report.correlated import has_field, stated_sigma_of
from jaxbundle.report.lens_advice import advise_parameters, is_hardly_determined
from jaxbundle.report.verdict import judge_replication
from jaxbundle.results import TableMethods
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@print_anywhere
class Calibration(TableMethods):
    """A calibrated camera. It prints as a summary; `report()` is the full report.

    **Attributes:**

    - `views`: the measurements, and the failed photographs with reasons;
    - `adjustment`: the `Adjustment` of the network;
    - `camera`: the camera with its adjusted parameters, held; `parameters` and `sigma` by name
      (in the unit of the model, a posteriori), and `stated_sigma`, which are shown;
    - `rms`: √(Σ(vx² + vy²)/points) in pixels, as OpenCV defines it;
    - `bias`, `mapping_error`, `coverage`, `advice`, `cross_validation`: accuracy, and advice on
      further photographs; `validated`: whether the last is requested.
    """

    def __init__(self, views: BoardViews, adjustment: Adjustment, validated: bool = True):
        self.views = views
        self.validated = validated
        self.adjustment = adjustment
        # Report, page, JSON and figures use the same maps, each a propagation of the whole
        # covariance.
        self._maps: dict[tuple, UncertaintyMap] = {}

    @property
    def converged(self) -> bool:
        return self.adjustment.converged

    @property
    def name(self) -> str:
        return self.adjustment.network.cameras[0].id

    @property
    def parameters(self) -> dict[str, float]:
        """All parameters of the camera by name."""
        return self.adjustment.camera_parameters(self.name)

    @functools.cached_property
    def sigma(self) -> dict[str, float]:
        """Classical σ of the free parameters by name."""
        names, C = self.adjustment.camera_covariance(self.name, classical=True)
        return dict(zip(names, np.sqrt(np.diagonal(C)).tolist()))

    @functools.cached_property
    def stated_sigma(self) -> dict[str, float]:
        """σ of the free parameters by name, under errors that image points share where these are
        known and their σ are larger."""
        parameters = self.adjustment.cameras[self.name]["parameters"]
        return {name: not_none(stated_sigma_of(parameters[name])) for name in self.sigma}

    @property
    def camera(self) -> Camera:
        """The calibrated camera with no free parameters."""
        adjusted_camera = self.adjustment.network.cameras[0]
        return dataclasses.replace(
            adjusted_camera, parameters=self.parameters, free=(), sigma={}, observed={}
        )

    @functools.cached_property
    def _residuals(self) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        return quality.residuals_in_pixels(self.adjustment, self.adjustment.network.cameras[0])

    @property
    def rms(self) -> float:
        """√(Σ(vx² + vy²)/points) of the image points used, pixels."""
        return float(np.sqrt(np.nanmean((self._residuals[0] ** 2).sum(1))))

    @property
    def measured(self) -> Float[np.ndarray, "n 2"]:
        """All measured image points, pixels."""
        return self._residuals[1]

    @property
    def rotation(self) -> Float[np.ndarray, "views 3 3"]:
        """M of every view, board to camera."""
        return np.asarray(_matrices(self.adjustment.values["image"].rotation))

    @property
    def position(self) -> Float[np.ndarray, "views 3"]:
        """X0 of every view in the system of its board, object unit."""
        return self.adjustment.image_values[:, :3]

    @property
    def distances(self) -> Float[np.ndarray, " views"]:
        """Distance of every view from the centre of its board, object unit."""
        return np.linalg.norm(self.position - self.views.centres, axis=1)

    @functools.cached_property
    def coverage(self) -> Coverage:
        """Where in the image points were measured."""
        return quality.coverage(self._residuals[1], self.views.image_size)

    @functools.cached_property
    def cross_validation(self) -> CrossValidation | None:
        """The camera calibrated from either half of the photographs; None if there are too few,
        or if not requested (`validated`).

        Four more adjustments, made on first access."""
        return quality.cross_validation(self.adjustment) if self.validated else None

    @functools.cached_property
    def bias(self) -> CalibrationBias | None:
        """The bias test of camera model and board; None with too few cells of four corners."""
        return find_bias(self.adjustment, *self.views.board.grids)

    @functools.cached_property
    def mapping_error(self) -> MappingError:
        """The expected mapping error over the image, comparable between camera models, and over
        its measured part."""
        return mapping_error(self.adjustment, self.name)

    @property
    def advice(self) -> list[str]:
        """Warnings in words, those of the adjustment about the camera among them, and advice on
        further photographs (without cross-validation)."""
        return [*self.shortcomings, *self.limits, *self._contradictions, *self.suggestions]

    @property
    def limits(self) -> list[str]:
        """Where in the image the camera is not valid, in words."""
        message = self.adjustment.distortion_reach[self.name].message
        return [] if message is None else [message]

    @property
    def _contradictions(self) -> list[str]:
        """Halves of the photographs that contradict each other, in words."""
        finding = judge_replication(self.adjustment)
        return (
            [f"{finding.brief}: {finding.words}"] if finding is not None and finding.lowers else []
        )

    @property
    def suggestions(self) -> list[str]:
        """What would make a good calibration better."""
        which = advise_parameters(is_hardly_determined(self.adjustment), self._lacks_parameters)
        return suggest(self._significance, get_model(self.camera.model), which)

    @functools.cached_property
    def _missing_affinity(self) -> MissingAffinity | None:
        return find_missing_affinity(self.adjustment)

    @property
    def _lacks_parameters(self) -> bool:
        """Whether the residuals have a part that the camera model does not have."""
        affinity, bias = self._missing_affinity, self.bias
        return (
            self.rms > ADVICE.max_rms
            or (affinity is not None and affinity.missed)
            or (bias is not None and "camera" in bias.found)
            or has_field(self.adjustment)
        )

    @property
    def _significance(self) -> dict[str, float]:
        """|value|/σ of the free parameters."""
        return {name: abs(self.parameters[name]) / s for name, s in self.sigma.items() if s > 0}

    @property
    def shortcomings(self) -> list[str]:
        """Warnings in words, on the halves of the photographs once `cross_validation` was made."""
        warnings = advice(
            self.position,
            self.rotation,
            self.views.centres,
            self._unit,
            self.coverage,
            self.rms,
            self._significance,
            get_model(self.camera.model),
            # Only if it was made: four more adjustments are not made for an advice.
            self.__dict__.get("cross_validation"),
        )
        images = self.adjustment.images
        warnings = [
            *many_not_used(len(self.views), len(self.views.failed)),
            *misfitting_views(images["id"].tolist(), images["rms"]),
            *warnings,
        ]
        missed = self._missing_affinity
        if missed is not None and missed.missed:
            warnings = [*warnings, str(missed)]
        # Image points are removed one by one: only counted by corner do they show a bad print.
        problem = self.adjustment.problem
        rays = removed_rays(self.adjustment.removed)
        points = [problem.network.points.id[problem.point[ray]] for ray in rays]
        warnings += often_removed(points, len(problem.network.images))
        if self.bias is not None and self.bias.found:
            warnings = [*warnings, self.bias.sentence]
        return warnings

    def uncertainty(
        self, distance: float = np.inf, frame: str = "scene", grid: tuple[int, int] = quality.GRID
    ) -> UncertaintyMap:
        """Uncertainty of a projected point over the image, pixels, for a distance in the object
        unit; frames: see `jaxbundle.adjustment.quality.projection_uncertainty`."""
        key = (distance, frame, grid)
        if key not in self._maps:
            self._maps[key] = quality.uncertainty_map(
                self.adjustment, self.name, distance, frame, grid
            )
        return self._maps[key]

    @property
    def reported_maps(self) -> list[UncertaintyMap]:
        """Near (the median distance of the board), at ten times that, at infinity; and without the
        scene."""
        # Near the board the poses dominate, at infinity the camera; three distances also determine
        # the whole curve (`quality.over_distance`).
        median_distance = float(np.median(self.distances))
        frames_and_distances = (
            ("scene", median_distance),
            ("scene", 10 * median_distance),
            ("scene", np.inf),
            ("rotation", np.inf),
            ("camera", np.inf),
        )
        return [self.uncertainty(distance, frame) for frame, distance in frames_and_distances]

    def uncertainty_over_distance(
        self, distances: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """σ of a projected point in the middle and in the corners, pixels, [n] each."""
        return quality.over_distance(self._scene_maps, distances)

    def uncertainty_curves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distances from a quarter of the nearest of the board to a hundred times the farthest; σ
        of a projected point at them in the middle and in the corners (pixels); and these three of
        the maps of the report, as rows."""
        reported = np.array([(m.distance, m.middle, m.corners) for m in self._scene_maps]).T
        reported_distances = reported[0, np.isfinite(reported[0])]
        # 400 of them, dense enough to show every dip
        ends = self.distances.min() / 4, 100 * self.distances.max()
        distances = np.union1d(np.geomspace(*ends, 400), reported_distances)
        return distances, *self.uncertainty_over_distance(distances), reported

    @property
    def _scene_maps(self) -> list[UncertaintyMap]:
        return [m for m in self.reported_maps if m.frame == "scene"]

    @property
    def _unit(self) -> str:
        return self.adjustment.network.object_unit

    def plot_coverage(self, ax: "Axes | None" = None) -> "Axes":
        """Where in the image points were measured; matplotlib axes."""
        return plotting.coverage_map(
            self.coverage, self.measured, self.views.image_size, self.name, ax
        )

    def plot_uncertainty(
        self, distance: float = np.inf, frame: str = "scene", ax: "Axes | None" = None
    ) -> "Axes":
        """σ of a projected point over the image; matplotlib axes."""
        uncertainty = self.uncertainty(distance, frame, quality.DRAWN)
        return plotting.uncertainty_image(
            uncertainty, self.views.image_size, self._unit, self.name, ax
        )

    def plot_uncertainty_over_distance(self, ax: "Axes | None" = None) -> "Axes":
        """The curves of `uncertainty_curves`, with the values of the report marked; matplotlib
        axes."""
        span = float(self.distances.min()), float(self.distances.max())
        distances, middle, corners, reported = self.uncertainty_curves()
        return plotting.uncertainty_curve(
            distances, middle, corners, span, self._unit, self.name, ax, reported=tuple(reported)
        )

    def plot_halves(self, ax: "Axes | None" = None) -> "Axes":
        """The image differences of the cameras of the two halves (`cross_validation`); matplotlib
        axes."""
        halves = self.cross_validation
        if halves is None or halves.comparison is None:
            raise ValueError("there are no two halves to compare: too few photographs")
        title = f"Camera {self.name}: the two halves"
        return plotting.difference_map(halves.comparison, ax, title)

    def report(self) -> str:
        """The full report as text."""
        from jaxbundle.calibration.report import text

        return text(self)

    def to_dict(self, brief: bool = False) -> dict:
        """The result as plain dicts and numbers, as in JSON."""
        from jaxbundle.calibration.report import as_dict

        return as_dict(self, brief)

    def table(self) -> dict[str, np.ndarray]:
        """One row a parameter: columns parameter, value, sigma (NaN: not estimated), under
        correlated errors, where these are known, sigma_correlated."""
        names = list(self.parameters)
        column = lambda by_name: np.array(
            [by_name.get(name, np.nan) for name in names], dtype=float
        )
        table = {
            "parameter": np.array(names, dtype=object),
            "value": column(self.parameters),
            "sigma": column(self.sigma),
        }
        if self.adjustment.error_model is not None:
            free, C = self.adjustment.camera_covariance(self.name)
            table["sigma_correlated"] = column(dict(zip(free, np.sqrt(np.diagonal(C)))))
        return table

    def __str__(self) -> str:
        if not self.converged:
            return f"Calibration of {self.name}: not solved ({self.adjustment.termination})"
        values_in_words = ", ".join(
            f"{n} {self.parameters[n]:.6g} ± {s:.2g}" for n, s in self.stated_sigma.items()
        )
        halves = self.adjustment.replication
        return (
            f"Calibration of {self.name}: {len(self.views)} photographs, "
            f"{len(self.views.failed)} failed, RMS {self.rms:.3f} px\n{values_in_words}"
            + ("" if halves is None else f"\n{halves.sentence}")
        )


@partial(compile_once, static=())
def _matrices(rotation: Float[AnyArray, "views 4"]) -> Float[Array, "views 3 3"]:
    return jax.vmap(matrix_from_quaternion)(rotation)
