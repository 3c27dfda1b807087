"""A small valid file of every format of networks and cameras, and words without end in them.

`test_mutations.py` damages all of them.
"""

import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from exchange_cases import CAMERAS, network
from foreign_samples import NVM, SAMPLES, write_sample

from jaxbundle.batches.stacks import read_camera_stack
from jaxbundle.errors import InputError
from jaxbundle.io import read_cameras, read_network, write_project
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.cameras.opencv_writing import write_opencv
from jaxbundle.io.cameras.result_json import read_calibrated
from jaxbundle.io.networks.bal import write_bal
from jaxbundle.io.networks.bundler import write_bundler
from jaxbundle.io.networks.colmap import write_colmap
from jaxbundle.io.networks.stereo import fill_ros_stereo, write_opencv_stereo
from jaxbundle.network.tables import Camera, Network

FURTHER_SAMPLES = ("opencv-xml", "opencv-json", "opencv-nested", "ros-ini", "camodocal", "orb-slam",
                   "orb-slam-pair", "euroc", "anipose", "alicevision", "metashape-lens",
                   "autocal")  # fmt: skip
EXAMPLE = Path(__file__).parents[2] / "examples" / "convergent4" / "convergent4.txt"


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """The function that gives a folder with a valid input of a kind, and nothing else."""
    return cache(lambda kind: made(kind, tmp_path_factory.mktemp(kind)))


def made(kind: str, folder: Path) -> Path:
    net, snavely = network("opencv", ("a", "b", "c")), network("snavely", ("0", "1", "2"), 0)
    match kind:
        case "colmap":
            write_colmap(net, folder)
        case "colmap-text":
            write_colmap(net, folder, text=True)
        case "bal":
            write_bal(snavely, folder / "problem.bal")
        case "bundler":
            write_bundler(network("snavely", ("a", "b", "c"), 0), folder / "bundle.out")
        case "project":
            write_project(net, folder)
        case "photo-list":
            shutil.copy(EXAMPLE, folder)
        case "opencv":
            write_opencv(CAMERAS["opencv"], folder / "camera.yaml")
        case "json":
            write_opencv(CAMERAS["opencv"], folder / "camera.json")
        case "photomodeler":
            from test_photomodeler import export

            (folder / "export.txt").write_text(export(control=((3, 0.02),)))
        case "bingo":
            from test_bingo import GEO, IMAGE

            (folder / "image.dat").write_text(IMAGE)
            (folder / "geoin.dat").write_text(GEO)
        case "metashape":
            from test_metashape import PIXEL, xml

            text = xml(transform=True).replace("<b1>", "<b2>2.5</b2><b1>")
            (folder / "cameras.xml").write_text(text.replace("<calibration", PIXEL, 1))
        case "openmvg":
            from test_openmvg import scene

            (folder / "sfm_data.json").write_text(json.dumps(scene(), indent=1))
        case "opensfm":
            from test_opensfm import files, write

            write(folder, *files(gps=True))
        case "transforms":
            from test_transforms import OPENCV, frames

            document = {**OPENCV, "frames": frames(k1=0.1)}
            (folder / "transforms.json").write_text(json.dumps(document, indent=1))
        case "kalibr":
            from test_kalibr import chain

            text = chain(("pinhole", "radtan"), ("pinhole", "equi"))
            (folder / "camchain.yaml").write_text(text)
        case "mrcal":
            from test_mrcal import model

            (folder / "left.cameramodel").write_text(model("OPENCV8"))
        case "opencv-stereo":
            from test_rigs_for_others import rig

            write_opencv_stereo(rig()[0], folder / "stereo.yaml")
        case "ros-stereo":
            from test_rigs_for_others import rig

            fill_ros_stereo(rig()[0], folder)
        case "nvm":
            (folder / "model.nvm").write_text(NVM)
        case "colmap-rigs":
            from test_colmap import FILES, FRAMES, RIGS

            for name, text in {**FILES, "rigs.txt": RIGS, "frames.txt": FRAMES}.items():
                (folder / name).write_text(text)
        case name if name in SAMPLES:
            write_sample(folder, name)
        case "rig":
            from test_rigs_for_others import result_json

            result_json(folder)
        case "micmac":
            from test_micmac import folder as oriented

            for file in oriented(folder).iterdir():
                file.rename(folder / file.name)
            (folder / "Ori-Test").rmdir()
        case "jaicov":
            from test_jaicov import write

            write(folder)
        case "column-map":
            from test_column_map import write

            write(folder)
        case "camera-stack":
            np.savez(
                folder / "cameras.npz", object_points=np.ones((4, 3)), ids=np.arange(2),
                image_points=np.ones((2, 3, 4, 2)), image_size=np.array([640, 480]),
                visible=np.ones((2, 3, 4), bool),
            )
        case "result":
            names = ("fx", "fy", "cx")
            parameter = {"value": 900.0, "sigma": 0.5, "free": True}
            camera = {
                "model": "opencv", "parameters": dict.fromkeys(names, parameter),
                "correlations": {a: dict.fromkeys(names, 0.1) for a in names},
            }
            (folder / "result.json").write_text(
                json.dumps({"converged": True, "cameras": {"cam": camera}}, indent=1)
            )
    return folder


