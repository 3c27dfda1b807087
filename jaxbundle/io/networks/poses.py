"""Rotations of many images at once, in the forms used by files.

All are computed in batches of one shape, so that any number of images shares one compiled program.
"""

from collections.abc import Callable
from functools import partial

import jax
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxbundle import geometry
from jaxbundle.errors import InputError
from jaxbundle.float64 import local_x64
from jaxbundle.system.programs import compile_once

Matrices = Float[np.ndarray, "images 3 3"]
Triples = Float[np.ndarray, "images 3"]
Quaternions = Float[np.ndarray, "images 4"]


def angles_of(M: Matrices) -> Triples:
    """ω, φ, κ in radians of rotation matrices."""
    return apply_in_batches(geometry.omega_phi_kappa_from_matrix, M, (3, 3), (3,))


def matrices_of(angles: Triples) -> Matrices:
    """M of ω, φ, κ in radians."""
    return apply_in_batches(geometry.matrix_from_omega_phi_kappa, angles, (3,), (3, 3))


def quaternions_of(M: Matrices) -> Quaternions:
    """Unit quaternions (w, x, y, z) of rotation matrices."""
    return apply_in_batches(geometry.quaternion_from_matrix, M, (3, 3), (4,))


def matrices_of_quaternions(q: Quaternions) -> Matrices:
    """Rotation matrices of quaternions (w, x, y, z) of any length but 0."""
    return apply_in_batches(geometry.matrix_from_quaternion, q, (4,), (3, 3))


def rotation_vectors_of(M: Matrices) -> Triples:
    """v with M = exp([v]×)."""
    return apply_in_batches(geometry.rotation_vector_from_matrix, M, (3, 3), (3,))


def matrices_of_rotation_vectors(v: Triples) -> Matrices:
    """M = exp([v]×)."""
    return apply_in_batches(geometry.matrix_from_rotation_vector, v, (3,), (3, 3))


def are_rotations(
    R: Float[np.ndarray, "*images 3 3"], tolerance: float = 1e-4
) -> Bool[np.ndarray, "*images"]:
    """Which matrices of a file are rotations.

    **Arguments:** `tolerance` of R·Rᵀ relative to the identity: files have six digits or so of R;
    larger, and a matrix with a typing error in its fourth digit passes.
    """
    deviation = np.abs(R @ R.mT - np.eye(3)).max((-2, -1))
    return np.asarray((deviation <= tolerance) & (np.linalg.det(R) > 0))


def check_rotations(R: Float[np.ndarray, "*images 3 3"], where: str) -> None:
    """Refuse invalid rotation matrices.

    **Raises:** `InputError` beginning with `where`."""
    is_rotation = are_rotations(R)
    if not is_rotation.all():
        (first_invalid, *_) = np.reshape(R, (-1, 3, 3))[~np.ravel(is_rotation)]
        # Minus a reflection is a rotation.
        mirror = are_rotations(-first_invalid).all()
        raise InputError(
            f"{where} is not a rotation matrix{', but one that mirrors' if mirror else ''}"
        )


@partial(compile_once, static=0)
def _batch(function: Callable[..., Array], rows: Float[np.ndarray, "batch ..."]) -> Array:
    return jax.vmap(function)(rows)


def apply_in_batches(
    function: Callable[..., Array],
    rows: Float[np.ndarray, "images ..."],
    shape: tuple[int, ...],
    result_shape: tuple[int, ...],
    batch_size: int = 256,
) -> Float[np.ndarray, "images ..."]:
    """A function of one image's array applied to all, in batches of one shape.

    **Arguments:** `rows` [images, *shape]; `batch_size`: larger wastes work on the zeros that fill
    up the last batch (a dozen images are common), smaller makes more calls.

    **Returns:** [images, *result_shape].
    """
    rows = np.reshape(rows, (-1, *shape))
    results = np.zeros((len(rows), *result_shape))
    with local_x64():
        for begin in range(0, len(rows), batch_size):
            part = rows[begin : begin + batch_size]
            batch = np.concatenate([part, np.zeros((batch_size - len(part), *shape))])
            results[begin : begin + batch_size] = np.asarray(_batch(function, batch))[: len(part)]
    return results
