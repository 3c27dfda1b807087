"""Small files of every keyed format of networks and cameras, written by hand from their
documentation; @ marks the places where a further key may stand."""

import json
from pathlib import Path

YAML, JSON, XML = "{key}: 7\n", '"{key}": 7, ', "<{key}>7</{key}>"
"""A key with a value, by the kind of file."""

EYE = "[1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
BODY = f"!!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: {EYE}"
VINS_BODY = BODY.replace("[1.0, 0, 0, 0,", "[1.0, 0, 0, 0.1,")

OPENCV = """%YAML:1.0
---
@image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320.5, 0., 501., 241.25, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.3, 0.1, 0.001, -0.0005, 0.02 ]
"""
STEREO = """%YAML:1.0
---
@K1: [500.0, 0, 320, 0, 501, 240, 0, 0, 1]
D1: [-0.3, 0.1, 0.001, -0.0005, 0.02]
K2: [510.0, 0, 321, 0, 511, 241, 0, 0, 1]
D2: [-0.2, 0.1, 0.001, -0.0005, 0.02]
image_size: [640, 480]
R: [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
T: [-0.12, 0.0, 0.0]
"""
ROS = """image_width: 640
image_height: 480
@camera_name: cam
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320.5, 0, 501, 241.25, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.0005, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [480, 0, 320, 0, 0, 480, 240, 0, 0, 0, 1, 0]}
"""
OST = """# oST version 5.0 parameters

[image]

width
640

height
480

[narrow_stereo]

camera matrix
500.000000 0.000000 320.500000
0.000000 501.000000 241.250000
0.000000 0.000000 1.000000

distortion
-0.300000 0.100000 0.001000 -0.000500 0.000000

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000
@"""
CAMODOCAL = """%YAML:1.0
---
@model_type: PINHOLE
camera_name: cam
image_width: 752
image_height: 480
distortion_parameters:
   @@@k1: -0.29
   k2: 0.07
   p1: 0.0002
   p2: 1.7e-05
projection_parameters:
   fx: 461.1
   fy: 459.7
   cx: 362.6
   cy: 248.5
"""
VINS = f"""%YAML:1.0

@imu: 1
num_of_cam: 2
imu_topic: "/imu0"
output_path: "~/output/"
cam0_calib: "left.yaml"
cam1_calib: "right.yaml"
image_width: 752
image_height: 480
estimate_extrinsic: 0
body_T_cam0: {BODY}
body_T_cam1: {VINS_BODY}
max_cnt: 150
min_dist: 30
freq: 10
g_norm: 9.81
"""
ORB = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
@Camera.fx: 458.654
Camera.fy: 457.296
Camera.cx: 367.215
Camera.cy: 248.375
Camera.k1:-0.28340811
Camera.k2: 0.07395907
Camera.p1: 0.00019359
Camera.p2: 1.76187114e-05
Camera.width: 752
Camera.height: 480
Camera.fps: 20.0
Camera.RGB: 1
ThDepth: 35
ORBextractor.nFeatures: 1200
ORBextractor.scaleFactor: 1.2
Viewer.KeyFrameSize: 0.05
"""
ORB_PAIR = ORB.replace("Camera.type", "System.LoadAtlas: x\nCamera.type")
for _name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
    ORB_PAIR = ORB_PAIR.replace(f"Camera.{_name}", f"Camera1.{_name}")
ORB_PAIR += """Camera2.fx: 457.587
Camera2.fy: 456.134
Camera2.cx: 379.999
Camera2.cy: 255.238
Camera2.k1: -0.28368365
Camera2.k2: 0.07451284
Camera2.p1: -0.00010473
Camera2.p2: -3.555907e-05
Stereo.T_c1_c2: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [0.0, -1.0, 0.0, 0.11, 1.0, 0.0, 0.0, 0.02, 0.0, 0.0, 1.0, -0.03, 0.0, 0.0, 0.0, 1.0]
"""
EUROC = f"""sensor_type: camera
comment: VI-Sensor cam0
@T_BS:
  cols: 4
  rows: 4
  data: {EYE}
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
KALIBR = """@cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.3, 362.7, 248.1]
  distortion_model: radtan
  distortion_coeffs: [-0.27, 0.06, 0.001, 0.0002]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  @@"""
