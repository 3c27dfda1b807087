"""The network of a set of photographs: measured tie points, cameras with what is free."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbundle.network.build import make_network
from jaxbundle.network.tables import Camera, Network
from jaxbundle.reconstruction.photographs import Cameras, Photograph
from jaxbundle.tiepoints.refinement import Measurements

PRIORS = {"fx": 0.2, "cx": 0.02, "cy": 0.02}
"""σ of start values, in parts of the principal distance, of the longer side: so wide that they
count only where photographs determine nothing."""
K1_PRIOR = 0.3
BY_NUMBER = ((3, ("fx", "k1")), (4, ("cx", "cy")), (5, ("k2", "p1", "p2")))
"""What is free from how many photographs of a camera on."""


def tie_network(
    photographs: Sequence[Photograph], cameras: Cameras, measured: Measurements, name: str
) -> Network:
    """The network of the photographs that measurements name; image coordinates in pixels."""
    rows = np.unique(measured.image).tolist()
    of = [cameras.of[k] for k in rows]
    used = sorted(set(of))
    free = [_freed(cameras.cameras[c], of.count(c), cameras.given) for c in used]
    tracks = np.unique(measured.track)
    names = np.array([p.name for p in photographs], dtype=object)
    return make_network(
        free,
        {"id": names[rows], "camera": [cameras.cameras[c].id for c in of]},
        {"id": tracks.astype(str), "role": ["tie"] * len(tracks),
         **{axis: np.full(len(tracks), np.nan) for axis in "XYZ"}},
        {"image": names[measured.image], "point": measured.track.astype(str),
         "x": measured.xy[:, 0], "y": measured.xy[:, 1],
         "sx": measured.sigma[:, 0], "sy": measured.sigma[:, 1]},
        datum="inner", image_unit="px", object_unit="unit", name=name,
    )  # fmt: skip


def _freed(camera: Camera, number: int, given: bool) -> Camera:
    if given:
        return camera
    free = tuple(n for least, names in BY_NUMBER if number >= least for n in names)
    f, size = camera.parameters["fx"], max(camera.image_size or (1, 1))
    sigma = {"fx": PRIORS["fx"] * f, "cx": PRIORS["cx"] * size, "cy": PRIORS["cy"] * size,
             "k1": K1_PRIOR}  # fmt: skip
    return dataclasses.replace(
        camera, free=free, sigma={n: s for n, s in sigma.items() if n in free}
    )
