"""Control networks of ISIS as text, and jigsaw's residuals, written here by their documentation."""

import numpy as np
import pytest
from isis_samples import GOOD, HEAD, RESIDUALS, measure, point
from rpc_block import SIGMA_CONTROL, block
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.io.scanner.isis_points import read_control_network, read_jigsaw_residuals
from jaxbundle.io.scanner.refinement import read_refinement
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.refinement import refine

SERIAL = "WV03/SENSOR/123456789.000"
TEXT = """
[refine]
observations = "network.pvl"
sigma = 0.4

[images]
A = "left_RPC.TXT"
B = "middle_RPC.TXT"
right = "r.RPB"

[serial_numbers]
A = "{SERIAL}:0"
B = "{SERIAL}:1"

[unknowns]
bias_degree = 1
bias = [6.0, 0.8]
"""
def serial_of(k):
    return f"{SERIAL}:{k}" if k < 2 else "right"


def network(points, observations, covariance):
    """The text of a network of the points and measurements of a block."""
    rays = {}
    for i, p, xy in zip(observations.image, observations.point, observations.xy.tolist()):
        rays.setdefault(p, []).append(measure(serial_of(i), *xy))
    kinds = {"tie": "Free", "control": "Constrained"}
    body = [point(points.id[p], kinds[points.role[p]], points.X[p].tolist(),
                  covariance if points.role[p] == "control" else None, measures)
            for p, measures in rays.items()]  # fmt: skip
    return HEAD + "".join(body) + "End_Object\nEnd\n"


@pytest.fixture(scope="module")
def scene():
    scene = block(rpc=3, scanner=0, points=30, control=6, checks=0, degree=1, rays=3)
    (_, points, observations), _ = scene.draw(np.random.default_rng(2))
    return scene, points, observations


@pytest.fixture
def folder(scene, tmp_path):
    for one, name in zip(scene[0].images, ("left_RPC.TXT", "middle_RPC.TXT", "r.RPB")):
        write_rpc(tmp_path / name, one.image.rpc)
    points = scene[1]
    # tie points have no coordinates: what a network says of them is no observation
    X = np.where(np.isfinite(points.X), points.X, 1.0)
    given = type(points)(points.id, points.role, X, points.sigma, points.axes, points.axis_names)
    text = network(given, scene[2], SIGMA_CONTROL**2 * np.eye(3))
    (tmp_path / "network.pvl").write_text(text)
    (tmp_path / "refine.toml").write_text(TEXT.replace("{SERIAL}", SERIAL))
    return tmp_path


def test_a_network_gives_its_points_and_measurements(scene, folder):
    _, points, observations = scene
    file = read_refinement(folder / "refine.toml")
    assert any("RMS 0.4 lines, 0.3 samples" in words for words in file.warnings)
    row = [points.id.index(id) for id in file.points.id]
    assert sorted(row) == list(range(len(points.id))) and file.points.role.count("control") == 6
    for k, p in enumerate(row):
        assert file.points.role[k] == points.role[p]
        if points.role[p] == "control":
            np.testing.assert_allclose(file.points.X[k], points.X[p], rtol=1e-15)
            np.testing.assert_allclose(file.points.sigma[k], SIGMA_CONTROL, rtol=1e-12)
        else:
            # tie points have none
            assert np.isnan(file.points.X[k]).all()
    of = lambda o, names: sorted(
        (int(i), names[p], *xy) for i, p, xy in zip(o.image, o.point, np.asarray(o.xy).tolist())
    )
    np.testing.assert_allclose(
        np.array([r[2:] for r in of(file.observations, file.points.id)]),
        np.array([r[2:] for r in of(observations, points.id)]), rtol=1e-14,
    )  # fmt: skip
    assert [r[:2] for r in of(file.observations, file.points.id)] == [
        r[:2] for r in of(observations, points.id)
    ]


@pytest.mark.further
def test_a_network_gives_the_refinement_of_its_points(scene, folder):
    _, points, observations = scene
    file = read_refinement(folder / "refine.toml")
    found = refine(file.images, file.points, file.observations)
    direct = refine(file.images, points, observations)
    np.testing.assert_allclose(found.estimate, direct.estimate, atol=1e-5)
    np.testing.assert_allclose(found.inspection.sigma, direct.inspection.sigma, rtol=1e-5)


