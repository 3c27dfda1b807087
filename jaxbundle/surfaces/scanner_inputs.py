"""Scanner and RPC images from files, in one neighbourhood; and their coordinates in a map system.

An image is given by a raster with RPC tags, by a raster with coefficients beside it
(`NAME_RPC.TXT`, `NAME.RPB`, `NAME.geom`, `NAME.xml`), by the file of the coefficients, or by a
scanner file; the raster of the last two has the same name and is beside them, or in the folder of
--photos.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, geodetic
from jaxbundle.io.networks.orientation_covariance import FILE as COVARIANCE_FILE
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.refined_orientations import (
    TABLE,
    RefinedBlock,
    RefinedFile,
    read_refined_orientations,
)
from jaxbundle.io.scanner.rpc import read_rpc
from jaxbundle.io.scanner.rpc_images import (
    COMPANION_ENDINGS,
    IMAGES,
    find_coefficients,
    find_raster,
    has_rpc_only,
    read_rpc_image,
)
from jaxbundle.photographs.places import utm_system
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.rpc.bias import domain_of_bias
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.pushbroom.surfaces import Ground
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.ground_orientation import rpc_orientation, scanner_orientation
from jaxbundle.surfaces.scanner_views import (
    GroundView,
    Neighbourhood,
    RpcView,
    ScannerView,
    neighbourhood,
)
from jaxbundle.surfaces.views import Grey
from jaxbundle.system.file_content import no_such_file
from jaxbundle.system.rasters import check_pixels, check_raw, open_raster, read_pixels

if TYPE_CHECKING:
    import pyproj

# The polynomials; or the scanner's image, and its Earth, None in a local frame.
Orientation = Rpc | tuple[PushbroomImage, Ellipsoid | None]


def read_ground_views(
    files: Sequence[Path], folder: Path | None
) -> tuple[tuple[GroundView, ...], Neighbourhood | None]:
    """The oriented images and the origin of their coordinates, None in a local frame. Refined files
    have the covariance of their refinement.

    **Raises:** `InputError` for another kind of file, a missing raster, or another size.
    """
    files, blocks = _with_blocks(files)
    refined = [None if b is None else b.image_of(path) for b, path in zip(blocks, files)]
    orientations_and_rasters = [
        _orientation(
            path, folder, None if refined_file is None else _pixels_of(refined_file, folder)
        )
        for path, refined_file in zip(files, refined)
    ]
    around = _common_neighbourhood(
        files, [orientation for orientation, _ in orientations_and_rasters]
    )
    rasters = [raster.resolve() for _, raster in orientations_and_rasters]
    for k, raster in enumerate(rasters):
        if raster in rasters[:k]:
            raise InputError(
                f"{files[k]}: its raster {raster.name} is also that of "
                f"{files[rasters.index(raster)]}; a surface needs different images"
            )
    names = [raster.name for _, raster in orientations_and_rasters]
    if len({*names}) < len(names):
        names = [str(raster) for _, raster in orientations_and_rasters]
    views = []
    for name, (orientation, raster), refined_file, block in zip(
        names, orientations_and_rasters, refined, blocks
    ):
        if not isinstance(orientation, Rpc):
            with open_raster(raster) as source:
                check_raw(raster, source)
        grey = read_grey(raster)
        if not isinstance(orientation, Rpc):
            _check_size(raster, grey, orientation[0])
        view = _view(name, grey, orientation, around)
        if refined_file is not None and block is not None:
            _add_covariance(view, orientation, refined_file, block)
        views.append(view)
    return tuple(views), around


def views_of_images(
    ids: Sequence[str], orientations: Sequence[Orientation], rasters: Sequence[Path]
) -> tuple[GroundView, ...]:
    """Images with known orientations and their pixels, by their ids.

    **Raises:** `InputError` if a raster cannot be read, or has another size."""
    around = _common_neighbourhood([Path(id) for id in ids], orientations)
    views = []
    for id, orientation, raster in zip(ids, orientations, rasters):
        grey = read_grey(raster)
        if not isinstance(orientation, Rpc):
            _check_size(raster, grey, orientation[0])
        views.append(_view(id, grey, orientation, around))
    return tuple(views)


def _check_size(raster: Path, grey: Grey, image: PushbroomImage) -> None:
    if (image.pixels, image.lines) != (grey.shape[1], grey.shape[0]):
        raise InputError(
            f"{raster}: {grey.shape[1]} × {grey.shape[0]} pixels, the scanner file has "
            f"{image.pixels} × {image.lines}"
        )


def read_refined_views(
    folder: Path,
) -> tuple[tuple[GroundView, ...], Neighbourhood | None] | None:
    """The images of a refinement without their pixels, named by their ids; None for another folder.

    **Raises:** `InputError` as `read_ground_views`."""
    block = read_refined_orientations(folder)
    if block is None:
        return None
    orientations = [
        read_rpc(refined_file.file)
        if has_rpc_only(refined_file.file)
        else _scanner_of(refined_file.file)
        for refined_file in block.images
    ]
    around = _common_neighbourhood(
        [refined_file.file for refined_file in block.images], orientations
    )
    views = []
    for refined_file, orientation in zip(block.images, orientations):
        image = (
            read_rpc_image(refined_file.file, refined_file.raster).image
            if isinstance(orientation, Rpc)
            else orientation[0]
        )
        # The size alone is needed: a view of one number instead of gigabytes of pixels.
        nothing = np.broadcast_to(np.uint8(0), (image.lines, image.pixels))
        view = _view(refined_file.id, nothing, orientation, around)
        _add_covariance(view, orientation, refined_file, block)
        views.append(view)
    return tuple(views), around


def _with_blocks(files: Sequence[Path]) -> tuple[list[Path], list[RefinedBlock | None]]:
    """Files, for the folder of a refinement all of its images, and the refinements they are of."""
    all_files: list[Path] = []
    of_every: list[RefinedBlock | None] = []
    block_of_folder: dict[Path, RefinedBlock | None] = {}
    for path in files:
        place = path if path.is_dir() else path.parent
        if place not in block_of_folder:
            block_of_folder[place] = read_refined_orientations(place)
        block = block_of_folder[place]
        files_of_entry = [one.file for one in block.images] if path.is_dir() and block else [path]
        all_files += files_of_entry
        of_every += [block] * len(files_of_entry)
    return all_files, of_every


def _pixels_of(refined_file: RefinedFile, folder: Path | None) -> Path | None:
    """The raster of a refined image: where it was, or of its name in a folder."""
    if refined_file.raster is not None or folder is None:
        return refined_file.raster
    raster_in_folder = folder / refined_file.raster_name
    return raster_in_folder if refined_file.raster_name and raster_in_folder.is_file() else None


def _common_neighbourhood(
    files: Sequence[Path], orientations: Sequence[Orientation]
) -> Neighbourhood | None:
    """The place of images that are all on the Earth; None if all are in a local frame."""
    local = [not isinstance(o, Rpc) and o[1] is None for o in orientations]
    if any(local) and not all(local):
        raise InputError(
            f"{files[local.index(True)]}: is in a local frame, the other images are on the Earth"
        )
    return None if all(local) else _central_neighbourhood(orientations[0])


def _view(
    name: str, grey: Grey, orientation: Orientation, around: Neighbourhood | None
) -> GroundView:
    if isinstance(orientation, Rpc):
        assert around is not None, "coefficients are never in a local frame"
        return RpcView(name, grey, orientation, around)
    return ScannerView(name, grey, *orientation, around)


def _add_covariance(
    view: GroundView, orientation: Orientation, refined_file: RefinedFile, block: RefinedBlock
) -> None:
    """What the refinement of an image says of its errors."""
    joint = block.covariance
    if joint is None:
        return
    try:
        if isinstance(orientation, Rpc):
            # Compensated coefficients have a domain of their own; the bias belongs to the given.
            domain = (
                refined_file.domain
                if refined_file.domain is not None
                else domain_of_bias(orientation)
            )
            view.orientation = rpc_orientation(joint, refined_file.id, domain)
        else:
            scanner_arguments = (
                refined_file.id,
                refined_file.sensor,
                *orientation,
                refined_file.knot_spacing,
            )
            view.orientation = scanner_orientation(joint, *scanner_arguments)
    except InputError as error:
        raise InputError(f"{refined_file.file.parent / COVARIANCE_FILE}: {error}") from None


def is_ground_image(path: Path) -> bool:
    """Whether a file may be a scanner image or one with rational polynomials."""
    name = path.name
    if (path / TABLE).is_file():
        return True
    if path.suffix.lower() in IMAGES or any(name.endswith(end) for end in COMPANION_ENDINGS):
        return True
    if path.suffix.lower() in (".json", ".dim", ".imd"):
        return True
    return path.suffix.lower() == ".toml" and path.is_file() and b"[scanner]" in path.read_bytes()


def read_grey(path: Path, pixels_at_once: int = 1 << 23) -> Grey:
    """The grey values of a raster; for colours their luminance. No-data is 0.

    One band of 8 or 16 bits keeps its type, all else becomes float32; so large rasters, which are
    read by blocks of lines of `pixels_at_once`, need no more memory than their pixels.

    **Raises:** `InputError` if it cannot be read.
    """
    with open_raster(path) as source:
        bands = list(range(1, min(source.count, 3) + 1))
        plain = len(bands) < 3 and source.dtypes[0] in ("uint8", "uint16")
        # Red, green and blue in the luminance (ITU-R BT.601, two digits).
        weights = np.array([0.3, 0.59, 0.11], np.float32)
        rows = max(1, pixels_at_once // source.width)
        check_pixels(path, source, bands)
        out = np.empty(source.shape, source.dtypes[0] if plain else np.float32)
        for begin in range(0, source.height, rows):
            window = (begin, min(begin + rows, source.height)), (0, source.width)
            values = read_pixels(path, source, bands, window).filled(0)
            if not plain:
                values = np.nan_to_num(values.astype(np.float32))
            colour = len(values) == 3
            out[slice(*window[0])] = np.tensordot(weights, values, 1) if colour else values[0]
        return out


def system_of(around: Neighbourhood, crs: str | None) -> str:
    """A map coordinate system: the given one, or the UTM zone.

    **Raises:** `InputError` for a system unknown to pyproj."""
    if crs is not None:
        return crs
    longitude, latitude = (np.degrees(float(a)) for a in (around.longitude, around.latitude))
    return utm_system(latitude, longitude)


def to_map(cloud: Cloud, around: Neighbourhood, crs: str) -> Cloud:
    """The cloud in a map system, with its covariance rotated and scaled.

    **Raises:** `InputError` for a system unknown to pyproj."""
    X, covariance = np.empty_like(cloud.X), np.empty_like(cloud.covariance)
    # The arrays of 262 144 points take about 50 MB.
    points_at_once = 1 << 18
    for begin in range(0, len(cloud), points_at_once):
        part = slice(begin, begin + points_at_once)
        X[part] = np.stack([*map_coordinates(cloud.X[part], around, crs), cloud.X[part, 2]], 1)
        J = map_derivative(cloud.X[part], around, crs)
        covariance[part] = J @ cloud.covariance[part] @ np.swapaxes(J, 1, 2)
    return dataclasses.replace(cloud, X=X, covariance=covariance, system=crs)


def map_derivative(
    X: Float[np.ndarray, "n 3"], around: Neighbourhood, crs: str
) -> Float[np.ndarray, "n 3 3"]:
    """The derivatives of coordinates in a map system by those of the neighbourhood."""
    # Differences over one metre: a map's curvature within it is 1e-7.
    x, y = map_coordinates(X, around, crs)
    columns = []
    for axis in range(2):
        dx, dy = map_coordinates(X + np.eye(3)[axis], around, crs)
        columns.append(np.stack([dx - x, dy - y, np.zeros_like(x)], 1))
    return np.stack([*columns, np.broadcast_to([0.0, 0, 1], X.shape)], 2)


def map_coordinates(
    X: Float[np.ndarray, "n 3"], around: Neighbourhood, crs: str
) -> tuple[np.ndarray, np.ndarray]:
    """x and y of points in a map system."""
    degrees = np.degrees(np.stack([np.asarray(a) for a in around.geographic(X.T)[:2]]))
    x, y = _transformer(crs).transform(*degrees)
    return np.asarray(x), np.asarray(y)


def from_map(
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
    h: Float[np.ndarray, " n"],
    around: Neighbourhood,
    crs: str,
) -> Float[np.ndarray, "n 3"]:
    """Points of map coordinates."""
    east, north = np.radians(to_degrees(x, y, crs))
    return np.asarray(around.local(east, north, np.asarray(h, float))).T


def to_degrees(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], crs: str
) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude of map coordinates."""
    longitude, latitude = _transformer(crs).transform(x, y, direction="INVERSE")
    return np.asarray(longitude), np.asarray(latitude)


