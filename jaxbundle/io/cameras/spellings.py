"""How the entries of a camera are spelled in files around OpenCV: one name here for each meaning.

Capital letters, underscores and dots do not count: `Camera_Matrix`, `cameraMatrix`. The tables have
the meanings; what begins with `dist` or contains `distort` are the coefficients, however the rest
is spelled. Any other entry is subject to the rule of keys (`text.known_keys`).

    camera_matrix              3 × 3, or fx, fy, cx, cy by name, or [fx, fy, cx, cy] of `intrinsics`
    distortion_coefficients    a vector of any shape, or k1, k2, p1, p2, k3 … by name
    image_size                 [w, h], or image_width and image_height
    xi                         a number: the mirror of OpenCV's omnidirectional camera
    distortion_model           a word of MODEL_NAMES; camera_model the same, or a product's name

Source: OpenCV's samples and documentation, ROS's messages, public calibration files.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.known_keys import Keys, UnknownKeys

# The entries of a camera by meaning: the spelling in the file, and the value.
EntriesByMeaning = dict[str, tuple[str, Any]]

CORE: tuple[str, ...] = ("fx", "fy", "cx", "cy")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
TILT = ("taux", "tauy")
SPELLINGS = {
    "camera_matrix": (
        "cameramatrix k kmatrix kmat matrixk intrinsicmatrix intrinsicsmatrix intrinsics intrinsic "
        "cameraintrinsics cameraintrinsic intrinsicparameters intrinsicparams intrinsicmat "
        "matrixintrinsic cammatrix cammtx cameramat cameramtx mtx m calibrationmatrix camk"
    ),
    "image_width": "imagewidth width w imgwidth imgw framewidth",
    "image_height": "imageheight height h imgheight imgh frameheight",
    "image_size": "imagesize resolution imgsize imageresolution dim framesize imsize size",
    "distortion_model": "distortionmodel distortiontype distmodel distortmodel lensmodel lenstype",
    "camera_model": "projectionmodel projectiontype cameramodel cameratype modeltype model",
    "fisheye_model": "fisheyemodel fisheye isfisheye usefisheye",
    "skew": "skew skewness",
    "xi": "xi",
    "roi": "roi regionofinterest",
    "binning_x": "binningx",
    "binning_y": "binningy",
    "camera_name": "cameraname camname cameraid camid",
    "fx": "fx focallengthx fu",
    "fy": "fy focallengthy fv",
    "cx": "cx ppx u0 principalpointx cu",
    "cy": "cy ppy v0 principalpointy cv",
}
MEANING = {name: kind for kind, names in SPELLINGS.items() for name in names.split()}
# Meanings of entries that are one number: a matrix `K1` is none.
SCALARS = (*CORE, *COEFFICIENTS, *TILT, "skew")
MODEL_NAMES = {
    **dict.fromkeys(
        "plumbbob rationalpolynomial rational radtan radialtangential brown brownconrady opencv "
        "pinhole perspective standard normal none opencvpinhole pinholeradtan radtan8 full "
        "rectilinear radialtangential8 radial".split(),
        "opencv",
    ),
    **dict.fromkeys(
        "equidistant fisheye equi kannalabrandt kannalabrandt4 kannalabrandt8 kb kb4 "
        "opencvfisheye pinholeequi pinholeequidistant".split(),
        "kannala-brandt",
    ),
}
"""Our model by the names that files give to OpenCV's two."""
# Entries of such files that do not concern the image of a ray, by meaning.
IGNORED = Keys(
    (),
    {
        **dict.fromkeys(
            ("board*", "*pattern*", "square*", "marker*", "chess*", "charuco*", "aruco*", "grid*",
             "checker*", "corner*", "*dictionary*"),
            "the calibration target",
        ),
        **dict.fromkeys(
            ("*error*", "rms*", "*rms", "*stddev*", "std*", "*deviation*", "*covariance*",
             "*uncertainty*", "*residual*", "reproj*", "quality*", "coverage*"),
            "how well it was calibrated",
        ),
        **dict.fromkeys(
            ("calibrationtime", "calibrationdate", "date", "time", "timestamp", "datetime",
             "createdat", "comment", "header", "stamp", "seq", "frameid", "cameraserial",
             "serialnumber", "serial", "imagetopic", "fps", "ratehz", "framerate", "name",
             "metadata", "sensortype", "software", "version", "imagepath", "sourcefile"),
            "where the file comes from",
        ),
        **dict.fromkeys(
            ("nframes", "n*frames", "nrofframes", "num*", "flags", "flag*", "fix*", "aspectratio",
             "criteria*", "*zerotangent*", "maxiter*", "calib*flags", "imagecount", "framecount"),
            "the settings of the calibration",
        ),
        **dict.fromkeys(
            ("imagepoints*", "objectpoints*", "*extrinsic*", "rvec*", "tvec*", "rotationvec*",
             "translationvec*", "perview*", "rotations", "translations", "viewposes"),
            "the measurements, and the boards' places",
        ),
        **dict.fromkeys(
            ("rectificationmatrix*", "projectionmatrix*", "r", "p", "r1", "r2", "p1", "p2", "q",
             "newcameramatrix", "newcameramtx", "newcammatrix", "newk", "newmtx", "refinedmatrix",
             "optimalcameramatrix", "newcammtx", "undistortedcameramatrix", "mapx", "mapy", "map1",
             "map2", "validroi*", "disptodepth*", "e", "f", "essential*", "fundamental*",
             "baseline*", "optimalnewcameramatrix", "rectified*", "fov", "fovx", "fovy", "hfov",
             "vfov", "horizontalfov", "verticalfov", "invk", "kinv"),
            "derived images: rectified or undistorted ones",
        ),
        **dict.fromkeys(
            ("rotation", "rotationmatrix", "translation", "translationvector", "t", "tbs",
             "tcamimu", "timucam"),
            "where the camera is: a camera file has no images",
        ),
    },
)  # fmt: skip


