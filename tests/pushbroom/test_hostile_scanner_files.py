"""Whatever is in the files of a line scanner, reading ends in one line of complaint or an image."""

import json
import shutil
from functools import cache
from pathlib import Path

import pytest
from rpc_scenes import made_up
from scanner_files import write_scanner
from test_csm import support_data
from test_dimap import write_dimap
from test_xml_products import dimap, early, worldview

from jaxbundle.io.scanner.csm import read_csm
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.refinement import read_refinement
from jaxbundle.io.scanner.rpc import read_rpc, write_rpc

FLIGHT = Path(__file__).parents[2] / "examples" / "line_scanner" / "flight.toml"
REFINE = """
[refine]
points = "points.csv"
observations = "observations.csv"

[images]
A = "scanner.toml"

[unknowns]
attitude = "free"
"""
POINTS = "id,role,longitude,latitude,height\nP,control,13.1,40.2,100\nQ,control,13.2,40.1,50\n"
OBSERVATIONS = "image,point,line,pixel\nA,P,100.5,20.25\nA,Q,200,30\n"


def made(kind: str, folder: Path) -> Path:
    """A folder with a valid input of a kind, and nothing else."""
    match kind:
        case "scanner":
            write_scanner(folder)
        case "refinement":
            write_scanner(folder)
            (folder / "refine.toml").write_text(REFINE)
            (folder / "points.csv").write_text(POINTS)
            (folder / "observations.csv").write_text(OBSERVATIONS)
        case "flight":
            shutil.copy(FLIGHT, folder)
        case "csm":
            (folder / "isd.json").write_text(json.dumps(support_data(), indent=1))
        case "worldview":
            (folder / "image.xml").write_text(worldview())
        case "dimap2":
            (folder / "DIM.XML").write_text(dimap())
        case "dimap of first products":
            (folder / "DIM.XML").write_text(early())
        case "dimap":
            write_dimap(folder)
        case "rpc":
            write_rpc(folder / "image_RPC.TXT", made_up(longitude_offset=12.3))
    return folder


READ = {
    "scanner": lambda folder: read_scanner(folder / "scanner.toml"),
    "refinement": lambda folder: read_refinement(folder / "refine.toml"),
    "flight": lambda folder: read_flight(folder / "flight.toml"),
    "csm": lambda folder: read_csm(folder / "isd.json"),
    "worldview": lambda folder: read_scanner(folder / "image.xml"),
    "dimap2": lambda folder: read_scanner(folder / "DIM.XML"),
    "dimap of first products": lambda folder: read_scanner(folder / "DIM.XML"),
    "dimap": lambda folder: read_scanner(folder / "METADATA.DIM"),
    "rpc": lambda folder: read_rpc(folder / "image_RPC.TXT"),
}


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return cache(lambda kind: made(kind, tmp_path_factory.mktemp(kind)))


@pytest.mark.parametrize("kind", READ)
def test_a_valid_input_is_read(kind, valid):
    assert READ[kind](valid(kind)) is not None


def test_files_that_are_cut_off_are_said_to_be(tmp_path):
    """XML and model states that end early: the usual damage of large files."""
    from jaxbundle.errors import InputError
    from jaxbundle.io.scanner.csm_state import MODEL

    state = MODEL + "\n" + json.dumps({"m_nLines": 100, "m_quaternions": [0.25] * 40}, indent=1)
    for name, text in (("a.xml", '<isd><EPH a="1"><LIST>1 2 3</LIST></EPH></isd>'),
                       ("b.json", state), ("c.json", state.partition("\n")[2])):  # fmt: skip
        for share in (0.5, 0.8):
            (tmp_path / name).write_text(text[: int(share * len(text))])
            with pytest.raises(InputError, match="ends there: is it cut off") as told:
                read_scanner(tmp_path / name)
            assert name in str(told.value) and "\n" not in str(told.value)
