"""A refinement as tables of unknowns and sets of observations for the engine.

Corrections of scanner images are one table, those of their sensors another; the photographs with
their cameras, priors and distances are declared as in a network.
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
from jaxbundle.refinement.tables import GroundPoints, ScannerImage
from jaxbundle.types import Index, present

IMAGE, SENSOR = "scanner image", "sensor"


class Rays(NamedTuple):
    """Which measurements an adjustment uses: rows of the two tables, and the points of them."""

    scanner: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    points: Int[np.ndarray, " points"]


@dataclasses.dataclass(frozen=True)
class RefinementInput:
    """The input of a refinement: scanner images with the forms of their unknowns and the rows of
    their sensors; points, measurements, photographs, and the rows of their points; the `origin` [3]
    of all coordinates of the engine."""

    images: list[ScannerImage]
    points: GroundPoints
    observations: Observations
    frames: Network | None
    forms: list[Form]
    sensor: Int[np.ndarray, " images"]
    frame_point: Int[np.ndarray, " points"]
    origin: Float[np.ndarray, "3"]

    @property
    def ids(self) -> list[str]:
        """The ids of all images, photographs after scanner images."""
        frames = () if self.frames is None else self.frames.images.id
        return [*(one.id for one in self.images), *frames]

    def kind(self, i: Index) -> kinds.ScannerPoint:
        """The equations of an image."""
        one = self.images[i]
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
        one, places = self.images[i].image, self.observations.xy[rows]
        return kinds.lines_of(self.kind(i), one, self.forms[i], self.origin, *p, X, places)


def gather(
    images: list[ScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None,
) -> RefinementInput:
    """The forms of the unknowns, the sensors, the origin."""
    forms = pad_forms([make_form(one.image, one.earth, one.freedom) for one in images])
    sensors = list(dict.fromkeys(map(sensor_of, images)))
    sensor = np.array([sensors.index(sensor_of(one)) for one in images])
    at = {id: k for k, id in enumerate(points.id)}
    of_frames = [] if frames is None else [at[id] for id in frames.points.id]
    # Coordinates relative to a point near by lose fewer digits; but corrections need Earth-fixed
    # positions.
    absolute = any(one.image.corrections.any for one in images)
    known = points.X[np.isfinite(points.X).all(1)]
    origin = np.zeros(3) if absolute or not len(known) else np.round(known.mean(0))
    return RefinementInput(
        images, points, observations, frames, forms, sensor, np.array(of_frames, int), origin
    )


def sensor_of(one: ScannerImage) -> str:
    """The name of the sensor of an image, its own if it shares none."""
    return one.sensor or one.id


class ImagePointSet(NamedTuple):
    """Image points: the name of their set; whether it is of scanner images; of each the row
    in its table of measurements, the image (as in `RefinementInput.ids`), the point among those
    used."""

    set: str
    of_scanner: bool
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
    control points, the point among those used; `cameras`: by id, the table and row of each."""

    inputs: RefinementInput
    rays: Rays
    problem: Problem
    parts: tuple[ImagePointSet, ...]
    columns: tuple[SharedUnknown, ...]
    control: Int[np.ndarray, " control"]
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
        """The problem with S at these values, and the largest relative change of S."""
        measured, X, change = dict(problem.data.measured), np.asarray(values["point"].position), 0.0
        for part in self.parts:
            if part.of_scanner:
                lines, _ = _lines(self.inputs, values, X, part.rows, part.image, part.point)
                before, measured[part.set] = np.asarray(measured[part.set].scale), lines
                # relative to the largest element: those off the diagonal are nearly zero
                size = np.abs(before).max((1, 2), keepdims=True)
                change = max(change, float((np.abs(lines.scale - before) / size).max()))
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
    already adjusted and points are to be compared with them: then there is no control and
    no distance, and points with one ray keep their height.

    **Raises:** `InputError` for points far from their measurement."""
    points, chosen, n = inputs.points, rays.points, len(rays.points)
    checking = values is not None
    index = np.full(len(points), -1)  # of every point among those used
    index[chosen] = np.arange(n)
    X = X - inputs.origin
    corrections, columns = _corrections(inputs)
    tables = [table for table, _ in corrections]
    # S of the scanner points is evaluated here, at the start, and again in `rescale`
    values = values or {t.name: t.value for t in tables}
    observed, parts = _scanner_points(inputs, rays, values, X, index)
    of_cameras = {}
    if inputs.frames is not None:
        network = _network_of(inputs, rays, index, X + inputs.origin, checking)
        photographs = declare_network(network, inputs.origin)
        # the network has a set of image points for every camera model
        for set_name, rows in photographs.image_rows.items():
            image, point = network.observations.image[rows], network.observations.point[rows]
            image = image + len(inputs.images)
            parts.append(ImagePointSet(set_name, False, rays.frame[rows], image, point))
        observed += photographs.observations
        tables += [t for t in photographs.tables if t.name != "point"]
        of_cameras = {
            network.cameras[c].id: (t.name, row)
            for t in photographs.cameras
            for row, c in enumerate(t.cameras)
        }
        columns += _columns_of_photographs(network, tables, of_cameras)
    seen = np.bincount(np.concatenate([part.point for part in parts]), minlength=n)
    table, control, at = _points(inputs, chosen, X, seen)
    if not checking:
        observed += control
        for t, prior in corrections:
            if np.isfinite(prior).any():
                observed.append(kinds.priors(t.name)((np.arange(t.rows),), sigma=prior))
        if not columns:
            raise InputError(
                'refine: every unknown is held; free some, such as attitude = "free" in [unknowns]'
            )
    tables = [dataclasses.replace(t, value=values.get(t.name, t.value)) for t in tables]
    # A point is touched by few observations, so that its 3 × 3 block is eliminated before the
    # unknowns that points share are solved for.
    eliminate = "point" if table.free.any() else None
    problem = make_problem([*tables, table], observed, eliminate)
    return DeclaredRefinement(inputs, rays, problem, tuple(parts), tuple(columns), at, of_cameras)


def _scanner_points(
    inputs: RefinementInput,
    rays: Rays,
    values: Values,
    X: Float[np.ndarray, "points 3"],
    index: Int[np.ndarray, " all_points"],
) -> tuple[list[ObservationSet], list[ImagePointSet]]:
    """Observations of the rays of scanner images, one set for all images with the same equations,
    and what their rows are. `index`: of the points among those used."""
    observed, parts = [], []
    measured, sigma = inputs.observations, inputs.observations.sigma
    # images differ in their equations by corrections and ellipsoid; their sizes were padded alike
    kind_of_image = [inputs.kind(i) for i in range(len(inputs.images))]
    for kind in dict.fromkeys(kind_of_image):
        mine = np.array([other == kind for other in kind_of_image])
        rows = rays.scanner[mine[measured.image[rays.scanner]]]
        rows = rows[np.argsort(measured.image[rows], kind="stable")]
        if not len(rows):
            continue
        image, point = measured.image[rows], index[measured.point[rows]]
        lines, v = _lines(inputs, values, X, rows, image, point)
        _check_near(inputs, rows, v)
        name = f"scanner points {len(parts) + 1}"
        parts.append(ImagePointSet(name, True, rows, image, point))
        touched = image, inputs.sensor[image], point
        observed.append(kinds.scanner_points(kind)(touched, lines, sigma=sigma[rows], name=name))
    return observed, parts


def _corrections(
    inputs: RefinementInput,
) -> tuple[list[tuple[Table, Float[np.ndarray, "rows k"]]], list[SharedUnknown]]:
    """The tables of corrections, each with the σ of its priors (inf: none), and their unknowns."""
    images, own = inputs.images, inputs.forms[0].image_unknowns
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
        tables.append((table, np.where(sigma > 0, sigma, np.inf)))
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
