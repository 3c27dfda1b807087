"""A camera model: how a ray in the camera frame and a measured image coordinate belong together.

    ray [r, s, q] ──ideal──▶ (xi, yi) ──from_ideal──▶ (x, y) measured
                  ◀──ray───           ◀──to_ideal────

`ideal` is free of distortion and relative to the principal point. A model states one of `to_ideal`
and `from_ideal` as its own formula; the other is its inverse (`inverse.py`), so the two domains of
the residual agree to rounding.

Every function takes and returns unpacked scalars of ONE image point. Camera frame: x right, y up,
the camera looks along −z, so that a point in front of a perspective camera has q < 0. What lies
behind it is projected all the same, through the projection centre: the caller looks at q.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Array, Float

Scalar = float | Float[Array, ""]
Pair = tuple[Scalar, Scalar]
Triple = tuple[Scalar, Scalar, Scalar]
Parameters = Sequence[Scalar]


@dataclass(frozen=True)
class CameraModel:
    """A camera model; hashable, to be a static argument of jitted functions.

    **Fields:**

    - `name`: as in a project file.
    - `parameters`: names, in the order of the parameter tuple `p` of all functions below.
    - `unit`: of image coordinates, `"mm"` or `"px"`; principal distance and principal point are in
      the same unit.
    - `axes`: `"up"`, x right and y up; `"down"`, u right and v down, the axes of pixels.
    - `own_formula`: which of `to_ideal` and `from_ideal` is the model's own formula.
    - `ideal`: `(p, r, s, q) -> (xi, yi)`.
    - `ray`: `(p, xi, yi) -> (r, s, q)`, of length 1.
    - `to_ideal`: `(p, x, y) -> (xi, yi)`.
    - `from_ideal`: `(p, xi, yi) -> (x, y)`.
    - `never_free`: parameters that are conventions, never to be estimated.
    - `principal_distance`: parameters that must be given and positive.
    """

    name: str
    parameters: tuple[str, ...]
    unit: Literal["mm", "px"]
    axes: Literal["up", "down"]
    own_formula: Literal["to_ideal", "from_ideal"]
    ideal: Callable[[Parameters, Scalar, Scalar, Scalar], Pair]
    ray: Callable[[Parameters, Scalar, Scalar], Triple]
    to_ideal: Callable[[Parameters, Scalar, Scalar], Pair]
    from_ideal: Callable[[Parameters, Scalar, Scalar], Pair]
    never_free: tuple[str, ...] = ()
    principal_distance: tuple[str, ...] = ("c",)


def project(model: CameraModel, p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """Measured image coordinates (x, y), in the model's unit, of the ray [r, s, q] of any length.

    NaN where the model has no image of the ray (`inverse.py`).
    """
    return model.from_ideal(p, *model.ideal(p, r, s, q))


def image_ray(model: CameraModel, p: Parameters, x: Scalar, y: Scalar) -> Triple:
    """The ray [r, s, q] in the camera frame, of length 1, of measured coordinates (x, y)."""
    return model.ray(p, *model.to_ideal(p, x, y))


def residual(
    model: CameraModel,
    domain: Literal["corrected", "measured"],
    p: Parameters,
    ray: Triple,
    xy: Pair,
) -> Pair:
    """The residual v = computed − observed of an image point, in the model's unit.

    **Arguments:** `domain` `"corrected"`, the ideal image of the ray against the measurement freed
    of distortion; or `"measured"`, the distorted image of the ray against the raw measurement;
    `ray` [r, s, q] = M·(X − X0); `xy` the measured coordinates.
    """
    match domain:
        case "corrected":
            computed, observed = model.ideal(p, *ray), model.to_ideal(p, *xy)
        case "measured":
            computed, observed = project(model, p, *ray), xy
        case _:
            raise ValueError(f"Residual domain must be 'corrected' or 'measured', not {domain!r}.")
    return computed[0] - observed[0], computed[1] - observed[1]
