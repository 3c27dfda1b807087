"""Calibrations of MicMac: `AutoCal….xml`, a `CalibrationInternConique`, the root of the document or
inside `ExportAPERO`.

    KnownConv         eConvApero_DistM2C, eConvOriLib: the distortion leads from the world to the
                      camera; eConvApero_DistC2M: from the camera to the world
    PP  F  SzIm       principal point, principal distance, pixels; size of the image
    CalibDistortion   ModNoDist
        ModRad        CDist, CoeffDist …: centre C, R3, R5, R7, … (CoeffDistInv is not read)
        ModPhgrStd    RadialePart (the same), P1, P2, b1, b2

    q = PP + F·[X/Z, Y/Z]                x right, y down, z forward
    D(q) = q + [dx·R + P1·(ρ² + 2dx²) + 2·P2·dx·dy + b1·dx + b2·dy,
                dy·R + P2·(ρ² + 2dy²) + 2·P1·dx·dy]
    [dx, dy] = q − C   ρ² = dx² + dy²   R = R3·ρ² + R5·ρ⁴ + …

The image is D(q) (M2C), or the point that D takes to q (C2M). M2C with C = PP, b1 = b2 = 0 and
three coefficients or fewer is exactly `opencv`, with fx and fy tied,

    k1 = R3·F²   k2 = R5·F⁴   k3 = R7·F⁶   p1 = P2·F   p2 = P1·F

With an affinity b1, b2 it is `brown-projected`, and C2M is `brown`, exactly, P2 and b2 with the
other sign. These are in mm: the pixel size, missing from the file, is taken as 0.005 mm; another
would scale c and coefficients, and change nothing in pixels. With more coefficients, or C different
from PP, the nearest of our models is fitted, as for ModUnif (`micmac_unified`). A separate affine
part (OrIntGlob) is refused by name. Which point of the first pixel is
(0, 0) is not published; its centre is assumed. Another choice would shift image points and
principal point alike, so that no ray changes.

Source: MicMac's documentation, "Camera models"; the formula of its `cDistModStdPhpgr`.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxbundle.cameras.inverse import implicit_inverse
from jaxbundle.cameras.scalars import Formula, Pair, Parameters, Scalar
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import FittedCamera, Foreign, fit_camera, with_messages
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.losses import check_others_zero, one_focal_length, size_of
from jaxbundle.io.networks.micmac_unified import unified_camera
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.rows import is_number
from jaxbundle.io.text.xml_fields import XmlFields, number_in, read_xml
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import beginning

CALIBRATION = "CalibrationInternConique"
M2C = ("eConvApero_DistM2C", "eConvOriLib")
C2M = ("eConvApero_DistC2M",)
# Models that can be written.
MODELS = ("opencv", "brown-projected", "brown")
KEYS = Keys(
    ("KnownConv", "PP", "F", "SzIm", "CalibDistortion", "OrIntGlob", "ParamAF"),
    {
        **dict.fromkeys(("RayonUtile", "RayonUtileInDMO"), "how far the image is used"),
        **dict.fromkeys(("ScannedAnalogik", "PixelSzIm"), "the size of its pixels in mm"),
        "PrecMesh*": "settings of the program",
    },
)
DISTORTION_KEYS = Keys(("ModNoDist", "ModRad", "ModPhgrStd", "ModUnif", "ModGrid", "ModGridDef"))
INVERSE = {"CoeffDistInv": "the approximate inverse of the same polynomial"}
SAME_CENTRE = {"PPaEqPPs": "whether CDist equals PP: both are read"}
RADIAL_KEYS = Keys(("CDist", "CoeffDist"), INVERSE | SAME_CENTRE)
# Of the parts of a distortion.
KIND_KEYS = {
    "ModNoDist": Keys((), {"Inutile": "always empty"}),
    "ModRad": RADIAL_KEYS,
    "RadialePart": RADIAL_KEYS,
    "ModPhgrStd": Keys(("RadialePart", "P1", "P2", "b1", "b2")),
    "ModUnif": Keys(("TypeModele", "Params", "Etats")),
}
# Coefficients CoeffDist of MicMac's models.
RADIAL = ("R1", "R2", "R3", "R4", "R5")
AFFINE = ("P1", "P2", "b1", "b2")
COEFFICIENTS = (*RADIAL, *AFFINE)


def is_autocal(path: Path) -> bool:
    """Whether an XML file holds a calibration of MicMac."""
    head = beginning(path, 100_000) if path.suffix.lower() == ".xml" else b""
    return f"<{CALIBRATION}".encode() in head and b"<OrientationConique>" not in head


def read_autocal(path: str | Path) -> Camera:
    """The camera of a calibration; its id is the name of the file.

    **Raises:** `InputError` naming file and element.
    """
    path = Path(path)
    return calibration(path, read_xml(path), path.stem)


def calibration(path: Path, root: ET.Element, id: str, pixel_size: float = 0.005) -> Camera:
    """The camera of the calibration in a document.

    **Arguments:** `pixel_size` [mm] of a model in mm, since the file has none. Any value gives the
    same image; 5 µm is a common one, so that c in mm looks like that of a lens.
    """
    root_fields = XmlFields(path, root, "a calibration of MicMac")
    # Tapas writes it inside <ExportAPERO>, other tools as the root
    element = root if root.tag == CALIBRATION else root_fields.find(CALIBRATION)
    if element is None:
        raise root_fields.missing_error(CALIBRATION)
    xml = XmlFields(path, element, "a calibration of MicMac")
    unknown = UnknownKeys()
    _check_keys(unknown, path, element)
    camera = _camera_of_calibration(path, xml, id, pixel_size)
    return with_messages(camera, *unknown.messages())


def _check_keys(unknown: UnknownKeys, path: Path, element: ET.Element) -> None:
    unknown.check_element(element, KEYS, f"{path}: {CALIBRATION}")
    if any(float(e.text or 0) for e in element.iter("ParamAF") if is_number(e.text or "")):
        raise InputError(f"{path}: ParamAF, an afocal system, is not supported")
    for distortion in element.iter("CalibDistortion"):
        unknown.check_element(distortion, DISTORTION_KEYS, f"{path}: CalibDistortion")
        for tag, keys in KIND_KEYS.items():
            for part in distortion.iter(tag):
                unknown.check_element(part, keys, f"{path}: {tag}")


def _camera_of_calibration(path: Path, xml: XmlFields, id: str, pixel_size: float) -> Camera:
    direction = xml.text("KnownConv", M2C[0])
    if direction not in (*M2C, *C2M):
        choices = ", ".join((*M2C, *C2M))
        raise InputError(f"{path}: KnownConv is {direction}; expected one of {choices}")
    if xml.find("OrIntGlob") is not None:
        raise InputError(f"{path}: OrIntGlob, a separate affine part, is not supported")
    f, (cx, cy), (w, h) = xml.number("F"), xml.numbers("PP", 2), xml.numbers("SzIm", 2)
    if not (f > 0 and w > 0 and h > 0 and w.is_integer() and h.is_integer()):
        raise InputError(f"{path}: F and SzIm must be positive, SzIm whole, not {f:g}, {w:g} {h:g}")
    core = {"fx": f, "fy": f, "cx": float(cx), "cy": float(cy)}
    kinds = [kind for part in xml.root.iter("CalibDistortion") for kind in part]
    if [kind.tag for kind in kinds if kind.tag != "ModNoDist"] == ["ModUnif"]:
        if direction in C2M:
            raise InputError(
                f"{path}: ModUnif with KnownConv {direction} is not supported; expected {M2C[0]}"
            )
        unified = next(kind for kind in kinds if kind.tag == "ModUnif")
        return unified_camera(id, xml, unified, core, (int(w), int(h)), pixel_size)
    p = core | _distortion(xml, core)
    start = core | {f"k{i}": p[f"R{i}"] * f ** (2 * i) for i in (1, 2, 3)}
    start |= {"p1": p["P2"] * f, "p2": p["P1"] * f}
    unusual_features = {
        "more than three coefficients": p["R4"] or p["R5"],
        # Equal to the last bit: MicMac writes one number twice (PPaEqPPs).
        "a separate centre of distortion": (p["x"], p["y"]) != (p["cx"], p["cy"]),
    }
    features_text = " and ".join(
        feature for feature, is_present in unusual_features.items() if is_present
    )
    size = int(w), int(h)
    if features_text:
        foreign = Foreign(FORMULAS[direction in C2M], p, start, size, (pixel_size, pixel_size))
        return fit_camera(id, foreign, str(path), f"has {features_text}")
    # Without affinity, or any distortion of the other direction, the formulas are the same.
    if not (p["b1"] or p["b2"] or (direction in C2M and any(p[name] for name in COEFFICIENTS))):
        return Camera(id, "opencv", start, image_size=size, tie=(("fx", "fy"),))
    model, note = MODELS[1 + (direction in C2M)], f"the pixel size is taken as {pixel_size:g} mm"
    return FittedCamera(
        id,
        model,
        _parameters_in_mm(p, size, pixel_size),
        image_size=size,
        pixel_size=(pixel_size, pixel_size),
        message=f"camera {id!r} is {model}, which is in mm: {note}; in pixels it changes nothing",
    )


def _parameters_in_mm(
    p: Mapping[str, float], size: tuple[int, int], pixel: float
) -> dict[str, float]:
    """The parameters of Brown's model in mm, y up."""
    radial = {f"K{i}": p[f"R{i}"] / pixel ** (2 * i) for i in (1, 2, 3)}
    x0, y0 = (pixel * (p[c] - (n - 1) / 2) for c, n in zip(("cx", "cy"), size))
    # y turns round: P2 and b2 are of odd terms in y
    return radial | {
        "c": p["fx"] * pixel,
        "x0": x0,
        "y0": -y0,
        "P1": p["P1"] / pixel,
        "P2": -p["P2"] / pixel,
        "b1": p["b1"],
        "b2": -p["b2"],
    }


