"""Error components (random effects): how large errors are that observations share, and the
covariance they give.

Residuals of real measurements are not white: they hold a field fixed on the sensor, a principal
point that moves between photographs, errors along a track. In units of the a priori σ

    Σ = Σ_k θ_k·V_k,   V_k = F_k·F_kᵀ,   θ_k ≥ 0,   V_0 = 1 (independent errors)

The unknowns stay those of least squares; their covariance is that of x = N⁻¹Aᵀe with e of Σ,

    C = Σ_k θ_k·X_k·X_kᵀ,   X_k = N⁻¹AᵀF_k      (θ_0·Q for the independent part)

The sizes follow from the residuals v = M·e, M = 1 − A·N⁻¹·Aᵀ, whose quadratic forms have the
expectations (MINQUE: Rao 1971; Koch 1999, section 3.6)

    q_k = vᵀV_k·v = Σ_j θ_j·T_kj,      T_kj = tr(M·V_k·M·V_j) = ‖F_kᵀ·M·F_j‖²

with M² = M: T_00 is the redundancy. How the θ ≥ 0 follow from them, and which are left out because
chance could explain them: `estimated_sizes`.

These traces, and covariances, are exact (`error_products`) where at most one component has many
columns, and observations that share its errors touch the same eliminated row, as along a track.
Else roots of many columns are replaced by random combinations of them, F·Ξ/√R with E ΞΞᵀ = R·1, on
one side of a trace (Hutchinson 1990). Observations that are said to have their own σ (`OTHERS`:
control, priors beside image points) are independent errors of the size σ0, whatever that of the
others is.

Sizes are estimates: what that does to covariances is `estimated_sizes`' (`ErrorModel.widening`).

Alternatives that did not help: effects as unknowns with priors give honest σ too, but estimates in
two halves of a real network agree no better; neither do they with whitening. Covariances clustered
by image or point (White 1980; Bell and McCaffrey 2002) miss the errors: unknowns of an image absorb
what its residuals should show.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.leastsquares.indexing.rows import (
    Values,
)
from jaxbundle.leastsquares.quality.distributions import level_of_one, normal_quantile
from jaxbundle.leastsquares.quality.error_effects import AT_ONCE, effects, remove_fit, stack_rows
from jaxbundle.leastsquares.quality.error_products import ErrorProducts, error_products
from jaxbundle.leastsquares.quality.estimated_sizes import (
    SizeEquations,
    inverse_of_traces,
    raise_to_independent,
    widening,
)
from jaxbundle.leastsquares.quality.size_traces import Traces
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.types import not_none


class ErrorComponent(NamedTuple):
    """One V = F·Fᵀ: `root`: F as a sparse matrix [rows, columns], rows of all observations in
    units of their a priori σ, set by set (`stack_rows`); a column is the effect of an error of one
    `unit`. With `mixing` [b, c], F is the root with every b of its columns replaced by c
    combinations of them: splines of all scales by the finest, of which each row has few."""

    name: str
    unit: str
    root: Any
    mixing: Float[np.ndarray, "b c"] | None = None

    @property
    def columns(self) -> int:
        """The number of columns of F."""
        number = self.root.shape[1]
        if self.mixing is None:
            return number
        return number // len(self.mixing) * self.mixing.shape[1]

    def products(self, x: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "columns n"]:
        """Fᵀ·x."""
        products = np.asarray(self.root.T @ x)
        if self.mixing is None:
            return products
        of_blocks = products.reshape(-1, len(self.mixing), x.shape[1])
        return (self.mixing.T @ of_blocks).reshape(-1, x.shape[1])

    def combine(self, z: Float[np.ndarray, "columns n"]) -> Float[np.ndarray, "rows n"]:
        """F·z."""
        if self.mixing is not None:
            of_blocks = z.reshape(-1, self.mixing.shape[1], z.shape[1])
            z = (self.mixing @ of_blocks).reshape(-1, z.shape[1])
        return np.asarray(self.root @ z)

    def sparse_root(self) -> Any:
        """F."""
        import scipy.sparse as sp

        root = self.root.tocsr()
        if self.mixing is None:
            return root
        blocks = root.shape[1] // len(self.mixing)
        return (root @ sp.kron(sp.identity(blocks), sp.csr_matrix(self.mixing))).tocsr()


# The unit of components in that of image coordinates.
IMAGE = "image"
# The name of a component whose size is not estimated: independent errors of some rows, σ0 times
# their a priori σ; its θ is added to that of all independent errors.
OTHERS = "other observations"
# That of the independent part, in units of the a priori σ.
INDEPENDENT = "independent errors"


class ErrorSize(NamedTuple):
    """The estimated size of a component, √θ, and its σ, in its unit; `score`: how far its quadratic
    form exceeds that of independent errors, in units of its σ (standard normal without it)."""

    name: str
    unit: str
    size: float
    sigma: float
    score: float

    def to_dict(self, image_unit: str) -> dict[str, str | float]:
        """As in JSON: `sigma` is the size, the standard deviation of the effect of the component
        on an observation; `sigma_of_sigma` that of the estimate."""
        unit = image_unit if self.unit == IMAGE else self.unit
        return {
            "name": self.name,
            "sigma": self.size,
            "unit": unit,
            "score": self.score,
            "sigma_of_sigma": self.sigma,
        }


@dataclasses.dataclass(frozen=True)
class ErrorSettings:
    """How components are estimated.

    - `max_columns`: roots of more columns are those of many (`error_products`), whose products with
      each other, of 8 MB for these, are not formed.
    - `max_clusters`: object points, or other eliminated rows, from which the skewness and the
      uncertainty of sizes of such a component are, right to √(2/100) = 14 %; from ten times as
      many are its traces with the others, right to 1 %.
    - `significance`: a component is left out if its size could be chance (one-sided, at this level
      for all components together). θ ≥ 0 makes chance add to σ, never take from them: 18 % to those
      of the stations of twelve photographs with independent errors if all θ > 0 are taken, 10 % at
      this level for each of them, 3 % for all together.
    - `draws`: number of random combinations of the columns of a component of many that has no
      blocks. Variances from 100 are right to √(2/100) = 14 %, σ to 7 %.
    - `seed`: of the combinations.
    """

    max_columns: int = 1000
    max_clusters: int = 100
    significance: float = 0.05
    draws: int = 100
    seed: int = 0

    def critical(self, components: int) -> float:
        """The quantile of the normal distribution that a θ must exceed, in its σ."""
        return normal_quantile(1 - level_of_one(self.significance, components))


DEFAULTS = ErrorSettings()


@dataclasses.dataclass(frozen=True)
class IndependentErrors:
    """The classical covariance of a solved problem: independent observations with σ times one
    factor, of which `variance` is the square. It answers what an `ErrorModel` answers."""

    solution: Solution
    variance: float

    def covariance(self, table: str) -> Float[np.ndarray, "rows width width"]:
        """The covariance blocks of all rows of a table."""
        return self.variance * np.asarray(self.solution.cofactor(table))

    def propagate_rows(
        self, rows: Mapping[str, Float[np.ndarray, "n rows width"]]
    ) -> Float[np.ndarray, "n n"]:
        """The covariance of linear functions of the changes of tables (`Solution.jacobian_of`)."""
        return self.variance * self.solution.propagate_rows(rows)

    def propagate(self, function: Callable[[Values], Array]) -> Float[np.ndarray, "n n"]:
        """The covariance of a differentiable function (`Values` → [n]) of the unknowns."""
        return self.variance * self.solution.propagate(function)

    def joint_covariance(
        self, table: str, rows: Sequence[int]
    ) -> Float[np.ndarray, "n width n width"]:
        """The covariance of some rows of a table among each other."""
        return self.variance * self.solution.joint_cofactors(table, rows)


@dataclasses.dataclass(frozen=True)
class ErrorModel:
    """The covariance of the observations of a solved problem. `theta` [k]: of the independent part
    and of the `components`, with their covariance; `own`: by table the blocks [rows, width, width]
    of the covariance of the unknowns that a component of θ = 1 gives, in the order of `components`
    (of the eliminated table only where θ is not zero);
    `equations` of the θ, None where they are stated; `widened`: by `widening`, as all covariances
    that are stated, or as estimated."""

    solution: Solution
    components: tuple[ErrorComponent, ...]
    theta: Float[np.ndarray, " k"]
    theta_covariance: Float[np.ndarray, "k k"]
    score: Float[np.ndarray, " k"]
    own: tuple[dict[str, Float[np.ndarray, "rows width width"]], ...]
    equations: SizeEquations | None = None
    widened: bool = True

    @property
    def theta_sigma(self) -> Float[np.ndarray, " k"]:
        """σ of the θ."""
        return np.sqrt(np.diag(self.theta_covariance))

    @functools.cached_property
    def widening(self) -> Float[np.ndarray, " k"]:
        """What the θ are multiplied by in covariances, because they are estimates; 1 if sizes are
        stated."""
        if not self.widened or self.equations is None:
            return np.ones(len(self.theta))
        T = self.equations.reduced[0]
        forms = T @ self.theta_covariance[: len(T), : len(T)] @ T
        return widening(self.theta, T, forms, self._parts_of_tables())

    @property
    def as_estimated(self) -> "ErrorModel":
        """The model without `widening`, for budgets, which state degrees of freedom themselves."""
        return dataclasses.replace(self, widened=False)

    def _parts_of_tables(self) -> Iterator[Float[np.ndarray, "k unknowns"]]:
        """The variances that every θ = 1 gives the unknowns of the tables not eliminated."""
        for table in self.own[0]:
            if table == self.solution.problem.plan.eliminated:
                continue
            blocks = [self.solution.cofactor(table), *(own.get(table) for own in self.own)]
            zeros = np.zeros_like(np.asarray(blocks[0]))
            parts = [zeros if block is None else np.asarray(block) for block in blocks]
            yield np.stack([np.diagonal(part, axis1=1, axis2=2).ravel() for part in parts])

    @property
    def sizes(self) -> tuple[ErrorSize, ...]:
        """√θ of the independent part, as a factor of the a priori σ, and of all components."""
        names = [(INDEPENDENT, "σ"), *((c.name, c.unit) for c in self.components)]
        names = [key for key in names if key[0] != OTHERS]
        # σ of √θ: σ_θ/(2√θ), but at most √σ_θ, its value at θ = 0
        theta, sigma_of_theta = (x[: len(names)] for x in (self.theta, self.theta_sigma))
        root, largest_sigma = np.sqrt(theta), np.sqrt(sigma_of_theta)
        sigma = np.minimum(sigma_of_theta, 2 * root * largest_sigma) / np.where(
            root > 0, 2 * root, 1.0
        )
        sigma = np.where(root > 0, sigma, largest_sigma)
        return tuple(
            ErrorSize(name, unit, float(s), float(d), float(z))
            for (name, unit), s, d, z in zip(names, root, sigma, self.score)
        )

    @property
    def widened_sizes(self) -> dict[str, float]:
        """The sizes that covariances are of, by name, as a design takes them."""
        factor = np.sqrt(self.widening)
        return {size.name: float(k * size.size) for k, size in zip(factor, self.sizes)}

    def covariance(self, table: str) -> Float[np.ndarray, "rows width width"]:
        """The covariance blocks of all rows of a table."""
        theta = self.widening * self.theta
        blocks = theta[0] * np.asarray(self.solution.cofactor(table))
        return blocks + sum(
            t * blocks_of_theta[table] for t, blocks_of_theta in zip(theta[1:], self.own) if t != 0
        )

    def propagate_rows(
        self, rows: Mapping[str, Float[np.ndarray, "n rows width"]]
    ) -> Float[np.ndarray, "n n"]:
        """The covariance of linear functions of the changes of tables (`Solution.jacobian_of`)."""
        return self.of_effects(effects(self.solution, rows))

    def propagate(self, function: Callable[[Values], Array]) -> Float[np.ndarray, "n n"]:
        """The covariance of a differentiable function (`Values` → [n]) of the unknowns."""
        slopes = self.solution.jacobian_of(function)
        return self.propagate_rows({table: np.asarray(x) for table, x in slopes.items()})

    def joint_covariance(
        self, table: str, rows: Sequence[int]
    ) -> Float[np.ndarray, "n width n width"]:
        """The covariance of some rows of a table among each other."""
        declared_table = self.solution.problem.table(table)
        width, number = declared_table.space.width, len(rows) * declared_table.space.width
        unit_rows = np.zeros((number, declared_table.rows, width))
        unit_rows[
            np.arange(number), np.repeat(rows, width), np.tile(np.arange(width), len(rows))
        ] = 1.0
        return self.propagate_rows({table: unit_rows}).reshape(len(rows), width, len(rows), width)

    def draw(
        self, number: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n rows"], Float[np.ndarray, "n k"]]:
        """Normal errors of all rows with this covariance, and the θ that would be estimated from
        the residuals they leave."""
        size = len(stack_rows(self.solution, self.solution.residuals))
        _, independent = _independent_part(self.components, self.theta, size)
        errors = np.sqrt(independent) * rng.standard_normal((number, size))
        for t, component in zip(self.theta[1:], self.components):
            if t > 0 and component.name != OTHERS:
                z = rng.standard_normal((component.columns, number))
                errors += np.sqrt(t) * component.combine(z).T
        forms = quadratic_forms(self.components, remove_fit(self.solution, errors)[0])
        return errors, np.array([not_none(self.equations).solve(q)[0] for q in forms])

    def covariances_of_residuals(self, rows: Int[np.ndarray, "n k"]) -> Float[np.ndarray, "n k k"]:
        """The covariance M·Σ·M of the residuals of groups of rows (`first_rows`), in units of their
        a priori σ."""
        size = len(stack_rows(self.solution, self.solution.residuals))
        (n, k), blocks = rows.shape, np.zeros((*rows.shape, rows.shape[1]))
        # So many columns have 80 MB for 100 000 rows.
        at_once = max(100 // k, 1)
        for begin in range(0, n, at_once):
            some = rows[begin : begin + at_once]
            unit = np.zeros((some.size, size))
            unit[np.arange(some.size), some.ravel()] = 1.0
            C = self.of_effects(remove_fit(self.solution, unit)[0]).reshape(
                len(some), k, len(some), k
            )
            number = np.arange(len(some))
            blocks[begin : begin + at_once] = C[number, :, number]
        return blocks

    def of_effects(self, D: Float[np.ndarray, "n rows"]) -> Float[np.ndarray, "n n"]:
        """The covariance D·Σ·Dᵀ of linear functions D of the errors, in units of their σ."""
        theta = self.widening * self.theta
        C = theta[0] * D @ D.T
        for t, component in zip(theta[1:], self.components):
            if t != 0:
                C = C + t * _of_component(component, D)
        return C

    def parts_of(self, D: Float[np.ndarray, "n rows"]) -> Float[np.ndarray, "k n n"]:
        """D·V_k·Dᵀ of the independent part and of every component."""
        return np.stack([D @ D.T, *(_of_component(c, D) for c in self.components)])


def _of_component(
    component: ErrorComponent, D: Float[np.ndarray, "n rows"]
) -> Float[np.ndarray, "n n"]:
    """D·V·Dᵀ of V = F·Fᵀ."""
    B = component.products(D.T)
    return B.T @ B


# What gives the covariance of functions of the unknowns.
Errors = ErrorModel | IndependentErrors


def fit_error_model(
    solution: Solution, components: Sequence[ErrorComponent], settings: ErrorSettings = DEFAULTS
) -> ErrorModel:
    """The sizes of components from the residuals of a solution; `OTHERS` comes last."""
    v = stack_rows(solution, solution.residuals)
    products = products_of(solution, components, settings)
    rng = np.random.default_rng(settings.seed)
    if products is None:
        F = [component.sparse_root() for component in components]
        T, cubes, blocks_by_theta = _traces(solution, F, settings, rng)
    else:
        traces = products.traces(settings.max_clusters, rng)
        T, cubes = traces.T, traces.cubes
    has_others = _has_others(components)
    critical = settings.critical(len(components) - has_others)
    system = SizeEquations(T, has_others, critical, cubes)
    theta, score = system.solve(quadratic_forms(components, v))
    if products is None:
        is_other, independent = _independent_part(components, theta, len(v))
        F = F[: len(F) - has_others]
        estimated = theta[: len(F) + 1]
        forms = _covariance_of_forms(solution, F, estimated, independent, is_other, rng)
    else:
        blocks_by_theta = products.blocks(theta)
        # V_0 without the given rows
        _, part = system.reduced
        forms = traces.covariance_of_forms(theta)
        if has_others:
            part = np.eye(len(theta))
            part[-1, 0] = -1.0
            forms = (part.T @ forms @ part)[:-1, :-1]
    T_of_estimated, _ = system.reduced
    # The forms are from some of the clusters, or from drawn errors: their own errors could leave a
    # negative variance. Σ ⪰ least·1; the θ of `OTHERS`, added to that of all, may be negative.
    least = theta[0] + min(theta[-1], 0.0) if has_others else theta[0]
    forms = raise_to_independent(forms, T_of_estimated, max(least, 0.0))
    inverse = inverse_of_traces(T_of_estimated)
    covariance = inverse @ forms @ inverse
    if has_others:
        # θ of the given rows is σ0² − θ_0, so that their sum is σ0² whatever θ_0 is
        onto = np.concatenate([np.eye(len(covariance)), -np.eye(len(covariance))[:1]])
        covariance = onto @ covariance @ onto.T
    return ErrorModel(
        solution, tuple(components), theta, covariance, score, tuple(blocks_by_theta), system
    )


def _traces(
    solution: Solution, F: Sequence[Any], settings: ErrorSettings, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k k"], list[dict[str, np.ndarray]]]:
    """T of the independent part and of roots F; tr(M·V_i·M·V_j·M·V_l), which their skewness is
    from; by root the covariance blocks that it gives. The cubes of two different roots of many
    columns are left at zero: sums of so many squares are nearly normal."""
    traces = Traces(F, solution.problem.counts.redundancy)
    blocks_by_theta: list[dict[str, np.ndarray]] = [{} for _ in F]
    exact = [root.shape[1] <= settings.max_columns for root in F]
    # Cubes of random combinations need the products of the others.
    for k in sorted(range(len(F)), key=lambda k: not exact[k]):
        for n, columns in enumerate(_columns(F[k], settings, rng)):
            remaining, changes = remove_fit(solution, columns)
            products = traces.add(k, columns, remaining, exact[k])
            _add_squares(blocks_by_theta[k], changes)
            if not exact[k] and n == 0:
                remaining_again, _ = remove_fit(solution, np.asarray((F[k] @ products).T))
                traces.add_cubes(k, remaining, remaining_again, settings.draws / len(columns))
    return *traces.of_all(), blocks_by_theta


def stated_error_model(
    solution: Solution,
    components: Sequence[ErrorComponent],
    theta: Float[np.ndarray, " k"],
    settings: ErrorSettings = DEFAULTS,
) -> ErrorModel:
    """The error model of components of known sizes, such as those of a camera from earlier jobs, in
    a solution or a design; `theta`: of the independent part and of the components."""
    rng, blocks_by_theta = np.random.default_rng(settings.seed), []
    products = products_of(solution, components, settings)
    if products is not None:
        blocks_by_theta = products.blocks(theta)
    else:
        for t, component in zip(theta[1:], components):
            blocks: dict[str, np.ndarray] = {}
            root = component.sparse_root()
            for columns in _columns(root, settings, rng) if t != 0 else ():
                _add_squares(blocks, remove_fit(solution, columns)[1])
            blocks_by_theta.append(blocks)
    zeros = np.zeros(len(theta))
    return ErrorModel(
        solution, tuple(components), theta, np.diag(zeros), zeros, tuple(blocks_by_theta)
    )


def products_of(
    solution: Solution, components: Sequence[ErrorComponent], settings: ErrorSettings
) -> ErrorProducts | None:
    """The products of the roots of components with M; None if they cannot be had exactly."""
    roots = [(component.root.tocsr(), component.mixing) for component in components]
    return error_products(solution, roots, settings.max_columns)


def _add_squares(blocks: dict[str, np.ndarray], changes: Mapping[str, np.ndarray]) -> None:
    """Add the blocks of X·Xᵀ of some columns of X."""
    for table, x in changes.items():
        squares = np.einsum("cni,cnj->nij", x, x)
        blocks[table] = blocks[table] + squares if table in blocks else squares


def _has_others(components: Sequence[ErrorComponent]) -> bool:
    return bool(components) and components[-1].name == OTHERS


def _independent_part(
    components: Sequence[ErrorComponent], theta: Float[np.ndarray, " k"], size: int
) -> tuple[Bool[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """Which rows are those of `OTHERS`; the variances of the independent errors of all rows."""
    is_other = np.zeros(size, bool)
    if _has_others(components):
        is_other[components[-1].root.nonzero()[0]] = True
    return is_other, np.where(is_other, theta[0] + theta[-1], theta[0])


def quadratic_forms(
    components: Sequence[ErrorComponent], v: Float[np.ndarray, "*draws rows"]
) -> Float[np.ndarray, "*draws k"]:
    """q of residuals v: vᵀv, and vᵀV_k·v of the components."""
    form_of = lambda component: np.sum(component.products(np.atleast_2d(v).T) ** 2, 0).reshape(
        v.shape[:-1]
    )
    return np.stack([np.sum(v**2, -1), *map(form_of, components)], -1)


def _columns(
    root: Any, settings: ErrorSettings, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "columns rows"]]:
    """The columns of a root, or random combinations of them, some at a time."""
    number = root.shape[1]
    exact = number <= settings.max_columns
    total = number if exact else settings.draws
    root = root.tocsc()
    for begin in range(0, total, AT_ONCE):
        end = min(begin + AT_ONCE, total)
        if exact:
            yield root[:, begin:end].toarray().T
        else:
            signs = rng.choice([-1.0, 1.0], (number, end - begin))
            yield np.asarray(root @ signs).T / np.sqrt(total)


def _covariance_of_forms(
    solution: Solution,
    F: Sequence[Any],
    theta: Float[np.ndarray, " k"],
    independent: Float[np.ndarray, " rows"],
    is_other: Bool[np.ndarray, " rows"],
    rng: np.random.Generator,
    draws: int = AT_ONCE,
) -> Float[np.ndarray, "k k"]:
    """cov(q)_ij = 2·tr(V_i·MΣM·V_j·MΣM) of normal errors of the fitted Σ, by residuals drawn from
    it; `independent`: variances of the rows; `is_other`: which rows are those of `OTHERS`. From 16
    draws σ of a size is right to about 1/√32 = 18 %."""
    of_components = [lambda e, f=f: np.asarray((f @ (f.T @ e.T)).T) for f in F]
    of_parts = [lambda e: e * ~is_other, *of_components]
    parts = list(zip(theta[1:], of_components))
    sigma = lambda e: independent * e + sum(t * V(e) for t, V in parts if t > 0)
    errors = np.sqrt(independent) * rng.standard_normal((draws, len(is_other)))
    for t, f in zip(theta[1:], F):
        if t > 0:
            errors += np.sqrt(t) * np.asarray((f @ rng.standard_normal((f.shape[1], draws))).T)
    u, _ = remove_fit(solution, errors)
    b = [remove_fit(solution, V(u))[0] for V in of_parts]
    Sb = [sigma(x) for x in b]
    G = np.array([[np.sum(x * y) / draws for y in Sb] for x in b])
    # Twice the symmetric part: the factor 2 of the covariance.
    return G + G.T
