"""Random least-squares problems, and their solution by dense algebra.

An observation touches up to four rows of up to six tables. With coefficients c [r, width] of each

    z = Σ c·x,    v = z + ε·z²/2 − y        ∂v/∂x = (1 + ε·z)·c

so that the dense Jacobian is a line of numpy, independent of the package. Problems that may float
have coefficients that add up to zero: a common shift of all tables changes nothing.

What varies: the number, widths and free columns of tables; rows that always meet, repeat, cross
or are held; the eliminated table; few observations or enough to be computed in chunks; σ of every
form and covariances; the reduced system; the datum.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxbundle import leastsquares as ls

CURVATURE = 0.05
LARGE = 2400
"""Observations of a kind that is computed in chunks (`PlanningSettings.small_part`)."""


@dataclasses.dataclass(frozen=True)
class Mixture:
    """The residuals of one observation; equal for all kinds, so that they share programs."""

    def __call__(self, *given):
        *blocks, measured = given
        z = sum(c @ jnp.atleast_1d(x) for c, x in zip(measured["c"].values(), blocks))
        return z + CURVATURE * z**2 / 2 - measured["y"]


@dataclasses.dataclass
class Random:
    """A random problem: arguments of `leastsquares.adjust`, and whether it may float."""

    tables: list
    observations: list
    options: dict
    floats: bool

    def adjust(self, **options) -> ls.Result:
        return ls.adjust(self.tables, self.observations, **self.options | options)


@dataclasses.dataclass(frozen=True)
class Shift:
    """The action of a common shift on one row."""

    def __call__(self, motion, value):
        return value + (motion if value.ndim else motion[0])


def make_random(seed: int, variant: int = 0) -> Random:
    """The problem of a seed, determined except for a common shift of all tables. Its variants have
    the same declarations in another order of rows, with other coefficients and weights."""
    for attempt in range(100):
        structure = np.random.default_rng((seed, attempt))
        problem = _draw(structure, np.random.default_rng((seed, attempt, variant)))
        dense = Dense(problem)
        if dense.rank == dense.unknowns - dense.defect and dense.redundancy > 0:
            return problem
    raise AssertionError(f"no determined problem for seed {seed}")


def _draw(rng, values) -> Random:
    """`rng` draws declarations, `values` numbers and the order of rows."""
    floats = rng.random() < 0.3
    width = int(rng.integers(0, 3))  # of all tables that float together
    size = int(rng.integers(3, 7))
    orders = {n: values.permutation(n) for n in range(1, 12)}
    tables = []
    for t in range(rng.integers(2, 7)):
        # Most tables have the same number of rows, so that their rows can meet or cross.
        rows = size if rng.random() < 0.6 or t < 2 else int(rng.integers(2, 9))
        w = width if floats else int(rng.integers(0, 4))
        value = values.normal(size=(rows, w) if w else rows)
        free = np.ones((rows, max(w, 1)))
        held = rng.random()
        if held < 0.25:
            free[rng.random(rows) < 0.4] = 0.0
        elif held < 0.4:
            free = (rng.random(free.shape) < 0.7).astype(float)
        elif held < 0.5 and t > 2:
            free[:] = 0.0
        name = "abcdefghi"[rng.integers(0, 9)] + str(t)
        tables.append(ls.Table(name, value, free=free[np.argsort(orders[rows])]))
    eliminate = tables[2] if len(tables) > 2 and tables[2].free.any() else tables[0]
    large, meeting = rng.random() < 0.2, len(tables) > 2 and rng.random() < 0.5
    observations = []
    for k in range(rng.integers(2, 5)):
        touched = [tables[i] for i in rng.integers(0, len(tables), rng.integers(2, 5))]
        if meeting:  # The first two meet always where the third is eliminated.
            others = [t for t in touched if t not in (*tables[:2], eliminate)]
            touched = [*tables[:2], eliminate, *others] if k % 2 else [*tables[:2], *others]
        if rng.random() < 0.2 and not floats:
            touched = touched[:1]
        always = meeting and k % 2
        number = LARGE if large and k == 1 else int(rng.integers(2, 6)) * 6
        observations.append(
            _observe(rng, values, f"kind {k}", touched, size, floats, number, always, orders)
        )
    if not floats:
        observations += [_prior(values, t) for t in tables if rng.random() < 0.7]
    observations = [observations[k] for k in rng.permutation(len(observations))]
    names = [t.name for t in tables if t.free.any()]
    chosen = eliminate.name if meeting or rng.random() < 0.5 else str(rng.choice(names))
    options: dict = {"eliminate": chosen if meeting or rng.random() < 0.75 else None}
    reduction = rng.random()
    if reduction < 0.3:
        options["reduction"] = "banded" if reduction < 0.15 else "iterative"
    if floats:
        actions = tuple((t.name, Shift()) for t in tables)
        names = tuple(f"shift {i}" for i in range(max(width, 1)))
        options["motions"] = ls.Motions(names, actions)
        options["datum"] = str(rng.choice(["inner", "minimal"]))
    return Random(tables, observations, options, floats)


def _observe(rng, values, name, touched, size, floats, n, meet, orders) -> ls.ObservationSet:
    """Observations of up to five rows; values follow from the present rows and noise. `meet`: the
    first two slots have the same row."""
    residuals = int(rng.integers(1, 4))
    common = np.arange(n) % size if rng.random() < 0.5 else rng.integers(0, size, n)
    rows = []
    for slot, table in enumerate(touched):
        how = rng.random()
        column = (
            common if how < 0.45 or (meet and slot < 2)
            else common + 1 if how < 0.65
            else np.zeros(n, int) if how < 0.7
            else rng.integers(0, table.rows, n)
        )  # fmt: skip
        rows.append(orders[table.rows][column % table.rows])
    c = [values.normal(size=(n, residuals, t.space.width)) for t in touched]
    if floats:
        mean = sum(c) / len(touched)
        c = [x - mean for x in c]
    z = sum(_times(x, t, r) for x, t, r in zip(c, touched, rows))
    noise, weights = _weights(rng, values, n, residuals)
    y = z + CURVATURE * z**2 / 2 + noise
    kind = ls.Kind(name, Mixture(), of=tuple(t.name for t in touched))
    return kind(rows, {"c": dict(enumerate(c)), "y": y}, **weights)


def _weights(rng, values, n, residuals):
    """Noise, and the arguments that state its size."""
    form, scale = rng.random(), 0.02
    unit = scale * values.normal(size=(n, residuals))
    if form < 0.2:
        root = np.linalg.cholesky(_covariances(values, n, residuals))
        return np.einsum("nij,nj->ni", root, unit), {"covariance": scale**2 * root @ root.mT}
    if form < 0.4:
        return unit, {"sigma": scale}
    sigma = scale * values.uniform(0.5, 2.0, n if form < 0.6 else (n, residuals))
    noise = unit / scale * (sigma if sigma.ndim == 2 else sigma[:, None])
    if form > 0.85:
        sigma[rng.random(sigma.shape) < 0.15] = np.inf
        noise[~np.isfinite(sigma)] = 1.0
    return noise, {"sigma": sigma}


def _covariances(rng, n, residuals):
    root = rng.normal(size=(n, residuals, residuals))
    return root @ root.mT + 0.5 * np.eye(residuals)


def _prior(rng, table) -> ls.ObservationSet:
    w, n = table.space.width, table.rows
    value = table.value if np.ndim(table.value) == 2 else table.value[:, None]
    c = [np.broadcast_to(np.eye(w), (n, w, w))]
    y = value + CURVATURE * value**2 / 2 + 0.1 * rng.normal(size=(n, w))
    kind = ls.Kind(f"prior of {table.name}", Mixture(), of=(table.name,))
    return kind([np.arange(n)], {"c": {0: c[0]}, "y": y}, sigma=0.1)


def _times(c, table, rows, value=None):
    value = np.asarray(table.value if value is None else value)
    value = value if value.ndim == 2 else value[:, None]
    return np.einsum("nrw,nw->nr", c, value[rows])


def _whitening(problem: Random):
    """L⁻¹ [n, r, r] of every set of observations."""
    roots = []
    for o in problem.observations:
        r = np.shape(o.measured["y"])[1]
        if o.covariance is not None:
            roots.append(np.linalg.inv(np.linalg.cholesky(o.covariance)))
            continue
        sigma = np.asarray(o.sigma)[:, None] if np.ndim(o.sigma) == 1 else o.sigma
        roots.append(np.eye(r) / (np.ones((o.number, r)) * sigma)[:, :, None])
    return roots


class Dense:
    """The same problem as one dense matrix over all unknowns."""

    def __init__(self, problem: Random, values=None, roots=None):
        self.problem = problem
        tables = problem.tables
        given = {t.name: t.value for t in tables} if values is None else values
        self.values = {t.name: np.array(given[t.name], float) for t in tables}
        ends = np.cumsum([t.free.size for t in tables])
        self.first = {t.name: int(end) - t.free.size for t, end in zip(tables, ends)}
        self.free = np.flatnonzero(np.concatenate([t.free.ravel() for t in tables]))
        self.defect = 0
        if problem.floats and self.free.size:
            width = tables[0].space.width
            everywhere = np.concatenate([np.tile(np.eye(width), (t.rows, 1)) for t in tables])
            held = np.delete(everywhere, self.free, 0)
            # A direction of the shift is open if no held unknown moves along it.
            open_ = ~held.any(0)
            self.defect, self.gauge = int(open_.sum()), everywhere[self.free][:, open_]
        self.root = _whitening(problem) if roots is None else roots
        self.used = [np.diagonal(root, axis1=1, axis2=2) for root in self.root]
        self.linearise()
        self.rank = np.linalg.matrix_rank(self.J, tol=1e-7 * np.linalg.norm(self.J, 2))
        self.unknowns = len(self.free)
        self.observations = int((np.concatenate([w.ravel() for w in self.used]) > 0).sum())
        self.redundancy = self.observations + self.defect - self.unknowns

    def linearise(self):
        """v/σ, and the dense Jacobian J of all unknowns that are free."""
        self.v, J = [], []
        width = sum(t.free.size for t in self.problem.tables)
        for o, root in zip(self.problem.observations, self.root):
            tables = [next(t for t in self.problem.tables if t.name == n) for n in o.kind.of]
            c = [np.asarray(x) for x in o.measured["c"].values()]
            terms = zip(c, tables, o.rows)
            z = sum(_times(x, t, r, self.values[t.name]) for x, t, r in terms)
            v = z + CURVATURE * z**2 / 2 - o.measured["y"]
            full = np.zeros((*v.shape, width))
            at = np.arange(o.number)[:, None]
            for x, t, rows in zip(c, tables, o.rows):
                w = t.space.width
                columns = self.first[t.name] + rows[:, None] * w + np.arange(w)
                for i in range(v.shape[1]):
                    np.add.at(full, (at, i, columns), (1 + CURVATURE * z[:, i : i + 1]) * x[:, i])
            self.v.append(np.einsum("nij,nj->ni", root, v))
            J.append(np.einsum("nij,nju->niu", root, full)[..., self.free])
        self.J = np.concatenate([x.reshape(-1, len(self.free)) for x in J])
        self.by_set = J
        self.r = np.concatenate([v.ravel() for v in self.v])

    def solve(self, tolerance=1e-12) -> "Dense":
        """Gauss–Newton from here to the last digits, with the smallest change of the unknowns where
        the datum is open."""
        for _ in range(50):
            step = -np.linalg.lstsq(self.J, self.r, rcond=1e-10)[0]
            self.add(step)
            self.linearise()
            if np.abs(step).max(initial=0) < tolerance:
                return self
        raise AssertionError("the dense solution did not converge")

    def add(self, step):
        everything = np.concatenate([x.ravel() for x in self.values.values()])
        everything[self.free] += step
        cuts = np.cumsum([x.size for x in self.values.values()])[:-1]
        for (name, x), part in zip(self.values.items(), np.split(everything, cuts)):
            self.values[name] = part.reshape(x.shape)

    def vector(self, values=None):
        """The free unknowns."""
        values = self.values if values is None else values
        return np.concatenate([np.ravel(values[t.name]) for t in self.problem.tables])[self.free]

    @property
    def cofactors(self):
        """Q of the unknowns with inner constraints on all of them where the datum is open."""
        return np.linalg.pinv(self.J.T @ self.J, rcond=1e-12, hermitian=True)

    @property
    def projection(self):
        """Takes the open shift out of the unknowns: what remains does not depend on the datum."""
        identity = np.eye(len(self.free))
        if not self.defect:
            return identity
        q = np.linalg.qr(self.gauge)[0]
        return identity - q @ q.T

    def estimable(self, x):
        return self.projection @ x