TRANSFORMS = json.dumps(
    {
        "@": 0, "camera_angle_x": 0.7, "w": 800, "h": 600,
        "frames": [{"@": 0, "file_path": "a.png", "transform_matrix": [
            [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}],
    }
)  # fmt: skip
ALICEVISION = json.dumps(
    {
        "version": ["1", "2", "5"], "@": 0,
        "views": [{"@": 0, "viewId": "10", "poseId": "10", "intrinsicId": "3", "path": "/a/b.jpg",
                   "width": "4000", "height": "3000", "metadata": {"Model": "X"}}],
        "intrinsics": [{"@": 0, "intrinsicId": "3", "width": "4000", "height": "3000",
                        "sensorWidth": "8", "sensorHeight": "6", "serialNumber": "x",
                        "type": "radial3", "initializationMode": "estimated",
                        "initialFocalLength": "-1", "focalLength": "6.4", "pixelRatio": "1.01",
                        "pixelRatioLocked": "true", "principalPoint": ["12.5", "-7"],
                        "distortionInitializationMode": "none",
                        "distortionParams": ["-0.05", "0.02", "0.001"],
                        "undistortionOffset": ["0", "0"], "undistortionParams": "",
                        "locked": "false"}],
        "poses": [{"poseId": "10", "pose": {"transform": {
            "rotation": ["0", "-1", "0", "1", "0", "0", "0", "0", "1"],
            "center": ["1", "2", "3"]}, "locked": "0"}}],
        "structure": [{"@": 0, "landmarkId": "5", "descType": "sift", "color": ["1", "2", "3"],
                       "X": ["1.2", "2.1", "9"], "observations": [
                           {"@": 0, "observationId": "10", "featureId": "1", "x": ["2100", "1400"],
                            "scale": "0"}]}],
    }
)  # fmt: skip
LENS = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  @<projection>frame</projection> <width>6000</width> <height>4000</height>
  <f>6600</f> <cx>10.5</cx> <cy>-54</cy> <k1>-0.09</k1> <k2>0.08</k2> <p1>0.0002</p1>
  <p2>-0.0009</p2> <date>2023-02-17T16:46:58Z</date>
</calibration>
"""
AUTOCAL = """<?xml version="1.0" ?>
<CalibrationInternConique>
  @<KnownConv>eConvApero_DistM2C</KnownConv> <PP>1504.5 998.75</PP> <F>6690.5</F>
  <SzIm>3008 2000</SzIm>
  <CalibDistortion><ModRad>@<CDist>1504.5 998.75</CDist> <CoeffDist>-1.5e-09</CoeffDist>
  </ModRad></CalibDistortion>
</CalibrationInternConique>
"""
STORAGE = """<?xml version="1.0"?>
<opencv_storage>
<calibration_time>"Mon Jan  1 00:00:00 2024"</calibration_time>
@<image_width>640</image_width> <image_height>480</image_height> <flags>14</flags>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>657.3 0. 319.5 0. 657.3 239.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>-0.4183 0.5095 0. 0. -0.5784</data></distortion_coefficients>
<avg_reprojection_error>0.38</avg_reprojection_error>
</opencv_storage>
"""
NVM = """NVM_V3

2
a b.jpg\t1000 1 0 0 0 0.5 0.25 -4 -0.02 0
c.jpg 1100 0 1 0 0 1 0 5 0.03 0
1
0.75 0.5 0.125 10 20 30 2 0 7 60 -61 1 9 55.5 66.5

0
"""


def _metashape() -> str:
    from test_metashape import xml

    text = xml().replace("<sensors>", "@<sensors>").replace("<resolution", "@<resolution", 1)
    return text.replace('label="b"><transform', 'label="b">@<transform').replace(
        "<chunk label", "@<chunk label"
    )


def _opensfm(kind: str) -> str:
    from test_opensfm import files

    scenes, _ = files(gps=True)
    scene = max(scenes, key=lambda scene: len(scene["shots"]))
    camera = next(iter(scene["cameras"].values()))
    if kind == "cameras":
        return json.dumps({"cam": {"@": 0, **camera}})
    shots = {name: {"@": 0, **shot} for name, shot in scene["shots"].items()}
    points = {id: {"@": 0, **point} for id, point in scene["points"].items()}
    cameras = {name: {"@": 0, **camera} for name, camera in scene["cameras"].items()}
    return json.dumps([{"@": 0, "cameras": cameras, "shots": shots, "points": points}])


def _openmvg() -> str:
    from test_openmvg import scene

    document = scene()
    for name in ("views", "intrinsics"):
        for row in document[name]:
            if data := row["value"]["ptr_wrapper"]["data"]:
                data["@"] = 0
    for row in (*document["extrinsics"], *document["structure"]):
        row["value"]["@"] = 0
    return json.dumps({**document, "@": 0})


def _isd() -> str:
    from test_csm_frame import support_data

    return json.dumps({"@": 0, **support_data()})


def _mrcal() -> str:
    from test_mrcal import model

    return model("OPENCV8").replace("'lensmodel'", "@'lensmodel'", 1)


ANIPOSE = """@[cam_0]
@name = "left"
size = [ 640, 480,]
matrix = [ [ 500.0, 0.0, 320.0,], [ 0.0, 501.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.3, 0.1, 0.001, -0.0005, 0.02,]
rotation = [ 0.0, 0.0, 0.0,]
translation = [ 0.0, 0.0, 0.0,]

[cam_1]
@name = "right"
size = [ 640, 480,]
matrix = [ [ 510.0, 0.0, 321.0,], [ 0.0, 511.0, 239.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.01, 0.002, -0.003, 0.001,]
fisheye = true
rotation = [ 0.02, -0.1, 0.01,]
translation = [ -100.0, 2.0, 1.0,]

[metadata]
adjusted = false
error = 0.4
"""


def _groups(text: str, *names: str) -> str:
    """Places for keys in elements of XML, in the first of each name."""
    for name in names:
        assert f"<{name}>" in text, name
        text = text.replace(f"<{name}>", f"<{name}>@", 1)
    return text


def _worldview() -> str:
    from test_xml_products import worldview

    return _groups(worldview(), "isd", "IMD", "IMAGE", "TLCLISTList", "EPH", "ATT", "ATTLISTList",
                   "GEO", "PRINCIPAL_DISTANCE", "OPTICAL_DISTORTION", "PERSPECTIVE_CENTER",
                   "CAMERA_ATTITUDE", "DETECTOR_MOUNTING", "BAND_P", "DETECTOR_ARRAY")  # fmt: skip


def _dimap2(kind: str) -> str:
    from test_xml_products import dimap, early

    if kind == "early":
        return _groups(early(), "PHR_Dimap_Document", "Product_Characteristics",
                       "Raster_Dimensions", "Sensor_Model_Characteristics", "Point",
                       "UTC_Sensor_Model_Range", "Sensor_Attitudes", "Polynomial_Models", "Q0",
                       "Position_In_Retina", "Viewing_Directions", "PsiX_Model")  # fmt: skip
    text = _groups(dimap(kind == "polynomial"), "Dimap_Document", "Metadata_Identification",
                   "Dataset_Identification", "Raster_Data", "Raster_Dimensions", "Geometric_Data",
                   "Refined_Model", "Time", "Time_Range", "Time_Stamp", "Ephemeris", "Point_List",
                   "Point", "Attitudes", "Instrument_Calibration")  # fmt: skip
    more = ("Polynomial_Quaternions", "Q2", "Swath_Range") if kind == "polynomial" else (
        "Quaternion_List", "Quaternion", "Band_Calibration")  # fmt: skip
    return _groups(text, *more, "Polynomial_Look_Angles")


def _dimap1() -> str:
    import tempfile

    from test_dimap import write_dimap

    with tempfile.TemporaryDirectory() as folder:
        text = write_dimap(Path(folder)).read_text()
    return _groups(text, "Dimap_Document", "Dataset_Id", "Raster_Dimensions", "Data_Strip",
                   "Ephemeris", "Point", "Location", "Satellite_Attitudes", "Corrected_Attitude",
                   "Angles", "Sensor_Configuration", "Time_Stamp", "Instrument_Look_Angles",
                   "Look_Angles")  # fmt: skip


def _csm() -> str:
    from test_csm import support_data

    return json.dumps({"@": 0, **support_data()})


SCANNERS = ("csm", "worldview", "dimap", "dimap2", "dimap2-table", "dimap2-early")
"""Those that `read_scanner` reads."""

SAMPLES: dict[str, tuple[str, str, object]] = {
    "opencv": ("camera.yaml", YAML, OPENCV),
    "opencv-xml": ("camera.xml", XML, STORAGE),
    "opencv-json": ("camera.json", JSON, '{@"mtx": [[500, 0, 320], [0, 501, 240], [0, 0, 1]], '
                    '"dist": [[-0.3, 0.1, 0.001, -0.0005, 0.02]]}'),
    "opencv-stereo": ("stereo.yaml", YAML, STEREO),
    "opencv-nested": ("rig.json", JSON, '{@"left": {@"K": [500, 0, 320, 0, 501, 240, 0, 0, 1]}, '
                      '"right": {"K": [500, 0, 320, 0, 501, 240, 0, 0, 1]}, '
                      '"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "T": [-0.1, 0, 0]}'),
    "ros": ("camera_info.yaml", YAML, ROS),
    "ros-ini": ("ost.ini", "\n{key}\n7\n", OST),
    "camodocal": ("cam.yaml", YAML, CAMODOCAL.replace("@@@", "")),
    "camodocal-lens": ("cam.yaml", "{key}: 7\n   ", CAMODOCAL.replace("@@@", "#").replace("@", "")
                       .replace("#", "@")),
    "vins": ("vins.yaml", YAML, VINS),
    "orb-slam": ("orb.yaml", YAML, ORB),
    "orb-slam-pair": ("orb.yaml", YAML, ORB_PAIR),
    "euroc": ("sensor.yaml", YAML, EUROC),
    "kalibr": ("camchain.yaml", YAML, KALIBR.replace("@@", "").replace("\n  rost", "\n  rost")),
    "kalibr-camera": ("camchain.yaml", YAML, KALIBR.replace("@cam0", "cam0").replace("@@", "@")),
    "anipose": ("calibration.toml", "{key} = 7\n", ANIPOSE),
    "transforms": ("transforms.json", JSON, TRANSFORMS),
    "alicevision": ("scene.sfm", JSON, ALICEVISION),
    "csm-frame": ("isd.json", JSON, _isd),
    "metashape": ("cameras.xml", XML, _metashape),
    "metashape-lens": ("calibration.xml", XML, LENS),
    "autocal": ("AutoCal_x.xml", XML, AUTOCAL),
    "opensfm": ("reconstruction.json", JSON, lambda: _opensfm("scene")),
    "opensfm-cameras": ("camera_models.json", JSON, lambda: _opensfm("cameras")),
    "openmvg": ("sfm_data.json", JSON, _openmvg),
    "mrcal": ("left.cameramodel", "'{key}': 7, ", _mrcal),
    "csm": ("isd.json", JSON, _csm),
    "worldview": ("image.xml", XML, _worldview),
    "dimap": ("METADATA.DIM", XML, _dimap1),
    "dimap2": ("DIM.XML", XML, lambda: _dimap2("polynomial")),
    "dimap2-table": ("DIM.XML", XML, lambda: _dimap2("table")),
    "dimap2-early": ("DIM.XML", XML, lambda: _dimap2("early")),
}  # fmt: skip
"""File name, form of a key, text or the function that makes it, by format."""


def places(name: str) -> int:
    """How many places of a sample may have a further key."""
    return _text(name).count("@")


def _text(name: str) -> str:
    text = SAMPLES[name][2]
    text = text() if callable(text) else text
    return str(text).replace('"@": 0, ', "@").replace(', "@": 0', "@")


def write_sample(folder: Path, name: str, key: str = "", place: int = 0) -> Path:
    """Write a sample, with a further key at one of its places."""
    file, form, _ = SAMPLES[name]
    parts = _text(name).split("@")
    added = form.format(key=key) if key else ""
    # in JSON a place may be behind the last entry
    behind = form == JSON and added and parts[place + 1].lstrip()[:1] in "}]"
    added = ", " + added.rstrip(", ") if behind else added
    text = "".join(parts[: place + 1]) + added + "".join(parts[place + 1 :])
    path = folder / file
    path.write_text(text)
    if name == "vins":
        for side in ("left", "right"):
            own = CAMODOCAL.replace("@", "").replace("name: cam", f"name: {side}")
            (folder / f"{side}.yaml").write_text(own)
    return path
