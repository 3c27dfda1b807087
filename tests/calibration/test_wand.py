"""Cameras by a wand of known length: truth and σ, markers without names, what cannot be."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import wand_scenes as scenes

import jaxbundle
from jaxbundle.calibration import WandSettings
from jaxbundle.calibration.rig.wand_images import measure_wand
from jaxbundle.calibration.rig.wand_markers import Mark, name_markers, name_three
from jaxbundle.cameras import get_model, project
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.measure import BlobSettings
from jaxbundle.measure.moving_blobs import find_still_scene
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
    """Three by the ratio of their distances, in every frame in which one triple of blobs fits, also
    with two wrong blobs in every second frame: never wrong; ambiguous frames are counted."""
    pairs = {("A", "B"): 0.15, ("B", "C"): 0.35, ("A", "C"): 0.5}
    rng = np.random.default_rng(0)
    for name, table in waved(noise=0.2).items():
        marks = [Mark(str(f), m, x, y) for f, m, x, y in zip(*table.values())]
        wrong = [
            Mark(str(f), "", *rng.uniform(0, [1280, 960])) for f in range(0, 30, 2) for _ in "12"
        ]
        shuffled = [
            (marks + wrong)[k]._replace(marker="") for k in rng.permutation(len(marks + wrong))
        ]
        whole = [f for f in {m.frame for m in marks} if sum(m.frame == f for m in marks) == 3]
        found, said = name_three(name, shuffled, CAMERAS[name], pairs, WandSettings())
        right = {(m.x, m.y): m.marker for m in marks}
        assert all(right.get((m.x, m.y)) == m.marker for m in found)
        assert len(found) > 0.75 * 3 * len(whole)
        assert (len({m.frame for m in shuffled}) - len(found) // 3 > 0) == bool(said)


@pytest.mark.further
def test_two_markers_that_look_alike():
    """Their rays tell which is which in all cameras of a frame; a camera whose frames are not
    simultaneous agrees with none."""
    ends = {("right", "left"): 0.5}
    two = {"A": 0.0, "C": 0.5}
    rng = np.random.default_rng(0)
    given = {}
    for name, table in waved(40, markers=two).items():
        marks = [Mark(str(f), m, x, y) for f, m, x, y in zip(*table.values())]
        given[name] = [marks[k] for k in rng.permutation(len(marks))]
    right = {(m.x, m.y): m.marker for own in given.values() for m in own}
    nameless = {name: [m._replace(marker="") for m in own] for name, own in given.items()}
    found, _ = name_markers(nameless, CAMERAS, ends, WandSettings())
    by_frame = {}
    for own in found.values():
        for m in own:
            by_frame.setdefault(m.frame, set()).add((m.marker, right[m.x, m.y]))
    # the same end has the same name in all cameras of a frame
    assert len(by_frame) > 35 and all(len(names) == 2 for names in by_frame.values())
    assert {m.marker for own in found.values() for m in own} == {"left", "right"}
    late = [m._replace(frame=str((int(m.frame) + 7) % 40)) for m in nameless["c3"]]
    again, said = name_markers(nameless | {"c3": late}, CAMERAS, ends, WandSettings())
    assert not again["c3"] and again["c0"] and "do not tell the two markers apart" in said[0]


def test_another_wand_is_said():
    """Lengths that no frame fits: the ratio that the markers have is said, within perspective."""
    marks = [Mark(str(f), "", x, y) for f, _, x, y in zip(*waved()["c0"].values())]
    for pairs in ({("A", "B"): 0.1, ("B", "C"): 0.4}, {("A", "B"): 0.05, ("A", "C"): 0.5}):
        with pytest.raises(InputError, match=r"as 1 : \d+\.00; those in a line are at 1 : 2\."):
            name_three("c0", marks, CAMERAS["c0"], pairs, WandSettings())


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
    ({"c0": NAMELESS}, {("A", "C"): 0.5}, "rays of no two cameras"),
    ({"c0": NAMELESS}, {("A", "B"): 0.5, ("B", "C"): 0.2, ("A", "C"): 0.2}, "half way"),
    ({"c0": {"frame": [1], "x": [0.0], "y": [0.0], "sx": [-1.0]}}, 0.5, "expected a positive σ"),
    ({"c0": {"frame": [], "x": [], "y": []}}, 0.5, "no markers"),
    ({"c0": NAMELESS}, {("A", "B"): 0.25, ("B", "C"): 0.25}, "half way"),
    ({"c9": NAMELESS}, 0.5, "none 'c9'"),
])  # fmt: skip
def test_what_cannot_be(change, lengths, words):
    with pytest.raises(InputError, match=words):
        jaxbundle.calibrate_wand(waved(3) | change, CAMERAS, lengths, sigma_length=1e-4)


SMALL = (480, 360)
SMALL_CAMERAS = {
    name: dataclasses.replace(
        camera,
        parameters={**camera.parameters, "fx": 375.0, "fy": 375.0, "cx": 239.5, "cy": 179.5},
        image_size=SMALL,
    )
    for name, camera in CAMERAS.items()
}


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A wand of three markers before two cameras: photographs of one, a video of the other; and
    where the markers are."""
    home, rng, ends = tmp_path_factory.mktemp("wand"), np.random.default_rng(1), scenes.wave(24)
    (home / "c0").mkdir()
    video = cv2.VideoWriter(str(home / "c1.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 30, SMALL, True)
    truth = {}
    for k, name in enumerate(NAMES[:2]):
        truth[name] = scenes.markers_in_images(
            SMALL_CAMERAS[name], ROTATIONS[k], PLACES[k], ends, [0, 0.3, 1]
        )
        for f, uv in enumerate(truth[name]):
            grey = scenes.render_frame(uv, SMALL, rng, radius=2.5)
            if name == "c0":
                cv2.imwrite(str(home / "c0" / f"frame_{f:06d}.png"), grey)
            else:
                video.write(np.repeat(grey[..., None], 3, axis=2))
    video.release()
    return home, truth


def test_markers_in_images(filmed):
    """Every marker of photographs and of a video has the right name and frame, and a centre within
    its σ; lamps are no markers."""
    home, truth = filmed
    given = {"c0": home / "c0", "c1": home / "c1.avi"}
    pairs = {("A", "B"): 0.15, ("B", "C"): 0.35, ("A", "C"): 0.5}
    found, _ = measure_wand(given, SMALL_CAMERAS, {}, BlobSettings())
    named, _ = name_markers(found, SMALL_CAMERAS, pairs, WandSettings())
    for name, marks in named.items():
        assert len(marks) > 0.6 * 72
        right = np.array([truth[name][int(m.frame), "ABC".index(m.marker)] for m in marks])
        off = np.array([(m.x, m.y) for m in marks]) - right
        over = off / np.array([(m.sx, m.sy) for m in marks])
        assert np.abs(off).max() < 0.15 and 0.8 < np.sqrt((over**2).mean()) < 1.25


def test_images_that_cannot_be(filmed, tmp_path):
    home, _ = filmed
    for change, words in (
        ({"c1": home / "c0" / "frame_000003.png"}, "'c1': 1 frame; expected three or more"),
        ({"c1": [home / "c0" / "frame_000003.png"] * 3}, "'c1': 1 frame;"),
        ({"c1": tmp_path / "none.mp4"}, "none.mp4: no such file"),
        ({"c1": tmp_path}, "no photographs in this folder"),
    ):
        with pytest.raises(InputError, match=words):
            measure_wand({"c0": home / "c0"} | change, SMALL_CAMERAS, {}, BlobSettings())
    with pytest.raises(InputError, match="480 × 360 pixels, its interior orientation is of 1280"):
        measure_wand({"c0": home / "c0", "c1": home / "c1.avi"}, CAMERAS, {}, BlobSettings())
    still = np.full((90, 120), 50, np.uint8)
    with pytest.raises(InputError, match="nothing moves"):
        find_still_scene([still] * 4, BlobSettings())


@pytest.mark.further
def test_a_wand_in_images(filmed, tmp_path, command):
    """Photographs, a video and a table of markers in one calibration: truth within σ; what was
    measured is written, and gives the same again."""
    from jaxbundle.io import write_cameras

    home, _ = filmed
    rng, uv = np.random.default_rng(2), scenes.markers_in_images(
        SMALL_CAMERAS["c2"], ROTATIONS[2], PLACES[2], scenes.wave(24), [0, 0.3, 1]
    )
    rows = [
        f"{f},{x},{y},0.02,0.02"
        for f, of_frame in enumerate(uv + 0.02 * rng.normal(size=uv.shape))
        for x, y in rng.permutation(of_frame)
    ]
    (tmp_path / "c2.csv").write_text("\n".join(["frame,x,y,sx,sy", *rows]))
    given = [f"c0={home / 'c0'}", f"c1={home / 'c1.avi'}", f"c2={tmp_path / 'c2.csv'}"]
    write_cameras([SMALL_CAMERAS[name] for name in NAMES[:3]], tmp_path / "cameras.toml")
    lengths = ["--length", "A,B=0.15", "--length", "B,C=0.35", "--length", "A,C=0.5"]
    rest = ["--cameras", tmp_path / "cameras.toml", *lengths, "--sigma-length", "1e-5"]
    said = command("calibrate-wand", *given, *rest, "--out", tmp_path / "out")
    assert said.status == 0, said.err
    found = json.loads((tmp_path / "out" / "result.json").read_text())
    assert 0.8 < found["adjustment"]["sigma0"] < 1.25
    for k, name in enumerate(NAMES[1:3], 1):
        m, (base, _) = found["mountings"][name], truth(k)
        sigma = np.sqrt(np.diag(m["covariance"]))[:3]
        assert np.abs((np.array(m["base"]) - base) / sigma).max() < 4
    # the folder is its own: written again
    assert command("calibrate-wand", *given, *rest, "--out", tmp_path / "out").status == 0
    written = [f"{name}={tmp_path / 'out' / 'markers' / name}.csv" for name in NAMES[:3]]
    again = command("calibrate-wand", *written, *rest, "--json", tmp_path / "again.json")
    assert again.status == 0, again.err
    again = json.loads((tmp_path / "again.json").read_text())
    for name in NAMES[1:3]:
        one, other = (np.array(f["mountings"][name]["base"]) for f in (found, again))
        assert np.allclose(one, other, atol=1e-9)


def test_frames_that_nothing_ties():
    """No frame has both ends before two cameras."""
    apart = {n: {**t, "frame": [f"{n} {f}" for f in t["frame"]]} for n, t in waved(3).items()}
    with pytest.raises(InputError, match="no frame shows both ends"):
        jaxbundle.calibrate_wand(apart, CAMERAS, {("A", "C"): 0.5}, sigma_length=1e-4)


def test_cameras_and_lengths_of_the_command(tmp_path):
    from jaxbundle.cli.calibrate_wand import cameras_by_name, lengths_given, sigma_of_length
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
    assert sigma_of_length(None, "m") == 1e-4 and sigma_of_length(None, "mm") == 0.1
    assert sigma_of_length(0.5, "inch") == 0.5
    with pytest.raises(InputError, match="--sigma-length: .*inch"):
        sigma_of_length(None, "inch")
