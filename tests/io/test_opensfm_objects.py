"""Objects of OpenSfM in memory. OpenSfM is on no index: its two functions that are called, whose
names and results are those of its source (`opensfm/io.py`, `pymap.TracksManager`), stand in."""

import json
import sys
from types import ModuleType, SimpleNamespace

import pytest
from exchange_cases import assert_same, network

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.io.networks.opensfm_writing import write_opensfm

NAMES = ("a.jpg", "b.jpg", "c d.jpg")


class Tracks:
    def __init__(self, text):
        self.text = text

    def as_string(self):
        return self.text


@pytest.fixture
def objects(tmp_path, monkeypatch):
    """A reconstruction and its tracks, as OpenSfM has read them from files."""
    before = network("opencv", NAMES)
    write_opensfm(before, tmp_path / "opensfm")
    (document,) = json.loads((tmp_path / "opensfm" / "reconstruction.json").read_text())
    reconstruction = SimpleNamespace(**document)
    module = ModuleType("opensfm.io")
    module.reconstructions_to_json = lambda found: [vars(one) for one in found]
    monkeypatch.setitem(sys.modules, "opensfm", ModuleType("opensfm"))
    monkeypatch.setitem(sys.modules, "opensfm.io", module)
    return before, reconstruction, Tracks((tmp_path / "opensfm" / "tracks.csv").read_text())


def test_the_objects_are_the_network(objects):
    before, reconstruction, tracks = objects
    found = jaxbundle.from_opensfm(reconstruction, tracks)
    assert_same(before, found)
    assert found.name == "reconstruction"
    free = jaxbundle.from_opensfm(reconstruction, tracks, ["free=fx,k1"])
    assert free.cameras[0].free == ("fx", "k1")
    alone = jaxbundle.from_opensfm(reconstruction)
    assert len(alone.images) == 3 and not len(alone.observations)
    (said,) = [text for text in alone.warnings if "no image points" in text]
    assert said.startswith("reconstruction/tracks.csv")


def test_other_objects_and_a_machine_without_opensfm(objects, monkeypatch):
    _, reconstruction, tracks = objects
    with pytest.raises(InputError, match="expected an opensfm.types.Reconstruction, got int"):
        jaxbundle.from_opensfm(3)
    with pytest.raises(InputError, match="expected an opensfm.pymap.TracksManager, got dict"):
        jaxbundle.from_opensfm(reconstruction, {})
    with pytest.raises(InputError, match="^reconstruction.*there are no shots"):
        reconstruction.shots = {}
        jaxbundle.from_opensfm(reconstruction, tracks)
    monkeypatch.setitem(sys.modules, "opensfm.io", None)
    with pytest.raises(InputError, match="OpenSfM is needed"):
        jaxbundle.from_opensfm(reconstruction, tracks)
