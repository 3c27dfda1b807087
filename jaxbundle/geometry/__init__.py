"""Geometry: pure, differentiable functions of one rotation, one pose, one point.

Batch them with `jax.vmap`. Angles are in radians, lengths in the unit of their arguments.
`affine`, `ellipsoid` and `similarity` are used as namespaces: `affine.apply`,
`ellipsoid.geodetic`, `similarity.transform_point`.
"""

from jaxbundle.geometry import affine as affine
from jaxbundle.geometry import ellipsoid as ellipsoid
from jaxbundle.geometry import similarity as similarity
from jaxbundle.geometry.quaternions import matrix_from_quaternion as matrix_from_quaternion
from jaxbundle.geometry.quaternions import (
    matrix_from_rotation_vector as matrix_from_rotation_vector,
)
from jaxbundle.geometry.quaternions import quaternion_conjugate as quaternion_conjugate
from jaxbundle.geometry.quaternions import quaternion_difference as quaternion_difference
from jaxbundle.geometry.quaternions import quaternion_from_matrix as quaternion_from_matrix
from jaxbundle.geometry.quaternions import (
    quaternion_from_rotation_vector as quaternion_from_rotation_vector,
)
from jaxbundle.geometry.quaternions import quaternion_multiply as quaternion_multiply
from jaxbundle.geometry.quaternions import retract_quaternion as retract_quaternion
from jaxbundle.geometry.quaternions import (
    rotation_vector_from_matrix as rotation_vector_from_matrix,
)
from jaxbundle.geometry.quaternions import (
    rotation_vector_from_quaternion as rotation_vector_from_quaternion,
)
from jaxbundle.geometry.rotations import R1 as R1
from jaxbundle.geometry.rotations import R2 as R2
from jaxbundle.geometry.rotations import R3 as R3
from jaxbundle.geometry.rotations import (
    azimuth_tilt_swing_from_matrix as azimuth_tilt_swing_from_matrix,
)
from jaxbundle.geometry.rotations import (
    matrix_from_azimuth_tilt_swing as matrix_from_azimuth_tilt_swing,
)
from jaxbundle.geometry.rotations import matrix_from_omega_phi_kappa as matrix_from_omega_phi_kappa
from jaxbundle.geometry.rotations import matrix_from_phi_omega_kappa as matrix_from_phi_omega_kappa
from jaxbundle.geometry.rotations import matrix_from_rodrigues as matrix_from_rodrigues
from jaxbundle.geometry.rotations import omega_phi_kappa_from_matrix as omega_phi_kappa_from_matrix
from jaxbundle.geometry.rotations import omega_phi_kappa_near as omega_phi_kappa_near
from jaxbundle.geometry.rotations import phi_omega_kappa_from_matrix as phi_omega_kappa_from_matrix
from jaxbundle.geometry.rotations import rodrigues_from_matrix as rodrigues_from_matrix
from jaxbundle.geometry.similarity import helmert_point as helmert_point
from jaxbundle.geometry.similarity import helmert_pose as helmert_pose
from jaxbundle.geometry.similarity import transform_point as transform_point
from jaxbundle.geometry.similarity import transform_pose as transform_pose
