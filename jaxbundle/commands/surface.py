"""`surface`: match oriented images of files to a cloud, a surface model and an orthophoto."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import numeric_array
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.maps import describe_distance
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.columns import did_you_mean
from jaxbundle.results import TableMethods
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.dsm import Dsm, DsmSettings, check_number_of_cells, make_dsm
from jaxbundle.surfaces.files import report_of, text_of
from jaxbundle.surfaces.height_reference import (
    HeightReference,
    check_cells,
    heights_of_ground_images,
    heights_of_photographs,
    no_height_reference,
)
from jaxbundle.surfaces.inputs import check_points, read_views, tie_points
from jaxbundle.surfaces.orthophoto import ToViews, mosaic
from jaxbundle.surfaces.pairs import choose_partners, least_extent, parse_partners
from jaxbundle.surfaces.point_files import read_cloud
from jaxbundle.surfaces.reconstruct import (
    SurfaceResult,
    SurfaceSettings,
    find_bounds,
    ground_bounds,
    reconstruct_surface,
)
from jaxbundle.surfaces.relative import align_all
from jaxbundle.surfaces.scanner_inputs import (
    from_map,
    is_ground_image,
    map_coordinates,
    read_ground_views,
    system_of,
    to_map,
)
from jaxbundle.surfaces.scanner_views import GroundView, Neighbourhood, RpcView
from jaxbundle.surfaces.views import OrientedImage
from jaxbundle.types import Progress

DEFAULT = SurfaceSettings()
# The lowest and the highest height searched.
Heights = tuple[float, float]


class _Wanted(NamedTuple):
    """The options --crs, --geoid and --heights; the size of the cells of a model, None: none."""

    crs: str | None
    geoid: str | Path | None
    heights: str | None
    cells: float | None


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Surface(TableMethods):
    """A surface from oriented images: `cloud`, `messages`; `matching`: the cloud's statistics by
    base image; the `dsm` and the `orthophoto` on it [rows, columns], None if not asked for; `check`
    points [n, 3]; `heights`: what they are above, empty if it is not known."""

    matching: SurfaceResult
    dsm: Dsm | None
    orthophoto: np.ndarray | None
    check: np.ndarray
    heights: str = ""

    @property
    def cloud(self) -> Cloud:
        """The points with covariance, rays and pixel in the base image."""
        return self.matching.cloud

    @property
    def messages(self) -> tuple[str, ...]:
        """What a user should know about inputs and matching."""
        return self.matching.messages

    @cached_property
    def accuracy(self) -> dict[str, Any]:
        """Counts and accuracy; RMS at check points, if there are any."""
        return report_of(self.matching, check=self.check, heights=self.heights)

    def to_dict(self) -> dict[str, Any]:
        """Counts and accuracy as plain dicts and numbers, as in JSON."""
        return without_nan(self.accuracy)

    def table(self) -> dict[str, np.ndarray]:
        """The points."""
        return self.cloud.table()

    def __str__(self) -> str:
        """Counts and accuracy in lines."""
        return text_of(self.accuracy)


def surface(  # noqa: PLR0913 (public: the options of the command, all but one by name)
    input: str | Path | Sequence[str | Path],
    *,
    photos: str | Path | None = None,
    pairs: Sequence[str] | None = None,
    zmin: float | None = None,
    zmax: float | None = None,
    points: str = "grid",
    step: int | None = None,
    dense: bool = False,
    dsm: float | None = None,
    orthophoto: bool = False,
    orthophoto_of: Sequence[str] | None = None,
    check: np.ndarray | str | Path | None = None,
    crs: str | None = None,
    geoid: str | Path | None = None,
    heights: str | None = None,
    settings: SurfaceSettings = DEFAULT,
    progress: Progress | None = None,
    tell: Callable[[str], object] | None = None,
) -> Surface:
    """Match oriented images to a cloud with the σ of every point.

    **Arguments:**

    - `input`: a project or COLMAP folder of oriented photographs, whose files are in the folder
      `photos`; or two or more scanner or RPC images; or the folder of `pushbroom refine --out`,
      whose covariance is then in the σ.
    - `pairs`: BASE,OTHER[,OTHER…], names; default: selected by geometry.
    - `zmin`, `zmax`: lowest and highest height searched; default: from the tie points, or from the
      range of the coefficients.
    - `points`: matched points, `"grid"`, `"edges"` or `"corners"`, `step` pixels apart; `dense`:
      every pixel of the base images, or every `step`-th.
    - `dsm`: size of the cells of a surface model; `orthophoto`: of all images on it, or of those
      in `orthophoto_of`.
    - `check`: points [n, 3], or their file, whose heights are compared; default: check and control
      points of the input.
    - `crs`: coordinate system of cloud and DSM; of scanner and RPC images by default the UTM zone;
      of photographs that of their block. With a vertical part, its heights.
    - `geoid`: raster of geoid heights, or name of a grid of PROJ; `heights`: what cloud, DSM,
      `check`, `zmin` and `zmax` are above, `"ellipsoid"` or `"geoid"`. Default: the geoid if one
      is given, else what is computed: above the ellipsoid from scanner and RPC images, the heights
      of their block from photographs.
    - `progress(stage, done, total)`; `tell`: called with every message when it arises.

    **Raises:** `InputError`; `NotSolvedError` if no images overlap, or nothing matches.
    """
    inputs = [Path(input)] if isinstance(input, str | Path) else [Path(path) for path in input]
    folder = None if photos is None else Path(photos)
    height_range = _heights(zmin, zmax)
    if dsm is not None and not dsm > 0:
        raise InputError(f"--dsm {dsm}: expected a positive size")
    if (orthophoto or orthophoto_of) and dsm is None:
        raise InputError("--orthophoto: needs --dsm, the size of its pixels")
    # Read before matching, which takes minutes: its errors come at once.
    known_points = read_cloud(check).X if isinstance(check, str | Path) else check
    if known_points is not None:
        known_points = numeric_array("check", known_points, "coordinates X, Y, Z [n, 3]")
    options = {"points": points, "step": step, "dense": dense, "settings": settings}
    say = tell or (lambda _: None)
    # Photographs come in one folder, scanner and RPC images one by one.
    if len(inputs) > 1 or is_ground_image(inputs[0]):
        match = _match_ground_images
    else:
        match = _match_photographs
    reference = _Wanted(crs, geoid, heights, dsm)
    matched = match(
        inputs, folder, height_range, pairs, reference, {**options, "progress": progress}, say
    )
    views = choose_views(matched.views, orthophoto_of) if orthophoto or orthophoto_of else []
    cells = DsmSettings(window=settings.window(dense))
    model = None if dsm is None else make_dsm(matched.surface.cloud, dsm, settings=cells)
    picture = mosaic(views, model, matched.to_views) if views and model is not None else None
    true_points = matched.check if known_points is None else np.asarray(known_points, float)
    return Surface(matched.surface, model, picture, true_points, matched.heights)


@dataclasses.dataclass(frozen=True)
class _Matched:
    """The matched surface, its images, the transformation from cloud to image coordinates,
    check points, and what the heights are above."""

    surface: SurfaceResult
    views: Sequence[OrientedImage]
    to_views: ToViews
    check: np.ndarray
    heights: str = ""


def _match_photographs(
    inputs: Sequence[Path],
    photos: Path | None,
    heights: Heights | None,
    pairs: Sequence[str] | None,
    requested: _Wanted,
    options: Mapping[str, Any],
    say: Callable[[str], object],
) -> _Matched:
    if photos is None:
        raise InputError("--photos is missing: the folder of the photographs")
    reference = heights_of_photographs(requested.crs, requested.geoid, requested.heights)
    if requested.cells is not None:
        check_cells(reference, metres=False)
    views, network, messages = read_views(inputs[0], photos)
    if reference.geoid is not None:
        if network.object_unit != "m":
            raise InputError(f"--geoid: the unit of the block is {network.object_unit}; expected m")
        # Also without heights: a grid that does not cover the block is refused before matching.
        x, y = np.stack([view.X0[:2] for view in views], 1)
        computed_heights = reference.as_computed(heights or (0.0, 0.0), x, y)
        heights = heights and computed_heights
    bounds, messages_of_bounds = find_bounds(views, tie_points(network), heights)
    _say_all(messages + messages_of_bounds, say)
    partners = _partners(pairs, views) or choose_partners(views, bounds)
    _check_cells_of(requested.cells, lambda: least_extent(views, bounds, partners))
    reconstructed = reconstruct_surface(views, bounds, partners, **options)
    cloud = reference.apply(reconstructed.cloud)
    _say_all(reconstructed.messages, say)
    all_messages = (*messages, *messages_of_bounds, *reconstructed.messages)
    reconstructed = dataclasses.replace(reconstructed, cloud=cloud, messages=all_messages)
    to_views = lambda X: _with_height(X, -reference.correction(X[:, 0], X[:, 1]))
    check = check_points(network)
    check = _with_height(check, reference.correction(check[:, 0], check[:, 1]))
    return _Matched(reconstructed, views, to_views, check, reference.words)


def _match_ground_images(
    inputs: Sequence[Path],
    photos: Path | None,
    heights: Heights | None,
    pairs: Sequence[str] | None,
    requested: _Wanted,
    options: Mapping[str, Any],
    say: Callable[[str], object],
) -> _Matched:
    """Scanner or RPC images: the surface is in the coordinates of a map."""
    views, around = read_ground_views(inputs, photos)
    if len(views) < 2:
        raise InputError(f"{inputs[0]}: one image; a surface needs at least two")
    crs, geoid, height_system, cells = requested
    if around is None:
        no_height_reference(geoid, height_system)
        reference = HeightReference()
    else:
        reference = heights_of_ground_images(system_of(around, crs), geoid, height_system)
        if cells is not None:
            check_cells(reference, metres=True)
    if reference.geoid is not None and around is not None and reference.horizontal is not None:
        x, y = _corners(views, around, reference.horizontal)
        computed_heights = reference.as_computed(heights or (0.0, 0.0), x, y)
        heights = heights and computed_heights
    bounds, messages = ground_bounds(views, heights)
    partners = _partners(pairs, views) or choose_partners(views, bounds)
    horizontal = reference.horizontal

    def to_xy(X: np.ndarray) -> np.ndarray:
        if around is None or horizontal is None:
            return X
        return np.stack(map_coordinates(X, around, horizontal), 1)

    _check_cells_of(cells, lambda: least_extent(views, bounds, partners, to_xy))
    messages = (*messages, *align_all(views, bounds))
    if around is not None and crs is not None:
        place = (float(np.degrees(float(a))) for a in (around.longitude, around.latitude))
        messages = (*messages, *filter(None, [describe_distance(crs, *place)]))
    _say_all(messages, say)
    reconstructed = reconstruct_surface(views, bounds, partners, **options)
    _say_all(reconstructed.messages, say)
    reconstructed = dataclasses.replace(
        reconstructed, messages=(*messages, *reconstructed.messages)
    )
    if around is None or horizontal is None:
        return _Matched(reconstructed, views, lambda X: X, np.zeros((0, 3)))
    cloud = reference.apply(to_map(reconstructed.cloud, around, horizontal))
    in_map = dataclasses.replace(reconstructed, cloud=cloud)

    def to_views(X: np.ndarray) -> np.ndarray:
        h = X[:, 2] - reference.correction(X[:, 0], X[:, 1])
        return from_map(X[:, 0], X[:, 1], h, around, horizontal)

    return _Matched(in_map, views, to_views, np.zeros((0, 3)), reference.words)


def _with_height(X: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Points [n, 3] with something added to their heights."""
    return np.column_stack([X[:, :2], X[:, 2] + shift])


