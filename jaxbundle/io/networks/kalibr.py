"""Camera chains of Kalibr: `camchain.yaml`.

    cam0:
      camera_model: pinhole           pinhole, omni, eucm, ds
      intrinsics: [fu, fv, pu, pv]    omni: ξ before; eucm: α, β; ds: ξ, α
      distortion_model: radtan        radtan, equi (equidistant), fov, none
      distortion_coeffs: [k1, k2, p1, p2]    equi: k1 … k4; fov: ω
      resolution: [w, h]
      rostopic: /cam0/image_raw
    cam1:
      T_cn_cnm1:                      4 × 4, from the frame of cam0 to that of cam1
      …

    pinhole     radtan, none `opencv`; equi `kannala-brandt`; fov `fov`
    omni        radtan, none `mei`
    eucm, ds    none `eucm`, `double-sphere`

Camera frames have x right, y down, z forward; the centre of the first pixel is (0, 0). A chain
becomes one image per camera, taken at one moment by a rig: the first at the origin, looking
along Z with Y down. Without T_cn_cnm1 the poses follow from those in the body (T_cam_imu, or
T_imu_cam as of OpenVINS, …). A camera with none of them has no orientation, and is not in the rig.
A camera with more coefficients than radtan is fitted, with the difference in a message.
The written mounting is that of the first moment with an image of every camera, or of the
images if each camera has one. Time shifts are not read.

Source: Kalibr's wiki, "yaml formats", "Supported models".
"""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert import convert_camera
from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import cv_pose
from jaxbundle.io.networks.assemble import all_parameters, rig_network
from jaxbundle.io.networks.losses import (
    QUANTITIES,
    Losses,
    changed,
    describe_losses,
    losing,
    mountings_in_metres,
    need_values,
    size_of,
)
from jaxbundle.io.networks.poses import check_rotations, matrices_of
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.rows import join_numbers
from jaxbundle.io.text.yaml_text import parse_yaml
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning

CORE = ("fx", "fy", "cx", "cy")
RADTAN = ("k1", "k2", "p1", "p2")
EQUI = ("k1", "k2", "k3", "k4")
# Our model, intrinsics and coefficients; the first of a model is written.
MODELS: dict[tuple[str, str], tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    ("pinhole", "radtan"): ("opencv", CORE, RADTAN),
    ("pinhole", "equi"): ("kannala-brandt", CORE, EQUI),
    ("pinhole", "fov"): ("fov", CORE, ("omega",)),
    ("pinhole", "none"): ("opencv", CORE, ()),
    ("omni", "radtan"): ("mei", ("xi", *CORE), RADTAN),
    ("omni", "none"): ("mei", ("xi", *CORE), ()),
    ("eucm", "none"): ("eucm", ("alpha", "beta", *CORE), ()),
    ("ds", "none"): ("double-sphere", ("xi", "alpha", *CORE), ()),
}
# Names in files of other programs.
DISTORTION_NAMES = {
    **dict.fromkeys(("equidistant", "equidist"), "equi"),
    **dict.fromkeys(("radial-tangential",), "radtan"),
}
COEFFICIENT_KEYS = ("distortion_coeffs", "distortion_coefficients")
# Also those of chains that others write, with OpenCV's coefficients.
READ_MODELS = MODELS | {
    ("pinhole", "plumb_bob"): ("opencv", CORE, (*RADTAN, "k3")),
    ("pinhole", "rational_polynomial"): ("opencv", CORE, (*RADTAN, "k3", "k4", "k5", "k6")),
}
CAMERA_KEY = re.compile(r"cam\d+")
# Names of the transformation between body (IMU) and camera, and its direction.
BODY = {
    **dict.fromkeys(("T_cam_imu", "T_C_B", "T_cam_body", "T_C_I"), "to camera"),
    **dict.fromkeys(("T_imu_cam", "T_B_C", "T_BS", "T_body_cam", "T_I_C"), "from camera"),
}
# Of a camera.
KEYS = Keys(
    (
        *("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution"),
        *("distortion_coefficients", "T_cn_cnm1", *BODY),
    ),
    {
        "cam_overlaps": "which cameras see the same, a setting of the calibration",
        "rostopic": "where the images come from",
        "timeshift_cam_imu": "time between camera and IMU, not of the images",
        "label": "a name beside cam0",
        "rate_hz": "how often it takes images",
    },
)
# Beside the cameras.
FILE = Keys((), {"imu*": "an IMU has no images", "T_imu_body": "where the IMU is in the body"})
OFFERED_MODELS = tuple(dict.fromkeys(model for model, *_ in MODELS.values()))


