"""Reconstructions of OpenSfM: `reconstruction.json`, with `tracks.csv`, `reference_lla.json` and
`ground_control_points.json` (`opensfm_control`).

    [{"cameras": {id: {projection_type, width, height, …}},
      "shots": {image: {camera, rotation, translation, gps_position, gps_dop}},
      "points": {id: {coordinates, color}}}, …]

The image points are in the tracks, one per line, separated by tabs: image, track, feature, x, y, …;
the header names the version (version 0 has no header). They and the camera parameters are relative
to the centre of the image, x right, y down, in units of its larger side s,

    u = s·x + (w − 1)/2   v = s·y + (h − 1)/2   fx = s·focal_x   cx = s·c_x + (w − 1)/2

    perspective, simple_radial, radial, brown    `opencv`: k1, k2, k3, p1, p2
    fisheye, fisheye_opencv                      `kannala-brandt`: k1 … k4
    fisheye62, fisheye624                        `kannala-brandt-tangential`, `thin-prism-fisheye`
                                                 where k5, k6, s1, s3 are 0, else fitted
    spherical, equirectangular                   `equirectangular`, fx = fy = s/(2π)
    dual                                         fitted: l·tan θ + (1 − l)·θ for θ of fisheye

x_camera = R·X + t, x right, y down, z forward; `rotation`
is the vector of R. `gps_position`, with σ `gps_dop` on every axis, are observed projection centres,
in the frame of the points, which is topocentric about `reference_lla.json`.

Source: OpenSfM documentation, "Geometric Models", "Dataset Structure"; its formulas for 2x², 2y² in
the tangential part, where the page has 2x, 2y.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import exterior_from_cv
from jaxbundle.io.cameras.nearest_camera import (
    Foreign,
    NoPlaceError,
    fit_camera,
    fit_messages,
    root,
    with_messages,
)
from jaxbundle.io.networks.assemble import (
    assemble,
    colour_columns,
    entry_of,
    foreign_document,
    image_columns,
)
from jaxbundle.io.networks.control import with_control
from jaxbundle.io.networks.opensfm_control import CONTROL, GroundControl, read_ground_control
from jaxbundle.io.networks.poses import (
    matrices_of_rotation_vectors,
)
from jaxbundle.io.networks.settings import choose_datum
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields, read_object, stack_rows
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.rows import TextRows
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.kinds import Antennas
from jaxbundle.network.tables import GREY, Camera, Network, Source
from jaxbundle.system.file_content import beginning, parse_json
from jaxbundle.types import not_none

RECONSTRUCTION, TRACKS, MODELS, REFERENCE = (
    "reconstruction.json",
    "tracks.csv",
    "camera_models.json",
    "reference_lla.json",
)
HEAD = "OPENSFM_TRACKS_VERSION_v"
ONE_FOCAL_LENGTH = ("focal",)
TWO_FOCAL_LENGTHS = ("focal_x", "focal_y")
# Our model, focal lengths, coefficients.
KINDS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "perspective": ("opencv", ONE_FOCAL_LENGTH, ("k1", "k2")),
    "simple_radial": ("opencv", TWO_FOCAL_LENGTHS, ("k1",)),
    "radial": ("opencv", TWO_FOCAL_LENGTHS, ("k1", "k2")),
    "brown": ("opencv", TWO_FOCAL_LENGTHS, ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("kannala-brandt", ONE_FOCAL_LENGTH, ("k1", "k2")),
    "fisheye_opencv": ("kannala-brandt", TWO_FOCAL_LENGTHS, ("k1", "k2", "k3", "k4")),
}
PRISM = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3")
CAMERA_KEYS = Keys(
    (
        *("projection_type", "width", "height", "focal", "focal_x", "focal_y", "c_x", "c_y"),
        *(*PRISM, "transition", "aspect_ratio"),
    ),
    {
        "*_prior": "start values of a reconstruction",
        "*_sigma": "of the start values",
        **dict.fromkeys(("focal_ratio", "name", "make", "model", "rig*"), "names of the camera"),
    },
)
SHOT_KEYS = Keys(
    ("camera", "rotation", "translation", "gps_position", "gps_dop"),
    {
        "orientation": "how the photograph is displayed",
        **dict.fromkeys(
            ("capture_time", "vertices", "faces", "merge_cc", "skey", "is_interpolated", "color",
             "name", "exif*"),
            "time, mesh and names",
        ),
        **dict.fromkeys(
            ("rig_camera_id", "rig_instance_id", "covariance", "scale"),
            "every shot has its own pose",
        ),
        **dict.fromkeys(
            ("compass", "opk*", "gravity*", "accelerometer"), "measured angles of the start",
        ),
    },
)  # fmt: skip
POINT_KEYS = Keys(
    ("coordinates", "color"),
    dict.fromkeys(("reprojection_errors", "reprojection_error", "rig*"), "residuals"),
)
SCENE_KEYS = Keys(
    ("cameras", "shots", "points"),
    {
        **dict.fromkeys(("biases", "rig_cameras", "rig_instances", "main_shots", "pano_shots"),
                        "every shot has its own pose"),
        "reference_lla": "as in its own file",
    },
)  # fmt: skip
FITTED_KINDS = ("fisheye62", "fisheye624", "dual")
SPHERICAL = ("spherical", "equirectangular")


def is_opensfm(path: Path) -> bool:
    """Whether a path is a reconstruction, or a folder with one."""
    if path.is_dir():
        return (path / RECONSTRUCTION).is_file()
    return _has_cameras(path, b"[")


def is_opensfm_cameras(path: Path) -> bool:
    """Whether a path is a JSON file with cameras only, such as `camera_models.json`."""
    return _has_cameras(path, b"{")


def _has_cameras(path: Path, begin: bytes) -> bool:
    head = beginning(path, 1_000_000).lstrip() if path.suffix.lower() == ".json" else b""
    if not head.startswith(begin) or b'"transform_matrix"' in head or b'"viewId"' in head:
        return False
    # Models of 2015 and before have no projection_type: all were perspective.
    old = b'"focal_prior"' in head or (begin == b"[" and b'"shots"' in head)
    return b'"projection_type"' in head or old


def read_opensfm_cameras(path: str | Path) -> tuple[Camera, ...]:
    """The cameras of `camera_models.json`.

    **Raises:** `InputError` naming file, camera and field.
    """
    path = Path(path)
    document = JsonFields(path, {"": read_object(path, read_text(path), "OpenSfM's cameras")})
    unknown = UnknownKeys()
    cameras = []
    for id, fields in document.objects("").items():
        unknown.check(fields.document, CAMERA_KEYS, fields.path)
        cameras.append(_camera(id, fields))
    return tuple(with_messages(camera, *unknown.messages()) for camera in cameras)


def read_opensfm(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of the largest reconstruction of a file.

    No camera parameter is free, σ is 1 px; the datum is given by GPS positions
    if three shots have one, else inner.

    **Raises:** `InputError` naming file, entry and field.
    """
    path = Path(path)
    file = path / RECONSTRUCTION if path.is_dir() else path
    scene, messages = _largest_reconstruction(file)
    unknown = UnknownKeys()
    unknown.check(scene.document, SCENE_KEYS, file)
    for fields in scene.objects("cameras").values():
        unknown.check(fields.document, CAMERA_KEYS, fields.path)
    cameras, errors = _cameras(scene)
    shots, omitted_shots = {}, []
    for id, shot in scene.objects("shots").items():
        unknown.check(shot.document, SHOT_KEYS, shot.path)
        camera = shot.text("camera")
        if camera in cameras:
            shots[id] = shot
        elif camera in errors:
            omitted_shots.append(id)
        else:
            raise InputError(f"{shot.path}: camera {camera!r} is not among the cameras")
    if not shots:
        raise next(iter(errors.values()), InputError(f"{file}: there are no shots"))
    if omitted_shots:
        reason = "; ".join(str(error).removeprefix(f"{file}, ") for error in errors.values())
        messages.append(
            f"{reason}; left out {count(len(omitted_shots), 'shot')}: {list_some(omitted_shots)}"
        )
    gps = _observed_centres(shots)
    if not gps and (number := sum(shot.get("gps_position") is not None for shot in shots.values())):
        messages.append(
            f"gps_position of {count(number, 'shot')} is not read: fewer than three do not "
            "determine a datum"
        )
    points = scene.objects("points")
    for point in points.values():
        unknown.check(point.document, POINT_KEYS, point.path)
    coordinates, colours = (
        stack_rows(
            [p.get(name, default) for p in points.values()],
            3,
            lambda k, name=name: (str([*points.values()][k].path), name),
        ).reshape(-1, 3)
        for name, default in (("coordinates", None), ("color", GREY))
    )
    rays, unmatched_count = _tracks(file.parent / TRACKS, cameras, shots, points)
    if unmatched_count:
        messages.append(
            f"left out {count(unmatched_count, 'image point')} of tracks that have no point"
        )
    if points and rays is None:
        messages.append(f"{file.parent / TRACKS} is not there: no image points")
    names, control = list(points), None
    if (file.parent / CONTROL).is_file():
        shot_cameras = {id: cameras[shot.text("camera")] for id, shot in shots.items()}
        control = read_ground_control(file.parent / CONTROL, file.parent / REFERENCE, shot_cameras)
        messages += control.messages
        control = control.renamed({*names})
        names, coordinates, rays = _add_control(file, control, names, coordinates, rays)
        colours = np.concatenate([colours, np.full((len(coordinates) - len(colours), 3), np.nan)])
    if (file.parent / REFERENCE).is_file():
        messages.append(_describe_reference(file.parent / REFERENCE))
    datum = {"datum": "control"} if gps else {}
    network = assemble(
        file,
        foreign_document(
            file.parent.name, map(entry_of, cameras.values()), object_unit="m", **datum
        ),
        overrides,
        _images(file, shots),
        Columns(
            {"id": names, **dict(zip("XYZ", coordinates.T)), **colour_columns(colours)},
            Source(str(file), None, "point"),
        ),
        rays,
        (*messages, *fit_messages(cameras.values()), *unknown.messages()),
    )
    network = network.replace(further=gps)
    if control is None or control.points is None or not len(network.points):
        return network
    return with_control(network, control.points, datum=not choose_datum(overrides))


