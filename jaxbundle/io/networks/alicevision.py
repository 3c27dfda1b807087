"""Scenes of AliceVision (Meshroom): `.sfm`, JSON with all numbers as texts.

    version       ["1", "2", "5"]
    views         viewId, poseId, intrinsicId, path, width, height
    intrinsics    intrinsicId, width, height, type, distortionType, distortionParams,
                  principalPoint, pxFocalLength (before 1.2.2); focalLength and sensorWidth in mm,
                  pixelRatio
    poses         poseId, pose/transform: rotation (by columns), center
    structure     landmarkId, X, color, observations: observationId (a view), x

x_camera = R·(X − center), x right, y down, z forward. The principal point counts from the centre of
the image, before version 1.2.1 from its corner; fx = focalLength/sensorWidth·width and fy =
fx·pixelRatio, before version 1.2.5 fx/pixelRatio.

    pinhole, none                         `opencv`
    radial1, radial3 (radialk1, radialk3) `opencv` with k1, k2, k3
    brown                                 `opencv` with k1, k2, k3, p1 = t1, p2 = t2
    fisheye4                              `kannala-brandt`
    fisheye1                              `fov`

Which point of the first pixel is (0, 0) is not published; its centre is assumed, so that the centre
of the image is w/2. Another choice would shift image points and principal point alike, so that no
ray changes.

Source: AliceVision, sfmDataIO: its changelog and reader of JSON; its camera classes.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.networks.assemble import (
    assemble,
    colour_columns,
    foreign_document,
    image_columns,
    unique_labels,
)
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields, read_object, stack_rows
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import GREY, Network, Source
from jaxbundle.system.file_content import beginning

SUFFIXES = (".sfm", ".json")
# Our model and coefficients, by the distortion, or the kind of older versions.
KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    **dict.fromkeys(("pinhole", "none", ""), ("opencv", ())),
    **dict.fromkeys(("radial1", "radialk1"), ("opencv", ("k1",))),
    **dict.fromkeys(("radial3", "radialk3"), ("opencv", ("k1", "k2", "k3"))),
    "brown": ("opencv", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye4": ("kannala-brandt", ("k1", "k2", "k3", "k4")),
    "fisheye1": ("fov", ("omega",)),
}
SETTINGS = "settings and files of the program"
FILE_KEYS = Keys(
    ("version", "views", "intrinsics", "poses", "structure"),
    dict.fromkeys(("featuresFolders", "matchesFolders", "constraints*", "ancestors"), SETTINGS),
    {"rigs": "every view has its own pose", "controlPoints": "give them as control points"},
)
VIEW_KEYS = Keys(
    ("viewId", "poseId", "intrinsicId", "path", "width", "height"),
    dict.fromkeys(
        ("frameId", "metadata", "resectionId", "isPoseIndependant", "isPoseIndependent", "rigId",
         "subPoseId", "ancestors"),
        "when and how the photograph was taken",
    ),
)  # fmt: skip
INTRINSIC_KEYS = Keys(
    (
        *("intrinsicId", "width", "height", "type", "distortionType", "distortionParams"),
        *("principalPoint", "pxFocalLength", "focalLength", "sensorWidth", "pixelRatio"),
    ),
    {
        **dict.fromkeys(
            ("serialNumber", "initializationMode", "distortionInitializationMode", "locked",
             "pixelRatioLocked", "offsetLocked", "scaleLocked", "distortionLocked",
             "pxInitialFocalLength", "initialFocalLength", "sensorHeight"),
            "names, start values, what is held",
        ),
        **dict.fromkeys(
            ("undistortionOffset", "undistortionParams", "undistortionType"),
            "the other direction of the same distortion; refused where it is the only one",
        ),
        **dict.fromkeys(
            ("fisheyeCenterX", "fisheyeCenterY", "fisheyeRadius", "fisheyeCircleCenterX",
             "fisheyeCircleCenterY", "fisheyeCircleRadius"),
            "the part of the image that is used",
        ),
    },
)  # fmt: skip
POINT_KEYS = Keys(
    ("landmarkId", "X", "color", "observations"),
    dict.fromkeys(("descType", "parallaxRobust", "state"), "features"),
)
RAY_KEYS = Keys(("observationId", "x"), dict.fromkeys(("featureId", "scale", "depth"), "features"))


def is_alicevision(path: Path) -> bool:
    """Whether a JSON file has views and intrinsics of AliceVision."""
    head = beginning(path, 100_000) if path.suffix.lower() in SUFFIXES else b""
    return re.search(rb'"version"\s*:\s*\[', head) is not None and (
        b'"viewId"' in head or b'"intrinsicId"' in head
    )


def read_alicevision(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a scene; cameras and points are named by number, images by file.

    No camera parameter is free, σ is 1 px, the datum inner. Views without pose and image points are
    left out.

    **Raises:** `InputError` naming file, entry and field.
    """
    path = Path(path)
    file, unknown = (
        JsonFields(path, read_object(path, read_text(path), "AliceVision")),
        UnknownKeys(),
    )
    unknown.check(file.document, FILE_KEYS, path)
    version = tuple(int(part) for part in _numbers(file, "version", None))
    cameras = {}
    for row in file.rows("intrinsics"):
        unknown.check(row.document, INTRINSIC_KEYS, row.path)
        id = row.text("intrinsicId")
        cameras[id] = _camera(row, id, version)
    poses = {row.text("poseId"): row.child("pose.transform") for row in file.rows("poses")}
    views, without_camera = {}, []
    for row in file.rows("views"):
        unknown.check(row.document, VIEW_KEYS, row.path)
        id = row.text("viewId")
        if row.text("intrinsicId", "none") in cameras:
            views[id] = row
        else:
            without_camera.append(Path(_photograph_path(row, id)).name)
    tie_points, colours, rays = _structure(file, unknown, views)
    measured_views = {view for view, *_ in rays}
    posed_views = {id for id, row in views.items() if row.text("poseId", "none") in poses}
    omitted_views = [
        Path(_photograph_path(views[id], id)).name
        for id in views
        if id not in posed_views | measured_views
    ]
    views = {id: row for id, row in views.items() if id in posed_views | measured_views}
    if not views:
        raise InputError(
            f"{path}: a scene of AliceVision without poses and image points; expected the result "
            "of its structure from motion"
        )
    files = [re.split(r"[\\/]", _photograph_path(row, id))[-1] for id, row in views.items()]
    labels = unique_labels(files, list(views))
    names = dict(zip(views, labels))
    R, X0 = np.full((len(views), 3, 3), np.nan), np.full((len(views), 3), np.nan)
    for k, (id, row) in enumerate(views.items()):
        if id in posed_views:
            pose = poses[row.text("poseId")]
            R[k] = _numbers(pose, "rotation", 9).reshape(3, 3).T
            X0[k] = _numbers(pose, "center", 3)
            check_rotations(R[k], f"{pose.path}: rotation")
    images = image_columns(
        Source(str(path), None, "view"),
        labels,
        [row.text("intrinsicId") for row in views.values()],
        flip_rows(R),
        X0,
    )
    location_of = lambda k: (f"{path}, structure[{k}]", "X")
    X = stack_rows(
        [_parse_numbers(value) for value in tie_points.values()], 3, location_of
    ).reshape(-1, 3)
    location_of = lambda k: (f"{path}, structure[{k}]", "color")
    rgb = stack_rows([_parse_numbers(value) for value in colours], 3, location_of).reshape(-1, 3)
    location_of = lambda k: (f"{path}, landmark {rays[k][1]}, view {rays[k][0]}", "x")
    xy = stack_rows([_parse_numbers(x) for *_, x in rays], 2, location_of).reshape(-1, 2)
    left_out = {
        "without pose and image points": omitted_views,
        "whose intrinsicId is not among the intrinsics, with their image points": without_camera,
    }
    messages = [
        f"left out {count(len(names_left_out), 'view')} {why}: {list_some(names_left_out)}"
        for why, names_left_out in left_out.items()
        if names_left_out
    ]
    return assemble(
        path,
        foreign_document(path.stem, cameras.values()),
        overrides,
        images,
        Columns(
            {"id": list(tie_points), **dict(zip("XYZ", X.T)), **colour_columns(rgb)},
            Source(str(path), None, "landmark"),
        ),
        Columns(
            {
                "image": [names[view] for view, *_ in rays],
                "point": [point for _, point, _ in rays],
                **dict(zip("xy", xy.T)),
            },
            Source(str(path), None, "observation"),
        ),
        (*messages, *unknown.messages()),
    )


