"""Cameras of nerfstudio and instant-ngp: `transforms.json`.

    camera_model      OPENCV, PINHOLE, SIMPLE_PINHOLE, OPENCV_FISHEYE; OPENCV without it
    fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2       of all frames, or of each; or camera_angle_x,
                                                camera_angle_y, angles of view in radians
    frames            file_path, transform_matrix

The transform is camera → world, 4 × 4, x right, y up, the camera looks along −z, as here: M = Rᵀ,
X0 = its last column. Pixels count from the corner of the first one: cx = cx_file − ½. fl_y is
fl_x, and cx, cy the image centre if not given. k4 of OPENCV is the coefficient of r⁸, which our
model does not have: if it is not 0 the nearest camera is fitted. `is_fisheye` of instant-ngp is
OPENCV_FISHEYE. The point cloud (`ply_file_path`), masks and depths are not read. Coordinates are
those of the file: earlier transformations (`applied_transform`, `scale`, `offset`) are not
undone. Without fl_y and camera_angle_y pixels are square.

Source: nerfstudio documentation, "Data conventions"; instant-ngp, "Tips for training NeRF models".
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import Foreign, NoPlaceError, fit_camera, fit_messages
from jaxbundle.io.networks.assemble import (
    PIXEL_CENTRE,
    assemble,
    entry_of,
    foreign_document,
    image_columns,
)
from jaxbundle.io.networks.losses import (
    check_others_zero,
    describe_losses,
    losing,
    need_values,
    size_of,
)
from jaxbundle.io.networks.poses import check_rotations, matrices_of
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.json_fields import JsonFields, read_object
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Camera, Network, Source
from jaxbundle.system.file_content import beginning

MODELS = {
    "OPENCV": ("opencv", ("k1", "k2", "k3", "p1", "p2")),
    "PINHOLE": ("opencv", ()),
    "SIMPLE_PINHOLE": ("opencv", ()),
    "OPENCV_FISHEYE": ("kannala-brandt", ("k1", "k2", "k3", "k4")),
}
INTRINSICS = (
    *("camera_model", "is_fisheye", "camera_angle_x", "camera_angle_y", "fl_x", "fl_y"),
    *("cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2"),
)
# As dense_depth_priors_nerf has them.
OTHER_NAMES = {"fl_x": "fx", "fl_y": "fy"}
# By what the focal length of an axis is given.
FOCAL = ("fl", "camera_angle")
TRAINING = "how a field is trained and displayed"
KEYS = Keys(
    ("frames", *INTRINSICS, *OTHER_NAMES.values()),
    {
        **dict.fromkeys(
            ("aabb_scale", "aabb", "render_aabb*", "up", "n_frames", "sharpness*", "white_*",
             "black_*", "bg_color*", "envmap", "from_na", "from_mitsuba", "enable_depth_loading",
             "integer_depth_scale", "depth_scal*", "depth_unit_scale_factor", "near", "far",
             "*_filenames", "centroid", "avglen", "totw", "hdr", "sun_*", "time*", "fps",
             "num_frames", "wave*",
             "background*", "bounding_box*", "scene_box", "comment*", "version", "crop_box*"),
            TRAINING,
        ),
        **dict.fromkeys(("ply_file_path", "orientation_override", "auto_scale_poses_override"),
                        "the point cloud, and what nerfstudio does with the frames"),
    },
    {
        **dict.fromkeys(
            ("applied_transform", "applied_scale", "scale", "offset", "applied_offset"),
            "coordinates are those of the file",
        ),
        "rolling_shutter": "one pose a frame is read",
    },
)  # fmt: skip
# `rotation` is the step of Blender's turntable, in `transforms_train.json`.
FRAME_KEYS = Keys(
    ("file_path", "transform_matrix", *INTRINSICS, *OTHER_NAMES.values()),
    dict.fromkeys(
        ("sharpness", "mask_path", "depth_file_path", "*_path", "colmap_im_id", "colmap_id",
         "rotation", "time*", "timestamp*", "bg_color", "split", "light*", "exposure*", "*_id",
         "id", "near", "far", "frame*", "name", "image_name", "motion_mask*", "depth_scale", "hdr"),
        TRAINING,
    ),
    {"rolling_shutter": "one pose a frame is read",
     "transform_matrix_start": "one pose a frame is read",
     "transform_matrix_end": "one pose a frame is read"},
)  # fmt: skip


def is_transforms(path: Path) -> bool:
    """Whether a JSON file has frames with transforms."""
    head = beginning(path, 100_000) if path.suffix.lower() == ".json" else b""
    return b'"transform_matrix"' in head and b'"frames"' in head


def read_transforms(
    path: str | Path,
    overrides: Sequence[str] = (),
    *,
    image_size: Sequence[float] | None = None,
) -> Network:
    """The cameras and images of a file; frames with the same intrinsics share a camera.

    Nothing can be adjusted: there are no image points. `image_size`: of cameras without w and h.

    **Raises:** `InputError` naming file, frame and field.
    """
    path = Path(path)
    file = JsonFields(path, read_object(path, read_text(path), "transforms"))
    unknown = UnknownKeys()
    unknown.check(file.document, KEYS, path)
    if image_size is not None and file.get("w") is None and file.get("h") is None:
        file.document |= dict(zip("wh", image_size))
    cameras: dict[str, Camera] = {}
    names, camera_ids, M, X0, omitted_frames = [], [], [], [], []
    camera_error = None
    for frame in file.rows("frames"):
        unknown.check(frame.document, FRAME_KEYS, frame.path)
        name, fields = frame.text("file_path"), _intrinsics(file, frame)
        # Frames may repeat the intrinsics, in any order of the keys.
        key = json.dumps(fields.document, sort_keys=True)
        try:
            if key not in cameras:
                cameras[key] = _camera(str(len(cameras) + 1), fields)
        except NoPlaceError as error:
            camera_error, omitted_frames = error, [*omitted_frames, name]
            continue
        T = frame.array("transform_matrix", (None, 4))
        if len(T) not in (3, 4):
            raise InputError(f"{frame.path}: transform_matrix has {len(T)} rows; expected 4")
        check_rotations(T[:3, :3], f"{frame.path}: transform_matrix")
        names.append(name)
        camera_ids.append(cameras[key].id)
        # The file has camera → world, M world → camera.
        M.append(T[:3, :3].T)
        X0.append(T[:3, 3])
    if not names:
        raise camera_error or InputError(f"{path}: there are no frames")
    repeated_name = next((name for name in names if names.count(name) > 1), None)
    if repeated_name:
        raise InputError(f"{path}: two frames have the file_path {repeated_name!r}")
    messages = (
        [
            f"{camera_error}; left out {count(len(omitted_frames), 'frame')}: "
            f"{list_some(omitted_frames)}"
        ]
        if omitted_frames
        else []
    )
    messages += unknown.messages()
    images = image_columns(
        Source(str(path), None, "frame"), names, camera_ids, np.array(M), np.array(X0)
    )
    document = foreign_document(path.stem, map(entry_of, cameras.values()))
    return assemble(
        path, document, overrides, images, warnings=(*messages, *fit_messages(cameras.values()))
    )


def _intrinsics(file: JsonFields, frame: JsonFields) -> JsonFields:
    """The camera fields of a frame, missing ones from the file."""
    has_own = any(name in frame.document for name in (*INTRINSICS, *OTHER_NAMES.values()))
    values = {}
    for source in (file, frame):  # the frame's own replace those of the file
        for name in INTRINSICS:
            spellings = [
                k for k in (name, OTHER_NAMES.get(name, name)) if source.get(k) is not None
            ]
            if len({str(source.get(k)) for k in spellings}) > 1:
                raise InputError(f"{source.path}: {' and '.join(spellings)} differ; expected one")
            if spellings:
                values[name] = source.get(spellings[0])
    return JsonFields(frame.path if has_own else file.path, values)


def _camera(id: str, fields: JsonFields) -> Camera:
    fisheye = "OPENCV_FISHEYE" if fields.get("is_fisheye") is True else "OPENCV"
    kind = fields.text("camera_model", fisheye)
    if kind not in MODELS:
        raise NoPlaceError(
            f"{fields.path}: cameras of camera_model {kind} are not offered here; these are: "
            f"{', '.join(MODELS)}"
        )
    model, names = MODELS[kind]
    size = None
    if fields.get("w") is not None or fields.get("h") is not None:
        size = fields.integer("w", minimum=1), fields.integer("h", minimum=1)
    # Either axis may be the one that is given.
    first_axis, other_axis = "xy" if any(fields.get(f"{n}_x") is not None for n in FOCAL) else "yx"
    side = dict(zip("xy", size or (None, None)))
    f = {first_axis: _focal_length(fields, first_axis, side[first_axis], None)}
    f[other_axis] = _focal_length(fields, other_axis, side[other_axis], f[first_axis])
    fx, fy = f["x"], f["y"]
    c = [_principal_point(fields, axis, side[axis]) - PIXEL_CENTRE for axis in "xy"]
    core: dict[str, float] = dict(zip(("fx", "fy", "cx", "cy"), (fx, fy, *c)))
    coefficients = {name: fields.number(name, 0.0) for name in names}
    k4 = fields.number("k4", 0.0) if kind == "OPENCV" else 0.0
    if k4 == 0:
        tie = (("fx", "fy"),) if fields.get(f"fl_{other_axis}") is None and fx == fy else ()
        return Camera(id, model, core | coefficients, image_size=size, tie=tie)
    if size is None:
        raise InputError(f"{fields.path}: w is missing; k4 is not 0: a fit needs the image size")
    start = core | coefficients
    foreign = Foreign(polynomial, start | {"k4": k4}, start, size)
    return fit_camera(id, foreign, str(fields.path), f"has k4 {k4:g}")


def _focal_length(
    fields: JsonFields, axis: str, size: int | None, other_length: float | None
) -> float:
    """Focal length along an axis: given, from the angle of view, or that of the other axis."""
    if fields.get(f"fl_{axis}") is None and fields.get(f"camera_angle_{axis}") is not None:
        if size is None:
            raise InputError(
                f"{fields.path}: w and h are missing, which camera_angle_{axis} needs; expected "
                "them in the file, or --image-size W,H (convert, camera)"
            )
        return size / 2 / np.tan(fields.number(f"camera_angle_{axis}") / 2)
    if other_length is None and fields.get(f"fl_{axis}") is None:
        raise InputError(
            f"{fields.path}: fl_x and camera_angle_x are missing; expected one of them, or fl_y, "
            "camera_angle_y"
        )
    return fields.number(f"fl_{axis}", other_length)


def _principal_point(fields: JsonFields, axis: str, size: int | None) -> float:
    """A coordinate of the principal point: given, or the middle of the image."""
    if fields.get(f"c{axis}") is None and size is None:
        raise InputError(
            f"{fields.path}: c{axis} is missing, and w and h, whose half it is otherwise; expected "
            "them in the file, or --image-size W,H (convert, camera)"
        )
    return fields.number(f"c{axis}", None if size is None else size / 2)


def polynomial(p: Mapping[str, Scalar], X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """The distortion of OPENCV with k4."""
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = 1 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * (p["k3"] + r2 * p["k4"])))
    xd = x * radial + 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * x * x)
    yd = y * radial + 2 * p["p2"] * x * y + p["p1"] * (r2 + 2 * y * y)
    return jnp.stack([p["fx"] * xd + p["cx"], p["fy"] * yd + p["cy"]])


def write_transforms(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write the cameras and images of a network; intrinsics of a single camera are given once.

    Cameras must be of model `opencv` or `kannala-brandt` and have an image size.

    **Returns:** messages about what the format cannot hold.
    """
    need_values(network, points=False)
    images, single = network.images, len(network.cameras) == 1
    fields = [_fields(camera) for camera in network.cameras]
    T = np.tile(np.eye(4), (len(images), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = matrices_of(images.angles).transpose(0, 2, 1), images.position
    frames = [
        {"file_path": id, "transform_matrix": t, **({} if single else fields[c])}
        for id, t, c in zip(images.id, T.tolist(), images.camera.tolist())
    ]
    document = (fields[0] if single else {}) | {"frames": frames}
    write_text(Path(path), json.dumps(document, indent=1) + "\n")
    return describe_losses(network, TRANSFORMS_LOSSES)


# What it loses.
TRANSFORMS_LOSSES = losing("names of cameras", "pixel sizes of cameras", "points")


def _fields(camera: Camera) -> dict[str, Any]:
    fisheye = camera.model == "kannala-brandt"
    kind = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    names = MODELS[kind][1]
    p = check_others_zero(camera, "nerfstudio", names)
    w, h = size_of(camera, "nerfstudio")
    fields = {"camera_model": kind, "w": w, "h": h, "fl_x": p["fx"], "fl_y": p["fy"]}
    fields |= {"cx": p["cx"] + PIXEL_CENTRE, "cy": p["cy"] + PIXEL_CENTRE}
    return fields | {name: p[name] for name in names}
