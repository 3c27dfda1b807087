"""A network with its cameras in another model: parameters, image points and their σ.

Exterior orientations and object points are unchanged. An image point keeps its pixel, or, if
source and target have the same unit and axes, its coordinates. The only exception is `snavely`,
which has no principal point: its image points are relative to that of the source camera.

The error of a fit is reported for every camera (`jaxbundle.cameras.Conversion`).
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import CameraModel, Conversion, convert_camera, get_model, is_own, key_of
from jaxbundle.cameras.pixel_frame import between_frames
from jaxbundle.errors import InputError
from jaxbundle.network.kinds import Edges
from jaxbundle.network.rules import model_of
from jaxbundle.network.tables import Camera, Network

SIZES = ("image_size", "pixel_size")
# Corresponding parameters of different models; free in one means free in the other.
COUNTERPARTS = (
    ("c", "f", "fx", "fy"),
    ("x0", "cx"),
    ("y0", "cy"),
    ("K1", "k1"),
    ("K2", "k2"),
    ("K3", "k3"),
    ("P1", "P2", "p1", "p2"),
)


def convert_cameras(
    network: Network,
    model: str | CameraModel,
    r0: float = 0.0,
    only: Sequence[str] | None = None,
    measured: bool = False,
) -> tuple[Network, dict[str, Conversion]]:
    """The network with all cameras, or `only` some, in the model with this name, or a given one.

    **Arguments:** `r0` of the target, mm, if it has one; `measured`: fit over the measured area, as
    is done for a camera without image size, instead of the whole image.

    **Returns:** the network, and by camera its `Conversion`.

    **Raises:** `InputError` if a size is missing, or nothing can be fitted.
    """
    model = key_of(model_of(model))
    rays = network.observations
    xy, sigma = rays.xy.copy(), rays.sigma.copy()
    of_ray = network.images.camera[rays.image]
    cameras, conversions = [], {}
    for c, camera in enumerate(network.cameras):
        if camera.model == model or (only is not None and camera.id not in only):
            cameras.append(camera)
            continue
        mask = of_ray == c
        converted_camera, conversion, shift, step = _convert(camera, model, r0, xy[mask], measured)
        xy[mask], sigma[mask] = shift + step * xy[mask], np.abs(step) * sigma[mask]
        cameras.append(converted_camera)
        conversions[camera.id] = conversion
    units = {get_model(camera.model).unit for camera in cameras}
    converted = network.replace(
        cameras=tuple(cameras),
        observations=dataclasses.replace(rays, xy=xy, sigma=sigma),
        image_unit=units.pop() if conversions and len(units) == 1 else network.image_unit,
    )
    kept_tables = tuple(table for table in network.further if not isinstance(table, Edges))
    if conversions and len(kept_tables) < len(network.further):
        converted = converted.replace(further=kept_tables).warn(
            "edges are dropped: their image points refer to the models before the conversion"
        )
    dropped_ids = [c.id for c in network.cameras if c.id in conversions and c.sigma]
    if dropped_ids:
        converted = converted.warn(
            f"prior σ of the parameters of {', '.join(dropped_ids)} are dropped: they refer to the "
            "model before the conversion"
        )
    return converted, conversions


def convert_one(
    camera: Camera, model: str | CameraModel, r0: float = 0.0
) -> tuple[Camera, Conversion]:
    """A camera in the model with this name, or a given one, and its `Conversion`."""
    converted, conversion, _, _ = _convert(camera, model, r0, np.zeros((0, 2)))
    return converted, conversion


def _convert(
    camera: Camera,
    model: str | CameraModel,
    r0: float,
    xy: Float[np.ndarray, "rays 2"],
    measured: bool = False,
):
    """The camera, the conversion, and shift and step of its image points."""
    source, target = get_model(camera.model), model_of(model)
    sizes = camera.image_size, camera.pixel_size
    parameters, centre = dict(camera.parameters), np.zeros(2)
    # `snavely` has no principal point: that of the camera is moved into the image coordinates.
    if model == "snavely" and camera.model != "bingo":
        parameters, centre, sizes = _centre(camera)
    area = None
    if len(xy) and (measured or camera.image_size is None):
        area = xy.min(0) - centre, xy.max(0) - centre
    try:
        conversion = convert_camera(
            source, parameters, target, image_size=sizes[0], pixel_size=sizes[1], area=area, r0=r0
        )
        shift, step = between_frames(source, target, *sizes)
        # The size that stands in for it is for the frame of the coordinates, not for a fit.
        if camera.image_size is None and area is None and not conversion.exact:
            raise ValueError("image_size is needed, since the conversion is fitted over the image")
    except ValueError as error:
        size = next((name for name in SIZES if str(error).startswith(name)), None)
        remedy = f"; give --{size.replace('_', '-')} WIDTH,HEIGHT" if size else ""
        raise InputError(f"camera {camera.id!r}: {error}{remedy}") from None
    converted = dataclasses.replace(
        camera,
        model=model,
        parameters=conversion.parameters,
        sigma={},
        observed={},
        free=_counterparts(camera.free, source, target),
        tie=camera.tie if source == target else (),
    )
    return converted, conversion, shift - step * centre, step


def _centre(camera: Camera):
    """The camera with its principal point at the image centre, and how far it was from there."""
    model, parameters = get_model(camera.model), dict(camera.parameters)
    names, size = model.principal_point, camera.image_size or (1, 1)
    if not names:
        return parameters, np.zeros(2), (size, camera.pixel_size)
    middle = (np.array(size) - 1) / 2 if model.axes == "down" else np.zeros(2)
    centre = np.array([parameters.get(name, 0.0) for name in names]) - middle
    parameters |= dict(zip(names, middle.tolist()))
    return parameters, centre, (size, camera.pixel_size)


def _counterparts(free: Sequence[str], source: CameraModel, target: CameraModel):
    """The free parameters of the target. Distortion parameters of user-defined models have no
    counterparts: to or from such a model either all default free parameters are free, or none."""
    if is_own(source) or is_own(target):
        fields = "principal_distance", "principal_point"
        free_names = {
            n for f in fields if {*getattr(source, f)} & {*free} for n in getattr(target, f)
        }
        distortion_names = {*free} - {*source.core} and {*target.free} - {*target.core}
        return tuple(name for name in target.parameters if name in free_names | distortion_names)
    groups: Mapping[str, tuple[str, ...]] = {n: group for group in COUNTERPARTS for n in group}
    free_names = {counterpart for name in free for counterpart in groups.get(name, (name,))}
    return tuple(name for name in target.parameters if name in free_names)