def is_kalibr(path: Path) -> bool:
    """Whether a YAML file has cameras `cam0`, … with a `camera_model`."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        return False
    head = beginning(path, 100_000)
    chain = b"camera_model" in head or b"T_cn_cnm1" in head
    return re.search(rb"^cam\d+\s*:", head, re.M) is not None and chain


def read_kalibr(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of a chain, each with an image; nothing can be adjusted.

    **Raises:** `InputError` naming file, camera and key.
    """
    path = Path(path)
    unknown = UnknownKeys()
    document = parse_yaml(path, read_text(path))
    unknown.check((key for key in document if not CAMERA_KEY.fullmatch(key)), FILE, path)
    chain = {
        id: JsonFields(f"{path}, {id}", document[id])
        for id in sorted(filter(CAMERA_KEY.fullmatch, document), key=camera_number)
        if isinstance(document[id], dict)
    }
    if not chain:
        raise InputError(f"{path}: there is no camera cam0")
    for fields in chain.values():
        unknown.check(fields.document, KEYS, fields.path)
    cameras = [_camera(id, fields) for id, fields in chain.items()]
    poses, messages = _poses(list(chain.values()))
    return rig_network(
        path,
        cameras,
        [*poses[:, :3, :3]],
        [*poses[:, :3, 3]],
        overrides,
        (*messages, *unknown.messages()),
    )


def _poses(chain: Sequence[JsonFields]) -> tuple[Float[np.ndarray, "cameras 4 4"], list[str]]:
    """From the frame of the first camera to that of each, NaN where the file does not tell; of a
    single camera from the body. Messages about what is not read."""
    body_poses = [_body_pose(fields) for fields in chain]
    poses = np.full((len(chain), 4, 4), np.nan)
    if len(chain) == 1:
        poses[0] = np.nan if body_poses[0] is None else body_poses[0]
        return poses, []
    poses[0] = np.eye(4)
    for k, fields in enumerate(chain[1:], 1):
        # A chain may be broken and go on through the body.
        if fields.get("T_cn_cnm1") is not None:
            poses[k] = _transform(fields, "T_cn_cnm1") @ poses[k - 1]
    for k, body_pose in enumerate(body_poses):
        candidates = (
            (other_body_pose, poses[j])
            for j, other_body_pose in enumerate(body_poses)
            if other_body_pose is not None and j != k and np.isfinite(poses[j]).all()
        )
        if body_pose is not None and np.isnan(poses[k]).any():
            for other_body_pose, other_pose in candidates:
                poses[k] = body_pose @ np.linalg.inv(other_body_pose) @ other_pose
                break
    for k, fields in enumerate(chain[1:], 1):
        if fields.get("T_cn_cnm1") is not None and np.isnan(poses[k]).any():
            poses[k] = _transform(fields, "T_cn_cnm1") @ poses[k - 1]
    unread = [
        key
        for key in (*BODY, "timeshift_cam_imu")
        if any(fields.get(key) is not None for fields in chain)
    ]
    messages = [
        f"{chain[0].path}: the frame is that of the first camera; not kept: {', '.join(unread)}"
    ]
    return poses, messages if unread else []


def _body_pose(fields: JsonFields) -> Float[np.ndarray, "4 4"] | None:
    """From the frame of the body to that of the camera."""
    key = next((key for key in BODY if fields.get(key) is not None), None)
    if key is None:
        return None
    T = _transform(fields, key)
    return T if BODY[key] == "to camera" else np.linalg.inv(T)


def _transform(fields: JsonFields, key: str) -> Float[np.ndarray, "4 4"]:
    value = fields.get(key)
    if isinstance(value, dict):
        # Rows, cols, data, as in EuRoC's files.
        value = JsonFields(f"{fields.path}: {key}", value).array("data", (16,)).reshape(4, 4)
        value = value.tolist()
    T = JsonFields(fields.path, {key: value}).array(key, (4, 4))
    check_rotations(T[:3, :3], f"{fields.path}: {key}")
    return T


