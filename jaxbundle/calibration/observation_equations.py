"""The observation equations of the image points of one camera at its adjusted values, dense.

For tests that add parameters to a calibration, or divide it, without a new adjustment.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.spaces import Space
from jaxbundle.network.kinds.image_points import ImagePoint
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


class LinearisedImagePoints(NamedTuple):
    """Residuals over their σ, and their derivatives.

    `v` [n, 2]; `slopes`: by table, the derivatives by the changes of the row that is used;
    `rows`: by table, that row; `by_columns`: derivatives by held parameters of the camera.
    """

    v: Float[np.ndarray, "n 2"]
    slopes: dict[str, Float[np.ndarray, "n 2 width"]]
    rows: dict[str, Int[np.ndarray, " n"]]
    by_columns: Float[np.ndarray, "n 2 columns"]


def linearise_image_points(
    problem: NetworkProblem, values: Values, columns: tuple[int, ...] = ()
) -> LinearisedImagePoints:
    """All image points of a network of one camera; 0 without weight.

    **Arguments:** `columns`: parameters of the camera, held or not, for derivatives.
    """
    camera = problem.network.cameras[0].model
    image_point, declared = ImagePoint(camera, problem.network.residuals), problem.declared
    (name,) = (table.name for table in problem.cameras)
    rows_of = {"image": problem.image, name: problem.camera, "point": problem.point}
    touched_values = tuple(
        jax.tree.map(lambda x, i=i: np.asarray(x)[i], values[t]) for t, i in rows_of.items()
    )
    spaces = tuple(declared.spaces[t] for t in rows_of)
    xy, weight = problem.image_coordinates(), problem.image_weights
    v, J = _linearise(image_point, spaces, columns, touched_values, xy, weight)
    *parts, B = np.split(np.asarray(J), np.cumsum([s.width for s in spaces]), 2)
    return LinearisedImagePoints(np.asarray(v), dict(zip(rows_of, parts)), rows_of, B)


def lagrange_multipliers(
    adjustment: Adjustment, linearised: LinearisedImagePoints, B: Float[np.ndarray, "n 2 k"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Bᵀv and S of omitted parameters b, B = ∂v/∂b:

        S·b = −Bᵀ·v,      S = BᵀB − (JᵀB)ᵀ·Q·(JᵀB),      vᵀv falls by bᵀ·S·b

    with J = ∂v/∂unknowns, Q their cofactors. S is singular along directions that the unknowns
    absorb.

    Source: Rao (1948), Proceedings of the Cambridge Philosophical Society 44, 50-57.
    """
    tables, k = adjustment.problem.tables, B.shape[2]
    rows = {t.name: np.zeros((k, t.rows, t.space.width)) for t in tables}
    for t, i in linearised.rows.items():
        part = np.einsum("nrw,nrk->nkw", linearised.slopes[t], B)
        np.add.at(rows[t].swapaxes(0, 1), i, part)
    flat = B.reshape(-1, k)
    # (JᵀB)ᵀ·Q·(JᵀB) by the factor that the adjustment holds: Q itself, thousands squared, is never
    # made
    S = flat.T @ flat - adjustment.inspection.solution.propagate_rows(rows)
    return flat.T @ linearised.v.ravel(), S


@partial(compile_once, static=(0, 1, 2))
def _linearise(
    image_point: ImagePoint,
    spaces: tuple[Space, ...],
    columns: tuple[int, ...],
    touched_values: tuple[Any, ...],
    xy: Float[AnyArray, "n 2"],
    weight: Float[AnyArray, "n 2"],
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 directions"]]:
    """v/σ [n, 2] of all image points and their derivatives [n, 2, directions]: by the changes of
    pose, camera and point, and by b."""
    ends = np.cumsum([s.width for s in spaces])

    def linearise_point(
        touched_values: tuple[Any, ...], xy: Float[AnyArray, "2"], weight: Float[AnyArray, "2"]
    ) -> tuple[Array, Array]:
        def v(change: Float[Array, " directions"]) -> tuple[Array, Array]:
            *changes, b = jnp.split(change, ends)
            pose, interior, ray = (
                s.move(s.prepare(x), tuple(d)) for s, x, d in zip(spaces, touched_values, changes)
            )
            p = dict(enumerate(interior)) | {c: interior[c] + b[k] for k, c in enumerate(columns)}
            residual = jnp.stack(image_point(pose, tuple(p.values()), tuple(ray), tuple(xy)))
            # Returned twice: value and derivatives in one pass.
            residual = jnp.where(weight > 0, weight * residual, 0.0)
            return residual, residual

        J, residual_value = jax.jacfwd(v, has_aux=True)(jnp.zeros(ends[-1] + len(columns)))
        return residual_value, J

    return jax.vmap(linearise_point)(touched_values, xy, weight)