def _corners(
    views: Sequence[GroundView], around: Neighbourhood, crs: str
) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the corners of images on the ellipsoid, or at the middle of their heights."""
    corners = []
    for view in views:
        columns, rows = view.size
        uv = np.array([[u, v] for u in (0.0, columns - 1.0) for v in (0.0, rows - 1.0)])
        h = sum(view.range()) / 2 if isinstance(view, RpcView) else 0.0
        corners.append(view.points(uv, np.full(len(uv), h)))
    X = np.concatenate(corners)
    x, y = map_coordinates(X[np.isfinite(X).all(1)], around, crs)
    return x, y


def _check_cells_of(size: float | None, extent: Callable[[], Float[np.ndarray, "2"]]) -> None:
    """Refuse cells that are far too small before matching, which takes minutes to hours.

    **Arguments:** `extent()`: of the surface in x and y."""
    if size is not None:
        with np.errstate(over="ignore"):
            columns, rows = np.ceil(extent() / size)
        check_number_of_cells(rows, columns, size)


def choose_views(
    views: Sequence[OrientedImage], names: Sequence[str] | None
) -> list[OrientedImage]:
    """The images with these names; all if none are given.

    **Raises:** `InputError`."""
    known_names = [view.name for view in views]
    for name in names or ():
        if name not in known_names:
            raise InputError(
                f"--orthophoto-of {name!r}: no such image{did_you_mean(name, known_names)}"
            )
    return [view for view in views if not names or view.name in names]


def _say_all(messages: Sequence[str], say: Callable[[str], object]) -> None:
    for message in messages:
        say(message)


def _partners(
    pairs: Sequence[str] | None, views: Sequence[OrientedImage]
) -> dict[int, list[int]] | None:
    return parse_partners(pairs, [v.name for v in views]) if pairs else None


def _heights(zmin: float | None, zmax: float | None) -> Heights | None:
    if zmin is None and zmax is None:
        return None
    if zmin is None or zmax is None or not zmin < zmax:
        raise InputError("--zmin and --zmax: give both, the lower height first")
    return zmin, zmax
