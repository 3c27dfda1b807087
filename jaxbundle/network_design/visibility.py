r"""Visibility of a target from a station: as a smooth weight, and as yes or no.

Every condition of a ray is a margin m, 0 at its limit and about 1 well inside: for the format the
distance from an edge in half formats, for lengths in half their range. The weight is

    v = Π 1/(1 + exp(−m/s))

with the softness s. It is differentiable, and for s → 0 it is 1 if all margins are positive, else
0. The margin of occlusion is the length of the ray within an obstacle, widened by 3·s
so that thin walls also hide, and reduced by 4·s so that targets on its surface are
visible.
"""

from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.cameras import CameraModel, default_parameters, get_model, project
from jaxbundle.cameras.convert import image_area
from jaxbundle.cameras.field_of_view import field_of_view_of_rays
from jaxbundle.cameras.scalars import Parameters
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.network.tables import Camera
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.types import AnyArray

# Rays of cameras with a smaller largest angle are compared by tangents of the angle off the axis,
# as a perspective camera images them; of fisheyes, whose tangents grow without limit, by the angle.
WIDE_ANGLE = np.radians(70.0)
# Angles off the axis whose tangents are compared; beyond, the angle is added.
LARGEST_ANGLE = np.radians(87.0)


class UsableFormat(NamedTuple):
    """The image of a camera: its model, the corners of the usable format, and the
    largest angle off the axis (radians)."""

    model: CameraModel
    low: tuple[float, float]
    high: tuple[float, float]
    angle: float


class Rules(eqx.Module):
    """The conditions of rays as arrays, relative to the origin of the network; None: not given."""

    distance: Float[AnyArray, "2"] | None
    focus: Float[AnyArray, "2"] | None
    cos_incidence: Float[AnyArray, ""] | None
    obstacles: Float[AnyArray, "obstacles 2 3"] | None


def view_of(camera: Camera, edge: float) -> UsableFormat:
    """The image of a camera.

    **Raises:** `InputError` if its format is not known."""
    model = get_model(camera.model)
    try:
        low, high = image_area(model, camera.image_size, camera.pixel_size)
        if camera.image_size is None:
            raise ValueError("image_size is not given")
        values = {**default_parameters(model), **camera.parameters}
        field = field_of_view_of_rays(model, values, camera.image_size, camera.pixel_size)
    except ValueError as error:
        raise InputError(
            f"camera {camera.id}: its field of view is not known: {error}; a design needs "
            "image_size, and pixel_size of a model in mm"
        ) from None
    # Beyond the radius to which a distortion is one-to-one there are no rays, and the search, which
    # moves targets over the edge of the image, would have no gradient.
    if not np.isfinite(field.diagonal):
        raise InputError(
            f"camera {camera.id}: there is no ray to the corners of its image; a "
            "design needs a camera whose distortion holds to the corners"
        )
    inner = edge * (high - low)
    low, high = (tuple(map(float, corner)) for corner in (low + inner, high - inner))
    return UsableFormat(model, low, high, field.diagonal / 2)


def rules_of(conditions: Conditions, origin: Float[np.ndarray, "3"]) -> Rules:
    """The conditions of rays of a network with this origin."""
    pair = lambda limits: None if limits is None else np.array(limits)
    incidence, boxes = conditions.incidence, conditions.obstacles
    return Rules(
        pair(conditions.distance),
        pair(conditions.focus),
        None if incidence is None else np.asarray(np.cos(incidence)),
        np.array(boxes) - origin if boxes else None,
    )


def image_of(
    view: UsableFormat,
    position: Float[AnyArray, "3"],
    rotation: Float[AnyArray, "4"],
    interior: Float[AnyArray, " parameters"],
    point: Float[AnyArray, "3"],
) -> Float[Array, "2"]:
    """The image of a target; outside the field of view that of the nearest ray inside, since a
    distorted camera may have no image there."""
    x, y, z = matrix_from_quaternion(rotation) @ (point - position)
    return _image(view, interior, x, y, -z)[0]


def margins(
    view: UsableFormat,
    rules: Rules,
    position: Float[AnyArray, "3"],
    rotation: Float[AnyArray, "4"],
    interior: Float[AnyArray, " parameters"],
    point: Float[AnyArray, "3"],
    normal: Float[AnyArray, "3"] | None,
    softness: float | Float[AnyArray, ""] = 0.0,
) -> dict[str, Float[Array, " margins"]]:
    """The margins of one ray by condition; obstacles with this softness, 0: exact."""
    sight = point - position
    length = jnp.sqrt(jnp.sum(sight**2))
    x, y, z = matrix_from_quaternion(rotation) @ sight
    by_condition: dict[str, Array] = {"field of view": _in_view(view, interior, x, y, -z)}
    if rules.distance is not None:
        by_condition["distance"] = _within(length, rules.distance)
    if rules.focus is not None:
        by_condition["focus"] = _within(-z, rules.focus)
    if rules.cos_incidence is not None and normal is not None:
        cosine = -(sight @ normal) / length
        by_condition["incidence"] = jnp.asarray(cosine - rules.cos_incidence)[None]
    if rules.obstacles is not None:
        hidden = lambda box: _length_in_box(box, point, position, softness)
        by_condition["obstacles"] = jax.vmap(hidden)(rules.obstacles)
    return by_condition


