"""A refinement as tables of unknowns and sets of observations for the engine.

Corrections of scanner images are one table, those of their sensors another, the biases of RPC
images a third; the photographs with their cameras, priors and distances are declared as in a
network.
"""

import dataclasses
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
from jaxbundle.network.tables import Distances, Network, Points
from jaxbundle.refinement import kinds
from jaxbundle.refinement.correction_tables import (
    SharedUnknown,
    columns_of_photographs,
    declare_corrections,
)
from jaxbundle.refinement.inputs import IMAGE, PHOTOGRAPH, Rays, RefinementInput
from jaxbundle.refinement.rpc_points import RPC_IMAGE, RPC_POINTS, misclosures
from jaxbundle.refinement.start_checks import check_columns, check_near
from jaxbundle.refinement.terrain_heights import (
    TERRAIN_HEIGHTS,
    choose_covered,
    terrain_heights,
    update_cells,
)
from jaxbundle.types import not_none


class ImagePointSet(NamedTuple):
    """Image points: the name of their set; the table of their images (`IMAGE`, `RPC_IMAGE`,
    `PHOTOGRAPH`); of each the row in its table of measurements, the image (as in
    `RefinementInput.ids`), the point among those used."""

    set: str
    table: str
    rows: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]


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
                scale_before, measured[part.set] = np.asarray(measured[part.set].scale), lines
                # Relative to the largest element: those off the diagonal are nearly zero.
                size = np.abs(scale_before).max((1, 2), keepdims=True)
                change = max(change, float((np.abs(lines.scale - scale_before) / size).max()))
        if len(self.levelled):
            model, cells = not_none(self.inputs.terrain), measured[TERRAIN_HEIGHTS]
            measured[TERRAIN_HEIGHTS], shift = update_cells(model, cells, X[self.levelled])
            change = max(change, shift)
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
    by_image = [
        inputs.lines(i, values, X[point[image == i]], rows[image == i]) for i in np.unique(image)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *by_image)


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
    points, chosen_points, n = inputs.points, rays.points, len(rays.points)
    checking = values is not None
    index = np.full(len(points), -1)  # of every point among those used
    index[chosen_points] = np.arange(n)
    X = X - inputs.origin
    corrections, columns = declare_corrections(inputs)
    tables = [correction.table for correction in corrections]
    # S of the scanner points is evaluated here, at the start, and again in `rescale`
    values = values or {t.name: t.value for t in tables}
    observed, parts = _scanner_points(inputs, rays, values, X, index)
    of_cameras = {}
    if inputs.frames is not None:
        network = _network_of(inputs, rays, index, X + inputs.origin, checking)
        of_photographs, of_cameras = _photographs(inputs, rays, network, parts)
        observed += of_photographs.observations
        tables += [t for t in of_photographs.tables if t.name != "point"]
        columns += columns_of_photographs(network, tables, of_cameras)
    rays_of_point = np.bincount(np.concatenate([part.point for part in parts]), minlength=n)
    table, control, controlled_rows = _points(inputs, chosen_points, X, rays_of_point)
    levelled, uncovered = np.zeros(0, int), np.zeros(0, int)
    if not checking:
        observed += [
            *control,
            *(prior for correction in corrections for prior in correction.priors),
        ]
        if not columns:
            raise InputError(
                'refine: every unknown is held; free some, such as attitude = "free" in [unknowns]'
            )
        heights, levelled, uncovered = _terrain_heights(inputs, chosen_points, X)
        observed += heights
    tables = [dataclasses.replace(t, value=values.get(t.name, t.value)) for t in tables]
    # A point is touched by few observations, so that its 3 × 3 block is eliminated before the
    # unknowns that points share are solved for.
    eliminate = "point" if table.free.any() else None
    problem = make_problem([*tables, table], observed, eliminate)
    parts, columns = tuple(parts), tuple(columns)
    return DeclaredRefinement(
        inputs, rays, problem, parts, columns, controlled_rows, levelled, uncovered, of_cameras
    )


