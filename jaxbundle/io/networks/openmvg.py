"""Scenes of openMVG: `sfm_data.json`, version 0.2 and later.

    views            key, value: ptr_wrapper/data: local_path, filename, width, height, id_view,
                     id_intrinsic, id_pose
    intrinsics       key, value: polymorphic_id, polymorphic_name, ptr_wrapper/data: width, height,
                     focal_length, principal_point, and the coefficients of the kind
    extrinsics       key, value: rotation (three rows), center
    structure        key, value: X, observations: key (of the view), value: id_feat, x
    control_points   the same

The name of a kind is given at its first intrinsic only; later ones repeat its number. Some versions
wrap the fields inherited from another kind in "value0". Of the kinds

    pinhole, pinhole_radial_k1, pinhole_radial_k3    disto_k1, disto_k3: k1, k2, k3
    pinhole_brown_t2                                 disto_t2: k1, k2, k3, t1, t2
    fisheye                                          fisheye: k1 … k4

the first are `opencv` with p1 = t1, p2 = t2, the last `kannala-brandt`; fx = fy = focal_length.
x_camera = R·(X − center), x right, y down, z forward. A spherical camera,

    u = w/2 + s·λ/2π    v = h/2 + s·φ/2π    λ = atan2(x, z), φ = atan2(−y, √(x² + z²))

with s = max(w, h),
has y up in a frame that is rotated without reflection: its scene is a mirror image. A scene of
spherical cameras only is mirrored back (y of world and cameras negated) and read as
`equirectangular`; beside other cameras the views of spherical ones are left out.
Which point of the first pixel is (0, 0) is not published; its centre is assumed. Another
choice would shift image points and principal point alike, so that no ray changes.

Source: openMVG documentation, "SfM_Data", "cameras"; the serialisation of its cameras.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.networks.assemble import (
    assemble,
    foreign_document,
    image_columns,
    unique_labels,
)
from jaxbundle.io.networks.control import with_control
from jaxbundle.io.networks.losses import (
    changed,
    check_others_zero,
    describe_losses,
    losing,
    need_values,
    one_focal_length,
    size_of,
    written_numbers,
)
from jaxbundle.io.networks.poses import check_rotations, matrices_of
from jaxbundle.io.networks.settings import choose_datum
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.json_fields import JsonFields, read_object, stack_rows
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import Camera, Network, Points, Source
from jaxbundle.system.file_content import beginning

# Our model, the field of the coefficients, and their names here.
KINDS = {
    "pinhole": ("opencv", "", ()),
    "pinhole_radial_k1": ("opencv", "disto_k1", ("k1",)),
    "pinhole_radial_k3": ("opencv", "disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": ("opencv", "disto_t2", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("kannala-brandt", "fisheye", ("k1", "k2", "k3", "k4")),
}
SPHERICAL = "spherical"
SCENE_KEYS = Keys(
    ("sfm_data_version", "views", "intrinsics", "extrinsics", "structure", "control_points"),
    {"root_path": "where the images are"},
)
VIEW_KEYS = Keys(
    ("local_path", "filename", "width", "height", "id_view", "id_intrinsic", "id_pose", "value0"),
    {"use_pose_*": "told where it is used", "center*": "the same", "rotation*": "the same"},
)
INTRINSIC_KEYS = Keys(
    (
        *("width", "height", "focal_length", "principal_point", "value0"),
        *filter(None, (field for _, field, _ in KINDS.values())),
    )
)
POSE_KEYS = Keys(("rotation", "center"))
POINT_KEYS = Keys(("X", "observations"))
RAY_KEYS = Keys(("id_feat", "x"))
MIRROR = np.array([1.0, -1.0, 1.0])
# Index of a missing entry, the largest of 32 bits (openMVG, `types.hpp`, UndefinedIndexT).
UNDEFINED_INDEX = 2**32 - 1
# The bit of a new number, whose name or object follows (cereal, `details/helpers.hpp`, msb_32bit).
NEW_NUMBER = 2**31
# The number of an object of the declared class (cereal, `details/helpers.hpp`, msb2_32bit).
DECLARED_CLASS = 2**30


def is_openmvg(path: Path) -> bool:
    """Whether a JSON file begins with a version of openMVG's scene."""
    return path.suffix.lower() == ".json" and b'"sfm_data_version"' in beginning(path, 1000)


