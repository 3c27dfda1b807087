"""The keys of a project in the Open Photogrammetry Format, by the format of the file and the path
of the object.

Source: Open Photogrammetry Format Specification 1.0 (Pix4D), its schemas; glTF 2.0 (Khronos).
"""

from collections.abc import Mapping

from jaxbundle.io.text.known_keys import Keys

FORMAT = "application/opf-"
PROJECT = f"{FORMAT}project+json"
CALIBRATED, CAMERA_LIST = f"{FORMAT}calibrated-cameras+json", f"{FORMAT}camera-list+json"
INPUT_CAMERAS, FRAME = f"{FORMAT}input-cameras+json", f"{FORMAT}scene-reference-frame+json"
INPUT_POINTS = f"{FORMAT}input-control-points+json"
PROJECTED_POINTS = f"{FORMAT}projected-control-points+json"
TRACKS = "model/gltf+json"
MATCHES = "OPF_mesh_primitive_matches"

HEAD = ("format", "version")
VENDOR = {"extensions": "objects of a vendor", "ext*": "objects of a vendor"}
GLTF = {"name": "a label", "extras": "objects of a program", **VENDOR}

MARK = Keys(("camera_id", "position_px"), {"accuracy": "of a click, without a unit", **VENDOR})
POINT = Keys(
    ("id", "marks", "is_checkpoint"), {"geolocation": "given coordinates, projected", **VENDOR}
)

KEYS: Mapping[str, Mapping[str, Keys]] = {
    PROJECT: {
        "": Keys(
            (*HEAD, "items"),
            {
                **dict.fromkeys(("id", "name", "description"), "labels"),
                "generator": "the program",
                **VENDOR,
            },
        ),
        "items": Keys(
            ("type", "resources"),
            {
                **dict.fromkeys(("id", "name", "labels"), "labels"),
                "sources": "what an item was made of",
                **VENDOR,
            },
        ),
        "items.resources": Keys(("uri", "format"), VENDOR),
    },
    CAMERA_LIST: {
        "": Keys((*HEAD, "cameras"), {"uid_generator": "how ids were made", **VENDOR}),
        "cameras": Keys(("id", "uri"), VENDOR),
    },
    INPUT_CAMERAS: {
        "": Keys((*HEAD, "sensors"), {"captures": "poses before the calibration", **VENDOR}),
        "sensors": Keys(
            ("id", "name", "image_size_px"),
            {
                "bands": "names of colours",
                "pixel_size_um": "everything is in pixels",
                "internals": "before the calibration",
                "rig_relatives": "before the calibration",
                "shutter_type": "its effect is with the calibrated cameras",
                **VENDOR,
            },
        ),
    },
    CALIBRATED: {
        "": Keys((*HEAD, "sensors", "cameras"), VENDOR),
        "sensors": Keys(
            ("id", "internals"), {"rig_relatives": "every camera has its pose", **VENDOR}
        ),
        "sensors.internals": Keys(
            (
                *("type", "principal_point_px", "focal_length_px", "radial_distortion"),
                *("tangential_distortion", "affine", "polynomial"),
            ),
            {"is_symmetric_affine": "what is held", "is_p0_zero": "what is held", **VENDOR},
        ),
        "cameras": Keys(
            ("id", "sensor_id", "position", "orientation_deg"),
            VENDOR,
            {"rolling_shutter": "one pose a photograph is read"},
        ),
    },
    FRAME: {
        "": Keys(
            (*HEAD, "base_to_canonical"),
            {"crs": "coordinates stay in the system of the project", **VENDOR},
        ),
        "base_to_canonical": Keys(("shift", "scale", "swap_xy"), VENDOR),
    },
    INPUT_POINTS: {
        "": Keys((*HEAD, "gcps", "mtps"), VENDOR),
        **{name: POINT for name in ("gcps", "mtps")},
        **{f"{name}.marks": MARK for name in ("gcps", "mtps")},
    },
    PROJECTED_POINTS: {
        "": Keys((*HEAD, "projected_gcps"), VENDOR),
        "projected_gcps": Keys(("id", "coordinates", "sigmas"), VENDOR),
    },
    TRACKS: {
        "": Keys(
            ("nodes", "meshes", "accessors", "bufferViews", "buffers"),
            {
                "asset": "version and program",
                **dict.fromkeys(("scene", "scenes"), "all meshes are read"),
                **dict.fromkeys(("materials", "textures", "images", "samplers"), "for display"),
                **dict.fromkeys(("extensionsUsed", "extensionsRequired"), "their names"),
                **GLTF,
            },
        ),
        "nodes": Keys(("mesh", "matrix", "children"), GLTF),
        "meshes": Keys(("primitives",), GLTF),
        "meshes.primitives": Keys(
            ("attributes", "extensions"),
            {"mode": "points", "material": "for display", **GLTF},
        ),
        "meshes.primitives.attributes": Keys(
            ("POSITION", "COLOR_0"), {"NORMAL": "of surfaces", "_*": "of a program"}
        ),
        "meshes.primitives.extensions": Keys((MATCHES,), {"*": "of a program"}),
        f"meshes.primitives.extensions.{MATCHES}": Keys(
            ("cameraUids", "cameraIds", "pointIndexRanges", "imagePoints"), GLTF
        ),
        f"meshes.primitives.extensions.{MATCHES}.imagePoints": Keys(
            ("pixelCoordinates",),
            dict.fromkeys(("featureIds", "scales", "depths"), "of the matching"),
        ),
        "accessors": Keys(
            ("bufferView", "byteOffset", "componentType", "count", "type", "sparse"),
            {"min": "of the numbers", "max": "of the numbers", "normalized": "of colours", **GLTF},
        ),
        "bufferViews": Keys(
            ("buffer", "byteOffset", "byteStride"),
            {"byteLength": "of the file", "target": "for display", **GLTF},
        ),
        "buffers": Keys(("uri",), {"byteLength": "of the file", **GLTF}),
    },
}
"""By format, the keys of the objects by their paths."""
