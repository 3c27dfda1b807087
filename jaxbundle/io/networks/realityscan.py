"""Cameras of RealityScan (RealityCapture): a folder of XMP files, or the table "Internal/External
camera parameters".

    NAME.xmp      xcr:Rotation (by rows), Position, FocalLength35mm, PrincipalPointU and V, Skew,
                  DistortionModel, DistortionCoeficients (k1 k2 k3 k4 t1 t2), AspectRatio, as
                  attributes or elements of rdf:Description
    NAME.csv      #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2

x = R·(X − Position), x right, y down, z forward. The table has the rotation camera → object, x
right, y up, the camera looking along −z,

    Mᵀ = R_z(−heading)·R_x(pitch)·R_y(roll)

in degrees. With the larger side s = max(w, h) of the image

    f_px = f·s/36   cx = w/2 + U·s − ½   cy = h/2 + V·s − ½

and `opencv` with k1, k2, k3, p1 = t1, p2 = t2; a k4 (of r⁸) is fitted. That t1 and t2 are in the
order of OpenCV, and that image coordinates count from the corner of the image, is not published;
other readers assume it, too. Skewed pixels and the models with a division are refused.

The size of a photograph is in neither file: it is read from the photograph beside it (in a folder
also by the stem of its name), else it is `image_size`.

Source: RealityCapture, "XMP Camera Math" (2020); the readers of nerfstudio and of AliceVision.
"""

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras.field_of_view import SMALL_FORMAT
from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.cameras.nearest_camera import Foreign, fit_camera, fit_messages
from jaxbundle.io.networks.assemble import (
    PIXEL_CENTRE,
    all_parameters,
    assemble,
    entry_of,
    foreign_document,
    image_columns,
    unique_labels,
)
from jaxbundle.io.networks.losses import (
    changed,
    check_others_zero,
    describe_losses,
    losing,
    need_values,
    size_of,
)
from jaxbundle.io.networks.poses import check_rotations, matrices_of
from jaxbundle.io.networks.transforms import polynomial
from jaxbundle.io.text.csv_tables import parse_csv, read_text, write_text
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import number_in, read_xml
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.columns import Columns
from jaxbundle.network.tables import Camera, Network, Source
from jaxbundle.photographs.formats import SUFFIXES as PHOTOGRAPHS
from jaxbundle.photographs.reading import photograph_size
from jaxbundle.system.file_content import beginning

NAMESPACE = "http://www.capturingreality.com/ns/xcr/1.1#"
# The property of XMP for the name of the file that is described.
MEDIA, OWN_NAME = "http://ns.adobe.com/xap/1.0/mm/", "PreservedFileName"
FILES = ("*.xmp",)
RADIAL, TANGENTIAL = ("k1", "k2", "k3", "k4"), ("t1", "t2")
MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
POSE = ("x", "y", "alt", "heading", "pitch", "roll")
REQUIRED = ("name", *POSE, "f")
HEADER = (*REQUIRED, "px", "py", *RADIAL, *TANGENTIAL)
XMP_KEYS = Keys(
    (
        *("Rotation", "Position", "FocalLength35mm", "PrincipalPointU", "PrincipalPointV"),
        *("DistortionModel", "DistortionCoeficients", "Skew", "AspectRatio"),
    ),
    {
        **dict.fromkeys(
            ("Version", "PosePrior", "Coordinates", "CalibrationPrior", "CalibrationGroup",
             "DistortionGroup", "ComponentId", "InTexturing", "InMeshing", "InColoring"),
            "groups, and what the program holds",
        ),
        **dict.fromkeys(("Rig", "RigInstance", "RigPoseIndex"), "every camera has its own pose"),
        **dict.fromkeys(("latitude", "longitude", "altitude", "GPS*"), "measured positions"),
    },
)  # fmt: skip
TABLE_KEYS = Keys(HEADER, {})


class Row(NamedTuple):
    """A photograph: name; size; f, U, V and coefficients by name; M and X0, NaN without a pose."""

    name: str
    size: tuple[int, int]
    parameters: Mapping[str, float]
    M: Float[np.ndarray, "3 3"]
    X0: Float[np.ndarray, "3"]
    where: str


