"""Cameras of programs for simultaneous localisation and mapping: camodocal, VINS, ORB-SLAM.

**camodocal, VINS**: `model_type`, `image_width`, `image_height`, and by model

    PINHOLE           projection_parameters fx fy cx cy, distortion_parameters k1 k2 p1 p2: `opencv`
    PINHOLE_FULL      the same with k1 … k6
    KANNALA_BRANDT    projection_parameters k2 … k5, mu mv u0 v0: `kannala-brandt` with k1 … k4
    MEI               mirror_parameters xi, distortion_parameters k1 k2 p1 p2,
                      projection_parameters gamma1 gamma2 u0 v0: `mei`
    SCARAMUZZA        poly_parameters p0 … p4, affine_parameters ac ad ae cx cy: `scaramuzza`

VINS's settings stand in the same file, or, of VINS-Fusion, in one that names the cameras' files
(`networks.vins`).

**ORB-SLAM 2 and 3, OpenVSLAM**: `Camera.fx`, …, or `Camera1.fx` and `Camera2.fx`; `Camera.type`
(`Camera.model`) PinHole, perspective, Rectified: k1 k2 p1 p2 k3 of `opencv`; KannalaBrandt8,
fisheye: k1 … k4 of `kannala-brandt`. A second camera makes a network (`networks.orb_slam`).

The first pixel has its centre at 0.

Source: camodocal, CameraFactory and its camera models; VINS-Mono, VINS-Fusion, ORB-SLAM 2 and 3,
OpenVSLAM: their example settings.
"""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import with_messages
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.yaml_text import parse_yaml
from jaxbundle.network.rules import check_camera
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import beginning

YAML = (".yaml", ".yml")


@dataclasses.dataclass(frozen=True)
class Lens:
    """A model of a program: ours, its parameters that must be there, those that are 0 if they are
    not; keys by parameter."""

    model: str
    required: Mapping[str, str]
    optional: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def keys(self) -> dict[str, str]:
        """All keys by parameter."""
        return {**self.required, **self.optional}


def _keys_of_section(section: str, **keys: str) -> dict[str, str]:
    return {name: f"{section}.{key}" for name, key in keys.items()}


def _names_in_section(section: str, names: str) -> dict[str, str]:
    return {name: f"{section}.{name}" for name in names.split()}


PROJECTION, DISTORTION, MIRROR = (
    "projection_parameters",
    "distortion_parameters",
    "mirror_parameters",
)
CAMODOCAL = {
    "PINHOLE": Lens(
        "opencv",
        _names_in_section(PROJECTION, "fx fy cx cy"),
        _names_in_section(DISTORTION, "k1 k2 p1 p2 k3"),
    ),
    "PINHOLE_FULL": Lens(
        "opencv",
        _names_in_section(PROJECTION, "fx fy cx cy"),
        _names_in_section(DISTORTION, "k1 k2 p1 p2 k3 k4 k5 k6"),
    ),
    "KANNALA_BRANDT": Lens(
        "kannala-brandt",
        _keys_of_section(
            PROJECTION, fx="mu", fy="mv", cx="u0", cy="v0", k1="k2", k2="k3", k3="k4", k4="k5"
        ),
    ),
    "MEI": Lens(
        "mei",
        {
            **_keys_of_section(MIRROR, xi="xi"),
            **_keys_of_section(PROJECTION, fx="gamma1", fy="gamma2", cx="u0", cy="v0"),
        },
        _names_in_section(DISTORTION, "k1 k2 p1 p2"),
    ),
}
SCARAMUZZA = "SCARAMUZZA"
POLYNOMIAL, INVERSE, AFFINE = "poly_parameters", "inv_poly_parameters", "affine_parameters"
AFFINE_KEYS = {"c": "ac", "d": "ad", "e": "ae", "cx": "cx", "cy": "cy"}
SETTINGS_OF_VINS = Keys(
    (),
    {
        **dict.fromkeys(
            ("*topic*", "output_path", "*folder*", "camera_name", "*path*", "support_file",
             "vocabulary_file", "brief_pattern_file", "config*", "*mask*"),
            "files and topics",
        ),
        **dict.fromkeys(
            ("max_*", "min_*", "freq", "F_threshold", "show_*", "equalize", "fisheye",
             "keyframe_parallax", "flow_back", "use_gpu*", "multiple_thread", "visual*", "save_*",
             "skip_*", "pub_*", "fast_relocalization", "loop_closure", "load_previous*",
             "pose_graph*", "publish_*", "is_fisheye", "debug*", "queue*", "visualize*", "ransac*",
             "freq_*", "image_queue*"),
            "settings of its tracker and solver",
        ),
        **dict.fromkeys(
            ("imu", "imu_*", "acc_*", "gyr_*", "g_norm", "td", "estimate_td", "rolling_shutter*",
             "estimate_extrinsic", "num_of_cam", "ex_calib*", "extrinsicRotation",
             "extrinsicTranslation", "camera_lidar*", "lidar*"),
            "the IMU: a camera's image does not depend on it",
        ),
    },
)  # fmt: skip
SIZE = ("image_width", "image_height")
CAMODOCAL_KEYS = SETTINGS_OF_VINS | Keys(("model_type", *SIZE, PROJECTION, DISTORTION, MIRROR))