def fold(name: str) -> str:
    """A name without capital letters and separators."""
    return re.sub(r"[\W_]+", "", name.lower())


def meaning_of(name: str, value: Any) -> str | None:
    """What an entry is, by its name; None if it is none of a camera."""
    name = fold(name)
    if _is_scalar(value) and name in (*COEFFICIENTS, *TILT):
        return name
    if (kind := MEANING.get(name)) is not None:
        return kind if _is_scalar(value) or kind not in SCALARS else None
    if name.startswith("undist"):
        return None
    distortion = name == "d" or "distort" in name or name.endswith("dist")
    distortion |= re.match(r"dist(?!ance)", name) is not None
    coefficients = re.fullmatch(r"(lens|camera)?coef\w*|kc", name) is not None
    return "distortion_coefficients" if distortion or coefficients else None


def camera_entries(
    entries: Mapping[str, Any], where: object, unknown: UnknownKeys, ignored: Keys = IGNORED
) -> EntriesByMeaning:
    """The entries of a camera by meaning; others are checked by the rule of keys.

    **Raises:** `InputError` for an unknown entry that may change the geometry, and for two entries
    of one meaning."""
    by_meaning: EntriesByMeaning = {}
    unrecognised = []
    for name, value in entries.items():
        kind = meaning_of(name, value)
        # What is null, or an empty list, says nothing.
        if value is None or value == [] or value == "":
            continue
        if kind == "distortion_coefficients" and isinstance(value, str):
            kind = "distortion_model"
        if kind is None:
            unrecognised.append(name)
        elif kind in ("camera_matrix", "distortion_coefficients") and _has_named_numbers(value):
            inner_entries = camera_entries(value, where, unknown, ignored)
            if kind == "distortion_coefficients" and inner_entries.keys().isdisjoint(
                (kind, *COEFFICIENTS, *TILT)
            ):
                raise InputError(
                    f"{where}: {name} is {show(value)}; expected the coefficients of distortion"
                )
            for meaning, (spelling, part) in inner_entries.items():
                _add_entry(by_meaning, meaning, (f"{name}.{spelling}", part), where)
        else:
            _add_entry(by_meaning, kind, (name, value), where)
    if "roi" in by_meaning and not isinstance(by_meaning["roi"][1], Mapping):
        # OpenCV's getOptimalNewCameraMatrix gives both, of the undistorted image
        if not any("new" in fold(name) or "optimal" in fold(name) for name in entries):
            raise InputError(
                f"{where}: {by_meaning['roi'][0]} is {show(by_meaning['roi'][1])}; expected "
                "x_offset, y_offset, width and height, as in ROS; without it if the image is whole"
            )
        del by_meaning["roi"]
    name_by_folded = {fold(name): name for name in unrecognised}
    if "xi" in by_meaning and (
        sphere := [name for key, name in name_by_folded.items() if key == "alpha"]
    ):
        raise InputError(
            f"{where}: {by_meaning['xi'][0]} and {sphere[0]} are a double sphere, not a camera of "
            "OpenCV; expected a Kalibr file, camera_model ds"
        )
    for name in ignored.unknown(name_by_folded):
        unknown.check([name_by_folded[name]], Keys((*CORE, *SPELLINGS)), where)
    return by_meaning


def _add_entry(
    by_meaning: EntriesByMeaning, kind: str, entry: tuple[str, Any], where: object
) -> None:
    # Of several names, the first: none of them concerns rays.
    if kind != "camera_name" and kind in by_meaning and by_meaning[kind][1] != entry[1]:
        raise InputError(
            f"{where}: {by_meaning[kind][0]} and {entry[0]} are both the "
            f"{kind.replace('_', ' ')}, and differ; expected one of them"
        )
    by_meaning.setdefault(kind, entry)


def _has_named_numbers(value: Any) -> TypeGuard[Mapping[str, Any]]:
    """Whether a value is numbers by their names, not a matrix of OpenCV."""
    return isinstance(value, Mapping) and not {"rows", "data"} <= value.keys()


def _is_scalar(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_matrix(value: Any) -> bool:
    """Whether a value may be the matrix of a camera, or its numbers by name."""
    if isinstance(value, Mapping):
        meanings = {MEANING.get(fold(name)) for name in value}
        return {"rows", "data"} <= value.keys() or {"fx", "fy"} <= meanings
    flat = _flatten(value)
    return len(flat) in (4, 9) and all(map(_is_scalar, flat))


def _flatten(value: Any) -> list[Any]:
    """The numbers of lists of lists; not the elements of a long list."""
    if not isinstance(value, list) or len(value) > 16:
        return [value]
    return [x for part in value for x in (part if isinstance(part, list) else [part])]


def has_camera(entries: Any) -> bool:
    """Whether a mapping has the entries of a camera."""
    if not isinstance(entries, Mapping):
        return False
    kinds = {meaning_of(name, value): value for name, value in entries.items()}
    has_focal_lengths = {"fx", "fy"} <= kinds.keys()
    return has_focal_lengths or is_matrix(kinds.get("camera_matrix"))


def cameras_within(
    document: Any, depth: int = 3, name: str = ""
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Names and entries of the objects that have a camera, the outermost ones."""
    if has_camera(document):
        yield name, document
    elif depth and isinstance(document, Mapping):
        for key, value in document.items():
            yield from cameras_within(value, depth - 1, str(key))
    elif depth and isinstance(document, list) and len(document) < 1000:
        for k, value in enumerate(document):
            yield from cameras_within(value, depth - 1, f"{name or 'camera'}{k}")