def is_realityscan(path: Path) -> bool:
    """Whether a folder has XMP files of RealityScan, or a file is its table."""
    if path.is_dir():
        first_file = next(iter(sorted(path.glob(FILES[0]))), None)
        return first_file is not None and NAMESPACE.encode() in beginning(first_file, 10_000)
    if path.suffix.lower() != ".csv":
        return False
    # The table may begin with the number of cameras, and its columns may be chosen by the user.
    for line in beginning(path, 10_000).decode("utf-8", errors="replace").splitlines():
        if not line.strip() or line.startswith("#cameras"):
            continue
        return {*REQUIRED} <= {*_column_names(line)}
    return False


def read_realityscan(
    path: str | Path,
    overrides: Sequence[str] = (),
    *,
    image_size: Sequence[float] | None = None,
) -> Network:
    """The cameras and images of a folder or a table; photographs of equal interior orientation
    share a camera.

    Nothing can be adjusted: there are no image points. `image_size`: of photographs that are not
    beside the files.

    **Raises:** `InputError` naming file and field.
    """
    path, unknown = Path(path), UnknownKeys()
    reader = _read_folder if path.is_dir() else _read_table
    rows = list(reader(path, unknown, image_size))
    if not rows:
        raise InputError(f"{path}: there are no cameras")
    # Each photograph states its own numbers: equal ones are of one camera.
    cameras: dict[tuple, Camera] = {}
    camera_ids = []
    for row in rows:
        key = (row.size, tuple(row.parameters.items()))
        if key not in cameras:
            cameras[key] = _camera(str(len(cameras) + 1), row)
        camera_ids.append(cameras[key].id)
    names = unique_labels([row.name for row in rows], range(len(rows)))
    images = image_columns(
        Source(str(path), None, "camera"),
        names,
        camera_ids,
        np.array([row.M for row in rows]),
        np.array([row.X0 for row in rows]),
    )
    messages = [*unknown.messages(), *fit_messages(cameras.values())]
    if any(row.parameters[name] for row in rows for name in TANGENTIAL):
        messages.append("t1 and t2 are taken as p1 and p2 of OpenCV")
    document = foreign_document(path.stem, map(entry_of, cameras.values()))
    return assemble(path, document, overrides, images, warnings=messages)


def _camera(id: str, row: Row) -> Camera:
    p, (w, h) = row.parameters, row.size
    side = max(w, h)
    f = p["f"] * side / SMALL_FORMAT[0]
    if not f > 0:
        raise InputError(f"{row.where}: the focal length is {p['f']:g}; expected a number above 0")
    core = {"fx": f, "fy": f}
    core |= {"cx": w / 2 + p["px"] * side - PIXEL_CENTRE}
    core |= {"cy": h / 2 + p["py"] * side - PIXEL_CENTRE}
    core |= {"k1": p["k1"], "k2": p["k2"], "k3": p["k3"], "p1": p["t1"], "p2": p["t2"]}
    if p["k4"]:
        foreign = Foreign(polynomial, core | {"k4": p["k4"]}, core, row.size)
        return fit_camera(id, foreign, row.where, f"has k4 {p['k4']:g}")
    return Camera(id, "opencv", core, image_size=row.size, tie=(("fx", "fy"),))


def _size_and_name(
    folder: Path, name: str, image_size: Sequence[float] | None, where: str
) -> tuple[tuple[int, int], str]:
    """The size of a photograph, and its name with suffix if it is beside."""
    # XMP files have the stem of their photograph only; cameras write IMG_1.JPG
    suffixes = (*PHOTOGRAPHS, *map(str.upper, PHOTOGRAPHS))
    for file in (folder / name, *(folder / f"{name}{suffix}" for suffix in suffixes)):
        if file.suffix.lower() in PHOTOGRAPHS and file.is_file():
            return photograph_size(file), file.name
    if image_size is None:
        raise InputError(
            f"{where}: the size of the photograph is missing; expected {name} beside it, or "
            "--image-size W,H (convert, camera)"
        )
    w, h = (int(n) for n in image_size)
    return (w, h), name


