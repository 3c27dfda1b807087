"""Projects in the Open Photogrammetry Format: cameras, control, and tie points of a glTF."""

import json

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, matrix
from numpy.testing import assert_allclose

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.formats import recognise_format
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.opf_keys import (
    CALIBRATED,
    CAMERA_LIST,
    FRAME,
    INPUT_CAMERAS,
    INPUT_POINTS,
    KEYS,
    PROJECT,
    PROJECTED_POINTS,
    TRACKS,
)
from jaxbundle.network.reprojection import point_errors

F, C = 1000.0, (641.5, 359.0)
R, T = (-0.1, 0.02, 0.001), (1e-3, -5e-4)
SHIFT = np.array([-1000.0, 2000.0, -50.0])
CAMERA = [2**63 + 5, 7, 9]
"""Identifiers have 64 bits."""
COLOURS = np.arange(4 * len(POINTS)).reshape(-1, 4) % 256


def pixels(M, X0, X=POINTS):
    """The formula of Pix4D's perspective camera, from the corner of the image."""
    x, y, z = ((X - X0) @ M.T * [1, -1, -1]).T
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + R[0] * r2 + R[1] * r2**2 + R[2] * r2**3
    xd = radial * x + 2 * T[0] * x * y + T[1] * (r2 + 2 * x * x)
    yd = radial * y + 2 * T[1] * x * y + T[0] * (r2 + 2 * y * y)
    return np.stack([F * xd + C[0], F * yd + C[1]], 1)


def dump(folder, name, kind, **content):
    document = {"format": f"application/opf-{kind}+json", "version": "1.0", **content}
    (folder / name).write_text(json.dumps(document))


def write(folder, internals=None, control=4, **frame):
    """`POINTS` seen by the images of `exchange_cases`; the first points are control.

    With all that the specification requires: pyopf 1.4.1 resolves it, and the COLMAP model that its
    `opf2colmap` makes of it has the same cameras, orientations, points, colours, image points."""
    uv = [pixels(matrix(a), X0) for a, X0 in zip(ANGLES, POSITION)]
    dump(folder, "list.json", "camera-list",
         cameras=[{"id": id, "uri": f"file:///c:/my%20photos/{n}.jpg"}
                  for id, n in zip(CAMERA, "abc")])  # fmt: skip
    own = {"type": "perspective", "principal_point_px": C, "focal_length_px": F,
           "radial_distortion": R, "tangential_distortion": T}  # fmt: skip
    seen = {"sensor_id": 3, "model_source": "database", "pixel_type": "uint8",
            "pixel_range": {"min": 0, "max": 255}, "image_orientation": 1}  # fmt: skip
    dump(folder, "input.json", "input-cameras",
         captures=[{"id": 100 + k, "reference_camera_id": id, "time": "2024-05-01T10:00:00Z",
                    "rig_model_source": "not_applicable", "cameras": [{"id": id, **seen}]}
                   for k, id in enumerate(CAMERA)],
         sensors=[{"id": 3, "name": "drone", "image_size_px": [1280, 720], "pixel_size_um": 2.4,
                   "shutter_type": "global", "bands": [{"name": "Red", "weight": 1.0}],
                   "internals": own}])  # fmt: skip
    dump(folder, "calibrated.json", "calibrated-cameras",
         sensors=[{"id": 3, "internals": internals or own}],
         cameras=[{"id": id, "sensor_id": 3, "position": (X0 + SHIFT).tolist(),
                   "orientation_deg": np.degrees(a).tolist()}
                  for id, a, X0 in zip(CAMERA, ANGLES, POSITION)])  # fmt: skip
    dump(folder, "points.json", "input-control-points", mtps=[],
         gcps=[{"id": f"G{p}", "is_checkpoint": p == 3,
                "geolocation": {"crs": {"definition": "EPSG:25832"}, "coordinates": [0, 0, 0],
                                "sigmas": [0.01, 0.01, 0.02]},
                "marks": [{"camera_id": id, "position_px": xy[p].tolist(), "accuracy": 1.0}
                          for id, xy in zip(CAMERA, uv)]} for p in range(control)])  # fmt: skip
    dump(folder, "projected.json", "projected-control-points",
         projected_gcps=[{"id": f"G{p}", "coordinates": (POINTS[p] + SHIFT).tolist(),
                          "sigmas": [0.01, 0.01, 0.02]} for p in range(control)])  # fmt: skip
    base = {"shift": SHIFT.tolist(), "scale": [1, 1, 1], "swap_xy": False} | frame
    dump(folder, "frame.json", "scene-reference-frame", crs={"definition": "EPSG:25832"},
         base_to_canonical=base)  # fmt: skip
    tracks(folder, uv)
    resources = {
        "camera_list": [("list.json", "camera-list")],
        "input_cameras": [("input.json", "input-cameras")],
        "input_control_points": [("points.json", "input-control-points")],
        "projected_control_points": [("projected.json", "projected-control-points")],
        "scene_reference_frame": [("frame.json", "scene-reference-frame")],
        "calibration": [("calibrated.json", "calibrated-cameras"), ("tracks.gltf", None)],
    }
    items = [
        {"id": f"{k:08}-0000-0000-0000-000000000000", "type": name, "sources": [],
         "resources": [{"uri": uri, "format": f"application/opf-{kind}+json" if kind
                        else "model/gltf+json"} for uri, kind in given]}
        for k, (name, given) in enumerate(resources.items())
    ]  # fmt: skip
    path = folder / "project.opf"
    path.write_text(json.dumps({"version": "1.0", "format": "application/opf-project+json",
                                "id": "caa7754e-90dc-11ec-b909-0242ac120002", "name": "p",
                                "description": "", "items": items}))  # fmt: skip
    return path


