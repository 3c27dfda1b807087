"""False alarms and volumes of `change`, from images to significance: pairs of satellite images of
one place in two years are refined with control, matched, and compared, many times.

    OPENBLAS_NUM_THREADS=1 python benchmarks/change.py [--draws 100] [--pixels 200] [--json FILE]

Two images with RPC of 0.5 m look at hills ahead and back in each year, from other angles in the
second; there a heap of 4 m has been tipped. Every draw has another texture of the ground, new noise
in all images, coefficients shifted by 6 pixels (σ), new measurements of eight control points (0.3
pixel, 0.15 m) and of thirty tie points. `refine` adjusts each pair; surfaces are matched with the
compensated coefficients; `change` carries the covariance of both refinements to every cell of 1 m.
Given are

- the share of unchanged cells that are called changed at 5 %, mean over the draws and its σ;
  without stable ground the share of a draw is 0 or large, as the errors of its orientations: so
  also the mean over a hundred other such errors for the matches of each draw;
- how often the volume of the heap, and of squares of 20 m of unchanged ground, is within 2 σ of the
  truth, 95 % expected, and the RMS of their errors over σ, 1 expected;
- the share of false alarms if the covariance of the refinements is left out;

all of it also where a third of the ground is known to be stable.
"""

import dataclasses
import os
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

CELL, NOISE, SHIFT = 1.0, 2.0, 6.0
PITCHES = (-0.22, 0.22), (-0.15, 0.27)
CONTROL, TIES, SIGMA_PIXEL, SIGMA_CONTROL = 8, 30, 0.3, 0.15
HEAP, RADIUS = 4.0, 9.0
HEIGHTS = -30.0, 40.0


def heap(X, Y):
    """The heap, as heights over the hills."""
    return HEAP * np.exp(-((X - 20) ** 2 + (Y + 15) ** 2) / (2 * (RADIUS / 2) ** 2))


@dataclasses.dataclass
class Year:
    """The true coefficients of a pair of images, and what they look at."""

    rpcs: list
    views: list
    around: object
    field: object
    sensor: object

    def photograph(self, seed):
        """Both images without noise, of ground with a texture of its own for every `seed`."""
        import surface_satellite as satellite

        from jaxbundle.planning.rendering import Scene
        from jaxbundle.planning.texture import Texture

        scene = Scene((self.field,), (Texture(satellite.GSD / 2, seed=seed),))
        shots = [satellite.photograph(view, scene, self.sensor) for view in self.views]
        return [shot.grey.astype(np.float32) for shot in shots]


def years(pixels):
    """Both pairs, and the heights of the ground."""
    import surface_satellite as satellite

    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.planning.rendering import Sensor
    from jaxbundle.planning.shapes import HeightField
    from jaxbundle.pushbroom.rpc.fitting import fit_image
    from jaxbundle.surfaces.scanner_views import RpcView, neighbourhood

    side = pixels * satellite.GSD
    grounds = [satellite.hills, lambda X, Y: satellite.hills(X, Y) + heap(X, Y)]
    found, around = [], None
    for k, (pitches, ground) in enumerate(zip(PITCHES, grounds)):
        field = HeightField(ground, (-2 * side, -2 * side, 2 * side, 2 * side))
        rpcs, views = [], []
        for image, target in satellite.passes(pixels, pitches):
            around = neighbourhood(*target) if around is None else around
            rpc = fit_image(image, WGS84, (-200.0, 300.0))[0].rpc
            views.append(RpcView("", np.zeros((pixels, pixels), np.float32), rpc, around))
            rpcs.append(rpc)
        sensor = Sensor(gain=1 - 0.2 * k, offset=10 * k)
        found.append(Year(rpcs, views, around, field, sensor))
    return found, grounds


