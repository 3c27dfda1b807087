"""Detection of wrong units: numbers that no camera or object can explain.

The widest lenses show 90° from the axis, where r/c is 2 in a stereographic image and less in other
fisheyes; 84° in a central projection are r/c = 10. A narrow field is never refused: c may be
arbitrarily long, as in microscopes and telescopes. If the field is narrower than `narrow_field` and
the same number in pixels would be a common lens, this is reported: as a warning if the pixel size
confirms it, else as a likely cause if the adjustment fails.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import STATED, Camera, Network, Points


@dataclasses.dataclass(frozen=True)
class UnitLimits:
    """What no camera or object has, or few have: numbers beyond are in another unit.

    All are far from what they tell apart, since units differ by 1000 (mm and m) or 50 to 500 (mm
    and pixels of 2 to 20 µm): none is critical within a factor of two.

    - `max_radius`: largest median r/c of the image points of a camera; 84° from the axis in a
      central projection, and no fisheye has more than 2. A median, to ignore blunders.
    - `fields`: r/c that cameras have, used only to check a remedy.
    - `coarse_pixel`, `fine_pixel`: mm; larger and smaller than the pixels of sensors.
    - `narrow_radius`: r/c less than that of any camera with such pixels.
    - `narrow_field`: r/c, half of the image points within 1.1°, below which c may be in pixels.
    - `usual_fields`: r/c of usual lenses, 3° to 45°; 600 mm before a full frame would be 3 if they
      were pixels.
    - `min_pixels`: no camera has a c of fewer pixels.
    - `half_of_points`: the part of an image's width within which half of its evenly spread points
      lie around the centre (sides 3 : 2, π·r² = half of the area).
    - `far`: coordinates of more than this many of their extents may be degrees: 12 km at 120° of
      longitude.
    - `steep`: so may those whose heights extend over more than this many of them: 3 m to 111 km of
      ground.
    - `sigma0`: within these σ0 is a matter of precision, beyond perhaps of a unit.
    - `agreement`: largest ratio of σ0 to the ratio of two units: a guessed σ is right to about this
      factor.
    - `min_sigma`: pixels; no image point is measured more precisely.
    - `min_pixel`: mm; the smallest pixels of cameras.
    - `thousand`: the ratios of two lengths of one object that are taken for 1000; one of both is a
      start value, or the extent of other points.
    """

    max_radius: float = 10.0
    fields: tuple[float, float] = (0.02, 5.0)
    coarse_pixel: float = 0.1
    fine_pixel: float = 1e-4
    narrow_radius: float = 1e-3
    narrow_field: float = 0.02
    usual_fields: tuple[float, float] = (0.05, 1.0)
    min_pixels: float = 300.0
    half_of_points: float = 1 / 3
    far: float = 1000.0
    steep: float = 3.0
    sigma0: tuple[float, float] = (0.1, 10.0)
    agreement: float = 4.0
    min_sigma: float = 0.005
    min_pixel: float = 1e-3
    thousand: tuple[float, float] = (300.0, 3000.0)


LIMITS = UnitLimits()


def check_units(network: Network) -> Network:
    """The network, with warnings for lengths that seem to be in another unit.

    **Raises:** `InputError` if half of a camera's image points would be outside any lens, and for
    known points in degrees."""
    if degrees := name_degrees(network.points):
        raise InputError(f"{network.points.source.name}: {degrees}")
    of_camera = network.images.camera[network.observations.image]
    messages = []
    for c, camera in enumerate(network.cameras):
        xy = network.observations.xy[of_camera == c]
        if len(xy):
            messages.append(_check_field(camera, xy))
    return network.warn(*filter(None, [*messages, *name_lengths(network)]))


def name_lengths(network: Network) -> list[str]:
    """Lengths that seem to be in mm and in m in one network, in words."""
    messages = _control_against_ties(network), _distances_against_control(network)
    return [line for line in messages if line]


def name_unit_of_positions(network: Network, images: dict[str, Float[np.ndarray, "3"]]) -> str:
    """Whether all adjusted projection centres (by id) are a thousand times their start values, or a
    thousandth, about the common origin: images in m beside control in mm, in words; else empty."""
    rows = [k for k, id in enumerate(network.images.id) if id in images]
    if not rows:
        return ""
    start_distance = np.linalg.norm(network.images.position[rows], axis=1)
    adjusted_distance = np.linalg.norm([images[network.images.id[k]] for k in rows], axis=1)
    # Start values that are wrong in their unit only are good to a tenth; poor ones are not 1000
    # times too small all together.
    with np.errstate(divide="ignore", invalid="ignore"):
        decades = np.abs(np.log10(adjusted_distance / start_distance))
    if not (np.abs(decades - 3) < np.log10(1.1)).all():
        return ""
    return (
        f"the adjusted projection centres are {adjusted_distance[0] / start_distance[0]:.4g} times "
        "their start values: is the control in mm, or the start values in m? Expected is one unit "
        f"of object coordinates, {network.object_unit}"
    )


def _check_field(camera: Camera, xy: Float[np.ndarray, "rays 2"]) -> str:
    """A warning for a pixel size in metres; refuses a principal distance too short for anything."""
    model = get_model(camera.model)
    values = [camera.parameters[name] for name in model.principal_distance]
    name, c = model.principal_distance[0], min(float(value) for value in values)
    point = [camera.parameters.get(n, 0.0) for n in model.principal_point] or [0.0, 0.0]
    median_radius = float(np.median(np.hypot(*(xy - point).T)))
    size = camera.pixel_size
    if median_radius > LIMITS.max_radius * c:
        raise InputError(
            f"camera {camera.id!r}: {name} is {c:g} {model.unit} and half of its image points lie "
            f"more than {median_radius:.4g} {model.unit} from the principal point, "
            f"{np.degrees(np.arctan(median_radius / c)):.1f}° from the axis: no lens has such a "
            f"field of view. {_remedy(camera, model.unit, name, c, median_radius)}"
        )
    if (
        size is not None
        and max(size) < LIMITS.fine_pixel
        and median_radius < LIMITS.narrow_radius * c
    ):
        return (
            f"camera {camera.id!r}: pixel_size is {max(size):g} mm, and half of its image points "
            f"lie within {median_radius / c:.2g} of {name} about the axis; is it in metres? It "
            f"is expected in mm ({1000 * max(size):g})"
        )
    if size is not None or camera.image_size is not None:
        return _in_pixels(camera, xy)
    return ""


def name_degrees(points: Points) -> str:
    """Whether X and Y of known points are longitude and latitude in degrees, in words; else empty.

    They are within ±180 and ±90, hardly differ for their distance from 0, and the heights differ by
    more: a degree is 111 km, so that any ground is steep in these numbers."""
    is_known = points.has_role("control", "fixed", "check") & np.isfinite(points.position).all(1)
    if is_known.sum() < 2:
        return ""
    low, high = points.position[is_known].min(0), points.position[is_known].max(0)
    extent = max((high - low)[:2])
    largest = np.maximum(np.abs(low), np.abs(high))
    swapped = largest[0] <= 90 and largest[1] <= 180
    if not (largest[0] <= 180 and largest[1] <= 90 or swapped):
        return ""
    if not (largest[:2].max() > LIMITS.far * extent and high[2] - low[2] > LIMITS.steep * extent):
        return ""
    return (
        f"X and Y of the {count(int(is_known.sum()), 'known point')} look like longitude and "
        f"latitude in degrees (X {low[0]:.8g} to {high[0]:.8g}, Y {low[1]:.8g} to {high[1]:.8g}, Z "
        f"{low[2]:.4g} to {high[2]:.4g}): expected coordinates in one unit of length; convert "
        "them to a map projection, such as UTM, or to a local system"
    )


def name_sigma_unit(network: Network, sigma0: float) -> str:
    """The unit in which the a priori σ of image coordinates would agree with σ0, in words; empty if
    nobody stated them, σ0 is not far from 1, or no unit does."""
    if network.observations.sigma_origin != STATED:
        return ""
    if LIMITS.sigma0[0] < sigma0 < LIMITS.sigma0[1] or not sigma0 > 0:
        return ""
    camera, sigma = network.cameras[0], float(np.median(network.observations.sigma))
    unit, pitch = get_model(camera.model).unit, camera.pixel_size and abs(camera.pixel_size[0])
    if network.image_unit == "px" and unit == "mm" and pitch:  # Converted where it was read.
        unit, sigma = "px", sigma / pitch
    if unit == "mm":
        factors = {"µm": 1e-3} | ({"pixels": pitch} if pitch else {})
        if sigma < LIMITS.min_sigma * (pitch or LIMITS.min_pixel):
            factors["m"] = 1e3
    else:
        factors = {"mm": 1 / pitch} if pitch else {"mm": sigma0} if sigma < LIMITS.min_sigma else {}
    plausible_factors = {
        u: f for u, f in factors.items() if 1 / LIMITS.agreement < sigma0 / f < LIMITS.agreement
    }
    if not plausible_factors:
        return ""
    likely_unit = min(plausible_factors, key=lambda u: abs(np.log(sigma0 / plausible_factors[u])))
    return (
        f"σ0 is {sigma0:.3g}: the a priori σ of the image coordinates, {sigma:.4g} {unit}, looks "
        f"like one in {likely_unit}; it is expected in {unit}: "
        f"{sigma * plausible_factors[likely_unit]:.3g} (times {plausible_factors[likely_unit]:.4g})"
    )


def name_pixels(network: Network) -> str:
    """A message about a principal distance in mm that may be in pixels; else empty. Only a likely
    cause: without pixel size it cannot be distinguished from a telescope."""
    of_camera = network.images.camera[network.observations.image]
    rows = (network.observations.xy[of_camera == c] for c in range(len(network.cameras)))
    first_message, *further_messages = [
        line
        for camera, xy in zip(network.cameras, rows, strict=True)
        if len(xy) and (line := _in_pixels(camera, xy))
    ] or [""]
    return first_message + (
        f"; so with {count(len(further_messages), 'other camera')}" if further_messages else ""
    )


def _in_pixels(camera: Camera, xy: Float[np.ndarray, "rays 2"]) -> str:
    model = get_model(camera.model)
    name, c = model.principal_distance[0], float(camera.parameters[model.principal_distance[0]])
    median_radius = float(np.median(np.hypot(*(xy - np.median(xy, axis=0)).T)))
    if (
        model.unit != "mm"
        or c < LIMITS.min_pixels
        or not 0 < median_radius < LIMITS.narrow_field * c
    ):
        return ""
    expected = "multiplied by the size of a pixel"
    pixels = None
    if camera.pixel_size is not None:
        pixels, expected = (
            median_radius / max(camera.pixel_size),
            f"{c * max(camera.pixel_size):.4g}",
        )
    elif camera.image_size is not None:
        pixels = LIMITS.half_of_points * max(camera.image_size)
    if pixels is not None and not LIMITS.usual_fields[0] < pixels / c < LIMITS.usual_fields[1]:
        return ""
    return (
        f"camera {camera.id!r}: {name} is {c:g} mm and half of its image points lie within "
        f"{median_radius:.3g} mm of their centre, "
        f"{np.degrees(np.arctan(median_radius / c)):.2g}° for such a "
        f"lens: is {name} in pixels? It is expected in mm ({expected})"
    )


def _remedy(camera: Camera, unit: str, name: str, c: float, median_radius: float) -> str:
    if unit != "mm":
        return f"Is {name} in mm? It is expected in {unit}: divided by the size of a pixel"
    causes = []
    if camera.pixel_size is not None and max(camera.pixel_size) > LIMITS.coarse_pixel:
        return (
            f"Is pixel_size {max(camera.pixel_size):g} in µm? It is expected in mm "
            f"({max(camera.pixel_size) / 1000:g})"
        )
    if LIMITS.fields[0] < median_radius / (1000 * c) < LIMITS.fields[1]:
        causes.append(f"Is {name} in metres? It is expected in mm ({1000 * c:g})")
    causes.append(
        'Are the image coordinates pixels? Set image_unit = "px" and give the camera its '
        "image_size and pixel_size"
    )
    return "; or: ".join(causes)


def _control_against_ties(network: Network) -> str:
    """Control in millimetres and start values in metres, or vice versa."""
    points = network.points
    has_position = np.isfinite(points.position).all(1)
    control = has_position & points.has_role("control", "fixed")
    tie = has_position & points.has_role("tie")
    if min(control.sum(), tie.sum()) < 3:
        return ""
    extents = [float(np.ptp(points.position[rows], axis=0).max()) for rows in (control, tie)]
    if not _is_thousandfold(*extents):
        return ""
    return (
        f"the control points extend over {extents[0]:.4g} and the start values of the tie points "
        f"over {extents[1]:.4g} {network.object_unit}: is one of them in mm, the other in m? "
        "Give all object coordinates in one unit"
    )


def _distances_against_control(network: Network) -> str:
    """Distances in millimetres between control points in metres, or vice versa."""
    points, distances = network.points, network.distances
    is_known = points.has_role("control", "fixed") & np.isfinite(points.position).all(1)
    if not len(distances):
        return ""
    a, b = points.position[distances.points].transpose(1, 0, 2)
    length = np.linalg.norm(a - b, axis=1)
    suspicious_pairs = [
        f"{points.id[i]} to {points.id[j]}"
        for row, (i, j) in enumerate(distances.points)
        if is_known[i] and is_known[j] and _is_thousandfold(distances.value[row], length[row])
    ]
    if not suspicious_pairs:
        return ""
    return (
        f"distances a thousand times those of the control points, or a thousandth: "
        f"{list_some(suspicious_pairs)}; are they in {network.object_unit}, like the control "
        "points?"
    )


def _is_thousandfold(a: float, b: float) -> bool:
    if not min(a, b) > 0:
        return False
    return LIMITS.thousand[0] < max(a / b, b / a) < LIMITS.thousand[1]