CORE, RADTAN, EQUI = "fx fy cx cy", "k1 k2 p1 p2 k3 k4 k5 k6", "k1 k2 k3 k4"
# Our model and coefficients by `Camera.type`, without separators.
ORB_SLAM = {
    **dict.fromkeys(("pinhole", "perspective"), ("opencv", RADTAN)),
    **dict.fromkeys(("rectified",), ("opencv", "")),
    **dict.fromkeys(("kannalabrandt8", "kannalabrandt", "fisheye"), ("kannala-brandt", EQUI)),
}
ARRANGEMENTS = ("monocular", "stereo", "rgbd", "rgb-d")
PREFIXES = ("Camera", "Camera1")
ORB_KEYS = Keys(
    (
        *("Camera.type", "Camera.model", "Camera.width", "Camera.height", "Camera.cols"),
        *("Camera.rows", "Camera.bFishEye", "Stereo.T_c1_c2", "Tlr"),
    ),
    {
        **dict.fromkeys(
            ("ORBextractor.*", "Viewer.*", "System.*", "File.version", "loopClosing", "Tracking.*",
             "Mapping.*", "UseMotionModel", "Feature.*", "PangolinViewer.*", "SocketPublisher.*",
             "KeyFrame*", "Initializer.*", "LoopDetector.*", "GraphOptimizer.*",
             "GlobalOptimizer.*", "Relocalizer.*", "Optimizer.*", "Preprocessing.*",
             "MarkerModel.*"),
            "settings of the program",
        ),
        **dict.fromkeys(
            ("Camera.name", "Camera.setup", "Camera.fps", "Camera.RGB", "Camera.color*",
             "Camera.setup_type", "Camera.color_order"),
            "names and colours",
        ),
        **dict.fromkeys(
            ("Camera.bf", "ThDepth", "Stereo.ThDepth", "Stereo.b", "DepthMapFactor", "RGBD.*",
             "depth_threshold", "Camera.focal_x_baseline", "Camera.depth_threshold",
             "depthmap_factor"),
            "depth images and rectified pairs",
        ),
        **dict.fromkeys(
            ("IMU.*", "Tbc", "InsertKFsWhenLost", "thFarPoints"), "the IMU",
        ),
        **dict.fromkeys(
            ("Camera.newWidth", "Camera.newHeight", "Camera.imageScale", "Camera.lapping*",
             "Camera*.overlapping*", "Camera2.lapping*"),
            "the program reduces its images itself; the numbers here are of the whole ones",
        ),
        **dict.fromkeys(
            ("LEFT.*", "RIGHT.*"), "the cameras of the images before rectification; warned of",
        ),
    },
)  # fmt: skip
_CAMODOCAL_HEAD = re.compile(rb"(?m)^\s*model_type\s*:\s*[\"']?(\w+)")
_ORB_HEAD = re.compile(rb"(?m)^\s*[\"']?Camera1?\.fx[\"']?\s*:")


def is_slam_yaml(path: Path) -> bool:
    """Whether a YAML file has cameras of one of these programs."""
    head = beginning(path, 1_000_000) if path.suffix.lower() in YAML else b""
    model = _CAMODOCAL_HEAD.search(head)
    return (model is not None and b"_parameters" in head) or _ORB_HEAD.search(head) is not None


def read_slam_yaml(path: str | Path) -> Camera:
    """The camera of a file of camodocal, VINS or ORB-SLAM; of two the first.

    **Raises:** `InputError` naming the entry.
    """
    path = Path(path)
    fields = read_yaml_fields(path)
    if fields.get("model_type") is not None:
        return camodocal_camera(path, fields)
    unknown = UnknownKeys()
    return with_messages(orb_cameras(path, fields, unknown)[0], *unknown.messages())


def camodocal_camera(path: Path, fields: JsonFields) -> Camera:
    """The camera of camodocal; its id is `camera_name`, or the name of the file."""
    kind = fields.text("model_type").upper()
    if kind == SCARAMUZZA:
        return _scaramuzza(path, fields)
    if kind not in CAMODOCAL:
        raise InputError(
            f"{path}: model_type is {kind}, a camera of camodocal; expected one of "
            f"{', '.join((*CAMODOCAL, SCARAMUZZA))}"
        )
    lens, unknown = CAMODOCAL[kind], UnknownKeys()
    unknown.check(fields.document, CAMODOCAL_KEYS, path)
    for section in (PROJECTION, DISTORTION, MIRROR):
        if fields.get(section) is not None:
            section_keys = [key.partition(".")[2] for key in lens.keys.values() if section in key]
            unknown.check(fields.child(section).document, Keys(section_keys), f"{path}, {section}")
    parameters = {name: fields.number(key) for name, key in lens.required.items()}
    parameters |= {name: fields.number(key, 0.0) for name, key in lens.optional.items()}
    return _named_camera(path, fields, lens.model, parameters, unknown)


