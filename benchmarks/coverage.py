"""How often stated σ hold: coverage of 95 % intervals under errors that image points share.

    python benchmarks/coverage.py [--network block|calibration|batch] [--draws N] [--cases a,b]
                                  [--json FILE]

`block`: twelve photographs of 63 points at 6 m, a free network; `calibration`: twenty views of a
known board of 88 points; `batch`: a hundred cameras (or --draws of them) from as many views of this
board, by `calibrate_batch`, with sizes of errors common to the batch. 1500 pixels principal
distance, σ = 0.2 pixels, adjusted from the truth with free interior orientation. Every draw, and
every camera of a batch, has new noise and new disturbances. Coverage of interior parameters,
stations and points by classical σ and by those of the error model; the mean d²/n of the interior
parameters (1 where their covariance is right); and how much larger σ are, the median of the
unknowns, in the mean of the draws. Exit status 1 if the error model covers less than 92 or more
than 98 % of a disturbance that it has a component for, or less than 90 % of another, by more than
the draws explain: the errors of a draw are common to all of its unknowns, so that the share of one
varies by about 0.15; or if σ of interior orientations grow by more than 5 % with white noise.
"""

import dataclasses
import sys
from collections.abc import Callable

import machine
import numpy as np

NOISE, QUANTILE = 0.2, 1.959964
BEYOND = ("correlated 60 px", "correlated 200 px", "waves", "steps", "field in every image")
"""Disturbances that the error model has no component for."""


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--network", choices=[*NETWORKS], default="block")
    parser.add_argument("--draws", type=machine.positive)
    parser.add_argument("--cases", default="", help="a,b: some of the disturbances")
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    import jaxbundle

    jaxbundle.enable_x64()
    exact = NETWORKS[options.network]()
    disturb = Disturbances(exact)
    draws = options.draws or (100 if options.network == "batch" else 200)
    run = batch if options.network == "batch" else one_by_one
    chosen = [name for name in options.cases.split(",") if name] or list(disturb.cases)
    figures, wrong = {"machine": machine.machine(), "draws": draws, "cases": {}}, []
    print("95 % intervals: interior orientation, stations, points; d²/n of the interior one; σ ×")
    print(f"{'disturbance':24}{'classical':>30}{'correlated':>30}{'classical':>11}{'corr.':>7}")
    for name in chosen:
        coverage, d2, grown = run(exact, disturb.cases[name], draws)
        figures["cases"][name] = {
            "coverage": coverage.tolist(), "d2": d2.tolist(), "grown": grown.tolist(),
        }  # fmt: skip
        cells = ["".join(f"{x:10.3f}" for x in row) for row in coverage]
        times = "".join(f"{x:7.3f}" for x in grown)
        print(f"{name:24}{cells[0]}{cells[1]}{d2[0]:11.2f}{d2[1]:7.2f}  ×{times}", flush=True)
        chance = 3 * 0.15 / np.sqrt(draws)
        low, high = (0.9, 1.0) if name in BEYOND else (0.92, 0.98)
        if (coverage[1] < low - chance).any() or (coverage[1] > high + chance).any():
            wrong.append(f"{name}: σ do not hold")
        if name == "white" and grown[0] > 1.05:
            wrong.append(f"white: σ grow by {100 * grown[0] - 100:.0f} %")
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


def camera():
    import jaxbundle

    return jaxbundle.Camera(
        "cam",
        "opencv",
        {"fx": 1500.0, "fy": 1500.0, "cx": 999.5, "cy": 749.5, "k1": -0.05},
        free=("fx", "fy", "cx", "cy", "k1", "k2"),
        image_size=(2000, 1500),
    )


def block():
    """Twelve photographs in a ring, a free network."""
    from jaxbundle.planning import grid_of_targets, ring_of_stations

    return without_noise(
        ring_of_stations(12, 5.0, 6.0, roll_every=2), grid_of_targets(9, 7, 0.6, relief=0.6)
    )


def calibration():
    """Twenty views of a board of 88 known points, turned by quarters, at 0.5 to 0.9 m."""
    from jaxbundle.planning.stations import stations_looking_at

    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(11) - 5.0, np.arange(8) - 3.5)
    board = 0.03 * np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], 1)
    tilt, azimuth = np.radians(rng.uniform(10, 45, 20)), rng.uniform(0, 2 * np.pi, 20)
    away = rng.uniform(0.5, 0.9, 20)
    X0 = away[:, None] * np.stack(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)], 1
    )
    at = np.concatenate([0.04 * rng.normal(size=(20, 2)), np.zeros((20, 1))], 1)
    placed = stations_looking_at(X0, at, roll=np.pi / 2 * (np.arange(20) % 4))
    network = without_noise(placed, board)
    points = dataclasses.replace(network.points, role=("fixed",) * len(board))
    return network.replace(points=points, datum="control")


NETWORKS = {"block": block, "calibration": calibration, "batch": calibration}


