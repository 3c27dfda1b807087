"""Simulated views of a board, to test a calibration before taking photographs."""

import numpy as np

from jaxbundle.arguments import at_least_zero
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.cameras import get_model
from jaxbundle.cameras.pixel_frame import in_pixels
from jaxbundle.errors import InputError
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.tables import Camera
from jaxbundle.planning.simulate import simulate
from jaxbundle.planning.stations import Stations


def simulate_views(
    board: Board, camera: Camera, stations: Stations, *, noise: float, seed: int = 0
) -> BoardViews:
    """The image points of a board, photographed from some stations.

        stations = jaxbundle.stations_looking_at(places, aims, up=(0, 1, 0))
        views = simulate_views(Board(9, 6, 0.03), camera, stations, noise=0.1)
        calibration = jaxbundle.calibrate(views, model="opencv")

    The board lies in the plane Z = 0 and is seen from Z > 0, X to the right, Y up (`Board.points`).

    **Arguments:** `camera`, with its true parameters and an `image_size`; `noise`: σ of an image
    coordinate, pixels; `seed` of the noise.

    **Returns:** `BoardViews`, one view per station, named "1", "2", …; points outside the image are
    NaN.

    **Raises:** `InputError` for a camera without image size, for a station behind the board, and if
    no point is imaged.
    """
    require_board(board)
    noise = at_least_zero("noise", noise)
    if camera.image_size is None:
        raise InputError(f"camera {camera.id!r}: image_size is needed, in pixels")
    for row in np.flatnonzero(stations.position[:, 2] <= 0)[:1]:
        raise InputError(f"station {row + 1} is behind the board, at Z ≤ 0; expected Z > 0")
    model, points = get_model(camera.model), board.points
    width, height = unit_size(model, camera.pixel_size)
    network = simulate(
        stations, points, camera, noise=(noise * width, noise * height), seed=seed, min_rays=1
    )
    rays = network.observations
    # `simulate` keeps the points that have rays; the board has all, in its own order
    xy = np.full((len(stations), len(points), 2), np.nan)
    number = np.array([int(id) - 1 for id in network.points.id])
    uv = in_pixels(rays.xy, model, camera.image_size, camera.pixel_size)
    xy[rays.image, number[rays.point]] = uv
    columns, rows = (int(n) for n in camera.image_size)
    return BoardViews(board, tuple(network.images.id), (columns, rows), xy)
