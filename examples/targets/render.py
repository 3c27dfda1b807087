"""Renders the photographs of this folder: three sides of a box corner with targets.

    python examples/targets/render.py [FOLDER]

24 ring-coded targets of 14 bits and 36 plain discs, white on black, millimetres; the true
coordinates go into `truth.csv`, and a length, measured with an error, into `bars.csv`.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import jaxbundle
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.measure import ring_codes
from jaxbundle.planning import stations_looking_at

SIZE, FINE = (1024, 768), 4
K = np.array([[1100.0, 0, 515.2], [0, 1100.0, 380.9], [0, 0, 1]])
DISTORTION = np.array([-0.08, 0.02, 0.0, 0.0])
EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
RADIUS, SIDE, NOISE, BLUR = 9.0, 600.0, 1.5, 0.7
ENDS, SIGMA = ("4", "15"), 0.01
CENTRES = 600 * np.array([
    [2.1, 0.7, 0.8], [1.9, 1.3, 0.7], [1.3, 1.9, 0.8], [0.7, 2.1, 0.7],
    [2.0, 0.8, 1.7], [1.5, 1.5, 1.8], [0.8, 2.0, 1.7], [1.6, 1.4, 0.6],
])  # fmt: skip


def targets():
    """Number ("" of a plain disc), centre and two axes of every target."""
    rng = np.random.default_rng(4)
    found, number = [], 1
    for normal in range(3):
        e, f = np.eye(3)[(normal + 1) % 3], np.eye(3)[(normal + 2) % 3]
        for k in range(20):
            row, column = divmod(k, 5)
            a = (column + 0.5) / 5 + rng.uniform(-0.03, 0.03)
            b = (row + 0.5) / 4 + rng.uniform(-0.03, 0.03)
            coded = (row + column) % 2 == 0 and sum(bool(n) for n, *_ in found) < 8 * (normal + 1)
            found.append((str(number) if coded else "", SIDE * (a * e + b * f), e, f))
            number += coded
    return found


def light(ab, number):
    """Whether points of the plane of a target, in radii, are light."""
    r, t = np.hypot(*ab), np.arctan2(ab[1], ab[0])
    disc = r < 1
    if not number:
        return disc
    # clockwise as seen from before it
    code = ring_codes(14)[int(number) - 1]
    sector = (np.mod(-t, 2 * np.pi) / (2 * np.pi) * 14).astype(int) % 14
    return disc | ((r > 2) & (r < 3) & (code >> (13 - sector) & 1 == 1))


def photograph(X0, M, rng):
    """Grey values of a photograph: the mean over each pixel, blurred, with noise."""
    share = np.zeros(SIZE[::-1])
    # the parts of a pixel, and the half side of the window of a target
    part, half = (np.arange(FINE) + 0.5) / FINE - 0.5, 48
    for number, centre, e, f in targets():
        normal = np.cross(e, f)
        if (X0 - centre) @ normal < 0:
            continue
        seen = M @ (centre - X0)
        # without distortion, which moves it by up to ten pixels
        x, y = -seen[:2] / seen[2]
        at = round(K[0, 2] + K[0, 0] * x), round(K[1, 2] - K[1, 1] * y)
        u, v = (k + np.arange(-half, half + 1) for k in at)
        parts = [np.add.outer(k, part).ravel() for k in (u, v)]
        fine = np.stack(np.meshgrid(*parts), -1)
        xy = cv2.undistortPoints(fine.reshape(-1, 1, 2), K, DISTORTION, criteria=EXACT)
        # y upwards, the object before the camera at negative z
        rays = np.insert(xy.reshape(-1, 2) * [1, -1], 2, -1.0, axis=1) @ M
        s = ((centre - X0) @ normal) / (rays @ normal)
        offset = X0 + s[:, None] * rays - centre
        lit = light(np.stack([offset @ e, offset @ f]) / RADIUS, number)
        mean = lit.reshape(len(v), FINE, len(u), FINE).mean((1, 3))
        rows, columns = (v >= 0) & (v < SIZE[1]), (u >= 0) & (u < SIZE[0])
        place = np.ix_(v[rows], u[columns])
        share[place] = np.maximum(share[place], mean[np.ix_(rows, columns)])
    grey = cv2.GaussianBlur(25 + 175 * share, (0, 0), BLUR)
    return np.clip(grey + rng.normal(0, NOISE, grey.shape), 0, 255).round().astype(np.uint8)


def main(folder: Path) -> None:
    jaxbundle.enable_x64()
    rng = np.random.default_rng(1)
    stations = stations_looking_at(CENTRES, np.full((len(CENTRES), 3), 0.35 * SIDE))
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    for k, (X0, angles) in enumerate(zip(stations.position, stations.angles)):
        # a quarter turn of every second one separates principal point and attitude
        turned = np.array([*angles[:2], angles[2] + (k % 2) * np.pi / 2])
        M = np.asarray(matrix_from_omega_phi_kappa(turned))
        grey = photograph(X0, M, rng)
        file = folder / "photos" / f"photo_{k + 1}.jpg"
        cv2.imwrite(str(file), grey, [cv2.IMWRITE_JPEG_QUALITY, 92])
    all_targets = targets()
    rows = [f"{n},{','.join(f'{c:.4f}' for c in X)}" for n, X, *_ in all_targets if n]
    (folder / "truth.csv").write_text("\n".join(["id,X,Y,Z", *rows]) + "\n")
    ends = [X for n, X, *_ in all_targets if n in ENDS]
    length = np.linalg.norm(ends[1] - ends[0]) + rng.normal(0, SIGMA)
    bar = f"from,to,value,sigma\n{','.join(ENDS)},{length:.4f},{SIGMA}\n"
    (folder / "bars.csv").write_text(bar)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