# --- XMP ------------------------------------------------------------------------------------


def _read_folder(
    folder: Path, unknown: UnknownKeys, image_size: Sequence[float] | None
) -> Iterator[Row]:
    for path in sorted(folder.glob(FILES[0])):
        fields = _fields(path)
        if not fields:
            continue  # of another program
        photograph_name = fields.pop(OWN_NAME, path.stem)
        unknown.check(fields, XMP_KEYS, path)
        size, name = _size_and_name(folder, photograph_name, image_size, str(path))
        yield Row(name, size, _interior(path, fields), *_pose(path, fields), str(path))


def _fields(path: Path) -> dict[str, str]:
    """What is in the namespace of RealityScan, by name."""
    text = read_text(path)
    if NAMESPACE not in text:
        return {}
    fields = {}
    # The namespaces of elements are removed by the reader: their names are those of the file.
    xcr_tags = {*re.findall(r"<xcr:(\w+)", text)}
    for element in read_xml(path).iter():
        for key, value in element.attrib.items():
            if key.startswith(f"{{{NAMESPACE}}}") or key == f"{{{MEDIA}}}{OWN_NAME}":
                fields[key.rpartition("}")[2]] = value
        if element.tag in xcr_tags:
            fields[element.tag] = element.text or ""
    return fields


def _numbers(path: Path, fields: Mapping[str, str], key: str, n: int) -> np.ndarray:
    words = fields[key].split()
    if len(words) != n:
        raise InputError(f"{path}: {key} has {len(words)} numbers; expected {n}")
    return np.array([number_in(word, f"{path}: {key}") for word in words])


def _interior(path: Path, fields: Mapping[str, str]) -> dict[str, float]:
    if "FocalLength35mm" not in fields:
        raise InputError(f"{path}: FocalLength35mm is missing")
    model = fields.get("DistortionModel", "perspective")
    if model not in MODELS:
        raise InputError(
            f"{path}: the distortion model {model} is not read; expected one of "
            f"{', '.join(MODELS)}, chosen in the settings of the alignment"
        )
    number = lambda key, default: number_in(fields.get(key, default), f"{path}: {key}")
    if number("Skew", "0") != 0 or number("AspectRatio", "1") != 1:
        raise InputError(f"{path}: Skew and AspectRatio are not read; expected 0 and 1")
    # The six coefficients are there for every model, those it does not have as 0.
    k = np.zeros(6)
    if model != "perspective" and "DistortionCoeficients" in fields:
        k = _numbers(path, fields, "DistortionCoeficients", 6)
    interior = {"f": number("FocalLength35mm", "0")}
    interior |= {"px": number("PrincipalPointU", "0"), "py": number("PrincipalPointV", "0")}
    return interior | dict(zip((*RADIAL, *TANGENTIAL), k.tolist()))


def _pose(path: Path, fields: Mapping[str, str]) -> tuple[np.ndarray, np.ndarray]:
    # A calibration alone has no pose: unknown, never the identity.
    if "Rotation" not in fields or "Position" not in fields:
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    R = _numbers(path, fields, "Rotation", 9).reshape(3, 3)
    check_rotations(R, f"{path}: Rotation")
    return flip_rows(R), _numbers(path, fields, "Position", 3)


# --- table ----------------------------------------------------------------------------------


def _column_names(line: str) -> list[str]:
    return [name.strip().lstrip("#").strip().lower() for name in line.split(",")]


