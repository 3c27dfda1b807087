"""Unknowns that the points do not determine, in words.

The normal matrix of all observations except the priors of the shared unknowns, reduced to these and
scaled by its diagonal before the elimination of points, has the eigenvalue 1/k for a direction
whose variance is k times that of single unknowns. Eigenvectors of small eigenvalues
are described by their dominant unknowns: pitch bias against position along track.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.problem import with_data
from jaxbundle.leastsquares.quality.names import kept_unknowns, place_of
from jaxbundle.leastsquares.quality.null_space import scaled_system, undetermined_unknowns
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.refinement.declare import DeclaredRefinement
from jaxbundle.refinement.freedom import UnknownName


@dataclasses.dataclass(frozen=True)
class WeaknessSettings:
    """Which directions are reported, and how.

    - `weak_eigenvalue`: of the scaled normal matrix; σ along the direction is 1/√ of it, ten times
      that of single unknowns. Larger: usual correlations are reported too.
    - `null_eigenvalue`: below it the direction is undetermined, and the eigenvalue rounding of
      squares of 1e-16 that were summed over many points.
    - `min_component`: unknowns with at least this fraction of the largest component are named, up
      to `most_named` of them: for the sentence only.
    """

    weak_eigenvalue: float = 1e-2
    null_eigenvalue: float = 1e-10
    min_component: float = 0.15
    most_named: int = 4


DEFAULTS = WeaknessSettings()


class WeakDirection(NamedTuple):
    """A direction: its eigenvalue, unknowns with their components, a sentence for the report."""

    eigenvalue: float
    unknowns: tuple[str, ...]
    sentence: str


def weaknesses(
    declared: DeclaredRefinement, solution: Solution, settings: WeaknessSettings = DEFAULTS
) -> list[WeakDirection]:
    """All weak directions, the weakest first; of the jitter of an axis only the weakest."""
    S, names = _matrix_without_priors(declared, solution)
    if not np.isfinite(S).all():
        # A point that its own observations leave open, so that it could not be eliminated.
        vague = undetermined_unknowns(solution.problem, solution.values)
        sentence = f"the points do not determine {', '.join(vague[: settings.most_named])}"
        return [WeakDirection(0.0, tuple(vague), sentence)]
    values, vectors = np.linalg.eigh(S)
    weak, jitter = [], set()  # `jitter`: what is listed already
    for value, vector in zip(values, vectors.T):
        if value >= settings.weak_eigenvalue:
            break
        shares = _shares(vector, names)
        min_share = settings.min_component * shares[0][1]
        named_unknowns = [name for name, share in shares if share >= min_share][
            : settings.most_named
        ]
        is_null = bool(value < settings.null_eigenvalue)
        if _is_jitter(named_unknowns[0]):
            # Many directions of one spline: one sentence.
            named_unknowns = named_unknowns[:1]
            if named_unknowns[0] in jitter:
                continue
            jitter.add(named_unknowns[0])
        weak.append(
            WeakDirection(
                float(value), tuple(named_unknowns), _sentence(named_unknowns, value, is_null)
            )
        )
    return weak


def _is_jitter(name: str) -> bool:
    return " jitter of " in name


def _sentence(named_unknowns: list[str], value: float, null: bool) -> str:
    how = "do not determine" if null else "hardly determine"
    jitter = _is_jitter(named_unknowns[0])
    text = f"the points {how} {'parts of ' if jitter else ''}the {named_unknowns[0]}"
    if named_unknowns[1:]:
        text += f" against {', '.join(named_unknowns[1:])}"
    if not null:
        text += f" (σ {1 / np.sqrt(value):.2g} times as large as of one alone)"
    return f"{text}; use wider knot spacing or more points" if jitter else text


def _shares(vector: Float[np.ndarray, " m"], names: list[UnknownName]) -> list[tuple[str, float]]:
    """Names of unknowns with the part of the vector they have, the largest first."""
    total = {}
    for part, name in zip(vector, names):
        word = f"{name.group} of {name.owner}"
        # Of eigenvector components, whose squares add up: all coefficients of a spline as one.
        total[word] = total.get(word, 0.0) + part**2
    return sorted(((n, float(np.sqrt(s))) for n, s in total.items()), key=lambda x: -x[1])


def _matrix_without_priors(
    declared: DeclaredRefinement, solution: Solution
) -> tuple[Float[np.ndarray, "m m"], list[UnknownName]]:
    """The scaled reduced normal matrix without priors, of the shared unknowns, and their names;
    points that distances keep in the engine's reduced system are eliminated here."""
    weight = dict(solution.problem.data.weight)
    # Priors hide what the points leave open. Those of photographs stay: an orientation that was
    # measured is no weakness of the points.
    for observations in solution.problem.observations:
        if observations.kind.snooped == "" and observations.kind.of != ("image",):
            weight[observations.name] = 0 * weight[observations.name]
    data = dataclasses.replace(solution.problem.data, weight=weight)
    problem = with_data(solution.problem, data)
    S = scaled_system(problem, solution.values)[0]
    columns = {(c.table, c.row, c.direction): c.name for c in declared.columns}
    places = [place_of(problem, *unknown) for unknown in kept_unknowns(problem)]
    is_kept = np.array([place in columns for place in places])
    points = np.array([place[0] == "point" for place in places])
    cross = S[np.ix_(is_kept, points)]
    # The pseudoinverse: what no observation determines of these points is not eliminated. Below
    # 1e-13 of the largest, some hundred eps, an eigenvalue is rounding.
    explained_part = (
        cross @ np.linalg.pinv(S[np.ix_(points, points)], 1e-13, hermitian=True) @ cross.T
    )
    return S[np.ix_(is_kept, is_kept)] - explained_part, [
        columns[p] for p, k in zip(places, is_kept) if k
    ]
