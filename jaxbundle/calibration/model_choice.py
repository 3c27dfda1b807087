r"""Choice of the camera model: several models calibrated from the same views of a board.

**Cross-validation.** The views fall into folds. For each fold the camera is estimated from the
other folds, and the poses of its own views with that camera; their residuals show the error of the
model in unseen photographs. This is one adjustment per fold, in which the σ of its views are
a thousand times as large, so that they determine only their own poses.

**Information criteria**, for n image coordinates with the weighted sum of squares S, and k
parameters as the trace of n·I minus their redundancy numbers (unknowns with a prior count in part):

    AIC = n·ln(S/n) + 2·k        BIC = n·ln(S/n) + k·ln(n)

**Difference.** The image difference of two calibrations, without the rotation that every pose
absorbs (`cameras.compare`), relative to the σ of the difference of two such calibrations.

**The choice**: the model with fewest parameters whose mean square residual of left-out views
exceeds that of the best model by no more than the standard error of this excess over the views.

Source: Akaike (1974), IEEE Transactions on Automatic Control 19(6); Schwarz (1978), Annals of
Statistics 6(2); Breiman, Friedman, Olshen and Stone (1984), Classification and Regression Trees,
section 3.4.3, the rule of one standard error.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle import plotting
from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.quality.expected_difference import expected_difference
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import integer, show
from jaxbundle.calibration.calibrate import calibrate, check_model, views_of
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.quality import (
    residuals_in_pixels,
    start_at_result,
    take_images,
    used_rays,
)
from jaxbundle.calibration.result import Calibration
from jaxbundle.cameras import CameraModel, Comparison, compare_cameras, get_model
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.measure.boards import Board
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.tables import Camera, Network, are_among
from jaxbundle.results import TableMethods
from jaxbundle.types import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Candidate:
    """A model, calibrated from the common observations.

    **Fields:** `calibration`, the result of `calibrate`; `free` parameters of the camera;
    `unknowns`: k of the criteria, poses included; `sigma0` of the image coordinates; `rms` of their
    residuals, and `left_out` for left-out views, pixels (|v| of a point); `by_view`: mean squares
    of the latter [views]; `aic`, `bic`.
    """

    model: str
    calibration: Calibration
    free: int
    unknowns: float
    sigma0: float
    rms: float
    left_out: float
    by_view: Float[np.ndarray, " views"]
    aic: float
    bic: float

    @property
    def model_and_parameters(self) -> tuple[CameraModel, dict[str, float]]:
        """The model and its parameters."""
        return get_model(self.calibration.camera.model), self.calibration.parameters


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ModelDifference:
    """The image difference of a model from the best: the map, its lengths in pixels, and the RMS of
    the lengths over the σ of the difference."""

    comparison: Comparison
    covariance: Float[np.ndarray, "rows columns 2 2"]
    rms: float
    largest: float
    over_sigma: float


class ModelComparison(TableMethods):
    """Comparison of models. Printing shows the table and the conclusion.

    **Attributes:** `candidates`, in the given order; `failed`: model and reason; `folds`; `views`
    compared; `gross`: (image, point) that no model explains, removed for all; `best`: the candidate
    with the smallest left-out RMS; `suffices`: the recommended one; `differences` from the best by
    model (None: nothing to compare).
    """

    def __init__(
        self,
        candidates: Iterable[Candidate],
        failed: Mapping[str, str],
        folds: int,
        views: Iterable[str],
        gross: Iterable[tuple[str, str]],
    ):
        self.candidates: tuple[Candidate, ...] = tuple(candidates)
        self.failed: dict[str, str] = dict(failed)
        self.folds, self.views, self.gross = folds, tuple(views), tuple(gross)
        self.best = min(self.candidates, key=lambda candidate: candidate.left_out)
        # One standard error (Breiman et al.): between models that the scatter of the photographs
        # cannot separate, the simpler one.
        sufficient = [
            candidate
            for candidate in self.candidates
            if self.excess(candidate)[0] <= self.excess(candidate)[1]
        ]
        self.suffices = min(sufficient, key=lambda candidate: (candidate.free, candidate.left_out))

    def excess(self, candidate: Candidate) -> tuple[float, float]:
        """The excess of the mean square residual of left-out views over that of the best model, and
        its standard error over the views, pixels²."""
        d = candidate.by_view - self.best.by_view
        return float(d.mean()), float(d.std(ddof=1) / np.sqrt(len(d)))

    @cached_property
    def differences(self) -> dict[str, ModelDifference | None]:
        other_candidates = (
            candidate for candidate in self.candidates if candidate is not self.best
        )
        return {
            candidate.model: _difference(self.best, candidate) for candidate in other_candidates
        }

    @property
    def sentence(self) -> str:
        """The sufficient model and the reason."""
        sufficient, best = self.suffices, self.best
        text = (
            f"{sufficient.model} suffices: in photographs left out it leaves an RMS of "
            f"{sufficient.left_out:.4g} px with {sufficient.free} parameters"
        )
        if sufficient is best:
            text += ", the least of all"
        else:
            text += (
                f", no worse than {best.model} ({best.left_out:.4g} px, {best.free} parameters) "
                "within the scatter of the photographs"
            )
        simpler = [candidate for candidate in self.candidates if candidate.free < sufficient.free]
        if simpler:
            worse = ", ".join(
                f"{candidate.model} ({candidate.left_out:.4g} px)" for candidate in simpler
            )
            text += f"; {worse} {'is' if len(simpler) == 1 else 'are'} simpler and worse"
        return text + "."

    def plot_difference(self, model: str, ax: "Axes | None" = None) -> "Axes":
        """The map of a model's difference from the best; matplotlib axes."""
        difference = self.differences[model]
        if difference is None:
            raise ValueError(f"{model} and {self.best.model} have no part of the image in common")
        return plotting.difference_map(difference.comparison, ax, f"{model} − {self.best.model}")

    def report(self) -> str:
        """Table and sentence as text."""
        from jaxbundle.calibration.report import choice_text

        return choice_text(self)

    def to_dict(self) -> dict:
        """The comparison as plain dicts and numbers, as in JSON."""
        from jaxbundle.calibration.report import choice_dict

        return choice_dict(self)

    def table(self) -> dict[str, np.ndarray]:
        """One row a model: columns model, free, sigma0, rms, left_out (pixels), aic, bic."""
        names = ("model", "free", "sigma0", "rms", "left_out", "aic", "bic")
        return {
            name: np.array([getattr(candidate, name) for candidate in self.candidates])
            for name in names
        }

    def __str__(self) -> str:
        return self.report()


