"""The result of an adjustment: values with standard deviations, tests, tables, figures.

Every σ is a posteriori (times σ0) unless called a priori. Cofactors and redundancy numbers are
computed on first access. Without a solution every accessor raises `NotSolvedError` with the reason.
"""

import copy
import functools
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle import plotting, report
from jaxbundle.adjustment import result_tables
from jaxbundle.adjustment.problem import Counts, NetworkProblem, coordinates
from jaxbundle.adjustment.quality.check_points import CheckPoints, intersect_check_points
from jaxbundle.adjustment.quality.control_prediction import ControlPrediction, predict_control
from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS as CORRELATIONS
from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings, correlated_errors
from jaxbundle.adjustment.quality.distortion_reach import (
    Reach,
    distortion_reach,
    farthest_measurements,
)
from jaxbundle.adjustment.quality.further_unknowns import Estimate
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.misfit import doubt_of_fit, doubt_of_unit
from jaxbundle.adjustment.quality.points_at_any_distance import FarPoints, find_far_points
from jaxbundle.adjustment.quality.replication import (
    HalvesDifference,
    Replication,
    compare_halves,
    random_halves,
)
from jaxbundle.adjustment.quality.variance_groups import groups
from jaxbundle.adjustment.quality.weakness import Weakness, weakness
from jaxbundle.adjustment.saved_state import (
    load_bytes,
    network_fingerprint,
    own_models,
    saved_bytes,
    store,
)
from jaxbundle.adjustment.second_minima.evidence import SecondMinimum
from jaxbundle.adjustment.unknowns import (
    angles_near,
    find_unknowns,
    place_of,
    require_located,
    value_of,
)
from jaxbundle.arguments import at_least_zero
from jaxbundle.arguments import path as given_path
from jaxbundle.display import print_anywhere
from jaxbundle.errors import NotSolvedError
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.leastsquares.adjust import TableResult, table_result
from jaxbundle.leastsquares.any_distance import is_at_infinity
from jaxbundle.leastsquares.datum.motions import SIMILARITY_PARAMETERS
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import SINGULAR, TERMINATIONS
from jaxbundle.leastsquares.iterations.stopping import converged as reached_minimum
from jaxbundle.leastsquares.quality.error_components import ErrorModel, Errors, IndependentErrors
from jaxbundle.leastsquares.quality.global_test import chi_squared_test, is_tested
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.leastsquares.quality.reliability import Reliability
from jaxbundle.leastsquares.quality.robust import Reweighted, residual_lengths, robust_scale
from jaxbundle.leastsquares.quality.variance_components import Component, variance_components
from jaxbundle.network.blunders import Removed, Suspect
from jaxbundle.network.columns import list_some
from jaxbundle.network.declare import LEAST_IMAGES
from jaxbundle.network.tables import ESTIMATED, UNIT, Network, Observations, Points, units_of
from jaxbundle.network.unit_mistakes import name_pixels
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation.swapped_control import CONTRADICTORY_CONTROL
from jaxbundle.results import data_frame, finite
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D


# Random halves that are tried for the replication of a result.
MAX_SPLITS = 3
# What a result keeps and what follows from its error model.
UNDER_ERRORS = (
    "check_points",
    "_modelled",
    "cameras",
    "control_prediction",
    "errors",
    "far_points",
    "image_covariance",
    "images",
    "point_covariance",
    "points",
    "replication",
)


