"""Input of the BINGO program: image coordinates (`image.dat`) and geo input (`geoin.dat`).

`image.dat`, free of columns; a photograph ends with −99 or where the next begins:

    PHOTO [CAMERA]
    POINT x y
    …
    -99

`geoin.dat`; these statements are read:

    CAPA key CAMERA c xH yH [σc σx σy]      camera; key 3: all three are adjusted, with these σ
    CONT POINT X Y Z                        control point, held
    CHCK POINT X Y Z                        check point

Lines that begin with `*`, the word `C` or `#` are comments. RADI and ADPA
(distortion curve, additional parameters) are skipped with a warning: they concern the distortion,
which starts at 0 here. Every other statement is refused by name: the program's manual is not
public, and this description of the two files follows a thesis and an open reader.
`itera.dat` (orientations and coordinates) is not read for the same reason: photographs have no
start values.

Image coordinates have y up and the unit of the file, also used for c, xH, yH; it is called
"mm" here. The camera has model `bingo`.

Sources: Repanšek (2009), section 7.1.2 and appendices; the BINGO reader of an add-on to GRASS GIS
for the orientation of images (Turek).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import assemble, foreign_document
from jaxbundle.io.text.rows import TextRow, TextRows
from jaxbundle.network.columns import Columns, did_you_mean, list_some
from jaxbundle.network.tables import EXTERIOR, Network, Source

IMAGE, GEO = "image.dat", "geoin.dat"
END_OF_PHOTOGRAPH = "-99"
SKIPPED_STATEMENTS = ("RADI", "ADPA")
STATEMENTS = ("CAPA", "CONT", "CHCK", *SKIPPED_STATEMENTS)
INTERIOR = ("c", "x0", "y0")
ROLES = {"CONT": "fixed", "CHCK": "check"}


def is_bingo(path: Path) -> bool:
    """Whether a path is a folder with both files, or the first of them."""
    if path.name.lower() == IMAGE:
        path = path.parent
    return path.is_dir() and {IMAGE, GEO} <= {p.name.lower() for p in path.iterdir()}


def read_bingo(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a folder with `image.dat` and `geoin.dat`.

    **Raises:** `InputError` naming file and line.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    files = {p.name.lower(): p for p in folder.iterdir()} if folder.is_dir() else {}
    for name in (IMAGE, GEO):
        if name not in files:
            raise InputError(f"{folder}: there is no {name} in it")
    photos, rays = _image_coordinates(files[IMAGE])
    cameras, points, skipped_statements = _geo_input(files[GEO])
    camera_ids = [_find_camera(*photo, cameras, files[GEO]) for photo in photos]
    no_values = np.full(len(photos), np.nan)
    lines = np.array([row.number for *_, row in photos])
    images = Columns(
        {
            "id": [photo for photo, *_ in photos],
            "camera": camera_ids,
            **dict.fromkeys(EXTERIOR, no_values),
        },
        Source(str(files[IMAGE]), lines, "line"),
    )
    ids = dict.fromkeys(rays.values["point"])
    points_by_id = {row["id"]: row for row in points}
    # New points are only in image.dat: tie points, without start values.
    tie_rows = [{"id": id, "role": "tie"} for id in ids if id not in points_by_id]
    table = [*(row for row in points if row["id"] in ids), *tie_rows]
    network = assemble(
        folder,
        foreign_document(
            folder.resolve().name,
            cameras.values(),
            object_unit="m",
            image_unit="mm",
            residuals="corrected",
            datum="control" if points else "inner",
        ),
        overrides,
        images,
        Columns(
            {key: [row.get(key) for row in table] for key in ("id", "role", "X", "Y", "Z")},
            Source(str(files[GEO]), np.array([row.get("line", 0) for row in table]), "line"),
        ),
        rays,
    )
    unseen = [row["id"] for row in points if row["id"] not in ids]
    if unseen:
        network = network.note(f"no photograph shows the points {list_some(unseen)}: left out")
    if skipped_statements:
        network = network.warn(
            f"{', '.join(skipped_statements)} of {files[GEO].name} are not read: the distortion "
            "starts at 0; give its parameters with --set camera.ID.p25=… and free=…"
        )
    return network.note(
        "photographs and new points have no start values: the file with them (itera.dat) is not "
        "read"
    )


def _find_camera(
    photo: str, camera: str | None, row: TextRow, cameras: Mapping[str, dict], file: Path
) -> str:
    """The camera that a photograph names, or the only one."""
    if camera is None and len(cameras) == 1:
        return next(iter(cameras))
    if camera is None or camera not in cameras:
        problem = f"camera {camera!r}" if camera else "no camera is named, and there are several"
        raise row.error(
            f"photograph {photo}: {problem}; CAPA statements in {file}: {', '.join(cameras)}"
        )
    return camera


def _image_coordinates(path: Path) -> tuple[list[tuple[str, str | None, TextRow]], Columns]:
    """Photographs (id, camera or None, line) and the table of image points."""
    photos: list[tuple[str, str | None, TextRow]] = []
    images, points, values, lines = [], [], [], []
    in_photograph = False  # −99 ends a photograph, after which a point has none
    for row in TextRows(path, "#"):
        if _is_comment(row):
            continue
        if row.words[0] == END_OF_PHOTOGRAPH:
            in_photograph = False
        elif len(row) <= 2:
            photos.append((row.words[0], row.words[1] if len(row) == 2 else None, row))
            in_photograph = True
        else:
            if not in_photograph:
                raise row.error(
                    f"{len(row)} values where a photograph (PHOTO [CAMERA]) is expected"
                )
            images.append(photos[-1][0])
            points.append(row.words[0])
            values.append(row.numbers("xy", 1))
            lines.append(row.number)
    if not values:
        raise InputError(f"{path}: there are no image points")
    xy = np.array(values)
    source = Source(str(path), np.array(lines), "line")
    return photos, Columns({"image": images, "point": points, "x": xy[:, 0], "y": xy[:, 1]}, source)


def _geo_input(path: Path) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]], list[str]]:
    """Cameras by name, rows of points, and the skipped statements."""
    cameras: dict[str, dict] = {}
    points, skipped_statements = [], {}
    for row in TextRows(path, "#"):
        if _is_comment(row):
            continue
        keyword = row.words[0].upper()
        if keyword in SKIPPED_STATEMENTS:
            skipped_statements[keyword] = True
        elif keyword == "CAPA":
            camera = _camera(row)
            if camera["id"] in cameras:
                raise row.error(f"camera {camera['id']!r} occurs twice")
            cameras[camera["id"]] = camera
        elif keyword in ROLES:
            if len(row) < 2:
                raise row.error(f"{keyword}: expected POINT X Y Z")
            X, Y, Z = row.numbers("XYZ", 2).tolist()
            points.append(
                {
                    "id": row.words[1],
                    "role": ROLES[keyword],
                    "X": X,
                    "Y": Y,
                    "Z": Z,
                    "line": row.number,
                }
            )
        else:
            hint = did_you_mean(keyword, STATEMENTS)
            raise row.error(
                f"the statement {row.words[0][:20]!r} is not known{hint}; remove it if the network "
                "does not need it"
            )
    if not cameras:
        raise InputError(f"{path}: no camera (CAPA key CAMERA c xH yH)")
    return cameras, points, list(skipped_statements)


def _camera(row: TextRow) -> dict[str, Any]:
    key = row.integer(1, "the key of CAPA")
    if len(row) not in (6, 9):
        raise row.error("expected CAPA key CAMERA c xH yH [σc σx σy]")
    values = row.numbers(INTERIOR, 3, allow_more=True).tolist()
    camera = {"id": row.words[2], "model": "bingo", **dict(zip(INTERIOR, values))}
    if key == 3:  # all three are adjusted; other keys: none
        camera["free"] = list(INTERIOR)
        if len(row) == 9:
            sigma = row.numbers(("σc", "σx", "σy"), 6).tolist()
            camera["sigma"] = dict(zip(INTERIOR, sigma))
    return camera


def _is_comment(row: TextRow) -> bool:
    return row.words[0] in ("C", "*") or row.words[0].startswith("*")
