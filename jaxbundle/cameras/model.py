"""A camera model: how a ray in the camera frame and a measured image coordinate belong together.

    ray [r, s, q] ──ideal──▶ (xi, yi) ──from_ideal──▶ (x, y) measured
                  ◀──ray───           ◀──to_ideal────

`ideal` is free of distortion and relative to the principal point. A model states one formula; the
other direction is its inverse (`inverse.py`), so the two domains of the residual agree to rounding.

Every function takes and returns unpacked scalars of ONE image point. Camera frame: x right, y up,
the camera looks along −z, so that a point in front of a perspective camera has q < 0. What lies
behind it is projected all the same, through the projection centre: the caller looks at q.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp

from jaxbundle.cameras.fisheye_images import equidistant, equisolid, orthographic, stereographic
from jaxbundle.cameras.inverse import implicit_inverse
from jaxbundle.cameras.perspective import perspective
from jaxbundle.cameras.scalars import Formula, OfRay, Pair, Parameters, Scalar, ToRay, Triple

IMAGES = {
    "perspective": perspective,
    "equidistant": equidistant,
    "stereographic": stereographic,
    "equisolid": equisolid,
    "orthographic": orthographic,
}
# Ideal images of rays less than 90° from the axis.
NARROW_PROJECTIONS = ("perspective", "orthographic")
FORMULAS = ("correct", "distort", "project", "unproject")
Image = Literal["perspective", "equidistant", "stereographic", "equisolid", "orthographic"]
PRINCIPAL_DISTANCES = ("c",), ("fx", "fy"), ("f",)
# Default names.
PRINCIPAL_POINTS = ("x0", "y0"), ("cx", "cy")
# Further fields of a camera; a parameter cannot have one of these names.
RESERVED_NAMES = ("id", "model", "image_size", "pixel_size", "free", "sigma")


class LocalFormula(NamedTuple):
    """A `distort` that depends on few of many parameters: how many; `columns`, `(p, xi, yi) ->`
    which, as whole numbers; `distort`, `(p, columns, values, xi, yi) -> (x, y)`, with these values
    in their places."""

    number: int
    columns: Callable
    distort: Callable


@dataclasses.dataclass(frozen=True, repr=False, kw_only=True)
class CameraModel:
    """A camera model: one formula and the names of its parameters.

        mine = CameraModel("mine", ("c", "x0", "y0", "K1"), correct=my_function)

    It is hashable, to be a static argument of jitted functions, and equal to a model of the same
    formula (the same function, not one that reads the same) and fields. `str` gives its name.

    **Arguments:**

    - `name`: of the model in files and reports; `parameters`: names, in the order of the tuple `p`
      of all functions below.
    - One formula, a function of scalars, element by element, of arithmetic and `jax.numpy`:
      `correct`, `(p, x, y) -> (xi, yi)`, from the measured to the ideal image; `distort`,
      `(p, xi, yi) -> (x, y)`, from the ideal to the measured image; `project`,
      `(p, r, s, q) -> (x, y)`, from the ray to the measured image; or `unproject`,
      `(p, x, y) -> (r, s, q)`, from the measured image to a ray of any length. `unproject` may
      be given with `project` as its inverse. Ideal coordinates are relative to the
      principal point and on the scale of the principal distance.
    - `inverse`: of `correct`, `distort`, or of `project` as it maps ideal to measured coordinates;
      by default computed by Newton's method with implicit derivatives, in `iterations` steps from
      `start`, `(p, X, Y) -> (x, y)`.
    - `unit`: of image coordinates, `"mm"` or `"px"`; principal distance and principal point are in
      the same unit. `axes`: `"up"`, x right and y up (of mm if not given); `"down"`, u right and
      v down, the axes of pixels (of px).
    - `image`: the ideal image, `"perspective"`, or, for fisheyes, `"equidistant"`,
      `"stereographic"` or `"equisolid"`, whose rays may be 90° and more from the axis, or
      `"orthographic"`. `magnification`, `(p) -> number`: the scale of the image on the axis, in
      principal distances, if it is not 1.
    - `defaults`: values of optional parameters, if they are not 0.
    - `free`: parameters estimated by default; all if not given. `never_free`: parameters that
      are conventions, never estimated. `ranges`: of parameters that are valid
      only from a lowest value to below a highest. `prior`: σ of parameters not determined by
      photographs alone; `calibrate` observes their start values with it.
    - `principal_distance`: one parameter, or two, along and across, that must be given and
      positive; c, fx and fy, or f if not named. `principal_point`: two parameters, the measured
      image of the axis; x0 and y0, or cx and cy if not named, and none without these.
    - `local`: in addition to `distort`, for models with many parameters of which each image point
      depends on few.

    **Fields made of them:** `own_formula`, which of `to_ideal` and `from_ideal` the formula is;
    `ideal`, `(p, r, s, q) -> (xi, yi)`; `ray`, `(p, xi, yi) -> (r, s, q)`, of length 1; `to_ideal`,
    `(p, x, y) -> (xi, yi)`; `from_ideal`, `(p, xi, yi) -> (x, y)`.

    **Raises:** `ValueError`.
    """

    name: str = dataclasses.field(kw_only=False)
    parameters: tuple[str, ...] = dataclasses.field(kw_only=False)
    correct: Formula | None = None
    distort: Formula | None = None
    project: OfRay | None = None
    unproject: ToRay | None = None
    inverse: Formula | None = None
    start: Formula | None = None
    iterations: int = 6
    unit: Literal["mm", "px"] = "mm"
    axes: Literal["up", "down"] | None = None
    image: Image = "perspective"
    magnification: Callable[[Parameters], Scalar] | None = None
    defaults: Mapping[str, float] | tuple = ()
    free: tuple[str, ...] = ()
    never_free: tuple[str, ...] = ()
    ranges: Mapping[str, tuple[float, float]] | tuple[Any, ...] = ()
    prior: Mapping[str, float] | tuple = ()
    principal_distance: tuple[str, ...] = ()
    principal_point: tuple[str, ...] = ()
    local: LocalFormula | None = None
    own_formula: Literal["to_ideal", "from_ideal"] = dataclasses.field(init=False, compare=False)
    ideal: OfRay = dataclasses.field(init=False, compare=False)
    ray: ToRay = dataclasses.field(init=False, compare=False)
    to_ideal: Formula = dataclasses.field(init=False, compare=False)
    from_ideal: Formula = dataclasses.field(init=False, compare=False)

    def __post_init__(self):
        for name, value in _complete(self).items():
            object.__setattr__(self, name, value)
        columns = [self.parameters.index(name) for name in self.principal_distance]
        ideal, ray = IMAGES[self.image](columns, self.axes == "up")
        if self.magnification is not None:
            # Distortion formulas near the identity need an ideal image of the same scale on the
            # axis.
            ideal, ray = (_magnify(of, columns, self.magnification) for of in (ideal, ray))
        formula, inverse = self.correct or self.distort, self.inverse
        if self.project is not None:
            # `project` as a distortion of the ideal image, so that every model has the same two
            # domains.
            project = self.project
            formula = lambda p, xi, yi: project(p, *ray(p, xi, yi))
        if self.unproject is not None:
            unproject = self.unproject
            corrected = lambda p, x, y: ideal(p, *unproject(p, x, y))
            formula, inverse = (corrected, inverse) if formula is None else (formula, corrected)
        assert formula is not None, "checked by _complete"
        # The formula stated is exact; the other direction is its inverse, to rounding.
        point = [self.parameters.index(name) for name in self.principal_point]
        start = _at_the_point(point) if self.correct and point else _less_its_origin(formula)
        inverse = inverse or implicit_inverse(formula, self.start or start, self.iterations)
        explicit = self.distort or self.project
        own_formula, other_formula = ("from_ideal", "to_ideal")[:: 1 if explicit else -1]
        functions = {
            "own_formula": own_formula,
            own_formula: formula,
            other_formula: inverse,
            "ideal": ideal,
            "ray": ray,
        }
        for name, value in functions.items():
            object.__setattr__(self, name, value)

    @property
    def formula(self) -> Formula | OfRay | ToRay:
        """The one function the model states."""
        stated = self.correct or self.distort or self.project or self.unproject
        assert stated is not None, "checked when the model is made"
        return stated

    @property
    def wide(self) -> bool:
        """Whether rays may be 90° and more from the axis."""
        return self.image not in NARROW_PROJECTIONS

    @property
    def core(self) -> tuple[str, ...]:
        """Principal distance and principal point: the parameters that are not additional ones."""
        return (*self.principal_distance, *self.principal_point)

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        return f"CameraModel({self.name!r})"


def _complete(model: CameraModel) -> dict:
    """The fields of a model that are not functions, checked, in the form that is kept."""
    if not isinstance(model.name, str) or not model.name.isprintable() or not model.name.strip():
        raise ValueError(f"The name of a camera model must be a text, but is {model.name!r:.60}.")
    where = f"Camera model {model.name!r}: "
    text = isinstance(model.parameters, str)
    parameters = () if text else tuple(model.parameters)
    valid = lambda n: isinstance(n, str) and n.isidentifier() and n not in RESERVED_NAMES
    odd = [n for n in parameters if not valid(n)]
    if odd or not parameters or len({*parameters}) < len(parameters):
        raise ValueError(
            f"{where}parameters must be different names such as ('c', 'x0', 'y0', 'K1'), none of "
            f"them {', '.join(RESERVED_NAMES)}, but are {model.parameters!r:.200}."
        )
    formulas = [name for name in FORMULAS if getattr(model, name) is not None]
    if len(formulas) != 1 and formulas != ["project", "unproject"]:
        raise ValueError(
            f"{where}give one formula as correct, distort, project or unproject, not "
            f"{' and '.join(formulas) or 'none'}; its inverse is inverse, that of project may be "
            "unproject."
        )
    for name in (*formulas, "inverse", "start", "magnification"):
        if getattr(model, name) is not None and not callable(getattr(model, name)):
            raise ValueError(f"{where}{name} must be a function, not {getattr(model, name)!r:.60}.")
    for name, choices in (
        ("unit", ("mm", "px")),
        ("axes", ("up", "down", None)),
        ("image", tuple(IMAGES)),
    ):
        if getattr(model, name) not in choices:
            known_set = ", ".join(filter(None, choices))
            raise ValueError(
                f"{where}{name} is one of {known_set}, not {getattr(model, name)!r:.60}."
            )
    if not isinstance(model.iterations, int) or model.iterations < 1:
        raise ValueError(f"{where}iterations must be a number above 0, not {model.iterations!r}.")
    # The first of the usual names that are among the parameters.
    known_set = lambda sets: next((names for names in sets if {*names} <= {*parameters}), ())
    fields = {
        "parameters": parameters,
        "axes": model.axes or ("up" if model.unit == "mm" else "down"),
        "defaults": tuple(dict(model.defaults).items()),
        "never_free": tuple(model.never_free),
        "ranges": tuple((name, tuple(ends)) for name, ends in dict(model.ranges).items()),
        "prior": tuple(dict(model.prior).items()),
        "principal_distance": tuple(model.principal_distance) or known_set(PRINCIPAL_DISTANCES),
        "principal_point": tuple(model.principal_point) or known_set(PRINCIPAL_POINTS),
    }
    fields["free"] = tuple(model.free) or tuple(
        n for n in parameters if n not in fields["never_free"]
    )
    tables = ("defaults", "ranges", "prior")
    for name in (*tables, "free", "never_free", "principal_distance", "principal_point"):
        unknown = {*(dict(fields[name]) if name in tables else fields[name])} - {*parameters}
        if unknown:
            raise ValueError(f"{where}{name} names {', '.join(unknown)}, which is no parameter.")
    if len(fields["principal_distance"]) not in (1, 2) or len(fields["principal_point"]) not in (
        0,
        2,
    ):
        raise ValueError(
            f"{where}principal_distance must name one parameter, or two, along and across, and "
            "principal_point two or none; c, fx and fy, f, x0 and y0, cx and cy need no naming."
        )
    return fields


def _magnify(
    function: Callable, columns: Sequence[int], magnification: Callable[[Parameters], Scalar]
) -> Any:
    """An ideal image, or its rays, at the scale that the image has on the axis."""
    return lambda p, *at: function({c: p[c] * magnification(p) for c in columns}, *at)


def _less_its_origin(formula: Formula) -> Formula:
    """Undoes the shift of a formula that is near the identity but for a shift."""

    def start(p: Parameters, X: Scalar, Y: Scalar) -> Pair:
        x, y = formula(p, 0.0 * X, 0.0 * Y)
        return X - x, Y - y

    return start


def _at_the_point(columns: Sequence[int]) -> Formula:
    """Undoes the shift to the principal point of a correction, exact on the axis. At the origin of
    pixels, a corner, a correction may have no value at all."""
    x0, y0 = columns
    return lambda p, X, Y: (X + p[x0], Y + p[y0])


def project(model: CameraModel, p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """Measured image coordinates (x, y), in the model's unit, of the ray [r, s, q] of any length.

    NaN where the model has no image of the ray (`inverse.py`).
    """
    if model.project is not None:
        return model.project(p, r, s, q)
    return model.from_ideal(p, *model.ideal(p, r, s, q))


def image_ray(model: CameraModel, p: Parameters, x: Scalar, y: Scalar) -> Triple:
    """The ray [r, s, q] in the camera frame, of length 1, of measured coordinates (x, y)."""
    if model.unproject is not None:
        r, s, q = model.unproject(p, x, y)
        length = jnp.sqrt(r * r + s * s + q * q)
        return r / length, s / length, q / length
    return model.ray(p, *model.to_ideal(p, x, y))


def residual(
    model: CameraModel,
    domain: str,
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
