"""Orientations of MicMac: a folder `Ori-…` with a file for every image, and calibrations.

    Orientation-IMAGE.xml: OrientationConique
        OrIntImaM2C           must be the identity
        TypeProj              eProjStenope
        FileInterne           the calibration (`micmac_camera.py`), or Interne, the same inside
        Externe               Centre; ParamRotation/CodageMatr: L1, L2, L3; KnownConv
        ConvOri               KnownConv

L1, L2, L3 are the rows of the rotation from the camera frame (x right, y down, z forward) to the
world, so that R = [L1; L2; L3]ᵀ, M = D·R; Centre is X0. Calibrations are searched in the folder
and the one above. Angles (CodageAngulaire) and other conventions are refused. Tie points
(Homol) and measurements of control are in other files, which are not read.

Source: MicMac's documentation, "Orientation"; its conventions eConvApero_DistM2C, eConvOriLib.
"""

import html
import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import flip_rows
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.networks.assemble import assemble, entry_of, foreign_document, image_columns
from jaxbundle.io.networks.losses import describe_losses, losing, need_values
from jaxbundle.io.networks.micmac_camera import C2M, M2C, calibration, calibration_lines, document
from jaxbundle.io.networks.poses import check_rotations, matrices_of
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.rows import join_numbers
from jaxbundle.io.text.xml_fields import XmlFields, read_xml
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.tables import Camera, Network, Source

ORIENTATION, CALIBRATION = "Orientation-", "AutoCal_"
FILES = (f"{ORIENTATION}*.xml", f"{CALIBRATION}*.xml")
ORIENTATION_KEYS = Keys(
    (
        *("OrIntImaM2C", "TypeProj", "FileInterne", "Interne", "Externe", "ConvOri"),
        "RelativeNameFI",
    ),
    {
        **dict.fromkeys(("Verif", "ZoneUtileInPixel"), "checks by MicMac"),
        "ControleGPS": "measured positions",
    },
)
EXTERNAL_KEYS = Keys(
    ("KnownConv", "Centre", "ParamRotation"),
    {
        **dict.fromkeys(("AltiSol", "Profondeur", "Time", "VitFiable", "IncCentre"),
                        "the depth of the scene, the time, and σ"),
    },
    {"Vitesse": "one pose a photograph is read"},
)  # fmt: skip
IDENTITY = {"I00": (0.0, 0.0), "V10": (1.0, 0.0), "V01": (0.0, 1.0)}


def is_micmac(path: Path) -> bool:
    """Whether a folder has orientations of MicMac."""
    return path.is_dir() and any(path.glob(FILES[0]))


