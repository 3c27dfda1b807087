"""How well targets, circles and corners are measured in rendered photographs.

    python benchmarks/measuring.py [--json FILE]

Photographs as in the tests (`tests/measure/exact_render.py`): grey values of noise σ 1.5 with a
contrast of 190, blurred by 0.7 or 1.2 pixels, the object tilted by 0° or 25°. Targets: 20
discs each, their true centres those of the images of the circles (eccentricity taken into account).
Corners: `find_board_points` on a chessboard of 9 × 6, squares of 30 pixels. RMS of a coordinate in
pixels, against truth, and of errors over their stated σ, which should be 1. The exit status is 1 if
an RMS is above 0.05 pixels, or errors are more than 1.5 times their σ.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

import jaxbundle

jaxbundle.enable_x64()
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "measure"))

from exact_render import Cells, Rings, image_of, photograph, plane_to_pixels  # noqa: E402

from jaxbundle.measure import (  # noqa: E402
    Board,
    centre_by_ellipse,
    centre_by_grey_values,
    find_board_points,
)

LIMIT_PX, LIMIT_IN_SIGMA = 0.05, 1.5
PLACES = [(6.1 * i + 0.3 * j, 6.3 * j + 0.2 * i) for i in range(5) for j in range(4)]


def targets(radius, tilt, blur):
    """Errors and σ of both methods."""
    size = int(32 * radius + 30)
    H = plane_to_pixels(radius, tilt, 37, 20, (size / 2, size / 2), (13, 10), 90)
    discs = Rings(tuple((x, y, 0, 1, 0, 7, 0.0) for x, y in PLACES), 1.0)
    picture = photograph(discs, H, (size, size), blur)
    true = []
    for x, y in PLACES:  # the pole of the line at infinity
        circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - 1]])
        dual = H @ np.linalg.inv(circle) @ H.T
        true.append(dual[:2, 2] / dual[2, 2])
    for method in (centre_by_grey_values, centre_by_ellipse):
        found = [method(picture, place + [1.3, -1.1]) for place in true]
        yield np.array([t.xy for t in found]) - true, np.array([t.sigma for t in found])


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def targets_of_all():
    """RMS of a coordinate and of error/σ by both methods, for every radius and blur."""
    for radius in (2.3, 3.4, 5.6, 9.0):
        for blur in (0.7, 1.2):
            both = [list(targets(radius, tilt, blur)) for tilt in (0, 25)]
            found = {"radius_px": radius, "blur": blur}
            for k, method in enumerate(("grey_values", "ellipse")):
                errors = np.concatenate([b[k][0] for b in both])
                sigma = np.concatenate([b[k][1] for b in both])
                found[method] = {"rms_px": rms(errors), "error_over_sigma": rms(errors / sigma)}
            yield found


def corners_of_all():
    """RMS of a coordinate of a chessboard's corners and of error/σ, for every blur."""
    board, squares = Board(9, 6, 1.0), np.indices((7, 10)).sum(0) % 2
    table = np.pad(squares.astype(float), 1, constant_values=1.0)
    places = [[j + 2, i + 2] for i in range(6) for j in range(9)]
    for blur in (0.7, 1.2):
        errors, sigma = [], []
        for i, tilt in enumerate((0, 15, 25, 35)):
            H = plane_to_pixels(30, tilt, 5 * i, 50 * i, (200.3 + i / 4, 160.1), (6, 4.5), 30)
            found = find_board_points(photograph(Cells(table), H, (400, 320), blur, seed=i), board)
            errors.append(found.xy - image_of(H, places))
            sigma.append(np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)))
        errors, sigma = np.concatenate(errors), np.concatenate(sigma)
        yield {"blur": blur, "rms_px": rms(errors), "error_over_sigma": rms(errors / sigma)}


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
    print("\ncorners of a chessboard\nblur    RMS px  error/σ")
    for f in found["corners"]:
        print(f"{f['blur']:4.1f}  {f['rms_px']:8.3f}  {f['error_over_sigma']:7.2f}")


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
