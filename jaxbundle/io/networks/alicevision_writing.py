"""Writing scenes of AliceVision (`.sfm`, version 1.2.5); the form is in `alicevision.py`."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.networks.losses import (
    CORE,
    changed,
    check_others_zero,
    describe_losses,
    losing,
    need_values,
    size_of,
    written_numbers,
)
from jaxbundle.io.networks.poses import matrices_of
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.network.tables import Camera, Network

VERSION = ("1", "2", "5")
# Coefficients by the type of an intrinsic, the first that has all that are not 0.
RADIAL = {"pinhole": (), "radial3": ("k1", "k2", "k3"), "brown": ("k1", "k2", "k3", "p1", "p2")}
FISHEYE = {"fisheye4": ("k1", "k2", "k3", "k4")}


def write_alicevision(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write a scene with views, intrinsics, poses and structure. Cameras must be of model `opencv`
    or `kannala-brandt` and have an image size.

    **Returns:** messages about what the format cannot hold.
    """
    need_values(network)
    images, points, rays = network.images, network.points, network.observations
    cameras = written_numbers([camera.id for camera in network.cameras])
    landmarks = written_numbers(points.id)
    R = flip_rows(matrices_of(images.angles))
    views, poses = [], []
    for i, (id, c) in enumerate(zip(images.id, images.camera.tolist())):
        w, h = size_of(network.cameras[c], "AliceVision")
        numbers = {"viewId": str(i), "poseId": str(i), "intrinsicId": str(cameras[c])}
        views.append(numbers | {"path": id, "width": str(w), "height": str(h)})
        # By columns.
        transform = {"rotation": _texts(R[i].T.ravel()), "center": _texts(images.position[i])}
        poses.append({"poseId": str(i), "pose": {"transform": transform | {"locked": "0"}}})
    point_observations: list[list[dict]] = [[] for _ in points.id]
    features = np.zeros(len(images), int)
    for i, p, xy in zip(rays.image.tolist(), rays.point.tolist(), rays.xy):
        point_observations[p].append(
            {"observationId": str(i), "featureId": str(features[i]), "x": _texts(xy)}
        )
        features[i] += 1
    # A landmark without a colour is grey, as the program has it.
    colours = points.colour_or_grey().tolist()
    structure = [
        {
            "landmarkId": str(number),
            "descType": "unknown",
            "color": [str(value) for value in colour],
            "X": _texts(X),
            "observations": observations,
        }
        for number, colour, X, observations in zip(
            landmarks, colours, points.position, point_observations
        )
    ]
    scene = {
        "version": list(VERSION),
        "featuresFolders": [],
        "matchesFolders": [],
        "views": views,
        "intrinsics": [_intrinsic(camera, n) for camera, n in zip(network.cameras, cameras)],
        "poses": poses,
        "structure": structure,
    }
    write_text(Path(path), json.dumps(scene, indent=1) + "\n")
    return describe_losses(network, ALICEVISION_LOSSES)


def _intrinsic(camera: Camera, number: int) -> dict[str, Any]:
    kinds = FISHEYE if camera.model == "kannala-brandt" else RADIAL
    p = check_others_zero(camera, "AliceVision", [*kinds.values()][-1])
    w, h = size_of(camera, "AliceVision")
    kind = next(k for k, names in kinds.items() if not any(p[n] for n in {*p} - {*CORE, *names}))
    # Any sensor will do: the focal length is stated in the same millimetres.
    sensor = w * (camera.pixel_size[0] if camera.pixel_size is not None else 1e-3)
    return {
        "intrinsicId": str(number),
        "width": str(w),
        "height": str(h),
        "sensorWidth": repr(float(sensor)),
        "sensorHeight": repr(float(sensor) * h / w),
        "type": kind,
        "focalLength": repr(float(p["fx"] / w * sensor)),
        "pixelRatio": repr(float(p["fy"] / p["fx"])),
        "principalPoint": _texts([p["cx"] - w / 2, p["cy"] - h / 2]),
        "distortionParams": _texts(p[name] for name in kinds[kind]),
        "locked": "0",
    }


def _texts(values: Any) -> list[str]:
    return [repr(float(value)) for value in values]


ALICEVISION_LOSSES = losing(
    "pixel sizes of cameras",
    "roles of points",
    partly={
        "names of cameras": lambda n: changed(
            [c.id for c in n.cameras], written_numbers([c.id for c in n.cameras])
        ),
        "names of points": lambda n: changed(n.points.id, written_numbers(n.points.id)),
    },
)
