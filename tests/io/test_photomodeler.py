"""PhotoModeler's text export: a file written here from a known network, and broken ones."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from exchange_cases import ANGLES, CAMERAS, POINTS, POSITION, assert_same, network
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.networks.photomodeler import is_photomodeler
from jaxbundle.io.networks.photomodeler_points import PhotoModelerBlock, renumber_smart

BROWN = CAMERAS["brown"]
NAMES = ("a.jpg", "b.jpg", "c.jpg")
SHARED = Path(__file__).parents[3] / "shared" / "data" / "photomodeler"


SIZE = (6.4, 3.6)
PRECISE = (5.00023, 3.21037, 1.82018, *SIZE, 2.0041e-3, -1.047e-6, 0.0, 1.0047e-4, -5.0021e-5)
"""A camera whose digits the line of a photograph does not have."""
JOINED = lambda *values: " ".join(repr(float(v)) for v in values)


def rounded(inner) -> str:
    """A camera as the program writes it for every photograph."""
    return " ".join(f"{v:.{3 if k < 3 else 5}f}" for k, v in enumerate(inner))


def export(
    control=(), size=" 1280 720", folder="e:\\photos\\", sigma="0.10000", inner=None, of_photo=None
) -> str:
    """The network of `exchange_cases` as the program would export it."""
    net, p, join = network("brown", NAMES), BROWN.parameters, JOINED
    xs, ys = SIZE
    inner = inner or (p["c"], p["x0"] + xs / 2, ys / 2 - p["y0"], xs, ys, p["K1"], p["K2"], 0.0,
                      p["P1"], p["P2"])  # fmt: skip
    lines = ["Bundle Soln test", f" 0.0005 20{size}", join(*[1.0] * 9), join(*inner),
             join(*[0.0] * 10)]  # fmt: skip
    for i, name in enumerate(NAMES):
        omega, phi, kappa = np.degrees(ANGLES[i])
        lines += [f"  {i} {folder}{name}", f"  {i} {join(*POSITION[i], kappa, phi, omega)}",
                  f"  {i} {join(*[0.01] * 6)}", "",
                  f"  {i} {of_photo(inner) if of_photo else join(*inner)}",
                  f"  {i} {join(*[0.0] * 10)}"]  # fmt: skip
    lines.append("")
    lines += [f" {k} {join(*POINTS[k - 1], *[s] * 3)}" for k, s in control] + [""]
    lines += [f" {k + 1} {join(*X, *[0.01] * 3)}" for k, X in enumerate(POINTS)] + [""]
    u = net.observations.xy / [0.005, -0.005] + [640, 360]
    lines += [f" {i} {k + 1} {join(*uv)} {sigma} {sigma}" for i, k, uv in
              zip(net.observations.image, net.observations.point, u)]  # fmt: skip
    lines += ["", "  1    1      2 ", "", "   0    1", ""]
    return "\n".join(lines)


def read(tmp_path, text, overrides=()):
    path = tmp_path / "export.txt"
    path.write_bytes(text.encode("latin-1"))
    assert is_photomodeler(path) == text.startswith("Bundle Soln")
    return read_network(path, format="photomodeler", overrides=overrides)


def test_the_network_comes_back(tmp_path):
    net = read(tmp_path, export())
    assert_same(network("brown", NAMES), net)
    assert net.cameras[0].image_size == (1280, 720) and net.datum == "inner"
    assert_allclose(net.cameras[0].pixel_size, (0.005, 0.005))
    assert_allclose(net.observations.sigma, 0.1 * 0.005)
    assert net.residuals == "corrected" and net.image_unit == "px"


def test_control_points_weighted_and_held(tmp_path):
    net = read(tmp_path, export(control=((3, 0.02), (5, -0.8))))
    assert net.datum == "control"
    roles = dict(zip(net.points.id, net.points.role))
    assert (roles["3"], roles["5"], roles["1"]) == ("control", "fixed", "tie")
    assert_allclose(net.points.sigma[net.points.id.index("3")], 0.02)
    assert "held as fixed: '5'" in " ".join(net.notes)


def test_size_of_the_image_from_the_command_line(tmp_path):
    with pytest.raises(InputError, match="line 2 has no image size.*camera.cam.image_size"):
        read(tmp_path, export(size=""))
    net = read(tmp_path, export(size=""), ["camera.cam.image_size=1280,720", "free=c"])
    assert_same(network("brown", NAMES), net)
    assert net.cameras[0].free == ("c",)


def test_matched_points_have_the_default_sigma_and_names_may_be_latin(tmp_path):
    net = read(tmp_path, export(sigma="0.0", folder="e:\\Größe\\"), ["sigma_image=0.5"])
    assert_allclose(net.observations.sigma, 0.5 * 0.005)
    assert net.images.id == NAMES


def test_two_cameras(tmp_path):
    lines = export().splitlines()
    row = next(k for k, line in enumerate(lines) if line.startswith("  2 5.0"))
    lines[row] = lines[row].replace("  2 5.0", "  2 5.5")
    net = read(tmp_path, "\n".join(lines))
    assert [c.id for c in net.cameras] == ["cam1", "cam2"]
    assert net.cameras[1].parameters["c"] == 5.5 and list(net.images.camera) == [0, 0, 1]


def test_the_header_has_the_digits_that_photographs_round(tmp_path):
    """K2 = −1.047e-6 stands as 0.00000 in the line of a photograph."""
    net = read(tmp_path, export(inner=PRECISE, of_photo=rounded))
    assert [camera.id for camera in net.cameras] == ["cam"]
    p = net.cameras[0].parameters
    assert (p["c"], p["K1"], p["K2"], p["P1"]) == (5.00023, 2.0041e-3, -1.047e-6, 1.0047e-4)
    assert_allclose((p["x0"], p["y0"]), (3.21037 - 3.2, 1.8 - 1.82018), rtol=1e-12)


def test_a_photograph_with_another_camera_keeps_its_own(tmp_path):
    """Half a unit of the last decimal and a little more is another camera; what its digits leave
    open in the corner of the image is told: 5e-6·r⁵ of K2, r = 3.67 mm, is 0.67 px."""
    lines = export(inner=PRECISE, of_photo=rounded).splitlines()
    row = next(k for k, line in enumerate(lines) if line.startswith("  1 5.000 "))
    lines[row] = "  1 5.001 3.210 1.820 6.40000 3.60000 0.00200 -0.00010 0.00000 0.00010 -0.00005"
    net = read(tmp_path, "\n".join(lines))
    assert list(net.images.camera) == [0, 1, 0]
    assert [c.parameters["c"] for c in net.cameras] == [5.00023, 5.001]
    assert net.cameras[0].parameters["K2"] == -1.047e-6 and net.cameras[1].parameters["K1"] == 0.002
    (told,) = [w for w in net.warnings if "rounds camera" in w]
    assert "'cam2'" in told and "K2 to 0.67 px" in told
    net = read(tmp_path, "\n".join(lines), ["camera.cam2.free=K2,K1,P1"])
    assert not [w for w in net.warnings if "rounds camera" in w]


def smart(text: str) -> str:
    """The export with its points 9 to 12 found by matching, with ids that run through those of the
    points marked by hand: 2, 3, 14, 15."""
    ids, lines = {"9": "2", "10": "3", "11": "14", "12": "15"}, text.splitlines()
    for k, line in enumerate(lines):
        words = line.split()
        if line.startswith(" ") and len(words) == 7 and words[0] in ids:
            lines[k] = " ".join(["", ids[words[0]], *words[1:]])
        if line.startswith(" ") and len(words) == 6 and words[1] in ids and words[-1] == "0.10000":
            lines[k] = " ".join(["", words[0], ids[words[1]], *words[2:4], "0.00000", "0.00000"])
    return "\n".join(lines)


def test_smart_points_whose_ids_are_taken_are_renumbered(tmp_path):
    net, plain = read(tmp_path, smart(export())), network("brown", NAMES)
    ids = ["1", "2", "3", "4", "5", "6", "7", "8", "102", "103", "14", "15"]
    assert list(net.points.id) == ids
    assert_same(plain, net.replace(points=dataclasses.replace(net.points, id=plain.points.id)))
    told = " ".join(net.warnings)
    assert "2 smart points" in told and "2 is 102, 3 is 103" in told


def test_a_repeated_id_that_is_no_smart_point_is_refused(tmp_path):
    text = smart(export()).replace("0.00000 0.00000\n", "0.10000 0.10000\n")
    with pytest.raises(InputError, match="point '2' is already in"):
        read(tmp_path, text)


def renumbered(listed, marked):
    """Ids of object points and of image points, those of smart points with a minus."""
    objects = PhotoModelerBlock(
        [str(k) for k in listed], np.zeros((len(listed), 6)), [*range(len(listed))]
    )
    values = np.array([[1.0, 1.0, *[float(k > 0)] * 2] for k in marked])
    marks = PhotoModelerBlock([str(abs(k)) for k in marked], values, [*range(len(marked))])
    renumber_smart(Path("export.txt"), objects, marks)
    return [[int(id) for id in block.id] for block in (objects, marks)]


@pytest.mark.parametrize("listed, marked, objects, marks", [
    ([5, 3, 7, 3, 8], [5, 3, 7, -3, -8], [5, 3, 7, 13, 8], [5, 3, 7, 13, 8]),
    ([1, 5, 5, 6], [1, 5, -5, -6], [1, 5, 15, 6], [1, 5, 15, 6]),
    ([1, 2, 3, 2, 20, 3], [1, 2, 3, -2, -20, -3], [1, 2, 3, 102, 20, 103],
     [1, 2, 3, 102, 20, 103]),
    # listed once: after a smart point, before a point marked by hand, after the descent
    ([1, 2, 4, 5], [1, 2, 5, -4, -5], [1, 2, 4, 15], [1, 2, 5, 4, 15]),
    ([1, 5, 6, 7], [1, 5, 6, -5, -7], [1, 5, 6, 7], [1, 5, 6, 15, 7]),
    ([1, 7, 2, 3], [1, 2, 7, -7, -2, -3], [1, 7, 12, 3], [1, 2, 7, 17, 12, 3]),
])  # fmt: skip
def test_which_of_the_points_of_an_id_is_the_smart_one(listed, marked, objects, marks):
    assert renumbered(listed, marked) == [objects, marks]


@pytest.mark.parametrize("listed, marked, message", [
    ([1, 2, 2, 2], [1, 2, -2], "line 3: point '2' is in the object points 3 times"),
    ([1, 5, 6], [1, 5, -5, -6], "line 1: point '5' has image points .* once"),
    ([9, 5, 1], [1, 5, -5, -9], "line 1: point '5' has image points .* once"),
])  # fmt: skip
def test_an_id_whose_point_cannot_be_told_is_refused(listed, marked, message):
    with pytest.raises(InputError, match=message):
        renumbered(listed, marked)


def in_windows(lines):
    return b"\xef\xbb\xbf" + "\r\n".join(lines).encode()


def with_commas(lines):
    comma = [line if ":\\" in line else line.replace(".", ",") for line in lines[1:]]
    return "\n".join([lines[0], *comma]).encode()


def photograph_skipped(lines):
    """Numbers 0, 1, 5."""
    rows = [k < 23 or len(line.split()) == 6 for k, line in enumerate(lines)]
    return "\n".join(re.sub("^( +)2 ", r"\g<1>5 ", line) if row else line
                     for row, line in zip(rows, lines)).encode()  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [in_windows, with_commas, photograph_skipped, lambda lines: "\n".join(["", *lines]).encode()],
)
def test_what_other_systems_make_of_it(tmp_path, change):
    text = export(inner=PRECISE, of_photo=rounded)
    (tmp_path / "plain.txt").write_text(text)
    (tmp_path / "export.txt").write_bytes(change(text.splitlines() + [""]))
    assert (tmp_path / "export.txt").read_bytes() != text.encode()
    net = read_network(tmp_path / "export.txt")
    assert_same(read_network(tmp_path / "plain.txt"), net, atol=0)


def test_photographs_without_orientation(tmp_path):
    lines = export().splitlines()
    for start in ("  1 1.6", "  2 0.1"):
        row = next(k for k, line in enumerate(lines) if line.startswith(start))
        lines[row] = f"  {start.split()[0]} " + "0.000 " * 6
    net = read(tmp_path, "\n".join(lines))
    assert np.isnan(net.images.position).any(1).tolist() == [False, True, True]
    assert np.isnan(net.images.angles).any(1).tolist() == [False, True, True]


def test_adjusted_control_is_told_with_the_remedy(tmp_path):
    path = tmp_path / "export.txt"
    path.write_text(export(control=((3, 0.02), (5, -0.8))))
    (told,) = [w for w in read_network(path).warnings if "a posteriori" in w]
    assert "1 control point with adjusted" in told and "--control FILE" in told
    path.write_text(export(control=((5, -0.8),)))
    assert not [w for w in read_network(path).warnings if "a posteriori" in w]


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder ../shared/data is not here")
def test_sigma0_of_a_real_export():
    """The Damped Bundle Adjustment Toolbox reports 1.78095; rounded cameras give 1.78908."""
    network = read_network(SHARED / "fixed-no-orient.txt")
    assert jaxbundle.adjust(network).sigma0 == pytest.approx(1.78095, abs=5e-6)


BROKEN = {
    "title": ("Bundle Soln test\n", "", "tolerance|values|number"),
    "photograph": ("  1 e:\\photos\\b", "  x e:\\photos\\b", "number of a photograph is 'x'"),
    "order": ("  1 1.6 ", "  2 1.6 ", "orientation of photograph 1, not of 2"),
    "NaN": ("-1.5 -0.2 4.0", "-1.5 nan 4.0", "line 7: Y is 'nan'"),
    "format": (" 6.4 3.6 ", " 0.0 3.6 ", "format .* must be positive"),
    "unknown photo": ("\n 2 12 ", "\n 7 12 ", "photograph 7 does not exist; there are 3, 0 to 2"),
    "short ray": (" 0.10000 0.10000\n", "\n", "2 values where 4 are expected"),
    "id": ("\n 1 ", "\n one ", "is 'one'; expected a whole number"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files(tmp_path, name):
    old, new, message = BROKEN[name]
    text = export()
    assert old in text
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, text.replace(old, new) if name == "format" else text.replace(old, new, 1))
    assert "export.txt" in str(caught.value)


@pytest.mark.parametrize("share", np.linspace(0.0, 0.95, 15))
def test_cut_off(tmp_path, share):
    text = export()
    cut = text[: int(share * len(text))]
    end = cut.rfind("\n")
    for part in (cut, cut[: max(end, 0)]):
        with pytest.raises(InputError, match="export.txt"):
            read(tmp_path, part)


@pytest.mark.further
def test_points_it_does_not_list_are_found_from_its_orientations(tmp_path):
    from jaxbundle import orient

    lines = export().splitlines()
    net = read(tmp_path, "\n".join(line for line in lines if not line.startswith((" 3 ", " 8 "))))
    lost = [net.points.id.index(id) for id in ("3", "8")]
    assert np.isnan(net.points.position[lost]).all() and "'3', '8'" in " ".join(net.warnings)
    found = orient(net).network
    at = [found.points.id.index(id) for id in ("3", "8")]
    assert_allclose(found.points.position[at], POINTS[[2, 7]], atol=1e-6)
