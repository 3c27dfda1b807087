"""Control from a table of its own: its forms, what it replaces, and another frame of the input."""

import dataclasses
import sys

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, matrix, network
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from test_photomodeler import export

from jaxbundle import cli
from jaxbundle.cli.outputs import check_targets
from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.networks.bundler import write_bundler
from jaxbundle.io.networks.control import read_control, with_control
from jaxbundle.io.networks.project import write_project
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds import Antennas
from jaxbundle.network.tables import Source

TURN, SCALE = Rotation.from_euler("xyz", [0.3, -0.2, 0.7]).as_matrix(), 40.0
SHIFT = np.array([999_000.0, 112_000.0, 130.0])
FRAME = {"as the input": lambda X: X, "another": lambda X: SCALE * X @ TURN.T + SHIFT}


def photomodeler(folder):
    (folder / "export.txt").write_text(export(control=((3, 0.02), (5, -0.8), (11, 0.02))))
    return folder / "export.txt", 1


def project(folder):
    return write_project(network("brown"), folder / "project"), 1


def bundler(folder):
    write_bundler(network("snavely", ("0", "1", "2"), 0), folder / "bundle.out")
    return folder / "bundle.out", 0


def table(folder, X, first=1, rows=(0, 2, 4, 6), sigma="0.02,0.02,0.04"):
    lines = [f"{k + first},{','.join(map(repr, X[k].tolist()))},{sigma}" for k in rows]
    path = folder / "control.csv"
    path.write_text("\n".join(["id,X,Y,Z,sX,sY,sZ", *lines]))
    return path


@pytest.mark.parametrize("frame", FRAME)
@pytest.mark.parametrize("form", [photomodeler, project, bundler])
def test_control_replaces_that_of_any_input(tmp_path, form, frame):
    """All of a network without errors comes into the frame of the table."""
    input, first = form(tmp_path)
    X = FRAME[frame](POINTS)
    net = read_network(input, control=table(tmp_path, X, first))
    assert net.datum == "control" and [net.points.role[k] for k in range(12)] == [
        "control" if id in {str(k + first) for k in (0, 2, 4, 6)} else "tie"
        for id in net.points.id
    ]
    at = [net.points.id.index(str(k + first)) for k in range(12)]
    assert_allclose(net.points.position[at], X, rtol=1e-12, atol=1e-9)
    assert_allclose(net.points.sigma[at][[0, 2, 4, 6]], [[0.02, 0.02, 0.04]] * 4)
    assert np.isnan(net.points.sigma[at][[1, 3, 10]]).all()
    assert_allclose(net.images.position, FRAME[frame](POSITION), rtol=1e-12, atol=1e-9)
    turn = TURN if frame == "another" else np.eye(3)
    for mine, given in zip(net.images.angles, ANGLES):
        assert_allclose(matrix(mine), matrix(given) @ turn.T, atol=1e-12)
    said = " ".join((*net.warnings, *net.notes))
    assert ("in another frame" in said) == (frame == "another") and "a posteriori" not in said
    assert ("became tie points: '11'" in said) == (form is photomodeler)
    assert "held as fixed" not in said


@pytest.mark.parametrize("scale, said", [(1000.0, "a thousand times"), (1e-3, "a thousandth")])
def test_control_in_mm_for_start_values_in_m_is_said(tmp_path, scale, said):
    input, first = project(tmp_path)
    net = read_network(input, control=table(tmp_path, scale * POINTS, first))
    (told,) = [line for line in net.warnings if "is one of them in mm, the other in m?" in line]
    assert said in told and "control.csv" in told


@pytest.mark.parametrize("frame", [*FRAME, "a little off"])
@pytest.mark.parametrize("in_control", [False, True])
def test_what_else_is_observed_in_the_frame_of_the_input(tmp_path, frame, in_control):
    """σ of check points that the table does not have turn with the frame; antennas are left out
    unless they are in the frame of the control, or the start values only a little off, as those by
    GNSS are."""
    to_control = FRAME.get(frame, lambda X: X + 0.05 * np.ptp(POINTS, axis=0).max())
    input, _ = project(tmp_path)
    net = read_network(input)
    points = net.points
    roles = tuple("check" if k == 5 else role for k, role in enumerate(points.role))
    sigma = np.full_like(points.sigma, np.nan)
    sigma[5] = 0.01, 0.02, 0.03
    antennas = to_control(POSITION) if in_control else POSITION
    columns = {"image": net.images.id, **dict(zip("XYZ", antennas.T))}
    columns |= {f"s{axis}": [0.1] * 3 for axis in "XYZ"}
    gps = Antennas.from_columns(Columns(columns, Source("gps")), {}, 1.0)
    points = dataclasses.replace(points, role=roles, sigma=sigma)
    net = with_control(
        net.replace(points=points, further=(gps,)),
        read_control(table(tmp_path, to_control(POINTS))),
    )
    A = SCALE * TURN if frame == "another" else np.eye(3)
    covariance = A @ np.diag(sigma[5] ** 2) @ A.T
    assert net.points.role[5] == "check"
    assert_allclose(net.images.position, to_control(POSITION), rtol=1e-12, atol=1e-9)
    assert_allclose(net.points.sigma[5], np.sqrt(np.diag(covariance)), rtol=1e-9)
    told = any("3 observed positions of antennas" in line for line in net.warnings)
    assert told == (frame == "another" and not in_control) == (not net.further)


