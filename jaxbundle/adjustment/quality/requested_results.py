"""Requested results, by name or as a whole: their response, and their σ."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import coordinates
from jaxbundle.adjustment.quality.fixed_quantities import split_name
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.precision import image_variances
from jaxbundle.adjustment.unknowns import angles_near, require_located, value_of
from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.quality.error_components import Errors
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

# All free camera parameters; the root mean square of X0, Y0, Z0, ω, φ, κ of all images, and of X,
# Y, Z of all points, without held ones.
CAMERAS, IMAGES, POINTS = WORDS = ("cameras", "images", "points")


@dataclasses.dataclass(frozen=True)
class RequestedResult:
    """A result: its `name`, in `words`; radians for an `angle`; the numbers of `function` whose
    root mean square it is (for a slice of one: that number)."""

    name: str
    words: str
    angle: bool
    numbers: slice

    def combine(self, effects: Float[np.ndarray, "k numbers"]) -> Float[np.ndarray, " k"]:
        """The effect on the result, from the effects on all numbers."""
        effects_on_numbers = effects[:, self.numbers]
        return (
            effects_on_numbers[:, 0]
            if effects_on_numbers.shape[1] == 1
            else np.sqrt(np.mean(effects_on_numbers**2, 1))
        )


@dataclasses.dataclass(frozen=True)
class RequestedResults:
    """The requested `function(values) -> [numbers]`, and the σ of each result."""

    asked: tuple[RequestedResult, ...]
    function: Callable[[Values], jax.Array]
    sigma: Float[np.ndarray, " results"]


def request_results(inspection: Inspection, errors: Errors, of: Any = WORDS) -> RequestedResults:
    """The named results: words, KIND:ID:NAME (a text or a tuple), or a function of `Values`; their
    σ by the errors of the observations.

    **Raises:** `InputError` for an unknown name, or if nothing is left."""
    if callable(of):
        return _of_function(errors, of)
    single = isinstance(of, tuple) and len(of) == 3 and of[0] in ("camera", "image", "point")
    requests = (of,) if isinstance(of, str) or single else of
    if not isinstance(requests, Sequence):
        raise InputError(f"of: expected names of results, got {show(of)}")
    # All results are one function of the values, so that one solution per held quantity (or one per
    # result, in the other direction) gives the effects on all of them.
    parts, results, sigmas, first_number = [], [], [], 0
    words = requests == WORDS
    for request in requests:
        results_of_request = _part(inspection, errors, request)
        if results_of_request is None:
            if words:
                continue
            raise InputError(f"of: {request} are all held")
        for k, (name, text, angle) in enumerate(results_of_request.names):
            numbers = slice(
                first_number + k,
                first_number + results_of_request.size,
                len(results_of_request.names),
            )
            results.append(RequestedResult(name, text, angle, numbers))
        parts.append(results_of_request.function)
        sigmas.append(results_of_request.sigma)
        first_number += results_of_request.size
    if not parts:
        raise InputError("of: no result is requested, or the network has no unknowns")
    function = lambda values: jnp.concatenate([part(values) for part in parts])
    return RequestedResults(tuple(results), function, np.concatenate(sigmas))


class _Part(NamedTuple):
    """A `function` of the values that gives `size` numbers; name, words and whether it is an angle
    of each result that is made of them; the σ of these results. With fewer results than
    numbers, the numbers are rows of an image or point: every result takes one column of them."""

    function: Callable[[Values], Float[AnyArray, " size"]]
    names: list[tuple[str, str, bool]]
    size: int
    sigma: Float[np.ndarray, " results"]


def _part(inspection: Inspection, errors: Errors, request: Any) -> _Part | None:
    """The results of a word or a name; None if all of them are held."""
    problem = inspection.problem
    if request == CAMERAS:
        return _of_cameras(inspection, errors)
    if request == IMAGES:
        return _of_images(inspection, errors)
    if request == POINTS:
        return _of_points(inspection, errors)
    name = Name(*split_name(request))
    try:
        value_of(problem, name, inspection.adjusted)
    except KeyError as error:
        raise InputError(f"of: {error.args[0]}") from None
    require_located(problem, name)
    function = lambda values: jnp.atleast_1d(value_of(problem, name, values))
    sigma = np.sqrt(np.clip(np.diagonal(errors.propagate(function)), 0, None))
    angle = name.kind == "image" and name.parameter in EXTERIOR[3:]
    return _Part(function, [(":".join(split_name(request)), str(name), angle)], 1, sigma)


def _of_cameras(inspection: Inspection, errors: Errors) -> _Part | None:
    problem, places, names, sigmas = inspection.problem, [], [], []
    for c, camera in enumerate(problem.network.cameras):
        parameters, free = problem.free_parameters(c)
        all_parameters = get_model(camera.model).parameters
        table, row = problem.table_of_camera(c)
        C = errors.covariance(table.name)[row]
        for k in free:
            places.append((c, all_parameters.index(parameters[k])))
            name = Name("camera", camera.id, parameters[k])
            names.append((f"camera:{camera.id}:{parameters[k]}", str(name), False))
            sigmas.append(np.sqrt(max(C[k, k], 0.0)))
    if not places:
        return None
    rows, columns = np.array(places).T
    interior = problem.interior_orientation
    return _Part(
        lambda values: interior(values)[rows, columns], names, len(names), np.array(sigmas)
    )


def _of_images(inspection: Inspection, errors: Errors) -> _Part | None:
    problem = inspection.problem
    rows = np.flatnonzero((problem.table("image").free > 0).any(1))
    if not len(rows):
        return None
    reference = jnp.asarray(problem.network.images.angles[rows])

    def poses(values: Values) -> Float[Array, " 6*images"]:
        position, rotation = values["image"]
        angles = jax.vmap(angles_near, (0, None, 0))(rotation[rows], jnp.zeros(3), reference)
        return jnp.concatenate([position[rows], angles], 1).ravel()

    angles, rotation = problem.network.images.angles, inspection.adjusted["image"].rotation
    # The mean variance over all images, not the variance of a mean: the RMS σ of an image.
    variance = _variances(angles, rotation, errors.covariance("image"))
    variance = np.asarray(variance)[rows]
    names = [(f"images:{p}", f"{p} of images, RMS", p in EXTERIOR[3:]) for p in EXTERIOR]
    return _Part(poses, names, 6 * len(rows), np.sqrt(np.clip(variance.mean(0), 0, None)))


_variances = compile_once(image_variances, ())


def _of_points(inspection: Inspection, errors: Errors) -> _Part | None:
    problem = inspection.problem
    rows = np.flatnonzero((problem.table("point").free > 0).any(1))
    if not len(rows):
        return None
    # Of far points those of the engine are of direction and inverse distance.
    C = problem.cofactors_of_coordinates(inspection.adjusted["point"], errors.covariance("point"))
    variance = np.diagonal(np.asarray(C)[rows], axis1=1, axis2=2)
    names = [(f"points:{axis}", f"{axis} of points, RMS", False) for axis in "XYZ"]
    sigma = np.sqrt(np.clip(variance.mean(0), 0, None))
    return _Part(lambda values: coordinates(values)[rows].ravel(), names, 3 * len(rows), sigma)


def _of_function(errors: Errors, user_function: Callable[..., Any]) -> RequestedResults:
    function = lambda values: jnp.ravel(user_function(values))
    sigma = np.sqrt(np.clip(np.diagonal(errors.propagate(function)), 0, None))
    number = range(len(sigma))
    results = tuple(
        RequestedResult(str(k + 1), f"result {k + 1}", False, slice(k, k + 1)) for k in number
    )
    return RequestedResults(results, function, sigma)


def effects_on(
    results: RequestedResults, values: Values, tangents: Values
) -> Float[np.ndarray, "k numbers"]:
    """The change of every requested number along tangents of the tables [k, rows, …]."""
    return np.asarray(_changes_along(results.function, values, tangents))


@compile_once
def _changes_along(
    function: Callable[[Values], Float[Array, " n"]], values: Values, tangents: Values
) -> Float[Array, "errors n"]:
    return jax.vmap(lambda d: jax.jvp(function, (values,), (d,))[1])(tangents)
