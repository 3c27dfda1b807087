"""The output of Bundler: `bundle.out`, version 0.3, with the list of images beside it.

    # Bundle file v0.3
    cameras points                     two whole numbers
    f k1 k2                            a camera; f = 0: not oriented
    R, three rows of three
    t, three numbers
    …
    X Y Z                              a point
    red green blue
    rays  camera key x y  camera key x y  …

x_camera = R·X + t, x right, y up, looking along −z; image points count from the image centre, y up:
model `snavely`. `list.txt` in the same folder names the images, one per line; without it their
numbers, from 0, are their names. Keys are not kept.

Source: Snavely, Bundler user's manual, section "Output format and scene representation".
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import bundler_pose, exterior_from_bundler
from jaxbundle.io.networks.assemble import (
    all_parameters,
    assemble,
    colour_columns,
    foreign_document,
    image_columns,
)
from jaxbundle.io.networks.losses import (
    are_numbered_from_0,
    changed,
    describe_losses,
    losing,
    need_values,
)
from jaxbundle.io.networks.poses import check_rotations, matrices_of
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.rows import TextRows, join_numbers
from jaxbundle.io.writing.replacing import replace_files
from jaxbundle.network.build import POINT_COLOURS
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import Network, Source
from jaxbundle.system.file_content import beginning

HEAD = "# Bundle file v0.3"
LIST = "list.txt"
FREE = ["f", "k1", "k2"]


def is_bundler(path: Path) -> bool:
    """Whether a file begins like Bundler's output."""
    return beginning(path, 13) == b"# Bundle file"