def test_points_without_coordinates_are_intersected_to_find_the_frame(tmp_path):
    lines = export().splitlines()
    text = "\n".join(line for line in lines if not (len(line.split()) == 7 and line[1:2] != " "))
    (tmp_path / "export.txt").write_text(text)
    assert np.isnan(read_network(tmp_path / "export.txt").points.position).all()
    X = FRAME["another"](POINTS)
    net = read_network(tmp_path / "export.txt", control=table(tmp_path, X))
    assert_allclose(net.images.position, FRAME["another"](POSITION), atol=1e-5)


FORMS = {
    "header": "role,id,X,Y,Z,sX,sY,sZ\n,7,1.5,-2,3e1,0.1,0.2,free\nfixed,a,0,0,1,,,\n",
    "semicolon": "\ufeffid;name;X;Y;Z;SigmaX;sigma_Y;σZ;role\r\n7;P 7;1,5;-2;30;0,1;0,2;free;\r\n"
                 "a;;0;0;1;;;;fixed\r\n",
    "tabs": "# comment\nPoint\tx\ty\tz\tsx\tsy\tsz\trole\n\n7\t1.5\t-2\t30\t.1\t.2\tfree\tcontrol\n"
            "a\t0\t0\t1\t\t\t\tfixed\n".replace("Point", "id"),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMS)
def test_forms_of_the_table(tmp_path, name):
    path = tmp_path / "control.txt"
    path.write_text(FORMS[name], encoding="utf-8", newline="")
    points = read_control(path)
    assert points.id == ("7", "a") and points.role == ("control", "fixed")
    assert_allclose(points.position, [[1.5, -2, 30], [0, 0, 1]])
    assert_allclose(points.sigma, [[0.1, 0.2, np.inf], [np.nan] * 3])


def test_forms_without_header(tmp_path):
    path = tmp_path / "control.txt"
    path.write_text("P1 1 2 3 0.1 0.1 0,2\nP2 4 5,5 6 0.1 0.1 0.2\n")
    assert_allclose(read_control(path).position[1], [4, 5.5, 6])
    assert_allclose(read_control(path).sigma[0], [0.1, 0.1, 0.2])
    path.write_text("North corner, 1.0, 2.0, 3.0\n")
    assert read_control(path).id == ("North corner",)
    path.write_text("P1,1,2,3\n")
    assert read_control(path).role == ("control",) and np.isnan(read_control(path).sigma).all()


BROKEN = {
    "empty": ("\n# nothing\n", "file is empty"),
    "no rows": ("id,X,Y,Z\n", "table is empty"),
    "column": ("id,X,Y,Z,sigmaQ\n1,0,0,0,1\n", "line 1: unknown column 'sigmaQ'"),
    "id": ("X,Y,Z\n1,0,0\n", "line 1: the column 'id' is missing"),
    "count": ("1 2 3\n", "line 1: 3 columns without a header"),
    "cells": ("id,X,Y,Z\n1,0,0\n", "line 2: 3 cells where 4"),
    "number": ("id,X,Y,Z\n1,0,zero,0\n", "line 2: Y is 'zero'"),
    "missing": ("id,X,Y,Z\n1,0,,0\n", "line 2: Y is missing"),
    "twice": ("1,0,0,0\n1,1,1,1\n", "line 2: point '1' is already in .*line 1"),
    "sigma": ("1,0,0,0,0.1,0.1,-0.1\n", "line 1: sZ is -0.1; expected a positive number"),
    "role": ("id,role,X,Y,Z\n1,tied,0,0,0\n", "line 2: role must be one of"),
    "nobody": ("id,X,Y,Z\nP1,0,0,0\n", "none of its 1 points is one of the network; it has '1'"),
    "quotes": ('id,X,Y,Z\n"1,0,0,0\n', "not a table"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_tables(tmp_path, name):
    text, message = BROKEN[name]
    (tmp_path / "export.txt").write_text(export())
    path = tmp_path / "control.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_network(tmp_path / "export.txt", control=path)
    assert "control.csv" in str(caught.value)


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["jaxbundle", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code or 0, capsys.readouterr()


def test_on_the_command_line(tmp_path, monkeypatch, capsys):
    input, _ = photomodeler(tmp_path)
    control = table(tmp_path, FRAME["another"](POINTS))
    status, _ = run(monkeypatch, capsys, "convert", input, tmp_path / "points.csv",
                    "--control", control, "--quiet")  # fmt: skip
    assert status == 0
    written = [line.split(",") for line in (tmp_path / "points.csv").read_text().splitlines()]
    row = next(cells for cells in written if cells[0] == "3")
    assert row[1] == "control" and float(row[2]) == FRAME["another"](POINTS)[2, 0]
    words = ("convert", input, control, "--force", "--control", control)
    status, said = run(monkeypatch, capsys, *words)
    assert status == 2 and "overwritten" in said.err and control.read_text().startswith("id,")
    with pytest.raises(InputError, match="overwritten"):
        check_targets(input, read_network(input), str(control), None, control)