def _distortion(xml: XmlFields, core: Mapping[str, float]) -> dict[str, float]:
    """R1 … R5, the centre x, y, and P1, P2, b1, b2, of the only distortion other than ModNoDist.

    **Raises:** `InputError` for an unsupported kind, and for several."""
    zeros = dict.fromkeys(COEFFICIENTS, 0.0)
    kinds = [kind for part in xml.root.iter("CalibDistortion") for kind in part]
    kinds = [kind for kind in kinds if kind.tag != "ModNoDist"]
    for kind in kinds:
        if kind.tag not in ("ModRad", "ModPhgrStd") or len(kinds) > 1:
            name = kind.findtext("TypeModele", "").strip()
            raise InputError(
                f"{xml.path}: CalibDistortion {kind.tag} {name}".rstrip()
                + f" of {len(kinds)}; expected one of ModNoDist, ModRad, ModPhgrStd, ModUnif"
            )
    if not kinds:
        return zeros | {"x": core["cx"], "y": core["cy"]}
    part = XmlFields(xml.path, kinds[0], f"a {kinds[0].tag} of MicMac")
    x, y = part.numbers("CDist", 2)
    R = [number_in(e.text or "", f"{xml.path}: CoeffDist") for e in kinds[0].iter("CoeffDist")]
    if any(R[len(RADIAL) :]):
        raise InputError(f"{xml.path}: {len(R)} coefficients CoeffDist; {len(RADIAL)} are known")
    coefficients = zeros | dict(zip(RADIAL, R))
    coefficients |= {name: part.number(name, 0.0) for name in AFFINE}
    return coefficients | {"x": float(x), "y": float(y)}


