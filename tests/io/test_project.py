"""The project format: meaning, refusals, and writing as the inverse of reading."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from jaxbundle.commands.cameras import open_camera
from jaxbundle.errors import InputError
from jaxbundle.io import read_network, read_project, write_opencv, write_project
from jaxbundle.io.formats import FORMATS
from jaxbundle.io.networks.settings import CAMERA_KEYS, SETTINGS, TABLES, apply_overrides
from jaxbundle.io.writing.folders import MARKER
from jaxbundle.network.build import (
    CAMERA_FIELDS,
    DISTANCE_COLUMNS,
    IMAGE_COLUMNS,
    IMAGE_SIGMAS,
    OBSERVATION_COLUMNS,
    OBSERVATION_SIGMAS,
    POINT_COLUMNS,
    POINT_SIGMAS,
    make_cameras,
    make_network,
)
from jaxbundle.network.check import check_network
from jaxbundle.network.tables import DATUMS, RESIDUAL_DOMAINS, ROLES, Camera
from jaxbundle.network.units import ANGLE_UNITS, IMAGE_UNITS

ROOT = Path(__file__).parents[2]
CASES = ROOT.parent / "shared" / "cases"

FILES = {
    "project.toml": """\
[project]
name = "small"
object_unit = "m"
image_unit = "mm"
angle_unit = "deg"
sigma_image = 0.01
datum = "control"
residuals = "corrected"
images = "images.csv"
points = "points.csv"
observations = "observations.csv"
distances = "distances.csv"

[[camera]]
id = "cam.1"
model = "brown"
c = 50.0
free = ["c", "K1"]
sigma = { c = 0.1 }
""",
    "images.csv": """\
# a comment
id,camera,X0,Y0,Z0,omega,phi,kappa,sX0
left,cam.1,0,0,50,0,0,0,0.5

right,cam.1,10,0,50,0,0,90,fixed
""",
    "points.csv": """\
id,role,X,Y,Z,sX,sY,sZ
a,control,0,0,0,0.1,0.1,free
b,fixed,10,0,1,,,
c,fixed,0,10,2,,,
d,fixed,10,10,0,,,
"e, far",tie,5,5,0,,,
""",
    "observations.csv": """\
image,point,x,y,sx,sy
left,a,0,0,,
left,b,10,0,,
left,c,0,10,0.02,0.02
left,d,10,10,,
left,"e, far",5,5,,
right,a,0,10,,
right,b,0,0,,
right,c,10,10,,
right,d,10,0,,
right,"e, far",5,5,,
""",
    "distances.csv": """\
