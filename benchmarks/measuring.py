"""How well targets, circles and corners are measured in rendered photographs.

    python benchmarks/measuring.py [--json FILE]

Photographs as in the tests (`tests/measure/render.py`): 480 × 360 pixels, grey values of noise σ 2
with a contrast of 204, blurred by 0.7 or 1.2 pixels, the object tilted by 0° or 25°. Targets: 20
discs each, their true centres those of the images of the circles (eccentricity taken into account).
Corners: `find_board` on a chessboard of 9 × 6. RMS of a coordinate in pixels, against truth; for
targets also the RMS of errors over their stated σ, which should be 1. The exit status is 1 if an
RMS is above 0.05 pixels, or errors are more than twice their σ.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import machine
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

LIMIT_PX, LIMIT_IN_SIGMA = 0.05, 2.0
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


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def targets_of_all():
    """RMS of a coordinate and of error/σ by both methods, for every radius and blur."""
    for radius in (0.002, 0.003, 0.005, 0.008):
        for blur in (0.7, 1.2):
            both = [list(targets(radius, tilt, blur)) for tilt in (0, 25)]
            found = {"radius_px": radius * 620 / 0.55, "blur": blur}
            for k, method in enumerate(("grey_values", "ellipse")):
                errors = np.concatenate([b[k][0] for b in both])
                sigma = np.concatenate([b[k][1] for b in both])
                found[method] = {"rms_px": rms(errors), "error_over_sigma": rms(errors / sigma)}
            yield found


def corners_of_all():
    """RMS of a coordinate of a chessboard's corners, for every blur."""
    board = Board(9, 6, 0.03)
    for blur in (0.7, 1.2):
        errors = []
        for i, tilt in enumerate((0, 15, 25, 35)):
            M, X0 = render.pose(tilt, -tilt / 2, 20 * i, board.points.mean(0)[:2], 0.5)
            picture = render.photograph(
                render.LENS, M, X0, render.chessboard(9, 6, 0.03), blur, seed=i
            )
            errors.append(find_board(picture, board) - render.LENS.image_of(M, X0, board.points))
        yield {"blur": blur, "rms_px": rms(np.concatenate(errors))}


def show(found):
    """The figures as text."""
    print(machine.in_words(found["machine"]))
    print("targets            grey values         ellipse")
    print("radius px  blur    RMS px  error/σ     RMS px  error/σ")
    for f in found["targets"]:
        cells = [
            f"{f[method]['rms_px']:6.3f}  {f[method]['error_over_sigma']:7.2f}"
            for method in ("grey_values", "ellipse")
        ]
        print(f"{f['radius_px']:9.1f}  {f['blur']:4.1f}    {cells[0]}     {cells[1]}")
    print("\ncorners of a chessboard\nblur    RMS px")
    for f in found["corners"]:
        print(f"{f['blur']:4.1f}  {f['rms_px']:8.3f}")


def complaints(found):
    """Errors above the limit, or above the stated σ."""
    of_targets = [
        (f"targets of {f['radius_px']:.1f} pixels by {method}, blur {f['blur']}", f[method])
        for f in found["targets"] for method in ("grey_values", "ellipse")
    ]  # fmt: skip
    of_corners = [(f"corners, blur {f['blur']}", f) for f in found["corners"]]
    return [
        f"{name}: RMS {f['rms_px']:.3f} pixels, error/σ {f.get('error_over_sigma', 1):.2f}"
        for name, f in of_targets + of_corners
        if not (f["rms_px"] <= LIMIT_PX and f.get("error_over_sigma", 1) <= LIMIT_IN_SIGMA)
    ]


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    given = parser.parse_args()
    found = {
        "machine": machine.machine(),
        "targets": list(targets_of_all()),
        "corners": list(corners_of_all()),
    }
    if given.json != "-":
        show(found)
    machine.write_json(found, given.json)
    return machine.verdict(complaints(found))


if __name__ == "__main__":
    sys.exit(main())