def compare_models(
    photographs: Sequence[str | Path] | BoardViews,
    board: Board | None = None,
    *,
    models: Sequence[str | CameraModel],
    folds: int = 4,
    progress: Progress | None = None,
    **options: Any,
) -> ModelComparison:
    """Calibrate one camera with several models and choose the sufficient one.

    **Arguments:** `models`: names or `CameraModel`s, two or more; `folds` of the cross-validation;
    the others and `options` as in `calibrate`. Each model estimates its standard parameters.

    **Returns:** a `ModelComparison`. A model that cannot be calibrated is listed with the reason.

    **Raises:** `InputError` for unknown models, and too few photographs for the folds;
    `NotSolvedError` if no model can be calibrated.
    """
    if isinstance(models, str) or not isinstance(models, Iterable) or len({*models}) < 2:
        raise InputError(
            "models: give at least two different ones, such as ['opencv', 'kannala-brandt'], not "
            f"{show(models)}"
        )
    folds = integer("folds", folds, 2)
    names = [check_model(model).name for model in models]
    views = views_of(photographs, board, progress)
    calibrations, failures = _calibrate_all(views, dict(zip(names, models)), options)
    if not calibrations:
        raise NotSolvedError(
            "not solved: none of the models: "
            + "; ".join(f"{name}: {why}" for name, why in failures.items())
        )
    # Models are compared on the same observations: a photograph, or a point, that one of them could
    # not use would make its residuals smaller. A point is gross if no model explains it.
    names_in_all = set.intersection(
        *({*calibration.views.names} for calibration in calibrations.values())
    )
    common = [name for name in views.names if name in names_in_all]
    needed = folds + 4  # so that about four remain for the camera of a fold
    if len(common) < needed:
        raise InputError(
            f"{len(common)} photographs can be used by all models; {folds} folds need "
            f"{needed} at least: give more, or fewer folds"
        )
    # Of robust calibrations, whose weights would differ between the models, by data snooping.
    significance = options.get("significance", 0.001)
    gross = set.intersection(
        *(_gross_points(calibration, significance) for calibration in calibrations.values())
    )
    candidates = []
    for name, calibration in calibrations.items():
        candidate = _candidate(name, calibration, common, gross, folds)
        if isinstance(candidate, str):
            failures[name] = candidate
        else:
            candidates.append(candidate)
    if not candidates:
        raise NotSolvedError(f"not solved: {'; '.join(failures.values())}")
    return ModelComparison(candidates, failures, folds, common, sorted(gross))


def _calibrate_all(
    views: BoardViews, models: Mapping[str, str | CameraModel], options: Mapping[str, Any]
) -> tuple[dict[str, Calibration], dict[str, str]]:
    """The calibrations by the names of the models, and why others failed."""
    calibrations, failures = {}, {}
    for name, model in models.items():
        try:
            calibration = calibrate(views, model=model, cross_validation=False, **options)
        except (InputError, NotSolvedError) as error:
            failures[name] = str(error)
            continue
        if calibration.converged:
            calibrations[name] = calibration
        else:
            failures[name] = f"not solved: {calibration.adjustment.termination}"
    return calibrations, failures


