"""`replicate`: a network in two halves that share no image point, each adjusted alone
(`adjustment.quality.replication`)."""

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.load_saved import load_adjustment
from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS as CORRELATIONS
from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.adjustment.quality.replication import (
    MIN_IMAGES,
    HalvesDifference,
    Replication,
    difference_of,
    effects_of_halves,
    expected_band,
    random_halves,
)
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import integer, one_of
from jaxbundle.choices import REPLICATION
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.formats import as_network
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Network
from jaxbundle.types import Progress

Given = Adjustment | Network | str | Path


def replicate(
    given: Given | Sequence[Given],
    *,
    by: str = "photographs",
    repeat: int = 1,
    seed: int = 0,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    snooping: str | None = None,
    settings: CorrelationSettings = CORRELATIONS,
    progress: Progress | None = None,
) -> Replication:
    """Adjust disjoint halves of a network and compare the interior orientations they give; or those
    of two or more finished jobs of one camera, each with each.

    **Arguments:**

    - `given`: a result; or a network, or the path of one (`format`, `overrides` and `control` as of
      `jaxbundle.read_network`), which is adjusted first, with `snooping` as of `jaxbundle.adjust`;
      or the path of a saved adjustment (`Adjustment.save`). Several of them are jobs, for which
      `by`, `repeat` and `seed` mean nothing.
    - `by`: `"points"`, `"photographs"` (of calibrations also called `"views"`): random halves;
      `"runs"`: the first half of the photographs of each camera, in their order, against the
      second.
    - `repeat`: number of random splits; runs have one. `seed`: of them.
    - `settings`: of the error components.
    - `progress(stage, done, total)`: called before every split.

    **Raises:** `InputError` for too few photographs; `NotSolvedError` if the network or no pair of
    halves can be adjusted.
    """
    one_of("by", by, REPLICATION)
    repeat = 1 if by == "runs" else integer("repeat", repeat, least=1)
    seed = integer("seed", seed, least=0)
    open_one = partial(
        _adjusted, settings, format=format, overrides=overrides, control=control, snooping=snooping
    )
    sources = [*given] if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    if len(sources) != 1:
        return _compare_jobs([open_one(source) for source in sources])
    return _compare_halves(open_one(sources[0]), by, repeat, seed, progress)


def _compare_halves(
    adjustment: Adjustment, by: str, repeat: int, seed: int, progress: Progress | None
) -> Replication:
    """`repeat` splits of one network."""
    network = adjustment.problem.network
    photographs = len(network.images)
    needed = MIN_IMAGES if by == "points" else 2 * MIN_IMAGES
    if photographs < needed:
        alternative = f"; halves by points need {MIN_IMAGES}" if photographs >= MIN_IMAGES else ""
        raise InputError(
            f"{count(photographs, 'photograph')}: halves by {by} need {needed} or more{alternative}"
        )
    if not any(adjustment.camera_covariance(camera.id)[0] for camera in network.cameras):
        raise InputError("no camera has a free parameter: there is nothing to compare")
    solution = adjustment.cofactors.solution
    splits, failed, of_splits = [], [], []
    for number, in_second in enumerate(random_halves(network, by, repeat, seed)):
        if progress is not None:
            progress("adjusting halves", number, repeat)
        try:
            names, D = effects_of_halves(solution, adjustment.problem, in_second)
        except NotSolvedError as error:
            failed.append(f"split {number + 1}: {error}")
        else:
            splits.append(difference_of(solution, names, D, adjustment.error_model))
            of_splits.append(D)
    if not splits:
        raise NotSolvedError(f"no halves of the network can be adjusted alone: {failed[0]}")
    band = (
        None if adjustment.error_model is None else expected_band(adjustment.error_model, of_splits)
    )
    unit = adjustment.image_unit
    return Replication(by, tuple(splits), tuple(failed), adjustment.error_model, band, unit)


def _adjusted(
    settings: CorrelationSettings,
    source: Given,
    *,
    format: str | None,
    overrides: Sequence[str],
    control: str | Path | None,
    snooping: str | None,
) -> Adjustment:
    """A result with an error model."""
    if isinstance(source, str | Path) and Path(source).suffix == ".npz":
        source = load_adjustment(source)
    if not isinstance(source, Adjustment):
        network = as_network(source, format=format, overrides=overrides, control=control)
        source = adjust(network, snooping=snooping)
    return source if source.correlations == settings else source.with_changes(correlations=settings)


def _compare_jobs(results: Sequence[Adjustment]) -> Replication:
    """The differences of the interior orientations of finished jobs, each with each."""
    if not results:
        raise InputError("no network is given")
    splits, failed = [], []
    for (i, job_a), (j, job_b) in combinations(enumerate(results, 1), 2):
        try:
            splits.append(_difference_of_jobs(job_a, job_b))
        except NotSolvedError as error:
            failed.append(f"jobs {i} and {j}: {error}")
    if not splits:
        raise NotSolvedError(f"nothing can be compared: {failed[0]}")
    model = next((job_a.error_model for job_a in results if job_a.error_model is not None), None)
    return Replication("jobs", tuple(splits), tuple(failed), model, None, results[0].image_unit)


def _difference_of_jobs(job_a: Adjustment, job_b: Adjustment) -> HalvesDifference:
    """Second − first of the free parameters of the cameras of both; two jobs of one camera each are
    of the same one, whatever its name."""
    ids = [[camera.id for camera in r.problem.network.cameras] for r in (job_a, job_b)]
    pairs = [(id, id) for id in ids[0] if id in ids[1]]
    if len(ids[0]) == len(ids[1]) == 1:
        pairs = [(ids[0][0], ids[1][0])]
    names, difference, classical, correlated = [], [], [], []
    for a, b in pairs:
        models = [
            next(c.model for c in r.problem.network.cameras if c.id == id)
            for r, id in ((job_a, a), (job_b, b))
        ]
        if models[0] != models[1]:
            raise NotSolvedError(
                f"camera {a!r} is of model {models[0]}, camera {b!r} of {models[1]}: parameters of "
                "the same name mean other things there"
            )
        free = [r.camera_covariance(id)[0] for r, id in ((job_a, a), (job_b, b))]
        common = [name for name in free[0] if name in free[1]]
        p, q = job_a.camera_parameters(a), job_b.camera_parameters(b)
        names += [(a, name) for name in common]
        difference += [q[name] - p[name] for name in common]
        for blocks, is_classical in ((classical, True), (correlated, False)):
            C = np.zeros((len(common), len(common)))
            for result, id in ((job_a, a), (job_b, b)):
                free_names, covariance = result.camera_covariance(id, classical=is_classical)
                positions = [list(free_names).index(name) for name in common]
                C += covariance[np.ix_(positions, positions)]
            blocks.append(C)
    if not names:
        raise NotSolvedError("they have no camera of the same name with a free parameter")
    from scipy.linalg import block_diag  # imported here: slow, and rarely needed

    modelled = job_a.error_model is not None or job_b.error_model is not None
    return HalvesDifference(
        tuple(names),
        np.array(difference),
        block_diag(*classical),
        block_diag(*correlated) if modelled else None,
    )