def _add_control(
    file: Path,
    control: GroundControl,
    names: Sequence[str],
    coordinates: Float[np.ndarray, "n 3"],
    rays: Columns | None,
) -> tuple[list[str], Float[np.ndarray, "m 3"], Columns]:
    """Points and image points with those of ground control."""
    control_ids = [*(control.points.id if control.points else ()), *control.unknown]
    columns: dict[str, list] = {}
    for k, name in enumerate(("image", "point", "x", "y")):
        tracked = () if rays is None else rays.values[name]
        columns[name] = [*tracked, *(row[k] for row in control.rays)]
    unknown = np.full((len(control_ids), 3), np.nan)
    source = Source(str(file.parent / CONTROL), None, "observation")
    if rays is not None and rays.source.numbers is not None:
        # Lines of the tracks; the image points of control have none.
        lines = np.r_[rays.source.numbers, np.zeros(len(control.rays), np.int64)]
        source = dataclasses.replace(rays.source, numbers=lines)
    return [*names, *control_ids], np.concatenate([coordinates, unknown]), Columns(columns, source)


def _largest_reconstruction(file: Path) -> tuple[JsonFields, list[str]]:
    """The reconstruction with the most shots, and messages about the others."""
    scenes = JsonFields(file, {"": parse_json(file, read_text(file))}).rows("")
    if not scenes:
        raise InputError(f"{file}: there is no reconstruction in it")
    sizes = [len(scene.get("shots") or ()) for scene in scenes]
    largest = int(np.argmax(sizes))
    scene = JsonFields(file, scenes[largest].document)
    other_shots = sum(sizes) - sizes[largest]
    # Each part has its own datum: they cannot be one network.
    if len(scenes) == 1:
        return scene, []
    return scene, [
        f"the largest of {len(scenes)} reconstructions is read; the others have "
        f"{count(other_shots, 'shot')}"
    ]


