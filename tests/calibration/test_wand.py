"""Cameras by a wand of known length: truth and σ, markers without names, what cannot be."""

import numpy as np
import pytest

import jaxbundle
from jaxbundle.calibration.rig.wand import WandSettings, _told_apart
from jaxbundle.cameras import get_model, project
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network.tables import Camera

MODEL = get_model("opencv")
LENS = {"fx": 1000.0, "fy": 1000.0, "cx": 639.5, "cy": 479.5}
MARKERS = {"A": 0.0, "B": 0.15, "C": 0.5}
"""Along the stick, m."""

ANGLES = np.linspace(0, 2 * np.pi, 4, endpoint=False)
PLACES = np.stack([3 * np.cos(ANGLES), 3 * np.sin(ANGLES), 1.5 + 0.3 * np.arange(4)], 1)
STATIONS = jaxbundle.stations_looking_at(PLACES, np.array([0, 0, 1.0]))
ROTATIONS = [np.asarray(matrix_from_omega_phi_kappa(a)) for a in STATIONS.angles]
NAMES = ("c0", "c1", "c2", "c3")
PARAMETERS = {**dict.fromkeys(MODEL.parameters, 0.0), **LENS}
CAMERAS = {name: Camera(name, "opencv", PARAMETERS, (), image_size=(1280, 960)) for name in NAMES}


def waved(frames=30, seed=0, noise=0.1, markers=MARKERS, seen=lambda camera, frame: True):
    """Tables of the markers in every camera."""
    shape, rng = np.random.default_rng(5), np.random.default_rng(seed)
    middle = shape.uniform([-0.8, -0.8, 0.5], [0.8, 0.8, 1.6], (frames, 3))
    along = shape.normal(size=(frames, 3))
    along /= np.linalg.norm(along, axis=1)[:, None]
    p = tuple(CAMERAS["c0"].parameters.values())
    found = {}
    for k, name in enumerate(NAMES):
        rows = {"frame": [], "marker": [], "x": [], "y": []}
        for f in range(frames):
            for marker, place in markers.items():
                X = middle[f] + (place - 0.25) * along[f]
                uv = project(MODEL, p, *(ROTATIONS[k] @ (X - PLACES[k])))
                u, v = np.array([float(x) for x in uv]) + noise * rng.normal(size=2)
                if seen(k, f) and 0 < u < 1280 and 0 < v < 960:
                    for column, value in zip(rows.values(), (f, marker, u, v)):
                        column.append(value)
        found[name] = rows
    return found


def truth(k):
    """Base and rotation of camera k in the frame of the first."""
    return ROTATIONS[0] @ (PLACES[k] - PLACES[0]), ROTATIONS[k] @ ROTATIONS[0].T


def errors(found):
    """Errors of bases over their σ, and of rotations in radians."""
    over, turns = [], []
    for k, name in enumerate(NAMES[1:], 1):
        m, (base, R) = found.mountings[name], truth(k)
        over.append((m.base - base) / m.sigma[:3])
        turns.append(np.arccos(np.clip((np.trace(m.rotation @ R.T) - 1) / 2, -1, 1)))
    return np.array(over), np.array(turns)


@pytest.mark.further
def test_a_chain_of_cameras_by_a_wand():
    """Each frame is seen by three neighbours only, none by the first and the last camera; two
    markers with names; truth within σ, the scale from the wand: twice the length, twice the
    bases."""
    two = {"A": 0.0, "C": 0.5}
    chain = waved(60, markers=two, seen=lambda k, f: f % 2 in (k - 2, k - 1, k))
    found = jaxbundle.calibrate_wand(chain, CAMERAS, 0.5, sigma_length=1e-4, sigma_image=0.1)
    assert found.converged and 0.85 < found.adjustment.sigma0 < 1.15
    over, turns = errors(found)
    assert np.abs(over).max() < 4 and turns.max() < 2e-3
    double = jaxbundle.calibrate_wand(chain, CAMERAS, 1.0, sigma_length=2e-4, sigma_image=0.1)
    for name in NAMES[1:]:
        one, other = found.mountings[name], double.mountings[name]
        assert np.allclose(other.base, 2 * one.base, rtol=1e-6)
        assert np.isclose(other.length_sigma, 2 * one.length_sigma)
    network = found.network()
    assert network.images.id == NAMES and "c3: base" in str(found)


