"""Realistic photographs of a chessboard, rendered, and as corners only."""

import numpy as np
import render

from jaxbundle.measure import Board

BOARD = Board(9, 6, 0.03)
PATTERN = render.chessboard(9, 6, 0.03)


def poses(number, seed=0, turned=True, middle=(0.12, 0.075)):
    """M and X0 of photographs from all around, near and far, some with a rolled camera."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(number):
        azimuth = 2 * np.pi * i / number
        tilt = rng.uniform(15, 35) * (i % 4 != 3)
        kappa = (0, 90, 180, -90)[i % 4] * turned + rng.uniform(-10, 10)
        aim = np.array(middle) + rng.uniform(-0.025, 0.025, 2)
        # the long side of the board across the short side of the image
        distance = rng.uniform(0.44, 0.6) + 0.1 * turned * (i % 2)
        found.append(
            render.pose(tilt * np.cos(azimuth), tilt * np.sin(azimuth), kappa, aim, distance)
        )
    return found


def corners(lens, views, board=BOARD):
    """Exact image points [views, points, 2]."""
    return np.array([lens.image_of(M, X0, board.points) for M, X0 in views])


def rendered(lens, views, pattern=PATTERN, **options):
    """The photographs."""
    return [
        render.photograph(lens, M, X0, pattern, seed=i, **options)
        for i, (M, X0) in enumerate(views)
    ]


def write_example(folder, number=12):
    """The photographs of examples/board, JPEG; in the last one the board is cut by the edge."""
    import cv2

    views = [*poses(number), render.pose(15, -20, 5, (0.02, 0.03), 0.42)]
    for i, picture in enumerate(rendered(render.LENS, views), 1):
        cv2.imwrite(f"{folder}/photo_{i:02d}.jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])


if __name__ == "__main__":
    import sys

    import jaxbundle

    jaxbundle.enable_x64()
    write_example(sys.argv[1])
