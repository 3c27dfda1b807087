"""The network of a set of photographs: measured tie points, cameras with free parameters (what is
known of these before: `camera_priors`)."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbundle.network.build import make_network
from jaxbundle.network.tables import ESTIMATED, Network
from jaxbundle.reconstruction.attitudes import MapAttitudes
from jaxbundle.reconstruction.camera_priors import (
    LENS_PARAMETERS,
    PARAMETERS,
    with_camera_priors,
    with_common_lens_parameters,
)
from jaxbundle.reconstruction.named import NamedMeasurements
from jaxbundle.reconstruction.photographs import Cameras, Photograph
from jaxbundle.tiepoints.track_measurement import Measurements


@dataclasses.dataclass(frozen=True)
class FurtherData:
    """Further data of a network: named points including control, distances between
    them; positions of the photographs with their σ, and attitudes; the `unit` that distances and
    positions give the network. (Coordinates of control: `georeferencing`.)"""

    named: NamedMeasurements
    distances: tuple[dict, ...] = ()
    positions: tuple[np.ndarray, np.ndarray] | None = None
    attitudes: MapAttitudes | None = None
    unit: str = "m"


def photograph_network(
    photographs: Sequence[Photograph],
    cameras: Cameras,
    measured: Measurements,
    extra: FurtherData,
    name: str,
    aspect_sigma: float,
    angle_unit: str,
) -> Network:
    """The network of the photographs with measurements; image coordinates in pixels.

    **Arguments:** `aspect_sigma`: of fy/fx about 1; infinite: not observed; `angle_unit` of the
    results."""
    # Without tie points of features the named ones connect the photographs.
    rows = np.unique(measured.image if len(measured) else extra.named.image).tolist()
    camera_of_image = [cameras.camera_of[k] for k in rows]
    used_cameras = sorted(set(camera_of_image))
    free = [cameras.cameras[c] for c in used_cameras]
    if not cameras.calibrated:
        free = [dataclasses.replace(camera, free=PARAMETERS) for camera in free]
    tracks = [track_name(t) for t in np.unique(measured.track).tolist()]
    # Photographs without tie points are not in the network.
    named_measurements = extra.named.take(np.isin(extra.named.image, rows))
    points = [*tracks, *dict.fromkeys(named_measurements.name)]
    names = np.array([p.name for p in photographs], dtype=object)
    images = {"id": names[rows], "camera": [cameras.cameras[c].id for c in camera_of_image]}
    if extra.positions is not None:
        for values, prefix in zip(extra.positions, ("", "s")):
            images |= {f"{prefix}{axis}0": values[rows, i] for i, axis in enumerate("XYZ")}
    unknown = {axis: np.full(len(points), np.nan) for axis in "XYZ"}
    xy = np.concatenate([measured.xy, named_measurements.xy])
    sigma = np.concatenate([measured.sigma, named_measurements.sigma])
    observations = {
        "image": names[np.concatenate([measured.image, named_measurements.image])],
        "point": [*map(track_name, measured.track.tolist()), *named_measurements.name],
    }
    observations |= {"x": xy[:, 0], "y": xy[:, 1], "sx": sigma[:, 0], "sy": sigma[:, 1]}
    point_ids = set(points)
    distances = [d for d in extra.distances if {d["from"], d["to"]} <= point_ids]
    network = make_network(
        free,
        images,
        {"id": points, "role": ["tie"] * len(points), **unknown},
        observations,
        distances or None,
        image_unit="px",
        angle_unit=angle_unit,
        name=name,
        sigma_origin=ESTIMATED,
        # Positions give frame and scale; without them inner constraints define the frame, and scale
        # bars the scale.
        datum="inner" if extra.positions is None else "control",
        object_unit=extra.unit if distances or extra.positions is not None else "unit",
    )
    # Of the photograph whose window is matched in the others.
    tracks, colours = measured.track[measured.is_template], measured.colour[measured.is_template]
    colour_of = dict(zip(map(track_name, tracks.tolist()), colours.tolist()))
    network = network.replace(points=network.points.with_colours(colour_of))
    if not cameras.calibrated:
        stated_distances = [cameras.stated_distances[c] for c in used_cameras]
        lens = [cameras.lens[c] for c in used_cameras]
        # With pixels that may not be square, fx of portrait format is fy of landscape format.
        of_lens = LENS_PARAMETERS if np.isfinite(aspect_sigma) else LENS_PARAMETERS[1:]
        network = with_common_lens_parameters(
            with_camera_priors(network, stated_distances, lens, of_lens, aspect_sigma),
            lens,
            of_lens,
        )
    return network


def track_name(track: int) -> str:
    """The id of a tie point."""
    return f"t{track}"
