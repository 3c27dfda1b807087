"""Attitudes and σ that drones write."""

import numpy as np
import pytest
from PIL import Image

from jaxbundle.network.build import make_network
from jaxbundle.photographs import read_exif
from jaxbundle.photographs.xmp import SIGMA_ATTITUDE, CameraAttitude, Xmp, parse_xmp, rotation_of
from jaxbundle.reconstruction.attitudes import map_attitudes, with_attitudes

HEAD = '<?xpacket begin="" id="W5M0"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
RDF = '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
TAIL = '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
DJI = (
    HEAD + RDF + '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
    'drone-dji:GimbalRollDegree="+1.50" drone-dji:GimbalYawDegree="-30.00" '
    'drone-dji:GimbalPitchDegree="-89.90" drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.012" '
    'drone-dji:RtkStdLat="0.014" drone-dji:RtkStdHgt="0.031"/>' + TAIL
)
PIX4D = (
    HEAD + RDF + '<rdf:Description xmlns:Camera="http://pix4d.com/camera/1.0">'
    "<Camera:Yaw>90</Camera:Yaw><Camera:Pitch>10</Camera:Pitch><Camera:Roll>-2</Camera:Roll>"
    "<Camera:GPSXYAccuracy>1/40</Camera:GPSXYAccuracy><Camera:IMUPitchAccuracy>2</Camera:IMUPitchAccuracy>"
    "</rdf:Description>" + TAIL
)


def test_tags_of_dji_and_pix4d(tmp_path):
    assert parse_xmp(DJI) == Xmp(CameraAttitude(-30, -89.9, 1.5, SIGMA_ATTITUDE), 0.014, 0.031)
    assert parse_xmp(PIX4D.encode()) == Xmp(CameraAttitude(90, -80, -2, 2.0), 1 / 40, None)
    Image.new("L", (90, 60)).save(tmp_path / "a.jpg", xmp=DJI.encode())
    assert read_exif(tmp_path / "a.jpg").attitude == CameraAttitude(-30, -89.9, 1.5, SIGMA_ATTITUDE)


@pytest.mark.parametrize("packet", [
    b"", b"\0\xff", DJI[:-60].encode(), HEAD + RDF + TAIL, DJI.replace("+1.50", "nan"),
    DJI.replace("Gimbal", "Flight"),
    '<!DOCTYPE a [<!ENTITY b "c">]>' + DJI,
])  # fmt: skip
def test_damaged_and_other_packets_say_nothing_of_the_attitude(packet):
    assert parse_xmp(packet).attitude is None


def test_rotation_of_an_attitude():
    """Rows of M: right, top and back of the camera in east, north, up."""
    east, north, up = np.eye(3)
    down = rotation_of(CameraAttitude(0, -90, 0))
    np.testing.assert_allclose(down, [east, north, up], atol=1e-15)
    turned = rotation_of(CameraAttitude(90, -90, 0))
    np.testing.assert_allclose(turned, [-north, east, up], atol=1e-15)
    ahead = rotation_of(CameraAttitude(0, 0, 0))
    np.testing.assert_allclose(ahead, [east, up, -north], atol=1e-15)
    lowered = rotation_of(CameraAttitude(0, 0, 30))
    assert lowered[0] @ up == pytest.approx(-0.5)  # the right side
    # Grid north lies east of true north where the meridian converges by a positive angle.
    true, grid = CameraAttitude(12, -70, 3), CameraAttitude(10, -70, 3)
    np.testing.assert_allclose(rotation_of(true, 2.0), rotation_of(grid), atol=1e-15)


def test_attitudes_take_part_where_they_agree():
    measured = [CameraAttitude(yaw, -90, 0, 2.0) for yaw in (0, 10, 20, 30)]
    attitudes = map_attitudes(measured, np.zeros(4))
    names = [f"{k}.jpg" for k in range(4)]

    def network(turn):
        kappa = -np.radians([0, 10, 20, 30]) + turn
        images = {"id": names, "camera": ["c"] * 4, "X0": [0.0] * 4, "Y0": [0.0] * 4,
                  "Z0": [50.0] * 4, "omega": [0.0] * 4, "phi": [0.0] * 4, "kappa": kappa}
        return make_network(
            [{"id": "c", "model": "brown", "c": 50.0}], images,
            {"id": ["1"], "role": ["tie"], "X": [0.0], "Y": [0.0], "Z": [0.0]},
            {"image": names[:1], "point": ["1"], "x": [0.0], "y": [0.0]}, datum="inner",
        )  # fmt: skip

    found, note = with_attitudes(network(np.radians(1.0)), names, attitudes)
    (further,) = found.further
    np.testing.assert_allclose(further.angles[:, 2], -np.radians([0, 10, 20, 30]), atol=1e-12)
    np.testing.assert_allclose(further.sigma, np.radians(2.0))
    assert "attitudes of 4 photographs" in note and "1.0 degrees" in note
    without, note = with_attitudes(network(np.radians(90.0)), names, attitudes)
    assert without.further == () and "off by 90 degrees" in note