@print_anywhere
class Adjustment:
    """An adjusted network. It prints as a summary; `report()` is the full report.

    **Attributes** (object unit, image unit and angle unit are the network's; angles in methods
    that return arrays are radians):

    - `converged`, `termination`, `iterations`, `sigma0`, `vtpv`, `redundancy`, `counts`
    - `cameras`, `images`, `points`, `residuals`: tables (dicts of numpy columns)
    - `method`, `reduction`: solver, and solver of the reduced system of images and cameras
    - `warnings`, `removed` (data snooping), `eliminated` (insignificant parameters),
      `undetermined` (names, if the network is singular), `weakness` (poorly determined unknowns)
    - `far_points`: direction and distance of the points at any distance, whose rays are nearly
      parallel; None if there are none
    - `sigma_factors`: with estimated variance components, the factor of the a priori σ by group of
      observations; empty otherwise. A priori then refers to the estimated σ, except in
      `variance_components`.
    - `findings`: likely causes of a missing solution or a bad fit; in words, also among the
      `warnings`.
    - `robust`, `weights`: the estimator, and its weight factors of the image points in the order
      of the observations; None otherwise. A priori σ are then those after weighting.
      `robust_scale`: of the residuals, a posteriori (MAD), in a priori σ; `suspects`: image points
      whose residuals exceed the critical value.
    - `doubts`: the warnings about a priori σ, σ0 and blunders
    - `error_model`: of errors that image points share, if it was requested (`correlations`, its
      settings) and the network can show any, else None; `replication`: two halves of the network
      compared, if requested (`halves_by`), else None
    - `second_minima`: other minima (`adjustment.second_minima.evidence.SecondMinimum`) that cannot
      be separated from the result, or that were left for a better one
    - `fingerprint`: of the adjusted network; `save` writes the result into a file
    """

    # Statistics are computed on first use and kept: most callers read a few, and the covariances of
    # a large block take longer than its adjustment.
    def __init__(  # noqa: PLR0913 - all that a result holds
        self,
        network: Network,
        problem: NetworkProblem,
        minimum: Minimum,
        *,
        removed: tuple[Removed, ...] = (),
        eliminated: tuple[Name, ...] = (),
        undetermined: tuple[str, ...] = (),
        check: tuple[Points, Observations] | None = None,
        method: str = "levenberg-marquardt",
        reduction: str | None = None,
        sigma_factors: Mapping[str, float] | None = None,
        inspection: Inspection | None = None,
        robust: str | None = None,
        reweighted: Reweighted | None = None,
        suspects: tuple[Suspect, ...] = (),
        doubts: tuple[str, ...] = (),
        weakness: Weakness | None = None,
        findings: tuple[str, ...] = (),
        correlations: CorrelationSettings | None = None,
        halves_by: str = "",
        second_minima: tuple[SecondMinimum, ...] = (),
    ):
        self.network = network
        self.problem = problem
        self.minimum = minimum
        self.removed = removed
        self.eliminated = eliminated
        self.undetermined = undetermined
        self.method = method
        self.reduction = reduction or problem.reduction
        self.sigma_factors = dict(sigma_factors or {})
        self.robust = robust
        self.weights = self.robust_scale = None
        if reweighted is not None:
            self.weights = np.asarray(problem.image_points(reweighted.weights))
            self.robust_scale = reweighted.scale
        self.suspects = suspects
        self.given_doubts = doubts
        self.findings = findings
        self.correlations = correlations
        self.halves_by = halves_by
        self.second_minima = second_minima
        self._weakness = weakness
        self._inspection = inspection
        self.check = check

    # --- how it ended -----------------------------------------------------------------------

    def with_changes(
        self,
        *,
        sigma_factors: Mapping[str, float] | None = None,
        findings: tuple[str, ...] | None = None,
        correlations: CorrelationSettings | None = None,
        halves_by: str | None = None,
    ) -> "Adjustment":
        """The same result with other factors of σ or findings, or with errors that image points
        share (`correlations`) and halves by photographs, points or runs; what follows from none of
        them is not computed again."""
        changed = copy.copy(self)
        for name in ("verdict", "doubts", "variance_components", "check_points", "fingerprint"):
            changed.__dict__.pop(name, None)
        if sigma_factors is not None:
            changed.sigma_factors = dict(sigma_factors)
        if findings is not None:
            changed.findings = findings
        if correlations is not None:
            changed.correlations = correlations
            for name in UNDER_ERRORS:
                changed.__dict__.pop(name, None)
        if halves_by is not None:
            changed.halves_by = halves_by
            changed.__dict__.pop("replication", None)
        return changed

    def with_correlated_errors(
        self, halves_by: str = "photographs", settings: CorrelationSettings = CORRELATIONS
    ) -> "Adjustment":
        """The same result with an error model and one split into halves, as `reconstruct` and
        `calibrate` state them; unchanged without a result, and with fewer photographs than
        `settings.min_images`. Both are computed when they are needed."""
        if not self.converged or len(self.problem.network.images) < settings.min_images:
            return self
        return self.with_changes(correlations=settings, halves_by=halves_by)

    @property
    def converged(self) -> bool:
        """Whether a minimum was reached and all unknowns are determined."""
        return bool(reached_minimum(int(self.minimum.termination))) and not self.undetermined

    @property
    def termination(self) -> str:
        """Why the iterations ended, in words."""
        if self.undetermined:
            return TERMINATIONS[SINGULAR]
        return TERMINATIONS[int(self.minimum.termination)]

    @property
    def iterations(self) -> int:
        """Steps tried, including rejected ones, without the evaluation of the start."""
        return max(int(self.minimum.iterations) - 1, 0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Suspicious data, in words; also poorly determined unknowns, distortions that
        are not one-to-one, and a σ0 far above 1. See also `notes`."""
        reach_of_cameras = self.distortion_reach.values() if self.converged else ()
        turns = (reach.message for reach in reach_of_cameras if reach.message is not None)
        lines = (
            *self.problem.network.warnings,
            *self.findings,
            *self.weakness.lines,
            *turns,
            *self.doubts,
        )
        return tuple(dict.fromkeys(lines))

    @property
    def notes(self) -> tuple[str, ...]:
        """Information that does not lower the verdict, in words: where start values come from, what
        was left out, how uncertain the georeference is."""
        return tuple(dict.fromkeys((*self.problem.network.notes, *self.weakness.notes)))

    @functools.cached_property
    def verdict(self) -> report.Verdict:
        """Whether the result meets its tests: `state` ("met", "doubtful", "not met"), a sentence,
        and the findings: subject, state, numbers in words."""
        self._require_solved()
        return report.conclude(self)

    @functools.cached_property
    def weakness(self) -> Weakness:
        """Poorly determined unknowns: σ above a fiftieth of their reference length; without a
        solution the a priori σ where the iterations ended.

        The σ are a posteriori with a robust scale, so that neither blunders nor a reported
        contradiction make good geometry look weak."""
        if self._weakness is not None or not self.converged:
            return self._weakness or Weakness()
        # Contradictory control is reported by itself; its residuals would make images look weak.
        scale = self._scale
        lines = (*self.problem.network.warnings, *self.findings)
        if any(CONTRADICTORY_CONTROL in line for line in lines):
            scale = min(scale, 1.0)
        return weakness(self.inspection, min(self.sigma0, scale))

    @functools.cached_property
    def _scale(self) -> float:
        return robust_scale(self.problem, residual_lengths(self.inspection.solution))

    @functools.cached_property
    def doubts(self) -> tuple[str, ...]:
        """The warnings about a priori σ, σ0 and blunders, with the remedy; the last one about a
        global test that clearly fails."""
        if not self.converged:
            return self.given_doubts
        if self.sigma_origin == UNIT and self.weights_matter:
            unit = report.unit_of_weight(self)
            doubt = doubt_of_unit(self.sigma0, self.redundancy, unit)
            return self.given_doubts if doubt is None else (*self.given_doubts, doubt)
        # After downweighting σ0 < 1 is what a robust estimate has, and no finding.
        doubt, downweighted = None, self.robust and self.sigma0 < 1
        tested = is_tested(self.redundancy, self.sigma_origin)
        if tested and not downweighted and (self.sigma0 > 1 or self.weights_matter):
            in_pixels = bool(name_pixels(self.problem.network))
            doubt = doubt_of_fit(self.sigma0, self._scale, self.redundancy, in_pixels)
        return self.given_doubts if doubt is None else (*self.given_doubts, doubt)

    @functools.cached_property
    def distortion_reach(self) -> dict[str, Reach]:
        """By camera, the radius to which its distortion was checked, and whether it is one-to-one
        there."""
        return distortion_reach(self.problem, self.values)

    @property
    def farthest_measurements(self) -> Float[np.ndarray, " cameras"]:
        """The largest distance of a measurement of every camera from its principal point, in the
        unit of its model."""
        return farthest_measurements(self.problem, self.values)

    @property
    def counts(self) -> Counts:
        """Rows and unknowns of the adjustment."""
        return self.problem.rows_and_unknowns

    @property
    def redundancy(self) -> int:
        """Observations + pseudo-observations + datum conditions − unknowns."""
        return self.counts.redundancy

    @property
    def values(self) -> Values:
        """The adjusted arrays (relative to `problem.origin`)."""
        self._require_solved()
        return self.minimum.values

    def _require_solved(self) -> None:
        if not self.converged:
            names = list_some(self.undetermined, 8, str)
            details = f"; not determined: {names}" if names else ""
            details += "".join(f"; {line}" for line in (*self.findings, *self.weakness.lines))
            raise NotSolvedError(
                f"the adjustment did not converge ({self.termination}){details}; it has no result"
            )

    # --- precision of the whole -------------------------------------------------------------

    @functools.cached_property
    def vtpv(self) -> float:
        """vᵀPv of all observations, pseudo-observations included."""
        return self.inspection.vtpv

    @property
    def sigma0(self) -> float:
        """σ0 = √(vᵀPv/redundancy), dimensionless; NaN without redundancy."""
        r = self.redundancy
        return float(np.sqrt(self.vtpv / r)) if r > 0 else float("nan")

    def pope(self, w: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Pope's τ = w/σ0 from Baarda's w; NaN if all observations fit exactly."""
        return w / (self.sigma0 or float("nan"))

    @property
    def sigma_origin(self) -> str:
        """Where the a priori σ of image coordinates come from (`network.tables.SIGMA_ORIGINS`)."""
        if self.sigma_factors:
            return ESTIMATED
        return self.problem.network.observations.sigma_origin

    @property
    def weights_matter(self) -> bool:
        """Whether the ratio of the σ of image coordinates to those of other observations has an
        effect: there are more of these than the datum needs beside what is held."""
        points, images = self.problem.network.points, self.problem.network.images
        # Only the excess over the datum counts: the observations that fix it fit exactly, whatever
        # their σ.
        number_held = 3 * int(points.has_role("fixed").sum()) + int((images.sigma == 0).sum())
        needed = max(len(SIMILARITY_PARAMETERS) - self.counts.datum - number_held, 0)
        return self.counts.pseudo_observations > needed

    def global_test(self, significance: float = 0.05) -> dict:
        """χ² test of vᵀPv against a variance factor of 1 (two-sided): `vtpv`, the interval `low` to
        `high`, `passed`, and `sigma_origin`.

        `passed` is None if nothing is tested: nobody stated a priori σ, or they were estimated from
        the residuals, or there is no redundancy.
        """
        return chi_squared_test(self.vtpv, self.redundancy, self.sigma_origin, significance)

    # --- cofactors --------------------------------------------------------------------------

    @functools.cached_property
    def inspection(self) -> Inspection:
        """The inspection of the solution, for statistics."""
        self._require_solved()
        return self._inspection or Inspection(self.problem, self.values)

    @property
    def cofactors(self) -> Inspection:
        """The inspection, if there is a factor for cofactors.

        **Raises:** `NotSolvedError`."""
        if self.problem.reduction not in FACTORS:
            raise NotSolvedError(
                f"the reduced system of {self.problem.reduced_size} unknowns was solved "
                "by iteration and its factor does not fit into memory: only coordinates, σ0 "
                "and covariances of single unknowns (`covariance`) are available"
            )
        return self.inspection

    @property
    def reliability(self) -> Reliability:
        """Redundancy numbers and w of all observations, by set (`network.declare`)."""
        return self.cofactors.reliability

    @functools.cached_property
    def variance_components(self) -> dict[str, Component]:
        """For every group of observations the ratio of σ̂ to the given a priori σ, and σ̂
        itself."""
        solution = self.cofactors.solution
        return variance_components(solution, groups(self.problem), self.sigma_factors)

    @functools.cached_property
    def check_points(self) -> CheckPoints | None:
        """Check points intersected after the adjustment; None if there are none."""
        self._require_solved()
        if self.check is None:
            return None
        settings = self.correlations or CORRELATIONS
        return intersect_check_points(
            self.inspection, *self.check, self.sigma_factors, self.errors, settings
        )

    @functools.cached_property
    def control_prediction(self) -> ControlPrediction | None:
        """Every control point with σ, and every image measurement of control, predicted from all
        other observations; None without control with σ, or without a factor for cofactors."""
        self._require_solved()
        if self.problem.reduction not in FACTORS:
            return None
        return predict_control(self.inspection, self.sigma0, self.error_model)

    # --- unknowns ---------------------------------------------------------------------------

    @functools.cached_property
    def image_values(self) -> Float[np.ndarray, "images 6"]:
        """X0, Y0, Z0 (object unit), ω, φ, κ (radians, on the turn and branch of the start
        values)."""
        position = np.asarray(self.values["image"].position) + self.problem.origin
        return np.concatenate([position, np.asarray(self._angles[0])], 1)

    @functools.cached_property
    def _angles(self):
        """ω, φ, κ of all images, nearest to the given angles, and their Jacobians by δθ; small
        networks share the program."""
        # The batch is filled up to a shared size, so that small networks use one compiled program.
        reference = self.problem.network.images.angles
        rows = max(round_up(len(reference)), LEAST_IMAGES)
        wide = (
            np.resize(x, (rows, x.shape[1])) for x in (self.values["image"].rotation, reference)
        )
        return [np.asarray(x)[: len(reference)] for x in _all_angles(*wide)]

    @property
    def angle_jacobian(self) -> Float[np.ndarray, "images 3 3"]:
        """∂(ω, φ, κ)/∂δθ of every image."""
        return self._angles[1]

    @functools.cached_property
    def image_covariance(self) -> Float[np.ndarray, "images 6 6"]:
        """Covariance of X0, Y0, Z0, ω, φ, κ, angles by their exact Jacobian; radians."""
        return self._of_images(self._errors_of_blocks)

    @functools.cached_property
    def classical_image_covariance(self) -> Float[np.ndarray, "images 6 6"]:
        """`image_covariance` of independent errors."""
        return self._of_images(self.independent_errors)

    def _of_images(self, errors: Errors) -> Float[np.ndarray, "images 6 6"]:
        C = errors.covariance("image")
        # C of X0 and δθ to that of X0 and ω, φ, κ: A = diag(I, ∂(ω, φ, κ)/∂δθ).
        A = np.zeros((len(C), 6, 6))
        A[:, :3, :3] = np.eye(3)
        A[:, 3:, 3:] = self.angle_jacobian
        free = self.problem.table("image").free
        C = C * free[:, :, None] * free[:, None, :]
        return A @ C @ A.transpose(0, 2, 1)

    # --- correlated errors ------------------------------------------------------------------

    @functools.cached_property
    def _modelled(self) -> tuple[ErrorModel | None, str]:
        """The error model; why there is none although it was requested."""
        if self.correlations is None or not self.converged:
            return None, ""
        why = f"no camera has {self.correlations.min_images} photographs, and no point two rays"
        try:
            solution = self.cofactors.solution
            return correlated_errors(solution, self.problem, self.correlations), why
        except NotSolvedError as error:
            return None, str(error)

    def keep(self, model: ErrorModel | None, halves: Replication | None) -> None:
        """Take over an error model and halves that were computed before (`load_adjustment`);
        None: they are computed when they are needed."""
        if model is not None:
            for name in UNDER_ERRORS:
                self.__dict__.pop(name, None)
            self.__dict__["_modelled"] = model, ""
        if halves is not None:
            self.__dict__["replication"] = halves

    @property
    def error_model(self) -> ErrorModel | None:
        """Errors that image points share; None if they were not requested, or cannot be found."""
        return self._modelled[0]

    @functools.cached_property
    def errors(self) -> Errors:
        """The covariance of everything that follows from the observations: by the error model where
        there is one, else of independent errors. Whatever states a σ asks it."""
        # Without a factor for cofactors there is no model, but covariances of single unknowns.
        return self.error_model or IndependentErrors(self.inspection.solution, self.sigma0**2)

    @property
    def _errors_of_blocks(self) -> Errors:
        """The same for covariances of whole tables, which need a factor for cofactors."""
        return self.error_model or self.independent_errors

    @property
    def independent_errors(self) -> IndependentErrors:
        """The classical covariance, σ0² times the cofactors.

        **Raises:** `NotSolvedError` without a factor for cofactors."""
        return IndependentErrors(self.cofactors.solution, self.sigma0**2)

    @property
    def why_no_error_model(self) -> str:
        """Why a requested error model cannot be found; empty if it was."""
        model, why = self._modelled
        return why if model is None else ""

    @property
    def assumes_independence(self) -> bool:
        """Whether σ take the errors of image points as independent, though there are photographs
        enough to look for others."""
        has_enough = len(self.problem.network.images) >= CORRELATIONS.min_images
        return self.correlations is None and has_enough

    @functools.cached_property
    def replication(self) -> Replication | None:
        """One split of the network into halves, adjusted and compared; None if not requested."""
        if not self.halves_by or not self.converged:
            return None
        # Of held cameras alone there is nothing to compare.
        cameras = range(len(self.problem.network.cameras))
        if not any(len(self.problem.free_parameters(c)[1]) for c in cameras):
            return None
        failed = []
        # A random half may have all rolled photographs, or none, and not determine the camera.
        for in_second in random_halves(self.problem.network, self.halves_by, MAX_SPLITS, 0):
            try:
                split = self.compare_halves(in_second)
            except NotSolvedError as error:
                failed.append(str(error))
            else:
                return Replication(self.halves_by, (split,), (), self.error_model)
        return Replication(self.halves_by, (), tuple(failed[:1]), self.error_model)

    def compare_halves(self, second: Bool[np.ndarray, " rays"]) -> HalvesDifference:
        """The interior orientations of two halves of the network, each adjusted alone; `second`:
        the image points of the second one.

        **Raises:** `NotSolvedError` if a half has too few photographs, or no solution."""
        return compare_halves(self.cofactors.solution, self.problem, second, self.error_model)

    @property
    def correlated_image_covariance(self) -> Float[np.ndarray, "images 6 6"] | None:
        """`image_covariance` under the error model; None without one."""
        return None if self.error_model is None else self.image_covariance

    @property
    def correlated_point_covariance(self) -> Float[np.ndarray, "points 3 3"] | None:
        """`point_covariance` under the error model; None without one."""
        return None if self.error_model is None else self.point_covariance

    def correlated_camera_covariance(self, camera: str) -> Float[np.ndarray, "n n"] | None:
        """`camera_covariance` under the error model, of the same parameters; None without one."""
        return None if self.error_model is None else self.camera_covariance(camera)[1]

    @property
    def image_rms(self) -> float:
        """The RMS of the residuals of image coordinates, in the image unit; NaN without any."""
        v = result_tables.image_residuals(self)[self.problem.used_coordinates]
        return float(np.sqrt(np.mean(v**2))) if v.size else float("nan")

    @property
    def sigma_ratio(self) -> float:
        """The median of σ under the error model over classical σ, of the interior orientations or
        of the exterior ones, whichever is larger: control determines only the latter. 1 without a
        model."""
        if self.error_model is None:
            return 1.0
        cameras = [camera.id for camera in self.problem.network.cameras]
        interior = [
            (self.camera_covariance(c, classical=True)[1][None], self.camera_covariance(c)[1][None])
            for c in cameras
        ]
        exterior = [(self.classical_image_covariance, self.image_covariance)]
        medians = []
        for pairs in (interior, exterior):
            variances = [
                [np.diagonal(C, axis1=1, axis2=2).ravel() for C in classical_and_correlated]
                for classical_and_correlated in pairs
            ]
            ratios = np.concatenate([np.sqrt(b[a > 0] / a[a > 0]) for a, b in variances])
            if len(ratios):
                medians.append(float(np.median(ratios)))
        return max(medians, default=1.0)

    @functools.cached_property
    def point_values(self) -> Float[np.ndarray, "points 3"]:
        """X, Y, Z in the object unit; NaN at infinity, and if excluded by data snooping."""
        return self._where_known(np.asarray(coordinates(self.values)) + self.problem.origin)

    @functools.cached_property
    def point_covariance(self) -> Float[np.ndarray, "points 3 3"]:
        """Marginal covariance of every point; zero where it is fixed, NaN without coordinates."""
        return self._of_points(self._errors_of_blocks)

    @functools.cached_property
    def classical_point_covariance(self) -> Float[np.ndarray, "points 3 3"]:
        """`point_covariance` of independent errors."""
        return self._of_points(self.independent_errors)

    def _of_points(self, errors: Errors) -> Float[np.ndarray, "points 3 3"]:
        # Of far points the engine's are those of direction and inverse distance.
        C = self.problem.cofactors_of_coordinates(self.values["point"], errors.covariance("point"))
        return self._where_known(np.asarray(C))

    def _where_known(
        self, of_points: Float[np.ndarray, "points ..."]
    ) -> Float[np.ndarray, "points ..."]:
        lengths, unknown = self.problem.lengths, self.problem.excluded
        if lengths is not None:
            unknown = unknown | is_at_infinity(np.asarray(coordinates(self.values)), lengths)
        return np.where(unknown.reshape(-1, *(1,) * (of_points.ndim - 1)), np.nan, of_points)

    @functools.cached_property
    def located(self) -> Bool[np.ndarray, " points"]:
        """Which points are neither at any distance nor excluded by data snooping."""
        return ~(self.problem.at_any_distance | self.problem.excluded)

    @functools.cached_property
    def far_points(self) -> FarPoints | None:
        """The points adjusted at any distance because their rays are nearly parallel; None if there
        are none."""
        return find_far_points(self.cofactors, self._errors_of_blocks)

    def camera_parameters(self, camera: str) -> dict[str, float]:
        """All parameters of a camera by name."""
        c = self._camera(camera)
        table, row = self.problem.table_of_camera(c)
        return dict(zip(table.parameters, np.asarray(self.values[table.name])[row].tolist()))

    def camera_covariance(
        self, camera: str, *, classical: bool = False
    ) -> tuple[list[str], Float[np.ndarray, "n n"]]:
        """Names and covariance of the free parameters of a camera; `classical`: of independent
        errors, also where an error model is known."""
        errors = self.independent_errors if classical else self._errors_of_blocks
        table, row = self.problem.table_of_camera(self._camera(camera))
        names, free = self.problem.free_parameters(self._camera(camera))
        return [names[i] for i in free], errors.covariance(table.name)[row][np.ix_(free, free)]

    def camera_cofactor(self, camera: str) -> tuple[list[str], Float[np.ndarray, "n n"]]:
        """Names and cofactors of the free parameters of a camera."""
        names, free = self.problem.free_parameters(self._camera(camera))
        Q = self.cofactors.camera_cofactors[self._camera(camera)]
        return [names[i] for i in free], Q[np.ix_(free, free)]

    def _camera(self, camera: str) -> int:
        return place_of(
            camera,
            [camera_of_network.id for camera_of_network in self.problem.network.cameras],
            "camera",
        )

    def insignificant(self, critical: float = 2.0) -> list[tuple[float, Name]]:
        """Free interior parameters with t = |value|/σ below `critical`, the least first.

        **Raises:** `InputError` for a critical value that is negative or not a number."""
        critical = at_least_zero("critical", critical)
        parameters = [
            (entry["t"], Name("camera", camera, parameter))
            for camera, table in self.cameras.items()
            for parameter, entry in table["parameters"].items()
            if parameter in table["free"] and entry["t"] < critical
        ]
        return sorted(parameters, key=lambda item: item[0])

    def covariance(
        self, *names: tuple[str, str, str], classical: bool = False
    ) -> Float[np.ndarray, "n n"]:
        """Covariance of any unknowns by name, e.g. `("camera", "cam", "c")`,
        `("image", "12", "kappa")` (radians), `("point", "7", "Z")`; `classical` as of
        `covariance_of`.

        **Raises:** `InputError` without names, for a name that does not have three parts, or for a
        point excluded by data snooping; `KeyError` for an unknown name."""
        unknowns = find_unknowns(self.problem, names)
        for name in unknowns:
            require_located(self.problem, name)

        def pick(values: Values):
            return jnp.stack([value_of(self.problem, name, values) for name in unknowns])

        return self.covariance_of(pick, classical=classical)

    def covariance_of(
        self, function: Callable[[Values], jax.Array], *, classical: bool = False
    ) -> Float[np.ndarray, "n n"]:
        """Covariance of any differentiable function of the adjusted unknowns (`Values` → [n]):
        lengths, angles, projections; `classical`: of independent errors, also where an error model
        is known."""
        self._require_solved()
        if classical:
            return self.sigma0**2 * self.inspection.propagate(function)
        return self.errors.propagate(function)

    # --- tables -----------------------------------------------------------------------------

    @property
    def angle_scale(self) -> float:
        """Factor from radians to the network's angle unit."""
        return 1 / ANGLE_UNITS[self.network.angle_unit]

    @property
    def image_unit(self) -> str:
        """The unit of image coordinates in the adjustment: that of the camera models."""
        return units_of(self.problem.network.cameras)

    @functools.cached_property
    def cameras(self) -> dict[str, dict]:
        """Per camera: model, and per parameter value, sigma, free, t, total_correlation; and the
        correlation matrix of the free ones."""
        return result_tables.cameras(self)

    def unknowns(self, table: str) -> TableResult:
        """Values, σ and covariances of a table of unknowns of further kinds of observations (`also`
        of `jaxbundle.adjust`)."""
        if table not in self.problem.further_tables:
            known_tables = ", ".join(self.problem.further_tables) or "none"
            raise KeyError(f"there is no further table {table!r}; known: {known_tables}")
        return table_result(self.cofactors.solution, table, self.sigma0)

    @functools.cached_property
    def further_estimates(self) -> list[Estimate]:
        """The unknowns of further kinds of observations with their units, a row each."""
        return result_tables.further_estimates(self)

    @functools.cached_property
    def further_unknowns(self) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
        """By table, row and name: value and sigma of the unknowns of further kinds of observations
        (angles in the network's unit)."""
        return result_tables.further_unknowns(self)

    @functools.cached_property
    def images(self) -> dict[str, np.ndarray]:
        """Columns id, X0 … kappa, sX0 … skappa (angles in the network's unit), rays, rms (of v,
        image unit)."""
        return result_tables.images(self)

    @functools.cached_property
    def points(self) -> dict[str, np.ndarray]:
        """Columns id, role, X, Y, Z, sX, sY, sZ, rays."""
        return result_tables.points(self)

    @functools.cached_property
    def residuals(self) -> dict[str, np.ndarray]:
        """One row per observation: kind, image, point, axis, unit, v, sigma (a priori), r, w
        (Baarda), tau (Pope), mdb, external; image observations first, in the given order."""
        return result_tables.residuals(self)

    @property
    def measured(self) -> Float[np.ndarray, " rows"]:
        """What was measured, by row of `residuals`, in its unit; NaN of priors, and of kinds that
        measure something else than one number for each residual."""
        return result_tables.measured_values(self.problem)

    def table(self, name: str) -> dict[str, np.ndarray]:
        """A table by name: images, points, residuals, cameras (one row per parameter), checks,
        far_points, or of predicted control, control and control_measurements."""
        makers = {
            "control": result_tables.control,
            "control_measurements": result_tables.control_measurements,
            "cameras": result_tables.parameters,
            "checks": result_tables.checks,
            "far_points": result_tables.far_points,
        }
        if name in makers:
            return makers[name](self)
        if name not in ("images", "points", "residuals"):
            known_tables = ", ".join(("images", "points", "residuals", *makers))
            raise KeyError(f"tables are {known_tables}; not {name!r}")
        return getattr(self, name)

    # --- as a file --------------------------------------------------------------------------

    @functools.cached_property
    def fingerprint(self) -> str:
        """16 hex digits of the network that was adjusted: cameras, start values, measurements and
        settings, wherever they were read."""
        return network_fingerprint(self.problem.network)

    def save(self, path: str | PathLike) -> None:
        """Write the whole result into a file, which `jaxbundle.load_adjustment` reads; a file of
        this name is replaced when the new one is complete. User-defined camera models and
        observations (`also`) are functions: the file names them, and they must be given when it is
        loaded.

        **Raises:** `NotSolvedError` where there is no result; `InputError` where the file cannot
        be written."""
        self._require_solved()
        store(self, given_path("path", path))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled, as by `multiprocessing`: what `save` writes, with user-defined camera models."""
        models = own_models(self.problem.network)
        return load_bytes, (saved_bytes(self), tuple(models.values()))

    def __copy__(self) -> "Adjustment":
        # By `__reduce__` a copy would compute its covariances anew.
        copied = object.__new__(type(self))
        vars(copied).update(vars(self))
        return copied

    def __deepcopy__(self, memo: dict[int, Any]) -> "Adjustment":
        return copy.copy(self)

    # --- for people -------------------------------------------------------------------------

    def report(self, residual_limit: float = 3.0, **options: Any) -> str:
        """The full report as text (options: see `jaxbundle.report.text`)."""
        residual_limit = at_least_zero("residual_limit", residual_limit)
        return report.text(self, residual_limit, **options)

    def to_dict(self, brief: bool = False) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON (docs/result.md); `brief`: without
        points and residuals."""
        return finite(result_dict(self, brief))

    def __str__(self) -> str:
        return report.short(self)

    def __repr__(self) -> str:
        return report.one_line(self)

    def _repr_html_(self) -> str:
        return report.html(self)

    def plot_plan(self, ax: "Axes | None" = None) -> "Axes":
        """The network in plan view, with error ellipses; matplotlib axes."""
        return plotting.network_plan(self, ax)

    def plot_perspective(self, ax: "Axes3D | None" = None) -> "Axes3D":
        """The network in perspective; matplotlib 3D axes."""
        return plotting.network_perspective(self, ax)

    def plot_residuals(self, image: str, ax: "Axes | None" = None) -> "Axes":
        """The residuals of an image as vectors; matplotlib axes."""
        return plotting.residual_vectors(self, image, ax)

    def plot_distortion(self, camera: str, ax: "Axes | None" = None) -> "Axes":
        """The distortion of a camera over the radius, with ±σ; matplotlib axes."""
        return plotting.distortion_curve(self, camera, ax)

    def plot_correlations(self, camera: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Correlations of the free parameters of a camera, or of all; matplotlib axes."""
        return plotting.correlation_matrix(self, camera, ax)

    def plot_histogram(self, ax: "Axes | None" = None) -> "Axes":
        """The normalised residuals compared with the normal distribution; matplotlib axes."""
        return plotting.residual_histogram(self, ax)

    def units(self, name: str) -> dict[str, str]:
        """The units of the columns of a table; of residuals and camera parameters, whose units
        differ from row to row, none."""
        return result_tables.units(self, list(self.table(name)), name)

    def to_pandas(self, name: str, *, units: bool = False) -> Any:
        """A table as a pandas data frame (extra `tables`). The units of its columns are in
        `attrs["units"]`; with `units` they are the second level of its columns."""
        return data_frame(self.table(name), self.units(name), heads=units)


@partial(compile_once, static=())
@jax.vmap
def _all_angles(
    rotation: Float[AnyArray, "4"], reference: Float[AnyArray, "3"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """ω, φ, κ of all images nearest to the given ones, and their Jacobians by δθ."""

    def angles(d_theta: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        angles_after = angles_near(rotation, d_theta, reference)
        return angles_after, angles_after

    return jax.jacfwd(angles, has_aux=True)(jnp.zeros(3))[::-1]