def tracks(folder, uv):
    """A glTF of `POINTS` with y up, offset by its node; every point is seen by all images."""
    offset, n = np.array([-900.0, -40.0, -1900.0]), len(POINTS)
    X, Y, Z = (POINTS + SHIFT).T
    # [X, Y, Z] = [x, −z, y]
    own = np.stack([X, Z, -Y], 1) - offset
    first = np.arange(n, dtype=np.uint64) * np.uint64(3)
    packed = first | (np.full(n, 3, np.uint64) << np.uint64(40))
    arrays = [
        ("VEC3", 5126, own.astype("<f4")),
        ("SCALAR", 5125, np.tile([0, 1, 2], n).astype("<u4")),
        ("VEC2", 5125, packed.astype("<u8").view("<u4")),
        ("VEC2", 5126, np.stack(uv, 1).reshape(-1, 2).astype("<f4")),
        ("VEC4", 5121, COLOURS.astype("u1")),
    ]
    names = [f"{k}.bin" for k in range(len(arrays))]
    for name, (_, _, array) in zip(names, arrays):
        array.tofile(folder / name)
    size = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    node = np.eye(4)
    node[:3, 3] = offset
    matches = {"cameraUids": CAMERA, "cameraIds": 1, "pointIndexRanges": 2,
               "imagePoints": {"pixelCoordinates": 3, "featureIds": 3, "scales": 1}}  # fmt: skip
    document = {
        "asset": {"version": "2.0", "extensions": {"OPF_asset_version": {"version": "1.0"}}},
        "accessors": [{"bufferView": k, "componentType": c, "count": a.size // size[t], "type": t}
                      for k, (t, c, a) in enumerate(arrays)],
        "bufferViews": [{"buffer": k, "byteLength": a.nbytes} for k, (*_, a) in enumerate(arrays)],
        "buffers": [{"byteLength": a.nbytes, "uri": name}
                    for name, (*_, a) in zip(names, arrays)],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 4}, "mode": 0,
                                    "extensions": {"OPF_mesh_primitive_matches": matches}}]}],
        "nodes": [{"mesh": 0, "matrix": node.T.ravel().tolist()}],
        "scenes": [{"nodes": [0]}], "scene": 0,
    }  # fmt: skip
    (folder / "tracks.gltf").write_text(json.dumps(document))


