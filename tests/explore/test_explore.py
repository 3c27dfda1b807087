"""The explorer: access, and answers equal to those of the library."""

import base64
import dataclasses
import http.client
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from importlib.resources import files
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import CHROMIUM, Browser
from numpy.testing import assert_allclose
from page_reader import decode

import jaxbundle
from jaxbundle.adjustment.quality.expected_precision import expected_precision
from jaxbundle.cameras import get_model, project
from jaxbundle.errors import InputError
from jaxbundle.explorer import server as server_module
from jaxbundle.explorer.camera import CameraView
from jaxbundle.explorer.network import NetworkView, _smallest_turn
from jaxbundle.explorer.page import (
    Number,
    draw_controls,
    draw_tools,
    make_page,
    place,
    with_value,
)
from jaxbundle.explorer.scanner import (
    FLIGHT_FILE,
    PICTURE_FILE,
    TABLE_FILE,
    FlightView,
    _surface_at,
)
from jaxbundle.explorer.server import MOST_BYTES, Server, page_file
from jaxbundle.explorer.tracks import ENDS, GEODETIC, LOCAL, ORBIT, STRAIGHT, USUAL, choose_track
from jaxbundle.explorer.view import File, check_keys, number
from jaxbundle.explorer.widget import reply, show
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.scanner.flight import read_flight
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.network.tables import Camera
from jaxbundle.planning.stations import stations_looking_at
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.error_propagation import ground_errors
from jaxbundle.pushbroom.flight import measured_image, true_image
from jaxbundle.pushbroom.surfaces import Ground, Plane
from jaxbundle.report.page import UNKNOWN, Section
from jaxbundle.report.page.scene import describe_network

ROOT = Path(__file__).parents[2]
FLIGHT = """
[scanner]
name = "aircraft"
lines = 60
pixels = 40
earth = "local"

[times]
period = 0.02

[optics]
c = 60.0
pitch = 0.1

[track]
start = [300.0, 200.0, 800.0]
velocity = [5.0, 60.0, 0.0]

[angles]
roll = [{ kind = "sine", amplitude = 1.0, period = 3.0 }, 0.5]

[instruments]
attitude_rate = 4.0
attitude_interpolation = "linear"
"""


class Doubling:
    """A minimal view: it doubles a number."""

    def page(self, given, live):
        x = number(given, "x", 1.0)
        content = draw_controls([Number("x", "x", x, "", -5.0, 5.0)], live) + draw_tools(live)
        sections = [Section("one", "Doubling", content + place("twice"))]
        return make_page("doubling", sections, UNKNOWN, live, "doubling", self.answer(given))

    def answer(self, given):
        check_keys(given, ["x"])
        x = number(given, "x", 1.0)
        if x == 13:
            raise ZeroDivisionError("a\nfault")
        return {"parts": {"twice": f"<p>{2 * x:g}</p>"}, "twice": 2 * x, "none": float("nan")}

    def export(self, name, given):
        if name != "x.txt":
            raise InputError(f"there is no file {name!r}")
        return File(name, "text/plain", str(given["x"]).encode())


def serve(view, lines):
    server = Server(view, tell=lines.append)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    return server


@pytest.fixture(scope="module")
def doubling():
    lines = []
    server = serve(Doubling(), lines)
    server.lines = lines
    yield server
    server.shutdown()
    server.server_close()


