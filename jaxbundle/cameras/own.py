"""Checks of own camera models before any computation."""

from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxbundle.cameras.inverse import value_and_derivative
from jaxbundle.cameras.model import FORMULAS, CameraModel
from jaxbundle.float64 import local_x64
from jaxbundle.system.programs import compile_once
from jaxbundle.types import Scalar


def check_own(model: CameraModel, values: Mapping[str, float] | None = None) -> None:
    """Refuse a model with an unusable formula, with `values` also one unusable on the axis.

    **Raises:** `ValueError`: the formula does not take the parameters and give two numbers, or not
    element by element; it has no derivatives on the optical axis, or mirrors the image there; its
    inverse is wrong.
    """
    _check_form(model)
    if values is None:
        return
    where = f"camera model {model.name!r}: "
    with local_x64():
        p = np.array([values[name] for name in model.parameters], float)
        numbers = [np.asarray(x) for x in _near_the_axis(model, p)]
    image, (a, b, c, d), misclosure, misclosure_of_changed = numbers
    if not (np.isfinite(image).all() and np.isfinite([a, b, c, d]).all()):
        raise ValueError(
            f"{where}its formula has no finite value and derivatives on the optical axis, with the "
            "start values given; write it so that it has (x·√(x² + y²) has none at 0 in JAX, and "
            "its series in x² + y² has)"
        )
    if not a * d - b * c > 0 or not a + d > 0:
        raise ValueError(
            f"{where}measured and ideal image are mirrored or rotated relative to each other; are "
            f"axes {model.axes!r} (x right, y {model.axes}) right, and the signs of the formula?"
        )
    size = max(abs(values[name]) for name in model.principal_distance)
    # 1e-9 of the principal distance: 1e-5 pixels. An inverse that ends its iterations early, as
    # OpenCV's, is refused, since the two domains of a residual would differ.
    largest = 1e-9 * size
    if model.inverse is not None and (not misclosure <= largest or misclosure_of_changed > largest):
        worst = float(np.fmax(misclosure, misclosure_of_changed))
        raise ValueError(
            f"{where}inverse is not the inverse of its formula: a point comes back "
            f"{worst:.3g} {model.unit} beside itself, at the start values or with parameters near "
            "them; omit inverse, and it is computed"
        )


@lru_cache(maxsize=64)
def _check_form(model: CameraModel) -> None:
    name = next(n for n in FORMULAS if getattr(model, n) is not None)
    arguments = ("r, s, q", 3) if name == "project" else ("x, y", 2)
    number_of, results = (3, "three") if name == "unproject" else (2, "two")
    number, array = (jax.ShapeDtypeStruct(shape, jnp.result_type(float)) for shape in ((), (7, 11)))
    p = (number,) * len(model.parameters)
    # Numbers and arrays: a formula with an `if` works for one of them only.
    for argument in (number, array):
        expected = (
            f"Camera model {model.name!r}: {name}(p, {arguments[0]}) must take the parameters "
            f"({', '.join(model.parameters)}) as a tuple p and return {results} numbers, or for "
            f"arrays {results} arrays, element by element"
        )
        try:
            out = jax.eval_shape(model.formula, p, *(argument,) * arguments[1])
        except Exception as error:  # whatever a user's function raises
            text = " ".join(str(error).split())
            raise ValueError(f"{expected}; it raised {type(error).__name__}: {text:.160}") from None
        shapes = (
            [x.shape for x in out]
            if isinstance(out, tuple | list) and all(hasattr(x, "shape") for x in out)
            else None
        )
        if shapes != [argument.shape] * number_of:
            raise ValueError(f"{expected}; for {argument.shape or 'numbers'} it gave {out!r:.160}")


@partial(compile_once, static=0)
def _near_the_axis(model: CameraModel, p: Any) -> tuple[Array, tuple[Scalar, ...], Array, Array]:
    """Image of the axis, derivative of the formula there, and the error of a point near it after
    formula and inverse, with the parameters and with others near them."""
    p = tuple(p)
    zero, formula = jnp.zeros(()), getattr(model, model.own_formula)
    size = p[model.parameters.index(model.principal_distance[0])]
    axis_point = zero, zero
    if model.own_formula == "to_ideal":
        # `to_ideal` is tested where the axis is imaged: at the measured point whose ideal one is 0.
        # Without an inverse, at minus the ideal image of the origin, where the checks then fail.
        nearby = [-x for x in formula(p, *axis_point)]
        axis_point = [
            jnp.where(jnp.isfinite(x), x, y)
            for x, y in zip(model.from_ideal(p, *axis_point), nearby)
        ]
    value, derivative = value_and_derivative(formula, p, *axis_point)
    # 3° off the axis, in no symmetric direction: any model has an image there.
    slant = 0.05
    nearby = axis_point[0] + slant * size, axis_point[1] - 0.6 * slant * size
    inverse = model.to_ideal if model.own_formula == "from_ideal" else model.from_ideal

    def misclosure(p: tuple[Scalar, ...]) -> Array:
        there_and_back = inverse(p, *formula(p, *nearby))
        return jnp.abs(there_and_back[0] - nearby[0]) + jnp.abs(there_and_back[1] - nearby[1])

    # Coefficients are mostly zero at the start, where a wrong inverse inverts: each is changed so
    # that it moves the point by 1e-4 of the principal distance.
    by_parameter = jax.jacfwd(lambda p: jnp.stack(formula(p, *nearby)))(p)
    reach = [jnp.linalg.norm(column) for column in by_parameter]
    changed = tuple(x + 1e-4 * size / jnp.where(r > 0, r, jnp.inf) for x, r in zip(p, reach))
    return jnp.stack(value), derivative, misclosure(p), misclosure(changed)