def _read_table(
    path: Path, unknown: UnknownKeys, image_size: Sequence[float] | None
) -> Iterator[Row]:
    # Its header begins with #, as comments of our tables do.
    text = re.sub(r"^\s*#\s*(?=name\s*,)", "", read_text(path), count=1, flags=re.M | re.I)
    table = parse_csv(path, text)
    columns = {_column_names(name)[0]: name for name in table.values}
    unknown.check(columns, TABLE_KEYS, path)
    table = Columns({key: table.values[name] for key, name in columns.items()}, table.source)
    names = table.ids("name")
    pose = np.stack([table.numbers(key, required=True) for key in POSE], 1)
    interior = {
        key: table.numbers(key, required=True) if key in columns else np.zeros(len(names))
        for key in HEADER[len(POSE) + 1 :]
    }
    for k, name in enumerate(names):
        where = table.source(k)
        size, photograph = _size_and_name(path.parent, name, image_size, where)
        parameters = {key: float(column[k]) for key, column in interior.items()}
        M = _rotation_from_heading(*np.radians(pose[k, 3:])).T
        yield Row(photograph, size, parameters, M, pose[k, :3], where)


def _rotation_from_heading(heading: float, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """R_z(−heading)·R_x(pitch)·R_y(roll)."""
    ch, sh, cp, sp, cr, sr = (f(a) for a in (heading, pitch, roll) for f in (math.cos, math.sin))
    Rz = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])
    Rx = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    Ry = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return Rz @ Rx @ Ry