def test_comments_and_null(tmp_path):
    """What a network does not have is as missing; line numbers stay those of the file."""
    more = """
      LineSigma      = Null   # of no use
      SampleSigma    = NULL <pixels>
      /* two lines,
         Line = 99 */
      ChooserName    = "text with # and /* in it"
"""
    text = HEAD + point("P", "Free", [1e6, 2e6, 3e6], None, [measure("s", 4.0, 7.0, more)])
    text = text.replace("AprioriX = 1000000.0 <meters>", "AprioriX = Null /* unknown */")
    path = tmp_path / "one.net"
    path.write_text(text + "End_Object\nEnd\n")
    found = read_control_network(path)
    np.testing.assert_allclose(found.xy, [[4.0, 7.0]])
    assert np.isnan(found.xy_sigma).all() and np.isnan(found.X).any()
    row = text.splitlines().index("      SerialNumber   = s") + 1
    assert found.ray_row.tolist() == [row]
    path.write_text(text.replace("Line           = 5.0", "Line = Null") + "End_Object\nEnd\n")
    with pytest.raises(InputError, match="a measure without LINE"):
        read_control_network(path)


def test_a_covariance_becomes_sigma_along_its_axes(tmp_path):
    R = Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix()
    C = R @ np.diag([4.0, 9.0, 0.01]) @ R.T
    path = tmp_path / "one.net"
    constrained = point("P", "Constrained", [1e6, 2e6, 3e6], C, [measure("s", 4.0, 7.0)])
    fixed = point("F", "Fixed", [1.0, 2.0, 3.0], None, [])
    path.write_text(HEAD + constrained + fixed + "End_Object\nEnd\n")
    found = read_control_network(path)
    np.testing.assert_allclose(found.covariance[0], C, rtol=1e-12)
    assert not found.covariance[1].any() and found.role == ["control", "control"]
    # sample 8, line 5 are counted from 1
    np.testing.assert_allclose(found.xy, [[4.0, 7.0]])
    assert np.isnan(found.xy_sigma).all() and found.image == [("s",)]
    np.testing.assert_allclose(found.X[0], [1e6, 2e6, 3e6])


def test_sigma_axes_of_control_points_are_those_of_the_covariance(folder):
    text = (folder / "network.pvl").read_text()
    R = Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix()
    C = R @ np.diag([0.25, 0.36, 0.81]) @ R.T
    six = [repr(float(v)) for v in C[np.triu_indices(3)]]
    old = text.split("AprioriCovarianceMatrix = (")[1].split(")")[0]
    (folder / "network.pvl").write_text(text.replace(old, ", ".join(six)))
    points = read_refinement(folder / "refine.toml").points
    for k, role in enumerate(points.role):
        if role == "control":
            axes, sigma = points.axes[k], points.sigma[k]
            np.testing.assert_allclose(axes.T @ np.diag(sigma**2) @ axes, C, rtol=1e-9)


def test_what_is_ignored_or_rejected_is_left_out_and_told(tmp_path):
    rejected, ignored = "\n      JigsawRejected = Yes", "\n      Ignore = True"
    measures = [measure("s", 1.0, 2.0), measure("t", 3.0, 4.0, rejected),
                measure("u", 5.0, 6.0, ignored)]  # fmt: skip
    path = tmp_path / "n.pvl"
    path.write_text(HEAD + point("P", "Free", [0.0] * 3, None, measures) + "End_Object\nEnd\n")
    found = read_control_network(path)
    assert found.image == [("s",)]
    assert "1 measurement ignored" in found.messages[0]
    assert "1 measurement rejected by jigsaw" in found.messages[1]


