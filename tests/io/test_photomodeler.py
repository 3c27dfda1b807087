"""PhotoModeler's text export: a file written here from a known network, and broken ones."""

import numpy as np
import pytest
from exchange_cases import ANGLES, CAMERAS, POINTS, POSITION, assert_same, network
from numpy.testing import assert_allclose

from jaxbundle.errors import InputError
from jaxbundle.io.photomodeler import is_photomodeler, read_photomodeler

BROWN = CAMERAS["brown"]
NAMES = ("a.jpg", "b.jpg", "c.jpg")


def export(control=(), size=" 1280 720", folder="e:\\photos\\", sigma="0.10000") -> str:
    """The network of `exchange_cases` as the program would export it."""
    net, p = network("brown", NAMES), BROWN.parameters
    xs, ys = 6.4, 3.6
    inner = (p["c"], p["x0"] + xs / 2, ys / 2 - p["y0"], xs, ys, p["K1"], p["K2"], 0.0, p["P1"],
             p["P2"])  # fmt: skip
    join = lambda *values: " ".join(repr(float(v)) for v in values)
    lines = ["Bundle Soln test", f" 0.0005 20{size}", join(*[1.0] * 9), join(*inner),
             join(*[0.0] * 10)]  # fmt: skip
    for i, name in enumerate(NAMES):
        omega, phi, kappa = np.degrees(ANGLES[i])
        lines += [f"  {i} {folder}{name}", f"  {i} {join(*POSITION[i], kappa, phi, omega)}",
                  f"  {i} {join(*[0.01] * 6)}", "", f"  {i} {join(*inner)}",
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
    return read_photomodeler(path, overrides)


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
    assert "held as fixed: '5'" in net.warnings[0]


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


BROKEN = {
    "title": ("Bundle Soln test\n", "", "tolerance|values|number"),
    "photograph": ("  1 e:\\photos\\b", "  x e:\\photos\\b", "number of a photograph is 'x'"),
    "order": ("  1 1.6 ", "  2 1.6 ", "orientation of photograph 1 is expected, not of 2"),
    "NaN": ("-1.5 -0.2 4.0", "-1.5 nan 4.0", "line 7: Y is 'nan'"),
    "format": (" 6.4 3.6 ", " 0.0 3.6 ", "format .* must be positive"),
    "unknown photo": ("\n 2 12 ", "\n 7 12 ", "photograph 7 does not exist; there are 3"),
    "short ray": (" 0.10000 0.10000\n", "\n", "2 values where 4 are expected"),
    "id": ("\n 1 ", "\n one ", "is 'one'; a whole number"),
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


def test_points_it_does_not_list_are_found_from_its_orientations(tmp_path):
    from jaxbundle import orient

    lines = export().splitlines()
    net = read(tmp_path, "\n".join(line for line in lines if not line.startswith((" 3 ", " 8 "))))
    lost = [net.points.id.index(id) for id in ("3", "8")]
    assert np.isnan(net.points.position[lost]).all() and "'3', '8'" in net.warnings[-1]
    found = orient(net).network
    at = [found.points.id.index(id) for id in ("3", "8")]
    assert_allclose(found.points.position[at], POINTS[[2, 7]], atol=1e-6)