def _heading_of(R: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Heading, pitch and roll of a rotation camera → object, degrees."""
    heading = math.atan2(R[0, 1], R[1, 1])
    # Not asin, whose slope at 90° is infinite.
    pitch = math.atan2(R[2, 1], math.hypot(R[0, 1], R[1, 1]))
    # The first row of R_y(roll) = R_x(−pitch)·R_z(heading)·R: of a camera whose image columns are
    # vertical (pitch ±90°) any heading will do with the roll that belongs to it.
    ch, sh = math.cos(heading), math.sin(heading)
    roll = math.atan2(ch * R[0, 2] - sh * R[1, 2], ch * R[0, 0] - sh * R[1, 0])
    return math.degrees(heading), math.degrees(pitch), math.degrees(roll)


# --- writing --------------------------------------------------------------------------------


def _written_interior(camera: Camera, largest_difference: float = 0.5) -> dict[str, float]:
    """The interior orientation in the units of the program; `largest_difference`: what one focal
    length instead of two may change, pixels: rounding to whole ones does as much."""
    p = check_others_zero(camera, "RealityScan", ("k1", "k2", "k3", "p1", "p2"))
    w, h = size_of(camera, "RealityScan")
    # An adjusted camera has two focal lengths that differ by their σ.
    f, focal_difference = math.sqrt(p["fx"] * p["fy"]), _focal_difference(camera)
    if focal_difference > largest_difference:
        raise InputError(
            f"camera {camera.id!r}: RealityScan has one focal length, but fx is {p['fx']:.9g} and "
            f"fy {p['fy']:.9g}, {focal_difference:.2g} px at the edge of the image; adjust the "
            'camera with tie = [["fx", "fy"]]'
        )
    side = max(w, h)
    interior = {"f": f / side * SMALL_FORMAT[0]}
    interior |= {"px": (p["cx"] + PIXEL_CENTRE - w / 2) / side}
    interior |= {"py": (p["cy"] + PIXEL_CENTRE - h / 2) / side}
    return interior | {"k1": p["k1"], "k2": p["k2"], "k3": p["k3"], "k4": 0.0} | {
        "t1": p["p1"], "t2": p["p2"]
    }  # fmt: skip


def _focal_difference(camera: Camera) -> float:
    """What one focal length instead of two changes at the edge of the image, pixels."""
    p, (w, h) = all_parameters(camera), size_of(camera, "RealityScan")
    f = math.sqrt(p["fx"] * p["fy"])
    return max(w / 2 * abs(f / p["fx"] - 1), h / 2 * abs(f / p["fy"] - 1))


def _losses(network: Network) -> tuple[str, ...]:
    focal_difference = max((_focal_difference(camera) for camera in network.cameras), default=0.0)
    message = f"the difference of fx and fy (largest change in an image {focal_difference:.2g} px)"
    return (*describe_losses(network, REALITYSCAN_LOSSES), *([message] if focal_difference else []))


def write_realityscan_csv(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write the table "Internal/External camera parameters", which RealityScan imports as a flight
    log.

    **Returns:** messages about what the format cannot hold.
    """
    need_values(network, "opencv", "RealityScan", points=False)
    images = network.images
    interior = [_written_interior(camera) for camera in network.cameras]
    rows = [
        (id, *X0, *_heading_of(M.T), *(interior[c][key] for key in HEADER[len(POSE) + 1 :]))
        for id, X0, M, c in zip(
            images.id, images.position.tolist(), matrices_of(images.angles), images.camera.tolist()
        )
    ]
    text = io.StringIO()
    # A comma in the name of a photograph is quoted.
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(Path(path), f"#{','.join(HEADER)}\n{text.getvalue()}")
    return _losses(network)


def write_realityscan_xmp(
    network: Network, folder: str | Path, force: bool = False
) -> tuple[str, ...]:
    """Write an XMP file for every photograph of a network into a folder; laid beside the
    photographs, RealityScan reads them.

    **Arguments:** `force`: also replace a folder not written by this function.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` where the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`).
    """
    with replace_folder(folder, "write_realityscan_xmp", FILES, force) as new:
        return fill_realityscan(network, new)


def fill_realityscan(network: Network, folder: Path) -> tuple[str, ...]:
    """Write XMP files into an existing folder or a new one; as `write_realityscan_xmp`."""
    need_values(network, "opencv", "RealityScan", points=False)
    images = network.images
    names = [Path(id).stem if Path(id).suffix.lower() in PHOTOGRAPHS else id for id in images.id]
    names = [name.replace("/", "_") for name in names]
    ambiguous_name = next(
        (name for name in names if names.count(name) > 1 or not name.strip(".")), None
    )
    if ambiguous_name is not None:
        raise InputError(f"{folder}: image {ambiguous_name!r} does not give a unique file name")
    interior = [_written_interior(camera) for camera in network.cameras]
    R = flip_rows(matrices_of(images.angles))
    texts = [
        _xmp_text(id, interior[c], rotation, X0, c)
        for id, c, rotation, X0 in zip(images.id, images.camera.tolist(), R, images.position)
    ]
    folder.mkdir(exist_ok=True)
    for name, text in zip(names, texts):
        write_text(folder / f"{name}.xmp", text)
    return _losses(network)


def _xmp_text(id: str, p: Mapping[str, float], R: np.ndarray, X0: np.ndarray, group: int) -> str:
    numbers = lambda values: " ".join(repr(float(v)) for v in values)
    coefficients = [p[name] for name in (*RADIAL, *TANGENTIAL)]
    # A model without tangential terms would drop them.
    model = "brown3t2" if any(coefficients[4:]) else "brown3"
    model = model if any(coefficients) else "perspective"
    rdf = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
    return f"""<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="{rdf}">
  <rdf:Description xmlns:xcr="{NAMESPACE}" xcr:Version="3" xcr:PosePrior="exact"
    xcr:Coordinates="absolute" xcr:DistortionModel="{model}" xcr:FocalLength35mm="{p["f"]!r}"
    xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="{p["px"]!r}"
    xcr:PrincipalPointV="{p["py"]!r}" xcr:CalibrationPrior="exact" xcr:CalibrationGroup="{group}"
    xcr:DistortionGroup="{group}" xcr:InTexturing="1" xcr:InMeshing="1"
    xmlns:xmpMM="{MEDIA}" xmpMM:{OWN_NAME}={quoteattr(id)}>
   <xcr:Rotation>{numbers(R.ravel())}</xcr:Rotation>
   <xcr:Position>{numbers(X0)}</xcr:Position>
   <xcr:DistortionCoeficients>{numbers(coefficients)}</xcr:DistortionCoeficients>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
"""


# What it loses; the size of a photograph is not in the file, but that of the photograph beside it.
REALITYSCAN_LOSSES = losing(
    "pixel sizes of cameras",
    "points",
    partly={
        "names of cameras": lambda n: changed(
            [c.id for c in n.cameras], range(1, len(n.cameras) + 1)
        )
    },
)