def read(kind: str, folder: Path):
    """What a folder holds, read as this kind."""
    match kind:
        case "opencv" | "json":
            return read_cameras(next(folder.iterdir()))
        case "camera-stack":
            return [Camera(key) for key in read_camera_stack(folder / "cameras.npz").ids]
        case "result":
            return [camera for camera, _ in read_calibrated(folder / "result.json")]
        case "colmap-text" | "colmap-rigs":
            return read_network(folder, format="colmap")
        case "vins":
            return read_network(folder / "vins.yaml", format=kind)
        case name if name in FURTHER_SAMPLES:
            (file,) = folder.iterdir()
            # a damaged one may look like nothing, or like another kind
            return read_cameras(file) if is_camera_file(file) else read_network(file)
        case "colmap" | "project" | "bingo" | "opensfm" | "micmac" | "ros-stereo":
            return read_network(folder, format=kind)
        case "column-map":
            return read_network(folder / "map.toml", format=kind)
        case "jaicov":
            return read_network(folder / "project.phc", format=kind)
        case _:
            (file,) = (p for p in folder.iterdir() if p.name != "list.txt")
            settings = ["sigma_image=1"] if kind == "photo-list" else []
            return read_network(file, format=kind, overrides=settings)



KINDS = ("colmap", "colmap-text", "bal", "bundler", "project", "photo-list", "opencv", "json",
         "photomodeler", "bingo", "metashape", "openmvg", "opensfm", "transforms", "kalibr",
         "mrcal", "micmac", "jaicov", "column-map", "camera-stack", "result", "opencv-stereo",
         "ros-stereo", "rig", "nvm", "csm-frame", "colmap-rigs", "vins",
         *FURTHER_SAMPLES)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_valid_input_is_read(kind, valid):
    found = read(kind, valid(kind))
    assert isinstance(found, Network) or isinstance(found[0], Camera)


@pytest.mark.parametrize("kind, old, odd", [
    ("bal", "1000.0", "z" * 9000), ("colmap-text", "OPENCV", "Z" * 9000),
    ("colmap-text", "OPENCV", "Z/" * 4500), ("project", "opencv", "z" * 9000),
])  # fmt: skip
def test_a_word_without_end_is_cut(kind, old, odd, valid, tmp_path):
    folder = shutil.copytree(valid(kind), tmp_path / "copy")
    for file in folder.iterdir():
        file.write_text(file.read_text().replace(old, odd, 1))
    with pytest.raises(InputError) as found:
        read(kind, folder)
    assert odd[:20] in str(found.value) and len(str(found.value)) < 600


def test_names_of_files_are_not_cut():
    name = "/".join(["a" * 255, "b" * 255])
    assert str(InputError(f"{name}: no such file")).startswith(name)
