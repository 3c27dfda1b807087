"""Poses that change with time: cubic B-splines, in cumulative form for the rotation.

Between the knots t_i and t_i + Δ, with u = (t − t_i)/Δ, four control poses (p_j, M_j), j = i … i+3:

    p(t) = p_i + Σ λ_j(u)·(p_{i+j} − p_{i+j−1})                                  j = 1, 2, 3
    M(t) = C(λ_3·h_3)·C(λ_2·h_2)·C(λ_1·h_1)·M_i          C(h_j) = M_{i+j}·M_{i+j−1}ᵀ

    λ_1 = (5 + 3u − 3u² + u³)/6      λ_2 = (1 + 3u + 3u² − 2u³)/6      λ_3 = u³/6

h = tan(θ/2)·n is Gibbs's vector of a rotation by θ about n, and C(h) its matrix (Cayley), which is
rational: no root, no series, derivatives of any order. Whatever the map from vectors to rotations,
the curve is continuous to its second derivative, since C(1·h) leads from one control rotation to
the next exactly, and λ_1 reaches 1, and λ_3 leaves 0, with two vanishing derivatives. Neighbouring
control rotations must differ by less than 180°.

Sources: Kim, Kim and Shin (1995), A general construction scheme for unit quaternion curves with
simple high order derivatives, SIGGRAPH (cumulative form); Furgale, Rehder and Siegwart (2013),
Unified temporal and spatial calibration for multi-sensor systems, IROS; Sommer, Usenko, Schubert,
Demmel and Cremers (2020), Efficient derivative computation for cumulative B-splines on Lie groups,
CVPR.
"""

from collections.abc import Sequence

from jaxbundle.geometry.vectors import cross
from jaxbundle.types import Scalar

# Three scalars, and the nine of a matrix by rows.
Triple = tuple[Scalar, ...]
Rows = tuple[Scalar, ...]


def cumulative_basis(u: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """λ_1, λ_2, λ_3 of the cubic spline at u, 0 to 1 within an interval."""
    return (
        (5 + u * (3 + u * (-3 + u))) / 6,
        (1 + u * (3 + u * (3 - 2 * u))) / 6,
        u * u * u / 6,
    )


def gibbs_vector(A: Rows, B: Rows) -> Triple:
    """tan(θ/2)·n of the rotation A·Bᵀ (Gibbs, 1884); matrices by rows, without unit."""
    D = lambda i, j: sum(A[3 * i + k] * B[3 * j + k] for k in range(3))
    scale = 1 / (1 + D(0, 0) + D(1, 1) + D(2, 2))
    return (
        (D(2, 1) - D(1, 2)) * scale,
        (D(0, 2) - D(2, 0)) * scale,
        (D(1, 0) - D(0, 1)) * scale,
    )


def compose_gibbs(a_vector: Triple, b_vector: Triple) -> Triple:
    """The Gibbs vector of C(one)·C(other)."""
    scale = 1 / (1 - sum(a * b for a, b in zip(a_vector, b_vector)))
    return tuple(
        (a + b + c) * scale for a, b, c in zip(a_vector, b_vector, cross(a_vector, b_vector))
    )


def turn_by_gibbs(h: Triple, x: Triple) -> Triple:
    """C(h)·x = x + 2·(h × x + h × (h × x))/(1 + h·h)."""
    first_order = cross(h, x)
    second_order = cross(h, first_order)
    scale = 2 / (1 + h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
    return tuple(a + scale * (b + c) for a, b, c in zip(x, first_order, second_order))


def spline_position(positions: Sequence[Triple], u: Scalar) -> Triple:
    """p(t) of four control positions."""
    weights = cumulative_basis(u)
    steps = list(zip(positions, positions[1:]))
    return tuple(
        positions[0][k] + sum(w * (b[k] - a[k]) for w, (a, b) in zip(weights, steps))
        for k in range(3)
    )


def turn_back_by_steps(steps: Sequence[Triple], u: Scalar, x: Triple) -> Triple:
    """M_i·M(t)ᵀ·x by the steps h_1, h_2, h_3 from a control rotation to the next."""
    for weight, h in reversed(list(zip(cumulative_basis(u), steps))):
        # The inverse of C(h) is C(−h).
        x = turn_by_gibbs(tuple(-weight * c for c in h), x)
    return x