def _named_camera(
    path: Path,
    fields: JsonFields,
    model: str,
    parameters: Mapping[str, float],
    unknown: UnknownKeys,
) -> Camera:
    name = fields.get("camera_name")
    id = str(name) if name not in (None, "", "camera") else path.stem
    camera = Camera(id, model, parameters, image_size=_image_size(fields, *SIZE))
    check_camera(camera, f"{path}, ")
    return with_messages(camera, *unknown.messages())


def _scaramuzza(path: Path, fields: JsonFields) -> Camera:
    """`scaramuzza`, whose polynomial has the other sign, the axis forward."""
    unknown = UnknownKeys()
    unknown.check(fields.document, CAMODOCAL_KEYS | Keys((POLYNOMIAL, INVERSE, AFFINE)), path)
    a = [fields.number(f"{POLYNOMIAL}.p{i}") for i in range(5)]
    unknown.check(
        fields.child(POLYNOMIAL).document,
        Keys(f"p{i}" for i in range(5)),
        f"{path}, {POLYNOMIAL}",
    )
    unknown.check(fields.child(AFFINE).document, Keys(AFFINE_KEYS.values()), f"{path}, {AFFINE}")
    if a[1]:
        raise InputError(
            f"{path}: {POLYNOMIAL}.p1 is {a[1]:g}; expected 0: rays have no cusp on the axis"
        )
    parameters = {f"a{i}": -a[i] for i in (0, 2, 3, 4)}
    parameters |= {name: fields.number(f"{AFFINE}.{key}") for name, key in AFFINE_KEYS.items()}
    return _named_camera(path, fields, "scaramuzza", parameters, unknown)


def orb_cameras(path: Path, fields: JsonFields, unknown: UnknownKeys) -> list[Camera]:
    """One camera of ORB-SLAM or two."""
    document = fields.document
    stated_types = [str(document[k]) for k in ("Camera.type", "Camera.model") if document.get(k)]
    # Some files have the arrangement of the cameras as their type, and the lens as their model.
    lenses = [text for text in stated_types if text.lower() not in ARRANGEMENTS]
    text = next(iter(lenses or stated_types), "")
    kind = re.sub(r"[\W_]+", "", text).lower() or "pinhole"
    if document.get("Camera.bFishEye") and ORB_SLAM.get(kind, ("",))[0] != "kannala-brandt":
        raise InputError(f"{path}: Camera.bFishEye of ORB-SLAM without Camera.type KannalaBrandt8")
    if kind not in ORB_SLAM:
        raise InputError(
            f"{path}: Camera.type is {text}, of ORB-SLAM; expected PinHole, Rectified or "
            "KannalaBrandt8"
        )
    model, names = ORB_SLAM[kind]
    prefixes = [p for p in (*PREFIXES, "Camera2") if f"{p}.fx" in document]
    if not prefixes:  # within another object
        raise InputError(f"{path}: Camera.fx is missing at the first level; it is expected there")
    if "Camera" in prefixes and "Camera1" in prefixes:
        raise InputError(f"{path}: Camera.fx and Camera1.fx; expected one of them")
    camera_keys = [f"{p}.{name}" for p in prefixes for name in f"{CORE} {names}".split()]
    unknown.check(document, ORB_KEYS | Keys(camera_keys), path)
    # A dot leads into an object; these keys have dots themselves.
    raw = JsonFields(path, {key.replace(".", " "): value for key, value in document.items()})
    sides = [("Camera width", "Camera height"), ("Camera cols", "Camera rows")]
    size = next((s for w, h in sides if (s := _image_size(raw, w, h))), None)
    cameras = []
    for prefix in prefixes:
        parameters = {name: raw.number(f"{prefix} {name}") for name in CORE.split()}
        parameters |= {name: raw.number(f"{prefix} {name}", 0.0) for name in names.split()}
        id = path.stem if len(prefixes) == 1 else prefix
        camera = Camera(id, model, parameters, image_size=size)
        check_camera(camera, f"{path}, ")
        if any(key.startswith(("LEFT.", "RIGHT.")) for key in document):
            camera = with_messages(
                camera,
                f"{path}: {prefix}.fx … are of the rectified images; LEFT and RIGHT, the cameras "
                "before rectification, are not read",
            )
        cameras.append(camera)
    return cameras


def _image_size(fields: JsonFields, width: str, height: str) -> tuple[int, int] | None:
    if fields.get(width) is None and fields.get(height) is None:
        return None
    return fields.integer(width, minimum=1), fields.integer(height, minimum=1)


def read_yaml_fields(path: Path) -> JsonFields:
    """The entries of a YAML file as fields."""
    return JsonFields(path, parse_yaml(path, read_text(path)))
