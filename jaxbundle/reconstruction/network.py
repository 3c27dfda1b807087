"""The network of a set of photographs: measured tie points, cameras with free parameters."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbundle.io.networks.control import with_control
from jaxbundle.network.build import make_further, make_network
from jaxbundle.network.tables import Camera, Network, Points
from jaxbundle.reconstruction.attitudes import Attitudes
from jaxbundle.reconstruction.named import Named
from jaxbundle.reconstruction.photographs import Cameras, Photograph
from jaxbundle.tiepoints.refinement import Measurements

PRIORS = {
    "fx": 0.2, "cx": 0.01, "cy": 0.01, "k1": 0.3, "k2": 0.1, "k3": 0.05, "p1": 1e-3, "p2": 1e-3,
}  # fmt: skip
"""σ of the parameters of an unknown camera before the adjustment, all of them free: of fx relative
to itself, of cx and cy to the longer side. What few photographs do not determine is then part of
the σ of the result; parameters held at usual values would bias the others by many σ."""
FEWEST_PHOTOGRAPHS = 8
"""Minimum photographs of a camera for pixels that need not be square."""
FEWEST_CONTROL = 3
"""Minimum control points in a part to transform it into their frame."""
OF_THE_LENS = ("fx", "k1", "k2", "k3")
"""Common parameters of cameras with one lens."""


@dataclasses.dataclass(frozen=True)
class Extra:
    """Further data of a network: named points including control, distances between
    them; positions of the photographs with their σ, and attitudes."""

    named: Named
    control: Points | None = None
    distances: tuple[dict, ...] = ()
    positions: tuple[np.ndarray, np.ndarray] | None = None
    attitudes: Attitudes | None = None


def tie_network(
    photographs: Sequence[Photograph],
    cameras: Cameras,
    measured: Measurements,
    extra: Extra,
    name: str,
) -> Network:
    """The network of the photographs with measurements; image coordinates in pixels."""
    rows = np.unique(measured.image).tolist()
    of = [cameras.of[k] for k in rows]
    used = sorted(set(of))
    lenses = [cameras.lens[c] for c in of]
    free = [_free(cameras.cameras[c], of.count(c), lenses.count(cameras.lens[c]), cameras.given)
            for c in used]  # fmt: skip
    tracks = [track_name(t) for t in np.unique(measured.track).tolist()]
    named = extra.named.take(np.isin(extra.named.image, rows))
    points = [*tracks, *dict.fromkeys(named.name)]
    names = np.array([p.name for p in photographs], dtype=object)
    images = {"id": names[rows], "camera": [cameras.cameras[c].id for c in of]}
    if extra.positions is not None:
        for values, prefix in zip(extra.positions, ("", "s")):
            images |= {f"{prefix}{axis}0": values[rows, i] for i, axis in enumerate("XYZ")}
    xy = np.concatenate([measured.xy, named.xy])
    sigma = np.concatenate([measured.sigma, named.sigma])
    there = set(points)
    distances = [d for d in extra.distances if {d["from"], d["to"]} <= there]
    network = make_network(
        free, images,
        {"id": points, "role": ["tie"] * len(points),
         **{axis: np.full(len(points), np.nan) for axis in "XYZ"}},
        {"image": names[np.concatenate([measured.image, named.image])],
         "point": [*map(track_name, measured.track.tolist()), *named.name],
         "x": xy[:, 0], "y": xy[:, 1], "sx": sigma[:, 0], "sy": sigma[:, 1]},
        distances or None, image_unit="px", name=name,
        datum="inner" if extra.positions is None else "control",
        object_unit="m" if distances or extra.positions is not None else "unit",
    )  # fmt: skip
    network = _with_ties(network, [cameras.lens[c] for c in used])
    control = extra.control
    if control is None or len(there & set(control.id)) < FEWEST_CONTROL:
        return network
    return with_control(network, control).replace(object_unit="m")


def track_name(track: int) -> str:
    """The id of a tie point."""
    return f"t{track}"


def _with_ties(network: Network, lens: Sequence[int]) -> Network:
    """The network with common parameters of cameras with one lens."""
    first, columns = {}, {"camera": [], "other": [], "parameter": []}
    for camera, number in zip(network.cameras, lens):
        one = first.setdefault(number, camera)
        for name in OF_THE_LENS if one is not camera else ():
            if name in one.free and name in camera.free:
                for column, value in zip(columns.values(), (one.id, camera.id, name)):
                    column.append(value)
    if not columns["camera"]:
        return network
    return network.replace(further=(*network.further, *make_further({"ties": columns}, 1.0)))


def _free(camera: Camera, own: int, of_lens: int, given: bool) -> Camera:
    """A camera with free parameters, observed with their `PRIORS`; a calibrated one is held."""
    if given:
        return camera
    free = tuple(PRIORS)
    units = dict.fromkeys(free, 1.0) | dict.fromkeys(("cx", "cy"), max(camera.image_size or (1, 1)))
    units["fx"] = camera.parameters["fx"]
    sigma = {name: relative * units[name] for name, relative in PRIORS.items()}
    if own >= FEWEST_PHOTOGRAPHS and own == of_lens:
        camera, free = dataclasses.replace(camera, tie=()), ("fx", "fy", *free[1:])
        sigma["fy"] = sigma["fx"]
    return dataclasses.replace(camera, free=free, sigma=sigma)
