"""Projects of AICON 3D Studio, as JAiCov reads them: several tables of numbers.

    NAME.phc    image point x y sx sy vx vy method active parameter      image points, mm
    NAME.ior    five lines for each camera:                              interior orientation
                number parameter −c x0 y0 A1 A2 R0;  A3;  B1 B2;  C1 C2;
                width and height of the sensor (mm), columns, rows
    NAME.eor    image camera X0 Y0 Z0 ω φ κ order active state           exterior orientation
    NAME.obc    point X Y Z [sX sY sZ rays active new datum]             object points
    NAME.scale  number "name" point point length σ active                distances

Columns are separated by blanks, lines that begin with # are comments. Angles are radians, M as
here; the axes of the image are x right, y up, from its centre. The file has −c. The camera is
`brown-projected` (distortion at the projected point) with K_i = A_i, r0 = R0, P_i = B_i, b_i = C_i.
Inactive entries are left out; images with a rotation order other than 0, or with state
1, have no orientation. `datum` marks the points of the inner datum; all points are tie points, as
in JAiCov. Without .eor and .obc there are no orientations and coordinates.

Source: Loesler, JAiCov (Java Aicon Covariance), the columns its readers name; Luhmann (2023),
Nahbereichsphotogrammetrie, eq. 2.31, for the rotation.
"""

from collections.abc import Container, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters, assemble, foreign_document, image_columns
from jaxbundle.io.networks.losses import changed, describe_losses, losing, need_values, size_of
from jaxbundle.io.networks.poses import matrices_of
from jaxbundle.io.text.rows import TextRow, TextRows, join_numbers
from jaxbundle.io.writing.replacing import replace_files
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import Camera, Distances, Network, Source

SUFFIX = ".phc"
COMPANION_SUFFIXES = (".ior", ".eor", ".obc", ".scale")
INTERIOR = (
    ("number", "parameter", "c", "x0", "y0", "K1", "K2", "r0"),
    ("K3",),
    ("P1", "P2"),
    ("b1", "b2"),
    ("width", "height", "columns", "rows"),
)


def is_jaicov(path: Path) -> bool:
    """Whether a file has the name of AICON's image points."""
    return path.suffix.lower() == SUFFIX and path.is_file()