def _camera(row: JsonFields, id: str, version: tuple[int, ...]) -> dict[str, Any]:
    """The entry of an intrinsic."""
    w, h = (int(_number(row, key)) for key in ("width", "height"))
    kind = row.text("type", "pinhole").lower()
    distortion = row.text("distortionType", kind).lower()
    # Since the kinds and the distortions are apart, a kind is pinhole or equidistant.
    name = distortion if kind in ("pinhole", *KINDS) else kind
    if name not in KINDS:
        raise InputError(
            f"{row.path}: a camera of AliceVision of type {kind}, distortion {distortion}; "
            f"expected one of {', '.join(filter(None, KINDS))}"
        )
    model, names = KINDS[name]
    values = _numbers(row, "distortionParams", None).tolist() if row.get("distortionParams") else []
    if any(values[len(names) :]):
        raise InputError(
            f"{row.path}: {len(values)} distortionParams for {name}, which has {len(names)}"
        )
    undistortion = (
        _numbers(row, "undistortionParams", None) if row.get("undistortionParams") else ()
    )
    if np.any(undistortion) and not any(values):
        raise InputError(
            f"{row.path}: undistortionParams without distortionParams are not read; expected a "
            "camera calibrated by AliceVision"
        )
    values += [0.0] * (len(names) - len(values))
    if version < (1, 2, 2):
        f = (
            _numbers(row, "pxFocalLength", None)
            if isinstance(row.get("pxFocalLength"), list)
            else (np.array([_number(row, "pxFocalLength")] * 2))
        )
    else:
        ratio, width = _number(row, "pixelRatio", 1.0), _number(row, "sensorWidth")
        if ratio <= 0 or width <= 0:
            raise InputError(
                f"{row.path}: sensorWidth is {width:g}, pixelRatio {ratio:g}; expected positive "
                "numbers"
            )
        fx = _number(row, "focalLength") / width * w
        f = np.array([fx, fx * ratio if version >= (1, 2, 5) else fx / ratio])
    if len(f) != 2 or not (f > 0).all():
        raise InputError(f"{row.path}: the focal length is {f}; expected positive numbers")
    c = _numbers(row, "principalPoint", 2) + (0 if version < (1, 2, 1) else np.array([w, h]) / 2)
    core = dict(zip(("fx", "fy", "cx", "cy"), (*f.tolist(), *c.tolist())))
    tie = {"tie": [["fx", "fy"]]} if f[0] == f[1] else {}
    return {
        "id": id,
        "model": model,
        "image_size": [w, h],
        **tie,
        **core,
        **dict(zip(names, values)),
    }


