"""The rule of keys: a further key in any keyed format is a warning that names it; one that may
change the geometry is refused."""

import dataclasses
import json
import shutil

import pytest
from exchange_cases import network
from foreign_samples import JSON, SAMPLES, SCANNERS, XML, places, write_sample

from jaxbundle.errors import InputError
from jaxbundle.io import read_cameras, read_network
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.networks.micmac import write_micmac
from jaxbundle.io.networks.opensfm_writing import write_opensfm
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.text.known_keys import Keys, UnknownKeys, may_change_geometry

GEOMETRY = (
    "distortion_extra", "skew2", "roi_x", "binning_z", "image_scale", "pixelOffset", "transform2",
    "lens_model", "lengthUnit", "y_sign", "frame_origin", "K9", "p7", "imagescale", "crop", "flipY",
)  # fmt: skip
HARMLESS = ("vendor_remark", "android", "design", "grayscale", "original_name", "community")


def messages(path, scanner=False) -> tuple[str, ...]:
    """What reading a file tells."""
    if scanner:
        return read_scanner(path).warnings
    if is_camera_file(path):
        return fit_messages(read_cameras(path))
    return read_network(path).warnings


@pytest.mark.parametrize("name", SAMPLES)
def test_a_harmless_key_is_named_and_a_geometric_one_refused(tmp_path, name):
    told = lambda *key: messages(write_sample(tmp_path, name, *key), name in SCANNERS)
    file = SAMPLES[name][0]
    assert not any("unknown key" in message for message in told())
    for place in range(places(name)):
        found = [t for t in told("vendor_remark", place) if "unknown key 'vendor_remark'" in t]
        assert found and all(file in message for message in found)
        with pytest.raises(InputError, match=rf"{file}.*unknown key 'lens_offset'.*geometry"):
            told("lens_offset", place)


FOLDERS = {
    "micmac": (*[(f"Orientation-{n}.xml", tag, XML) for n in "ac" for tag in
                 ("<OrientationConique>", "<Externe>")],
               ("AutoCal_1.xml", "<CalibrationInternConique>", XML)),
    "opensfm": (("ground_control_points.json", '{"points": [{', JSON),
                ("ground_control_points.json", '"position": {', JSON),
                ("ground_control_points.json", '"observations": [{', JSON)),
}  # fmt: skip
"""Files of folders, and behind what a key may stand."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A folder of each kind."""
    made = {"micmac": tmp_path_factory.mktemp("m") / "Ori-x",
            "opensfm": tmp_path_factory.mktemp("o") / "opensfm"}  # fmt: skip
    (camera,) = network("opencv").cameras
    square = dataclasses.replace(camera, parameters={**camera.parameters, "fy": 1000.0})
    net = network("opencv", ("a", "b", "c")).replace(cameras=(square,))
    write_micmac(net, made["micmac"])
    write_opensfm(net, made["opensfm"])
    reference = {"latitude": 47.3, "longitude": 8.5, "altitude": 400.0}
    (made["opensfm"] / "reference_lla.json").write_text(json.dumps(reference))
    seen = [{"shot_id": name, "projection": [0.01, 0.02]} for name in "abc"]
    point = {"id": "g", "position": reference, "observations": seen}
    control = made["opensfm"] / "ground_control_points.json"
    control.write_text(json.dumps({"points": [point]}))
    return made


@pytest.mark.parametrize(
    "kind, k", [(kind, k) for kind, files in FOLDERS.items() for k in range(len(files))]
)
def test_keys_of_the_files_of_a_folder(tmp_path, folders, kind, k):
    name, behind, form = FOLDERS[kind][k]
    folder = shutil.copytree(folders[kind], tmp_path / folders[kind].name)
    file = next(folder.glob(name))
    text = file.read_text()
    assert behind in text and not any("unknown" in t for t in read_network(folder).warnings)
    added = lambda key: text.replace(behind, behind + form.format(key=key), 1)
    file.write_text(added("vendor_remark"))
    told = [t for t in read_network(folder).warnings if "unknown key 'vendor_remark'" in t]
    assert told and name in told[0]
    file.write_text(added("lens_offset"))
    with pytest.raises(InputError, match=f"{name}.*unknown key 'lens_offset'.*geometry"):
        read_network(folder)


def test_the_words_of_geometry():
    assert not [name for name in GEOMETRY if not may_change_geometry(name)]
    assert not [name for name in HARMLESS if may_change_geometry(name)]


def test_one_message_a_key():
    unknown, keys = UnknownKeys(), Keys(("a",), {"b*": "x"}, {"c": "of no use here"})
    for place in range(3):
        unknown.check(("a", "bb", "c", "d"), keys, f"row {place}")
    assert unknown.messages() == (
        "row 0: c is not read: of no use here (there, and in 2 more places)",
        "row 0: unknown key 'd' is not read (there, and in 2 more places)",
    )


@pytest.mark.parametrize("arguments", [
    ("camera", "{}"), ("convert", "{}", "{}.toml"), ("convert", "{}", "{}transforms.json"),
])  # fmt: skip
def test_the_user_sees_it(command, tmp_path, arguments):
    path = write_sample(tmp_path, "opencv", "vendor_remark")
    told = command(*(word.format(path) for word in arguments))
    assert told.status == 0 and "unknown key 'vendor_remark' is not read" in told.err