def visibility(
    margins_of_ray: dict[str, Array], softness: float | Float[AnyArray, ""]
) -> Float[Array, ""]:
    """The smooth weight of a ray, 0 to 1, from its margins at this softness."""
    # A target on the surface of an obstacle widened by 3·s has the margin −3·s; four more make it
    # 1/(1 + e⁻¹) = 0.73 visible, and one behind a thin wall (−6·s) 0.12.
    spared = lambda name: 4.0 if name == "obstacles" else 0.0
    return jnp.exp(
        sum(
            jnp.sum(jax.nn.log_sigmoid(m / softness + spared(name)))
            for name, m in margins_of_ray.items()
        )
    )


def visible(margins_of_ray: dict[str, Array]) -> dict[str, Bool[Array, ""]]:
    """Which conditions a ray satisfies, by its margins."""
    # Rounding: targets on the surface of an obstacle have the margin 0.
    return {name: jnp.all(m >= -1e-9) for name, m in margins_of_ray.items()}


def _in_view(
    view: UsableFormat,
    interior: Float[AnyArray, " parameters"],
    x: Float[Array, ""],
    y: Float[Array, ""],
    depth: Float[Array, ""],
) -> Float[Array, "5"]:
    """Margins of the four edges of the format and of the angle off the axis."""
    # The angle as well, since the image is that of the nearest ray inside: targets behind the
    # camera would else lie within the format.
    xy, angle = _image(view, interior, x, y, depth)
    low, high = jnp.array(view.low), jnp.array(view.high)
    half_size = (high - low) / 2
    if view.angle < WIDE_ANGLE:
        flat = jnp.minimum(angle, LARGEST_ANGLE)
        off_axis = (jnp.tan(flat) + angle - flat) / np.tan(view.angle)
    else:
        off_axis = angle / view.angle
    # The corners themselves are in view: 1e-6 beyond them is rounding.
    return jnp.concatenate(
        [(xy - low) / half_size, (high - xy) / half_size, (1 + 1e-6 - off_axis)[None]]
    )


def _image(
    view: UsableFormat,
    interior: Float[AnyArray, " parameters"],
    x: Float[Array, ""],
    y: Float[Array, ""],
    depth: Float[Array, ""],
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """The image of a ray, or of the nearest one inside the field of view, and its angle off the
    axis."""
    # The 1e-18 keeps the root differentiable on the axis: 1e-9 rad.
    distance_from_axis = jnp.sqrt(x * x + y * y + 1e-18 * (x * x + y * y + depth * depth))
    angle = jnp.arctan2(distance_from_axis, depth)
    angle_inside = jnp.minimum(angle, view.angle)
    factor = jnp.sin(angle_inside) / distance_from_axis
    p = cast(Parameters, interior)  # an array unpacks like a tuple
    xy = project(view.model, p, x * factor, y * factor, -jnp.cos(angle_inside))
    return jnp.stack(xy), angle


def _within(x: Float[Array, ""], ends: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    """Margins of a length between two ends, the second of which may be infinite."""
    low, high = ends[0], ends[1]
    scale = jnp.where(jnp.isfinite(high), (high - low) / 2, jnp.maximum(low, 1e-12))
    return jnp.stack([x - low, jnp.where(jnp.isfinite(high), high - x, scale)]) / scale


def _length_in_box(
    box: Float[AnyArray, "2 3"],
    point: Float[AnyArray, "3"],
    position: Float[AnyArray, "3"],
    softness: float | Float[AnyArray, ""],
) -> Float[Array, ""]:
    """The length of the ray within a box, negative, in half mean edges; if the ray misses
    the box, a positive measure of the distance."""
    scale = jnp.mean(box[1] - box[0]) / 2
    # Intersection of a ray and a box by slabs (Kay and Kajiya, 1986): it is inside from the last
    # entry to the first exit.
    wider = 3 * softness * scale
    direction = position - point
    length = jnp.sqrt(jnp.sum(direction**2))
    safe = jnp.where(jnp.abs(direction) < 1e-12 * length, 1e-12 * length, direction)
    near_planes, far_planes = (box[0] - wider - point) / safe, (box[1] + wider - point) / safe
    enters = jnp.maximum(jnp.max(jnp.minimum(near_planes, far_planes)), 0.0)
    leaves = jnp.minimum(jnp.min(jnp.maximum(near_planes, far_planes)), 1.0)
    return (enters - leaves) * length / scale