def ask(server, path, body=None, method=None, **headers):
    """Status, body and headers of a request; `path` after the token if it does not begin by /."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    path = path if path.startswith("/") else f"/{server.token}/{path}"
    method = method or ("GET" if body is None else "POST")
    if isinstance(body, dict):
        body = json.dumps(body)
    connection.request(method, path, body, headers)
    found = connection.getresponse()
    content = found.read()
    connection.close()
    return found.status, content.decode(errors="replace"), found.headers


# --- the server -----------------------------------------------------------------------------


def test_the_page_is_served_to_who_has_the_token(doubling):
    assert doubling.server_address[0] == "127.0.0.1" and len(doubling.token) >= 32
    status, page, headers = ask(doubling, "")
    assert status == 200 and headers["Content-Type"].startswith("text/html")
    assert "connect-src 'self'" in page and "default-src 'none'" in page
    assert headers["Cache-Control"] == "no-store"
    status, answer, _ = ask(doubling, "answer", {"x": 4})
    assert status == 200
    assert json.loads(answer) == {"parts": {"twice": "<p>8</p>"}, "twice": 8.0, "none": None}
    assert ask(doubling, "export/x.txt", {"x": 4})[1] == "4"


@pytest.mark.parametrize("path", ["/", "/answer", "/x/", "/TOKEN/", "/%C3%A9/"])
def test_without_the_token_nothing_is_answered(doubling, path):
    for body in (None, {"x": 1}):
        status, said, _ = ask(doubling, path, body)
        assert status == 403 and "doubling" not in said and doubling.token not in said
    token = doubling.token
    for wrong in (token[:-1], token.lower() if token != token.lower() else token.upper()):
        assert ask(doubling, f"/{wrong}/")[0] == 403
    # A site whose name leads to this machine is not spoken with.
    assert ask(doubling, "", Host=f"evil.example:{doubling.server_port}")[0] == 403


def raw(server, *lines, wait=10.0):
    """Status and body of a request of these lines."""
    with socket.create_connection(("127.0.0.1", server.server_port), wait) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        answer = b"".join(iter(lambda: connection.recv(4096), b"")).decode()
    head, _, body = answer.partition("\r\n\r\n")
    return int(head.split()[1]), body


def test_another_site_is_refused_even_with_the_token(doubling):
    here = f"127.0.0.1:{doubling.server_port}"
    for origin in ("null", "https://evil.example", f"http://{here}.evil.example"):
        status, said, _ = ask(doubling, "answer", {"x": 1}, Origin=origin)
        assert status == 403 and "another site" in said
    assert ask(doubling, "answer", {"x": 1}, Origin=f"http://{here}")[0] == 200
    get = f"GET /{doubling.token}/ HTTP/1.1"
    assert raw(doubling, get, f"Host: {here}")[0] == 200
    assert raw(doubling, get, f"Host: {here}", "Host: evil.example")[0] == 403


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "ANYTHING"])
def test_other_methods_are_refused_as_all_else(doubling, method):
    status, said, headers = ask(doubling, "answer", {"x": 1}, method)
    assert status == 405 and headers["Allow"] == "GET, POST"
    assert json.loads(said) == {"error": "expected one of the methods GET, POST"}


def test_a_request_that_trickles_in_does_not_hold_its_connection(doubling, monkeypatch):
    """A byte now and then, of the head or of the body, until the deadline of the whole."""
    monkeypatch.setattr(server_module, "REQUEST_TIMEOUT", 0.5)
    head = f"POST /{doubling.token}/answer HTTP/1.1\r\nHost: 127.0.0.1:{doubling.server_port}\r\n"
    for first in (head, f"{head}Content-Length: 1000\r\n\r\n"):
        begin = time.monotonic()
        with socket.create_connection(("127.0.0.1", doubling.server_port), 30) as connection:
            connection.sendall(first.encode())
            connection.settimeout(0.1)
            answer = b""
            while time.monotonic() < begin + 20:
                try:
                    connection.sendall(b"x")
                    if not (more := connection.recv(4096)):
                        break
                    answer += more
                except TimeoutError:
                    continue
                except OSError:
                    break
        assert time.monotonic() < begin + 20, "the connection is held"
    assert b" 408 " in answer


@pytest.mark.parametrize("path, body, status, words", [
    ("other", None, 404, "only page"), ("other", {}, 404, "there is no other"),
    ("export/", {}, 404, "there is no export"), ("export/y", {}, 400, "no file 'y'"),
    ("answer", "{", 400, "not JSON"), ("answer", "[1]", 400, "object of values"),
    ("answer", '{"x": NaN}', 400, "not a JSON number"), ("answer", "[" * 5000, 400, "not JSON"),
    ("answer", b"\xff\xfe", 400, "not JSON"),
    ("answer", '{"x": %s}' % ("1" * 400), 400, "larger than any number"),
    ("answer", '{"x": 1e999}', 400, "larger than any number"),
    ("answer", {"x": "1"}, 400, "x must be a finite number"),
    ("answer", {"x": True}, 400, "x must be a finite number"),
    ("answer", {"z": 1}, 400, "no value 'z'"), ("answer", {"x": 13}, 500, "a fault"),
    ("answer", " " * (MOST_BYTES + 1), 413, "at most"),
])  # fmt: skip
def test_what_cannot_be_answered_is_one_line_of_json(doubling, path, body, status, words):
    found, said, headers = ask(doubling, path, body)
    assert found == status and headers["Content-Type"] == "application/json"
    (line,) = json.loads(said).values()
    assert words in line and "\n" not in line and "Traceback" not in line


def test_a_fault_is_told_on_the_terminal(doubling):
    doubling.lines.clear()
    ask(doubling, "answer", {"x": 13})
    assert doubling.lines == ["internal error: ZeroDivisionError: a fault"]
    assert ask(doubling, "answer", {"x": 1})[0] == 200


def test_a_saved_page_asks_nobody(doubling):
    status, page, _ = ask(doubling, "save", {"x": 3})
    assert status == 200 and "connect-src" not in page and doubling.token not in page
    fields = re.findall(r"<(?:input|select)[^>]*>", page.partition("<script>")[0])
    assert fields and all("disabled" in field for field in fields)
    assert 'value="3.0"' in page and '"twice":6.0' in page


def test_a_port_that_is_taken_is_refused(doubling):
    with pytest.raises(InputError, match=f"port {doubling.server_port} of 127.0.0.1"):
        Server(Doubling(), doubling.server_port)


# --- networks -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def network(convergent4):
    return NetworkView(convergent4)


def moved_start(adjustment, id, centre):
    row = adjustment.problem.network.images.id.index(id)
    position = np.array(adjustment.values["image"].position)
    position[row] = centre - adjustment.problem.origin
    return row, eqx.tree_at(lambda v: v["image"].position, adjustment.values, jnp.asarray(position))


@pytest.mark.further
def test_a_moved_station_has_the_sigma_of_the_design(network, convergent4):
    """By `jaxbundle.precision`, and as an adjustment of measurements from there would have it."""
    id = convergent4.problem.network.images.id[1]
    pose = np.array([convergent4.images[name][1] for name in
                     ("X0", "Y0", "Z0", "omega", "phi", "kappa")])  # fmt: skip
    pose[:3] += [0.3, -0.2, 0.4]
    found = network.answer({"moves": {id: pose.tolist()}, "aim": False})
    assert_allclose(found["stations"][id]["values"], pose, rtol=1e-10)
    _, start = moved_start(convergent4, id, pose[:3])
    problem = convergent4.problem
    data = dataclasses.replace(problem.data, start=start)
    direct = jaxbundle.precision(problem, data, sigma0=convergent4.sigma0)
    assert_allclose(found["sigma"]["after"]["points"], direct.points, rtol=1e-9)
    assert_allclose(found["sigma"]["after"]["cameras"], direct.cameras, rtol=1e-9)
    # Measurements without error of the moved network, adjusted: their a priori σ times σ0.
    simulated = predicted_network(convergent4, start)
    expected = expected_precision(simulated).points * convergent4.sigma0
    assert_allclose(found["sigma"]["after"]["points"], expected, rtol=1e-6)
    assert "as adjusted" in found["parts"]["moved"] and "%" in found["parts"]["moved"]


def predicted_network(adjustment, values):
    """The network at these values, with the image coordinates that follow from them."""
    problem = adjustment.problem
    network = problem.network
    camera = network.cameras[0]
    model, p = get_model(camera.model), tuple(np.asarray(values["camera"])[0])

    def of_ray(i, j):
        position, rotation = values["image"]
        M = jaxbundle.geometry.matrix_from_quaternion(rotation[i])
        return jnp.stack(project(model, p, *(M @ (values["point"][j] - position[i]))))

    xy = np.asarray(jax.vmap(of_ray)(problem.image, problem.point))
    angles = np.asarray(adjustment.image_values)[:, 3:]
    parameters = dict(zip(model.parameters, map(float, p)))
    return network.replace(
        cameras=(dataclasses.replace(camera, parameters=parameters),),
        images=dataclasses.replace(
            network.images, angles=angles,
            position=np.asarray(values["image"].position) + problem.origin,
        ),
        points=dataclasses.replace(
            network.points, position=np.asarray(values["point"]) + problem.origin
        ),
        observations=dataclasses.replace(network.observations, xy=xy),
    )


def test_before_a_move_sigma_are_those_of_the_adjustment(network, convergent4):
    sigma = np.stack([convergent4.points[f"s{axis}"] for axis in "XYZ"], 1)
    assert_allclose(network.before.points, sigma, rtol=2e-3)
    assert network.answer({})["stations"] == {}


def test_a_station_turns_to_its_points(network, convergent4):
    """The centroid of its points is imaged in the same direction as before; without a move nothing
    changes."""
    id = convergent4.problem.network.images.id[0]
    pose = [float(convergent4.images[name][0]) for name in
            ("X0", "Y0", "Z0", "omega", "phi", "kappa")]  # fmt: skip
    same = network.answer({"moves": {id: pose}, "aim": True})["stations"][id]
    assert_allclose(same["values"], pose, atol=1e-9)
    scene = describe_network(convergent4)
    drawn = decode(scene["pyramids"], 15 * len(convergent4.images["id"]))[:15]
    assert_allclose(same["pyramid"], drawn, rtol=1e-5, atol=1e-5)
    pose[0] += 1.0
    (move,) = network.moves({"moves": {id: pose}, "aim": True})
    seen = convergent4.problem.point[convergent4.problem.image == 0]
    middle = convergent4.point_values[seen].mean(0)
    unit = lambda v: v / np.linalg.norm(v)
    rotation = convergent4.values["image"].rotation
    M = np.asarray(jaxbundle.geometry.matrix_from_quaternion(rotation[0]))
    before = unit(M @ (middle - convergent4.image_values[0, :3]))
    assert_allclose(unit(move.M @ (middle - move.centre)), before, atol=1e-12)


@pytest.mark.parametrize("old", [(0, 0, -1), (1, 0, 0), (0.6, 0, 0.8), (0.48, 0.6, 0.64)])
def test_a_station_on_the_other_side_of_its_points_looks_back(old):
    old = np.array(old)
    for new in (-old, old, np.array([0.0, 1.0, 0.0])):
        turn = _smallest_turn(old, new)
        assert_allclose(turn @ old, new, atol=1e-12)
        assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("given, words", [
    ({"moves": [1]}, "values by station"), ({"moves": {"nowhere": [0] * 6}}, "no image 'nowhere'"),
    ({"moves": {"ID": [0] * 5}}, "six numbers"), ({"moves": {"ID": [None] * 6}}, "six numbers"),
    ({"moves": {}, "aim": 1}, "true or false"), ({"move": {}}, "no value 'move'"),
])  # fmt: skip
def test_moves_that_mean_nothing_are_refused(network, given, words):
    text = json.dumps(given).replace("ID", network.ids[0])
    with pytest.raises(InputError, match=words):
        network.answer(json.loads(text))


# --- cameras --------------------------------------------------------------------------------

SIZE = (400, 300)
CAMERA = Camera(
    "cam", "opencv", {"fx": 380.0, "fy": 380.0, "cx": 201.0, "cy": 148.0, "k1": -0.2, "k2": 0.05},
    free=("fx", "k1"), image_size=SIZE,
)  # fmt: skip


def test_the_grid_is_the_image_of_its_rays_by_the_model():
    view = CameraView(CAMERA, {"k1": 0.001})
    found = view.answer({"k1": -0.1, "cx": 205.0})
    model = get_model("opencv")
    values = view.values | {"k1": -0.1, "cx": 205.0}
    x, y = np.meshgrid(np.linspace(-0.5, 399.5, 13), np.linspace(-0.5, 299.5, 9))
    ray = (x - 201.0) / 380, -(y - 148.0) / 380, -np.ones_like(x)
    # By hand: the radial distortion of OpenCV.
    a, b = ray[0], -ray[1]
    factor = 1 - 0.1 * (a**2 + b**2) + 0.05 * (a**2 + b**2) ** 2
    by_hand = np.stack([205.0 + 380 * a * factor, 148.0 + 380 * b * factor], -1)
    assert_allclose(found["grid"], by_hand, atol=1e-9)
    by_model = np.stack(project(model, tuple(values.values()), *map(jnp.asarray, ray)), -1)
    assert_allclose(found["grid"], by_model, atol=1e-9)
    given = view.answer({})
    assert given["rms"] == 0 and found["largest"] > found["rms"] > 1
    assert "difference/σ" in found["parts"]["numbers"] and ">100<" in found["parts"]["numbers"]


def test_a_slider_reaches_a_value_beyond_its_ends():
    control = Number("k1", "k1", 0.0, "", -1.0, 1.0)
    assert with_value(control, 2.5) == Number("k1", "k1", 2.5, "", -1.0, 2.5)
    page = str(CameraView(CAMERA).page({"k1": 77.0}, live=False).sections)
    assert 'max="77.0" value="77.0"' in page


def test_the_camera_file_has_the_values_of_the_sliders(tmp_path):
    file = CameraView(CAMERA).export("camera.toml", {"k1": -0.1})
    (tmp_path / file.name).write_bytes(file.content)
    from jaxbundle.io.cameras.camera_files import read_cameras

    (camera,) = read_cameras(tmp_path / file.name)
    assert camera.parameters["k1"] == -0.1 and camera.parameters["fx"] == 380


def test_a_photograph_is_freed_of_its_distortion():
    """A ramp that is even over the ideal image, as the camera sees it, is even again."""
    model, view = get_model("opencv"), CameraView(CAMERA)
    u, v = (jnp.asarray(x, float) for x in np.meshgrid(np.arange(400), np.arange(300)))
    p = tuple(view.values.values())
    a = np.asarray(jax.jit(model.to_ideal)(p, u, v)[0])
    grey = np.clip(128 + 0.5 * a, 0, 255).astype(np.uint8)
    view = CameraView(CAMERA, photograph=np.repeat(grey[..., None], 3, 2))
    image = view.answer({})["parts"]["photo"]
    data = re.search(r"base64,([^\"]+)", image)[1]
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_GRAYSCALE)
    expected = 128 + 0.5 * (np.arange(400) - 201)
    inner = np.abs(shown[20:-20, 20:-20].astype(float) - expected[20:-20])
    assert inner.mean() < 1 and inner.max() < 6
    assert np.abs(grey[20:-20, 20:-20] - expected[20:-20]).max() > 6


@pytest.mark.parametrize("given, words", [
    ({"k9": 1.0}, "no value 'k9'"), ({"fx": -1.0}, "fx"), ({"k1": None}, "finite number"),
])  # fmt: skip
def test_parameters_that_are_none_are_refused(given, words):
    with pytest.raises(InputError, match=words):
        CameraView(CAMERA).answer(given)


def test_a_camera_needs_the_size_of_its_image():
    with pytest.raises(InputError, match="--image-size"):
        CameraView(dataclasses.replace(CAMERA, image_size=None))
    with pytest.raises(InputError, match="10 × 10 pixels"):
        CameraView(CAMERA, photograph=np.zeros((10, 10, 3), np.uint8))


# --- line scanners --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "flight.toml"
    path.write_text(FLIGHT)
    return read_flight(path)


@pytest.fixture(scope="module")
def scanner(flight):
    return FlightView("aircraft", flight.flight, flight.earth)


def rms_of_cells(errors):
    """Of east and north at equally many positions in each of 7 × 6 parts of the image."""
    return np.sqrt(np.mean((errors**2).sum(1).reshape(7, 6, -1), axis=2))


@pytest.mark.further
def test_errors_between_the_records_are_not_missed():
    """Attitude records every 100 lines, on which regular lines can fall. The RMS of all 4000 lines
    is 0.143 m (0.144 in the published study)."""
    read = read_flight(ROOT / "examples/lapan_a3/flight.toml")
    view = FlightView("lapan_a3", read.flight, read.earth)
    every = np.repeat(np.arange(read.flight.lines), 3)
    pixels = np.tile([0.0, 700.0, 1999.0], read.flight.lines)
    exact = ground_errors(view.image, view.truth, Ground(read.earth), 1.0 * every, pixels)
    rms = np.sqrt(np.mean((exact**2).sum(1)))
    assert_allclose(rms, 0.143, atol=0.002)
    found = view.answer({})
    assert_allclose(found["rms"], rms, rtol=0.03)
    assert np.min(found["errors"]) > 0.02  # no part of the image is without error


@pytest.mark.further
def test_errors_on_the_ground_are_those_of_the_library(scanner, flight):
    """Those of linear interpolation, which the spline does not leave; and of an error of roll, as
    an offset of the attitude."""
    truth, ground = scanner.truth, Plane(level=0.0)
    places = scanner.positions
    found = scanner.answer({})
    image = measured_image(flight.flight)
    direct = ground_errors(image, true_image(flight.flight), ground, *places)
    assert_allclose(found["errors"], rms_of_cells(direct), atol=1e-9)
    splined = scanner.answer({"attitude_interpolation": "spline"})
    assert splined["rms"] < 0.1 * found["rms"]
    rolled = scanner.answer({"attitude_interpolation": "spline", "roll": 0.1})
    offset = eqx.tree_at(lambda i: i.offsets.attitude, scanner.truth,
                         jnp.array([0.0, np.radians(0.1), 0.0]))  # fmt: skip
    direct = ground_errors(offset, truth, ground, *places)
    assert_allclose(rolled["errors"], rms_of_cells(direct), atol=3e-3)
    # 800 m high: an error of roll moves the ground across by h·ε at least
    assert rolled["rms"] > 800 * np.radians(0.1)
    assert "CE90" in found["parts"]["accuracy"] and "<svg" in found["parts"]["ground"]


@pytest.mark.further
def test_the_flight_file_holds_what_was_chosen(scanner, tmp_path):
    given = {"attitude_interpolation": "spline", "roll": 0.05, "yaw": -0.02}
    file = scanner.export(FLIGHT_FILE, given)
    zipfile.ZipFile(io.BytesIO(file.content)).extractall(tmp_path)
    read = read_scanner(tmp_path / "scanner.toml")
    chosen = scanner.choose(scanner.values(given))
    errors = ground_errors(read.image, chosen.image, chosen.surface, *scanner.positions)
    assert np.abs(errors).max() < 1e-6
    assert read.image.trajectory.attitude.table.method == "spline"
    table = scanner.export(TABLE_FILE, given).content.decode()
    rows = table.partition("\n\n")[0].splitlines()[1:]
    errors = [float(line.split(",")[4]) for line in rows]
    assert_allclose(np.sqrt(np.mean(np.square(errors))), scanner.answer(given)["rms"], rtol=1e-12)
    assert scanner.export(PICTURE_FILE, given).content.startswith(b"\x89PNG")


@pytest.mark.further
def test_a_flight_has_an_orbit_and_a_straight_track(scanner, flight):
    """The other tracks begin at usual values; the given one is that of the file."""
    values = scanner.values({})
    assert values["track"] == STRAIGHT and values["height"] == 500e3
    assert choose_track(scanner.tracks, values) is flight.flight.track
    other_ends = {"end_X": 400.0, "end_Y": 200.0, "start_Z": 900.0}
    turned = choose_track(scanner.tracks, values | other_ends)
    assert turned == {"start": [300.0, 200.0, 900.0], "end": [400.0, 200.0, 800.0]}
    orbit = choose_track(scanner.tracks, values | {"track": ORBIT, "inclination": 90.0})
    assert orbit["height"] == 500e3 and orbit["inclination"] == np.pi / 2
    found = scanner.answer({"track": ORBIT})
    chosen = scanner.choose(scanner.values({"track": ORBIT}))
    other = {f"{end}_{axis}" for end in ENDS for axis in (*GEODETIC, *LOCAL)}
    assert chosen.earth is not None and other == set(found["idle"])
    direct = ground_errors(chosen.image, chosen.truth, chosen.surface, *scanner.positions)
    assert_allclose(found["errors"], rms_of_cells(direct), atol=1e-6)
    # From 500 km rather than 800 m: an error of roll grows with it.
    rolled = scanner.answer({"track": ORBIT, "roll": 0.1})
    assert 500e3 * np.radians(0.1) < rolled["largest"]


def test_an_image_that_was_read_is_its_own_reference(flight):
    view = FlightView("aircraft", measured_image(flight.flight), None)
    assert view.answer({})["rms"] == 0
    keys = {control.key for control in view.controls}
    assert "attitude_rate" not in keys and "aberration" not in keys  # no Earth
    assert view.answer({"pitch": 0.1})["rms"] > 800 * np.radians(0.1)


def test_there_is_no_height_above_an_ellipsoid_of_three_axes():
    assert _surface_at(0.0, Ellipsoid(3.0, 2.0, 1.0)).earth.b == 2
    with pytest.raises(InputError, match="the height of the ground is 100: .*three different axes"):
        _surface_at(100.0, Ellipsoid(3.0, 2.0, 1.0))


@pytest.mark.parametrize("given, words", [
    ({"attitude_interpolation": "splin"}, "did you mean 'spline'"),
    ({"roll": "x"}, "roll must be a finite number"), ({"attitude_rate": 0}, "above 0"),
    ({"attitude_white": -1}, "at least 0"), ({"aberation": True}, "no value 'aberation'"),
    ({"roll": 89.9}, "ground"), ({"position_interpolation": "slerp"}, "position_interpolation"),
])  # fmt: skip
def test_a_choice_that_means_nothing_is_refused(scanner, given, words):
    with pytest.raises(InputError, match=words):
        scanner.answer(given)


# --- the command ----------------------------------------------------------------------------


def test_inputs_are_recognised(tmp_path):
    from jaxbundle.commands.exploring import recognise

    examples = ROOT / "examples"
    assert recognise(str(examples / "convergent4" / "project.toml")) == "network"
    assert recognise(str(examples / "convergent4")) == "network"
    assert recognise(f"{examples}/video_cameras/cameras.toml#1-indoor") == "camera"
    assert recognise(str(examples / "line_scanner" / "flight.toml")) == "scanner"
    for name, text, kind in (("isd.json", '{"name_model": "X"}', "scanner"),
                             ("result.json", '{"cameras": {}}', "camera")):  # fmt: skip
        (tmp_path / name).write_text(text)
        assert recognise(str(tmp_path / name)) == kind
    assert recognise(str(tmp_path)) == "camera"
    # A folder of calibrate has a network beside its camera, as one of adjust.
    (tmp_path / "project.toml").write_text((examples / "convergent4/project.toml").read_text())
    for word, kind in (("calibrate", "camera"), ("adjust", "network")):
        (tmp_path / ".jaxbundle").write_text(f'{{"command": "{word}"}}')
        assert recognise(str(tmp_path)) == kind


@pytest.mark.parametrize("arguments, words", [
    (["nowhere"], "no such file"),
    (["examples/convergent4/project.toml", "--truth", "x"], "--truth: is for a scanner"),
    (["examples/line_scanner/flight.toml", "--set", "a=1"], "--set: is for a network"),
    (["examples/convergent4/project.toml#cam"], "--image-size"),
    (["examples/convergent4/project.toml", "--as", "scaner"], "did you mean 'scanner'"),
])  # fmt: skip
def test_mistakes_end_in_one_line(command, monkeypatch, arguments, words):
    monkeypatch.chdir(ROOT)
    told = command("explore", *arguments, "--no-browser")
    assert told.status == 2 and words in told.err and told.err.count("\n") == 1


def test_ctrl_c_ends_the_command():
    program = subprocess.Popen(
        [sys.executable, "-m", "jaxbundle", "explore", "--no-browser",
         "examples/video_cameras/cameras.toml#1-indoor"],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    address = program.stdout.readline().strip()
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/([\w-]+)/", address)
    assert found, address
    connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=60)
    connection.request("GET", f"/{found[2]}/")
    assert b"1-indoor" in connection.getresponse().read()
    connection.close()
    program.send_signal(signal.SIGINT)
    _, said = program.communicate(timeout=60)
    assert program.returncode == 130 and "jaxbundle: interrupted" in said


# --- in a browser ---------------------------------------------------------------------------


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is missing")
@pytest.mark.parametrize("kind", ["camera", "network", "scanner"])
def test_in_a_browser_a_control_changes_the_numbers(kind, network, scanner, tmp_path):
    view = {"camera": CameraView(CAMERA), "network": network, "scanner": scanner}[kind]
    key, part, value = {
        "camera": ("k1", "numbers", "-0.1"), "scanner": ("roll", "accuracy", "0.1"),
        "network": (None, "moved", None),
    }[kind]  # fmt: skip
    server = serve(view, [])
    try:
        with Browser(tmp_path) as browser:
            browser.open(server.address)
            browser.until(f"document.getElementById('{part}').innerText !== ''")
            before = browser.value(f"document.getElementById('{part}').innerText")
            idle = browser.value(
                "[...document.querySelectorAll('input:disabled')]"
                ".map(one => one.dataset.key ?? one.dataset.slides)"
            )
            places = [f"{end}_{axis}" for end in ENDS for axis in GEODETIC]
            of_scanner = [*USUAL, *places, *Corrections._fields]
            # number fields, and the sliders of those that have one
            assert [*dict.fromkeys(idle)] == (of_scanner if kind == "scanner" else [])
            if kind == "network":
                browser.value("""(() => { const field = document.getElementById("move-Z0");
                    field.value = Number(field.value) + 0.3;
                    field.dispatchEvent(new Event("change")); })()""")
            else:
                browser.value(f"""(() => {{
                    const slider = document.querySelector('[data-slides="{key}"]');
                    slider.value = {value}; slider.dispatchEvent(new Event("input")); }})()""")
                assert browser.value("document.getElementById('explore-said').textContent")
            browser.until(f"document.getElementById('{part}').innerText !== {json.dumps(before)}")
            browser.until("document.getElementById('explore-said').textContent === ''")
            assert browser.value(f"document.getElementById('{part}').innerText") != before
            if kind == "scanner":
                shown = browser.value("[...document.querySelectorAll('#pictures img')]"
                                      ".map(one => one.naturalWidth > 0 && one.alt)")  # fmt: skip
                assert shown == ["scene", "distorted", "corrected"]
            assert browser.console == []
            assert browser.requests and all(
                url.startswith((server.address, "data:")) for url in browser.requests
            )
            if folder := os.environ.get("PICTURES"):
                browser.take_picture(Path(folder) / f"{kind}.png")
    finally:
        server.shutdown()
        server.server_close()


# --- in a notebook --------------------------------------------------------------------------


def test_the_page_of_a_widget_is_answered_by_its_view():
    ask = lambda action, given: reply(Doubling(), {"number": 7, "action": action, "given": given})
    told, (content,) = ask("answer", {"x": 21})
    assert told == {"number": 7, "type": "application/json"}
    assert json.loads(content)["twice"] == 42
    assert ask("export/x.txt", {"x": 2})[1] == [b"2"]
    for action, given, said in (
        ("answer", {"y": 1}, "there is no value"), ("answer", {"x": 13}, "ZeroDivisionError"),
        ("elsewhere", {}, "there is no elsewhere"), ("answer", [], "values by name"),
    ):  # fmt: skip
        told, content = ask(action, given)
        assert said in told["error"] and content == []


def test_a_widget_is_one_of_anywidget():
    widget = show(Doubling(), height=300)
    assert "doubling" in widget.page and widget.height == 300
    sent = []
    widget.send = lambda *message: sent.append(message)
    widget._handle_custom_msg({"number": 1, "action": "answer", "given": {"x": 2}}, [])
    assert json.loads(sent[0][1][0])["twice"] == 4


HARNESS = """<!doctype html><div id="here"></div><script type="module">
%s
const back = [];
const answer = { parts: { twice: "<p>42 by Python</p>" }, twice: 42 };
render({ el: document.getElementById("here"), model: {
  get: name => ({ page: %s, height: 400 })[name],
  on: (_, f) => back.push(f), off: () => {},
  send: data => { window.asked = data; const content = new TextEncoder().encode(
    JSON.stringify(answer)); back[0]({ number: data.number, type: "application/json" },
    [new DataView(content.buffer)]); },
} });
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is missing")
def test_in_the_frame_of_a_widget_a_control_changes_the_numbers(tmp_path):
    script = files("jaxbundle.explorer.page").joinpath("widget.js").read_text(encoding="utf-8")
    script = script.replace("export default", "//")
    script = script.replace("allow-scripts", "allow-scripts allow-same-origin")  # to look into it
    page = page_file(Doubling(), {}, live=True).content.decode()
    page = json.dumps(page).replace("</script", "<\\/script").replace("<!--", "<\\!--")
    (tmp_path / "notebook.html").write_text(HARNESS % (script, page), encoding="utf-8")
    with Browser(tmp_path) as browser:
        browser.open((tmp_path / "notebook.html").as_uri())
        inside = "document.querySelector('iframe').contentDocument"
        browser.until(f"{inside}?.querySelector('[data-slides=x]') != null")
        browser.value(f"""(() => {{ const slider = {inside}.querySelector('[data-slides=x]');
            slider.value = 3; slider.dispatchEvent(new Event("input")); }})()""")
        browser.until(f"{inside}.getElementById('twice').innerText === '42 by Python'")
        assert browser.value("window.asked.given.x") == 3
        assert [line for line in browser.console if "can escape its sandboxing" not in line] == []


