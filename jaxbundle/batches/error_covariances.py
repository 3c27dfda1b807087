"""The covariances that components of shared errors give the unknowns of a camera.

With the rows W of the views and Z of the camera (`error_spans`), their triangular factors L and R,
the effects of errors F·ξ are

    x = R⁻ᵀ·Z·F·ξ  (interior),        L⁻ᵀ·(W·F·ξ − W·Jᵢ·x)  (pose)

so that covariances need only W·V·Wᵀ, W·V·Zᵀ and Z·V·Zᵀ of every V = F·Fᵀ: no row of all
observations is solved for.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.batches.error_roots import GIVEN_AXES
from jaxbundle.batches.error_spans import (
    BY_VIEW,
    Roots,
    Spans,
    in_single_precision,
    products_of_rows,
)
from jaxbundle.batches.normal import POSE


class Covariances(NamedTuple):
    """W·V·Wᵀ, W·V·Zᵀ and Z·V·Zᵀ of a component V of the `trace`."""

    ww: Float[Array, "views 6 6"]
    wz: Float[Array, "views 6 k"]
    zz: Float[Array, "k k"]
    trace: Float[Array, ""]

    @property
    def remaining(self) -> Float[Array, ""]:
        """tr(M·V)."""
        return self.trace - jnp.trace(self.zz) - jnp.trace(self.ww, axis1=1, axis2=2).sum()


class OntoSpans(NamedTuple):
    """W·F and Z·F of the field [.., axis and spline] and of the columns by view."""

    WB: Float[Array, "views 6 n"]
    ZB: Float[Array, "k n"]
    WF: Float[Array, "views 6 5"]
    ZF: Float[Array, "views k 5"]


def onto_field(
    spans: Spans,
    splines: Float[Array, "views splines points"],
    octaves: Float[Array, "splines splines"],
) -> tuple[Float[Array, "views 6 n"], Float[Array, "k n"]]:
    """W·F and Z·F of the field."""
    # One product of all rows of a view.
    rows = in_single_precision(jnp.concatenate([spans.W, spans.Z], 1))
    projected = jnp.einsum("veap,vsp->veas", rows, splines)
    onto_octaves = lambda A: (A @ in_single_precision(octaves)).reshape(*A.shape[:-2], -1)
    of_views, of_camera = projected[:, :POSE], projected[:, POSE:].sum(0)
    return onto_octaves(of_views).astype(float), onto_octaves(of_camera).astype(float)


def onto_spans(spans: Spans, roots: Roots) -> OntoSpans:
    return OntoSpans(
        *onto_field(spans, roots.splines, roots.octaves),
        jnp.einsum("veap,vapc->vec", spans.W, roots.by_view),
        jnp.einsum("vkap,vapc->vkc", spans.Z, roots.by_view),
    )


def covariances(spans: Spans, roots: Roots, of: OntoSpans) -> list[Covariances]:
    """Of all components."""
    W, k = spans.W, spans.Z.shape[1]
    rows = 2 * roots.used.sum()
    products_of_own = products_of_rows(W, W)
    return [
        Covariances(products_of_own, jnp.zeros((*W.shape[:2], k)), jnp.eye(k), rows),
        covariances_of_columns(of.WB, of.ZB, rows),
        *covariances_by_view(spans, roots.by_view),
        covariances_along_tracks(spans, roots.used, roots.views @ roots.views.T),
        *(
            covariances_of_given(spans, roots.by_point[..., axes], roots.points)
            for axes in GIVEN_AXES
        ),
    ]


def covariances_of_columns(
    WF: Float[Array, "views 6 n"], ZF: Float[Array, "k n"], trace: Float[Array, ""]
) -> Covariances:
    """Of columns F that all views share."""
    return Covariances(WF @ WF.swapaxes(1, 2), WF @ ZF.T, ZF @ ZF.T, trace)


def covariances_by_view(
    spans: Spans, by_view: Float[Array, "views 2 points 5"]
) -> list[Covariances]:
    """Of the components by view."""
    WF = jnp.einsum("veap,vapc->vec", spans.W, by_view)
    ZF = jnp.einsum("vkap,vapc->vkc", spans.Z, by_view)
    by_component = []
    for columns in BY_VIEW:
        w, z = WF[..., columns], ZF[..., columns]
        wz = jnp.einsum("vec,vkc->vek", w, z)
        trace = jnp.sum(by_view[..., columns] ** 2)
        zz = jnp.einsum("vkc,vlc->kl", z, z)
        by_component.append(Covariances(w @ w.swapaxes(1, 2), wz, zz, trace))
    return by_component


def covariances_along_tracks(
    spans: Spans, is_used: Float[Array, "views points"], K: Float[Array, "views views"]
) -> Covariances:
    """Of errors along tracks, of the correlation K of the views, which is 1 in a view."""
    W, Z = spans.W, spans.Z
    products_of_own = products_of_rows(W, W)
    correlated = jnp.einsum("vw,wkap->vkap", K, Z)
    wz, zz = jnp.einsum("veap,vkap->vek", W, correlated), jnp.einsum("vkap,vlap->kl", Z, correlated)
    return Covariances(products_of_own, wz, zz, 2 * is_used.sum())


def covariances_of_given(
    spans: Spans, by_point: Float[Array, "views 2 points axes"], root: Float[Array, "points points"]
) -> Covariances:
    """Of errors of given points along some axes with a root of their correlation."""
    W, Z = spans.W, spans.Z
    WG = jnp.einsum("veap,vapd->vedp", W, by_point) @ root
    ZG = jnp.einsum("vkap,vapd->kdp", Z, by_point) @ root
    WG, ZG = WG.reshape(*W.shape[:2], -1), ZG.reshape(Z.shape[1], -1)
    return covariances_of_columns(WG, ZG, jnp.sum(by_point**2))


def covariance_of_interior(spans: Spans, c: Covariances) -> Float[Array, "k k"]:
    """The covariance of the interior orientation, R⁻ᵀ·ZVZᵀ·R⁻¹."""
    solve_transposed = lambda b: jax.scipy.linalg.solve_triangular(spans.R.T, b, lower=False)
    return solve_transposed(solve_transposed(c.zz).T)


def variances_of_poses(
    spans: Spans, slopes: Float[Array, "views 6 6"], c: Covariances
) -> Float[Array, "views 6"]:
    """The variances of X0, Y0, Z0, ω, φ, κ of the views."""
    # W·F·ξ − W·Jᵢ·x = (W − B·Z)·F·ξ
    transposed = jax.scipy.linalg.solve_triangular(spans.R, spans.WJ.swapaxes(1, 2), lower=True)
    B = transposed.swapaxes(1, 2)
    mixed = c.wz @ B.swapaxes(1, 2)
    C = c.ww - mixed - mixed.swapaxes(1, 2) + B @ c.zz @ B.swapaxes(1, 2)
    # slopes·L⁻ᵀ
    S = jax.scipy.linalg.solve_triangular(spans.L, slopes.swapaxes(1, 2), lower=True)
    return jnp.einsum("vec,vef,vfc->vc", S, C, S)