def refined_views(year, greys, name, ground, rng, half):
    """The images of a year as views, with the coefficients and covariance of a refinement."""
    from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed
    from jaxbundle.io.scanner.refined_orientations import joint_covariance
    from jaxbundle.network.tables import Observations
    from jaxbundle.pushbroom.rpc.bias import RpcBias, apply_bias, domain_of_bias
    from jaxbundle.pushbroom.rpc.image import RpcImage
    from jaxbundle.pushbroom.rpc.polynomials import project_points
    from jaxbundle.refinement import RpcScannerImage, local_points, refine
    from jaxbundle.refinement.rpc_points import prior_of_bias
    from jaxbundle.surfaces.ground_orientation import rpc_orientation
    from jaxbundle.surfaces.scanner_views import RpcView

    n = CONTROL + TIES
    x, y = rng.uniform(-0.8 * half, 0.8 * half, (2, n))
    place = [np.asarray(v) for v in year.around.geographic(np.stack([x, y, ground(x, y)]))]
    X = np.stack([np.asarray(v) for v in earth_fixed(WGS84, tuple(place))], 1)
    images, places = [], []
    for k, rpc in enumerate(year.rpcs):
        shift = SHIFT * rng.normal(size=(2, 1))
        wrong = apply_bias(rpc, RpcBias(*shift))[0]
        size = greys[k].shape
        images.append(RpcScannerImage(f"{name}{k}", RpcImage(wrong, *size), prior_of_bias(0)))
        line, sample, _ = (np.asarray(v) for v in project_points(rpc, *place))
        places.append(np.stack([line, sample], 1) + SIGMA_PIXEL * rng.normal(size=(n, 2)))
    given = X + SIGMA_CONTROL * rng.normal(size=X.shape)
    given[CONTROL:] = np.nan
    roles = ["control"] * CONTROL + ["tie"] * TIES
    points = local_points([f"P{k}" for k in range(n)], roles, given, SIGMA_CONTROL)
    image, point = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    sigma = np.full((2 * n, 2), SIGMA_PIXEL)
    found = refine(images, points, Observations(image, point, np.concatenate(places), sigma))
    joint, views = joint_covariance(found), []
    for k, one in enumerate(images):
        noisy = greys[k] + NOISE * rng.normal(size=greys[k].shape)
        grey = (9 * np.clip(noisy, 0, 255) + 200).astype(np.uint16)
        view = RpcView(one.id, grey, found.image(one.id).rpc, year.around)
        view.orientation = rpc_orientation(joint, one.id, domain_of_bias(one.image.rpc))
        views.append(view)
    return views


def surface_of(views, half):
    """The surface of a pair as cells with the errors of its orientations."""
    from jaxbundle.surfaces.dsm import make_dsm
    from jaxbundle.surfaces.height_cells import HeightGrid, UncertainCells
    from jaxbundle.surfaces.orientation import orientation_errors
    from jaxbundle.surfaces.oriented_errors import OrientedErrors
    from jaxbundle.surfaces.reconstruct import ground_bounds, reconstruct_surface
    from jaxbundle.surfaces.relative import align_all

    bounds, _ = ground_bounds(views, HEIGHTS)
    align_all(views, bounds)
    cloud = reconstruct_surface(views, bounds, {0: [1]}, dense=True).cloud
    inside = (np.abs(cloud.X[:, :2]) < half).all(1)
    dsm = make_dsm(cloud.take(inside), CELL)
    grid = HeightGrid(dsm.height, dsm.own_sigma, dsm.x, dsm.y, dsm.size)
    errors = OrientedErrors(orientation_errors(views), (True, True), None, None)
    return grid, UncertainCells(grid, (errors,))


NAMES = ("false_alarms", "volume", "without_orientations", "sigma_ratio", "cells_of_the_heap",
         "redrawn")  # fmt: skip
CORNERS = (-35, -35), (-35, -13), (-13, -35), (-13, -13)
SIDE, REDRAWN = 20, 100


def squares(x, y, ground):
    """Squares of unchanged ground, numbered from 2 on."""
    labels = np.zeros(x.shape, int)
    for k, (left, low) in enumerate(CORNERS, 2):
        labels[(x > left) & (x < left + SIDE) & (y > low) & (y < low + SIDE) & ground] = k
    return labels


def redrawn_alarms(L, own_errors, sigma, limit, rng):
    """The share of false alarms of the same matches over many errors of the orientations: that of
    one is 0 or large, so that the mean of a hundred says little."""
    t = rng.normal(size=(REDRAWN, len(L)))
    return np.mean([np.mean(np.abs(own_errors + one @ L) > limit * sigma) for one in t])