def read_openmvg(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a scene; cameras and points are named by number, images by file.

    No camera parameter is free, σ is 1 px, the datum inner; control points are held. Views
    without pose have no orientation, or are left out if they have no image point.

    **Raises:** `InputError` naming file, entry and field.
    """
    path = Path(path)
    scene = JsonFields(path, read_object(path, read_text(path), "openMVG's scene"))
    scene.text("sfm_data_version")
    unknown = UnknownKeys()
    _check_keys(scene, unknown)
    cameras, spherical = _cameras(scene)
    mirror = MIRROR if spherical and not cameras else np.ones(3)
    if spherical and not cameras:
        cameras, spherical = (
            {key: _spherical_camera(key, data) for key, data in spherical.items()},
            {},
        )
    views, skipped_views = _views(scene, cameras, spherical)
    poses = {key: pose for key, pose in _entries(scene, "extrinsics").items()}
    tie_points, rays = _structure(scene, "structure", views)
    control_points, control_rays = _structure(scene, "control_points", views)
    # Numbers of control points and of structure are counted apart, and may be equal.
    names = {key: f"control {key}" if key in tie_points else str(key) for key in control_points}
    measured_views = {view for view, *_ in (*rays, *control_rays)}
    posed_views = {key for key, view in views.items() if view.get("id_pose") in poses}
    empty_views = [
        _view_name(views[key])
        for key in views
        if key not in posed_views and key not in measured_views
    ]
    views = {
        key: view for key, view in views.items() if key in posed_views or key in measured_views
    }
    if not views:
        raise InputError(f"{path}: no view has a pose or an image point")
    labels = unique_labels([_view_name(view) for view in views.values()], list(views))
    image_ids = dict(zip(views, labels))
    network = assemble(
        path,
        foreign_document(path.stem, cameras.values()),
        overrides,
        _images(path, views, image_ids, poses, mirror),
        _points(path, tie_points, [names[key] for key in control_points], mirror),
        Columns(
            {
                "image": [image_ids[view] for view, *_ in (*rays, *control_rays)],
                "point": [
                    *(str(key) for _, key, _ in rays),
                    *(names[key] for _, key, _ in control_rays),
                ],
                **dict(zip("xy", _image_points(path, (*rays, *control_rays)).T)),
            },
            Source(str(path), None, "observation"),
        ),
        (
            *_describe_unread(views, skipped_views, empty_views, mirror is MIRROR),
            *unknown.messages(),
        ),
    )
    if not control_points or not len(network.points):
        return network
    location_of = lambda k: (f"{path}, control_points[{k}]", "X")
    X = stack_rows(list(control_points.values()), 3, location_of) * mirror
    no_sigma = np.full((len(control_points), 3), np.nan)
    source = Source(str(path), None, "control point")
    table = Points(tuple(names.values()), ("control",) * len(control_points), X, no_sigma, source)
    return with_control(network, table, datum=not choose_datum(overrides))


def _check_keys(scene: JsonFields, unknown: UnknownKeys) -> None:
    """Notice what the reader does not know.

    **Raises:** `InputError` for what may change the geometry."""
    unknown.check(scene.document, SCENE_KEYS, scene.path)
    for name, keys in (("views", VIEW_KEYS), ("intrinsics", INTRINSIC_KEYS)):
        for value in _entries(scene, name).values():
            data = _pointer_fields(value)
            unknown.check(data.document, keys, data.path)
    for pose in _entries(scene, "extrinsics").values():
        unknown.check(pose.document, POSE_KEYS, pose.path)
    # Millions of points and image points: plain dictionaries, looked at once.
    for name in ("structure", "control_points"):
        for value in _plain_values(scene.get(name)):
            unknown.check(value, POINT_KEYS, f"{scene.path}, {name}")
            for ray in _plain_values(value.get("observations")):
                unknown.check(ray, RAY_KEYS, f"{scene.path}, {name}, observations")


def _plain_values(rows: Any) -> Iterator[dict[str, Any]]:
    """The values of rows of keys and values; what is none is reported by its reader."""
    for row in rows if isinstance(rows, list) else ():
        if isinstance(row, dict) and isinstance(row.get("value"), dict):
            yield row["value"]


def _describe_unread(
    views: Mapping[int, JsonFields],
    skipped_views: Sequence[str],
    empty_views: Sequence[str],
    mirrored: bool,
) -> list[str]:
    """Messages about what is not read, and about a mirrored scene."""
    messages = [
        f"left out {count(len(ids), 'view')} {reason}: {list_some(ids)}"
        for ids, reason in (
            (skipped_views, "of spherical cameras or without intrinsics"),
            (empty_views, "without pose and image points"),
        )
        if ids
    ]
    if any(view.get("use_pose_center_prior") for view in views.values()):
        messages.append("priors of projection centres (use_pose_center_prior) are not read")
    if mirrored:
        messages.append("the scene of spherical cameras is a mirror image: its Y is negated")
    return messages


def _entries(scene: JsonFields, name: str) -> dict[int, JsonFields]:
    """The values of a list of keys and values."""
    values: dict[int, JsonFields] = {}
    for row in scene.rows(name):
        key = row.integer("key")
        if key in values:
            raise InputError(f"{row.path}: key {key} occurs twice")
        values[key] = row.child("value")
    return values


def _pointer_fields(value: JsonFields) -> JsonFields:
    """The object of a pointer, with inherited fields."""
    data = value.child("ptr_wrapper.data")
    fields, inherited = {}, data.document
    while isinstance(inherited, dict):
        fields = {**inherited, **fields}
        inherited = inherited.get("value0")
    return JsonFields(data.path, fields)


def _cameras(scene: JsonFields) -> tuple[dict[int, dict[str, Any]], dict[int, JsonFields]]:
    """The entries of cameras by number, and the fields of spherical ones."""
    names: dict[int, str] = {}
    cameras, spherical = {}, {}
    for key, value in _entries(scene, "intrinsics").items():
        number = value.integer("polymorphic_id", DECLARED_CLASS)
        if value.get("polymorphic_name") is not None:
            names[number % NEW_NUMBER] = value.text("polymorphic_name")
        name = names.get(number % NEW_NUMBER, "")
        if name == SPHERICAL:
            spherical[key] = _pointer_fields(value)
            continue
        if name not in KINDS:
            raise InputError(
                f"{value.path}: the kind of camera is {name or 'not named'}; expected one of "
                f"{', '.join((*KINDS, SPHERICAL))}"
            )
        model, field, coefficients = KINDS[name]
        data = _pointer_fields(value)
        f, (cx, cy) = data.number("focal_length"), data.array("principal_point", (2,))
        values = data.array(field, (len(coefficients),)).tolist() if field else ()
        cameras[key] = {
            "id": str(key),
            "model": model,
            "tie": [["fx", "fy"]],
            "image_size": [data.integer("width", minimum=1), data.integer("height", minimum=1)],
            "fx": f,
            "fy": f,
            "cx": float(cx),
            "cy": float(cy),
            **dict(zip(coefficients, values)),
        }
    return cameras, spherical


def _spherical_camera(key: int, data: JsonFields) -> dict[str, Any]:
    """The entry of a spherical camera."""
    w, h = data.integer("width", minimum=1), data.integer("height", minimum=1)
    f = max(w, h) / (2 * np.pi)
    return {
        "id": str(key),
        "model": "equirectangular",
        "image_size": [w, h],
        "fx": f,
        "fy": f,
        "cx": w / 2,
        "cy": h / 2,
    }


def _views(
    scene: JsonFields, cameras: Mapping[int, dict], spherical: Mapping[int, JsonFields]
) -> tuple[dict[int, JsonFields], list[str]]:
    """The views with a camera, by number, and the names of the others."""
    views, skipped_views = {}, []
    for key, value in _entries(scene, "views").items():
        view = _pointer_fields(value)
        camera = view.integer("id_intrinsic", UNDEFINED_INDEX)
        if camera in cameras:
            views[key] = view
        elif camera in spherical or camera == UNDEFINED_INDEX:
            skipped_views.append(_view_name(view))
        else:
            raise InputError(f"{view.path}: id_intrinsic {camera} is not among the intrinsics")
    if not views:
        raise InputError(f"{scene.path}: no view has a camera that can be read")
    return views, skipped_views


def _view_name(view: JsonFields) -> str:
    return "/".join(filter(None, (view.get("local_path"), view.text("filename"))))


def _images(
    path: Path,
    views: Mapping[int, JsonFields],
    names: Mapping[int, str],
    poses: Mapping[int, JsonFields],
    mirror: Float[np.ndarray, "3"],
) -> Columns:
    R, X0 = (np.full((len(views), *shape), np.nan) for shape in ((3, 3), (3,)))
    for k, view in enumerate(views.values()):
        pose = poses.get(view.get("id_pose"))
        if pose is not None:
            R[k], X0[k] = pose.array("rotation", (3, 3)), pose.array("center", (3,))
            check_rotations(R[k], f"{pose.path}: rotation")
    cameras = [view.integer("id_intrinsic") for view in views.values()]
    source = Source(str(path), np.array(list(views)), "view")
    R = mirror[:, None] * R * mirror  # S·R·S and S·X0, S = diag(mirror): both frames are mirrored
    return image_columns(source, list(names.values()), cameras, flip_rows(R), X0 * mirror)


def _structure(
    scene: JsonFields, name: str, views: Mapping[int, JsonFields]
) -> tuple[dict[int, Any], list[tuple[int, int, Any]]]:
    """X of the points by number, and (view, point, x) of the image points."""
    points, rays = {}, []
    for key, value in _entries(scene, name).items():
        points[key] = value.get("X")
        for row in value.rows("observations"):
            view = row.integer("key")
            if view in views:
                rays.append((view, key, row.get("value.x")))
    return points, rays


def _image_points(path: Path, rays: Sequence[tuple[int, int, Any]]) -> Float[np.ndarray, "rays 2"]:
    def location_of(k: int) -> tuple[str, str]:
        return f"{path}, point {rays[k][1]}, view {rays[k][0]}", "x"

    return stack_rows([x for *_, x in rays], 2, location_of).reshape(-1, 2)


def _points(
    path: Path,
    tie_points: Mapping[int, Any],
    control: Sequence[str],
    mirror: Float[np.ndarray, "3"],
) -> Columns:
    location_of = lambda k: (f"{path}, structure[{k}]", "X")
    tie_positions = stack_rows(list(tie_points.values()), 3, location_of).reshape(-1, 3) * mirror
    position = np.concatenate([tie_positions, np.full((len(control), 3), np.nan)])
    columns = {"id": [*map(str, tie_points), *control], "role": ["tie"] * len(position)}
    return Columns(columns | dict(zip("XYZ", position.T)), Source(str(path), None, "point"))


def write_openmvg(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write a scene. Cameras must be of model `opencv` or `kannala-brandt`, with one principal
    distance, and have an image size; control and fixed points become `control_points`.

    **Returns:** messages about what the format cannot hold.
    """
    need_values(network)
    images, points, rays = network.images, network.points, network.observations
    R = flip_rows(matrices_of(images.angles))
    extrinsics = [
        _entry(i, {"rotation": R[i].tolist(), "center": images.position[i].tolist()})
        for i in range(len(images))
    ]
    point_observations: list[list[dict]] = [[] for _ in points.id]
    features = np.zeros(len(images), int)
    for i, p, xy in zip(rays.image.tolist(), rays.point.tolist(), rays.xy.tolist()):
        point_observations[p].append(_entry(i, {"id_feat": int(features[i]), "x": xy}))
        features[i] += 1
    is_control = points.has_role("control", "fixed")
    numbers = written_numbers(points.id)
    tables = [
        [
            _entry(
                numbers[p],
                {"X": points.position[p].tolist(), "observations": point_observations[p]},
            )
            for p in np.flatnonzero(mask).tolist()
        ]
        for mask in (~is_control, is_control)
    ]
    scene = {
        "sfm_data_version": "0.3",
        "root_path": "",
        "views": _view_entries(network),
        "intrinsics": _intrinsics(network.cameras, NEW_NUMBER + len(images) + 1),
        "extrinsics": extrinsics,
        "structure": tables[0],
        "control_points": tables[1],
    }
    write_text(Path(path), json.dumps(scene, indent=1) + "\n")
    return describe_losses(network, OPENMVG_LOSSES)


# What it loses; fixed points become control points.
OPENMVG_LOSSES = losing(
    "pixel sizes of cameras",
    "colours of points",
    partly={
        "names of cameras": lambda n: changed([c.id for c in n.cameras], range(len(n.cameras))),
        "roles of points": lambda n: int(n.points.has_role("fixed", "check").sum()),
        "names of points": lambda n: changed(n.points.id, written_numbers(n.points.id)),
    },
)


def _view_entries(network: Network) -> list[dict[str, Any]]:
    """The entries of the images; their pointers are numbered from 1."""
    entries = []
    for i, (id, c) in enumerate(zip(network.images.id, network.images.camera.tolist())):
        w, h = network.cameras[c].image_size or (0, 0)
        data = {"local_path": "", "filename": id, "width": w, "height": h}
        data |= {"id_view": i, "id_intrinsic": c, "id_pose": i}
        pointer = {"id": NEW_NUMBER + i + 1, "data": data}
        entries.append(_entry(i, {"polymorphic_id": DECLARED_CLASS, "ptr_wrapper": pointer}))
    return entries


def _entry(key: int, value: dict[str, Any]) -> dict[str, Any]:
    return {"key": key, "value": value}


def _intrinsics(cameras: Sequence[Camera], begin: int) -> list[dict[str, Any]]:
    """The entries of cameras, whose pointers are numbered from `begin`; only the first of a kind
    has its name."""
    entries, numbers = [], {}
    for k, camera in enumerate(cameras):
        name, data = _intrinsic(camera)
        kind = {"polymorphic_id": numbers.get(name, 0)}
        if name not in numbers:
            numbers[name] = len(numbers) + 1
            kind = {"polymorphic_id": NEW_NUMBER + numbers[name], "polymorphic_name": name}
        entries.append(_entry(k, kind | {"ptr_wrapper": {"id": begin + k, "data": data}}))
    return entries


def _intrinsic(camera: Camera) -> tuple[str, dict[str, Any]]:
    """The smallest kind that holds a camera, and its fields."""
    kinds = {n: (field, c) for n, (model, field, c) in KINDS.items() if model == camera.model}
    all_coefficients = max((c for _, c in kinds.values()), key=len, default=())
    p = check_others_zero(camera, "openMVG", all_coefficients)
    (w, h), f = size_of(camera, "openMVG"), one_focal_length(camera, "openMVG")
    name = next(
        n for n, (_, c) in kinds.items() if not any(p[k] for k in all_coefficients if k not in c)
    )
    field, names = kinds[name]
    data = {"width": w, "height": h, "focal_length": f, "principal_point": [p["cx"], p["cy"]]}
    return name, data | ({field: [p[k] for k in names]} if field else {})