@pytest.mark.further
def test_sigma_are_the_larger_under_correlated_errors():
    """As the report has them, where photographs have an affine distortion each."""
    rng, n = np.random.default_rng(3), 9
    u, v = np.meshgrid(np.arange(10) - 4.5, np.arange(7) - 3.0)
    board = 0.03 * np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], 1)
    azimuth = 2 * np.pi * np.arange(n) / n
    X0 = 0.6 * np.stack([0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), np.full(n, 0.85)], 1)
    placed = stations_looking_at(X0, np.zeros((n, 3)), roll=np.pi / 2 * (np.arange(n) % 4))
    parameters = {"fx": 1500.0, "fy": 1500.0, "cx": 999.5, "cy": 749.5}
    camera = Camera("cam", "opencv", parameters, free=("fx", "cx"), image_size=(2000, 1500))
    network = jaxbundle.simulate(placed, board, camera, noise=0.2, seed=4)
    rays, shear = network.observations, 0.6 * rng.normal(size=n)
    x, y = ((rays.xy - rays.xy.mean(0)) / 900).T
    xy = rays.xy + shear[rays.image, None] * np.stack([x, -y], 1)
    points = dataclasses.replace(network.points, position=board, role=("fixed",) * len(board))
    network = network.replace(
        points=points, observations=dataclasses.replace(rays, xy=xy), datum="control"
    )
    found = jaxbundle.adjust(network, correlated=True)
    assert found.sigma_ratio > 1.2
    view = NetworkView(found)
    C = found.image_covariance, found.classical_image_covariance
    larger = np.max([np.sqrt(np.diagonal(one, axis1=1, axis2=2)) for one in C], axis=0)
    # a design has predicted image coordinates, and of many columns other random combinations
    assert_allclose(view.before.images, larger, rtol=0.1)
    assert "the larger of the classical ones" in str(view._move_section({}, True))