def camera_number(id: str) -> int:
    """The number of cam10, which comes after cam9; −1 of another name."""
    digits = id.removeprefix("cam")
    return int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 9 else -1


def _camera(id: str, fields: JsonFields) -> Camera:
    kind = fields.text("camera_model", "pinhole"), fields.text("distortion_model", "none").lower()
    kind = kind[0], DISTORTION_NAMES.get(kind[1], kind[1])
    if kind not in READ_MODELS:
        choices = ", ".join("-".join(names) for names in READ_MODELS)
        raise InputError(
            f"{fields.path}: camera_model {kind[0]} with distortion_model {kind[1]}; expected one "
            f"of {choices}"
        )
    model, core, coefficients = READ_MODELS[kind]
    values = fields.array("intrinsics", (len(core),))
    coefficient_key = next(
        (k for k in COEFFICIENT_KEYS if fields.get(k) is not None), COEFFICIENT_KEYS[0]
    )
    coefficient_values = fields.array(coefficient_key, (len(coefficients),)) if coefficients else ()
    if not coefficients and np.any(fields.get(coefficient_key) or 0):
        raise InputError(
            f"{fields.path}: {coefficient_key} of distortion_model none; expected none"
        )
    w, h = fields.array("resolution", (2,))
    size = JsonFields(f"{fields.path}: resolution", {"w": w, "h": h})
    parameters = dict(zip((*core, *coefficients), map(float, (*values, *coefficient_values))))
    return Camera(
        id,
        model,
        parameters,
        image_size=(size.integer("w", minimum=1), size.integer("h", minimum=1)),
    )


