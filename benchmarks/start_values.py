"""Settings of start values, each halved and doubled: what is oriented, and how well.

    python benchmarks/start_values.py [SETTING …]

Networks without start values, all with a camera whose distortion is not known and with a tenth of
the image points wrong: an aerial block with control in its corners, a strip without control,
convergent images of a flat object, images all around an object. A row tells, for a value of a
setting, how many of all images and points were oriented, how many image points of those that are
right were left out and of the wrong ones kept, the largest error of a projection centre after the
similarity of the points to the truth, relative to the extent of the centres, and the time of the
processors. The first row is that of the defaults; a setting whose rows equal it is not critical
here.
"""

import argparse
import dataclasses
import time

import numpy as np

import jaxbundle
from jaxbundle.errors import NotSolvedError
from jaxbundle.orientation.alignment import similarity_of_most
from jaxbundle.orientation.network import find_start_values
from jaxbundle.orientation.settings import DEFAULTS
from jaxbundle.planning.simulate import Simulation

FORMAT = (36.0, 24.0)
TRUE = jaxbundle.Camera("wide", "brown", {"c": 24.0, "x0": 0.1, "K1": -1e-4})
NOMINAL = jaxbundle.Camera("wide", "brown", {"c": 24.0})


def networks(blunders: float) -> dict[str, Simulation]:
    """Networks and their truth; this share of the image points is wrong."""
    common = dict(noise=0.005, seed=3, start=NOMINAL, image_format=FORMAT)
    block = jaxbundle.aerial_block(3, 7, height=80.0, footprint=(120.0, 80.0))
    strip = jaxbundle.aerial_block(1, 12, height=80.0, footprint=(120.0, 80.0))
    ring = jaxbundle.ring_of_stations(8, 6.0, 5.0, roll_every=2)
    low = jaxbundle.ring_of_stations(16, 6.0, 1.0)
    cloud = lambda n, size: jaxbundle.cloud_of_targets(n, size, seed=1)
    made = {
        "block": jaxbundle.simulate_with_truth(
            block, cloud(400, (400, 200, 12)), TRUE, control=range(12), control_sigma=0.02,
            datum="control", **common,
        ),
        "strip": jaxbundle.simulate_with_truth(strip, cloud(250, (640, 80, 12)), TRUE, **common),
        "flat": jaxbundle.simulate_with_truth(
            ring, jaxbundle.grid_of_targets(9, 9, 0.5, relief=0.005), TRUE, **common
        ),
        "around": jaxbundle.simulate_with_truth(
            low, cloud(200, (2, 2, 2)), TRUE, max_incidence=1.0, normals=_outward(200),
            **common,
        ),
    }  # fmt: skip
    return {name: _without_start_values(found, blunders) for name, found in made.items()}


def _outward(points: int) -> np.ndarray:
    """Normals of the targets of the cloud, away from its middle: half of them are hidden."""
    return jaxbundle.cloud_of_targets(points, (2, 2, 2), seed=1) + 1e-9


def _without_start_values(simulation: Simulation, blunders: float) -> Simulation:
    network, rng = simulation.network, np.random.default_rng(5)
    images, points, rays = network.images, network.points, network.observations
    nothing = np.full((len(images), 3), np.nan)
    tie = points.has_role("tie")[:, None]
    wrong = rng.random(len(rays)) < blunders
    xy = rays.xy + wrong[:, None] * rng.uniform(-9, 9, rays.xy.shape)
    network = network.replace(
        images=dataclasses.replace(images, position=nothing, angles=nothing),
        points=dataclasses.replace(points, position=np.where(tie, np.nan, points.position)),
        observations=dataclasses.replace(rays, xy=xy),
    )
    return Simulation(network, simulation.truth)


def measure(cases: dict[str, Simulation], settings) -> str:
    """One row: the sums over all networks, the worst error, the time."""
    placed = known = lost = kept = 0
    worst, begin = 0.0, time.process_time()
    for case in cases.values():
        try:
            found = find_start_values(case.network, settings=settings)
        except NotSolvedError:
            worst = np.inf
            continue
        rays = case.truth.observations
        size = np.abs(case.network.observations.xy - rays.xy).max(1)
        pairs = lambda n: {
            (n.images.id[i], n.points.id[p])
            for i, p in zip(n.observations.image, n.observations.point)
        }
        used = pairs(found.network)
        ids = [(case.truth.images.id[i], case.truth.points.id[p])
               for i, p in zip(rays.image, rays.point)]  # fmt: skip
        there = np.array([id in used for id in ids])
        placed, known = placed + len(found.network.images), known + len(found.network.points)
        lost, kept = lost + (~there & (size < 0.05)).sum(), kept + (there & (size > 3)).sum()
        rows = [case.truth.points.id.index(id) for id in found.network.points.id]
        moved = similarity_of_most(found.network.points.position, case.truth.points.position[rows])
        rows = [case.truth.images.id.index(id) for id in found.network.images.id]
        truth, X0 = case.truth.images.position[rows], found.network.images.position
        if moved is None:
            worst = np.inf
            continue
        off = np.linalg.norm(X0 @ moved[0].T + moved[1] - truth, axis=1)
        worst = max(worst, float(off.max() / np.ptp(truth, axis=0).max()))
    seconds = time.process_time() - begin
    return f"{placed:6d} {known:6d} {lost:6d} {kept:6d} {worst:9.4f} {seconds:7.1f} s"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", nargs="*")
    # Those of intermediate adjustments have no effect without `improve`.
    unused = "first_improvement", "improvement_growth"
    names = [f.name for f in dataclasses.fields(DEFAULTS) if f.name not in unused]
    chosen = parser.parse_args().settings or names
    jaxbundle.enable_x64()
    title = f"{'images':>6} {'points':>6} {'lost':>6} {'kept':>6} {'error':>9} {'time':>9}"
    cases = networks(0.1)
    measure(cases, DEFAULTS)  # compiles
    print(f"{'':28} {title}\n{'defaults':28} {measure(cases, DEFAULTS)}", flush=True)
    for name in chosen:
        value = getattr(DEFAULTS, name)
        for changed in (value / 2, value * 2):
            changed = type(value)(changed)
            settings = dataclasses.replace(DEFAULTS, **{name: changed})
            print(f"{f'{name} {changed:g}':28} {measure(cases, settings)}", flush=True)


if __name__ == "__main__":
    main()