def read_bundler(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a `bundle.out`: one camera per image, all parameters free, σ 1 px.

    Images without orientation are left out with a warning.

    **Raises:** `InputError` naming file and line.
    """
    path = Path(path)
    rows = TextRows(path)
    head = rows.take(f"{HEAD!r}")
    if " ".join(head.words) != HEAD:
        raise head.error(f"expected {HEAD!r}; other versions are not known")
    counts = rows.take("the numbers of cameras and points")
    cameras, points = (counts.integer(k, name) for k, name in ((0, "cameras"), (1, "points")))
    interior, R, t, camera_lines = _cameras(rows, cameras)
    oriented = np.flatnonzero(interior[:, 0] != 0) if cameras else np.zeros(0, int)
    if not len(oriented):
        raise InputError(f"{path}: no camera is oriented")
    names = _image_names(path.parent / LIST, cameras)
    position, colours, lines, rays = _points(rows, points, cameras)
    if rows.has_more():
        raise rows.take("").error(f"a line after the last of {points} points")
    image = rays[:, 0].astype(np.int64)
    in_oriented = np.isin(image, oriented)
    unoriented_names = [names[i] for i in np.setdiff1d(np.arange(cameras), oriented)]
    warnings = [
        f"left out {count(len(unoriented_names), 'image')} that have no orientation: "
        f"{list_some(unoriented_names)}"
    ]
    M, X0 = exterior_from_bundler(R[oriented], t[oriented])
    oriented_names = [names[i] for i in oriented]
    images = image_columns(
        Source(str(path), camera_lines[oriented], "line"), oriented_names, oriented_names, M, X0
    )
    ids = np.arange(points)
    return assemble(
        path,
        foreign_document(
            path.stem,
            [
                {"id": names[i], "model": "snavely", "free": FREE, **dict(zip(FREE, interior[i]))}
                for i in oriented.tolist()
            ],
        ),
        overrides,
        images,
        Columns(
            {"id": ids, **dict(zip("XYZ", position.T)), **colour_columns(colours)},
            Source(str(path), lines, "line"),
        ),
        Columns(
            {
                "image": [names[i] for i in image[in_oriented]],
                "point": rays[in_oriented, 1].astype(np.int64),
                "x": rays[in_oriented, 2],
                "y": rays[in_oriented, 3],
            },
            Source(str(path), rays[in_oriented, 4].astype(np.int64), "line"),
        ),
        warnings if unoriented_names else (),
    )


def _cameras(
    rows: TextRows, number: int
) -> tuple[
    Float[np.ndarray, "cameras 3"],
    Float[np.ndarray, "cameras 3 3"],
    Float[np.ndarray, "cameras 3"],
    Int[np.ndarray, " cameras"],
]:
    """f, k1, k2; R; t; and lines, of all cameras."""
    interior, R, t, lines = [], [], [], []
    for k in range(number):
        camera_name = f"camera {k} of {number}"
        row = rows.take(f"f, k1, k2 of {camera_name}")
        interior.append(row.numbers(FREE))
        lines.append(row.number)
        matrix = [rows.take(f"R of {camera_name}").numbers(["R"] * 3) for _ in range(3)]
        R.append(np.array(matrix))
        t.append(rows.take(f"t of {camera_name}").numbers(["t"] * 3))
        if interior[-1][0] != 0:  # an image that was not oriented has f = 0 and R = 0
            check_rotations(R[-1], f"{row.location}: R of {camera_name}")
    return (
        np.array(interior).reshape(-1, 3),
        np.array(R).reshape(-1, 3, 3),
        np.array(t).reshape(-1, 3),
        np.array(lines, np.int64),
    )


def _points(
    rows: TextRows, number: int, cameras: int
) -> tuple[
    Float[np.ndarray, "points 3"],
    Float[np.ndarray, "points 3"],
    Int[np.ndarray, " points"],
    Float[np.ndarray, "rays 5"],
]:
    """Coordinates; colours; lines; and (camera, point, x, y, line) of all rays."""
    position, colours, lines, rays = [], [], [], []
    for k in range(number):
        point_name = f"point {k} of {number}"
        row = rows.take(f"coordinates of {point_name}")
        position.append(row.numbers("XYZ"))
        lines.append(row.number)
        colours.append(rows.take(f"colour of {point_name}").numbers(POINT_COLOURS))
        row = rows.take(f"rays of {point_name}")
        views = row.rays(0, "a ray", cameras, "camera")
        line_column = np.full((len(views), 1), row.number)
        rays.append(
            np.concatenate(
                [views[:, :1], np.full_like(line_column, k), views[:, 2:], line_column], 1
            )
        )
    rays = np.concatenate(rays) if rays else np.zeros((0, 5))
    position, colours = (np.array(values).reshape(-1, 3) for values in (position, colours))
    return position, colours, np.array(lines, np.int64), rays


def _image_names(path: Path, number: int) -> list[str]:
    """Names of the images from the list, or their numbers."""
    if path.is_file():
        lines = [line.split() for line in read_text(path).splitlines() if line.strip()]
        names = [words[0].removeprefix("./") for words in lines]
        # A list of other photographs, or with one twice, names nothing.
        if len(names) == number and len(set(names)) == number:
            return names
    return [str(k) for k in range(number)]


# What it loses; cameras and points are numbered from 0.
BUNDLER_LOSSES = losing(
    "that images share a camera",
    "image sizes of cameras",
    "pixel sizes of cameras",
    partly={
        "names of cameras": lambda n: changed([c.id for c in n.cameras], range(len(n.cameras))),
        "names of points": lambda n: changed(n.points.id, range(len(n.points))),
    },
)


def write_bundler(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write `bundle.out` and, if the images have names, `list.txt` beside it.

    The cameras must be of model `snavely`; images that share a camera each get a copy of it.

    **Returns:** messages about what the format cannot hold.
    """
    path = Path(path)
    images, points, rays = network.images, network.points, network.observations
    need_values(network, "snavely", "Bundler")
    R, t = bundler_pose(matrices_of(images.angles), images.position)
    lines = [HEAD, f"{len(images)} {len(points)}"]
    for i, c in enumerate(images.camera.tolist()):
        for row in ([*all_parameters(network.cameras[c]).values()], *R[i], t[i]):
            lines.append(join_numbers(row))
    key = np.zeros(len(images), int)
    # The key of a ray is its number in the image, as that of a feature.
    of_point: list[list[str]] = [[] for _ in points.id]
    for image, point, (x, y) in zip(rays.image.tolist(), rays.point.tolist(), rays.xy.tolist()):
        of_point[point].append(f"{image} {key[image]} {x!r} {y!r}")
        key[image] += 1
    for position, colour, views in zip(points.position, points.colour_or_grey().tolist(), of_point):
        rgb = " ".join(map(str, colour))
        lines += [join_numbers(position), rgb, " ".join([str(len(views)), *views])]
    numbered = are_numbered_from_0(images.id)
    names = path.parent / LIST
    if not numbered:
        if any(character.isspace() for id in images.id for character in id):
            raise InputError(
                f"{path.parent / LIST}: names of images cannot contain blanks; rename the images"
            )
    content: dict[Path, Sequence[str]] = {path: lines}
    if not numbered or names.is_file():  # an existing list would name the images
        content[names] = images.id
    with replace_files(*content) as temporary:
        for temporary_path, text in zip(temporary, content.values()):
            temporary_path.write_bytes(("\n".join(text) + "\n").encode())
    return describe_losses(network, BUNDLER_LOSSES)