def write_kalibr(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write the cameras of a network, named cam0, cam1, …, with the mountings of a rig, in metres.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` for a camera without a model in Kalibr, or without image size.
    """
    network, losses = mountings_in_metres(network, "kalibr")
    mountings, lines = mountings_of(network), []
    if mountings is None and len(network.cameras) > 1:
        losses.append("mountings of the cameras")
    for k, original in enumerate(network.cameras):
        camera, fit_losses = _fit_radtan_or_equi(original)
        losses += fit_losses
        lines += [f"cam{k}:", *(f"  {line}" for line in _camera_lines(camera, k))]
        if mountings is not None and k:
            lines += [
                "  T_cn_cnm1:",
                *(f"  - [{join_numbers(row, ', ')}]" for row in mountings[k - 1]),
            ]
    write_text(Path(path), "\n".join(lines) + "\n")
    return (*describe_losses(network, KALIBR_LOSSES), *losses)


def _fit_radtan_or_equi(camera: Camera) -> tuple[Camera, list[str]]:
    """A camera with more coefficients than Kalibr's radtan as the nearest radtan or equi, and the
    difference in words."""
    p = all_parameters(camera)
    extra_names = [name for name, value in p.items() if value and name not in (*CORE, *RADTAN)]
    if camera.model != "opencv" or not extra_names:
        return camera, []
    size, fits, reason = size_of(camera, "Kalibr"), [], ""
    for target, free_names in (("opencv", (*CORE, *RADTAN)), ("kannala-brandt", ())):
        try:
            fits.append(
                convert_camera(
                    get_model("opencv"), p, get_model(target), image_size=size, free=free_names
                )
            )
        except ValueError as error:
            reason = reason or str(error)
    if not fits:
        raise InputError(f"camera {camera.id!r}: Kalibr has no {', '.join(extra_names)}: {reason}")
    best = min(fits, key=lambda fit: fit.rms)
    message = (
        f"{', '.join(extra_names)} of camera {camera.id!r}, fitted as "
        f"{'radtan' if best.model == 'opencv' else 'equi'} over the image: largest difference "
        f"{best.largest:.3g} px, RMS {best.rms:.3g} px (none if the rig is calibrated without)"
    )
    fitted_camera = dataclasses.replace(camera, model=best.model, parameters=dict(best.parameters))
    return fitted_camera, [message]


def _camera_lines(camera: Camera, k: int) -> list[str]:
    """The entries of a camera, by the first model of Kalibr that holds it."""
    p, (w, h) = all_parameters(camera), size_of(camera, "Kalibr")
    for (kind, distortion), (model, core, coefficients) in MODELS.items():
        parameter_names = {*core, *coefficients}
        if model == camera.model and not any(p[name] for name in p if name not in parameter_names):
            values = join_numbers((p[name] for name in coefficients), ", ")
            return [
                f"camera_model: {kind}",
                f"intrinsics: [{join_numbers((p[name] for name in core), ', ')}]",
                f"distortion_model: {distortion}",
                f"distortion_coeffs: [{values}]",
                f"resolution: [{w}, {h}]",
                f"rostopic: /cam{k}/image_raw",
            ]
    parameter_sets = [names for model, *names in MODELS.values() if model == camera.model]
    if not parameter_sets:
        raise InputError(
            f"camera {camera.id!r}: Kalibr has no model {str(camera.model)!r}; convert it with "
            "--model opencv"
        )
    kalibr_names = {name for names in parameter_sets for part in names for name in part}
    excess = ", ".join(name for name, value in p.items() if value and name not in kalibr_names)
    raise InputError(f"camera {camera.id!r}: Kalibr has no {excess}; adjust the camera without")


def mountings_of(
    network: Network,
) -> Float[np.ndarray, "pairs 4 4"] | None:
    """T from the frame of each camera (x right, y down, z forward) to that of the next
    [cameras − 1, 4, 4]; None for a single camera, and without an image of every camera.

        x' = R'·X + t',  x = R·X + t   ⇒   x' = (R'·Rᵀ)·x + t' − (R'·Rᵀ)·t
    """
    images, number = network.images, len(network.cameras)
    if number == 1:
        return None
    moments: dict[object, list[int]] = {}
    for rigs in (kind for kind in network.further if isinstance(kind, Rigs)):
        row = {id: i for i, id in enumerate(images.id)}
        for rig, epoch, image in zip(rigs.rig, rigs.epoch, rigs.image):
            moments.setdefault((rig, epoch), []).append(row[image])
    # One image of every camera, as a file of cameras is read, is a moment too.
    if not moments and len(images) == number:
        moments = {0: list(range(number))}
    complete_moments = [
        rows
        for rows in moments.values()
        if len({*images.camera[rows].tolist()}) == number == len(rows)
    ]
    if not complete_moments or not np.isfinite(images.position[complete_moments[0]]).all():
        return None
    # Only the orientations that are written must be there.
    need_values(network.replace(images=images.take(np.array(complete_moments[0]))), points=False)
    rows = np.array(complete_moments[0])[np.argsort(images.camera[complete_moments[0]])]
    R, t = cv_pose(matrices_of(images.angles[rows]), images.position[rows])
    T = np.tile(np.eye(4), (number - 1, 1, 1))
    T[:, :3, :3] = R[1:] @ R[:-1].transpose(0, 2, 1)
    T[:, :3, 3] = t[1:] - np.einsum("nij,nj->ni", T[:, :3, :3], t[:-1])
    return T


def _lost_orientations(network: Network) -> int:
    """Images beyond one of each camera, all without mountings; the frame is that of the first."""
    if len(network.cameras) > 1 and mountings_of(network) is None:
        return QUANTITIES["orientations of images"](network)
    return len(network.images) - len(network.cameras)


def mounted_losses(names: Callable[[Network], Sequence[str]] | None = None) -> Losses:
    """The losses of a format of cameras and their mountings, whose images have the names of the
    cameras; `names`: other ones that cameras are given."""
    written_names = names or (lambda n: [camera.id for camera in n.cameras])
    return losing(
        "pixel sizes of cameras",
        "points",
        partly={
            "orientations of images": _lost_orientations,
            "rigs": lambda n: QUANTITIES["rigs"](n) if mountings_of(n) is None else 0,
            "names of images": lambda n: len({*n.images.id} - {*written_names(n)}),
            **(
                {"names of cameras": lambda n: changed([c.id for c in n.cameras], written_names(n))}
                if names
                else {}
            ),
        },
    )


# What it loses.
KALIBR_LOSSES = mounted_losses(lambda network: [f"cam{k}" for k in range(len(network.cameras))])
