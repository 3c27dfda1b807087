r"""Aims of a design: one number to minimise.

With the covariances C of n coordinates of points or of other functions, σ² their diagonals:

    mean          √(Σσ²/n)                  A-optimality; of points Fraser's mean σ
    worst         (Σ(tr C_k/3)^q)^(1/2q)    the worst point, a few per cent above its σ
    determinant   (Π det C_k)^(1/2n)        D-optimality: mean radius of the error ellipsoids
    reliability   (Σ r^(−q))^(1/2q)         1/√r of the smallest redundancy number: of the MDB

For quantities other than points C is one block.

Sources: Grafarend (1974); Fraser (1984), Photogrammetric Engineering and Remote Sensing 50(8);
Baarda (1968) for r.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.unknowns import find_unknowns, value_of
from jaxbundle.arguments import one_of
from jaxbundle.choices import AIMS
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_quaternion, retract_quaternion
from jaxbundle.geometry.quaternions import quaternion_from_rotation_vector
from jaxbundle.leastsquares.equations.normal import zero_tangent
from jaxbundle.leastsquares.indexing.plan import Plan
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, diagonal_of
from jaxbundle.leastsquares.iterations.retraction import retract
from jaxbundle.leastsquares.problem import pad_data, with_factor, without_filling
from jaxbundle.leastsquares.quality.precision import covariances, redundancy
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.types import AnyArray

Name = tuple[str, str, str]
Functions = Callable[[Values], Float[Array, " functions"]]


@dataclasses.dataclass(frozen=True)
class Aim:
    """The quantity to minimise.

    **Arguments:**

    - `measure`: "mean", "worst", "determinant" of the σ, or "reliability": of the image coordinate
      with the smallest redundancy number and hence the largest MDB.
    - `of`: the quantities: "points" (the tie points), "cameras" (all free parameters of cameras),
      names such as `(("camera", "cam", "c"),)`, or any function of the unknowns, `Values ->
      [functions]`. Object coordinates in `Values` are relative to the centroid of the points.

    **Raises:** `InputError` for another measure.
    """

    measure: str = "mean"
    of: str | Sequence[Name] | Functions = "points"

    def __post_init__(self):
        one_of("aim", self.measure, AIMS)
        if isinstance(self.of, str):
            one_of("aim: of", self.of, ("points", "cameras"))
        elif not callable(self.of) and not len(self.of):
            raise InputError('aim: no names; give names, "points" or "cameras"')

    @property
    def convex(self) -> bool:
        """Whether the square of the aim is convex in the weights of photographs."""
        return self.measure != "reliability"

    def __str__(self) -> str:
        if self.measure == "reliability":
            return "1/√r of the worst controlled image coordinate"
        subject = (
            self.of
            if isinstance(self.of, str)
            else "functions"
            if callable(self.of)
            else (", ".join(" ".join(name) for name in self.of))
        )
        return f"{self.measure} σ of {subject}"


def functions_of(problem: NetworkProblem, aim: Aim) -> Functions | None:
    """The quantities of the aim as a function of the unknowns; None for points and reliability.

    **Raises:** `InputError` if no camera has a free parameter, `KeyError` for unknown names."""
    quantities = aim.of
    if (
        aim.measure != "reliability"
        and quantities == "points"
        and not points_of_interest(problem).any()
    ):
        raise InputError("aim: all points are held, and their σ is 0; aim at the cameras")
    if aim.measure == "reliability" or quantities == "points":
        return None
    if callable(quantities):
        return lambda values: jnp.ravel(quantities(values))
    if isinstance(quantities, str):
        quantities = [
            ("camera", c.id, name) for c in problem.network.cameras for name in c.unknowns
        ]
        if not quantities:
            raise InputError(
                "aim: no camera has a free parameter; say what is free, or aim at points"
            )
        if aim.measure != "determinant" and len({name for *_, name in quantities}) > 1:
            raise InputError(
                f"aim: the {aim.measure} σ of camera parameters of different units; choose the "
                "determinant, or name one parameter"
            )
    unknowns = find_unknowns(problem, quantities)
    return lambda values: jnp.stack([value_of(problem, name, values) for name in unknowns])


def points_of_interest(problem: NetworkProblem) -> Bool[np.ndarray, " points"]:
    """The points of the aim: tie points, or if there are none all that are not held."""
    points = problem.network.points
    tie = points.has_role("tie")
    return tie if tie.any() else ~points.has_role("fixed")


class Task(NamedTuple):
    """An aim for the engine: `functions` of its tables, None for points and reliability; `mask`:
    of the points aimed at, filled as the tables are; `measure`: its number among `AIMS`;
    `image_sets`: the names of the sets of image coordinates."""

    declared: Declared
    plan: Plan
    functions: Callable | None
    reliability: bool
    measure: Int[np.ndarray, ""]
    mask: Float[np.ndarray, " points"]
    image_sets: tuple[str, ...]


def task_of(problem: NetworkProblem, aim: Aim) -> Task:
    """The aim for the engine.

    **Raises:** `InputError` if no factor of the network fits into memory."""
    problem = with_factor(problem)
    functions = functions_of(problem, aim)
    if problem.reduction not in FACTORS:
        raise InputError("design: the network is too large for its covariance; use a part of it")
    function = None
    if functions is not None:
        function = lambda tables: functions(without_filling(problem, tables))
    rows = points_of_interest(problem)
    mask = np.zeros(problem.sizes["table", "point"])
    mask[: len(rows)] = rows
    index = np.asarray(AIMS.index(aim.measure))
    reliable = aim.measure == "reliability"
    return Task(
        problem.declared, problem.plan, function, reliable, index, mask, tuple(problem.image_rows)
    )


@eqx.filter_jit
def log_aim(task: Task, data: Data) -> tuple[Float[Array, ""], Data]:
    """The logarithm of the aim and its gradient by all numbers of a design, which are padded to the
    sizes of the plan; NaN if the design leaves unknowns undetermined. Designs of one shape share
    the program."""
    declared, plan = task.declared, task.plan

    def value(data: Data) -> Float[Array, ""]:
        if task.reliability:
            # Observations with less than a thousandth of the largest 1/σ, a millionth of the
            # weight, are not visible in effect: they do not count, as they would not be measured.
            r = redundancy(declared, plan, data)
            roots = [diagonal_of(w) for w in (data.weight[o] for o in task.image_sets)]
            inverse = [
                jnp.where(w > 1e-3 * jnp.max(w), 1 / jnp.maximum(r[o], 1e-12), 0.0).ravel()
                for o, w in zip(task.image_sets, roots)
            ]
            return jnp.log(_norm(jnp.concatenate(inverse))) / 2
        functions, zero_change = task.functions, zero_tangent(plan)
        if functions is None:
            no_rows = jax.tree.map(lambda x: x[None][:0], zero_change)
            of_tables, _ = covariances(declared, plan, data, no_rows)
            return _log_measure(task.measure, of_tables["point"], task.mask)
        changed = lambda change: functions(retract(declared, plan, data.start, change))
        _, C = covariances(declared, plan, data, jax.jacrev(changed)(zero_change))
        return _log_measure(task.measure, C[None], jnp.ones(1))

    # By all numbers of the data, not by the variables of a design: so this program, the largest by
    # far, does not depend on the design, and `search.make_program` carries the gradient back.
    return jax.value_and_grad(value)(data)


def aim_of(problem: NetworkProblem, aim: Aim) -> float:
    """The aim of a network at its start values with its weights; NaN if it is not determined."""
    data = pad_data(problem, problem.data)
    return float(jnp.exp(log_aim(task_of(problem, aim), data)[0]))


def smallest_redundancy(problem: NetworkProblem) -> float:
    """The smallest redundancy number of an image coordinate."""
    problem = with_factor(problem)
    data = pad_data(problem, problem.data)
    numbers = redundancy(problem.declared, problem.plan, data)
    has_weight = {o: diagonal_of(data.weight[o]) > 0 for o in problem.image_rows}
    return min(float(numbers[o][is_used].min()) for o, is_used in has_weight.items())


def measure(aim: Aim, blocks: Float[AnyArray, "blocks k k"]) -> float:
    """The measure of covariance blocks of the σ."""
    index = np.asarray(AIMS.index(aim.measure))
    return float(jnp.exp(_log_measure(index, jnp.asarray(blocks), jnp.ones(len(blocks)))))


def _log_measure(
    index: Int[AnyArray, ""],
    blocks: Float[AnyArray, "blocks k k"],
    mask: Float[AnyArray, " blocks"],
) -> Float[Array, ""]:
    """The logarithm of the measure of this number, of the blocks whose mask is 1."""
    size = jnp.sum(mask) * blocks.shape[1]
    is_included = mask[:, None, None] > 0
    blocks = jnp.where(is_included, blocks, jnp.eye(blocks.shape[1]))
    variances = jnp.diagonal(blocks, axis1=1, axis2=2)
    single = len(blocks) == 1

    def mean() -> Float[Array, ""]:
        return jnp.log(jnp.sum(jnp.where(is_included[..., 0], variances, 0.0)) / size) / 2

    def worst() -> Float[Array, ""]:
        of_blocks = variances if single else variances.mean(1, keepdims=True)
        return jnp.log(_norm(jnp.where(is_included[..., 0], of_blocks, 0.0))) / 2

    def determinant() -> Float[Array, ""]:
        # Of the correlations, since units differ by many powers of ten (c in mm, K3 in mm⁻⁶).
        scale = jnp.sqrt(variances)
        correlation = blocks / (scale[:, :, None] * scale[:, None, :])
        log = jnp.linalg.slogdet(correlation)[1] / 2 + jnp.log(scale).sum(1)
        return jnp.sum(jnp.where(mask > 0, log, 0.0)) / size

    return jax.lax.switch(index, [mean, worst, determinant])


def _norm(x: Float[Array, "..."]) -> Float[Array, ""]:
    """(Σx^q)^(1/q) of numbers from 0, a smooth maximum."""
    # q = 12: a maximum shared by ten points is overestimated by 10^(1/24) in σ, 10 %, by a thousand
    # by a third. Larger: nearer to the maximum, whose gradient jumps from point to point; smaller:
    # nearer to the mean.
    q = 12
    largest = jnp.max(jax.lax.stop_gradient(x))
    return largest * jnp.sum((x / largest) ** q) ** (1 / q)


def refuse_arbitrary(aim: Aim, problem: NetworkProblem) -> None:
    """Refuse an aim that depends on the datum.

    **Raises:** `InputError`."""
    datum = problem.plan.datum
    if datum is None or aim.measure == "reliability":
        return
    functions, defect = functions_of(problem, aim), int(np.asarray(datum.gauge).shape[1])
    if functions is None:
        if problem.network.datum == "minimal":
            raise InputError(
                "aim: the datum is minimal, so that the σ of points depend on the held "
                'coordinates; choose inner constraints (datum = "inner"), the datum of smallest '
                "mean σ (design of order zero), or control points"
            )
        return
    # The derivatives by the seven motions of a similarity; the columns of the gauge are the
    # combinations of these that the datum leaves open.
    start = problem.data.start
    move = lambda t: functions(_move(start, t))
    slope = np.asarray(jax.jacfwd(move)(jnp.zeros(7)))
    change = np.abs(slope @ np.asarray(datum.gauge))
    size = np.abs(slope) @ np.abs(np.asarray(datum.gauge)) + np.abs(functions(start))[:, None]
    # An invariant quantity changes by rounding only, some 1e-12 of the sizes of its terms; one that
    # is not by about the sizes themselves.
    if (change > 1e-7 * size).any():
        raise InputError(
            f"aim: {defect} of 7 datum parameters are open, and the {aim} depends on the datum: a "
            "coordinate is known only relative to the datum points. Aim at a datum-invariant "
            "quantity (a parameter of a camera; a ratio of distances, or a distance if "
            "there is a scale), at the σ of all points under inner constraints, or give control "
            "points"
        )


def _move(values: Values, t: Float[AnyArray, "7"]) -> Values:
    """The unknowns after a small similarity: shifts, rotations, scale."""
    turn = matrix_from_quaternion(quaternion_from_rotation_vector(t[3:6]))
    move_points = lambda x: (1 + t[6]) * (x @ turn.T) + t[:3]
    in_camera = jax.vmap(lambda q: retract_quaternion(q, -matrix_from_quaternion(q) @ t[3:6]))
    position, rotation = values["image"]
    image = PoseValue(move_points(position), in_camera(jnp.asarray(rotation)))
    return values | {"image": image, "point": move_points(values["point"])}
