"""How well targets, circles and corners are measured in rendered photographs.

    python benchmarks/measuring.py

Photographs as in the tests (`tests/measure/render.py`): 480 × 360 pixels, grey values of noise σ 2
with a contrast of 204, blurred by 0.7 or 1.2 pixels, the object tilted by 0° or 25°. Targets: 20
discs each, their true centres those of the images of the circles (eccentricity taken into account).
Corners: `find_board` on a chessboard of 9 × 6. RMS of a coordinate in pixels, against truth; for
targets also the RMS of errors over the σ they state, which should be 1.
"""

import sys
from pathlib import Path

import jax
import numpy as np

import jaxbundle

jaxbundle.enable_x64()
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "measure"))

import render  # noqa: E402

from jaxbundle.cameras import get_model  # noqa: E402
from jaxbundle.measure import (  # noqa: E402
    Board,
    centre_by_ellipse,
    centre_by_grey_values,
    circle_centre_shift,
    find_board,
)
from jaxbundle.orientation import Pose  # noqa: E402

PLACES = np.array([[0.06 * i, 0.06 * j, 0.0] for i in range(5) for j in range(4)])
MODEL, P, UP = get_model("opencv"), render.LENS.parameters, np.array([0.0, 0.0, 1.0])
shifts = jax.jit(jax.vmap(lambda pose, X, r: circle_centre_shift(MODEL, P, pose, X, UP, r),
                          (None, 0, None)))  # fmt: skip


def targets(radius, tilt, blur):
    """Errors and σ of both methods."""
    M, X0 = render.pose(tilt, -tilt, 40 * (tilt > 0), (0.12, 0.09), 0.55)
    pattern = render.discs(PLACES[:, :2], radius, margin=0.03)
    picture = render.photograph(render.LENS, M, X0, pattern, blur)
    true = render.LENS.image_of(M, X0, PLACES) + np.asarray(shifts(Pose(X0, M), PLACES, radius))
    for method in (centre_by_grey_values, centre_by_ellipse):
        found = [method(picture, place + [1.3, -1.1]) for place in true]
        yield np.array([t.xy for t in found]) - true, np.array([t.sigma for t in found])


def main():
    rms = lambda x: np.sqrt(np.mean(np.square(x)))
    print("targets            grey values         ellipse")
    print("radius px  blur    RMS px  error/σ     RMS px  error/σ")
    for radius in (0.002, 0.003, 0.005, 0.008):
        for blur in (0.7, 1.2):
            both = [list(targets(radius, tilt, blur)) for tilt in (0, 25)]
            cells = []
            for method in (0, 1):
                errors = np.concatenate([b[method][0] for b in both])
                sigma = np.concatenate([b[method][1] for b in both])
                cells.append(f"{rms(errors):6.3f}  {rms(errors / sigma):7.2f}")
            print(f"{radius * 620 / 0.55:9.1f}  {blur:4.1f}    {cells[0]}     {cells[1]}")
    board = Board(9, 6, 0.03)
    print("\ncorners of a chessboard\nblur    RMS px")
    for blur in (0.7, 1.2):
        errors = []
        for i, tilt in enumerate((0, 15, 25, 35)):
            M, X0 = render.pose(tilt, -tilt / 2, 20 * i, board.points.mean(0)[:2], 0.5)
            picture = render.photograph(
                render.LENS, M, X0, render.chessboard(9, 6, 0.03), blur, seed=i
            )
            errors.append(find_board(picture, board) - render.LENS.image_of(M, X0, board.points))
        print(f"{blur:4.1f}  {rms(np.concatenate(errors)):8.3f}")


if __name__ == "__main__":
    main()
