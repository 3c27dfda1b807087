"""Derivatives compared with finite differences, for camera models, adjustments, any function."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.solve import solve
from jaxbundle.arguments import integer, positive, show
from jaxbundle.cameras import CameraModel, project
from jaxbundle.errors import InputError
from jaxbundle.network.arrays import Data


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """Largest relative differences over the tested directions.

    `forward`: jvp against central differences; `reverse`: vjp against jvp. Both are relative to
    the size of the derivative in that direction.
    """

    forward: float
    reverse: float
    tolerance: float

    @property
    def passed(self) -> bool:
        return self.forward < self.tolerance and self.reverse < 1e-9

    def __str__(self) -> str:
        verdict = "agree" if self.passed else "DISAGREE"
        return (
            f"derivatives {verdict}: autodiff against central differences {self.forward:.1e}, "
            f"reverse against forward {self.reverse:.1e} (relative)"
        )


def check_gradients(
    function: Callable | CameraModel | Problem,
    *arguments,
    directions: int = 5,
    step: float = 1e-4,
    tolerance: float = 1e-6,
    seed: int = 0,
    **options,
) -> GradientCheck:
    """Compare the derivatives of a function with finite differences, in random directions.

    **Arguments:**

    - `function`: any function of arrays (pytrees) to arrays; or a `CameraModel` with the
      arguments (parameters, ray) of `jaxbundle.cameras.project`; or a `Problem`, whose adjusted
      unknowns are differentiated with respect to `Data` (its own if no argument is given;
      `options` go to `jaxbundle.solve`).
    - `step`: of the differences, relative to the size of each leaf of the arguments; extrapolated
      from h and h/2 (Richardson), so the error is O(h⁴).
    """
    if not callable(function) and not isinstance(function, CameraModel | Problem):
        raise InputError(
            f"function must be a function, a CameraModel or a Problem, but is {show(function)}"
        )
    directions = integer("directions", directions)
    step, tolerance = positive("step", step), positive("tolerance", tolerance)
    if isinstance(function, CameraModel):
        model = function
        function = lambda p, ray: jnp.stack(project(model, tuple(p), *ray))
    elif isinstance(function, Problem):
        problem = function
        arguments = arguments or (problem.data.image_xy,)
        if len(arguments) == 1 and not isinstance(arguments[0], Data):
            function = lambda xy: solve(
                problem, eqx.tree_at(lambda d: d.image_xy, problem.data, xy), **options
            )
        else:
            function = lambda data: solve(problem, data, **options)
    x, unravel = ravel_pytree(tuple(jax.tree.map(jnp.asarray, arguments)))
    sizes = ravel_pytree(
        jax.tree.map(lambda a: jnp.full(jnp.shape(a), _size(a)), tuple(arguments))
    )[0]
    f = lambda x: ravel_pytree(function(*unravel(x)))[0]

    @jax.jit
    def derivatives(x, d, c):
        """f(x), its derivative along d, and c times its Jacobian: one program, compiled once."""
        y, forward = jax.linearize(f, x)
        return y, forward(d), jax.linear_transpose(forward, x)(c)[0]

    outputs = jax.eval_shape(f, x).shape
    random = np.random.default_rng(integer("seed", seed, 0))
    worst, transposed = 0.0, 0.0
    for _ in range(directions):
        d = jnp.asarray(random.normal(size=x.shape)) * sizes
        c = jnp.asarray(random.normal(size=outputs))
        _, along, pulled = derivatives(x, d, c)
        y = lambda h, d=d, c=c: derivatives(x + h * d, d, c)[0]
        difference = lambda h, y=y: (y(h) - y(-h)) / (2 * h)
        extrapolated = (4 * difference(step / 2) - difference(step)) / 3
        scale = float(jnp.linalg.norm(along))
        worst = max(worst, float(jnp.linalg.norm(along - extrapolated)) / max(scale, 1e-300))
        apart = abs(float(jnp.vdot(c, along)) - float(jnp.vdot(pulled, d)))
        bound = float(jnp.linalg.norm(c)) * scale
        transposed = max(transposed, apart / max(bound, 1e-300))
    return GradientCheck(worst, transposed, tolerance)


def _size(leaf) -> float:
    array = np.asarray(leaf)
    size = float(np.sqrt(np.mean(array**2))) if array.size else 0.0
    return size if size > 0 else 1.0