def test_residuals_of_jigsaw_are_measurements(scene, folder):
    _, points, observations = scene
    rows = [
        f"{points.id[p]},/data/{name}.cub,{serial_of(i)},  0.10,  0.20,{x + 1!r},{y + 1!r},"
        "  0.3,  -0.4,  0.5" for i, p, (y, x), name in
        zip(observations.image, observations.point, observations.xy.tolist(),
            np.array(["left", "middle", "r"])[observations.image])
    ]  # fmt: skip
    rejected = f"{points.id[0]},/data/left.cub,s,0,0,1.0,1.0,9.0,9.0,12.7,*"
    (folder / "residuals.csv").write_text(RESIDUALS + "\n".join([*rows, rejected]) + "\n")
    found = read_jigsaw_residuals(folder / "residuals.csv")
    np.testing.assert_allclose(found.xy, observations.xy, atol=1e-9)
    assert "1 measurement rejected" in found.messages[0] and "0.4 lines" in found.messages[1]
    text = (folder / "refine.toml").read_text()
    text = text.replace('"network.pvl"', '"residuals.csv"')
    text = "\n".join(line for line in text.splitlines() if SERIAL not in line)
    (folder / "refine.toml").write_text(text)
    file = read_refinement(folder / "refine.toml")
    # by the names of their files, without serial numbers; control is none
    assert len(file.observations) == len(observations) and set(file.points.role) == {"tie"}
    np.testing.assert_array_equal(file.observations.image, observations.image)


@pytest.mark.parametrize("text, words", [
    (GOOD, "CONTROLNETWORK is not closed"), (GOOD.split("Group")[0], "is not closed"),
    (GOOD.replace("Constrained", "Loose") + "End_Object\nEnd\n", "PointType 'Loose'"),
    (GOOD.replace("AprioriX =", "Apriori =") + "End_Object\nEnd\n", "without AprioriX"),
    (GOOD.replace("<meters>", "<degrees>") + "End_Object\nEnd\n", "expected meters"),
    (GOOD.replace("(1.0, 0.0", "(-1.0, 0.0") + "End_Object\nEnd\n", "negative eigenvalue"),
    (GOOD.replace("(1.0, 0.0", "(0.0, 0.0") + "End_Object\nEnd\n", "no error in one direction"),
    (GOOD.replace("End_Group", "") + "End_Object\nEnd\n", "END_OBJECT without a beginning"),
    (GOOD.replace("(1.0, ", "(") + "End_Object\nEnd\n", "has 5 numbers"),
    (GOOD.replace("Line           = 5.0", "Line = five") + "End_Object\nEnd\n", "line 28: LINE"),
    (GOOD.replace("SerialNumber", "Serial") + "End_Object\nEnd\n", "without SERIALNUMBER"),
    (GOOD + GOOD.removeprefix(HEAD) + "End_Object\nEnd\n", "'P' occurs twice"),
    (GOOD.replace("Version      = 5", "Version = 1") + "End_Object\nEnd\n", "version 1"),
    (HEAD + "End_Object\nEnd\n", "no control point"), ("", "no control point"),
    ("Object = ProtoBuffer\n  Object = Core\n", "binary control network.*cnetbin2pvl"),
    (GOOD.replace("PointId   = P", "PointId") + "End_Object\nEnd\n", "NAME = value"),
])  # fmt: skip
def test_damaged_networks_are_refused_by_line(text, words, tmp_path):
    path = tmp_path / "network.pvl"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as refused:
        read_control_network(path)
    assert "network.pvl" in str(refused.value) and "\n" not in str(refused.value)


def test_damaged_residuals_are_refused_by_line(tmp_path):
    path = tmp_path / "residuals.csv"
    row = "P,/data/left.cub,s,0,0,1.0,1.0,9.0,9.0,12.7"
    for text, words in ((f"{row},1,2", "line 4: 12 fields"), (row.replace("1.0", "x", 1), "line 4"),
                        ("", "no measurement")):  # fmt: skip
        path.write_text(RESIDUALS + text)
        with pytest.raises(InputError, match=words):
            read_jigsaw_residuals(path)


def test_serial_numbers_of_no_image_are_refused(folder):
    text = (folder / "refine.toml").read_text()
    (folder / "refine.toml").write_text(text.replace('A = "WV03', 'C = "WV03'))
    with pytest.raises(InputError, match=r"\[serial_numbers\].*C: no such image"):
        read_refinement(folder / "refine.toml")
    (folder / "refine.toml").write_text(text.replace(f"{SERIAL}:1", f"{SERIAL}:0"))
    with pytest.raises(InputError, match="by which A is known already"):
        read_refinement(folder / "refine.toml")
    (folder / "refine.toml").write_text(text.replace(f'A = "{SERIAL}:0"\n', ""))
    told = read_refinement(folder / "refine.toml").warnings
    assert any("not in [images]" in words and "serial_numbers" in words for words in told)
