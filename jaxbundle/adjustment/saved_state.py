"""The part of an adjustment that is saved: all that its result follows from without iterating.

The network, the start values, weights and free unknowns that the adjustment ended with, and the
adjusted values. Everything else (covariances, redundancy numbers, tests, tables) is computed from
these on demand, as in the process that adjusted.
"""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.adjustment.quality.replication import HalvesDifference, Replication
from jaxbundle.adjustment.second_minima.evidence import SecondMinimum
from jaxbundle.cameras import CameraModel, get_model, is_own
from jaxbundle.io.results.stored_tree import fingerprint, write_tree
from jaxbundle.leastsquares.quality.error_components import ErrorSettings, SizeEquations
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.network.blunders import Removed, Suspect
from jaxbundle.network.columns import list_some
from jaxbundle.network.declare import declare
from jaxbundle.network.kinds import KINDS
from jaxbundle.network.tables import (
    Camera,
    Distances,
    Images,
    LeftOut,
    Network,
    Observations,
    Points,
    Source,
)

NETWORK = (
    Network,
    LeftOut,
    Camera,
    Images,
    Points,
    Observations,
    Distances,
    Source,
    *KINDS.values(),
)
# Its number changes when older files cannot be read any more.
FORMAT = "jaxbundle adjustment 1"


@dataclasses.dataclass(frozen=True)
class State:
    """Where the engine ended: `free` by table; `weights` by set of observations; `start` and
    `values`, the leaves of `Values`; `history` of the iterations."""

    tables: tuple[str, ...]
    kinds: tuple[str, ...]
    reduction: str
    lengths: np.ndarray | None
    free: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    start: tuple[np.ndarray, ...]
    values: tuple[np.ndarray, ...]
    termination: int
    iterations: int
    history: tuple[np.ndarray, ...]


@dataclasses.dataclass(frozen=True)
class StoredErrorModel:
    """The estimated sizes of an `ErrorModel`, and the covariance blocks that its components give;
    the components themselves follow from the network, by their `names`."""

    names: tuple[str, ...]
    theta: np.ndarray
    theta_covariance: np.ndarray
    score: np.ndarray
    own: tuple[dict[str, np.ndarray], ...]
    equations: SizeEquations | None = None


@dataclasses.dataclass(frozen=True)
class Stored:
    """A saved adjustment; `check`: check points and their image points; `own_models`: names of
    camera models that only an object describes; `notes`: arguments of the `Adjustment`;
    `image_weights`, `robust_scale`: of robust estimation; `error_model` of correlated errors and
    `replication` (without its model), if they were requested."""

    format: str
    version: str
    fingerprint: str
    sigma0: float
    network: Network
    check: tuple[Points, Observations] | None
    own_models: tuple[str, ...]
    state: State
    notes: dict[str, Any]
    image_weights: np.ndarray | None
    robust_scale: float | None
    error_model: StoredErrorModel | None = None
    replication: Replication | None = None


CLASSES = (
    *NETWORK,
    Stored,
    State,
    Removed,
    Suspect,
    Name,
    CorrelationSettings,
    ErrorSettings,
    StoredErrorModel,
    SizeEquations,
    Replication,
    HalvesDifference,
    SecondMinimum,
)


def network_fingerprint(network: Network) -> str:
    """16 hex digits of a network's content: cameras, start values, measurements, settings; not of
    where it was read."""
    # Messages and names do not change a result: the same measurements have the same fingerprint.
    network = with_named_models(network).replace(warnings=(), notes=(), left_out=(), name="")
    return fingerprint(network, NETWORK, without=(Source,))


def with_named_models(network: Network) -> Network:
    """The network with the names of own camera models for the models."""
    name_of_model = lambda model: model.name if isinstance(model, CameraModel) else model
    cameras = (dataclasses.replace(c, model=name_of_model(c.model)) for c in network.cameras)
    return network.replace(cameras=tuple(cameras))


def own_models(network: Network) -> dict[str, CameraModel]:
    """The camera models of a network that are not built in, by name."""
    models = (get_model(camera.model) for camera in network.cameras)
    return {model.name: model for model in models if is_own(model)}


def with_own_models(network: Network, models: Sequence[CameraModel]) -> Network:
    """The network with these camera models for their names."""
    of_name = {model.name: model for model in models}
    model = lambda camera: of_name.get(str(camera.model), camera.model)
    cameras = (dataclasses.replace(c, model=model(c)) for c in network.cameras)
    return network.replace(cameras=tuple(cameras))


def store(adjustment: Any, path: str | Path) -> None:
    """Write an `Adjustment` that was solved into a file.

    **Raises:** `InputError` where the file cannot be written."""
    from jaxbundle import __version__

    problem, minimum = adjustment.problem, adjustment.minimum
    network = problem.network
    names_of_notes = (
        "removed",
        "eliminated",
        "method",
        "reduction",
        "sigma_factors",
        "robust",
        "suspects",
        "findings",
        "correlations",
        "halves_by",
        "second_minima",
    )
    notes = {name: getattr(adjustment, name) for name in names_of_notes}
    stored = Stored(
        FORMAT,
        __version__,
        adjustment.fingerprint,
        adjustment.sigma0,
        with_named_models(network),
        adjustment.check,
        # Models of one's own are functions, which a file cannot hold without executing it when
        # read: only their names are saved.
        tuple(sorted(own_models(network))),
        _state(problem, minimum),
        notes | {"doubts": adjustment.given_doubts},
        adjustment.weights,
        adjustment.robust_scale,
        _error_model(adjustment),
        adjustment.replication and dataclasses.replace(adjustment.replication, model=None),
    )
    write_tree(path, stored, CLASSES)


def saved_bytes(adjustment: Any) -> bytes:
    """The content of the file that `store` writes.

    **Raises:** `TypeError` with tables or observations of one's own, which the file only names."""
    problem = adjustment.problem
    declared = declare(problem.network, problem.origin, lengths=problem.lengths)
    if own := {o.name for o in problem.observations} - {o.name for o in declared.observations}:
        raise TypeError(
            f"an adjustment with observations of one's own ({list_some(sorted(own))}) is not "
            "pickled, since they are functions: use save, and load_adjustment with also=[…]"
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "adjustment"
        adjustment.save(file)
        return file.read_bytes()


def load_bytes(content: bytes, models: Sequence[CameraModel]) -> Any:
    """The `Adjustment` of the content of a saved file."""
    from jaxbundle import load_adjustment

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "adjustment"
        file.write_bytes(content)
        return load_adjustment(file, models=models)


def _error_model(adjustment: Any) -> StoredErrorModel | None:
    model = adjustment.error_model
    if model is None:
        return None
    names = tuple(component.name for component in model.components)
    sizes = model.theta, model.theta_covariance, model.score
    return StoredErrorModel(names, *sizes, model.own, model.equations)


def _state(problem: NetworkProblem, minimum: Any) -> State:
    steps = int(minimum.iterations)
    leaves = lambda tree: tuple(np.asarray(x) for x in jax.tree.leaves(tree))
    history = minimum.history
    return State(
        tables=tuple(t.name for t in problem.tables),
        kinds=tuple(o.kind.name for o in problem.observations),
        reduction=problem.reduction,
        lengths=problem.lengths,
        free=tuple(np.asarray(t.free) for t in problem.tables),
        weights=leaves([problem.data.weight[o.name] for o in problem.observations]),
        start=leaves(problem.data.start),
        values=leaves(minimum.values),
        termination=int(minimum.termination),
        iterations=steps,
        history=tuple(
            np.asarray(x)[:steps] for x in (history.cost, history.damping, history.accepted)
        ),
    )
