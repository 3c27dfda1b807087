"""The photographs of a reconstruction: files, metadata, and grouping by camera."""

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Camera
from jaxbundle.photographs.exif import UPRIGHT, Exif, StatedDistance, read_exif
from jaxbundle.photographs.folders import describe_other_files, list_photographs
from jaxbundle.photographs.formats import SUFFIXES
from jaxbundle.photographs.reading import photograph_size
from jaxbundle.system.file_content import check_plain, read_content


@dataclasses.dataclass(frozen=True)
class Photograph:
    """A file: unique `name`; `fingerprint` of its content; the metadata of its header."""

    path: Path
    name: str
    fingerprint: str
    exif: Exif

    @property
    def size(self) -> tuple[int, int]:
        return self.exif.size


def find_photographs(
    sources: Sequence[str | Path],
) -> tuple[list[Photograph], dict[str, str]]:
    """The photographs among files and folders, in the order of their names; and excluded files,
    with the reason.

    **Raises:** `InputError` if fewer than two can be used.
    """
    paths, left_out = _list_files(sources), {}
    names = _distinct_names([path.parent.resolve() / path.name for path in paths])
    photographs, first_name = [], {}
    for path, name in zip(paths, names):
        try:
            check_plain(path)
            columns, rows = photograph_size(path)
            # Icons and previews: a window of least squares matching is a quarter of the side.
            if min(columns, rows) < 64:
                raise InputError(f"{path}: {columns} × {rows} pixels are too few")
            content = read_content(path, text=False)
        except InputError as error:
            left_out[name] = str(error).removeprefix(f"{path}: ")
            continue
        fingerprint = hashlib.blake2b(content, digest_size=8).hexdigest()
        if fingerprint in first_name:
            left_out[name] = f"the same file as {first_name[fingerprint]}"
            continue
        first_name[fingerprint] = name
        photographs.append(Photograph(path, name, fingerprint, read_exif(path)))
    if len(photographs) < 2:
        reasons = list_some((f"{name} ({why})" for name, why in left_out.items()), 3, str)
        raise InputError(
            f"{len(photographs)} of {len(paths)} photographs can be used; two or more are needed"
            + (f": {reasons}" if left_out else "")
        )
    return photographs, left_out


def name_other_files(sources: Sequence[str | Path]) -> list[str]:
    """Notes about files in the given folders that are no photographs."""
    descriptions = [
        describe_other_files(folder) for folder in map(Path, sources) if folder.is_dir()
    ]
    return [words for words in descriptions if words]


def _list_files(sources: Sequence[str | Path]) -> list[Path]:
    """The files, and those of the folders, each once."""
    paths: list[Path] = []
    for path in map(Path, sources):
        if path.is_dir():
            photographs = list_photographs(path)
            if not photographs:
                other_files = describe_other_files(path).removeprefix(f"{path}: ")
                raise InputError(
                    f"{path}: no photographs in this folder ({', '.join(SUFFIXES)})"
                    + (f"; {other_files}" if other_files else "")
                )
            paths += photographs
        elif not path.exists():
            raise InputError(f"{path}: no such file")
        else:
            paths.append(path)
    unique = {path.resolve(): path for path in paths}  # a file, its folder and a link to it
    return list(unique.values())


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    """The names of different absolute paths; equal ones with as many of their folders as tell them
    apart."""
    lengths = [1] * len(paths)
    while True:
        names = ["/".join(path.parts[-n:]) for path, n in zip(paths, lengths)]
        times = Counter(names)
        if len(times) == len(names):
            return names
        lengths = [n + (times[name] > 1) for n, name in zip(lengths, names)]


@dataclasses.dataclass(frozen=True)
class Cameras:
    """`cameras`, and `camera_of` every photograph; of every camera the principal distance that its
    files state (`stated_distances`); whether it was given as `calibrated`; `notes`; `lens` of every
    camera: photographs in portrait and landscape format share a lens, with the same principal
    distance and radial distortion."""

    cameras: tuple[Camera, ...]
    camera_of: tuple[int, ...]
    stated_distances: tuple[StatedDistance | None, ...]
    calibrated: bool
    notes: tuple[str, ...]
    lens: tuple[int, ...] = (0,)


