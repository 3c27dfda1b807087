"""Points and orientations as tables of comma-separated values.

`NAME.csv` has the points, `NAME_images.csv` the exterior orientations, angles in the network's
unit; the columns are those of a project's tables, without σ or colours if there are none, and for
points the mean reprojection error, `error_px` or `error_mm`, which is not read again.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from jaxbundle.io.networks.losses import describe_losses, losing
from jaxbundle.io.text.csv_tables import write_csv
from jaxbundle.io.writing.replacing import replace_files
from jaxbundle.network.build import IMAGE_COLUMNS, POINT_COLOURS, POINT_COLUMNS, POINT_SIGMAS
from jaxbundle.network.reprojection import point_errors
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS


def images_path(path: Path) -> Path:
    """Path of the orientations beside the points."""
    return path.with_name(f"{path.stem}_images{path.suffix}")


def write_coordinates(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write both tables; a missing value is an empty cell.

    **Returns:** messages about what is lost.
    """
    path = Path(path)
    images, points = network.images, network.points
    angles = images.angles / ANGLE_UNITS[network.angle_unit]
    camera = [network.cameras[c].id for c in images.camera]
    sigma = np.isfinite(points.sigma).any()
    errors, unit = point_errors(network)
    numbers = np.concatenate(
        [points.position, *([points.sigma] if sigma else []), errors[:, None]], 1
    )
    coloured = points.colour is not None
    header = (
        *(*POINT_COLUMNS, *(POINT_SIGMAS if sigma else ()), f"error_{unit}"),
        *(POINT_COLOURS if coloured else ()),
    )
    rgb = points.colour_or_grey()[:, : 3 if coloured else 0].tolist()
    rows = zip(points.id, points.role, numbers.tolist(), rgb)
    with replace_files(images_path(path), path) as (of_images, of_points):
        write_csv(
            of_images,
            IMAGE_COLUMNS,
            (
                (id, c, *_cells(row))
                for id, c, row in zip(
                    images.id, camera, np.concatenate([images.position, angles], 1).tolist()
                )
            ),
        )
        write_csv(
            of_points, header, ((id, role, *_cells(row), *rgb) for id, role, row, rgb in rows)
        )
    return describe_losses(network, COORDINATES_LOSSES)


# What it loses; `NAME_images.csv` names the cameras.
COORDINATES_LOSSES = losing(
    "interior orientations",
    "image points",
    keeping=("roles of points", "σ of control points"),
)


def _cells(numbers: Iterable[float]) -> Iterator[str]:
    # x != x: NaN
    return ("" if x != x else "free" if x == np.inf else repr(x) for x in numbers)
