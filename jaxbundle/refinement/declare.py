"""A refinement as tables of unknowns and sets of observations for the engine.

Corrections of scanner images are one table, those of their sensors another, the biases of RPC
images a third; the photographs with their cameras, priors and distances are declared as in a
network.
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, Shaped

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.problem import Problem, make_problem, with_data
from jaxbundle.network.declare import DeclaredNetwork
from jaxbundle.network.declare import declare as declare_network
from jaxbundle.network.tables import EXTERIOR, Distances, Network, Observations, Points
from jaxbundle.refinement import kinds
from jaxbundle.refinement.freedom import (
    ARCSECONDS_PER_RADIAN,
    Form,
    UnknownName,
    make_form,
    names,
    pad_forms,
    priors,
)
from jaxbundle.refinement.rpc_points import (
    BIAS_PRIORS,
    RPC_IMAGE,
    RPC_POINTS,
    BiasSpace,
    misclosures,
    names_of_terms,
    stack_images,
)
from jaxbundle.refinement.tables import (
    AnyScannerImage,
    GroundPoints,
    RpcScannerImage,
    ScannerImage,
)
from jaxbundle.refinement.terrain_heights import (
    TERRAIN_HEIGHTS,
    HeightModel,
    choose_covered,
    terrain_heights,
    update_cells,
)
from jaxbundle.types import Index, present

IMAGE, SENSOR, PHOTOGRAPH = "scanner image", "sensor", "image"
"""Tables of the engine; `RPC_IMAGE` is the one of RPC images."""


class Rays(NamedTuple):
    """Which measurements an adjustment uses: rows of the two tables, and the points of them."""

    scanner: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    points: Int[np.ndarray, " points"]


@dataclasses.dataclass(frozen=True)
class RefinementInput:
    """The input of a refinement: scanner images, the `rigorous` ones with the forms of their
    unknowns and the rows of their sensors before those with RPC; points, measurements, photographs,
    and the rows of their points; a terrain model; the `origin` [3] of all coordinates of the
    engine."""

    rigorous: list[ScannerImage]
    rpc: list[RpcScannerImage]
    points: GroundPoints
    observations: Observations
    frames: Network | None
    terrain: HeightModel | None
    forms: list[Form]
    sensor: Int[np.ndarray, " images"]
    frame_point: Int[np.ndarray, " points"]
    origin: Float[np.ndarray, "3"]

    @property
    def images(self) -> list[AnyScannerImage]:
        """All scanner images, in the order of their rows in `observations`."""
        return [*self.rigorous, *self.rpc]

    @property
    def ids(self) -> list[str]:
        """The ids of all images, photographs after scanner images."""
        frames = () if self.frames is None else self.frames.images.id
        return [*(one.id for one in self.images), *frames]

    def kind(self, i: Index) -> kinds.ScannerPoint:
        """The equations of a rigorous image."""
        one = self.rigorous[i]
        return kinds.ScannerPoint(one.image.corrections, one.earth, self.forms[i].sizes)

    def lines(
        self,
        i: Index,
        values: Values,
        X: Float[np.ndarray, "n 3"],
        rows: Int[np.ndarray, " n"],
    ) -> tuple[kinds.MeasuredLine, Float[np.ndarray, "n 2"]]:
        """Of rows of the measurements in image i, of points X: what belongs to their places, and
        v."""
        p = values[IMAGE][i], values[SENSOR][self.sensor[i]]
        one, places = self.rigorous[i].image, self.observations.xy[rows]
        return kinds.lines_of(self.kind(i), one, self.forms[i], self.origin, *p, X, places)


def gather(
    images: list[AnyScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None,
    terrain: HeightModel | None = None,
) -> RefinementInput:
    """The input with rigorous images before those with RPC; the forms of the unknowns, the sensors,
    the origin."""
    rigorous = [one for one in images if isinstance(one, ScannerImage)]
    rpc = [one for one in images if isinstance(one, RpcScannerImage)]
    row = {one.id: k for k, one in enumerate([*rigorous, *rpc])}
    rows = np.array([row[one.id] for one in images])[observations.image]
    observations = dataclasses.replace(observations, image=rows)
    forms = pad_forms([make_form(one.image, one.earth, one.freedom) for one in rigorous])
    sensors = list(dict.fromkeys(map(sensor_of, rigorous)))
    sensor = np.array([sensors.index(sensor_of(one)) for one in rigorous], int)
    at = {id: k for k, id in enumerate(points.id)}
    of_frames = [] if frames is None else [at[id] for id in frames.points.id]
    # Coordinates relative to a point near by lose fewer digits; but corrections, polynomials and
    # terrain need Earth-fixed positions.
    absolute = bool(rpc) or terrain is not None
    absolute |= any(one.image.corrections.any for one in rigorous)
    known = points.X[np.isfinite(points.X).all(1)]
    origin = np.zeros(3) if absolute or not len(known) else np.round(known.mean(0))
    frame_point = np.array(of_frames, int)
    return RefinementInput(
        rigorous, rpc, points, observations, frames, terrain, forms, sensor, frame_point, origin
    )


def sensor_of(one: ScannerImage) -> str:
    """The name of the sensor of an image, its own if it shares none."""
    return one.sensor or one.id


class ImagePointSet(NamedTuple):
    """Image points: the name of their set; the table of their images (`IMAGE`, `RPC_IMAGE`,
    `PHOTOGRAPH`); of each the row in its table of measurements, the image (as in
    `RefinementInput.ids`), the point among those used."""

    set: str
    table: str
    rows: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]


class SharedUnknown(NamedTuple):
    """An unknown that points share: its name, the σ of its prior (inf: none), and where it is among
    the changes of the tables."""

    name: UnknownName
    sigma: float
    table: str
    row: int
    direction: int


@dataclasses.dataclass(frozen=True)
class DeclaredRefinement:
    """A refinement as the engine's problem, with the rays it uses. `control`: of the rows of
    control points, the point among those used; `levelled`: likewise of terrain heights; `uncovered`
    tie points, which the terrain model does not have; `cameras`: by id, the table and row of
    each."""

    inputs: RefinementInput
    rays: Rays
    problem: Problem
    parts: tuple[ImagePointSet, ...]
    columns: tuple[SharedUnknown, ...]
    control: Int[np.ndarray, " control"]
    levelled: Int[np.ndarray, " heights"]
    uncovered: Int[np.ndarray, " points"]
    cameras: dict[str, tuple[str, int]]

    @property
    def image(self) -> Int[np.ndarray, " rays"]:
        """The images of all image points, set by set."""
        return np.concatenate([part.image for part in self.parts])

    def image_by_image(self, by_part: Iterable[Shaped[np.ndarray, "n ..."]]) -> np.ndarray:
        """What belongs to the image points of every part, in the order of the images."""
        return np.concatenate(list(by_part))[np.argsort(self.image, kind="stable")]

    @property
    def number_of_rays(self) -> Int[np.ndarray, " points"]:
        """The number of rays of each point used."""
        points = np.concatenate([part.point for part in self.parts])
        return np.bincount(points, minlength=len(self.rays.points))

    def rescale(self, problem: Problem, values: Values) -> tuple[Problem, float]:
        """The problem with S and the cells of terrain heights at these values, and the largest
        relative change: of S, or of a height in units of its σ."""
        measured, X, change = dict(problem.data.measured), np.asarray(values["point"].position), 0.0
        for part in self.parts:
            if part.table == IMAGE:
                lines, _ = _lines(self.inputs, values, X, part.rows, part.image, part.point)
                before, measured[part.set] = np.asarray(measured[part.set].scale), lines
                # relative to the largest element: those off the diagonal are nearly zero
                size = np.abs(before).max((1, 2), keepdims=True)
                change = max(change, float((np.abs(lines.scale - before) / size).max()))
        if len(self.levelled):
            model, cells = present(self.inputs.terrain), measured[TERRAIN_HEIGHTS]
            measured[TERRAIN_HEIGHTS], off = update_cells(model, cells, X[self.levelled])
            change = max(change, off)
        data = dataclasses.replace(problem.data, measured=measured)
        return with_data(problem, data), change


def _lines(
    inputs: RefinementInput,
    values: Values,
    X: Float[np.ndarray, "points 3"],
    rows: Int[np.ndarray, " n"],
    image: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
) -> tuple[kinds.MeasuredLine, Float[np.ndarray, "n 2"]]:
    """`RefinementInput.lines` of rows that are sorted by their images."""
    found = [
        inputs.lines(i, values, X[point[image == i]], rows[image == i]) for i in np.unique(image)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def declare(
    inputs: RefinementInput,
    rays: Rays,
    X: Float[np.ndarray, "points 3"],
    values: Values | None = None,
) -> DeclaredRefinement:
    """The tables and observations of a refinement.

    **Arguments:** `X`: start values of the points of the rays; `values`: of all other tables, if
    already adjusted and points are to be compared with them: then there is no control, no distance
    and no terrain height, and points with one ray keep their height.

    **Raises:** `InputError` for points far from their measurement."""
    points, chosen, n = inputs.points, rays.points, len(rays.points)
    checking = values is not None
    index = np.full(len(points), -1)  # of every point among those used
    index[chosen] = np.arange(n)
    X = X - inputs.origin
    corrections, columns = _corrections(inputs)
    tables = [one.table for one in corrections]
    # S of the scanner points is evaluated here, at the start, and again in `rescale`
    values = values or {t.name: t.value for t in tables}
    observed, parts = _scanner_points(inputs, rays, values, X, index)
    of_cameras = {}
    if inputs.frames is not None:
        network = _network_of(inputs, rays, index, X + inputs.origin, checking)
        more, of_cameras = _photographs(inputs, rays, network, parts)
        observed += more.observations
        tables += [t for t in more.tables if t.name != "point"]
        columns += _columns_of_photographs(network, tables, of_cameras)
    seen = np.bincount(np.concatenate([part.point for part in parts]), minlength=n)
    table, control, at = _points(inputs, chosen, X, seen)
    levelled, uncovered = np.zeros(0, int), np.zeros(0, int)
    if not checking:
        observed += [*control, *(prior for one in corrections for prior in one.priors)]
        if not columns:
            raise InputError(
                'refine: every unknown is held; free some, such as attitude = "free" in [unknowns]'
            )
        heights, levelled, uncovered = _terrain_heights(inputs, chosen, X)
        observed += heights
    tables = [dataclasses.replace(t, value=values.get(t.name, t.value)) for t in tables]
    # A point is touched by few observations, so that its 3 × 3 block is eliminated before the
    # unknowns that points share are solved for.
    eliminate = "point" if table.free.any() else None
    problem = make_problem([*tables, table], observed, eliminate)
    parts, columns = tuple(parts), tuple(columns)
    return DeclaredRefinement(
        inputs, rays, problem, parts, columns, at, levelled, uncovered, of_cameras
    )


def _photographs(
    inputs: RefinementInput, rays: Rays, network: Network, parts: list[ImagePointSet]
) -> tuple[DeclaredNetwork, dict[str, tuple[str, int]]]:
    """The photographs as declared, and by the id of a camera its table and row; their image points
    are added to `parts`."""
    photographs = declare_network(network, inputs.origin)
    # the network has a set of image points for every camera model
    for set_name, rows in photographs.image_rows.items():
        image, point = network.observations.image[rows], network.observations.point[rows]
        image = image + len(inputs.images)
        parts.append(ImagePointSet(set_name, PHOTOGRAPH, rays.frame[rows], image, point))
    of_cameras = {
        network.cameras[c].id: (t.name, row)
        for t in photographs.cameras
        for row, c in enumerate(t.cameras)
    }
    return photographs, of_cameras


def _terrain_heights(
    inputs: RefinementInput,
    chosen: Int[np.ndarray, " points"],
    X: Float[np.ndarray, "points 3"],
) -> tuple[list[ObservationSet], Int[np.ndarray, " heights"], Int[np.ndarray, " points"]]:
    """Heights of tie points by the terrain model, the points that have one, and those that have
    none."""
    role = np.array(inputs.points.role, dtype=object)[chosen]
    ties = np.flatnonzero(role == "tie")
    if inputs.terrain is None or not len(ties):
        return [], np.zeros(0, int), np.zeros(0, int)
    model = inputs.terrain
    cells, covered = choose_covered(model, X[ties])
    cells = jax.tree.map(lambda x: x[covered], cells)
    kind = terrain_heights(model.terrain)
    return [kind((ties[covered],), cells, sigma=model.sigma)], ties[covered], ties[~covered]


def _scanner_points(
    inputs: RefinementInput,
    rays: Rays,
    values: Values,
    X: Float[np.ndarray, "points 3"],
    index: Int[np.ndarray, " all_points"],
) -> tuple[list[ObservationSet], list[ImagePointSet]]:
    """Observations of the rays of scanner images, one set for all images with the same equations,
    and what their rows are. `index`: of the points among those used."""
    observed, parts, away = [], [], []
    measured, sigma = inputs.observations, inputs.observations.sigma
    # images differ in their equations by corrections and ellipsoid; their sizes were padded alike
    kind_of_image: list = [inputs.kind(i) for i in range(len(inputs.rigorous))]
    kind_of_image += [RPC_POINTS] * len(inputs.rpc)
    for kind in dict.fromkeys(kind_of_image):
        mine = np.array([other == kind for other in kind_of_image])
        rows = rays.scanner[mine[measured.image[rays.scanner]]]
        rows = rows[np.argsort(measured.image[rows], kind="stable")]
        if not len(rows):
            continue
        image, point = measured.image[rows], index[measured.point[rows]]
        name = f"scanner points {len(parts) + 1}"
        if kind is RPC_POINTS:
            of_table, xy = image - len(inputs.rigorous), measured.xy[rows]
            v, _ = misclosures(values[RPC_IMAGE], of_table, X[point], xy)
            parts.append(ImagePointSet(name, RPC_IMAGE, rows, image, point))
            given = RPC_POINTS((of_table, point), xy, sigma=sigma[rows], name=name)
        else:
            lines, v = _lines(inputs, values, X, rows, image, point)
            parts.append(ImagePointSet(name, IMAGE, rows, image, point))
            touched = image, inputs.sensor[image], point
            given = kinds.scanner_points(kind)(touched, lines, sigma=sigma[rows], name=name)
        away.append((rows, v))
        observed.append(given)
    if away:
        rows, v = map(np.concatenate, zip(*away))
        _check_columns(inputs, rows, v)
        _check_near(inputs, rows, v)
    return observed, parts


class CorrectionTable(NamedTuple):
    """A table of unknowns of images, and the observations that are their priors (none: all free or
    held)."""

    table: Table
    priors: list[ObservationSet]


def _corrections(inputs: RefinementInput) -> tuple[list[CorrectionTable], list[SharedUnknown]]:
    """The tables of unknowns of scanner images with their priors, and the unknowns."""
    tables, columns = [], []
    if inputs.rigorous:
        tables, columns = _rigorous_corrections(inputs)
    if inputs.rpc:
        table, of_rpc = _biases(inputs.rpc)
        tables, columns = [*tables, table], columns + of_rpc
    return tables, columns


def _biases(images: list[RpcScannerImage]) -> tuple[CorrectionTable, list[SharedUnknown]]:
    """The table of RPC images with the terms of the highest degree, those of others held."""
    terms = max(np.shape(one.bias_sigma)[1] for one in images)
    widen = lambda s: np.pad(np.asarray(s, float), ((0, 0), (0, terms - np.shape(s)[1])))
    sigma = np.stack([widen(one.bias_sigma).ravel() for one in images])
    free, names = sigma > 0, names_of_terms(terms)
    start = stack_images([one.image.rpc for one in images], terms)
    labels = [one.id for one in images]
    table = Table(RPC_IMAGE, start, BiasSpace(terms), free, labels, tuple(names))
    columns = [
        SharedUnknown(
            UnknownName(f"image {images[i].id}", names[k], "pixel", 1.0, names[k]),
            float(sigma[i, k]),
            RPC_IMAGE,
            i,
            k,
        )
        for i, k in np.argwhere(free).tolist()
    ]
    prior = np.where(free, sigma, np.inf)
    priors = (
        [BIAS_PRIORS((np.arange(len(images)),), sigma=prior)] if np.isfinite(prior).any() else []
    )
    return CorrectionTable(table, priors), columns


def _rigorous_corrections(
    inputs: RefinementInput,
) -> tuple[list[CorrectionTable], list[SharedUnknown]]:
    """The corrections of rigorous images, and of their sensors."""
    images, own = inputs.rigorous, inputs.forms[0].image_unknowns
    sigma = np.stack([priors(form, one.freedom) for form, one in zip(inputs.forms, images)])
    # The unknowns of a sensor have the σ of its first image, or of the first that states one (NaN:
    # no such unknown).
    first = np.unique(inputs.sensor, return_index=True)[1]
    of_sensor = sigma[first, own:]
    for i, row in enumerate(inputs.sensor):
        absent = np.isnan(of_sensor[row])
        of_sensor[row, absent] = sigma[i, own:][absent]
    named = [names(f.sizes, one.id, sensor_of(one)) for f, one in zip(inputs.forms, images)]
    tables, columns = [], [[] for _ in images]
    # The vector of an image is its own unknowns, then those of its sensor: two tables, so that
    # images of one sensor touch the same row. Columns that are held in all rows leave the space.
    own_part = (IMAGE, sigma[:, :own], range(len(images)), 0)
    for title, sigma, of, start in (own_part, (SENSOR, of_sensor, first, own)):
        sigma = np.nan_to_num(sigma, nan=0.0, posinf=np.inf)
        moving = np.flatnonzero((sigma > 0).any(0)).tolist()
        space, free = kinds.VectorRow(sigma.shape[1], tuple(moving)), sigma[:, moving] > 0
        labels = [images[i].id if title == IMAGE else sensor_of(images[i]) for i in of]
        words = tuple(named[0][start + k].parameter for k in moving)
        table = Table(title, np.zeros(sigma.shape), space, free, labels, words)
        prior, rows = np.where(sigma > 0, sigma, np.inf), (np.arange(table.rows),)
        given = [kinds.priors(title)(rows, sigma=prior)] if np.isfinite(prior).any() else []
        tables.append(CorrectionTable(table, given))
        for row, i in enumerate(of):
            columns[i] += [
                SharedUnknown(named[i][start + k], float(sigma[row, k]), title, row, d)
                for d, k in enumerate(moving)
                if free[row, d]
            ]
    return tables, [column for of_image in columns for column in of_image]


def _points(
    inputs: RefinementInput,
    chosen: Int[np.ndarray, " points"],
    X: Float[np.ndarray, "points 3"],
    seen: Int[np.ndarray, " points"],
) -> tuple[Table, list[ObservationSet], np.ndarray]:
    """The table of points, observations of the controlled ones, and which these are."""
    points, role = inputs.points, np.array(inputs.points.role, dtype=object)[chosen]
    sigma = np.nan_to_num(points.sigma[chosen], nan=0.0, posinf=np.inf)
    control = (role == "control")[:, None]
    free = ~(control & (sigma == 0))
    # one ray gives no height: such a check point moves along its first two axes only
    free[(role == "check") & (seen < 2), 2] = False
    placed = kinds.Placed(X, points.axes[chosen])
    labels = [points.id[k] for k in chosen]
    table = Table("point", placed, kinds.AlongAxes(), free, labels, points.axis_names)
    weighted = control & (sigma > 0) & np.isfinite(sigma)
    at = np.flatnonzero(weighted.any(1))
    if not len(at):
        return table, [], at
    sigma = np.where(weighted, sigma, np.inf)[at]
    measured = kinds.Placed(*(x[at] for x in placed))
    return table, [kinds.control(points.axis_names)((at,), measured, sigma=sigma)], at


def _network_of(
    inputs: RefinementInput,
    rays: Rays,
    index: Int[np.ndarray, " all_points"],
    X: Float[np.ndarray, "points 3"],
    checking: bool,
) -> Network:
    """The photographs with the points and rays used; control is declared here (`_points`)."""
    frames, n = present(inputs.frames), len(X)
    # a camera without photographs would be undetermined
    used = list(dict.fromkeys(frames.images.camera.tolist()))
    camera = np.array([used.index(c) for c in frames.images.camera], int)
    seen, d = frames.observations.take(rays.frame), frames.distances
    ends = index[inputs.frame_point[d.points]]
    kept = (ends >= 0).all(1) & (not checking)
    ids = tuple(inputs.points.id[k] for k in rays.points)
    return frames.replace(
        cameras=tuple(frames.cameras[c] for c in used),
        images=dataclasses.replace(frames.images, camera=camera),
        # all of them tie points here: control is along the axes of each point, which the network
        # does not know
        points=Points(ids, ("tie",) * n, X, np.full((n, 3), np.nan)),
        observations=dataclasses.replace(seen, point=index[inputs.frame_point[seen.point]]),
        distances=Distances(ends[kept], d.value[kept], d.sigma[kept]),
    )


def _columns_of_photographs(
    network: Network, tables: list[Table], of_cameras: dict[str, tuple[str, int]]
) -> list[SharedUnknown]:
    """Their unknowns: of every image, and of its camera for the first image."""
    columns, called = [], {t.name: t for t in tables}
    for i, id in enumerate(network.images.id):
        for k in np.flatnonzero(called["image"].free[i]).tolist():
            word = EXTERIOR[k]
            unit = ("m", 1.0) if k < 3 else ("arcsec", ARCSECONDS_PER_RADIAN)
            name = UnknownName(f"photograph {id}", word, *unit, word)
            columns.append(SharedUnknown(name, math.inf, "image", i, k))
        c = network.images.camera[i]
        camera, (title, row) = network.cameras[c], of_cameras[network.cameras[c].id]
        if c in network.images.camera[:i]:  # named with its first image
            continue
        for d in np.flatnonzero(called[title].free[row]).tolist():
            word = called[title].parameters[d]
            name = UnknownName(f"camera {camera.id}", word, "", 1.0, word)
            columns.append(SharedUnknown(name, camera.sigma.get(word, math.inf), title, row, d))
    return columns


def _check_columns(
    inputs: RefinementInput, rows: Int[np.ndarray, " n"], v: Float[np.ndarray, "n 2"]
) -> None:
    """Refuse measurements whose line and pixel are exchanged, where points with given coordinates
    show it."""
    points, observations = inputs.points, inputs.observations
    given = np.isin(np.array(points.role, dtype=object)[observations.point[rows]],
                    ("control", "check"))  # fmt: skip
    xy = observations.xy[rows][given]
    off, other = (
        np.median(np.linalg.norm(xy + v[given] - places, axis=1)) if len(xy) else 0.0
        for places in (xy, xy[:, ::-1])
    )
    # An order of magnitude: start values explain a hundred pixels, but not that these vanish. Three
    # points are not all on the diagonal, or near another's place, by chance.
    if len(xy) >= 3 and off > 10 * other:
        raise InputError(
            f"{observations.source.name}: line and pixel seem to be exchanged: the points with "
            f"given coordinates are {off:.0f} pixels from their measurements (median), and "
            f"{other:.0f} from them with line and pixel exchanged; check the names of the columns"
        )


def _check_near(
    inputs: RefinementInput, rows: Int[np.ndarray, " n"], v: Float[np.ndarray, "n 2"]
) -> None:
    """Refuse points far from their measurement: swapped or wrong."""
    points, observations = inputs.points, inputs.observations
    size = np.array([(one.image.lines, one.image.pixels) for one in inputs.images])
    # Farther than two images off no start values are so bad: coordinates in another order, frame or
    # unit are; `~(… <=)` also catches NaN.
    far = (~(np.abs(v) <= 2.0 * size[observations.image[rows]])).any(1)
    if not far.any():
        return
    row, away = int(rows[far.argmax()]), v[far.argmax()]
    p, id = observations.point[row], inputs.images[observations.image[row]].id
    said = (
        f"{away[0]:.0f} lines and {away[1]:.0f} pixels away"
        if np.isfinite(away).all()
        else "where the camera does not look"
    )
    raise InputError(
        f"{observations.source(row)}: {points.role[p]} point {points.id[p]!r} of "
        f"{points.source(p)} is off image {id!r}: its coordinates are {said}; check "
        "their order, frame and units, and at the id"
    )