def assign_cameras(
    photographs: Sequence[Photograph], given_camera: Camera | None = None, per_folder: bool = False
) -> Cameras:
    """Photographs of one make, model, serial number, focal length and size share a camera, of model
    `opencv`.

    **Arguments:** `given_camera`: a calibrated camera, shared by all photographs; `per_folder`:
    those of every folder have a camera of their own.

    **Raises:** `InputError` if the given camera has another size.
    """
    notes = _rotation_messages(photographs)
    if given_camera is not None:
        fitted = _fit_size(given_camera, photographs)
        return Cameras((fitted,), (0,) * len(photographs), (None,), True, notes)
    # A zoom lens at another focal length is another camera, to the tenth of a millimetre.
    groups: dict[tuple, list[int]] = {}
    for k, photograph in enumerate(photographs):
        exif = photograph.exif
        focal = round(exif.focal_length or 0.0, 1), round(exif.focal_length_35 or 0.0)
        own_folder = photograph.path.parent.resolve() if per_folder else ""
        groups.setdefault((exif.camera, exif.serial, own_folder, *focal, exif.size), []).append(k)
    cameras, stated_distances, camera_of = [], [], [0] * len(photographs)
    # The key of a lens is that of a camera with the sides in order.
    lenses: dict[tuple, int] = {}
    lens = [lenses.setdefault((*key[:-1], *sorted(key[-1])), len(lenses)) for key in groups]
    folders = [photographs[rows[0]].path.parent.resolve() for rows in groups.values()]
    # A folder may hold photographs of several cameras, which have no names of folders then.
    folder_names = _distinct_names(folders) if len({*folders}) == len(folders) else []
    for number, rows in enumerate(groups.values()):
        exif = photographs[rows[0]].exif
        stated_distance = exif.principal_distance()
        # Without a statement a start value: 45° of view, between telephones and normal lenses.
        columns, rows_of_image = exif.size
        f = stated_distance.value if stated_distance else 1.2 * max(exif.size)
        id = (exif.camera or "camera") + (f" {number + 1}" if len(groups) > 1 else "")
        if per_folder and folder_names:
            id = folder_names[number]
        centre = {"cx": (columns - 1) / 2, "cy": (rows_of_image - 1) / 2}
        cameras.append(
            Camera(id, "opencv", {"fx": f, "fy": f, **centre}, image_size=(columns, rows_of_image))
        )
        stated_distances.append(stated_distance)
        for k in rows:
            camera_of[k] = number
        where = (
            f"{stated_distance.value:.0f} ± {stated_distance.sigma:.0f} px from "
            f"{stated_distance.source}"
            if stated_distance
            else "unknown: found from the photographs"
        )
        same_lens = f", the lens of camera {cameras[lens.index(lens[number])].id!r}" * (
            lens[number] in lens[:number]
        )
        notes = (
            *notes,
            f"camera {id!r}: {count(len(rows), 'photograph')} of {exif.size[0]} × "
            f"{exif.size[1]} pixels, principal distance {where}{same_lens}",
        )
    return Cameras(
        tuple(cameras), tuple(camera_of), tuple(stated_distances), False, notes, tuple(lens)
    )


def _fit_size(given_camera: Camera, photographs: Sequence[Photograph]) -> Camera:
    """The given camera with the size of the photographs."""
    size = given_camera.image_size
    for photograph in photographs:
        if size is None:
            given_camera = dataclasses.replace(given_camera, image_size=photograph.size)
            size = photograph.size
        if tuple(size) != photograph.size:
            raise InputError(
                f"{photograph.path}: {photograph.size[0]} × {photograph.size[1]} pixels, but "
                f"camera {given_camera.id!r} has {size[0]} × {size[1]}"
            )
    return given_camera


def _rotation_messages(photographs: Sequence[Photograph]) -> tuple[str, ...]:
    turned = [p.name for p in photographs if p.exif.orientation != UPRIGHT]
    if not turned:
        return ()
    return (
        f"{len(turned)} photographs have a rotated EXIF orientation ({list_some(turned, 3, str)}); "
        "their pixels are used in the orientation of the sensor, columns and rows likewise",
    )