def without_noise(stations, targets):
    """The network of exact image points with the σ of `NOISE`, from the truth."""
    import jaxbundle

    exact = jaxbundle.simulate(stations, targets, camera(), noise=1e-9)
    # start values are the truth: those of the datum points define it
    exact = exact.replace(points=dataclasses.replace(exact.points, position=targets))
    sigma = np.full_like(exact.observations.sigma, NOISE)
    return exact.replace(observations=dataclasses.replace(exact.observations, sigma=sigma))


Figures = tuple[np.ndarray, np.ndarray, np.ndarray]


def one_by_one(exact, disturbance: Callable, draws: int) -> Figures:
    """Coverage [classical and correlated, kinds], d²/n of both, and σ over classical ones."""
    import jaxbundle

    found = []
    for seed in range(draws):
        xy = exact.observations.xy + disturbance(np.random.default_rng(seed))
        network = exact.replace(observations=dataclasses.replace(exact.observations, xy=xy))
        found.append(of_draw(jaxbundle.adjust(network, correlated=True), exact))
    return tuple(np.mean(one, 0) for one in zip(*found))


def of_draw(result, exact) -> Figures:
    p, true = result.camera_parameters("cam"), exact.cameras[0].parameters
    covariances = [result.camera_covariance("cam", classical=c) for c in (True, False)]
    names = covariances[0][0]
    interior = np.array([p[n] - true.get(n, 0.0) for n in names])
    diagonal = lambda C: np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))
    of = [
        (interior, *(diagonal(C) for _, C in covariances)),
        (
            result.image_values[:, :3] - exact.images.position,
            diagonal(result.classical_image_covariance)[:, :3],
            diagonal(result.image_covariance)[:, :3],
        ),
    ]
    if not exact.points.has_role("fixed").any():
        classical = diagonal(result.classical_point_covariance)
        of.append(
            (result.point_values - exact.points.position, classical,
             diagonal(result.point_covariance))
        )  # fmt: skip
    return summary(of, interior, [C for _, C in covariances])


def summary(of, interior, covariances) -> Figures:
    """Of errors with their classical and correlated σ, by kind."""
    inside = lambda d, s: np.mean(np.abs(d) < QUANTILE * s)
    coverage = np.array([[inside(d, s[k]) for d, *s in of] for k in (0, 1)])
    d2 = []
    for C in covariances:
        scale = np.sqrt(np.diag(C))
        d = interior / scale
        d2.append(float(d @ np.linalg.solve(C / np.outer(scale, scale), d)) / len(d))
    return coverage, np.array(d2), np.array([np.median(s[1] / s[0]) for _, *s in of])


def batch(exact, disturbance: Callable, cameras: int) -> Figures:
    """The same of the cameras of a batch."""
    import jaxbundle

    rays, views = exact.observations, len(exact.images)
    xy = np.full((cameras, views, len(exact.points), 2), np.nan)
    for seed in range(cameras):
        xy[seed, rays.image, rays.point] = rays.xy + disturbance(np.random.default_rng(seed))
    given = exact.cameras[0]
    found = jaxbundle.calibrate_batch(
        exact.points.position, xy, given.image_size, free=given.free, correlated="batch"
    )
    true = np.array([given.parameters.get(name, 0.0) for name in found.parameters])
    draws = []
    for k in np.flatnonzero(found.converged):
        interior, C = found.values[k] - true, (found.covariance[k], found.covariance_correlated[k])
        of = [
            (interior, found.sigma[k], found.sigma_correlated[k]),
            (
                found.position[k] - exact.images.position,
                found.sigma_position[k],
                found.sigma_position_correlated[k],
            ),
        ]
        draws.append(summary(of, interior, C))
    return tuple(np.mean(one, 0) for one in zip(*draws))


class Disturbances:
    """Errors of the image points of a network, [rays, 2] in pixels, by name."""

    def __init__(self, network):
        rays = network.observations
        self.image, self.point, self.xy = rays.image, rays.point, rays.xy
        low, high = self.xy.min(0), self.xy.max(0)
        self.x, self.y = 2 * (self.xy - (low + high) / 2).T / (high - low).max()
        station, X = network.images.position, network.points.position
        depth = np.median(np.linalg.norm(X[self.point] - station[self.image], axis=1))
        apart = np.linalg.norm(station[:, None] - station, axis=2) / depth
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
        return rng.standard_normal((len(self.along), 2))[self.image]

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
        for image in range(len(self.along)):
            rows = self.image == image
            found[rows] = self.field(rng, length, rows)
        return found

    def along_tracks(self, rng) -> np.ndarray:
        """Of unit variance, by point and axis correlated with the distance of the stations."""
        points = int(self.point.max()) + 1
        errors = rng.standard_normal((len(self.along), points, 2))
        errors = np.einsum("ij,jpk->ipk", self.along, errors)
        return errors[self.image, self.point]


if __name__ == "__main__":
    sys.exit(main())
