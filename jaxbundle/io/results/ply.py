"""Points and cameras as a PLY file: vertices with their colours, or by role in a network without;
edges of the cameras' pyramids.

Binary, little endian, coordinates in double precision. `error` is the mean reprojection error of a
point, NaN if it has none (a comment in the header gives its unit).

Source: Turk (1994), The PLY Polygon File Format.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxbundle.io.networks.losses import describe_losses, losing, need_values
from jaxbundle.io.results.pyramids import pyramids
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.network.reprojection import point_errors
from jaxbundle.network.tables import Network

COLOURS = {
    "tie": (160, 160, 160),
    "control": (0, 120, 255),
    "fixed": (0, 60, 160),
    "check": (0, 180, 80),
}
VERTEX = np.dtype([("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f4")])


def write_ply(
    network: Network, path: str | Path, colours: Mapping[str, Sequence[int]] | None = None
) -> tuple[str, ...]:
    """Write points and cameras; points without coordinates are left out.

    **Arguments:** `colours`: red, green, blue of points by id; the others have the colour of the
    network, or are coloured by role if it has none.

    **Returns:** messages about what is lost.
    """
    need_values(network, points=False)
    has_coordinates = np.all(np.isfinite(network.points.position), axis=1)
    corners, edges = pyramids(network)
    vertices = np.zeros(has_coordinates.sum() + 5 * len(corners), VERTEX)
    point_count = int(has_coordinates.sum())
    vertices["position"][:point_count] = network.points.position[has_coordinates]
    errors, unit = point_errors(network)
    vertices["error"][:point_count], vertices["error"][point_count:] = (
        errors[has_coordinates],
        np.nan,
    )
    vertices["position"][point_count:] = corners.reshape(-1, 3)
    rgb = network.points.colour
    if rgb is None:
        rgb = np.array([COLOURS[role] for role in network.points.role], np.uint8).reshape(-1, 3)
    if colours:
        point_colours = [
            colours.get(id, network_colour)
            for id, network_colour in zip(network.points.id, rgb.tolist())
        ]
        rgb = np.array(point_colours, np.uint8)
    vertices["colour"][:point_count] = rgb[has_coordinates]
    vertices["colour"][point_count:] = (220, 40, 40)  # red: cameras, against the blues of points
    edges = (edges.reshape(-1, 2) + point_count).astype("<i4")
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {point_count} points, then pyramids of {len(corners)} images (error NaN)",
        f"comment error: mean reprojection error in {unit}",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "property float error",
        f"element edge {len(edges)}",
        "property int vertex1",
        "property int vertex2",
        "end_header\n",
    ]
    write_bytes(Path(path), "\n".join(head).encode() + vertices.tobytes() + edges.tobytes())
    return describe_losses(network, PLY_LOSSES)


# What it loses; roles of points are colours at most, which nothing reads.
PLY_LOSSES = losing(
    "interior orientations",
    "names of cameras",
    "names of images",
    "names of points",
    "image points",
    partly={"points": lambda n: int((~np.isfinite(n.points.position)).any(1).sum())},
)