def test_a_project(tmp_path):
    path = write(tmp_path)
    assert recognise_format(path) == "opf"
    net = read_network(path)
    assert net.images.id == ("a.jpg", "b.jpg", "c.jpg")
    assert_allclose(net.images.position, POSITION, atol=1e-9)
    assert_allclose(net.images.angles, ANGLES, atol=1e-12)
    (camera,) = net.cameras
    assert (camera.id, camera.model, camera.image_size) == ("drone", "opencv", (1280, 720))
    rays = (POINTS - POSITION[0]) @ matrix(ANGLES[0]).T
    theirs = pixels(matrix(ANGLES[0]), POSITION[0]) - 0.5
    assert_allclose(images_of(get_model("opencv"), all_parameters(camera), rays), theirs, atol=1e-9)
    control = net.points.has_role("control")
    assert control.sum() == 3 and net.points.has_role("check").sum() == 1
    assert_allclose(net.points.position[:4], POINTS[:4], atol=1e-9)
    assert_allclose(net.points.sigma[:3], [[0.01, 0.01, 0.02]] * 3)
    assert net.points.id[4:6] == ("t0", "t1")
    # single precision of the glTF, of coordinates of 100 m
    assert_allclose(net.points.position[4:], POINTS, atol=2e-5)
    assert_allclose(net.points.colour[4:], COLOURS[:, :3])
    assert len(net.observations) == 3 * (4 + len(POINTS))
    error, unit = point_errors(net)
    # 2e-5 m at 4 m and f = 1000 px
    assert unit == "px" and np.nanmax(error) < 0.02
    assert net.datum == "control"


def test_without_control_and_tie_points(tmp_path):
    path = write(tmp_path, control=0)
    document = json.loads(path.read_text())
    document["items"][-1]["resources"].pop()
    path.write_text(json.dumps(document))
    net = read_network(path)
    assert len(net.points) == 0 and len(net.images) == 3


def test_a_fisheye_is_fitted(tmp_path):
    internals = {"type": "fisheye", "principal_point_px": C, "affine": [1600, 0, 0, 1600],
                 "polynomial": [0, 1, 0.01, -0.15], "is_symmetric_affine": True,
                 "is_p0_zero": True}  # fmt: skip
    (camera,) = (net := read_network(write(tmp_path, internals))).cameras
    assert any("drone" in told and "px" in told for told in net.warnings)
    rays = np.array([[0.3, 0.2, -1.0], [-0.5, 0.1, -1.0], [0.0, 0.0, -1.0], [0.7, -0.5, -1.0]])
    off = np.hypot(rays[:, 0], rays[:, 1])
    theta = 2 / np.pi * np.arctan2(off, 1.0)
    rho = theta + 0.01 * theta**2 - 0.15 * theta**3
    unit = np.where(off[:, None] > 0, rays[:, :2] / np.maximum(off, 1e-300)[:, None], 0)
    theirs = 1600 * rho[:, None] * unit * [1, -1] + C - np.array(0.5)
    mine = images_of(get_model(camera.model), all_parameters(camera), rays)
    assert np.abs(mine - theirs).max() < 0.5


def test_a_scaled_base_system_is_told(tmp_path):
    net = read_network(write(tmp_path, scale=[0.3048, 0.3048, 1.0], swap_xy=True))
    assert any("0.3048" in told and "exchanged" in told for told in net.warnings)


