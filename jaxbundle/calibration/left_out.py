r"""The affinity a camera model has but was not given: is it missed?

`brown` and `brown-projected` have one principal distance; pixels that are not square, or a shear,
are left to b1 and b2, which a calibration does not estimate unless asked. Whether the residuals v
(over their σ) miss them is told by one step from the adjusted values, all other unknowns moving
with it,

    S·b = −Bᵀ·v,      S = BᵀB − (JᵀB)ᵀ·Q·(JᵀB)

with B = ∂v/∂b, J = ∂v/∂unknowns, Q their cofactors; the cofactors of b are S⁻¹. It is the score
(Lagrange multiplier) test: no second adjustment is needed.

Source: Rao (1948), Proceedings of the Cambridge Philosophical Society 44, 50-57.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model, is_own
from jaxbundle.network.kinds import ImagePoint

AFFINE = ("b1", "b2")
CRITICAL = 4.0
"""|b|/σ above which a parameter is missed."""


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Parameters that were held at 0: what they would be, σ, and the largest displacement of a
    point in the image they stand for, pixels."""

    names: tuple[str, ...]
    values: Float[np.ndarray, " k"]
    sigma: Float[np.ndarray, " k"]
    largest: float

    @property
    def missed(self) -> bool:
        return bool((np.abs(self.values) > CRITICAL * self.sigma).any())

    def __str__(self) -> str:
        each = ", ".join(
            f"{n} {b:.2g} ± {s:.1g}" for n, b, s in zip(self.names, self.values, self.sigma)
        )
        return (
            f"{' and '.join(self.names)} of the model are left out, and the residuals ask for them "
            f"({each}): points are displaced by up to {self.largest:.2f} px; pixels that are not "
            "square, or an affinity: free them (--free)"
        )


def left_out(adjustment) -> LeftOut | None:
    """The affine parameters of an adjusted camera that are not free; None where it has none.

    **Arguments:** the adjustment of one camera, with `image_size` and `pixel_size`.
    """
    given = adjustment.problem.network.cameras[0]
    model = get_model(given.model)
    known = () if is_own(model) else AFFINE
    names = tuple(n for n in known if n in model.parameters and n not in given.free)
    if not names or given.pixel_size is None or not adjustment.sigma0 > 0:
        return None
    columns = tuple(model.parameters.index(name) for name in names)
    B, v, rows = _score(adjustment.problem, columns, adjustment.values)
    S = B @ B.T - adjustment.inspection.solution.propagate_rows(rows)
    cofactor = np.linalg.inv(S)
    b = -cofactor @ (B @ v)
    sigma = adjustment.sigma0 * np.sqrt(np.diagonal(cofactor))
    # Δx = b1·x̄ + b2·ȳ, largest in a corner
    half = np.multiply(given.image_size, given.pixel_size) / 2
    reach = [half[AFFINE.index(name)] for name in names]
    return LeftOut(names, b, sigma, float(np.abs(b) @ reach / given.pixel_size[0]))


def _score(problem, columns, values):
    """B [k, 2n], v [2n] and JᵀB: by table [k, rows, width]."""
    camera = problem.network.cameras[0].model
    of, declared = ImagePoint(camera, problem.network.residuals), problem.system.declared
    (name,) = (table.name for table in problem.layout.cameras)
    tables = problem.layout.tables(values)
    at = {"image": problem.image, name: problem.camera, "point": problem.point}
    touched = tuple(jax.tree.map(lambda x, i=i: np.asarray(x)[i], tables[t]) for t, i in at.items())
    spaces = tuple(declared.spaces[t] for t in at)
    data = problem.data
    v, J = _linearise(of, spaces, columns, touched, data.image_xy, data.image_weight)
    *parts, B = np.split(np.asarray(J), np.cumsum([s.width for s in spaces]), 2)
    rows = {
        t.name: np.zeros((len(columns), t.rows, t.space.width)) for t in problem.system.tables
    }
    for (t, i), part in zip(at.items(), parts):
        np.add.at(rows[t].swapaxes(0, 1), i, np.einsum("nrw,nrk->nkw", part, B))
    return B.reshape(-1, len(columns)).T, np.asarray(v).ravel(), rows


@partial(jax.jit, static_argnums=(0, 1, 2))
def _linearise(of, spaces, columns, touched, xy, weight):
    """v/σ [n, 2] of all image points and their derivatives [n, 2, directions]: by the changes of
    pose, camera and point, and by b."""
    ends = np.cumsum([s.width for s in spaces])

    def of_one(touched, xy, weight):
        def v(change):
            *changes, b = jnp.split(change, ends)
            pose, interior, ray = (
                s.moved(s.prepare(x), tuple(d)) for s, x, d in zip(spaces, touched, changes)
            )
            p = dict(enumerate(interior)) | {c: interior[c] + b[k] for k, c in enumerate(columns)}
            residual = jnp.stack(of(pose, tuple(p.values()), tuple(ray), tuple(xy)))
            residual = jnp.where(weight > 0, weight * residual, 0.0)
            return residual, residual

        J, found = jax.jacfwd(v, has_aux=True)(jnp.zeros(ends[-1] + len(columns)))
        return found, J

    return jax.vmap(of_one)(touched, xy, weight)
