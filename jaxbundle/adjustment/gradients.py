"""Derivatives compared with finite differences, for camera models, adjustments, any function."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle.adjustment.solve import solve
from jaxbundle.arguments import integer, positive, show
from jaxbundle.cameras import CameraModel, project
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares.indexing.rows import Data
from jaxbundle.leastsquares.problem import Problem
from jaxbundle.system.programs import compile_once, quick_jit


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """Largest relative differences over the tested directions.

    `forward`: jvp against central differences; `reverse`: vjp against jvp; `differences`: the
    error of the central differences, as they estimate it themselves. All are relative to the size
    of the derivative in that direction.
    """

    forward: float
    reverse: float
    tolerance: float
    differences: float

    @property
    def passed(self) -> bool:
        # Both modes multiply the same numbers in another order: only rounding, 1e-16 times the
        # condition of the function, may separate them, whatever the tolerance of differences.
        return self.forward < self.tolerance and self.reverse < 1e-9

    def __str__(self) -> str:
        verdict, advice = "agree" if self.passed else "DISAGREE", ""
        if not self.passed and self.differences > self.tolerance:
            advice = f"; the differences are good to {self.differences:.1e} only: try another step"
        return (
            f"derivatives {verdict}: autodiff against central differences {self.forward:.1e}, "
            f"reverse against forward {self.reverse:.1e} (relative){advice}"
        )


def check_gradients(
    function: Callable | CameraModel | Problem,
    *arguments: Any,
    directions: int = 5,
    step: float = 1e-4,
    tolerance: float = 1e-6,
    seed: int = 0,
    **options: Any,
) -> GradientCheck:
    """Compare the derivatives of a function with finite differences, in random directions.

    **Arguments:**

    - `function`: any function of arrays (pytrees) to arrays; or a `CameraModel` with the
      arguments (parameters, ray) of `jaxbundle.cameras.project`; or a `Problem`, whose adjusted
      unknowns are differentiated with respect to `Data`, or to its measurements by set of
      observations (its own if no argument is given; `options` go to `jaxbundle.solve`).
    - `step`: the longest of the differences, relative to the size of each leaf of the arguments;
      for the arguments of a camera model, which have many units, relative to the change that
      would move the image point by its distance from the origin. It is halved until the
      differences, extrapolated to step 0, are ten times more exact than `tolerance`, ten times
      at most (Ridders 1982).
    """
    if not callable(function) and not isinstance(function, CameraModel | Problem):
        raise InputError(
            f"function must be a function, a CameraModel or a Problem, but is {show(function)}"
        )
    require_x64()
    directions = integer("directions", directions)
    step, tolerance = positive("step", step), positive("tolerance", tolerance)
    f, x, sizes = _flatten(*_as_function(function, arguments, options))
    # Traced once, for its shape and for its derivatives.
    f = jax.jit(f)
    if isinstance(function, CameraModel):
        sizes = _sizes_by_effect(f, x, sizes)

    def differentiate(
        x: Float[Array, " n"], d: Float[Array, " n"], c: Float[Array, " m"]
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """f(x), its derivative along d, and c times its Jacobian: one program."""
        y, forward = jax.linearize(f, x)
        return y, forward(d), jax.linear_transpose(forward, x)(c)[0]

    # Little optimisation for few numbers: for 160 it is compiled in 6 s of processor instead of 11;
    # for 1000, a hundred evaluations take about as much longer as compiling saves.
    compiled = quick_jit if x.size <= 1000 else compile_once
    derivatives = compiled(differentiate, ())
    outputs = jax.eval_shape(f, x).shape
    random = np.random.default_rng(integer("seed", seed, 0))
    forward, reverse, differences = [], [], []
    for _ in range(directions):
        # Random directions see every entry of the Jacobian at once; c·(J·d) = (c·J)·d tests reverse
        # mode without any differences.
        d = jnp.asarray(random.normal(size=x.shape)) * sizes
        c = jnp.asarray(random.normal(size=outputs))
        _, derivative_along, pulled = derivatives(x, d, c)
        scale = max(float(jnp.linalg.norm(derivative_along)), 1e-300)
        y = lambda h, d=d, c=c: derivatives(x + h * d, d, c)[0]
        extrapolated, error = _differentiate(y, step, tolerance / 10 * scale)
        forward.append(float(jnp.linalg.norm(derivative_along - extrapolated)) / scale)
        differences.append(error / scale)
        difference = abs(float(jnp.vdot(c, derivative_along)) - float(jnp.vdot(pulled, d)))
        reverse.append(difference / (float(jnp.linalg.norm(c)) * scale))
    largest = lambda values: float(np.max(values))  # NaN where one of them is
    return GradientCheck(largest(forward), largest(reverse), tolerance, largest(differences))


def _as_function(
    function: Any, arguments: tuple[Any, ...], options: Mapping[str, Any]
) -> tuple[Callable, tuple[Any, ...]]:
    """The function that a camera model or a problem stands for, and its arguments."""
    if isinstance(function, CameraModel):
        project_ray = lambda p, ray: jnp.stack(project(function, tuple(p), *ray))
        return project_ray, tuple(jnp.asarray(leaf, float) for leaf in arguments)
    if not isinstance(function, Problem):
        return function, arguments
    arguments = arguments or (function.data.measured,)
    if isinstance(arguments[0], Data):
        return lambda data: solve(function, data, **options), arguments
    replace = partial(dataclasses.replace, function.data)
    return lambda measured: solve(function, replace(measured=measured), **options), arguments


def _flatten(
    function: Callable, arguments: tuple[Any, ...]
) -> tuple[Callable, Float[Array, " n"], Float[Array, " n"]]:
    """A function of one vector, the vector of the arguments, and the size of each of its numbers:
    the RMS of the leaf it is from, 1 for a leaf of zeros."""

    def size(leaf: Any) -> float:
        array = np.asarray(leaf)
        rms = float(np.sqrt(np.mean(array**2))) if array.size else 0.0
        return rms if rms > 0 else 1.0

    x, unravel = ravel_pytree(tuple(jax.tree.map(jnp.asarray, arguments)))
    sizes = jax.tree.map(lambda a: jnp.full(jnp.shape(a), size(a)), tuple(arguments))
    return lambda x: ravel_pytree(function(*unravel(x)))[0], x, ravel_pytree(sizes)[0]


def _differentiate(y: Callable, step: float, sufficient: float) -> tuple[jax.Array, float]:
    """dy/dh at h = 0 and the norm of its error, from central differences at the steps h, h/2, …

    D₀(h) = (y(h) − y(−h))/2h has an error series in h²; Dⱼ(h) = Dⱼ₋₁(h) + (Dⱼ₋₁(h) −
    Dⱼ₋₁(2h))/(4ʲ − 1) is free of its first j terms. The error of Dⱼ(h) is estimated by its larger
    distance from Dⱼ₋₁(h) and Dⱼ₋₁(2h), and the value with the smallest is kept (Ridders, Advances
    in Engineering Software 4, 1982).
    """
    distance = lambda a, b: float(jnp.linalg.norm(a - b))
    row = [(y(step) - y(-step)) / (2 * step)]
    best, error = row[0], np.inf
    # Ten halvings, a thousandth of the given step: from 1e-4 to 1e-7, whose differences rounding
    # (1e-16/step) makes less exact again than longer ones.
    for _ in range(10):
        step, previous_row = step / 2, row
        row = [(y(step) - y(-step)) / (2 * step)]
        for j, longer in enumerate(previous_row, 1):
            row.append(row[-1] + (row[-1] - longer) / (4**j - 1))
            estimate = max(distance(row[j], row[j - 1]), distance(row[j], longer))
            if estimate < error:
                best, error = row[j], estimate
        if error <= sufficient:
            break
    return best, error


def _sizes_by_effect(f: Callable, x: jax.Array, otherwise: jax.Array) -> jax.Array:
    """The change of every argument that changes f by |f|; `otherwise` where it has no effect, or
    where f is 0."""
    effects, size = jnp.linalg.norm(jax.jacfwd(f)(x), axis=0), jnp.linalg.norm(f(x))
    return jnp.where((effects > 0) & (size > 0), size / effects, otherwise)
