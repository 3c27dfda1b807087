"""`load_adjustment`: a saved adjustment as the `Adjustment` it was."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbundle.adjustment.problem import NetworkProblem, make_problem
from jaxbundle.adjustment.quality.correlated_errors import error_components
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.adjustment.saved_state import CLASSES, FORMAT, State, Stored, with_own_models
from jaxbundle.arguments import path as given_path
from jaxbundle.cameras import CameraModel
from jaxbundle.errors import InputError
from jaxbundle.io.results.stored_tree import read_tree
from jaxbundle.leastsquares import problem as engine
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.iterations.solver import History, Minimum
from jaxbundle.leastsquares.quality.error_components import ErrorModel
from jaxbundle.network.columns import list_some
from jaxbundle.system.file_content import naming_file

WHAT = "a saved adjustment (Adjustment.save, jaxbundle adjust --save)"


def load_adjustment(
    path: str | Path,
    *,
    models: Sequence[CameraModel] = (),
    also: Sequence[Table | ObservationSet] = (),
) -> Adjustment:
    """Load what `Adjustment.save` has written: the whole result, without iterating again.

    **Arguments:** `models`: user-defined models of its cameras; `also`: what `adjust`
    was given under this name. Both are functions, which a file cannot hold.

    **Returns:** an `Adjustment` with everything that the saved one has, every covariance included.

    **Raises:** `InputError` for another kind of file, and if `models` or `also` are missing;
    `RuntimeError` without 64-bit floats.
    """
    given_path("path", path)
    stored = read_tree(path, CLASSES, WHAT)
    if not isinstance(stored, Stored) or stored.format != FORMAT:
        raise InputError(f"{path}: is not {WHAT} of this version of jaxbundle")
    try:
        with naming_file(path):
            result = _restored(stored, models, also, path)
            sigma0 = result.sigma0
    except (ValueError, TypeError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is damaged, or of another version of jaxbundle") from None
    # Everything is computed again from measurements and values: σ0 shows whether both are whole. It
    # agrees to rounding, 1e-12; another version may sum or stop differently, to less than 1e-6. The
    # σ0 of exact data is rounding itself.
    agrees = math.isclose(sigma0, stored.sigma0, rel_tol=1e-6, abs_tol=1e-9)
    if not agrees and not math.isnan(stored.sigma0):
        raise InputError(
            f"{path}: its σ0 is {stored.sigma0:.6g}, but its measurements and values give "
            f"{sigma0:.6g}: it is damaged, was saved by another version ({stored.version}), or a "
            "model or kind of your own is not the one that it was saved with"
        )
    return result


def _restored(
    stored: Stored,
    models: Sequence[CameraModel],
    also: Sequence[Table | ObservationSet],
    path: str | Path,
) -> Adjustment:
    missing_models = sorted(set(stored.own_models) - {model.name for model in models})
    if missing_models:
        raise InputError(
            f"{path}: the camera models {list_some(missing_models)} are not built in; give "
            "them as models=[…]"
        )
    stored = dataclasses.replace(stored, network=with_own_models(stored.network, models))
    return _restore(stored, _problem(stored, also, path))


def _problem(
    stored: Stored, also: Sequence[Table | ObservationSet], path: str | Path
) -> NetworkProblem:
    """The problem as the adjustment left it: planned anew from the network, with the weights that
    snooping or robust estimation changed, and the columns that elimination held."""
    state = stored.state
    problem = make_problem(
        stored.network, reduction=state.reduction, also=also, lengths=state.lengths
    )
    tables = tuple(t.name for t in problem.tables)
    kinds = tuple(o.kind.name for o in problem.observations)
    if (tables, kinds) != (state.tables, state.kinds):
        differing_names = set(state.tables + state.kinds) ^ set(tables + kinds)
        raise InputError(
            f"{path}: was adjusted with other user-defined tables and observations "
            f"({list_some(sorted(differing_names))}); give the same as also=[…]"
        )
    start = _tree(problem.data.start, state.start)
    problem = engine.with_data(problem, dataclasses.replace(problem.data, start=start))
    for table, free in zip(problem.tables, state.free):
        if not np.array_equal(np.asarray(table.free), free):
            problem = engine.with_free(problem, table.name, free)
    names = [o.name for o in problem.observations]
    weight = _tree([problem.data.weight[o] for o in names], state.weights)
    data = dataclasses.replace(problem.data, weight=dict(zip(names, weight, strict=True)))
    return engine.with_data(problem, data)


def _restore(stored: Stored, problem: NetworkProblem) -> Adjustment:
    state: State = stored.state
    history = History(*(jax.device_put(column) for column in state.history))
    values = _tree(problem.data.start, state.values)
    termination, iterations = map(np.int64, (state.termination, state.iterations))
    minimum = Minimum(values, jax.device_put(termination), jax.device_put(iterations), history)
    result = Adjustment(problem.network, problem, minimum, check=stored.check, **stored.notes)
    result.weights, result.robust_scale = stored.image_weights, stored.robust_scale
    model = _restore_error_model(stored, result)
    halves = stored.replication and dataclasses.replace(stored.replication, model=model)
    result.keep(model, halves)
    return result


def _restore_error_model(stored_adjustment: Stored, result: Adjustment) -> ErrorModel | None:
    stored = stored_adjustment.error_model
    if stored is None or result.correlations is None:
        return None
    solution = result.cofactors.solution
    components = tuple(error_components(solution, result.problem, result.correlations))
    if tuple(component.name for component in components) != stored.names:
        raise ValueError
    sizes = stored.theta, stored.theta_covariance, stored.score
    return ErrorModel(solution, components, *sizes, stored.own, stored.equations)


def _tree(like: Any, leaves: Sequence[np.ndarray]) -> Any:
    """Arrays in the structure of others of the same shapes."""
    known_leaves, structure = jax.tree.flatten(like)
    if [np.shape(x) for x in known_leaves] != [np.shape(x) for x in leaves]:
        raise ValueError
    return jax.device_put(jax.tree.unflatten(structure, leaves))
