"""Tables of other programs through a map of their columns."""

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, assert_same, matrix, network
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.io.networks.column_map import is_column_map, read_column_map

MAP = """
[project]
image_unit = "px"
angle_unit = "gon"
datum = "inner"
residuals = "measured"

[[camera]]
id = "1"
model = "opencv"
image_size = [1280, 720]
fx = 1000.0
fy = 1002.0
cx = 641.0
cy = 358.5
k1 = -0.1
k2 = 0.02
p1 = 1e-3
p2 = -5e-4

[table.points]
file = "object.txt"
skip = 1
columns = ["id", "-", "X", "Y", "Z"]
scale = { X = 0.001, Y = 0.001, Z = 0.001 }

[table.images]
file = "exterior.csv"
separator = ";"
decimal = ","
columns = ["id", "X0", "Y0", "Z0", ANGLES]
constant = { camera = "1" }
rotation = "KIND"

[table.observations]
file = "image.txt"
comment = "%"
columns = ["image", "point", "x", "y", "..."]
scale = { y = -1 }
"""


def angles(kind):
    gon = 200 / np.pi
    M = [matrix(a) for a in ANGLES]
    match kind:
        case "omega-phi-kappa":
            return ("omega", "phi", "kappa"), ANGLES * gon
        case "phi-omega-kappa":  # R3(κ)·R1(ω)·R2(φ), axes turned: scipy's intrinsic y-x-z, negated
            return ("phi", "omega", "kappa"), np.array(
                [-Rotation.from_matrix(m).as_euler("yxz") * gon for m in M]
            )
        case "matrix":
            return [f"m{i}{k}" for i in "123" for k in "123"], np.array(M).reshape(3, 9)


def write(folder, kind="omega-phi-kappa", changes=()):
    names, values = angles(kind)
    net = network("opencv")
    comma = lambda row: ";".join(repr(float(v)).replace(".", ",") for v in row)
    files = {
        "map.toml": MAP.replace("KIND", kind).replace("ANGLES", str(list(names))[1:-1]),
        "object.txt": "id what X Y Z\n" + "".join(
            f"{k + 1} target {x!r} {y!r} {z!r}\n" for k, (x, y, z) in enumerate(
                (1000 * POINTS).tolist())),
        "exterior.csv": "".join(
            f"{k + 1};{comma([*POSITION[k], *values[k]])}\n" for k in range(3)),
        "image.txt": "% u, v\n" + "".join(
            f"{i + 1} {k + 1} {x!r} {-y!r} 0.1 good\n" for i, k, (x, y) in
            zip(net.observations.image, net.observations.point, net.observations.xy.tolist())),
    }  # fmt: skip
    for file, old, new in changes:
        assert old in files[file]
        files[file] = files[file].replace(old, new, 1)
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder / "map.toml"


@pytest.mark.parametrize("kind", ["omega-phi-kappa", "phi-omega-kappa", "matrix"])
def test_the_network_comes_back(tmp_path, kind):
    path = write(tmp_path, kind)
    assert is_column_map(path)
    net = read_column_map(path)
    assert_same(network("opencv"), net)
    assert net.angle_unit == "gon" and net.name == "map"


def test_settings(tmp_path):
    net = read_column_map(write(tmp_path), ["sigma_image=0.3", "free=fx,fy"])
    assert (net.observations.sigma == 0.3).all() and net.cameras[0].free == ("fx", "fy")


BROKEN = {
    "no file": (("map.toml", '"object.txt"', '"object.tx"'), "object.tx: no such file"),
    "columns": (("object.txt", "2 target", "2"), "object.txt, line 3: 4 columns where"),
    "number": (("object.txt", "1 target ", "1 target x"), "object.txt, line 2: X is 'x"),
    "nan": (("image.txt", "1 1 ", "1 1 nan "), "x is 'nan'|image.txt"),
    "unknown image": (("image.txt", "\n1 1 ", "\n9 1 "), "line 2: image '9' is unknown"),
    "key": (("map.toml", "skip", "skop"), "unknown key 'skop'; did you mean 'skip'"),
    "table": (("map.toml", "[table.points]", "[table.point]"), "unknown table 'point'"),
    "twice": (("map.toml", '"id", "-", "X"', '"id", "X", "X"'), "occurs twice"),
    "column": (("map.toml", '"Y", "Z"]', '"Y", "H"]'), "scale of 'Z'"),
    "scale": (("map.toml", "y = -1", "y = 0"), "scale of y is 0"),
    "scale of an id": (("map.toml", "y = -1", "image = 2"), "no such column of numbers"),
    "rotation": (("map.toml", "omega-phi-kappa", "pho"), "unknown rotation 'pho'"),
    "angles": (("map.toml", "'omega'", "'-'"), "the column 'omega' is missing"),
    "decimal": (("map.toml", 'decimal = ","', 'decimal = "x"'), "decimal is 'x'"),
    "separator": (("map.toml", 'separator = ";"', 'separator = ";;"'), "separator is ';;'"),
    "missing": (("map.toml", "[table.images]", "[table.distances]"), "table.images. is missing"),
    "toml": (("map.toml", "[[camera]]", "[[camera"), "not valid TOML"),
    "project": (("map.toml", "image_unit", "image_unti"), "unknown key 'image_unti'"),
    "constant": (("map.toml", 'camera = "1"', 'X0 = "0"'), "constant 'X0' is a column of the file"),
    "skip": (("map.toml", "skip = 1", "skip = -1"), "skip is -1"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_maps_and_tables(tmp_path, name):
    change, message = BROKEN[name]
    path = write(tmp_path, changes=[change])
    with pytest.raises(InputError, match=message):
        read_column_map(path)


def test_a_matrix_must_be_a_rotation(tmp_path):
    path = write(tmp_path, "matrix")
    rows = (tmp_path / "exterior.csv").read_text().splitlines()
    cells = rows[1].split(";")
    rows[1] = ";".join([*cells[:4], "0,5", *cells[5:]])
    (tmp_path / "exterior.csv").write_text("\n".join(rows))
    with pytest.raises(InputError, match="exterior.csv, line 2: m11 … m33 are not a rotation"):
        read_column_map(path)