def _gross_points(calibration: Calibration, significance: float) -> set[tuple[str, str]]:
    """Image and point of gross errors: those that were removed; of a robust calibration those that
    data snooping removes."""
    adjustment = calibration.adjustment
    if adjustment.robust is not None:
        network = adjustment.problem.network
        network = start_at_result(network, adjustment, np.ones(len(network.observations), bool))
        adjustment = adjust(network, snooping="pope", significance=significance)
    ids = _ids(adjustment.problem.network)
    return {ids[i] for i in np.flatnonzero(~used_rays(adjustment.problem))}


def _ids(network: Network) -> list[tuple[str, str]]:
    rays = network.observations
    return [(network.images.id[i], network.points.id[p]) for i, p in zip(rays.image, rays.point)]


def _candidate(
    name: str,
    calibration: Calibration,
    common: Sequence[str],
    gross: set[tuple[str, str]],
    folds: int,
) -> Candidate | str:
    """A model with its statistics, or the reason for a failure."""
    result = calibration.adjustment
    network = result.problem.network
    keep = np.array([pair not in gross for pair in _ids(network)])
    network = start_at_result(network, result, keep)
    network = take_images(network, are_among(network.images.id, common))
    camera = network.cameras[0]
    readjusted = adjust(network)
    if not readjusted.converged:
        return f"{name}: all observations together: {readjusted.termination}"
    squares = np.zeros(len(network.observations))
    # Every fold-th view, not a block: neighbouring photographs are alike, and a block would leave a
    # part of the poses out.
    turns = np.arange(len(network.images)) % folds
    for fold in range(folds):
        is_left_out = turns[network.observations.image] == fold
        without_fold = adjust(_without_weight(network, is_left_out))
        if not without_fold.converged:
            return (
                f"{name}: the photographs without those of fold {fold + 1}: "
                f"{without_fold.termination}"
            )
        squares[is_left_out] = _squares(without_fold, camera)[is_left_out]
    # v is over σ, and the redundancy that of the image coordinates alone: k counts an unknown with
    # a prior by the part that the image determines
    v = readjusted.inspection.image_residuals
    redundancy = float(readjusted.problem.image_points(readjusted.reliability.redundancy).sum())
    n, S = v.size, float(np.square(v).sum())
    k = n - redundancy
    sums, counts = (np.bincount(network.observations.image, w) for w in (squares, None))
    return Candidate(
        name,
        calibration,
        len(camera.free),
        k,
        float(np.sqrt(S / redundancy)),
        float(np.sqrt(_squares(readjusted, camera).mean())),
        float(np.sqrt(squares.mean())),
        sums / counts,
        # σ is estimated, so that −2·ln of the likelihood is n·ln(S/n) and a constant
        n * np.log(S / n) + 2 * k,
        n * np.log(S / n) + k * np.log(n),
    )


def _without_weight(network: Network, is_left_out: Bool[np.ndarray, " rays"]) -> Network:
    """The network with negligible weight for some rays, which then do not affect the camera.

    A millionth of the weight: large enough for the poses, small enough for the camera."""
    rays = network.observations
    sigma = np.where(is_left_out[:, None], 1e3 * rays.sigma, rays.sigma)
    return network.replace(observations=dataclasses.replace(rays, sigma=sigma))


def _squares(adjustment: Adjustment, camera: Camera) -> Float[np.ndarray, " rays"]:
    """|v|² of every point, pixels²."""
    return np.square(residuals_in_pixels(adjustment, camera)[0]).sum(1)


def _difference(best: Candidate, candidate: Candidate) -> ModelDifference | None:
    camera = best.calibration.camera
    sizes = {"image_size": camera.image_size, "pixel_size": camera.pixel_size}
    mappings = best.model_and_parameters, candidate.model_and_parameters
    try:
        comparison = compare_cameras(*mappings, **sizes)
    except ValueError:
        return None
    covariance = lambda c: c.calibration.adjustment.camera_covariance(c.calibration.name)
    covariances = covariance(best), covariance(candidate)
    C = expected_difference(comparison, *mappings, covariances, **sizes)
    size = unit_size(mappings[0][0], camera.pixel_size)[0]
    # Lengths over the σ of a length: √ of the trace.
    sigma = np.sqrt(np.trace(C, axis1=2, axis2=3))
    ratio = comparison.length / sigma
    return ModelDifference(
        comparison,
        C,
        comparison.rms / size,
        comparison.largest / size,
        float(np.sqrt(np.nanmean(ratio**2))),
    )
