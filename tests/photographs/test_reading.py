"""Photographs of every kind: pixels and headers."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxbundle.errors import InputError
from jaxbundle.photographs import photograph_size, read_exif, read_photograph
from jaxbundle.photographs.exif import GeographicPosition
from jaxbundle.photographs.places import map_positions, to_map, utm_system
from jaxbundle.photographs.sensors import sensor_width

GREY = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (60, 90), np.uint8), (0, 0), 3)


def test_kinds_of_pixels(tmp_path):
    colour = np.stack([GREY, np.roll(GREY, 9, 1), np.roll(GREY, 17, 0)], -1)
    Image.fromarray(colour).save(tmp_path / "rgb.png")
    np.testing.assert_array_equal(read_photograph(tmp_path / "rgb.png", colour=True), colour)
    luma = colour @ [0.299, 0.587, 0.114]
    assert np.abs(read_photograph(tmp_path / "rgb.png") - luma).max() <= 1
    Image.fromarray(colour).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=98)
    assert np.abs(read_photograph(tmp_path / "cmyk.jpg") - luma).mean() < 8
    deep = GREY.astype(np.uint16) * 16  # twelve bits in sixteen
    cv2.imwrite(str(tmp_path / "deep.tif"), deep)
    found = read_photograph(tmp_path / "deep.tif")
    assert found.dtype == np.uint8 and found.max() == 255
    assert np.corrcoef(found.ravel(), GREY.ravel())[0, 1] > 0.999


def test_pixels_of_a_turned_photograph_are_those_of_the_sensor(tmp_path):
    head = Image.Exif()
    head[0x0112] = 6
    Image.fromarray(GREY).save(tmp_path / "turned.png", exif=head)
    np.testing.assert_array_equal(read_photograph(tmp_path / "turned.png"), GREY)
    assert read_exif(tmp_path / "turned.png").orientation == 6
    assert photograph_size(tmp_path / "turned.png") == (90, 60)


def test_photographs_of_any_size_but_what_cannot_be_decoded(tmp_path):
    """Headers without pixels."""
    def head(columns, rows):
        found = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
        chunk = lambda kind, data: (struct.pack(">I", len(data)) + kind + data
                                    + struct.pack(">I", zlib.crc32(kind + data)))  # fmt: skip
        path = tmp_path / f"{columns}.png"
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", found) + chunk(b"IDAT", b""))
        return path

    assert photograph_size(head(20_000, 10_000)) == (20_000, 10_000)
    with pytest.raises(InputError, match="40000 × 40000 pixels; at most .* reduce the image"):
        photograph_size(head(40_000, 40_000))


def test_files_cut_short(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "whole.jpg")
    content = (tmp_path / "whole.jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="cut.jpg: the file is truncated"):
        read_photograph(tmp_path / "cut.jpg")
    (tmp_path / "more.jpg").write_bytes(content + b"trailer \xff\xda")
    assert read_photograph(tmp_path / "more.jpg").shape == GREY.shape
    (tmp_path / "empty.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="the file is empty"):
        photograph_size(tmp_path / "empty.jpg")


def test_exif(tmp_path):
    head = Image.Exif()
    head[0x010F], head[0x0110] = "NIKON CORPORATION", "NIKON D800"
    details = head.get_ifd(0x8769)
    details[0x920A], details[0x9003] = 24.0, "2021:05:03 10:11:12"
    gps = head.get_ifd(0x8825)
    gps[1], gps[2], gps[3], gps[4] = "S", (33.0, 30.0, 36.0), "W", (70.0, 45.0, 0.0)
    gps[5], gps[6] = b"\x00", 512.5
    Image.fromarray(GREY).save(tmp_path / "a.jpg", exif=head)
    found = read_exif(tmp_path / "a.jpg")
    assert found.camera == "NIKON D800" and found.time.minute == 11
    f = pytest.approx(24 / 35.9 * 90)
    assert found.principal_distance()[::2] == (f, "focal length and sensor")
    assert found.place == GeographicPosition(pytest.approx(-33.51), pytest.approx(-70.75), 512.5)
    gps[2] = (91.0, 0.0, 0.0)  # no latitude
    Image.fromarray(GREY).save(tmp_path / "a.jpg", exif=head)
    assert read_exif(tmp_path / "a.jpg").place is None


def test_resolution_in_the_focal_plane_is_that_of_the_photograph_as_it_was_taken(tmp_path):
    head = Image.Exif()
    head[0x010F], head[0x0110] = "Maker", "of a camera in no table"
    details = head.get_ifd(0x8769)
    details[0x920A], details[0xA20E], details[0xA210] = 8.0, 254.0, 3  # pixels for a centimetre
    details[0xA002], details[0xA003] = 180, 120
    Image.fromarray(GREY).save(tmp_path / "half.jpg", exif=head)
    Image.fromarray(GREY[:, :60]).save(tmp_path / "square.jpg", exif=head)
    assert read_exif(tmp_path / "square.jpg").principal_distance() is None  # of unknown scale
    told = read_exif(tmp_path / "half.jpg").principal_distance()
    assert told[::2] == (pytest.approx(8.0 * 25.4 / 2), "focal length and resolution")
    assert told.sigma == pytest.approx(0.05 * told.value)


def test_a_focal_length_equivalent_to_film_is_rounded_to_millimetres(tmp_path):
    """By the diagonal of 43.27 mm, whatever the size; σ of a rounded number is 1/√12."""
    head = Image.Exif()
    head.get_ifd(0x8769)[0xA405] = 13
    for name, grey in (("whole.jpg", GREY), ("half.jpg", GREY[::2, ::2])):
        Image.fromarray(grey).save(tmp_path / name, exif=head)
        told = read_exif(tmp_path / name).principal_distance()
        assert told.value == pytest.approx(13 * np.hypot(*grey.shape) / np.hypot(36, 24))
        assert told.sigma / told.value == pytest.approx(np.hypot(0.05, 12**-0.5 / 13))


def test_sensors_are_not_mistaken():
    assert sensor_width("NIKON CORPORATION", "NIKON D80") == 23.6
    assert sensor_width("Canon", "Canon EOS 5D Mark II") == 36.0
    assert sensor_width("DJI", "FC6310") == 13.2
    assert sensor_width("NIKON", "NIKON D8000") is None


@pytest.mark.parametrize("model, width", [
    ("Canon EOS R", 36.0), ("Canon EOS RP", 36.0), ("Canon EOS R6m2", 36.0),
    ("Canon EOS R6 Mark II", 36.0), ("Canon EOS R1", 36.0), ("Canon EOS R7", 22.3),
    ("Canon EOS R10", 22.3), ("Canon EOS R50", 22.3), ("Canon EOS R100", 22.3),
    ("Canon EOS REBEL T3i", 22.3), ("Canon EOS REBEL SL1", 22.3), ("RICOH GR III", 23.6),
    ("RICOH GR DIGITAL 4", 7.44),
])  # fmt: skip
def test_cameras_of_one_first_name_have_sensors_of_their_own(model, width):
    assert sensor_width(model.split()[0], model) == width


@pytest.mark.parametrize("west", [2, 3])
def test_the_zone_of_places_on_both_sides_of_180_degrees(west):
    """Fiji: zone 60 ends at 180° E, zone 1 begins there; most photographs decide."""
    longitudes = [179.99 + 0.001 * k for k in range(west)]
    longitudes += [-179.99 - 0.001 * k for k in range(5 - west)]
    system = "EPSG:32760" if west > 2 else "EPSG:32701"
    X, *_, found, _ = map_positions([GeographicPosition(-17.0, x, 9.0) for x in longitudes])
    assert found == system and np.ptp(X[:, 0]) < 3000 and (X[:, 1] > 8e6).all()
    places = np.array([[x, -17.0, 9.0] for x in longitudes])
    moved, found = to_map(places, "EPSG:4326", "gcp")
    assert found == system
    np.testing.assert_allclose(moved, X, atol=1e-3)


def test_positions_in_a_map():
    assert utm_system(48.2, 16.4) == "EPSG:32633" and utm_system(-33.5, -70.7) == "EPSG:32719"
    places = [GeographicPosition(48.0 + 1e-3 * k, 16.0, 200.0 + k) for k in range(4)]
    X, sigma, _, said, wide = map_positions([*places, None])
    # a thousandth of a degree of the meridian at 48° is 111.2 m, times the scale of UTM
    assert np.allclose(np.diff(X[:4, 1]), 111.2 * 0.9996, atol=0.15)
    assert np.isnan(X[4]).all() and np.allclose(sigma[0], [3, 3, 6]) and "EPSG:32633" in said
    near = [GeographicPosition(48.0 + 1e-6 * k, 16.0, 200.0) for k in range(4)]
    assert wide and not map_positions(near).define_frame
    moved, said = to_map(np.array([[16.0, 48.0, 200.0]]), "EPSG:4326", "gcp")
    assert np.allclose(moved, X[:1], atol=1e-3) and said == "EPSG:32633"
    with pytest.raises(InputError, match="gcp: coordinate system 'EPSG:1' is not known"):
        to_map(moved, "EPSG:1", "gcp")