def _cameras(scene: JsonFields) -> tuple[dict[str, Camera], dict[str, NoPlaceError]]:
    cameras, errors = {}, {}
    for id, fields in scene.objects("cameras").items():
        try:
            cameras[id] = _camera(id, fields)
        except NoPlaceError as error:
            errors[id] = error
    return cameras, errors


def _camera(id: str, fields: JsonFields) -> Camera:
    """Our camera; **Raises:** `NoPlaceError` if no model fits."""
    kind = fields.text("projection_type", "perspective")
    size = fields.integer("width", minimum=1), fields.integer("height", minimum=1)
    if (ratio := fields.number("aspect_ratio", 1.0)) != 1:
        raise InputError(
            f"{fields.path}: aspect_ratio {ratio:g} is not read; expected 1, with focal_x and "
            "focal_y of projection_type brown for two focal lengths"
        )
    if kind in SPHERICAL:
        f = max(size) / (2 * np.pi)
        middle = {"cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2}
        return Camera(id, "equirectangular", {"fx": f, "fy": f} | middle, image_size=size)
    if kind not in (*KINDS, *FITTED_KINDS):
        choices = ", ".join((*KINDS, *FITTED_KINDS, *SPHERICAL))
        raise InputError(f"{fields.path}: projection_type is {kind}; expected one of {choices}")
    single = kind in ("perspective", "fisheye", "dual")  # one focal length, centred
    f = [
        max(size) * fields.number(name)
        for name in (ONE_FOCAL_LENGTH * 2 if single else TWO_FOCAL_LENGTHS)
    ]
    c = [
        max(size) * (0.0 if single else fields.number(name, 0.0)) + (n - 1) / 2
        for name, n in zip(("c_x", "c_y"), size)
    ]
    core: dict[str, float] = dict(zip(("fx", "fy", "cx", "cy"), (*f, *c)))
    if kind in KINDS:
        model, _, names = KINDS[kind]
        coefficients = {name: fields.number(name, 0.0) for name in names}
        tie = (("fx", "fy"),) if single else ()
        return Camera(id, model, core | coefficients, image_size=size, tie=tie)
    if kind == "dual":
        parameters = {"l": fields.number("transition", 0.5)}
        parameters |= {name: fields.number(name, 0.0) for name in ("k1", "k2")}
        formula = _project_dual
    else:
        parameters = {name: fields.number(name, 0.0) for name in PRISM}
        exact = (
            {"sx1": parameters["s0"], "sy1": parameters["s2"]}
            if parameters["s0"] or parameters["s2"]
            else {}
        )
        if not any(parameters[name] for name in ("k5", "k6", "s1", "s3")):
            model = "thin-prism-fisheye" if exact else "kannala-brandt-tangential"
            p = {name: parameters[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2")}
            return Camera(id, model, core | p | exact, image_size=size)
        formula = _project_fisheye624
    foreign = Foreign(formula, core | parameters, core, size, fisheye=True)
    return fit_camera(id, foreign, str(fields.path), f"is of projection_type {kind}")


def _project_fisheye624(
    p: Mapping[str, Scalar], X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    """fisheye624: decentring and thin prism are of the image of the angle, as the radial part."""
    radius = root(X * X + Y * Y)
    # θ/|[X, Y]|, whose limit on the axis is 1/Z
    scale = jnp.where(
        radius > 0, jnp.arctan2(radius, Z) / jnp.where(radius > 0, radius, 1.0), 1 / Z
    )
    x, y = X * scale, Y * scale
    t2 = x * x + y * y
    radial = 1 + sum(p[f"k{i}"] * t2**i for i in range(1, 7))
    xd = x * radial + 2 * p["p1"] * x * y + p["p2"] * (t2 + 2 * x * x)
    yd = y * radial + 2 * p["p2"] * x * y + p["p1"] * (t2 + 2 * y * y)
    xd, yd = xd + t2 * (p["s0"] + t2 * p["s1"]), yd + t2 * (p["s2"] + t2 * p["s3"])
    return jnp.stack([p["fx"] * xd + p["cx"], p["fy"] * yd + p["cy"]])


def _project_dual(p: Mapping[str, Scalar], X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """Between a perspective image and one of the angle."""
    radius = root(X * X + Y * Y)
    angle = jnp.arctan2(radius, Z)
    fish = jnp.where(radius > 0, angle / jnp.where(radius > 0, radius, 1.0), 1 / Z)
    scale = p["l"] / Z + (1 - p["l"]) * fish
    x, y = X * scale, Y * scale
    r2 = x * x + y * y
    radial = 1 + r2 * (p["k1"] + r2 * p["k2"])
    return jnp.stack([p["fx"] * x * radial + p["cx"], p["fy"] * y * radial + p["cy"]])


def _images(file: Path, shots: Mapping[str, JsonFields]) -> Columns:
    paths = [str(shot.path) for shot in shots.values()]
    rotation_vectors, t = (
        stack_rows([shot.get(name) for shot in shots.values()], 3, lambda k, n=name: (paths[k], n))
        for name in ("rotation", "translation")
    )
    M, X0 = exterior_from_cv(matrices_of_rotation_vectors(rotation_vectors), t)
    cameras = [shot.text("camera") for shot in shots.values()]
    return image_columns(Source(str(file), None, "shot"), list(shots), cameras, M, X0)


def _observed_centres(shots: Mapping[str, JsonFields]) -> tuple[Antennas, ...]:
    """The observed projection centres, if they define a datum."""
    positioned_shots = {
        id: shot for id, shot in shots.items() if shot.get("gps_position") is not None
    }
    if len(positioned_shots) < 3:  # do not determine the seven parameters of a datum
        return ()
    X0 = np.array([shot.array("gps_position", (3,)) for shot in positioned_shots.values()])
    default = 15.0  # m, OpenSfM's default of gps_dop
    sigma = np.array([shot.number("gps_dop", default) for shot in positioned_shots.values()])
    sigma = np.where(sigma > 0, sigma, default)
    columns = {
        "image": list(positioned_shots),
        **dict(zip("XYZ", X0.T)),
        **{f"s{axis}": sigma for axis in "XYZ"},
    }
    return (
        Antennas.from_columns(Columns(columns, Source("shots", None, "gps_position")), {}, 1.0),
    )


def _tracks(
    file: Path,
    cameras: Mapping[str, Camera],
    shots: Mapping[str, JsonFields],
    points: Mapping[str, JsonFields],
) -> tuple[Columns | None, int]:
    """The table of image points, None without tracks; how many have no point."""
    if not file.is_file():
        return None, 0
    columns: dict[str, list] = {name: [] for name in ("image", "point", "x", "y")}
    lines, unmatched_count = [], 0
    for row in TextRows(file, separator="\t"):
        if row.text.startswith(HEAD):
            version = row.text.removeprefix(HEAD).strip()
            if version not in ("1", "2", "3"):
                raise row.error(f"tracks of version {version[:20]}; 0, 1, 2 and 3 are known")
            continue
        if len(row) < 5:
            raise row.error(f"{len(row)} columns; expected image, track, feature, x, y, …")
        image, point = row.words[:2]
        # Of a photograph without orientation, or of a camera that was refused.
        if image not in shots:
            continue
        if point not in points:
            unmatched_count += 1
            continue
        x, y = row.numbers(("x", "y"), 3, allow_more=True)
        w, h = not_none(cameras[shots[image].text("camera")].image_size)
        values = (image, point, max(w, h) * x + (w - 1) / 2, max(w, h) * y + (h - 1) / 2)
        for column, value in zip(columns.values(), values):
            column.append(value)
        lines.append(row.number)
    return Columns(columns, Source(str(file), np.array(lines, np.int64), "line")), unmatched_count


def _describe_reference(file: Path) -> str:
    fields = JsonFields(file, read_object(file, read_text(file), "a reference"))
    origin = ", ".join(
        f"{name} {fields.number(name):.9g}" for name in ("latitude", "longitude", "altitude")
    )
    return f"coordinates are topocentric about {origin} ({REFERENCE})"
