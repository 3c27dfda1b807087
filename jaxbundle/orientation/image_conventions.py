"""Image coordinates in another convention than the expected one: an axis in the other direction,
exchanged axes, another origin.

Expected are pixels from the centre of the upper-left one, u right and v down, or mm or pixels from
the image centre, x right and y up, as the model of the camera has it. Start values of images and
points predict every image point. If the predictions are far from the measurements, but near one of
the eight symmetries of the image, about its centre or about a corner, that is their convention.
Without start values the extent of the coordinates shows another origin or unit.
"""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.cameras import get_model
from jaxbundle.network.tables import Camera, Network
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import Model, misclosures
from jaxbundle.orientation.rays import make_sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings

# The symmetry of the expected convention: a 2 × 2 matrix, row by row.
IDENTITY = (1, 0, 0, 1)
SYMMETRIES = {
    (1, 0, 0, -1): "{y} is counted in the other direction",
    (-1, 0, 0, 1): "{x} is counted in the other direction",
    (-1, 0, 0, -1): "the image is turned by 180°",
    (0, 1, 1, 0): "{x} and {y} are exchanged",
    (0, -1, -1, 0): "{x} and {y} are exchanged, both in the other direction",
    (0, -1, 1, 0): "the image is turned by 90°",
    (0, 1, -1, 0): "the image is turned by −90°",
}
EXPECTED_CONVENTION = {
    "px": "pixels from the centre of the upper-left pixel, u right, v down",
    "px up": "pixels from the image centre, x right, y up",
    "mm": "mm from the image centre, x right, y up",
}


def explains_better(misfit: float, given_misfit: float) -> bool:
    """Whether another convention explains the same data so much better that it is theirs: its
    misfit, the RMS or median of their residuals, is a fifth of that of the given convention.

    By chance, of two estimates of σ0 with 10 degrees of freedom each, one is five times the other
    with a probability of 1e-5, and of sixteen conventions the best one with 2e-4 (F distribution).
    A wrong convention misses by parts of the image or of the object, the right one by the errors of
    start values, a few hundredths of it, or by those of measurements. A similar misfit says
    nothing: nearly plane objects fit their mirror image.
    """
    return 5 * misfit < given_misfit


def name_image_convention(network: Network, settings: StartValueSettings = DEFAULTS) -> str:
    """The convention in which the image coordinates fit the start values, in words; empty if the
    expected one does, or no other."""
    images, points, rays = network.images, network.points, network.observations
    placed = np.all(np.isfinite(np.concatenate([images.position, images.angles], 1)), axis=1)
    has_coordinates = np.all(np.isfinite(points.position), axis=1)
    rows = np.flatnonzero(placed[rays.image] & has_coordinates[rays.point])
    if not len(rows):
        return ""
    # The median of 2000 is known to 3 % of its spread (1.25/√n): more than enough to recognise the
    # factor of five of `explains_better`, of up to sixteen conventions.
    rows = rows[batched.evenly_spaced(len(rows), 2000)]
    sample = network.replace(observations=rays.take(rows))
    centres, halves = (np.array(v) for v in zip(*(image_frame(c) for c in network.cameras)))
    camera = images.camera[sample.observations.image]
    medians: dict[tuple[tuple[int, int, int, int], bool], float]
    medians = {(IDENTITY, False): _misclosure(sample, placed, has_coordinates)}
    if medians[IDENTITY, False] <= settings.gross_ratio:
        return ""
    m, half_size = centres[camera], halves[camera]
    for symmetry, shifted in itertools.product([IDENTITY, *SYMMETRIES], [False, True]):
        if (symmetry, shifted) in medians or shifted and not np.isfinite(half_size).all():
            continue
        # Centred coordinates instead of those from a corner, or the other way round.
        middle = np.where(m == 0, half_size, 0.0) if shifted else m
        xy = (sample.observations.xy - middle) @ np.reshape(symmetry, (2, 2)).T + m
        changed = dataclasses.replace(sample.observations, xy=xy)
        medians[symmetry, shifted] = _misclosure(
            sample.replace(observations=changed), placed, has_coordinates
        )
    best = min(medians, key=lambda k: medians[k])  # The expected one, and simple ones, come first.
    if not explains_better(medians[best], medians[IDENTITY, False]):
        return ""
    # As they were given: pixels may be of a camera in mm.
    convention = convention_of(network.cameras[0], network.image_unit)
    x, y = ("u", "v") if convention == "px" else ("x", "y")
    words = []
    if best[1]:
        words.append(
            "they are counted from the image centre"
            if convention == "px"
            else "they are counted from a corner of the image"
        )
    if best[0] != IDENTITY:
        words.append(SYMMETRIES[best[0]].format(x=x, y=y))
    return (
        f"the image coordinates fit the start values if {' and '.join(words)}: expected are "
        f"{EXPECTED_CONVENTION[convention]}; change them in the input"
    )