def _transformer(crs: str) -> "pyproj.Transformer":
    try:
        import pyproj
        import pyproj.exceptions
    except ImportError:
        raise InputError("coordinate systems need pyproj: pip install 'jaxbundle[geo]'") from None
    try:
        return pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise InputError(f"--crs {crs!r}: {' '.join(str(error).split())}") from None


def _orientation(
    path: Path, folder: Path | None, raster: Path | None = None
) -> tuple[Orientation, Path]:
    """The polynomials, or the scanner's image and Earth; and the raster, if it is not known."""
    if not path.is_file():
        raise no_such_file(path, "a raster with RPC, or a scanner file")
    if path.suffix.lower() in IMAGES:
        return read_rpc(find_coefficients(path)), path
    scanner = path.suffix.lower() in (".json", ".dim", ".imd", ".toml")
    if path.suffix.lower() == ".xml":
        try:
            return read_rpc(path), raster or _raster_of(path, folder)
        except InputError:
            scanner = True
    orientation = _scanner_of(path) if scanner else read_rpc(path)
    return orientation, raster or _raster_of(path, folder)


def _scanner_of(path: Path) -> Orientation:
    file = read_scanner(path)
    return file.image, file.earth


def _raster_of(path: Path, folder: Path | None) -> Path:
    raster = find_raster(path, *([folder] if folder else []))
    if raster is None:
        where = f"beside it or in {folder}" if folder else "beside it; --photos names its folder"
        raise InputError(f"{path}: no raster {path.stem}.tif {where}")
    return raster


def _central_neighbourhood(orientation: Orientation) -> Neighbourhood:
    """The neighbourhood of the middle of the first image."""
    if isinstance(orientation, Rpc):
        return neighbourhood(
            np.radians(float(orientation.longitude_offset)),
            np.radians(float(orientation.latitude_offset)),
        )
    image: PushbroomImage = orientation[0]
    earth = orientation[1] or WGS84
    X = locate_point(image, Ground(earth), (image.lines - 1) / 2, (image.pixels - 1) / 2)
    longitude, latitude, _ = geodetic(earth, X)
    return neighbourhood(float(longitude), float(latitude), earth)
