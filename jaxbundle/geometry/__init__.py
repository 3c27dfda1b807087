"""Geometry: pure, differentiable functions of one rotation, one pose, one point.

Batch them with `jax.vmap`. Angles are in radians, lengths in the unit of their arguments.
`affine`, `ellipsoid` and `similarity` are used as namespaces: `affine.apply`,
`ellipsoid.geodetic`, `similarity.transform_point`.
"""

from . import affine as affine
from . import ellipsoid as ellipsoid
from . import similarity as similarity
from .quaternions import matrix_from_quaternion as matrix_from_quaternion
from .quaternions import matrix_from_rotation_vector as matrix_from_rotation_vector
from .quaternions import quaternion_conjugate as quaternion_conjugate
from .quaternions import quaternion_difference as quaternion_difference
from .quaternions import quaternion_from_matrix as quaternion_from_matrix
from .quaternions import quaternion_from_rotation_vector as quaternion_from_rotation_vector
from .quaternions import quaternion_multiply as quaternion_multiply
from .quaternions import retract_quaternion as retract_quaternion
from .quaternions import rotation_vector_from_matrix as rotation_vector_from_matrix
from .quaternions import rotation_vector_from_quaternion as rotation_vector_from_quaternion
from .rotations import R1 as R1
from .rotations import R2 as R2
from .rotations import R3 as R3
from .rotations import azimuth_tilt_swing_from_matrix as azimuth_tilt_swing_from_matrix
from .rotations import matrix_from_azimuth_tilt_swing as matrix_from_azimuth_tilt_swing
from .rotations import matrix_from_omega_phi_kappa as matrix_from_omega_phi_kappa
from .rotations import matrix_from_phi_omega_kappa as matrix_from_phi_omega_kappa
from .rotations import matrix_from_rodrigues as matrix_from_rodrigues
from .rotations import omega_phi_kappa_from_matrix as omega_phi_kappa_from_matrix
from .rotations import omega_phi_kappa_near as omega_phi_kappa_near
from .rotations import phi_omega_kappa_from_matrix as phi_omega_kappa_from_matrix
from .rotations import rodrigues_from_matrix as rodrigues_from_matrix
from .similarity import helmert_point as helmert_point
from .similarity import helmert_pose as helmert_pose
from .similarity import transform_point as transform_point
from .similarity import transform_pose as transform_pose
