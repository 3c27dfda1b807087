"""Simulated further observations of a simulated network."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PyTree

from jaxbundle.arguments import integer
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares.declarations import Kind, ObservationSet, Table
from jaxbundle.leastsquares.indexing.rows import evaluate, scalars
from jaxbundle.leastsquares.spaces import Space
from jaxbundle.network.declare import declare
from jaxbundle.network.kinds import ObservationTable
from jaxbundle.network.tables import Network, require_network
from jaxbundle.planning.stations import LARGEST_SEED
from jaxbundle.system.programs import compile_once


def simulate_further(
    network: Network, truth: Network, *, unknowns: Mapping[str, PyTree] | None = None, seed: int = 0
) -> Network:
    """The network with its further observations simulated from a truth, with noise of their σ.

    With a rolling shutter or refracting interfaces image points are shifted: those of the truth are
    moved to the image of the moving camera, or of the refracted ray, and keep their noise of the
    network.

    **Arguments:** `network`: its rows define the measurements and their σ (antennas, attitudes,
    tilts, differences, angles: measured values are ignored); `truth`: from
    `simulate_with_truth`; `unknowns`: true values of the tables of further observations,
    by name, such as `{"GNSS strip": shifts}` [strips, 6] (sorted by name); those of the
    settings, lever arms, boresights, interfaces, are true by default, and so are the `"velocity"`
    [images, 6] (object unit and radians per second) and the line times of a rolling shutter.

    **Raises:** `InputError` for a missing table; for a rolling shutter and interfaces also if
    network and truth have different image points.
    """
    require_x64()
    random = np.random.default_rng(integer("seed", seed, least=0, most=LARGEST_SEED))
    table_names: set[str] = set()
    simulated = []
    for rows in require_network(network).further:
        field = rows.MEASURED
        declared = declare(truth.replace(further=(rows,)), np.zeros(3))
        # The network declares its tables for these rows alone: theirs are what `unknowns` may name.
        values = {t.name: t.value for t in declared.tables}
        table_names |= set(values)
        values |= {name: v for name, v in (unknowns or {}).items() if name in values}
        if rows.CHANGES_IMAGE_POINTS:
            shift = _image_points(truth, rows, values) - truth.observations.xy
            network = _shift(network, truth, shift)
        if field:
            rows = rows.restrict_to(truth)
            observation_set = next(
                o for o in declared.observations if o.name in declared.further_sets
            )
            measured = jax.tree.leaves(observation_set.measured)[0] + _residuals(
                declared.tables, observation_set, values
            )
            whitening = observation_set.weight(
                np.shape(measured)[-1] if np.ndim(measured) > 1 else 1
            )
            noise = _noise(random, whitening).reshape(np.shape(measured))
            rows = dataclasses.replace(rows, **{field: measured + noise})
        simulated.append(rows)
    for name in unknowns or {}:
        if name not in table_names:
            raise InputError(
                f"unknowns: there is no table {name!r}; known: {', '.join(table_names)}"
            )
    return network.replace(further=tuple(simulated))


def _image_points(
    truth: Network, rows: ObservationTable, values: dict[str, PyTree]
) -> Float[np.ndarray, "rays 2"]:
    """The image points of the truth in the moving camera, where an image point is exposed with
    its line, which depends on the image point; or through its interfaces."""
    truth = truth.replace(further=(rows,), residuals="measured")
    # A fixed point: each round divides the error by the ratio of the readout to the motion of the
    # image. 1e-13 of the coordinates is rounding; where fifty rounds do not reach it, the ratio is
    # 0.55 or more, and the motion distorts the image beyond use.
    for _ in range(50):
        declared, rays = declare(truth, np.zeros(3)), truth.observations
        values = {t.name: t.value for t in declared.tables} | values
        xy = rays.xy.copy()
        for observation_set in declared.observations:
            if observation_set.name in declared.image_rows:
                xy[declared.image_rows[observation_set.name]] += _residuals(
                    declared.tables, observation_set, values
                )
        change = np.abs(xy - rays.xy).max(initial=0.0)
        truth = truth.replace(observations=dataclasses.replace(rays, xy=xy))
        if change <= 1e-13 * np.abs(xy).max(initial=0.0):
            return xy
    raise InputError(
        "simulate_further: the camera moves so fast that an image point has no line of its own"
    )


def _shift(network: Network, truth: Network, shift: Float[np.ndarray, "rays 2"]) -> Network:
    rays, true_rays = network.observations, truth.observations
    has_same_images = len(rays) == len(true_rays) and (rays.image == true_rays.image).all()
    if not (has_same_images and (rays.point == true_rays.point).all()):
        raise InputError("simulate_further: network and truth have other image points")
    return network.replace(observations=dataclasses.replace(rays, xy=rays.xy + shift))


def _residuals(
    tables: Sequence[Table], observation_set: ObservationSet, values: Mapping[str, PyTree]
) -> Float[np.ndarray, "n *residuals"]:
    """Computed minus measured of all observations of a set."""
    spaces = [next(t.space for t in tables if t.name == name) for name in observation_set.kind.of]
    block_values = [
        jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], values[name])
        for name, rows in zip(observation_set.kind.of, observation_set.rows)
    ]
    residuals = np.asarray(
        _evaluate(observation_set.kind, tuple(spaces), block_values, observation_set.measured)
    )
    return residuals.reshape(np.shape(jax.tree.leaves(observation_set.measured)[0]))


@partial(compile_once, static=(0, 1))
def _evaluate(
    kind: Kind, spaces: tuple[Space, ...], block_values: Sequence[PyTree], measured: PyTree
) -> Float[Array, "n residuals"]:
    def residuals_of(
        block_values: Sequence[PyTree], measured: PyTree
    ) -> Float[Array, " residuals"]:
        blocks = [space.prepare(value) for space, value in zip(spaces, block_values)]
        return jnp.stack(evaluate(kind, blocks, measured))

    return jax.vmap(residuals_of)(block_values, scalars(measured))


def _noise(
    random: np.random.Generator,
    whitening: Float[np.ndarray, "n k"] | Float[np.ndarray, "n k k"],
) -> Float[np.ndarray, "n k"]:
    """Errors of observations whose residuals are whitened by 1/σ, or by L⁻¹ of the covariance L·Lᵀ;
    zero without measurement."""
    errors = random.normal(size=whitening.shape[:2])
    if whitening.ndim == 3:
        return np.linalg.solve(whitening, errors[..., None])[..., 0]
    return np.where(whitening > 0, errors / np.where(whitening > 0, whitening, 1.0), 0.0)
