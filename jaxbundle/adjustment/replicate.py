"""`replicate`: a network in two halves that share no image point, each adjusted alone
(`adjustment.quality.replication`)."""

from collections.abc import Sequence
from pathlib import Path

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS as CORRELATIONS
from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.adjustment.quality.replication import (
    MIN_IMAGES,
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
from jaxbundle.network.tables import Network
from jaxbundle.types import Progress


def replicate(
    given: Adjustment | Network | str | Path,
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
    """Adjust disjoint halves of a network and compare the interior orientations they give.

    **Arguments:**

    - `given`: a result; or a network, or the path of one (`format`, `overrides` and `control` as of
      `jaxbundle.read_network`), which is adjusted first, with `snooping` as of `jaxbundle.adjust`.
    - `by`: `"points"`, `"photographs"` (of calibrations also called `"views"`): random halves;
      `"runs"`: the first half of the photographs, in their order, against the second.
    - `repeat`: number of random splits; runs have one. `seed`: of them.
    - `settings`: of the error components.
    - `progress(stage, done, total)`: called before every split.

    **Raises:** `InputError` for too few photographs; `NotSolvedError` if the network or no pair of
    halves can be adjusted.
    """
    one_of("by", by, REPLICATION)
    repeat = 1 if by == "runs" else integer("repeat", repeat, least=1)
    seed = integer("seed", seed, least=0)
    if not isinstance(given, Adjustment):
        known = as_network(given, format=format, overrides=overrides, control=control)
        given = adjust(known, snooping=snooping)
    if given.correlations != settings:
        given = given.with_changes(correlations=settings)
    network = given.problem.network
    if len(network.images) < 2 * MIN_IMAGES and by != "points":
        raise InputError(
            f"{len(network.images)} photographs: halves of them need {2 * MIN_IMAGES} or more; "
            'halves by "points" can be made'
        )
    if not any(given.camera_covariance(camera.id)[0] for camera in network.cameras):
        raise InputError("no camera has a free parameter: there is nothing to compare")
    whole = given.cofactors.solution
    splits, failed, of_splits = [], [], []
    for number, second in enumerate(random_halves(network, by, repeat, seed)):
        if progress is not None:
            progress("adjusting halves", number, repeat)
        try:
            names, D = effects_of_halves(whole, given.problem, second)
        except NotSolvedError as error:
            failed.append(f"split {number + 1}: {error}")
        else:
            splits.append(difference_of(whole, names, D, given.error_model))
            of_splits.append(D)
    if not splits:
        raise NotSolvedError(f"no halves of the network can be adjusted alone: {failed[0]}")
    band = None if given.error_model is None else expected_band(given.error_model, of_splits)
    unit = given.image_unit
    return Replication(by, tuple(splits), tuple(failed), given.error_model, band, unit)