def draw(pairs, grounds, rng, half, seed):
    """One comparison, without and with stable ground: share of false alarms, error of the volume of
    the heap over its σ, share of false alarms without the covariance of the orientations, scatter
    of cells, share of the cells of the heap that have heights, share of false alarms over redrawn
    errors of the orientations; errors of the volumes of squares of unchanged ground over their σ.
    """
    from jaxbundle.surfaces.change import find_change
    from jaxbundle.surfaces.height_cells import align

    made = [
        surface_of(refined_views(year, year.photograph(seed), f"{k}", ground, rng, half), half)
        for k, (year, ground) in enumerate(zip(pairs, grounds))
    ]
    before, after = align(*(cells for _, cells in made))
    rows, columns = before.shape
    x = before.x + (np.arange(columns) + 0.5) * CELL
    y = before.y - (np.arange(rows) + 0.5) * CELL
    x, y = np.meshgrid(x, y)
    risen = heap(x, y)
    distance = np.hypot(x - 20, y + 15)
    ground = distance > 2.5 * RADIUS
    stable = ground & (y > half / 3)
    ground &= ~stable
    labels = squares(x, y, ground)
    labels[distance < 1.5 * RADIUS] = 1
    whole = slice(0, rows), slice(0, columns)
    found_rows, alone = [], align(*(grid for grid, _ in made))
    for given in (None, stable):
        found = find_change(before, after, 0.05, given, labels)
        without = find_change(*alone, 0.05, given, labels)
        tested, known = ground & found.known, (labels == 1) & found.known
        on_heap, *level = found.regions
        truth = float(risen[known].sum()) * CELL**2
        redrawn = np.nan
        if given is None:
            L = np.concatenate([one.window(*whole).modes for one in (before, after)])[:, tested]
            d, own = found.difference[tested], found.sigma[tested] ** 2 - np.sum(L**2, axis=0)
            A = (L / np.sqrt(own)).T
            # without its shared errors, which the truth of all unchanged cells tells
            errors = d - np.linalg.lstsq(A, d / np.sqrt(own), rcond=None)[0] @ L
            redrawn = redrawn_alarms(L, errors, found.sigma[tested], found.limit, rng)
        found_rows.append((
            np.mean(found.sign[tested] != 0),
            (on_heap.volume - truth) / on_heap.sigma,
            np.mean(without.sign[tested] != 0),
            found.sigma_ratio,
            known.sum() / (labels == 1).sum(),
            redrawn,
            *((one.volume - risen[(labels == one.label) & found.known].sum()) / one.sigma
              for one in level),
        ))  # fmt: skip
    return found_rows


def conclude(rows):
    """Figures of all draws."""
    rows = np.array(rows)
    values, level = dict(zip(NAMES, rows.T)), rows[:, len(NAMES) :]
    rms = lambda a: float(np.sqrt(np.mean(a**2)))
    alarms, redrawn = values["false_alarms"], float(values["redrawn"].mean())
    figures = {
        "false_alarms": float(alarms.mean()),
        "sigma_of_false_alarms": float(alarms.std() / np.sqrt(len(alarms))),
        "false_alarms_without_orientations": float(values["without_orientations"].mean()),
        "heaps_within_2_sigma": float(np.mean(np.abs(values["volume"]) < 2)),
        "rms_of_heap_errors_by_sigma": rms(values["volume"]),
        "squares_within_2_sigma": float(np.mean(np.abs(level) < 2)),
        "rms_of_square_errors_by_sigma": rms(level),
        "sigma_ratio": float(np.median(values["sigma_ratio"])),
        "cells_of_the_heap": float(values["cells_of_the_heap"].mean()),
    }
    # with stable ground they are not redrawn
    return figures | ({} if np.isnan(redrawn) else {"false_alarms_redrawn": redrawn})


def main():
    parser = machine.parser_of(__doc__)
    parser.add_argument("--draws", type=machine.positive, default=100)
    parser.add_argument("--pixels", type=machine.positive, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=machine.target, metavar="FILE")
    given = parser.parse_args()
    import jaxbundle

    jaxbundle.enable_x64()
    pairs, grounds = years(given.pixels)
    rng, rows, begin = np.random.default_rng(given.seed), [], time.perf_counter()
    half = 0.42 * given.pixels * 0.5
    for k in range(given.draws):
        rows.append(draw(pairs, grounds, rng, half, k + 1))
        if (k + 1) % 10 == 0:
            seconds = time.perf_counter() - begin
            print(f"{k + 1} of {given.draws} draws, {seconds:.0f} s", flush=True)
            for row in zip(*rows):
                print("   ", {n: float(f"{v:.4g}") for n, v in conclude(row).items()}, flush=True)
    figures = dict(zip(("no_stable_ground", "stable_ground"), map(conclude, zip(*rows))))
    wrong = []
    for name, found in figures.items():
        print(name)
        for key, value in found.items():
            print(f"    {key:38s} {value:.4g}")
        # a fifth of the level for differences of stable and other ground, and 3 σ of the draws
        level = found["false_alarms"]
        if level > 0.06 + 3 * found["sigma_of_false_alarms"]:
            wrong.append(f"{name}: {100 * level:.2g} % false alarms at 5 %")
        # of the 95.4 % expected, less 3 σ of the draws
        for kind in ("heaps", "squares"):
            share = found[f"{kind}_within_2_sigma"]
            if share < 0.954 - 3 * np.sqrt(0.046 * 0.954 / given.draws):
                wrong.append(f"{name}: {share:.3g} of the volumes of {kind} within 2 σ")
    redrawn = figures["no_stable_ground"]["false_alarms_redrawn"]
    if abs(redrawn - 0.05) > 0.01:
        wrong.append(f"{100 * redrawn:.2g} % false alarms of redrawn orientations at 5 %")
    more = {"draws": given.draws, "seconds": time.perf_counter() - begin}
    machine.write_json({"machine": machine.machine()} | more | figures, given.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
