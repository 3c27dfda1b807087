"""How often stated σ hold: coverage of 95 % intervals under errors that image points share.

    python benchmarks/coverage.py [--draws N] [--cases a,b] [--json FILE]

Twelve photographs of 63 points at 6 m, 1500 pixels principal distance, σ = 0.2 pixels, adjusted
from the truth with free interior orientation. Every draw has new noise and new disturbances.
Coverage of interior parameters, stations and points by classical σ and by those of the error model,
and the mean d²/n of the interior parameters (1 where their covariance is right). Exit status 1 if
the error model covers less than 92 or more than 98 % of a disturbance that it has a component for,
or less than 90 % of another, by more than the draws explain: the errors of a draw are common to all
of its unknowns, so that the share of one varies by about 0.15.
"""

import dataclasses
import sys
from collections.abc import Callable

import machine
import numpy as np

NOISE, IMAGES, QUANTILE = 0.2, 12, 1.959964
BEYOND = ("correlated 60 px", "correlated 200 px", "waves", "steps", "field in every image")
"""Disturbances that the error model has no component for."""


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--draws", type=machine.positive, default=200)
    parser.add_argument("--cases", default="", help="a,b: some of the disturbances")
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    import jaxbundle
    from jaxbundle.planning import grid_of_targets, ring_of_stations

    jaxbundle.enable_x64()
    camera = jaxbundle.Camera(
        "cam",
        "opencv",
        {"fx": 1500.0, "fy": 1500.0, "cx": 999.5, "cy": 749.5, "k1": -0.05},
        free=("fx", "fy", "cx", "cy", "k1", "k2"),
        image_size=(2000, 1500),
    )
    stations = ring_of_stations(IMAGES, 5.0, 6.0, roll_every=2)
    targets = grid_of_targets(9, 7, 0.6, relief=0.6)
    exact = jaxbundle.simulate(stations, targets, camera, noise=1e-9)
    # start values are the truth: those of the datum points define it
    exact = exact.replace(points=dataclasses.replace(exact.points, position=targets))
    sigma = np.full_like(exact.observations.sigma, NOISE)
    exact = exact.replace(observations=dataclasses.replace(exact.observations, sigma=sigma))
    disturb = Disturbances(exact)
    chosen = [name for name in options.cases.split(",") if name] or list(disturb.cases)
    figures, wrong = {"machine": machine.machine(), "draws": options.draws, "cases": {}}, []
    print("95 % intervals: interior orientation, stations, points; d²/n of the interior one")
    print(f"{'disturbance':24}{'classical':>30}{'correlated':>30}{'classical':>11}{'corr.':>7}")
    for name in chosen:
        inside, squares = [], []
        for seed in range(options.draws):
            rng = np.random.default_rng(seed)
            xy = exact.observations.xy + disturb.cases[name](rng)
            network = exact.replace(observations=dataclasses.replace(exact.observations, xy=xy))
            result = jaxbundle.adjust(network, correlated=True)
            inside.append(covered(result, camera, exact, targets))
            squares.append(interior_squares(result, camera))
        coverage, d2 = np.mean(inside, 0), np.mean(squares, 0)
        figures["cases"][name] = {"coverage": coverage.tolist(), "d2": d2.tolist()}
        cells = ["".join(f"{x:10.3f}" for x in row) for row in coverage]
        print(f"{name:24}{cells[0]}{cells[1]}{d2[0]:11.2f}{d2[1]:7.2f}", flush=True)
        chance = 3 * 0.15 / np.sqrt(options.draws)
        low, high = (0.9, 1.0) if name in BEYOND else (0.92, 0.98)
        if (coverage[1] < low - chance).any() or (coverage[1] > high + chance).any():
            wrong.append(f"{name}: σ do not hold")
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


def covered(result, camera, exact, targets) -> np.ndarray:
    """Shares of interior parameters, projection centres and points within 1.96 σ of the truth, by
    classical (first row) and correlated σ."""
    names, C = result.camera_covariance("cam", classical=True)
    K = result.correlated_camera_covariance("cam")
    p = result.camera_parameters("cam")
    interior = np.array([p[n] - camera.parameters.get(n, 0.0) for n in names])
    stations = result.image_values[:, :3] - exact.images.position
    points = result.point_values - targets
    diagonal = lambda C: np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))
    of = [
        (interior, diagonal(C), diagonal(K)),
        (
            stations,
            diagonal(result.classical_image_covariance)[:, :3],
            diagonal(result.correlated_image_covariance)[:, :3],
        ),
        (
            points,
            diagonal(result.classical_point_covariance),
            diagonal(result.correlated_point_covariance),
        ),
    ]
    return np.array([[np.mean(np.abs(d) < QUANTILE * s[k]) for d, *s in of] for k in (0, 1)])


