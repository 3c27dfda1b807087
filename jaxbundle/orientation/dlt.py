"""Direct linear transformation: interior and exterior orientation from points in space.

    x = (L1·X + L2·Y + L3·Z + L4)/(L9·X + L10·Y + L11·Z + 1)
    y = (L5·X + L6·Y + L7·Z + L8)/(L9·X + L10·Y + L11·Z + 1)

Eleven parameters from six points or more (Abdel-Aziz and Karara, 1971), found as the 3 × 4 matrix
P by the singular value decomposition of the normalised equations (Hartley, 1997), and decomposed

    P ~ −K·D·M·[I  −X0],        D = diag(1, 1, −1)

        ⎡fx  s  x0⎤
    K = ⎢    fy y0⎥        x = x0 − fx·r/q − s·s/q,  y = y0 − fy·s/q  (r, s, q in the camera frame)
        ⎣        1⎦

by making the rows of P's left part perpendicular from the last to the first. Refinement minimises
the misclosures of the collinearity equations, optionally with radial distortion as a correction of
the measured coordinates, (x̄, ȳ)·(1 + K1·r² + K2·r⁴ + …).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxbundle.arguments import without_masks
from jaxbundle.leastsquares.iterations.small import adjust
from jaxbundle.orientation.linear import (
    RANK_TOLERANCE,
    extent,
    normalisation,
    null_vector,
    ones_unless,
)
from jaxbundle.orientation.pose import CameraPose, image_of, retract_pose, to_camera
from jaxbundle.orientation.status import Status, first_of
from jaxbundle.types import AnyArray


class CameraWithPose(eqx.Module):
    """Interior orientation (fx, fy, s, x0, y0) and radial K1, K2, … in image units, and pose."""

    interior: Float[AnyArray, "5"]
    radial: Float[AnyArray, " k"]
    pose: CameraPose


class RefinedCamera(eqx.Module):
    """A camera, vᵀPv, and the cofactors in the order of `interior`, δX0, δθ (radians), `radial`."""

    camera: CameraWithPose
    vtpv: Float[AnyArray, ""]
    cofactor: Float[AnyArray, "u u"]
    status: Int[AnyArray, ""]


@without_masks
def direct_linear_transformation(
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
) -> tuple[Float[Array, "3 4"], Int[Array, ""]]:
    """P of n ≥ 6 points, with L1 … L11 = P/P₃₄ row by row, differentiable.

    **Arguments:** image coordinates in any unit, y up; points in the object unit; weights
    p = 1/σ²; 0: the point is absent.

    **Returns:** P scaled to w = 1 at the mean of the points, and the status: `COLLINEAR_POINTS`,
    `COPLANAR_POINTS`, or `UNDETERMINED` (other critical configurations: a twisted cubic through
    the projection centre).
    """
    p = ones_unless(weights, xy)
    (m, k), (n, l) = normalisation(X, p), normalisation(xy, p)
    Y = jnp.pad((X - m) / k, ((0, 0), (0, 1)), constant_values=1)
    x, nil, sqrt_p = (xy - n) / l, jnp.zeros_like(Y), jnp.sqrt(p)[:, None]
    rows_x = sqrt_p * jnp.hstack([Y, nil, -x[:, :1] * Y])
    rows_y = sqrt_p * jnp.hstack([nil, Y, -x[:, 1:] * Y])
    h, singular = null_vector(jnp.concatenate([rows_x, rows_y]))
    a, b, c = h.reshape(3, 4)
    P = jnp.stack([l * a + n[0] * c, l * b + n[1] * c, c])
    P = jnp.concatenate([P[:, :3] / k, (P[:, 3] - P[:, :3] @ m / k)[:, None]], axis=1)
    at_mean = P[2, :3] @ m + P[2, 3]
    size = extent(X, p)
    status = first_of(
        (size[1] < RANK_TOLERANCE, Status.COLLINEAR_POINTS),
        (size[2] < RANK_TOLERANCE, Status.COPLANAR_POINTS),
        (singular[-2] < RANK_TOLERANCE * singular[0], Status.UNDETERMINED),
    )
    return P / jnp.where(at_mean == 0, 1, at_mean), status


def decompose(P: Float[AnyArray, "3 4"]) -> tuple[CameraWithPose, Int[Array, ""]]:
    """The camera without distortion whose projection matrix is P, w > 0 in front of it.

    `BEHIND_THE_CAMERA`: the image is mirrored (y down); the camera then sees it from behind.
    """
    # w = −q is positive in front: −P's left part has the determinant fx·fy·|m₃|³ > 0
    mirrored = jnp.linalg.det(P[:, :3]) > 0
    A = jnp.where(mirrored, P, -P)
    # An RQ decomposition by Gram–Schmidt, from the last row to the first, differentiable and with
    # the signs of D·M·K fixed; that of LAPACK leaves the signs of the diagonal open.
    length = jnp.linalg.norm(A[2, :3])
    a, b, m3 = A[:, :3] / length
    x0, y0 = a @ m3, b @ m3
    fy = jnp.linalg.norm(b - y0 * m3)
    m2 = -(b - y0 * m3) / fy
    skew = -a @ m2
    scaled_m1 = a - x0 * m3 + skew * m2
    fx = jnp.linalg.norm(scaled_m1)
    M = jnp.stack([-scaled_m1 / fx, m2, m3])
    X0 = -jnp.linalg.solve(A[:, :3], A[:, 3])
    camera = CameraWithPose(
        jnp.stack([fx, fy, skew, x0, y0]), jnp.zeros(0, P.dtype), CameraPose(X0, M)
    )
    return camera, first_of((mirrored, Status.BEHIND_THE_CAMERA))


def refine_camera(
    camera: CameraWithPose,
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    weights: Float[AnyArray, " n"] | None = None,
    radial: int = 0,
) -> RefinedCamera:
    """Eleven parameters, and `radial` ones of distortion, by least squares, differentiable; as many
    as the camera has if these are more.

    Arguments as in `direct_linear_transformation`; `UNDETERMINED` where the points do not give
    all parameters.
    """
    p = ones_unless(weights, xy)
    radial = max(radial, len(camera.radial))
    added_terms = radial - len(camera.radial)
    start = CameraWithPose(camera.interior, jnp.pad(camera.radial, (0, added_terms)), camera.pose)
    data = (xy, X, jnp.sqrt(p))
    fit = adjust(_misclosures, _retract, start, data, 11 + radial)
    behind = jax.vmap(to_camera, (None, 0))(fit.estimate.pose, X)[:, 2] >= 0
    status = first_of(
        (~fit.determined, Status.UNDETERMINED),
        (jnp.any(behind & (p > 0)), Status.BEHIND_THE_CAMERA),
    )
    return RefinedCamera(fit.estimate, fit.vtpv, fit.cofactor, status)


def project(camera: CameraWithPose, X: Float[AnyArray, "3"]) -> Float[Array, "2"]:
    """The image of a point without distortion, relative to the principal point."""
    fx, fy, skew = camera.interior[:3]
    x, y = image_of(camera.pose, X)
    return jnp.stack([fx * x + skew * y, fy * y])


def correct(camera: CameraWithPose, xy: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    """A measured point relative to the principal point, corrected for radial distortion."""
    reduced = jnp.asarray(xy) - camera.interior[3:]
    square = reduced @ reduced
    return reduced * (1 + sum(K * square ** (i + 1) for i, K in enumerate(camera.radial)))


def _misclosures(
    camera: CameraWithPose,
    xy: Float[AnyArray, "n 2"],
    X: Float[AnyArray, "n 3"],
    sqrt_weight: Float[AnyArray, " n"],
) -> Float[Array, " 2n"]:
    point = lambda xy, X, sqrt_p: sqrt_p * (project(camera, X) - correct(camera, xy))
    return jax.vmap(point)(xy, X, sqrt_weight).ravel()


def _retract(camera: CameraWithPose, delta: Float[Array, " u"]) -> CameraWithPose:
    return CameraWithPose(
        camera.interior + delta[:5],
        camera.radial + delta[11:],
        retract_pose(camera.pose, delta[5:11]),
    )
