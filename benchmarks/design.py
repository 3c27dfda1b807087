"""What design by gradient gains, and whether simulation and adjustment confirm it.

    python benchmarks/design.py [points] [board]

Four stations in a row that measure points, and eight upright ones in front of a board that
calibrate a camera; the textbook's convergent layout of four with rolled cameras (Fraser 1984;
Luhmann et al. 2014, section 3.7), with the best radius and height under the same conditions. All
networks are simulated and adjusted 200 times.
"""

import itertools
import sys
import time

import numpy as np

import jaxbundle
from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network_design.pairs import make_pairs
from jaxbundle.network_design.proof import prove
from jaxbundle.network_design.realise import problem_of

jaxbundle.enable_x64()

CAMERA = jaxbundle.Camera(
    "cam", "brown", {"c": 24.0, "K1": -1e-4}, free=("c", "x0", "y0", "K1"),
    image_size=(6000, 4000), pixel_size=(0.006, 0.006),
)  # fmt: skip
SIGMA = 0.0012
"""σ of image coordinates, mm: a fifth of a pixel."""
ROOM = jaxbundle.Conditions(room=((-4, -4, 0.3), (4, 4, 3.5)), distance=(1.5, 6.0), apart=0.5)
DRAWS = 200


def weak_four() -> jaxbundle.Network:
    """Four stations in a row, all looking at the middle of a cloud of 24 points."""
    places = np.array([[3.0, y, 1.5] for y in (-0.75, -0.25, 0.25, 0.75)])
    stations = jaxbundle.stations_looking_at(places, np.zeros(3))
    targets = jaxbundle.cloud_of_targets(24, (2.0, 2.0, 1.0), seed=1)
    return jaxbundle.simulate(stations, targets, CAMERA, noise=SIGMA, seed=1)


def weak_eight() -> jaxbundle.Network:
    """Eight upright stations before a board, its points given, nearly frontal."""
    places = np.array([[x, y, 1.6] for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.12, 0.12)])
    stations = jaxbundle.stations_looking_at(places, np.zeros(3), up=(0, 1, 0))
    board = jaxbundle.grid_of_targets(7, 5, 0.15)
    return jaxbundle.simulate(
        stations, board, CAMERA, noise=SIGMA, seed=1, datum="control", control=range(35),
        residuals="measured",
    )


BOARD = jaxbundle.Conditions(
    room=((-1.5, -1.5, 0.5), (1.5, 1.5, 1.8)), distance=(0.5, 2.5), focus=(0.6, 2.5),
    incidence=np.radians(60), normals=(0, 0, 1), apart=0.1,
)  # fmt: skip


def textbook(network: jaxbundle.Network, aim: jaxbundle.Aim) -> tuple[float, tuple]:
    """The best convergent layout of four stations around the object, every other camera rolled."""
    best = np.inf, ()
    pairs = make_pairs(network, aim, ROOM, SIGMA)
    origin, start = pairs.problem.origin, pairs.problem.data.start
    for radius, height, turn in itertools.product(
        np.linspace(1.5, 4.0, 11), np.linspace(0.3, 3.5, 9), (0.0, np.pi / 4)
    ):
        stations = ring(radius, height, turn)
        low, high = np.array(ROOM.room)
        if not ((stations.position >= low) & (stations.position <= high)).all():
            continue
        values = placed(start, stations, origin)
        measured = pairs.measured(values)
        rays = np.bincount(pairs.problem.point[measured], minlength=len(start["point"]))
        if rays.min() < 2:
            continue
        found = pairs.aim_at(measured, values)
        if found < best[0]:
            best = found, (radius, height, turn, int(measured.sum()))
    return best


def ring(radius: float, height: float, turn: float):
    """Four stations around the object, rolled by 0°, 90°, 0°, 90°."""
    azimuth = turn + np.pi / 2 * np.arange(4)
    places = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(4, height)], 1)
    return jaxbundle.stations_looking_at(places, np.zeros(3), roll=np.pi / 2 * (np.arange(4) % 2))


def placed(start, stations, origin):
    """The start values with these stations."""
    rotation = np.array([quaternion_from_matrix(matrix_from_omega_phi_kappa(a))
                         for a in stations.angles])  # fmt: skip
    return start | {"image": PoseValue(stations.position - origin, rotation)}


def show(title: str, designed: jaxbundle.Design, seconds: float, least: float) -> bool:
    """Print a design and its proof; returns whether it is confirmed and gains at least this
    much."""
    proof = designed.prove(DRAWS)
    print(f"\n{title} ({seconds:.1f} s)\n{designed}\nproof: {proof}")
    problem = problem_of(designed.before.exact)
    if problem is not None:
        print("before:", prove(problem, designed.aim, DRAWS))
    return designed.gain >= least and proof.agrees


def main() -> int:
    """Design, prove, compare; 1 where something is not confirmed."""
    parts, good = sys.argv[1:] or ["points", "board"], []
    if "points" in parts:
        begin = time.perf_counter()
        points = jaxbundle.design(weak_four(), "mean", conditions=ROOM, starts=3)
        good.append(show("four stations in a row", points, time.perf_counter() - begin, 2.0))
        aim, (radius, height, turn, rays) = textbook(weak_four(), points.aim)
        print(f"textbook, radius {radius:.3g} m, height {height:.3g} m, turned by {turn:.3g}, "
              f"{rays} image points: {aim:.4g}; designed over textbook "
              f"{points.after.aim / aim:.3f}")  # fmt: skip
        good.append(points.after.aim <= aim)
    if "board" in parts:
        begin = time.perf_counter()
        aim = jaxbundle.Aim("mean", (("camera", "cam", "c"),))
        camera = jaxbundle.design(weak_eight(), aim, conditions=BOARD)
        good.append(show("eight photographs of a board", camera, time.perf_counter() - begin, 3.0))
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
