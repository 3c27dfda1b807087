"""A design as a network for adjustment: visible targets, measured with noise."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.adjustment.problem import NetworkProblem, coordinates, make_problem
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry import matrix_from_quaternion, omega_phi_kappa_from_matrix
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.network.check import check_network
from jaxbundle.network.subsets import keep_images
from jaxbundle.network.tables import Distances, Network, Source
from jaxbundle.network_design.pairs import MIN_TARGETS, StationTargetPairs

_angles = jax.jit(jax.vmap(lambda q: omega_phi_kappa_from_matrix(matrix_from_quaternion(q))))


def realise(
    pairs: StationTargetPairs,
    values: Values,
    measured: Bool[np.ndarray, " rays"],
    seed: int | None = 0,
    residuals: str = "corrected",
) -> Network:
    """The network of a design with simulated measurements; stations with fewer than three
    visible targets are left out.

    **Arguments:** `measured`: which rays; `seed`: of the noise of simulated rays, while
    already measured ones are unchanged; None: all rays without noise."""
    network, origin = pairs.problem.network, pairs.problem.origin
    images = dataclasses.replace(
        network.images,
        position=np.asarray(values["image"].position) + origin,
        angles=np.asarray(_angles(np.asarray(values["image"].rotation))),
    )
    points = dataclasses.replace(network.points, position=np.asarray(coordinates(values)) + origin)
    rays = network.observations
    xy = np.asarray(pairs.predict(values))
    if seed is not None:
        noise = np.random.default_rng(seed).standard_normal(xy.shape)
        xy = np.where(pairs.soft[:, None], xy + rays.sigma * noise, rays.xy)
    rows = np.flatnonzero(measured)
    observations = dataclasses.replace(
        rays.take(rows), xy=xy[rows], source=Source("simulated image points")
    )
    displaced = network.replace(
        images=images,
        points=points,
        observations=observations,
        residuals=residuals,
        distances=_distances(network, points.position, seed),
    )
    rays_by_image = np.bincount(rays.image[rows], minlength=len(images))
    return keep_images(displaced, rays_by_image >= MIN_TARGETS)


def _distances(
    network: Network, points: Float[np.ndarray, "points 3"], seed: int | None
) -> Distances:
    """Distances simulated after targets have moved."""
    distances = network.distances
    ends = points[distances.points], network.points.position[distances.points]
    length, length_before = (np.linalg.norm(e[:, 0] - e[:, 1], axis=1) for e in ends)
    has_changed = np.abs(length - length_before) > 1e-12 * length_before  # beyond rounding
    # A stream of its own: the noise of image points does not depend on whether there are distances.
    noise = (
        np.zeros(len(distances))
        if seed is None
        else (distances.sigma * np.random.default_rng([seed, 1]).standard_normal(len(distances)))
    )
    return dataclasses.replace(
        distances, value=np.where(has_changed, length + noise, distances.value)
    )


def problem_of(network: Network) -> NetworkProblem | None:
    """The problem of a designed network; None if it cannot be adjusted."""
    try:
        checked = check_network(network)
        return make_problem(checked) if len(checked.images) == len(network.images) else None
    except (InputError, NotSolvedError):
        return None
