"""Fiducial marks: instrument or pixel coordinates into image coordinates.

    similarity   X = a·x − b·y + c,  Y = b·x + a·y + d
    affine       X = a·x + b·y + c,  Y = d·x + e·y + f
    projective   X = (a·x + b·y + c)/(g·x + h·y + 1),  Y = (d·x + e·y + f)/(g·x + h·y + 1)

by least squares on v = computed − calibrated image coordinates, σ0² = vᵀPv/(2n − u). The affine one
absorbs two scales and a shear of film or scanner; the similarity only scale and position,
so that its residuals show film deformation.

Source: Kraus (2007), Photogrammetry, section 3.2; Wolf and Dewitt (2000), appendices B and C.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.arguments import show
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.geometry import affine
from jaxbundle.leastsquares.iterations.small import Fit, adjust
from jaxbundle.network.columns import did_you_mean
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# Parameters of each kind, the letters above.
UNKNOWNS = {"similarity": 4, "affine": 6, "projective": 8}


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Transformation:
    """A transformation of the plane with its residuals.

    **Fields:** `parameters` in the order of the letters above and their `covariance` (a posteriori;
    NaN without redundancy); `residuals` v of the marks in the unit of the target, `sigma0`, the σ
    of a mark of weight 1 in that unit, NaN without redundancy; `redundancy`.
    """

    kind: str
    parameters: Float[np.ndarray, " u"]
    covariance: Float[np.ndarray, "u u"]
    residuals: Float[np.ndarray, "marks 2"]
    sigma0: float
    redundancy: int

    def __call__(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points of the source in the target system."""
        return np.asarray(_transform_all(self.kind, self.parameters, np.asarray(xy, float)))

    def __str__(self) -> str:
        largest = np.linalg.norm(self.residuals, axis=1).max()
        return (
            f"{self.kind} transformation of {len(self.residuals)} marks: σ0 {self.sigma0:.4g}, "
            f"redundancy {self.redundancy}, largest residual {largest:.4g}"
        )


def transform(
    kind: str, p: Float[AnyArray, " u"], point: Float[AnyArray, "2"]
) -> Float[Array, "2"]:
    """A point (x, y) of the source in the target system."""
    if kind == "similarity":
        a, b, c, d = p
        p = jnp.stack([a, -b, c, b, a, d])
    scale = 1.0
    if kind == "projective":
        scale, p = p[6] * point[0] + p[7] * point[1] + 1, p[:6]
    return affine.apply(p, point) / scale


@partial(compile_once, static=0)
def _transform_all(
    kind: str, p: Float[AnyArray, " u"], xy: Float[AnyArray, "n 2"]
) -> Float[Array, "n 2"]:
    return jax.vmap(partial(transform, kind), (None, 0))(p, xy)


def fit_fiducials(
    measured: Float[np.ndarray, "marks 2"],
    calibrated: Float[np.ndarray, "marks 2"],
    kind: str = "affine",
    weights: Float[np.ndarray, " marks"] | None = None,
) -> Transformation:
    """The transformation from measured to calibrated coordinates of fiducial marks.

    **Arguments:** the marks in the same order; `kind`: "similarity", "affine" or "projective";
    `weights` p = 1/σ², 0 for marks that only get residuals.

    **Raises:** `InputError` for too few marks, marks on a line, or negative weights.
    """
    if kind not in UNKNOWNS:
        raise InputError(f"kind of transformation {kind!r}{did_you_mean(kind, UNKNOWNS)}")
    source, target = np.asarray(measured, float), np.asarray(calibrated, float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 2:
        raise InputError(
            f"fiducial marks must come in pairs, [marks, 2] twice, but have the shapes "
            f"{source.shape} and {target.shape}"
        )
    p = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    if p.shape != source.shape[:1] or not (np.isfinite(p) & (p >= 0)).all():
        raise InputError(
            f"fiducial marks: expected {len(source)} weights, one of 0 or more for each mark, but "
            f"they are {show(weights)}"
        )
    # Marks of weight 0 have residuals, but determine nothing.
    marks, unknowns = int(np.count_nonzero(p)), UNKNOWNS[kind]
    if 2 * marks < unknowns:
        of_weight = " of weight above 0" if marks < len(source) else ""
        raise InputError(
            f"{marks} fiducial marks{of_weight} are too few for the {kind} transformation: give "
            f"{unknowns // 2} or more, or choose a simpler one"
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InputError("fiducial marks: every coordinate must be a finite number")
    # Pixels of thousands beside mm: reduced to the centroid and the spread, N is well scaled.
    middle = source.mean(0)
    size = max(float((source - middle).std()), 1e-300)
    fit = _fit(kind, unknowns, (source - middle) / size, target, p)
    if not bool(fit.determined):
        raise InputError(
            f"the {marks} fiducial marks do not determine the {kind} transformation: they lie on a "
            "line, or some of them coincide"
        )
    parameters, J = map(np.asarray, _in_source_units(kind, fit.estimate, middle, size))
    redundancy = 2 * marks - unknowns
    variance = float(fit.vtpv) / redundancy if redundancy else float("nan")
    result = Transformation(
        kind,
        parameters,
        variance * J @ np.asarray(fit.cofactor) @ J.T,
        np.zeros_like(source),
        variance**0.5,
        redundancy,
    )
    return dataclasses.replace(result, residuals=result(source) - target)


@partial(compile_once, static=(0, 1))
def _fit(
    kind: str,
    unknowns: int,
    source: Float[AnyArray, "marks 2"],
    target: Float[AnyArray, "marks 2"],
    p: Float[AnyArray, " marks"],
) -> Fit:
    start = jnp.zeros(unknowns).at[jnp.array([0, 1] if unknowns == 4 else [0, 4])].set(1.0)
    root = jnp.sqrt(p)[:, None]

    def residuals(
        q: Float[Array, " u"],
        source: Float[Array, "marks 2"],
        target: Float[Array, "marks 2"],
        root: Float[Array, "marks 1"],
    ) -> Float[Array, " 2*marks"]:
        return (root * (_transform_all(kind, q, source) - target)).ravel()

    # Linear ones end with the first step; the projective one starts from it.
    if kind == "projective":
        affine_start = affine.fit(source, target, p)
        start = jnp.concatenate([affine_start, jnp.zeros(2)])
    return adjust(residuals, jnp.add, start, (source, target, root), unknowns)


@partial(compile_once, static=0)
def _in_source_units(
    kind: str, q: Float[AnyArray, " u"], middle: Float[AnyArray, "2"], size: Scalar
) -> tuple[Float[Array, " u"], Float[Array, "u u"]]:
    """Parameters for (x, y) from those for (x − middle)/size, and their derivatives."""

    def convert(q: Float[AnyArray, " u"]) -> Float[Array, " u"]:
        (mx, my), k = middle, size
        if kind == "similarity":
            a, b = q[0] / k, q[1] / k
            return jnp.stack([a, b, q[2] - a * mx + b * my, q[3] - b * mx - a * my])
        rows = jnp.concatenate([q, jnp.ones(1) if len(q) == 8 else jnp.array([0.0, 0, 1])])
        H = rows.reshape(3, 3)
        H = jnp.concatenate([H[:, :2] / k, (H[:, 2] - H[:, :2] @ middle / k)[:, None]], 1)
        return (H / H[2, 2]).ravel()[: len(q)]

    return convert(q), jax.jacfwd(convert)(q)