@pytest.mark.parametrize(
    ("file", "old", "new", "why"),
    [
        ("project.opf", "opf-calibrated-cameras", "opf-other", "without calibrated cameras"),
        ("project.opf", "list.json", "https://a/list.json", "beside the project"),
        ("calibrated.json", '"sensor_id": 3', '"sensor_id": 4', "sensor 4 is not in the file"),
        ("calibrated.json", '"sensor_id": 3', '"sensor_id": "a"', "expected a whole number"),
        ("calibrated.json", "perspective", "spherical", "a spherical sensor is not read"),
        ("calibrated.json", '"type"', '"radial_scale": 2, "type"', "may change the geometry"),
        ("calibrated.json", '"focal_length_px": 1000.0', '"focal_length_px": -1', "a positive one"),
        ("projected.json", '"sigmas": [0.01', '"sigmas": [0', "sigmas of control point 'G0' are"),
        ("tracks.gltf", "3.bin", "none.bin", "cannot be read"),
        ("tracks.gltf", '"count": 9', '"count": 900', "bytes, where"),
        ("tracks.gltf", '"componentType": 5126', '"componentType": 9', "numbers of type 9"),
        ("tracks.gltf", '"mesh": 0', '"mesh": 3', r"meshes\[3\] is missing"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, file, old, new, why):
    path = write(tmp_path)
    text = (tmp_path / file).read_text()
    if old == '"count": 9':
        old, new = f'"count": {len(POINTS)}', f'"count": {100 * len(POINTS)}'
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=why):
        read_network(path)


def test_control_that_is_not_used_is_told(tmp_path):
    net = read_network(write(tmp_path, control=2))
    assert any("2 control points with marks; they are not used" in told for told in net.warnings)


@pytest.mark.parametrize("part, value", [("primitives", []), ("cameraUids", 5)])
def test_a_gltf_without_its_parts_is_refused(tmp_path, part, value):
    path = write(tmp_path)
    document = json.loads((tmp_path / "tracks.gltf").read_text())
    mesh = document["meshes"][0]
    if part == "primitives":
        mesh[part] = value
    else:
        mesh["primitives"][0]["extensions"]["OPF_mesh_primitive_matches"][part] = value
    (tmp_path / "tracks.gltf").write_text(json.dumps(document))
    with pytest.raises(InputError, match=f"tracks.gltf.*{part}"):
        read_network(path)


FILES = {
    PROJECT: "project.opf", CAMERA_LIST: "list.json", INPUT_CAMERAS: "input.json",
    CALIBRATED: "calibrated.json", FRAME: "frame.json", INPUT_POINTS: "points.json",
    PROJECTED_POINTS: "projected.json", TRACKS: "tracks.gltf",
}  # fmt: skip


def objects(value, path):
    """The objects at a path of a document."""
    rows = value if isinstance(value, list) else [value]
    name, _, more = path.partition(".")
    return rows if not path else [x for r in rows if name in r for x in objects(r[name], more)]


@pytest.mark.parametrize("kind", KEYS)
def test_a_further_key_anywhere_is_named_and_a_geometric_one_refused(tmp_path, kind):
    path = write(tmp_path)
    file = tmp_path / FILES[kind]
    text = file.read_text()
    assert not any("unknown key" in told for told in read_network(path).warnings)
    met = 0
    for place, keys in KEYS[kind].items():
        for added in ("vendor_remark", "lens_offset"):
            document = json.loads(text)
            if not (found := objects(document, place)) or not keys.unknown([added]):
                continue  # no manual tie points; extensions are a program's own
            found[-1][added] = 7
            file.write_text(json.dumps(document))
            if added == "lens_offset":
                with pytest.raises(InputError, match=rf"{file.name}.*unknown key 'lens_offset'"):
                    read_network(path)
            else:
                (told,) = [t for t in read_network(path).warnings if "'vendor_remark'" in t]
                assert file.name in told
                met += 1
    assert met == len(KEYS[kind]) - {INPUT_POINTS: 2, TRACKS: 1}.get(kind, 0)


def test_numbers_that_are_not_one_after_the_other_are_refused(tmp_path):
    path, file = write(tmp_path), tmp_path / "tracks.gltf"
    text = file.read_text()
    for key, place, value in (
        ("byteStride", "bufferViews", 24), ("sparse", "accessors", {"count": 1}),
        ("children", "nodes", [1]),
    ):  # fmt: skip
        document = json.loads(text)
        document[place][0][key] = value
        file.write_text(json.dumps(document))
        with pytest.raises(InputError, match=r"tracks.gltf, (accessors|nodes)\[0\]: .*expected"):
            read_network(path)
    document = json.loads(text)
    document["bufferViews"][0]["byteStride"] = 12  # as they are
    file.write_text(json.dumps(document))
    assert len(read_network(path).points) == 4 + len(POINTS)