def _photographs(
    inputs: RefinementInput, rays: Rays, network: Network, parts: list[ImagePointSet]
) -> tuple[DeclaredNetwork, dict[str, tuple[str, int]]]:
    """The photographs as declared, and by the id of a camera its table and row; their image points
    are added to `parts`."""
    photographs = declare_network(network, inputs.origin)
    # The network has a set of image points for every camera model.
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
    chosen_points: Int[np.ndarray, " points"],
    X: Float[np.ndarray, "points 3"],
) -> tuple[list[ObservationSet], Int[np.ndarray, " heights"], Int[np.ndarray, " points"]]:
    """Heights of tie points by the terrain model, the points that have one, and those that have
    none."""
    role = np.array(inputs.points.role, dtype=object)[chosen_points]
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
    observed, parts, misses = [], [], []
    measured, sigma = inputs.observations, inputs.observations.sigma
    # Images differ in their equations by corrections and ellipsoid; their sizes were padded alike.
    kind_of_image: list = [inputs.kind(i) for i in range(len(inputs.rigorous))]
    kind_of_image += [RPC_POINTS] * len(inputs.rpc)
    for kind in dict.fromkeys(kind_of_image):
        is_of_kind = np.array([other_kind == kind for other_kind in kind_of_image])
        rows = rays.scanner[is_of_kind[measured.image[rays.scanner]]]
        rows = rows[np.argsort(measured.image[rows], kind="stable")]
        if not len(rows):
            continue
        image, point = measured.image[rows], index[measured.point[rows]]
        name = f"scanner points {len(parts) + 1}"
        if kind is RPC_POINTS:
            of_table, xy = image - len(inputs.rigorous), measured.xy[rows]
            v, _ = misclosures(values[RPC_IMAGE], of_table, X[point], xy)
            parts.append(ImagePointSet(name, RPC_IMAGE, rows, image, point))
            observations = RPC_POINTS((of_table, point), xy, sigma=sigma[rows], name=name)
        else:
            lines, v = _lines(inputs, values, X, rows, image, point)
            parts.append(ImagePointSet(name, IMAGE, rows, image, point))
            touched_rows = image, inputs.sensor[image], point
            observations = kinds.scanner_points(kind)(
                touched_rows, lines, sigma=sigma[rows], name=name
            )
        misses.append((rows, v))
        observed.append(observations)
    if misses:
        rows, v = map(np.concatenate, zip(*misses))
        check_columns(inputs, rows, v)
        check_near(inputs, rows, v)
    return observed, parts


def _points(
    inputs: RefinementInput,
    chosen_points: Int[np.ndarray, " points"],
    X: Float[np.ndarray, "points 3"],
    rays_of_point: Int[np.ndarray, " points"],
) -> tuple[Table, list[ObservationSet], np.ndarray]:
    """The table of points, observations of the controlled ones, and which these are."""
    points, role = inputs.points, np.array(inputs.points.role, dtype=object)[chosen_points]
    sigma = np.nan_to_num(points.sigma[chosen_points], nan=0.0, posinf=np.inf)
    control = (role == "control")[:, None]
    free = ~(control & (sigma == 0))
    # One ray gives no height: such a check point moves along its first two axes only.
    free[(role == "check") & (rays_of_point < 2), 2] = False
    placed = kinds.Placed(X, points.axes[chosen_points])
    labels = [points.id[k] for k in chosen_points]
    table = Table("point", placed, kinds.AlongAxes(), free, labels, points.axis_names)
    weighted = control & (sigma > 0) & np.isfinite(sigma)
    controlled_rows = np.flatnonzero(weighted.any(1))
    if not len(controlled_rows):
        return table, [], controlled_rows
    sigma = np.where(weighted, sigma, np.inf)[controlled_rows]
    measured = kinds.Placed(*(x[controlled_rows] for x in placed))
    return (
        table,
        [kinds.control(points.axis_names)((controlled_rows,), measured, sigma=sigma)],
        controlled_rows,
    )


def _network_of(
    inputs: RefinementInput,
    rays: Rays,
    index: Int[np.ndarray, " all_points"],
    X: Float[np.ndarray, "points 3"],
    checking: bool,
) -> Network:
    """The photographs with the points and rays used; control is declared here (`_points`)."""
    frames, n = not_none(inputs.frames), len(X)
    # A camera without photographs would be undetermined.
    used_cameras = list(dict.fromkeys(frames.images.camera.tolist()))
    camera = np.array([used_cameras.index(c) for c in frames.images.camera], int)
    rays_used, d = frames.observations.take(rays.frame), frames.distances
    ends = index[inputs.frame_point[d.points]]
    is_kept = (ends >= 0).all(1) & (not checking)
    ids = tuple(inputs.points.id[k] for k in rays.points)
    return frames.replace(
        cameras=tuple(frames.cameras[c] for c in used_cameras),
        images=dataclasses.replace(frames.images, camera=camera),
        # All of them tie points here: control is along the axes of each point, which the network
        # does not know.
        points=Points(ids, ("tie",) * n, X, np.full((n, 3), np.nan)),
        observations=dataclasses.replace(
            rays_used, point=index[inputs.frame_point[rays_used.point]]
        ),
        distances=Distances(ends[is_kept], d.value[is_kept], d.sigma[is_kept]),
    )