def _distortion_at(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """D of a point, relative to the centre of distortion."""
    R1, R2, R3, R4, R5, P1, P2, b1, b2 = p
    r2 = x * x + y * y
    R = r2 * (R1 + r2 * (R2 + r2 * (R3 + r2 * (R4 + r2 * R5))))
    dx = x * R + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y + b1 * x + b2 * y
    return x + dx, y + y * R + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y


# Twelve iterations, as in `cameras.fisheye_prism`: Newton's method starts at the point itself and
# converges quadratically; more only take time.
_from_world = implicit_inverse(_distortion_at, lambda _, x, y: (x, y), 12)


def _project(
    direction: Formula, p: Mapping[str, Scalar], X: Scalar, Y: Scalar, Z: Scalar
) -> Float[Array, "2"]:
    """The image of a ray: `direction` maps from the ideal image."""
    x, y = p["fx"] * X / Z + p["cx"] - p["x"], p["fy"] * Y / Z + p["cy"] - p["y"]
    x, y = direction(tuple(p[name] for name in COEFFICIENTS), x, y)
    return jnp.stack([x + p["x"], y + p["y"]])


# Where the distortion leads to the camera, and where it leads to the world.
FORMULAS = (partial(_project, _distortion_at), partial(_project, _from_world))


def calibration_lines(camera: Camera) -> list[str]:
    """The element of a camera of one of the `MODELS`.

    **Raises:** `InputError` for another camera, and without image size.
    """
    w, h = size_of(camera, "MicMac")
    p = _from_brown(camera, w, h) if camera.model in MODELS[1:] else _from_opencv(camera)
    centre = f"{p['cx']!r} {p['cy']!r}"
    radial = [f"<CDist>{centre}</CDist>"]
    radial += [f"<CoeffDist>{p[f'R{i}']!r}</CoeffDist>" for i in (1, 2, 3)]
    radial += ["<PPaEqPPs>true</PPaEqPPs>"]
    kind = ["<ModRad>", *radial, "</ModRad>"]
    if any(p[name] for name in AFFINE):
        kind = [
            "<ModPhgrStd>",
            "<RadialePart>",
            *radial,
            "</RadialePart>",
            *(f"<{name}>{p[name]!r}</{name}>" for name in AFFINE),
            "</ModPhgrStd>",
        ]
    direction = C2M[0] if camera.model == "brown" else M2C[0]
    return [
        f"<{CALIBRATION}>",
        f"<KnownConv>{direction}</KnownConv>",
        f"<PP>{centre}</PP>",
        f"<F>{p['fx']!r}</F>",
        f"<SzIm>{w} {h}</SzIm>",
        "<CalibDistortion>",
        *kind,
        "</CalibDistortion>",
        f"</{CALIBRATION}>",
    ]


def _from_opencv(camera: Camera) -> dict[str, float]:
    p = check_others_zero(camera, "MicMac", ("k1", "k2", "k3", "p1", "p2"))
    if camera.model != MODELS[0]:
        raise InputError(f"camera {camera.id!r}: a fisheye is not written for MicMac")
    f = one_focal_length(camera, "MicMac")
    radial = {f"R{i}": p[f"k{i}"] / f ** (2 * i) for i in (1, 2, 3)}
    # The decentring terms of OpenCV have their names the other way round.
    return p | radial | {"P1": p["p2"] / f, "P2": p["p1"] / f, "b1": 0.0, "b2": 0.0}


def _from_brown(camera: Camera, w: int, h: int) -> dict[str, float]:
    p, (px, py) = all_parameters(camera), camera.pixel_size or (0.0, 1.0)
    if px != py or p["r0"]:
        raise InputError(
            f"camera {camera.id!r}: MicMac needs square pixels (pixel_size) and r0 = 0"
        )
    return {f"R{i}": p[f"K{i}"] * px ** (2 * i) for i in (1, 2, 3)} | {
        "fx": p["c"] / px,
        "cx": (w - 1) / 2 + p["x0"] / px,
        "cy": (h - 1) / 2 - p["y0"] / px,
        "P1": p["P1"] * px,
        "P2": -p["P2"] * px,
        "b1": p["b1"],
        "b2": -p["b2"],
    }


def document(lines: list[str]) -> str:
    """The text of a file of MicMac with these elements."""
    return "\n".join(['<?xml version="1.0" ?>', "<ExportAPERO>", *lines, "</ExportAPERO>"]) + "\n"


def write_autocal(camera: Camera, path: str | Path) -> None:
    """Write a calibration."""
    write_text(Path(path), document(calibration_lines(camera)))
