"""What is known of unknown cameras before the adjustment, as observations of their parameters.

Wide σ for all, the principal distance that the files state, fy/fx = 1, and the equality of
parameters of one lens.
"""

from collections.abc import Sequence

import numpy as np

from jaxbundle.network.build import make_further
from jaxbundle.network.kinds import CameraParameters
from jaxbundle.network.tables import Network
from jaxbundle.photographs.exif import StatedDistance

# σ of the parameters of an unknown camera before the adjustment, all of them free: of fx relative
# to itself (unless the files state it), of cx and cy to the longer side. What few photographs do
# not determine is then part of the σ of the result; parameters held at usual values would bias the
# others by many σ.
#
# They are wide, so that half or double changes a well-determined camera by far less than its σ: fx
# of start values from matches is a few per cent wrong, seldom 20; principal points of cameras lie
# within 1 %, 30 pixels of 3000; K1 of lenses with fx near the longer side is between −0.3 and 0.1,
# K2 and K3 are smaller, and move the corners, r = 0.6, by 8 and 1.4 ‰ of fx; P1 and P2 by 1 ‰.
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
# Parameters of an unknown camera that are estimated.
PARAMETERS = ("fx", "fy", *(name for name in PRIORS if name != "fx"))
ASPECT = "fy/fx"
# Common parameters of cameras with one lens: of photographs in portrait and landscape format. The
# first only if pixels are square.
LENS_PARAMETERS = ("fx", "k1", "k2", "k3")


def with_camera_priors(
    network: Network,
    stated_distances: Sequence[StatedDistance | None],
    lens: Sequence[int],
    of_lens: Sequence[str],
    aspect_sigma: float,
) -> Network:
    """The network with what is known of its unknown cameras as observations; what is common to the
    cameras of one lens is observed once."""
    rows = []
    for k, (camera, file) in enumerate(zip(network.cameras, stated_distances)):
        side = max(camera.image_size or (1, 1))
        for name, relative in PRIORS.items():
            # Equal parameters are one unknown: a second observation would count its prior twice.
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
    return next((kind for kind in network.further if isinstance(kind, CameraParameters)), None)


def with_observed(network: Network, observed: CameraParameters) -> Network:
    """The network with other observed parameters of its cameras."""
    other_kinds = [kind for kind in network.further if not isinstance(kind, CameraParameters)]
    return network.replace(further=(*other_kinds, observed))


def with_common_lens_parameters(
    network: Network, lens: Sequence[int], of_lens: Sequence[str]
) -> Network:
    """The network with the lens parameters of cameras with one lens made equal (table `ties`)."""
    first_of_lens, rows = {}, []
    for camera, number in zip(network.cameras, lens):
        first_camera = first_of_lens.setdefault(number, camera)
        if first_camera is not camera:
            rows += [(first_camera.id, camera.id, name) for name in of_lens]
    if not rows:
        return network
    columns = dict(zip(("camera", "other", "parameter"), map(list, zip(*rows))))
    return network.replace(further=(*network.further, *make_further({"ties": columns}, 1.0)))
