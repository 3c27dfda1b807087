"""Points and cameras as a DXF drawing, by ezdxf (extra `files`).

Layers: POINTS_TIE, POINTS_CONTROL, POINTS_FIXED, POINTS_CHECK with POINT entities and POINT_NAMES
with their names; CAMERAS with the pyramids as lines and CAMERA_NAMES.
"""

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.losses import describe_losses, losing, need_values
from jaxbundle.io.results.pyramids import pyramids
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.network.tables import ROLES, Network

if TYPE_CHECKING:
    from ezdxf.layouts.layout import Modelspace

# Numbers of AutoCAD's colour index.
COLOURS = {"tie": 8, "control": 5, "fixed": 4, "check": 3, "camera": 1}


def write_dxf(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write points and cameras; points without coordinates are left out.

    **Returns:** messages about what is lost.

    **Raises:** `InputError` if ezdxf is not installed.
    """
    try:
        import ezdxf
        import ezdxf.filemanagement
    except ImportError:
        raise InputError("DXF needs ezdxf: pip install 'jaxbundle[files]'") from None
    need_values(network, points=False)
    drawing = ezdxf.filemanagement.new("R2010")
    for role in ROLES:
        drawing.layers.add(f"POINTS_{role.upper()}", color=COLOURS[role])
    for layer in ("POINT_NAMES", "CAMERAS", "CAMERA_NAMES"):
        drawing.layers.add(layer, color=COLOURS["camera" if layer[0] == "C" else "tie"])
    space = drawing.modelspace()
    points = network.points
    has_coordinates = np.isfinite(points.position).all(1)
    corners, _ = pyramids(network)
    all_positions = np.concatenate([points.position[has_coordinates], corners.reshape(-1, 3)])
    height = 0.01 * float(np.ptp(all_positions, axis=0).max())  # of names, legible on a full page
    for row in np.flatnonzero(has_coordinates):
        position = tuple(points.position[row].tolist())
        space.add_point(position, dxfattribs={"layer": f"POINTS_{points.role[row].upper()}"})
        _write_name(space, points.id[row], position, height, "POINT_NAMES")
    for id, pyramid in zip(network.images.id, corners.tolist()):
        centre, *base = map(tuple, pyramid)
        for a, b in [*((centre, c) for c in base), *zip(base, [*base[1:], base[0]])]:
            space.add_line(a, b, dxfattribs={"layer": "CAMERAS"})
        _write_name(space, id, centre, height, "CAMERA_NAMES")
    text = io.StringIO()
    drawing.write(text)
    write_text(Path(path), text.getvalue())
    return describe_losses(network, DXF_LOSSES)


# What it loses; roles of points are layers.
DXF_LOSSES = losing(
    "interior orientations",
    "names of cameras",
    "colours of points",
    "image points",
    keeping=("roles of points",),
    partly={"points": lambda n: int((~np.isfinite(n.points.position)).any(1).sum())},
)


def _write_name(
    space: "Modelspace", name: str, position: tuple[float, ...], height: float, layer: str
) -> None:
    # Control characters would break the lines of the file.
    safe = "".join(c if c.isprintable() else "_" for c in name)
    space.add_text(safe, height=height, dxfattribs={"layer": layer, "insert": position})