from,to,value,sigma
a,"e, far",7.07,0.01
""",
}


@pytest.fixture
def folder(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def edit(folder, name, old, new):
    text = (folder / name).read_text(encoding="utf-8")
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")


def assert_same(a, b, rtol=0.0):
    """The same tables and settings; places and warnings are not compared."""
    assert a.cameras == b.cameras
    for table in ("images", "points", "observations", "distances"):
        for name, value in vars(getattr(a, table)).items():
            other = getattr(getattr(b, table), name)
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(other, value, rtol=rtol, atol=0)
            elif name != "source":
                assert value == other
    for field in dataclasses.fields(a):
        value = getattr(a, field.name)
        if isinstance(value, str) or field.name == "datum_points":
            assert value == getattr(b, field.name)


def test_what_the_project_says(folder):
    network = read_project(folder / "project.toml")
    assert str(network).startswith("Network 'small': 1 camera(s), 2 images, 5 points, 10 image")
    camera = network.cameras[0]
    assert (camera.id, camera.free, camera.sigma) == ("cam.1", ("c", "K1"), {"c": 0.1})
    np.testing.assert_allclose(network.images.angles[1], [0, 0, np.pi / 2])
    np.testing.assert_array_equal(network.images.sigma[:, 0], [0.5, 0])
    assert np.isposinf(network.points.sigma[0, 2])
    assert network.points.id[4] == "e, far"
    np.testing.assert_array_equal(network.observations.sigma[:3, 0], [0.01, 0.01, 0.02])
    assert network.images.source(1) == f"{folder / 'images.csv'}, line 5"
    assert network.warnings == ()
    assert check_network(network).warnings == ()


def test_overrides(folder):
    network = read_project(folder / "project.toml", [
        "sigma_image=0.5", "datum=inner", "datum_points=b, c", "residuals = measured",
        "camera.cam.1.c=51", "camera.cam.1.free=c,x0", "camera.cam.1.sigma.x0=0.2",
        "camera.cam.1.image_size=100,200", "name=other",
    ])  # fmt: skip
    assert network.observations.sigma[0, 0] == 0.5
    assert (network.datum, network.residuals, network.name) == ("inner", "measured", "other")
    assert network.datum_points == ("b", "c")
    camera = network.cameras[0]
    assert (camera.parameters, camera.free) == ({"c": 51.0}, ("c", "x0"))
    assert (camera.sigma, camera.image_size) == ({"c": 0.1, "x0": 0.2}, (100, 200))
    assert read_project(folder / "project.toml", ["free=c,K2", "camera.cam.1.sigma.c=1"]).cameras[
        0].free == ("c", "K2")


def test_settings_of_all_cameras():
    cameras = [{"id": "a", "c": 5.0, "free": ["K1"]}, {"id": "b", "c": 6.0}]
    opencv = {"id": "c", "model": "opencv", "fx": 1.0, "fy": 1.0}
    document = {"project": {}, "camera": [*cameras, opencv]}
    of = lambda *overrides: apply_overrides(document, overrides)["camera"]
    assert [c["free"] for c in of("free=c,K1")] == [["c", "K1"]] * 3
    assert [c["free"] for c in of("camera.*.free=c", "camera.b.free=K2")] == [["c"], ["K2"], ["c"]]
    made = of("camera.*.image_size=100,200", "camera.*.sigma.K1=0.1", "camera.*.c=7")
    assert all(c["image_size"] == [100, 200] and c["sigma"] == {"K1": 0.1} for c in made)
    assert [c["c"] for c in made] == [7.0] * 3
    assert document["camera"][:2] == cameras
    star = {"project": {}, "camera": [{"id": "*"}, {"id": "b"}]}
    assert apply_overrides(star, ["camera.*.c=1"])["camera"] == [{"id": "*", "c": 1.0}, {"id": "b"}]
    with pytest.raises(InputError, match="camera 'c': free names the unknown parameter 'c'"):
        make_cameras(of("free=c,K1"))
    with pytest.raises(InputError, match=r"no such camera; known: .*camera.\*.PARAMETER"):
        of("camera.d.c=1")


@pytest.mark.parametrize("override, said", [
    ("sigma", "expected KEY=VALUE"),
    (f"images={'a' * 300}.csv", "no such file"),
    ("sigm_image=1", "unknown key; known: name, .*sigma_image.*camera.ID.PARAMETER"),
    ("sigm_image=1", r"did you mean 'sigma_image'\?"),
    ("antena.sigma.ax=1", r"antenna.KEY.*did you mean 'antenna.sigma.ax'\?"),
    ("kamera.*.c=1", r"did you mean 'camera\.\*\.c'\?"),
    ("sigma_image=small", "'small' is not a number"),
    ("sigma_image=-1", "sigma_image is -1.0; it must be finite and positive"),
    ("camera.cam.c=1", "no such camera; known: camera.cam.1.PARAMETER"),
    ("camera.cam.1.K8=1", "camera 'cam.1': unknown key 'K8'"),
    ("camera.cam.1.id=b", "cannot be set"),
    ("camera.cam.1.c=long", "'long' is not a number"),
    ("datum=none", "datum must be one of"),
])  # fmt: skip
def test_a_bad_override_is_refused(folder, override, said):
    with pytest.raises(InputError, match=said):
        read_project(folder / "project.toml", [override])


@pytest.mark.parametrize("name, old, new, said", [
    ("project.toml", "datum =", "datun =", "project.toml, [project]: unknown key 'datun'; did you"),
    ("project.toml", '"control"', '"contrl"', "[project]: datum must be one of control, inner"),
    ("project.toml", '"deg"', '"degrees"', "angle_unit must be one of rad, deg, gon"),
    ("project.toml", "0.01", '"0.01"', "[project]: sigma_image is '0.01'; expected a number"),
    ("project.toml", "0.01", "0", "[project]: sigma_image is 0; it must be finite and positive"),
    ("project.toml", "0.01", "1" + "0" * 400, "too large a number; expected finite numbers"),
    ("project.toml", "0.01", "1" + "0" * 5000, "too large a number"),
    ("project.toml", "0.01", "[" * 3000 + "]" * 3000, "line 6: not valid TOML: nested too"),
    ("project.toml", "c = 50.0", "c = 5" + "0" * 400, "line 17: not valid TOML: too large"),
    ("project.toml", "c = 0.1", "c = 1" + "0" * 400, "line 19: not valid TOML: too large"),
    ("project.toml", '"images.csv"', f'"{"a" * 300}.csv"', "[project]: images = 'aaa"),
    ("project.toml", 'name = "small"', "name = 5", "[project]: name is 5; expected text in quotes"),
    ("project.toml", 'name = "small"', "datum_points = 1", "datum_points must be a list of ids"),
    ("project.toml", 'name = "small"', "name = small", "not valid TOML"),
    ("project.toml", "[project]", "[projekt]", "unknown key 'projekt'; did you mean 'project'?"),
    ("project.toml", "[project]", "", "unknown key 'name'"),
    ("project.toml", "[[camera]]", "[camera]", "write [[camera]] in double brackets"),
    ("project.toml", '"images.csv"', '"imgs.csv"', "images = 'imgs.csv': no such file"),
    ("project.toml", 'images = "images.csv"', "", "[project]: images is missing; give images ="),
    ("project.toml", '"images.csv"', "3", "images is 3; expected the name of a file"),
    ("project.toml", '"brown"', '"braun"', "camera 'cam.1': unknown model 'braun'; did you mean"),
    ("project.toml", '"K1"', '"k1"', "camera 'cam.1': free names the unknown parameter 'k1'; did"),
    ("project.toml", "c = 50.0", "", "camera 'cam.1':"),
    ("project.toml", "c = 50.0", 'c = "50"', "camera 'cam.1': c is '50'; expected a number"),
    ("images.csv", "phi", "fhi", "images.csv: unknown column 'fhi'; did you mean 'phi'?"),
    ("images.csv", ",sX0", ",X0", "images.csv, line 2: the column 'X0' occurs twice"),
    ("images.csv", "10,0,50", "10,abc,50", "images.csv, line 5: Y0 is 'abc'; expected a number"),
    ("images.csv", "right,cam.1", "right,cam", "images.csv, line 5: camera 'cam' is unknown"),
    ("images.csv", "right,cam.1", "left,cam.1", "line 5: image 'left' is already in"),
    ("images.csv", ",fixed", "", "images.csv, line 5: 8 cells where the header has 9"),
    ("points.csv", "role,", "", "points.csv, line 2: 8 cells where the header has 7"),
    ("points.csv", "b,fixed,10,", "b,fixed,nan,", "points.csv, line 3: X is 'nan'; expected a num"),
    ("points.csv", "free", "inf", "points.csv, line 2: sZ is 'inf'; expected a number or 'free'"),
    ("points.csv", "b,fixed", ",fixed", "points.csv, line 3: id is missing"),
    ("points.csv", '"e, far"', '"e, far', "points.csv: not a CSV table"),
    ("observations.csv", "left,b,10,", "left,B,10,", "observations.csv, line 3: point 'B' is unkn"),
    ("observations.csv", "left,b,10,0", "left,b,10,", "observations.csv, line 3: y is missing"),
    ("observations.csv", "left,b,10,0", "left,b,1O,0", "line 3: x is '1O'; expected a number"),
    ("observations.csv", "image,point,x,y,sx,sy", "image;point;x;y", "separate the columns by com"),
    ("distances.csv", "value", "length", "distances.csv: unknown column 'length'"),
    ("distances.csv", "0.01", "", "distances.csv, line 2: sigma is missing"),
])  # fmt: skip
def test_a_fault_in_a_file_is_refused_with_its_place(folder, name, old, new, said):
    edit(folder, name, old, new)
    with pytest.raises(InputError) as error:
        read_project(folder / "project.toml")
    assert said in str(error.value)
    assert str(folder) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name, old, new, said", [
    ("images.csv", "right,cam.1,10", "right,cam.1,", "line 5: image 'right': X0 has a σ but no"),
    ("images.csv", "90,fixed", "900,fixed", "images.csv, line 5: image 'right': kappa is 900 deg"),
    ("points.csv", "5,5,0", "5,5,", "points.csv, line 6: tie point 'e, far': Z has no start value"),
    ("points.csv", "b,fixed", "b,fxed", "points.csv, line 3: point 'b': role must be one of"),
    ("points.csv", "0.1,0.1,free", "0.1,,free", "line 2: control point 'a': σ of Y is missing"),
    ("observations.csv", "0.02,0.02", "0.02,-3", "line 4: σ of y of point 'c' in image 'left' is"),
    ("observations.csv", "left,b,10", "left,a,10", "line 3: point 'a' in image 'left' is alre"),
    ("distances.csv", "7.07", "0", "distances.csv, line 2: distance 'a' to 'e, far': value is 0"),
])  # fmt: skip
def test_a_fault_in_a_value_is_refused_with_its_place(folder, name, old, new, said):
    edit(folder, name, old, new)
    with pytest.raises(InputError) as error:
        check_network(read_project(folder / "project.toml"))
    assert said in str(error.value) and str(folder / name) in str(error.value)


def test_files_that_cannot_be_read(folder):
    (folder / "points.csv").write_bytes("id,role\nä,tie\n".encode("latin-1"))
    with pytest.raises(InputError, match="points.csv, line 2: not UTF-8 text"):
        read_project(folder / "project.toml")
    (folder / "points.csv").write_text("# nothing\n\n")
    with pytest.raises(InputError, match="points.csv: the file is empty"):
        read_project(folder / "project.toml")
    (folder / "points.csv").write_text("id,role,X,Y,Z\n")
    with pytest.raises(InputError, match="points.csv: the table is empty"):
        read_project(folder / "project.toml")
    with pytest.raises(InputError, match="nowhere.toml: no such file"):
        read_project(folder / "nowhere.toml")


def test_a_byte_order_mark_is_no_part_of_the_header(folder):
    text = (folder / "points.csv").read_text()
    (folder / "points.csv").write_text("\ufeff" + text, encoding="utf-8")
    assert len(read_project(folder).points) == 5


def test_tables_in_the_project_file_itself(folder):
    files = read_project(folder)
    edit(folder, "project.toml", 'distances = "distances.csv"\n', "")
    text = '\n[[distance]]\nfrom = "a"\nto = "e, far"\nvalue = 7.07\nsigma = 0.01\n'
    (folder / "project.toml").write_text((folder / "project.toml").read_text() + text)
    assert_same(read_project(folder), files)
    edit(folder, "project.toml", 'to = "e, far"', 'to = "f"')
    with pytest.raises(InputError, match=r"project.toml \[\[distance\]\], entry 1: to 'f' is unkn"):
        read_project(folder)
    edit(folder, "project.toml", 'name = "small"', 'distances = "distances.csv"')
    with pytest.raises(InputError, match="give either distances = 'distances.csv' or"):
        read_project(folder)


def test_an_override_of_a_sigma_that_is_no_table_is_refused(folder):
    edit(folder, "project.toml", "sigma = { c = 0.1 }", "sigma = 5")
    with pytest.raises(InputError, match="--set camera.cam.1.sigma.c: sigma of the camera is 5; e"):
        read_project(folder, ["camera.cam.1.sigma.c=1"])


@pytest.mark.parametrize("id, X, said", [
    ('"a"', "1" + "0" * 400, "line 23: not valid TOML: too large"),
    ('"a"', "true", "entry 1: X is True; expected a number"),
    ("inf", "0", "point 'a' is unknown"),
])  # fmt: skip
def test_odd_values_in_the_project_file_are_refused(folder, id, X, said):
    edit(folder, "project.toml", 'points = "points.csv"\n', "")
    text = (folder / "project.toml").read_text()
    text += f'\n[[point]]\nid = {id}\nrole = "tie"\nX = {X}\nY = 0\nZ = 0\n'
    (folder / "project.toml").write_text(text)
    with pytest.raises(InputError) as error:
        read_project(folder)
    assert said in str(error.value) and len(str(error.value)) < 300 + 2 * len(str(folder))


def test_only_ends_of_lines_end_a_line(folder):
    """Separators that Unicode knows may stand in an id; LF, CR LF and CR end a line."""
    edit(folder, "points.csv", '"e, far"', '"e,\u2028far"')
    edit(folder, "distances.csv", '"e, far"', '"e,\u2028far"')
    text = (folder / "observations.csv").read_text().replace("e, far", "e,\u2028far")
    (folder / "observations.csv").write_text(text.replace("\n", "\r"), newline="")
    text = (folder / "images.csv").read_text()
    (folder / "images.csv").write_text(text, newline="\r\n")
    network = read_project(folder)
    assert network.points.id[4] == "e,\u2028far"
    assert network.images.source(1).endswith("images.csv, line 5")
    assert len(network.observations) == 10


def test_blanks_about_the_id_of_a_camera_go(folder):
    edit(folder, "project.toml", '"cam.1"', '" cam.1 "')
    camera = read_project(folder, ["camera.cam.1.c=51"]).cameras[0]
    assert (camera.id, camera.parameters["c"]) == ("cam.1", 51.0)


def test_the_default_sigma_is_told(folder):
    edit(folder, "project.toml", "sigma_image = 0.01\n", "")
    network = read_project(folder)
    assert network.warnings == (
        "18 image coordinates of 20 without σ: theirs is 1 mm, beside those given; give "
        "sigma_image",
    )
    assert network.observations.sigma_origin == "unit"
    assert network.observations.sigma[0, 0] == 1.0


def test_writing_and_reading_gives_the_same_network(folder, tmp_path):
    network = read_project(folder, ["angle_unit=rad"])
    path = write_project(network.warn("look\nhere"), tmp_path / "new" / "copy")
    assert path == tmp_path / "new" / "copy" / "project.toml"
    assert_same(read_project(path), network)
    assert path.read_text().startswith("# look here\n[project]\n")
    assert {p.name for p in path.parent.iterdir()} == {*FILES, MARKER}


@pytest.mark.parametrize("unit", ["deg", "gon"])
def test_angles_are_written_in_the_unit_of_the_project(folder, tmp_path, unit):
    network = read_project(folder, [f"angle_unit={unit}"])
    assert_same(read_project(write_project(network, tmp_path / "copy")), network, rtol=1e-15)


def test_awkward_ids_and_pixels_survive(tmp_path):
    network = make_network(
        [{"id": 'c "1"', "c": 50.0, "image_size": [4001, 3000], "pixel_size": [0.005, 0.004]}],
        [{"id": "#1", "camera": 'c "1"', "X0": 1e-7, "Y0": 1 / 3, "Z0": 1e22, "omega": None,
          "phi": 0.1, "kappa": -3.0}],
        [{"id": "ü, 1", "role": "control", "X": 1 / 7, "Y": 0, "Z": -0.0, "sX": 1e-3,
          "sY": "free", "sZ": 2}],
        [{"image": "#1", "point": "ü, 1", "x": 17.3, "y": 2999.1}],
        image_unit="px", datum="inner", datum_points=["ü, 1"], name='a \\ "name"',
    )  # fmt: skip
    copy = read_project(write_project(network, tmp_path))
    assert_same(copy, network, rtol=1e-14)
    text = (tmp_path / "observations.csv").read_text(encoding="utf-8")
    assert text.splitlines()[1].startswith('"#1","ü, 1",')
    assert float(text.splitlines()[1].split(",")[3].strip('"')) == pytest.approx(17.3, abs=1e-12)


def test_nothing_is_written_when_something_cannot_be(folder, tmp_path):
    network = make_network(
        [{"id": "c", "model": "opencv", "fx": 9.0, "fy": 9.0}],
        [{"id": "i", "camera": "c", "X0": 0, "Y0": 0, "Z0": 0, "omega": 0, "phi": 0, "kappa": 0}],
        [{"id": "p", "role": "tie", "X": 0, "Y": 0, "Z": 0}],
        [{"image": "i", "point": "p", "x": 0, "y": 0}],
        image_unit="px",
    )  # fmt: skip
    with pytest.raises(InputError, match="pixel_size is needed"):
        write_project(network.replace(image_unit="mm"), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
    with pytest.raises(InputError, match="project.toml: cannot be made"):
        write_project(network, folder / "project.toml")


def test_the_kind_of_input_is_recognised(folder):
    assert read_network(folder).name == "small"
    assert read_network(folder / "project.toml", overrides=["name=x"]).name == "x"
    for name in ("none.toml", 300 * "a", "a\0b"):
        with pytest.raises(InputError, match="no such file or folder"):
            read_network(folder / name)
    camera = folder / "camera.yaml"
    write_opencv(Camera("a", "opencv", {"fx": 9.0, "fy": 9.0}, image_size=(8, 6)), camera)
    with pytest.raises(InputError, match="contains only cameras, without images and points"):
        read_network(camera)
    for name, what in (("opencv", "contains only a camera"), ("ply", "is written only")):
        with pytest.raises(InputError, match=f"--format {name}: {what}"):
            read_network(camera, format=name)
    with pytest.raises(InputError, match="not recognised; known formats"):
        read_network(folder / "points.csv")
    with pytest.raises(InputError, match="unknown format 'toml'; known: project, photo-list"):
        read_network(folder, format="toml")
    assert list(FORMATS)[:2] == ["project", "photo-list"]


DOCS = ROOT / "docs" / "project.md"


def test_the_project_of_the_documentation(tmp_path):
    """Its files can be adjusted as they stand there; its row of a table can be added to them."""
    text = DOCS.read_text(encoding="utf-8")
    first, row, _ = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "project.toml").write_text(first, encoding="utf-8")
    for name, content in re.findall(r"`(\w+\.csv)`:\n\n```text\n(.*?)```", text, re.DOTALL):
        (tmp_path / name).write_text(content, encoding="utf-8")
    network = check_network(read_project(tmp_path, ["free=c", "sigma_image=0.003"]))
    assert network.warnings == ()
    assert [len(network.images), len(network.points), len(network.observations)] == [2, 6, 12]
    points = "".join(row.replace('"7"', f'"{id}"') for id in [*network.points.id])
    edit(tmp_path, "project.toml", 'points = "points.csv"\n', "")
    with (tmp_path / "project.toml").open("a", encoding="utf-8") as file:
        file.write(points)
    assert np.isposinf(read_project(tmp_path).points.sigma[:, 2]).all()


def test_the_documentation_names_everything():
    text = DOCS.read_text(encoding="utf-8")
    columns = (*IMAGE_COLUMNS, *IMAGE_SIGMAS, *POINT_COLUMNS, *POINT_SIGMAS, *OBSERVATION_COLUMNS,
               *OBSERVATION_SIGMAS, *DISTANCE_COLUMNS)  # fmt: skip
    for name in (*SETTINGS, *TABLES, *CAMERA_FIELDS, *CAMERA_KEYS, *columns, *ROLES, *FORMATS):
        assert f"`{name}`" in text, name
    for name in (*DATUMS, *RESIDUAL_DOMAINS, *IMAGE_UNITS, *ANGLE_UNITS):
        assert f'`"{name}"`' in text, name


EXAMPLES = sorted(
    p.relative_to(ROOT) for p in (ROOT / "examples").glob("*/project*.toml")
    if p.parent.name != "four_photographs"  # oriented photographs for `surface`, nothing measured
)  # fmt: skip


@pytest.mark.parametrize("path", EXAMPLES, ids=str)
def test_examples_are_ready_to_be_adjusted(path):
    network = check_network(read_network(ROOT / path))
    assert network.warnings == ()


@pytest.mark.parametrize("path", sorted(CASES.glob("*/*.toml")) or [
    pytest.param(None, marks=pytest.mark.skip(reason="../shared/cases is not here"))
], ids=lambda p: str(p and p.relative_to(CASES)))  # fmt: skip
def test_acceptance_cases_are_ready_to_be_adjusted(path, tmp_path):
    network = read_network(path)
    assert check_network(network).warnings == ()
    assert_same(read_project(write_project(network, tmp_path)), network, rtol=1e-15)


def test_the_camera_of_a_project_without_points():
    """Oriented photographs alone, as `surface` takes them, have a camera to give."""
    camera = open_camera(ROOT / "examples" / "four_photographs" / "project.toml")
    assert camera.parameters["fx"] == 320 and camera.image_size == (320, 240)