def read_jaicov(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a project; no camera parameter is free.

    **Raises:** `InputError` naming file and line.
    """
    path = Path(path)
    companions = {suffix: path.with_suffix(suffix) for suffix in COMPANION_SUFFIXES}
    cameras = _cameras(companions[".ior"])
    images, angles, position, camera, inactive, messages = _images(companions[".eor"])
    points, coordinates, datum = _points(companions[".obc"])
    rays, lines, ray_messages = _rays(
        path, inactive, points if companions[".obc"].is_file() else None
    )
    for image in rays["image"]:
        images.setdefault(image, len(images))
    without_camera = list(images)[len(camera) :]
    if without_camera and len(cameras) > 1:
        ray_messages.append(
            f"{count(len(without_camera), 'image')} not in .eor, which names the camera of an "
            f"image: {list_some(without_camera)}; the first of {len(cameras)} cameras is taken: "
            "give their rows"
        )
    for point in rays["point"]:
        points.setdefault(point, len(points))
    # Images and points that only the image points name follow those of .eor and .obc, as unknown.
    X0, all_angles = np.full((2, len(images), 3), np.nan)
    X0[: len(position)], all_angles[: len(angles)] = position, angles
    camera_ids = camera + [str(next(iter(cameras)))] * (len(images) - len(camera))
    X = np.full((len(points), 3), np.nan)
    X[: len(coordinates)] = coordinates
    network = assemble(
        path,
        foreign_document(
            path.stem, cameras.values(), image_unit="mm", object_unit="mm", datum_points=datum
        ),
        overrides,
        image_columns(
            Source(str(companions[".eor"]), None, "image"),
            list(images),
            camera_ids,
            matrices_of(all_angles),
            X0,
        ),
        Columns(
            {"id": list(points), "role": ["tie"] * len(points), **dict(zip("XYZ", X.T))},
            Source(str(companions[".obc"]), None, "point"),
        ),
        Columns(rays, Source(str(path), np.array(lines, np.int64), "line")),
        (*messages, *ray_messages),
    )
    return _with_distances(network, companions[".scale"])


def _cameras(file: Path) -> dict[str, dict]:
    """The entries of cameras by number."""
    rows, cameras = TextRows(file, comment="#"), {}
    while rows.has_more():
        entry, first_row = {}, None
        for names in INTERIOR:
            row = rows.take(f"{', '.join(names)} of a camera")
            entry |= dict(zip(names, row.numbers(names, allow_more=True).tolist()))
            first_row = first_row or row
        assert first_row is not None
        size = entry["columns"], entry["rows"]
        if not (entry["c"] < 0 and min(entry["width"], entry["height"], *size) > 0):
            raise row.error("c must be negative, the sizes of the sensor positive")
        id = first_row.words[0]
        if id in cameras:
            raise first_row.error(f"camera {id} occurs twice")
        values = {
            name: entry[name]
            for name in ("x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2", "r0")
        }
        cameras[id] = {
            "id": id,
            "model": "brown-projected",
            "c": -entry["c"],
            **values,
            "image_size": list(size),
            "pixel_size": [entry["width"] / size[0], entry["height"] / size[1]],
        }
    if not cameras:
        raise InputError(f"{file}: there is no camera in it")
    return cameras


def _images(
    file: Path,
) -> tuple[
    dict[str, int],
    Float[np.ndarray, "n 3"],
    Float[np.ndarray, "n 3"],
    list[str],
    set[str],
    list[str],
]:
    """Row of each image, angles, positions, cameras, the images that are not active, messages."""
    images: dict[str, int] = {}
    angles, position, camera, inactive, unread_ids = [], [], [], [], []
    for row in TextRows(file, comment="#") if file.is_file() else ():
        names = ("X0", "Y0", "Z0", "omega", "phi", "kappa", "order", "active", "state")
        entry = dict(zip(names, row.numbers(names, 2, allow_more=True).tolist()))
        if entry["active"] == 0:
            inactive.append(row.words[0])
            continue
        _number_row(row, images, "image")
        # Order 0: ω, φ, κ; state 1: not oriented, 2: approximately, 3: by bundle adjustment.
        is_oriented = entry["order"] == 0 and entry["state"] != 1
        if entry["order"] != 0:
            unread_ids.append(row.words[0])
        values = [entry[name] if is_oriented else np.nan for name in names[:6]]
        position.append(values[:3])
        angles.append(values[3:])
        camera.append(row.words[1])
    messages = (
        [
            f"{count(len(unread_ids), 'image')} whose rotation is of another order than 0: without "
            f"orientation: {list_some(unread_ids)}"
        ]
        if unread_ids
        else []
    )
    as_rows = lambda numbers: np.reshape(numbers, (-1, 3))
    off = {*inactive}.difference(images)
    return images, as_rows(angles), as_rows(position), camera, off, messages


def _points(file: Path) -> tuple[dict[str, int], Float[np.ndarray, "n 3"], list[str]]:
    """Row of each point, coordinates, and the ids of the datum."""
    points: dict[str, int] = {}
    coordinates, datum = [], []
    for row in TextRows(file, comment="#") if file.is_file() else ():
        values = row.numbers(("X", "Y", "Z"), 1, allow_more=True)
        # Short rows, of coordinates alone or with σ, are active points outside the datum.
        if len(row) >= 11 and row.words[8] == "0":
            continue
        _number_row(row, points, "point")
        coordinates.append(values)
        if len(row) >= 11 and row.words[10] != "0":
            datum.append(row.words[0])
    return points, np.reshape(coordinates, (-1, 3)), datum


def _number_row(row: TextRow, table: dict[str, int], kind: str) -> None:
    if row.words[0] in table:
        raise row.error(f"{kind} {row.words[0]} occurs twice")
    table[row.words[0]] = len(table)


def _rays(
    file: Path, inactive: Container[str], points: Mapping[str, int] | None
) -> tuple[dict[str, list], list[int], list[str]]:
    """The columns of image points, but those of `inactive` images, their lines, and messages."""
    columns: dict[str, list] = {name: [] for name in ("image", "point", "x", "y", "sx", "sy")}
    lines, unknown, of_inactive = [], [], []
    names = ("x", "y", "sx", "sy", "vx", "vy", "method", "active")
    for row in TextRows(file, comment="#"):
        values = row.numbers(names, 2, allow_more=True)
        image, point = row.words[:2]
        if values[-1] <= 0:
            continue
        if image in inactive:
            of_inactive.append(image)
            continue
        if points is not None and point not in points:
            unknown.append(point)
            continue
        for name, value in zip(columns, (image, point, *values[:4].tolist())):
            columns[name].append(value)
        lines.append(row.number)
    if not lines:
        raise InputError(f"{file}: there are no active image points")
    left_out = {
        "points that are not in .obc, or not active there": unknown,
        "images that are not active in .eor": of_inactive,
    }
    messages = [
        f"left out {count(len(ids), 'image point')} of {why}: {list_some(dict.fromkeys(ids))}"
        for why, ids in left_out.items()
        if ids
    ]
    return columns, lines, messages


def _with_distances(network: Network, file: Path) -> Network:
    """The network with the active distances of a file between its points."""
    index, lines = {id: k for k, id in enumerate(network.points.id)}, []
    ends, values = [], []
    for row in TextRows(file, comment="#") if file.is_file() else ():
        # The name stands in quotes and may have blanks.
        values_row = TextRow(
            row.path,
            row.number,
            row.text.rpartition('"')[2] if '"' in row.text else " ".join(row.words[1:]),
        )
        length, sigma, active = values_row.numbers(("length", "σ", "active"), 2, allow_more=True)
        # An end that was left out above leaves nothing to measure.
        if active == 0 or not {*values_row.words[:2]} <= {*index}:
            continue
        if not (length > 0 and sigma > 0):
            raise row.error("length and σ must be positive")
        ends.append([index[id] for id in values_row.words[:2]])
        values.append((length, sigma))
        lines.append(row.number)
    if not ends:
        return network
    value, sigma = np.array(values).T
    source = Source(str(file), np.array(lines), "line")
    return network.replace(distances=Distances(np.array(ends), value, sigma, source))


def write_jaicov(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write a project: NAME.phc and NAME.ior, .eor, .obc, .scale beside it.

    Cameras must have model `brown-projected`, with image and pixel size; images and cameras are
    numbered if their ids are not numbers.

    **Returns:** messages about what the format cannot hold.
    """
    path = Path(path)
    need_values(network, "brown-projected", "AICON")
    images, points, rays = network.images, network.points, network.observations
    if any(character.isspace() or character in '"#' for id in points.id for character in id):
        raise InputError(f"{path}: names of points cannot have blanks, quotes or #")
    image_ids, camera_ids = _numbers(images.id), _numbers([c.id for c in network.cameras])
    # Without a choice the inner datum is that of all tie points.
    datum = {*network.datum_points} or {id for id, r in zip(points.id, points.role) if r == "tie"}
    number = np.bincount(rays.point, minlength=len(points)).tolist()
    content = {
        path: [
            f"{image_ids[i]} {points.id[p]} {join_numbers(xy)} {join_numbers(s)} 0 0 0 1 0"
            for i, p, xy, s in zip(rays.image, rays.point, rays.xy, rays.sigma)
        ],
        path.with_suffix(".ior"): [
            line for id, c in zip(camera_ids, network.cameras) for line in _interior(id, c)
        ],
        path.with_suffix(".eor"): [
            # Order 0, active, state 3: by bundle adjustment.
            f"{id} {camera_ids[c]} {join_numbers(X0)} {join_numbers(angles)} 0 1 3"
            for id, c, X0, angles in zip(image_ids, images.camera, images.position, images.angles)
        ],
        path.with_suffix(".obc"): [
            f"{id} {join_numbers(X)} 0 0 0 {n} 1 1 {int(id in datum)}"
            for id, X, n in zip(points.id, points.position, number)
        ],
        path.with_suffix(".scale"): [
            f'{k} "" {points.id[a]} {points.id[b]} {join_numbers((value, sigma))} 1'
            for k, ((a, b), value, sigma) in enumerate(
                zip(network.distances.points, network.distances.value, network.distances.sigma)
            )
        ],
    }
    with replace_files(*content) as temporary:
        for temporary_path, lines in zip(temporary, content.values()):
            temporary_path.write_bytes("".join(f"{line}\n" for line in lines).encode())
    return describe_losses(network, JAICOV_LOSSES)


def _numbers(ids: Sequence[str]) -> list[str]:
    # 18 digits fit in 64 bits
    are_numbers = all(id.isascii() and id.isdigit() and len(id) < 19 for id in ids)
    return list(ids) if are_numbers else [str(k) for k in range(1, len(ids) + 1)]


# What it loses; names of cameras and images are numbers.
JAICOV_LOSSES = losing(
    "colours of points",
    keeping=("distances", "σ of image points", "datum points"),
    partly={
        "names of cameras": lambda n: _count_renumbered([camera.id for camera in n.cameras]),
        "names of images": lambda n: _count_renumbered(n.images.id),
    },
)


def _count_renumbered(ids: Sequence[str]) -> int:
    return changed(ids, _numbers(ids))


def _interior(id: str, camera: Camera) -> list[str]:
    p, (w, h) = all_parameters(camera), size_of(camera, "AICON")
    if camera.pixel_size is None:
        raise InputError(f"camera {camera.id!r}: AICON needs the sensor's size; give pixel_size")
    # In files of AICON c is negative.
    values = p | {"c": -p["c"]}
    lines = [join_numbers(values[name] for name in names if name in p) for names in INTERIOR[:4]]
    sensor = join_numbers((w * camera.pixel_size[0], h * camera.pixel_size[1]))
    return [f"{id} 0 {lines[0]}", *lines[1:], f"{sensor} {w} {h}"]
