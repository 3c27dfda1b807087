"""T of the components of shared errors of a camera, T_kj = ‖F_kᵀ·M·F_j‖², and the traces of three.

Of the field and of the columns by view the products are formed. Errors along tracks and of given
points, of which a camera has thousands of columns, are represented by random combinations of them
(`SumSettings`).
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings
from jaxbundle.batches.error_covariances import OntoSpans, covariances, onto_spans
from jaxbundle.batches.error_roots import GIVEN_AXES
from jaxbundle.batches.error_spans import (
    BY_VIEW,
    COMPONENTS,
    FIELD,
    GIVEN,
    TRACKS,
    Roots,
    Spans,
    in_single_precision,
)


@dataclasses.dataclass(frozen=True)
class SumSettings:
    """How many random numbers and cameras sums are from that would take too long exactly.

    **Fields:**

    - `probes`: random combinations of the columns of errors along tracks, and of given points: of
      matrices of rank r their sums of squares are right to √(2/(16·r)), 5 % for r = 50.
    - `cameras` of a batch that sizes common to it are from: those of views from n of them are right
      to 1/√(2n), 2 % for 64 cameras of 20 views.
    - `draws` that the covariance of the forms of a camera is from, right to √(2/16) = 35 %: degrees
      of freedom, which it is for, need no more.
    """

    probes: int = 16
    cameras: int = 64
    draws: int = 16


SUMS = SumSettings()


class ComponentTraces(NamedTuple):
    """T [k, k] of the components of a camera, and the traces of three of them
    (`leastsquares.quality.size_traces`); zero where they are not wanted."""

    T: Float[np.ndarray, "*cameras k k"]
    cubes: Float[np.ndarray, "*cameras k k k"]


class FewColumns(NamedTuple):
    """S = FᵀM·F of the field and of the columns by view, by blocks."""

    field: Float[Array, "n n"]
    mixed: Float[Array, "m n"]
    by_view: Float[Array, "m m"]

    @staticmethod
    def from_roots(roots: Roots, projected: OntoSpans) -> "FewColumns":
        WB, ZB, WF, ZF = projected
        views, columns = WF.shape[0], WF.shape[2]
        field = jax.scipy.linalg.block_diag(roots.gram, roots.gram)
        field = field - jnp.einsum("ves,vet->st", WB, WB) - ZB.T @ ZB
        mixed = (
            jnp.einsum("vsp,vapc->vacs", roots.splines, in_single_precision(roots.by_view))
            @ roots.octaves
        )
        mixed = mixed.swapaxes(1, 2).reshape(views, columns, -1)
        mixed = mixed - jnp.einsum("ves,vec->vcs", WB, WF) - jnp.einsum("ks,vkc->vcs", ZB, ZF)
        products_of_own = jnp.einsum("vapc,vapd->vcd", roots.by_view, roots.by_view)
        products_of_own = products_of_own - jnp.einsum("vec,ved->vcd", WF, WF)
        diagonal = jnp.arange(views)
        by_view = -jnp.einsum("vkc,wkd->vcwd", ZF, ZF)
        by_view = by_view.at[diagonal, :, diagonal, :].add(products_of_own)
        flat = views * columns
        return FewColumns(field, mixed.reshape(flat, -1), by_view.reshape(flat, flat))

    def sums(self, other: "FewColumns") -> Float[Array, "components components"]:
        """Sums of the products of the elements of the blocks of two, by components."""
        of_view = jnp.zeros((5, len(COMPONENTS)))
        for k, columns in enumerate(BY_VIEW, FIELD + 1):
            of_view = of_view.at[columns, k].set(1.0)
        component_of_column = jnp.tile(of_view, (len(self.by_view) // 5, 1))
        sums = component_of_column.T @ (self.by_view * other.by_view) @ component_of_column
        with_field = component_of_column.T @ jnp.sum(self.mixed * other.mixed, 1)
        sums = sums.at[FIELD].add(with_field).at[:, FIELD].add(with_field)
        return sums.at[FIELD, FIELD].add(jnp.sum(self.field * other.field))


def random_signs(settings: CorrelationSettings, views: int, points: int) -> tuple[Array, Array]:
    """Random combinations of the columns of errors along tracks and of given points, the same of
    every camera."""
    keys = jax.random.split(jax.random.key(settings.estimation.seed))
    signs = lambda key, *shape: jax.random.rademacher(key, (SUMS.probes, *shape), dtype=float)
    return signs(keys[0], views, 2, points), signs(keys[1], 3, points)


def traces_of_components(spans: Spans, roots: Roots, signs: tuple[Array, Array]) -> ComponentTraces:
    projected = onto_spans(spans, roots)
    S, count = in_single_precision(FewColumns.from_roots(roots, projected)), len(COMPONENTS)
    T, cubes = S.sums(S), jnp.zeros((count,) * 3)
    # S_ij·S_jk of every j
    through = FewColumns(S.field @ S.field, S.mixed @ S.field, S.mixed @ S.mixed.T)
    cubes = cubes.at[FIELD].set(S.sums(through))
    of_columns = np.arange(len(S.by_view)) % 5
    for k, columns in enumerate(BY_VIEW, FIELD + 1):
        some = np.flatnonzero((of_columns >= columns.start) & (of_columns < columns.stop))
        field, by_view = S.mixed[some], S.by_view[some]
        through = FewColumns(field.T @ field, by_view.T @ field, by_view.T @ by_view)
        cubes = cubes.at[k].set(S.sums(through))
    # Of random combinations of the columns of the others.
    masks = [jnp.zeros((3, 1)).at[axes].set(1.0) for axes in GIVEN_AXES]
    errors = [roots.along_tracks(signs[0]), *(roots.of_points(signs[1] * mask) for mask in masks)]
    remaining = jnp.stack([c.remaining for c in covariances(spans, roots, projected)])
    spans, roots = in_single_precision((spans, roots))
    for k, e in zip(range(TRACKS, count), in_single_precision(errors)):
        u = spans.residuals(e)
        products = roots.products(u)
        traces = roots.forms_of(u, products).mean(0)
        T = T.at[k].set(traces)
        flat = [x.reshape(SUMS.probes, -1) / jnp.sqrt(SUMS.probes) for x in products[:2]]
        pairs = FewColumns(flat[0].T @ flat[0], flat[1].T @ flat[0], flat[1].T @ flat[1])
        cubes = cubes.at[k].set(S.sums(pairs))
        # Half of them again: M·F·(Fᵀ·M·F·ξ).
        half_of_probes = [x[: SUMS.probes // 2] for x in products]
        e = (
            roots.along_tracks(half_of_probes[2])
            if k == TRACKS
            else roots.of_points(half_of_probes[3] * in_single_precision(masks[k - GIVEN]))
        )
        z = spans.residuals(e)
        products_of_probes = [x * y for x, y in zip(roots.products(z), half_of_probes)]
        traces_of_k = (
            jnp.zeros(count).at[k].set(jnp.sum(z**2)).at[FIELD].set(jnp.sum(products_of_probes[0]))
        )
        for j, columns in enumerate(BY_VIEW, FIELD + 1):
            traces_of_k = traces_of_k.at[j].set(jnp.sum(products_of_probes[1][..., columns]))
        cubes = cubes.at[k, k].set(traces_of_k / (SUMS.probes // 2))
    # Of two of them from the combinations of both.
    symmetric = (T[TRACKS:, TRACKS:] + T[TRACKS:, TRACKS:].T) / 2
    T = T.at[:, TRACKS:].set(T[TRACKS:].T).at[TRACKS:, TRACKS:].set(symmetric)
    T = T.astype(float).at[0].set(remaining).at[:, 0].set(remaining)
    parts: list[Any] = [T, cubes.astype(float)]
    return ComponentTraces(*parts)
