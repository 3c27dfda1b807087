"""DIMAP of SPOT 5: an image written by the handbook's formulas is read as itself; refusals."""

import re

import numpy as np
import pytest
from pushbroom_scenes import LINES, PERIOD, PIXELS, locate, orbit

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, ray_to_ellipsoid
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.pushbroom.surfaces import Ground

CENTRE = np.datetime64("2008-03-04T12:31:03.081912", "ns")
MIDDLE = 300
"""The line at the centre time, counted from 1."""
PSI_X = 0.01 + 1e-5 * np.sin(np.arange(PIXELS) / 50)
PSI_Y = 0.1 + 7e-5 * (np.arange(PIXELS) - 200)


def angles(t):
    """Pitch, roll, yaw of the handbook, radians; each moves evenly."""
    return 0.02 + 1e-5 * t, -0.03 + 2e-5 * t, 0.05 - 1e-5 * t


def stamp(t):
    return str(CENTRE + np.timedelta64(round(t * 1e9), "ns"))


def write_dimap(folder, change=lambda text: text):
    rows = np.arange(-120.0, 121.0, 30.0)
    P, V = orbit(rows)
    xyz = lambda v: "".join(f"<{n}>{x!r}</{n}>" for n, x in zip("XYZ", v.tolist()))
    points = "".join(
        f"<Point><Location>{xyz(p)}</Location><Velocity>{xyz(v)}</Velocity>"
        f"<TIME>{stamp(t)}</TIME></Point>"
        for t, p, v in zip(rows, P, V)
    )
    attitudes = "".join(
        "<Angles>" + "".join(
            f"<{n}>{v!r}</{n}>" for n, v in zip(("PITCH", "ROLL", "YAW"), angles(t))
        ) + f"<TIME>{stamp(t)}</TIME></Angles>"
        for t in np.arange(-1.9375, 2.1, 0.125).tolist()
    )  # fmt: skip
    looks = "".join(
        f"<Look_Angles><DETECTOR_ID>{k}</DETECTOR_ID><PSI_X>{x!r}</PSI_X><PSI_Y>{y!r}</PSI_Y>"
        "</Look_Angles>" for k, (x, y) in enumerate(zip(PSI_X.tolist(), PSI_Y.tolist()), 1)
    )  # fmt: skip
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document><Dataset_Id><DATASET_NAME>scene</DATASET_NAME></Dataset_Id>
<Raster_Dimensions><NCOLS>{PIXELS}</NCOLS><NROWS>{LINES}</NROWS></Raster_Dimensions>
<Data_Strip><Ephemeris><Points>{points}</Points></Ephemeris>
<Satellite_Attitudes><Corrected_Attitudes><Corrected_Attitude>{attitudes}</Corrected_Attitude>
</Corrected_Attitudes></Satellite_Attitudes>
<Sensor_Configuration><Time_Stamp><LINE_PERIOD>{PERIOD!r}</LINE_PERIOD>
<SCENE_CENTER_TIME>{CENTRE}Z</SCENE_CENTER_TIME><SCENE_CENTER_LINE>{MIDDLE}</SCENE_CENTER_LINE>
</Time_Stamp><Instrument_Look_Angles_List><Instrument_Look_Angles><Look_Angles_List>{looks}
</Look_Angles_List></Instrument_Look_Angles></Instrument_Look_Angles_List></Sensor_Configuration>
</Data_Strip></Dimap_Document>
"""
    path = folder / "METADATA.DIM"
    path.write_text(change(text))
    return path


def by_the_handbook(line, pixel):
    """Equations 5a, 11, 7 as they are printed, on the ellipsoid."""
    t = PERIOD * (line + 1 - MIDDLE)
    pitch, roll, yaw = angles(t)
    cp, sp, cr, sr, cy, sy = (f(a) for a in (pitch, roll, yaw) for f in (np.cos, np.sin))
    Mp = np.array([[1, 0, 0], [0, cp, sp], [0, -sp, cp]])
    Mr = np.array([[cr, 0, -sr], [0, 1, 0], [sr, 0, cr]])
    My = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    u = Mp @ Mr @ My @ [-np.tan(PSI_Y[pixel]), np.tan(PSI_X[pixel]), -1]
    P, V = (v[0] for v in orbit(np.array([t])))
    Z = P / np.linalg.norm(P)
    X = np.cross(V, Z) / np.linalg.norm(np.cross(V, Z))
    d = np.stack([X, np.cross(Z, X), Z], 1) @ u
    return P + float(ray_to_ellipsoid(WGS84, P, d)) * d


def test_an_image_by_the_handbook(tmp_path):
    """First, middle and last line and column; the attitudes begin 0.056 s after the first line, and
    then, with two rows less, end 1.5 steps before the last."""
    scanner = read_scanner(write_dimap(tmp_path))
    assert scanner.name == "scene" and scanner.earth == WGS84
    assert "extrapolated by 0.0558" in scanner.warnings[0]
    lines, pixels = np.array([0, 299, 300, 599]), np.array([0, 150, 399])
    found = locate(scanner.image, Ground(), lines.astype(float), pixels.astype(float))
    for i, line in enumerate(lines):
        for k, pixel in enumerate(pixels):
            expected = by_the_handbook(line, pixel)
            np.testing.assert_allclose(found[:, i, k], expected, atol=2e-3)
    fewer = lambda text: re.sub(r"(<Angles>((?!</Angles>).)*</Angles>){2}(?=</Corr)", "", text)
    scanner = read_scanner(write_dimap(tmp_path, fewer))
    assert len(scanner.image.trajectory.attitude.table.times) == 34
    assert "and 0.1875 s at its end" in scanner.warnings[0]
    found = locate(scanner.image, Ground(), lines.astype(float), pixels.astype(float))
    for k, pixel in enumerate(pixels):
        np.testing.assert_allclose(found[:, 3, k], by_the_handbook(599, pixel), atol=2e-3)


REFUSED = {
    "no number": ("<LINE_PERIOD>0", "<LINE_PERIOD>x0", ["LINE_PERIOD", "'x0"]),
    "missing": (
        "<SCENE_CENTER_LINE>300</SCENE_CENTER_LINE>", "", ["SCENE_CENTER_LINE is missing"],
    ),
    "look angles": (f"<NCOLS>{PIXELS}", "<NCOLS>401", ["400 Look_Angles", "401"]),
    "time": ("<TIME>2008-03-04T12:29", "<TIME>yesterday", ["Point 1, TIME", "yesterday"]),
    "order": ("<TIME>2008-03-04T12:29:03", "<TIME>2008-03-04T12:39:03", ["point 2", "sort"]),
    "no xml": ("</Dimap_Document>", "", ["not valid XML"]),
    "resampled": (
        "<Data_Strip>", "<Data_Processing><PROCESSING_LEVEL>1B</PROCESSING_LEVEL>"
        "</Data_Processing><Data_Strip>", ["PROCESSING_LEVEL is '1B'", "1A"],
    ),
    "late": ("<NROWS>600", "<NROWS>700", ["Corrected_Attitude: image line 646", "0.25 s are"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(tmp_path, case):
    old, new, words = REFUSED[case]

    def change(text):
        assert old in text
        return text.replace(old, new, 1)

    with pytest.raises(InputError) as refused:
        read_scanner(write_dimap(tmp_path, change))
    for word in words:
        assert word in str(refused.value), refused.value


def test_other_bands_and_shifts_are_reported(tmp_path):
    """The look angles of a second band, and a shift between arrays."""
    band = "<Instrument_Look_Angles><BAND_INDEX>2</BAND_INDEX></Instrument_Look_Angles>"
    shift = "<DEREGISTRATION_VALUE>0.25</DEREGISTRATION_VALUE>"

    def change(text):
        end = "</Instrument_Look_Angles_List>"
        text = text.replace(end, f"{band}{end}")
        return text.replace("<Time_Stamp>", f"{shift}<Time_Stamp>")

    _, bands, shifts = read_scanner(write_dimap(tmp_path, change)).warnings
    assert "2 bands have look angles of their own" in bands
    assert "DEREGISTRATION_VALUE 0.25" in shifts and "not applied" in shifts