def convention_of(camera: Camera, unit: str = "") -> str:
    """The key in `EXPECTED_CONVENTION` of coordinates in this unit, or in that of the model."""
    model = get_model(camera.model)
    unit = unit if unit in ("px", "mm") else model.unit
    return "px up" if unit == model.unit == "px" and model.axes == "up" else unit


def image_frame(camera: Camera) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The image centre, and half the size of the image, in the unit of the model; NaN: unknown."""
    model, size, pitch = get_model(camera.model), camera.image_size, camera.pixel_size
    if model.axes == "down":
        half_size = np.full(2, np.nan) if size is None else np.array(size) / 2
        point = [camera.parameters.get(n, 0.0) for n in model.principal_point]
        centre = (
            half_size - 0.5 if size is not None else np.array(point if len(point) == 2 else [0, 0])
        )
        return np.asarray(centre, float), half_size
    pitch = (1.0, 1.0) if model.unit == "px" else pitch
    has_size = size is not None and pitch is not None
    return np.zeros(2), np.array(size) * pitch / 2 if has_size else np.full(2, np.nan)


def _misclosure(
    network: Network,
    placed: Bool[np.ndarray, " images"],
    has_coordinates: Bool[np.ndarray, " points"],
) -> float:
    """The median misclosure of start values, in tolerances; infinite if half have no ray."""
    sights, images = make_sights(network), network.images
    if 2 * len(sights.row) < len(network.observations):
        return np.inf
    model = Model.empty(sights)
    model.place(placed, images.position[placed], batched.matrices(images.angles[placed]))
    model.X[has_coordinates] = network.points.position[has_coordinates]
    return float(np.median(misclosures(sights, model) / sights.tolerance[sights.image]))


def name_image_extent(network: Network) -> str:
    """Whether image coordinates lie where no image is, in words: another origin, or unit."""
    camera_of_ray = network.images.camera[network.observations.image]
    for c, camera in enumerate(network.cameras):
        xy = network.observations.xy[camera_of_ray == c]
        centre, half_size = image_frame(camera)
        if not len(xy):
            continue
        unit, convention = get_model(camera.model).unit, convention_of(camera)
        # Without a hundredth at either end: a few blunders would hide where the others are.
        low, high = np.quantile(xy, [0.01, 0.99], axis=0)
        if not np.isfinite(half_size).all():
            # Six points are in one quadrant of an image by chance once in 4⁵ = 1000 times.
            one_sided = ((low > 0) | (high < 0)).all()
            if convention != "px" and len(xy) >= 6 and one_sided:
                return (
                    f"camera {camera.id!r}: the image coordinates run from {low[0]:.4g}, "
                    f"{low[1]:.4g} to {high[0]:.4g}, {high[1]:.4g} {unit}, all on one side of the "
                    "image centre: are they counted from a corner? Expected are "
                    f"{EXPECTED_CONVENTION[convention]}"
                )
            continue
        description = (
            f"camera {camera.id!r}: the image coordinates run from {low[0]:.4g}, {low[1]:.4g} to "
            f"{high[0]:.4g}, {high[1]:.4g} {unit}, where the image is from "
            f"{(centre - half_size)[0]:.4g}, {(centre - half_size)[1]:.4g} to "
            f"{(centre + half_size)[0]:.4g}, {(centre + half_size)[1]:.4g}"
        )
        # In mm all points lie within 2 % of the image about its first pixel: a sensor of 36 mm has
        # 2000 columns and more.
        if unit == "px" and (np.abs([low, high]) < 0.02 * 2 * half_size).all():
            return f"{description}: are they in mm? Expected are {EXPECTED_CONVENTION[convention]}"
        # Of coordinates from the centre, taken for coordinates from a corner, three quarters lie
        # outside the image; blunders are fewer than a quarter.
        outside_share = (np.abs(xy - centre) > half_size).any(1).mean()
        shifted = np.where(centre == 0, half_size, 0.0)
        if outside_share > 0.25 and (np.abs(xy - shifted) <= half_size).all(1).mean() > 0.99:
            origin = "the image centre" if convention == "px" else "a corner of the image"
            return (
                f"{description}: are they counted from {origin}? Expected are "
                f"{EXPECTED_CONVENTION[convention]}"
            )
    return ""
