"""A small simulated drone block: nine photographs from 60 m, tie points, control points, satellite
positions with an offset; at the level below matching."""

import dataclasses

import numpy as np

import jaxbundle
from jaxbundle import Camera
from jaxbundle.network.tables import Points
from jaxbundle.planning.simulate import simulate_with_truth
from jaxbundle.planning.stations import Stations
from jaxbundle.reconstruction.adjusting import WeightedAdjustment
from jaxbundle.reconstruction.named import NamedMeasurements
from jaxbundle.reconstruction.oriented_block import FrameData

ORIGIN = np.array([235_000.0, 3_811_000.0, 250.0])
OFFSET = np.array([1.5, -2.0, 31.0])
"""Satellite positions minus control."""
SATELLITE = np.array([1.0, 1.0, 2.0])
F, SIZE = 1500.0, (2000, 1500)
CAMERA = Camera("drone", "opencv", {"fx": F, "fy": F, "cx": 999.5, "cy": 749.5},
                free=("fx", "cx", "cy", "k1"), tie=(("fx", "fy"),), image_size=SIZE,
                sigma={"fx": 0.2 * F, "cx": 20.0, "cy": 20.0, "k1": 0.3})  # fmt: skip
CONTROL, TIES = 9, 60
NAMES = tuple(f"gcp{k:02d}" for k in range(CONTROL))


@dataclasses.dataclass
class Drone:
    """True control points, the measurements of all points, the network without control, and given
    satellite positions."""

    truth: np.ndarray
    named: NamedMeasurements
    network: jaxbundle.Network
    images: tuple[str, ...]
    positions: tuple[np.ndarray, np.ndarray]
    blocks: dict = dataclasses.field(default_factory=dict)

    def given(self, X, sigma=np.nan, roles=None, positions=True, named=None) -> FrameData:
        """What a surveyor gives: control coordinates [9, 3] and their σ."""
        s = np.broadcast_to(np.asarray(sigma, float), (CONTROL, 3)).copy()
        points = Points(NAMES, roles or ("control",) * CONTROL, X, s)
        return FrameData(points, named or self.named, self.images, "EPSG:32611",
                     self.positions if positions else None)  # fmt: skip

    def block(self, positions=True) -> WeightedAdjustment:
        """The block adjusted without control, in the system of the positions or in its own; once
        for all tests."""
        if positions not in self.blocks:
            self.blocks[positions] = self._block(positions)
        return self.blocks[positions]

    def _block(self, positions: bool) -> WeightedAdjustment:
        network = self.network
        if not positions:
            images, points = network.images, network.points
            network = network.replace(
                images=dataclasses.replace(images, position=(images.position - ORIGIN) / 20.0,
                                           sigma=np.full((len(images), 6), np.nan)),
                points=dataclasses.replace(points, position=(points.position - ORIGIN) / 20.0),
                datum="inner",
            )  # fmt: skip
        result = jaxbundle.adjust(network)
        assert result.converged
        return WeightedAdjustment(result, {}, len(network.observations))


def swapped(named: NamedMeasurements, point: str, other: str) -> tuple[NamedMeasurements, int]:
    """Measurements in which one of a point has the place of another in the same photograph, and
    this row."""
    for k, (image, name) in enumerate(zip(named.image, named.name)):
        for n in np.flatnonzero(named.image == image):
            if name == point and named.name[n] == other:
                xy = named.xy.copy()
                xy[k] = named.xy[n] + 0.4
                return dataclasses.replace(named, xy=xy), k
    raise AssertionError(f"{point} and {other} are in no common photograph")


def drone_block(seed: int) -> Drone:
    """The block of a seed; its network lacks the measurement that `swapped` makes wrong, as if data
    snooping had removed it."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid([-18, 0, 18], [-14, 0, 14]), -1).reshape(-1, 2)
    X0 = np.concatenate([grid + rng.uniform(-2, 2, (9, 2)), rng.uniform(57, 63, (9, 1))], 1)
    angles = np.stack([*rng.uniform(-0.08, 0.08, (2, 9)), rng.uniform(-3, 3, 9)], 1)
    ground = lambda n, w: np.stack([rng.uniform(-w, w, n), rng.uniform(-w, w, n),
                                    rng.uniform(-3, 3, n)], 1)  # fmt: skip
    X = np.concatenate([ground(CONTROL, 22.0), ground(TIES, 45.0)]) + ORIGIN
    stations = Stations(X0 + ORIGIN, angles)
    simulated = simulate_with_truth(stations, X, CAMERA, noise=0.3, seed=seed)
    network, truth = simulated.network, simulated.truth
    ids = [NAMES[int(id)] if int(id) < CONTROL else f"t{id}" for id in _numbers(network.points.id)]
    rays = network.observations
    named = np.flatnonzero(np.array([ids[p] in NAMES for p in rays.point]))
    measured = NamedMeasurements(rays.image[named], tuple(ids[p] for p in rays.point[named]),
                     rays.xy[named].copy(), np.ones((len(named), 2)))  # fmt: skip
    manual = np.array([ids[p] in NAMES for p in rays.point])
    sigma = np.repeat(np.where(manual, 1.0, 0.3)[:, None], 2, 1)
    wrong = named[swapped(measured, "gcp04", "gcp00")[1]]
    kept = np.arange(len(rays)) != wrong
    satellite = truth.images.position + OFFSET + SATELLITE * rng.standard_normal((9, 3))
    spread = np.tile(SATELLITE, (9, 1))
    images = dataclasses.replace(
        network.images, position=satellite, angles=truth.images.angles,
        sigma=np.concatenate([spread, np.full((9, 3), np.nan)], 1),
    )  # fmt: skip
    position = truth.points.position + OFFSET
    network = network.replace(
        images=images, datum="control",
        observations=dataclasses.replace(rays, sigma=sigma).take(kept),
        points=Points(tuple(ids), ("tie",) * len(ids), position, np.full((len(ids), 3), np.nan)),
    )  # fmt: skip
    control = np.array([truth.points.position[ids.index(n)] for n in NAMES])
    return Drone(control, measured, network, network.images.id, (satellite, spread))


def _numbers(ids):
    """The targets of the points, counted from 0."""
    return [int(id) - 1 for id in ids]