def read_micmac(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras and images of a folder, named after the files; nothing can be adjusted.

    **Raises:** `InputError` naming file and element.
    """
    path = Path(path)
    files = sorted(path.glob(FILES[0]))
    if not files:
        raise InputError(f"{path}: there is no {FILES[0]} in it")
    cameras: dict[Path, Camera] = {}
    names, camera_ids, rotations, centres = [], [], [], []
    unknown = UnknownKeys()
    for file in files:
        xml = XmlFields(file, read_xml(file), "an orientation of MicMac")
        for tag, keys in (("OrientationConique", ORIENTATION_KEYS), ("Externe", EXTERNAL_KEYS)):
            for part in xml.root.iter(tag):
                unknown.check_element(part, keys, f"{file}: {tag}")
        where, root = _calibration(file, xml)
        if where not in cameras:
            id = where.stem.removeprefix(CALIBRATION if where != file else ORIENTATION)
            # Once for all images that share it.
            cameras[where] = calibration(where, root, id)
        C2W, X0 = _pose(xml)
        names.append(file.stem.removeprefix(ORIENTATION))
        camera_ids.append(cameras[where].id)
        rotations.append(C2W.T)  # world → camera, as R of x = R·X + t
        centres.append(X0)
    images = image_columns(
        Source(str(path), None, "file"),
        names,
        camera_ids,
        flip_rows(np.array(rotations)),
        np.array(centres),
    )
    project_document = foreign_document(path.name, map(entry_of, cameras.values()), object_unit="m")
    messages = (*fit_messages(cameras.values()), *unknown.messages())
    return assemble(path, project_document, overrides, images, warnings=messages)


def _calibration(file: Path, xml: XmlFields) -> tuple[Path, ET.Element]:
    """The file of the calibration of an image, and its document."""
    if xml.find("FileInterne") is None:
        if xml.find("Interne") is None:
            raise xml.missing_error("FileInterne")
        return file, xml.root
    name = xml.text("FileInterne")
    candidates = (file.parent / name, file.parent.parent / name, file.parent / Path(name).name)
    for candidate in candidates:
        if os.path.isfile(candidate):  # also of names too long for a file
            return candidate, read_xml(candidate)
    raise InputError(f"{file}: FileInterne {name}: there is no such file beside it, nor above")


def _pose(xml: XmlFields) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The rotation from camera to world, and the projection centre."""
    kind = xml.text("TypeProj", "eProjStenope")
    external = xml.find("Externe")
    if external is None:
        raise xml.missing_error("Externe")
    external_xml = XmlFields(xml.path, external, xml.kind)
    convention = external_xml.text("KnownConv", xml.text("ConvOri/KnownConv", M2C[0]))
    for name, value, choices in (
        ("TypeProj", kind, ("eProjStenope",)),
        ("KnownConv", convention, (*M2C, *C2M)),
    ):
        if value not in choices:
            raise InputError(f"{xml.path}: {name} is {value}; expected {', '.join(choices)}")
    if xml.find("OrIntImaM2C") is not None:
        for name, expected in IDENTITY.items():
            if tuple(xml.numbers(f"OrIntImaM2C/{name}", 2)) != expected:
                raise InputError(f"{xml.path}: OrIntImaM2C must be the identity, but {name} is not")
    rows = [external_xml.numbers(f"ParamRotation/CodageMatr/L{i}", 3) for i in (1, 2, 3)]
    check_rotations(np.array(rows), f"{xml.path}: CodageMatr")
    return np.array(rows), external_xml.numbers("Centre", 3)


def write_micmac(network: Network, folder: str | Path, force: bool = False) -> tuple[str, ...]:
    """Write the orientations and calibrations of a network into a folder.

    Cameras must be of model `opencv` with one focal length, without k4 and beyond, or
    `brown-projected` or `brown` with square pixels, and have an image size.

    **Arguments:** `force`: also replace a folder not written by this function.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` where the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`).
    """
    with replace_folder(folder, "write_micmac", FILES, force) as new:
        return fill_micmac(network, new)


def fill_micmac(network: Network, folder: Path) -> tuple[str, ...]:
    """Write orientations into an existing folder or a new one; as `write_micmac`."""
    need_values(network, points=False)
    images = network.images
    for id in (*images.id, *(camera.id for camera in network.cameras)):
        # Names of files are made of them.
        if "/" in id or not id.strip("."):
            raise InputError(f"{folder}: {id!r} cannot be part of the name of a file")
    calibrations = {camera.id: document(calibration_lines(camera)) for camera in network.cameras}
    C2W = flip_rows(matrices_of(images.angles)).transpose(0, 2, 1)
    folder.mkdir(exist_ok=True)
    for id, text in calibrations.items():
        write_text(folder / f"{CALIBRATION}{id}.xml", text)
    for k, id in enumerate(images.id):
        camera = network.cameras[images.camera[k]].id
        lines = _orientation_lines(f"{CALIBRATION}{camera}.xml", C2W[k], images.position[k])
        write_text(folder / f"{ORIENTATION}{id}.xml", document(lines))
    return describe_losses(network, MICMAC_LOSSES)


# What it loses.
MICMAC_LOSSES = losing("pixel sizes of cameras", "points")


def _orientation_lines(
    file: str, C2W: Float[np.ndarray, "3 3"], X0: Float[np.ndarray, "3"]
) -> list[str]:
    rows = [f"<L{i}>{join_numbers(row)}</L{i}>" for i, row in enumerate(C2W, 1)]
    return [
        "<OrientationConique>",
        "<OrIntImaM2C>",
        *(f"<{name}>{join_numbers(values)}</{name}>" for name, values in IDENTITY.items()),
        "</OrIntImaM2C>",
        "<TypeProj>eProjStenope</TypeProj>",
        f"<FileInterne>{html.escape(file, quote=False)}</FileInterne>",
        "<RelativeNameFI>true</RelativeNameFI>",
        "<Externe>",
        f"<KnownConv>{M2C[0]}</KnownConv>",
        f"<Centre>{join_numbers(X0)}</Centre>",
        "<ParamRotation>",
        "<CodageMatr>",
        *rows,
        "</CodageMatr>",
        "</ParamRotation>",
        "</Externe>",
        "<ConvOri>",
        f"<KnownConv>{M2C[0]}</KnownConv>",
        "</ConvOri>",
        "</OrientationConique>",
    ]