def interior_squares(result, camera) -> list[float]:
    """d²/n of the interior parameters against the truth, classical and correlated."""
    names, C = result.camera_covariance("cam", classical=True)
    p = result.camera_parameters("cam")
    d = np.array([p[n] - camera.parameters.get(n, 0.0) for n in names])
    found = []
    for covariance in (C, result.correlated_camera_covariance("cam")):
        scale = np.sqrt(np.diag(covariance))
        R = covariance / np.outer(scale, scale)
        found.append(float((d / scale) @ np.linalg.solve(R, d / scale)) / len(d))
    return found


class Disturbances:
    """Errors of the image points of a network, [rays, 2] in pixels, by name."""

    def __init__(self, network):
        rays = network.observations
        self.image, self.point, self.xy = rays.image, rays.point, rays.xy
        low, high = self.xy.min(0), self.xy.max(0)
        self.x, self.y = 2 * (self.xy - (low + high) / 2).T / (high - low).max()
        station = network.images.position
        apart = np.linalg.norm(station[:, None] - station, axis=2) / 6.0
        self.along = np.linalg.cholesky(np.exp(-((apart / 0.5) ** 2)) + 1e-9 * np.eye(len(station)))
        white = lambda rng: NOISE * rng.standard_normal(self.xy.shape)
        t4 = lambda rng: NOISE * rng.standard_t(4, self.xy.shape) / np.sqrt(2)
        mixed = lambda share, length: (
            lambda rng: (
                np.sqrt(1 - share) * white(rng)
                + np.sqrt(share) * NOISE * self.field_of_images(rng, length)
            )
        )
        added = lambda more: lambda rng: white(rng) + more(rng)
        single: dict[str, Callable] = {
            "sensor field": lambda rng: 0.08 * self.field(rng, 300.0),
            "waves": lambda rng: 0.08 * np.sqrt(2) * np.sin(self.phases(rng)),
            "steps": lambda rng: 0.08 * np.sign(np.sin(self.phases(rng))),
            "field in every image": lambda rng: 0.08 * self.field_of_images(rng, 300.0),
            "affine 0.2 px": lambda rng: 0.2 * self.affine(rng),
            "principal point 0.5 px": lambda rng: 0.5 * self.by_image(rng),
        }
        tracks = lambda rng: np.sqrt(0.5) * (white(rng) + NOISE * self.along_tracks(rng))
        self.cases: dict[str, Callable] = {
            "white": white,
            "heavy tails": t4,
            "correlated 60 px": mixed(0.5, 60.0),
            "correlated 200 px": mixed(0.1, 200.0),
            **{name: added(more) for name, more in single.items()},
            "along tracks": tracks,
        }
        several = ("sensor field", "affine 0.2 px", "principal point 0.5 px")
        self.cases["all together"] = lambda rng: tracks(rng) + sum(single[n](rng) for n in several)

    def phases(self, rng) -> np.ndarray:
        return 3 * np.stack([self.y, self.x], 1) + rng.uniform(0, 2 * np.pi, 2)

    def by_image(self, rng) -> np.ndarray:
        return rng.standard_normal((IMAGES, 2))[self.image]

    def affine(self, rng) -> np.ndarray:
        a, b = self.by_image(rng).T
        return np.stack([a * self.x + b * self.y, b * self.x - a * self.y], 1)

    def field(self, rng, length: float, rows: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Of unit variance, normally distributed, correlated over a length on the sensor."""
        xy = self.xy[rows]
        apart = np.linalg.norm(xy[:, None] - xy, axis=2)
        K = np.exp(-((apart / length) ** 2)) + 1e-6 * np.eye(len(xy))
        return np.linalg.cholesky(K) @ rng.standard_normal((len(xy), 2))

    def field_of_images(self, rng, length: float) -> np.ndarray:
        found = np.zeros_like(self.xy)
        for image in range(IMAGES):
            rows = self.image == image
            found[rows] = self.field(rng, length, rows)
        return found

    def along_tracks(self, rng) -> np.ndarray:
        """Of unit variance, by point and axis correlated with the distance of the stations."""
        points = int(self.point.max()) + 1
        errors = np.einsum("ij,jpk->ipk", self.along, rng.standard_normal((IMAGES, points, 2)))
        return errors[self.image, self.point]


if __name__ == "__main__":
    sys.exit(main())
