"""The network of a set of photographs: measured tie points, cameras with free parameters."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbundle.network.build import make_further, make_network
from jaxbundle.network.kinds import CameraParameters
from jaxbundle.network.tables import ESTIMATED, Network
from jaxbundle.photographs.exif import StatedDistance
from jaxbundle.reconstruction.attitudes import MapAttitudes
from jaxbundle.reconstruction.named import NamedMeasurements
from jaxbundle.reconstruction.photographs import Cameras, Photograph
from jaxbundle.tiepoints.track_measurement import Measurements

PRIORS = {
    "fx": 0.2,
    "cx": 0.01,
    "cy": 0.01,
    "k1": 0.3,
    "k2": 0.1,
    "k3": 0.05,
    "p1": 1e-3,
    "p2": 1e-3,
}
"""σ of the parameters of an unknown camera before the adjustment, all of them free: of fx relative
to itself (unless the files state it), of cx and cy to the longer side. What few photographs do not
determine is then part of the σ of the result; parameters held at usual values would bias the others
by many σ.

They are wide, so that half or double changes a well-determined camera by far less than its σ: fx of
start values from matches is a few per cent wrong, seldom 20; principal points of cameras lie within
1 %, 30 pixels of 3000; K1 of lenses with fx near the longer side is between −0.3 and 0.1, K2 and K3
are smaller, and move the corners, r = 0.6, by 8 and 1.4 ‰ of fx; P1 and P2 by 1 ‰."""
PARAMETERS = ("fx", "fy", *(name for name in PRIORS if name != "fx"))
"""Parameters of an unknown camera that are estimated."""
ASPECT = "fy/fx"
LENS_PARAMETERS = ("fx", "k1", "k2", "k3")
"""Common parameters of cameras with one lens: of photographs in portrait and landscape format. The
first only if pixels are square."""


@dataclasses.dataclass(frozen=True)
class FurtherData:
    """Further data of a network: named points including control, distances between
    them; positions of the photographs with their σ, and attitudes. (Coordinates of control:
    `georeferencing`.)"""

    named: NamedMeasurements
    distances: tuple[dict, ...] = ()
    positions: tuple[np.ndarray, np.ndarray] | None = None
    attitudes: MapAttitudes | None = None


def tie_network(
    photographs: Sequence[Photograph],
    cameras: Cameras,
    measured: Measurements,
    extra: FurtherData,
    name: str,
    aspect_sigma: float,
) -> Network:
    """The network of the photographs with measurements; image coordinates in pixels.

    **Arguments:** `aspect_sigma`: of fy/fx about 1; infinite: not observed."""
    rows = np.unique(measured.image).tolist()
    of = [cameras.camera_of[k] for k in rows]
    used = sorted(set(of))
    free = [cameras.cameras[c] for c in used]
    if not cameras.calibrated:
        free = [dataclasses.replace(camera, free=PARAMETERS) for camera in free]
    tracks = [track_name(t) for t in np.unique(measured.track).tolist()]
    named = extra.named.take(np.isin(extra.named.image, rows))
    points = [*tracks, *dict.fromkeys(named.name)]
    names = np.array([p.name for p in photographs], dtype=object)
    images = {"id": names[rows], "camera": [cameras.cameras[c].id for c in of]}
    if extra.positions is not None:
        for values, prefix in zip(extra.positions, ("", "s")):
            images |= {f"{prefix}{axis}0": values[rows, i] for i, axis in enumerate("XYZ")}
    unknown = {axis: np.full(len(points), np.nan) for axis in "XYZ"}
    xy = np.concatenate([measured.xy, named.xy])
    sigma = np.concatenate([measured.sigma, named.sigma])
    observations = {
        "image": names[np.concatenate([measured.image, named.image])],
        "point": [*map(track_name, measured.track.tolist()), *named.name],
    }
    observations |= {"x": xy[:, 0], "y": xy[:, 1], "sx": sigma[:, 0], "sy": sigma[:, 1]}
    there = set(points)
    distances = [d for d in extra.distances if {d["from"], d["to"]} <= there]
    network = make_network(
        free,
        images,
        {"id": points, "role": ["tie"] * len(points), **unknown},
        observations,
        distances or None,
        image_unit="px",
        name=name,
        sigma_origin=ESTIMATED,
        # positions give frame and scale; without them inner constraints define the frame, and scale
        # bars the scale
        datum="inner" if extra.positions is None else "control",
        object_unit="m" if distances or extra.positions is not None else "unit",
    )
    if not cameras.calibrated:
        stated = [cameras.stated_distances[c] for c in used]
        lens = [cameras.lens[c] for c in used]
        # with pixels that may not be square, fx of portrait format is fy of landscape format
        of_lens = LENS_PARAMETERS if np.isfinite(aspect_sigma) else LENS_PARAMETERS[1:]
        network = _with_ties(_observe(network, stated, lens, of_lens, aspect_sigma), lens, of_lens)
    return network


def track_name(track: int) -> str:
    """The id of a tie point."""
    return f"t{track}"


def _observe(
    network: Network,
    stated: Sequence[StatedDistance | None],
    lens: Sequence[int],
    of_lens: Sequence[str],
    aspect_sigma: float,
) -> Network:
    """The network with what is known of its unknown cameras as observations; what is common to the
    cameras of one lens is observed once."""
    rows = []
    for k, (camera, file) in enumerate(zip(network.cameras, stated)):
        side = max(camera.image_size or (1, 1))
        for name, relative in PRIORS.items():
            # equal parameters are one unknown: a second observation would count its prior twice
            if name in of_lens and lens[k] in lens[:k]:
                continue
            if name == "fx" and file is not None:
                rows.append((camera.id, name, file.value, file.sigma))
                continue
            value = camera.parameters.get(name, 0.0) if name in ("fx", "cx", "cy") else 0.0
            unit = {"fx": value, "cx": side, "cy": side}.get(name, 1.0)
            rows.append((camera.id, name, value, relative * unit))
        if np.isfinite(aspect_sigma):
            rows.append((camera.id, ASPECT, 1.0, aspect_sigma))
    columns = dict(zip(("camera", "parameter", "value", "sigma"), map(list, zip(*rows))))
    return network.replace(
        further=(*network.further, *make_further({CameraParameters.TABLE: columns}, 1.0))
    )


def observed_parameters(network: Network) -> CameraParameters | None:
    """The observed parameters of the cameras."""
    return next((one for one in network.further if isinstance(one, CameraParameters)), None)


def with_observed(network: Network, observed: CameraParameters) -> Network:
    """The network with other observed parameters of its cameras."""
    others = [one for one in network.further if not isinstance(one, CameraParameters)]
    return network.replace(further=(*others, observed))


def _with_ties(network: Network, lens: Sequence[int], of_lens: Sequence[str]) -> Network:
    """The network with common parameters of cameras with one lens."""
    first, rows = {}, []
    for camera, number in zip(network.cameras, lens):
        other = first.setdefault(number, camera)
        if other is not camera:
            rows += [(other.id, camera.id, name) for name in of_lens]
    if not rows:
        return network
    columns = dict(zip(("camera", "other", "parameter"), map(list, zip(*rows))))
    return network.replace(further=(*network.further, *make_further({"ties": columns}, 1.0)))
