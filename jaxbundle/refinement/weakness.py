"""What the points cannot determine, in words.

The normal matrix of image points and control alone, without priors, reduced to the shared unknowns
and scaled by its diagonal before the elimination of points, has the eigenvalue 1/k for a direction
in which k times more is unknown than if every unknown were alone. Eigenvectors of small eigenvalues
are named by the unknowns that have part in them: pitch bias against position along track.
"""

from typing import NamedTuple

import numpy as np

from jaxbundle.refinement.build import Columns
from jaxbundle.refinement.equations import System, Unknowns
from jaxbundle.refinement.inspection import layout_of
from jaxbundle.refinement.solver import normal

WEAK = 1e-2
"""Eigenvalues below this: a σ more than ten times greater than of the unknown alone."""
NULL = 1e-10
"""Eigenvalues below this are rounding."""
PART = 0.15
"""An unknown with this part of the largest belongs to the direction."""
MOST = 4
"""No more unknowns are named in one direction."""


class Weakness(NamedTuple):
    """A direction: its eigenvalue, unknowns named with their parts, the sentence for people."""

    eigenvalue: float
    unknowns: tuple[str, ...]
    sentence: str


def weaknesses(system: System, unknowns: Unknowns, columns: Columns) -> list[Weakness]:
    """All weak directions, the weakest first; jitter is one for its axis."""
    S = _observed(system, unknowns)
    values, vectors = np.linalg.eigh(S)
    found, jitter = [], set()
    for value, vector in zip(values, vectors.T):
        if value >= WEAK:
            break
        shares = _shares(vector, columns)
        named = [name for name, share in shares if share >= PART * shares[0][1]][:MOST]
        if " jitter of " in named[0]:
            # many directions of one spline: one sentence
            jitter.add((named[0], value < NULL))
            continue
        found.append(Weakness(float(value), tuple(named), _sentence(named, value)))
    for name in sorted({name for name, _ in jitter}):
        none = (name, True) in jitter
        value = 0.0 if none else float(values[0])
        sentence = (
            f"the points leave parts of the {name} undetermined; knots farther apart or more "
            "points would, its prior holds it meanwhile"
        )
        found.append(Weakness(value, (name,), sentence))
    return found


def _sentence(named, value):
    how = "do not determine" if value < NULL else "hardly determine"
    text = f"the points {how} the {named[0]}"
    if named[1:]:
        text += f" against {', '.join(named[1:])}"
    if value < NULL:
        return text
    return f"{text} (σ {1 / np.sqrt(value):.2g} times as large as of one alone)"


def _shares(vector, columns):
    """Names of unknowns with the part of the vector they have, the largest first."""
    total = {}
    for part, name in zip(vector, columns.names):
        word = f"{name.group} of {name.owner}"
        total[word] = total.get(word, 0.0) + part**2
    return sorted(((n, float(np.sqrt(s))) for n, s in total.items()), key=lambda x: -x[1])


def _observed(system, unknowns):
    """The scaled reduced normal matrix of image points, control and given orientations."""
    reduced, _ = normal(system, unknowns)
    A, B, of = (np.asarray(x) for x in (
        reduced.jacobian.shared, reduced.jacobian.point, reduced.jacobian.of
    ))
    keep = np.ones(len(A), bool)
    keep[layout_of(system).prior] = False
    A, B, of = A[keep], B[keep], of[keep]
    V, W = np.zeros((len(system.X), 3, 3)), np.zeros((len(system.X), 3, A.shape[1]))
    np.add.at(V, of, B[:, :, None] * B[:, None, :])
    np.add.at(W, of, B[:, :, None] * A[:, None, :])
    N = A.T @ A
    diagonal = np.diagonal(N)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    S = N - np.einsum("pim,pij,pjn->mn", W, np.linalg.pinv(V, 1e-13, hermitian=True), W)
    return S * scale * scale[:, None]
