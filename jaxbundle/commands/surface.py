"""`surface`: match oriented images of files to a cloud, a surface model and an orthophoto."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.maps import describe_distance
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.columns import did_you_mean
from jaxbundle.results import TableMethods
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.dsm import Dsm, make_dsm
from jaxbundle.surfaces.files import report_of, text_of
from jaxbundle.surfaces.inputs import check_points, read_views, tie_points
from jaxbundle.surfaces.orthophoto import ToViews, mosaic
from jaxbundle.surfaces.pairs import parse_partners
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
    read_ground_views,
    system_of,
    to_map,
)
from jaxbundle.surfaces.views import OrientedImage
from jaxbundle.types import Progress

DEFAULT = SurfaceSettings()
# The lowest and the highest height searched.
Heights = tuple[float, float]


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Surface(TableMethods):
    """A surface from oriented images: `cloud`, `messages`; `matching`: the cloud's statistics by
    base image; the `dsm` and the `orthophoto` on it [rows, columns], None if not asked for; `check`
    points [n, 3]."""

    matching: SurfaceResult
    dsm: Dsm | None
    orthophoto: np.ndarray | None
    check: np.ndarray

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
        return report_of(self.matching, check=self.check)

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
    - `crs`: coordinate system of cloud and DSM; of scanner and RPC images by default the UTM zone.
    - `progress(stage, done, total)`; `tell`: called with every message when it arises.

    **Raises:** `InputError`; `NotSolvedError` if no images overlap, or nothing matches.
    """
    inputs = [Path(input)] if isinstance(input, str | Path) else [Path(path) for path in input]
    folder = None if photos is None else Path(photos)
    heights = _heights(zmin, zmax)
    if dsm is not None and not dsm > 0:
        raise InputError(f"--dsm {dsm}: a positive size is expected")
    if (orthophoto or orthophoto_of) and dsm is None:
        raise InputError("--orthophoto: needs --dsm, the size of its pixels")
    # read before matching, which takes minutes: its errors come at once
    given = read_cloud(check).X if isinstance(check, str | Path) else check
    options = {"points": points, "step": step, "dense": dense, "settings": settings}
    say = tell or (lambda _: None)
    # photographs come in one folder, scanner and RPC images one by one
    if len(inputs) > 1 or is_ground_image(inputs[0]):
        match = _match_ground_images
    else:
        match = _match_photographs
    made = match(inputs, folder, heights, pairs, crs, {**options, "progress": progress}, say)
    views = choose_views(made.views, orthophoto_of) if orthophoto or orthophoto_of else []
    model = None if dsm is None else make_dsm(made.surface.cloud, dsm)
    picture = mosaic(views, model, made.to_views) if views and model is not None else None
    known = made.check if given is None else np.asarray(given, float)
    return Surface(made.surface, model, picture, known)


@dataclasses.dataclass(frozen=True)
class _Matched:
    """The matched surface, its images, the transformation from cloud to image coordinates, and
    check points."""

    surface: SurfaceResult
    views: Sequence[OrientedImage]
    to_views: ToViews
    check: np.ndarray


def _match_photographs(
    inputs: Sequence[Path],
    photos: Path | None,
    heights: Heights | None,
    pairs: Sequence[str] | None,
    crs: str | None,
    options: Mapping[str, Any],
    say: Callable[[str], object],
) -> _Matched:
    if photos is None:
        raise InputError("--photos is missing: the folder of the photographs")
    views, network, messages = read_views(inputs[0], photos)
    bounds, more = find_bounds(views, tie_points(network), heights)
    _say_all(messages + more, say)
    found = reconstruct_surface(views, bounds, _partners(pairs, views), **options)
    cloud = dataclasses.replace(found.cloud, system=crs)
    _say_all(found.messages, say)
    every = (*messages, *more, *found.messages)
    found = dataclasses.replace(found, cloud=cloud, messages=every)
    return _Matched(found, views, lambda X: X, check_points(network))


def _match_ground_images(
    inputs: Sequence[Path],
    photos: Path | None,
    heights: Heights | None,
    pairs: Sequence[str] | None,
    crs: str | None,
    options: Mapping[str, Any],
    say: Callable[[str], object],
) -> _Matched:
    """Scanner or RPC images: the surface is in the coordinates of a map."""
    views, around = read_ground_views(inputs, photos)
    if len(views) < 2:
        raise InputError(f"{inputs[0]}: one image; a surface needs at least two")
    bounds, messages = ground_bounds(views, heights)
    messages = (*messages, *align_all(views, bounds))
    if around is not None and crs is not None:
        place = (float(np.degrees(float(a))) for a in (around.longitude, around.latitude))
        messages = (*messages, *filter(None, [describe_distance(crs, *place)]))
    _say_all(messages, say)
    found = reconstruct_surface(views, bounds, _partners(pairs, views), **options)
    _say_all(found.messages, say)
    found = dataclasses.replace(found, messages=(*messages, *found.messages))
    if around is None:
        return _Matched(found, views, lambda X: X, np.zeros((0, 3)))
    system = system_of(around, crs)
    in_map = dataclasses.replace(found, cloud=to_map(found.cloud, around, system))
    to_views = lambda X: from_map(X[:, 0], X[:, 1], X[:, 2], around, system)
    return _Matched(in_map, views, to_views, np.zeros((0, 3)))


def choose_views(
    views: Sequence[OrientedImage], names: Sequence[str] | None
) -> list[OrientedImage]:
    """The images with these names; all if none are given.

    **Raises:** `InputError`."""
    known = [view.name for view in views]
    for name in names or ():
        if name not in known:
            raise InputError(f"--orthophoto-of {name!r}: no such image{did_you_mean(name, known)}")
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