def _photograph_path(view: JsonFields, id: str) -> str:
    """The path of a photograph, or the number of its view."""
    return str(view.get("path") or id)


def _structure(
    file: JsonFields, unknown: UnknownKeys, views: Mapping[str, JsonFields]
) -> tuple[dict[str, Any], list[Any], list[tuple[str, str, Any]]]:
    """X of the landmarks; their colours; view, landmark, x of the image points."""
    tie_points, colours, rays = {}, {}, []
    for row in file.rows("structure"):
        unknown.check(row.document, POINT_KEYS, row.path)
        id = row.text("landmarkId")
        tie_points[id], colours[id] = row.get("X"), row.get("color", GREY)
        for ray in row.rows("observations"):
            unknown.check(ray.document, RAY_KEYS, ray.path)
            view = ray.text("observationId")
            if view in views and ray.get("x") is not None:
                rays.append((view, id, ray.get("x")))
    return tie_points, [*colours.values()], rays


def _parse_numbers(value: Any) -> Any:
    """Numbers that stand there as texts."""
    try:
        return [float(x) for x in value]
    except (TypeError, ValueError):
        return value


def _numbers(fields: JsonFields, key: str, length: int | None) -> np.ndarray:
    value = fields.get(key)
    return JsonFields(fields.path, {key: _parse_numbers(value)}).array(key, (length,))


def _number(fields: JsonFields, key: str, default: float | None = None) -> float:
    value = fields.get(key, default)
    try:
        value = float(value) if isinstance(value, str) else value
    except ValueError:
        pass
    return JsonFields(fields.path, {key: value}).number(key)
