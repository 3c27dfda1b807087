"""Geometry: pure, differentiable functions of one rotation, one pose, one point.

Batch them with `jax.vmap`. Angles are in radians, lengths in the unit of their arguments.
`affine`, `ellipsoid` and `similarity` are used as namespaces: `affine.apply`,
`ellipsoid.geodetic`, `similarity.transform_point`.
"""

from jaxbundle.geometry import affine, ellipsoid, pose_conventions, similarity
from jaxbundle.geometry.quaternions import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_conjugate,
    quaternion_difference,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    retract_quaternion,
    rotation_vector_from_matrix,
    rotation_vector_from_quaternion,
)
from jaxbundle.geometry.rotations import (
    R1,
    R2,
    R3,
    azimuth_tilt_swing_from_matrix,
    matrix_from_azimuth_tilt_swing,
    matrix_from_omega_phi_kappa,
    matrix_from_phi_omega_kappa,
    matrix_from_rodrigues,
    omega_phi_kappa_from_matrix,
    omega_phi_kappa_near,
    phi_omega_kappa_from_matrix,
    rodrigues_from_matrix,
)
from jaxbundle.geometry.similarity import (
    helmert_point,
    helmert_pose,
    transform_point,
    transform_pose,
)

__all__ = [
    "R1",
    "R2",
    "R3",
    "affine",
    "azimuth_tilt_swing_from_matrix",
    "ellipsoid",
    "helmert_point",
    "helmert_pose",
    "matrix_from_azimuth_tilt_swing",
    "matrix_from_omega_phi_kappa",
    "matrix_from_phi_omega_kappa",
    "matrix_from_quaternion",
    "matrix_from_rodrigues",
    "matrix_from_rotation_vector",
    "omega_phi_kappa_from_matrix",
    "omega_phi_kappa_near",
    "phi_omega_kappa_from_matrix",
    "pose_conventions",
    "quaternion_conjugate",
    "quaternion_difference",
    "quaternion_from_matrix",
    "quaternion_from_rotation_vector",
    "quaternion_multiply",
    "retract_quaternion",
    "rodrigues_from_matrix",
    "rotation_vector_from_matrix",
    "rotation_vector_from_quaternion",
    "similarity",
    "transform_point",
    "transform_pose",
]