@pytest.mark.further
def test_a_chain_of_pairs():
    """Every frame is seen by two neighbours: of two pairs with a camera in common, only the lengths
    of the wand give the ratio of the bases."""
    two = {"A": 0.0, "C": 0.5}
    chain = waved(90, markers=two, seen=lambda k, f: f % 3 in (k - 1, k))
    found = jaxbundle.calibrate_wand(chain, CAMERAS, 0.5, sigma_length=1e-4, sigma_image=0.1)
    assert found.converged and 0.85 < found.adjustment.sigma0 < 1.15
    over, turns = errors(found)
    assert np.abs(over).max() < 4 and turns.max() < 2e-3
    # the shared camera alone does not tie them
    rows = {name: np.array(chain["c2"][name]) for name in chain["c2"]}
    rows = {name: one[rows["frame"] % 3 != 1] for name, one in rows.items()}
    with pytest.raises(jaxbundle.NotSolvedError, match="c2|c3"):
        jaxbundle.calibrate_wand({**chain, "c2": rows}, CAMERAS, 0.5, sigma_length=1e-4)


def test_markers_without_names_are_told_apart():
    """By the ratio of their distances, in every frame with three; others are counted."""
    for table in waved(noise=0.2).values():
        marks = [(str(f), m, x, y) for f, m, x, y in zip(*table.values())]
        nameless = [(f, "", x, y) for f, _, x, y in np.random.default_rng(0).permutation(
            np.array(marks, dtype=object))]  # fmt: skip
        whole = [f for f in {f for f, *_ in marks} if sum(m[0] == f for m in marks) == 3]
        pairs = {("A", "B"): 0.15, ("B", "C"): 0.35, ("A", "C"): 0.5}
        found, said = _told_apart("c0", nameless, pairs, WandSettings())
        right = {(x, y): m for _, m, x, y in marks}
        # short in the image, along the line of sight, the order is lost in the noise
        assert np.mean([right[x, y] == m for _, m, x, y in found]) > 0.97
        assert len(found) == 3 * len(whole) and bool(said) == (len(marks) != len(found))


NAMELESS = {"frame": [1, 1, 1], "x": [0.0, 1, 2], "y": [0.0, 0, 0]}


@pytest.mark.parametrize(("change", "lengths", "words"), [
    ({"c0": {"frame": [1], "x": [0.0]}}, 0.5, "column 'y' is missing"),
    ({"c0": {"frame": [1], "x": [0.0], "y": ["?"], "marker": ["A"]}}, 0.5, "expected pixels"),
    ({"c0": {"frame": [1, 1], "x": [0, 1], "y": [0, 1], "marker": "AA"}}, 0.5, "'A' is.*twice"),
    ({}, 0.5, "one is given, of two markers, but the markers are 'A', 'B', 'C'"),
    ({}, {("A", "D"): 0.5}, "no marker 'D'"),
    ({}, {("A", "B"): -0.5}, "lengths: of A and B"),
    ({}, {("A", "B", "C"): 0.5}, "expected two markers"),
    ({"c0": {"frame": [1, 1], "x": [0.0, 1], "y": [0.0, 1], "marker": ["A", ""]}}, 0.5,
     "a marker has no name"),
    ({"c0": NAMELESS}, {("A", "C"): 0.5}, "only three in a line"),
    ({"c0": NAMELESS}, {("A", "B"): 0.25, ("B", "C"): 0.25}, "half way"),
    ({"c9": NAMELESS}, 0.5, "none 'c9'"),
])  # fmt: skip
def test_what_cannot_be(change, lengths, words):
    with pytest.raises(InputError, match=words):
        jaxbundle.calibrate_wand(waved(3) | change, CAMERAS, lengths, sigma_length=1e-4)


def test_frames_that_nothing_ties():
    """No frame has both ends before two cameras."""
    apart = {n: {**t, "frame": [f"{n} {f}" for f in t["frame"]]} for n, t in waved(3).items()}
    with pytest.raises(InputError, match="no frame shows both ends"):
        jaxbundle.calibrate_wand(apart, CAMERAS, {("A", "C"): 0.5}, sigma_length=1e-4)


def test_cameras_and_lengths_of_the_command(tmp_path):
    from jaxbundle.cli.calibrate_wand import cameras_by_name, lengths_given
    from jaxbundle.io import write_cameras

    file = tmp_path / "cameras.toml"
    write_cameras([CAMERAS[name] for name in NAMES], file)
    assert list(cameras_by_name([str(file)], ["c2", "c0"])) == ["c2", "c0"]
    with pytest.raises(InputError, match="no camera 'x'; the files have 'c0', 'c1', 'c2', 'c3'"):
        cameras_by_name([str(file)], ["x"])
    assert lengths_given(["0.5"]) == 0.5
    assert lengths_given(["A,B=0.15", "B,C=0.35"]) == {("A", "B"): 0.15, ("B", "C"): 0.35}
    for bad in (["half"], ["A=0.5"], ["A,B=x"]):
        with pytest.raises(InputError, match="--length"):
            lengths_given(bad)
