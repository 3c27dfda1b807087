"""WorldView, Pléiades and SPOT 6: XML of a simulated flight is read as the flight; refusals.

The truth is the formula of the format on the true orbit and attitude, not what a reader makes.
"""

import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushbroom_scenes import LINES, PERIOD, PIXELS, attitude, locate, orbit
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, ray_to_ellipsoid
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.pushbroom.ground_to_image import project_near
from jaxbundle.pushbroom.surfaces import Ground

START = np.datetime64("2016-06-22T23:59:59.25", "ns")
DOWN = Rotation.from_euler("xyz", [np.pi + 0.02, -0.01, 1.2])
"""From a camera that looks along +z, its line at an angle, to ours."""
BODY = Rotation.from_euler("xyz", [0.3, -0.1, 0.7])
AT = np.array([0.0, 1.0, 250.0, 599.0]), np.array([0.0, 133.0, 399.0])
near = jax.jit(jax.vmap(project_near, (None, 0, 0, 0)))


def stamp(t):
    return str(START + np.timedelta64(round(t * 1e9), "ns")) + "Z"


def turned(t):
    """The attitude at one time."""
    return attitude(np.array([t]))[0]


def ground(P, d):
    return P + float(ray_to_ellipsoid(WGS84, P, d)) * d


def check_image(scanner, truth):
    """Locate and project agree with the truth to a micrometre and a millionth of a pixel."""
    found = np.asarray(locate(scanner.image, Ground(), *AT))
    expected = np.array([[truth(l, u) for u in AT[1]] for l in AT[0]]).transpose(2, 0, 1)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    line, pixel = (a.ravel() for a in np.meshgrid(*AT, indexing="ij"))
    back = near(scanner.image, jnp.asarray(expected.reshape(3, -1).T), line + 3.0, pixel - 2.0)
    np.testing.assert_allclose(back, [line, pixel], atol=1e-6)
    # ours: the line of detectors along x, the flight forward
    P, V = (v[0] for v in orbit(np.array([2.0])))
    turn = Rotation.from_quat(np.roll(scanner.image.trajectory.attitude.table.values[0], -1))
    assert turn.inv().apply(V)[1] > 0 > turn.inv().apply(-P)[2]


WV = {"x0": 1.5, "y0": 3.1, "pitch": 0.05, "c": 700.0, "angle": 0.4}
CENTRE = np.array([0.2, -0.1, 1.3])


def worldview(change=lambda text: text, first=-1.0, last=5.5, tlc=None, extra=""):
    step = 0.05
    t = np.arange(round((last - first) / step) + 1) * step + first
    q = (attitude(t) * DOWN * BODY).as_quat()
    lens = BODY.inv().as_quat()
    P, V = orbit(t)
    P = P - (attitude(t) * DOWN * BODY).apply(CENTRE)
    row = lambda values: " ".join(repr(float(v)) for v in values)
    eph = "".join(
        f"<EPHEMLIST>{k} {row(p)} {row(v)} 1 0 0 1 0 1</EPHEMLIST>"
        for k, (p, v) in enumerate(zip(P, V), 1)
    )
    att = "".join(
        f"<ATTLIST>{k} {row(v)} 1 0 0 0 1 0 0 1 0 1</ATTLIST>" for k, v in enumerate(q, 1)
    )
    tlc = tlc or f"<TLCLIST>0 0</TLCLIST><TLCLIST>{LINES} {LINES * PERIOD!r}</TLCLIST>"
    times = f"<STARTTIME>{stamp(first)}</STARTTIME><TIMEINTERVAL>{step}</TIMEINTERVAL>"
    return change(f"""<?xml version="1.0" encoding="UTF-8"?>
<isd><IMD><IMAGEDESCRIPTOR>Basic1B</IMAGEDESCRIPTOR><NUMROWS>{LINES}</NUMROWS>
<NUMCOLUMNS>{PIXELS}</NUMCOLUMNS><IMAGE><SCANDIRECTION>Forward</SCANDIRECTION>
<TLCTIME>{stamp(0)}</TLCTIME><FIRSTLINETIME>{stamp(0)}</FIRSTLINETIME>
<AVGLINERATE>{1 / PERIOD!r}</AVGLINERATE><NUMTLC>2</NUMTLC><TLCLISTList>{tlc}</TLCLISTList>
</IMAGE></IMD>
<EPH>{times}<EPHEMLISTList>{eph}</EPHEMLISTList></EPH>
<ATT>{times}<ATTLISTList>{att}</ATTLISTList></ATT>
<GEO><PRINCIPAL_DISTANCE><PD>{WV["c"]}</PD></PRINCIPAL_DISTANCE>
<OPTICAL_DISTORTION><POLYORDER>-1</POLYORDER><ALISTList><ALIST>0 0</ALIST></ALISTList>
</OPTICAL_DISTORTION>
<PERSPECTIVE_CENTER><CX>{CENTRE[0]}</CX><CY>{CENTRE[1]}</CY><CZ>{CENTRE[2]}</CZ>
</PERSPECTIVE_CENTER><CAMERA_ATTITUDE>
{"".join(f"<QCS{k}>{v!r}</QCS{k}>" for k, v in enumerate(lens.tolist(), 1))}</CAMERA_ATTITUDE>
<DETECTOR_MOUNTING><BAND_P><DETECTOR_ARRAY><DETORIGINX>{WV["x0"]}</DETORIGINX>
<DETORIGINY>{WV["y0"]}</DETORIGINY><DETROTANGLE>{WV["angle"]}</DETROTANGLE>
<DETPITCH>{WV["pitch"]}</DETPITCH></DETECTOR_ARRAY></BAND_P>{extra}</DETECTOR_MOUNTING></GEO></isd>""")


def by_worldview(time):
    def truth(line, pixel):
        t, a = time(line), np.radians(WV["angle"])
        x = WV["x0"] + WV["pitch"] * pixel * np.sin(a)
        y = WV["y0"] - WV["pitch"] * pixel * np.cos(a)
        P = orbit(np.array([t]))[0][0]
        return ground(P, (turned(t) * DOWN).apply([x, y, WV["c"]]))

    return truth


def without_corrections(folder, name="image.xml"):
    text = f'[scanner]\nsource = "{name}"\n[corrections]\n'
    text += "light_time = false\naberration = false\nrefraction = false\n"
    (folder / "plain.toml").write_text(text)
    return read_scanner(folder / "plain.toml")


def test_worldview(tmp_path):
    (tmp_path / "image.xml").write_text(worldview())
    scanner = read_scanner(tmp_path / "image.xml")
    assert not scanner.warnings
    assert scanner.image.corrections == (True, True, True)
    check_image(without_corrections(tmp_path), by_worldview(lambda line: PERIOD * line))


def as_text(element, depth=0):
    """A group as PVL: letters, lists in brackets, groups with numbers."""
    lines = []
    for child in element:
        if child.tag.endswith("List"):
            rows = ",\n".join(f"( {', '.join(e.text.split())} )" for e in child)
            lines.append(f"{child.tag[:-4].lower()} = (\n{rows} );")
        elif len(child):
            name = f"{child.tag}_1" if child.tag in ("IMAGE", "DETECTOR_ARRAY") else child.tag
            lines += [f"BEGIN_GROUP = {name}", as_text(child), f"END_GROUP = {name}"]
        else:
            quoted = f'"{child.text}"' if child.tag == "IMAGEDESCRIPTOR" else child.text
            lines.append(f"\t{child.tag.lower()} = {quoted};")
    return "\n".join(lines)


def test_worldview_as_text(tmp_path):
    """IMD, EPH, ATT, GEO say what the XML says."""
    (tmp_path / "image.xml").write_text(worldview())
    for group in ET.fromstring(worldview()):
        (tmp_path / f"image.{group.tag}").write_text(as_text(group) + "\nEND;\n")
    found, expected = (
        jax.tree.leaves(read_scanner(tmp_path / f"image.{suffix}").image)
        for suffix in ("IMD", "xml")
    )
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    text = (tmp_path / "image.GEO").read_text()
    for old, new, words in [
        ("END_GROUP = BAND_P", "END_GROUP = BAND_Q", ["image.GEO, line", "BAND_Q ends"]),
        ("END_GROUP = DETECTOR_MOUNTING", "", ["image.GEO", "DETECTOR_MOUNTING does not end"]),
        ("pd = ", "pd : ", ["image.GEO, line 2", "NAME = value;"]),
    ]:
        (tmp_path / "image.GEO").write_text(text.replace(old, new))
        with pytest.raises(InputError) as refused:
            read_scanner(tmp_path / "image.IMD")
        for word in words:
            assert word in str(refused.value), refused.value
    (tmp_path / "image.GEO").unlink()
    with pytest.raises(InputError, match="image.GEO is not next to it"):
        read_scanner(tmp_path / "image.IMD")


TIMES = {
    "one row": ("<TLCLIST>0 0.25</TLCLIST>", lambda line: 0.25 + PERIOD * line),
    "two rates": (
        f"<TLCLIST>0 0.5</TLCLIST><TLCLIST>200 {0.5 + 200 * PERIOD!r}</TLCLIST>"
        f"<TLCLIST>300 {0.5 + 250 * PERIOD!r}</TLCLIST>",
        lambda line: 0.5 + PERIOD * (line if line < 200 else 200 + (line - 200) / 2),
    ),
}


@pytest.mark.parametrize("case", TIMES)
def test_times_of_worldview(tmp_path, case):
    tlc, time = TIMES[case]
    (tmp_path / "image.xml").write_text(worldview(tlc=tlc))
    times = read_scanner(tmp_path / "image.xml").image.times
    for line in AT[0]:
        assert float(times.time(line)) == pytest.approx(time(line), abs=1e-12)


def test_what_worldview_warns_of(tmp_path):
    other = "<BAND_C><DETECTOR_ARRAY><DETORIGINX>2</DETORIGINX><DETORIGINY>3</DETORIGINY>"
    other += "<DETROTANGLE>0</DETROTANGLE><DETPITCH>0.05</DETPITCH></DETECTOR_ARRAY></BAND_C>"
    (tmp_path / "image.xml").write_text(worldview(extra=other, last=3.95))
    bands, position, turns = read_scanner(tmp_path / "image.xml").warnings
    assert "BAND_C" in bands and "of BAND_P, which are used" in bands
    assert "EPHEMLIST" in position and "0.0433333 s at its end" in position and "ATTLIST" in turns


def dimap(polynomial=True, change=lambda text: text, unit=1e3, rows=33):
    """ψ_x, ψ_y, and quaternions as a polynomial (Pléiades) or a table (SPOT 6)."""
    P, _ = orbit(np.arange(-8.0, 13.0))
    points = "".join(
        f"<Point><LOCATION_XYZ>{' '.join(repr(float(v)) for v in p)}</LOCATION_XYZ>"
        f"<VELOCITY_XYZ>0 0 0</VELOCITY_XYZ><TIME>{stamp(t)}</TIME></Point>"
        for t, p in zip(range(-8, 13), P)
    )
    if polynomial:
        parts = "".join(
            f"<Q{k}><DEGREE>3</DEGREE><COEFFICIENTS>{' '.join(map(repr, c.tolist()))}"
            f"</COEFFICIENTS></Q{k}>" for k, c in enumerate(quaternion_polynomials())
        )  # fmt: skip
        turns = f"<Polynomial_Quaternions><OFFSET>{OFFSET!r}</OFFSET><SCALE>3.0</SCALE>{parts}"
        turns += "</Polynomial_Quaternions>"
        angles = "<Swath_Range><FIRST_COL>5</FIRST_COL></Swath_Range><Polynomial_Look_Angles>"
        end = "</Polynomial_Look_Angles>"
    else:
        t = -0.5 + 5.0 * np.arange(rows) / (rows - 1)
        q = np.roll((attitude(t) * DOWN).as_quat(), 1, axis=1).tolist()
        turns = "<Quaternion_List>" + "".join(
            "<Quaternion>" + "".join(f"<Q{k}>{v!r}</Q{k}>" for k, v in enumerate(row))
            + f"<TIME>{stamp(at)}</TIME></Quaternion>" for at, row in zip(t, q)
        ) + "</Quaternion_List>"  # fmt: skip
        angles = "<Band_Calibration_List><Band_Calibration><BAND_ID>P</BAND_ID>"
        angles += "<Polynomial_Look_Angles>"
        end = "</Polynomial_Look_Angles></Band_Calibration></Band_Calibration_List>"
    return change(f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT>
<METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification>
<Dataset_Identification><DATASET_NAME>Pléiades</DATASET_NAME></Dataset_Identification>
<Raster_Data><Raster_Dimensions><NROWS>{LINES}</NROWS><NCOLS>{PIXELS}</NCOLS></Raster_Dimensions>
</Raster_Data><Geometric_Data><Refined_Model><Time><Time_Range><START>{stamp(0)}</START>
<END>{stamp(PERIOD * (LINES - 1))}</END></Time_Range><Time_Stamp>
<LINE_PERIOD>{unit * PERIOD!r}</LINE_PERIOD></Time_Stamp></Time>
<Ephemeris><Point_List>{points}</Point_List></Ephemeris><Attitudes>{turns}</Attitudes>
<Geometric_Calibration><Instrument_Calibration>{angles}<XLOS_0>{LOS[0][0]}</XLOS_0>
<XLOS_1>{LOS[0][1]}</XLOS_1><YLOS_0>{LOS[1][0]}</YLOS_0><YLOS_1>{LOS[1][1]}</YLOS_1>{end}
</Instrument_Calibration></Geometric_Calibration></Refined_Model></Geometric_Data>
</Dimap_Document>""")


LOS = ([-0.014, 7e-5], [0.003, 1e-7])
OFFSET = 86399.25 + 2.0
"""Seconds of the day of START: the middle of the image is after midnight."""


def quaternion_polynomials():
    """Cubics near the quaternions, in (t − 2)/3."""
    t = np.linspace(-0.2, 4.2, 50)
    q = np.roll((attitude(t) * DOWN).as_quat(), 1, axis=1)
    q *= np.where(q @ q[0] < 0, -1, 1)[:, None]
    return np.polynomial.polynomial.polyfit((t - 2) / 3, q, 3).T


def by_dimap(polynomial):
    def truth(line, pixel):
        t = PERIOD * line
        x, y = (a + b * (pixel + (4 if polynomial else 0)) for a, b in LOS)
        R = turned(t) * DOWN
        if polynomial:
            q = np.array([np.polyval(c[::-1], (t - 2) / 3) for c in quaternion_polynomials()])
            R = Rotation.from_quat(np.roll(q, -1))
        P = orbit(np.array([t]))[0][0]
        return ground(P, R.apply([y, -x, 1]))

    return truth


@pytest.mark.parametrize("polynomial", [True, False])
def test_dimap2(tmp_path, polynomial):
    """Attitudes of a table every 0.05 s: by Lagrange's polynomial as the true ones."""
    text = dimap(polynomial, unit=1e3 if polynomial else 1e6, rows=101)
    (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
    scanner = read_scanner(tmp_path / "DIM.XML")
    assert scanner.name == "Pléiades" and not scanner.warnings
    assert not scanner.image.corrections.any
    check_image(scanner, by_dimap(polynomial))


def early():
    """The same model in the form of the first products of Pléiades."""
    root = ET.fromstring(dimap().partition("?>")[2])
    take = lambda path: "".join(ET.tostring(e, "unicode") for e in root.find(f".//{path}"))
    points = take("Point_List")
    for new, old in (("LOCATION_VALUES", "LOCATION_XYZ"), ("VELOCITY_VALUES", "VELOCITY_XYZ"),
                     ("UTC_TIME", "TIME")):  # fmt: skip
        points = points.replace(f"<{old}>", f"<{new}>").replace(f"</{old}>", f"</{new}>")
    turns = [take(f"Polynomial_Quaternions/Q{k}") for k in range(4)]
    turns = "".join(f"<Q{k}>{turn}</Q{k}>" for k, turn in enumerate(turns))
    number = lambda name: root.findtext(f".//{name}")
    (x, y) = (" ".join(map(repr, row)) for row in LOS)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<PHR_Dimap_Document><Metadata_Identification>
<METADATA_PROFILE version="1.4">PHR_SYSTEM_RECTIFIED_PRODUCT</METADATA_PROFILE>
</Metadata_Identification><Dataset_Identification><DATASET_NAME>a</DATASET_NAME>
</Dataset_Identification><Product_Characteristics><PROCESSING_LEVEL>SENSOR</PROCESSING_LEVEL>
</Product_Characteristics><Raster_Dimensions><NROWS>{LINES}</NROWS><NCOLS>{PIXELS}</NCOLS>
</Raster_Dimensions><Geometric_Data><Sensor_Model_Characteristics>
<UTC_Sensor_Model_Range><START>{stamp(0)}</START><END>{number("END")}</END>
</UTC_Sensor_Model_Range><Sensor_Ephemeris><Point_List>{points}</Point_List></Sensor_Ephemeris>
<Sensor_Attitudes><Polynomial_Models>{turns}</Polynomial_Models><OFFSET>{number("OFFSET")}</OFFSET>
<SCALE>{number("SCALE")}</SCALE></Sensor_Attitudes>
<SENSOR_LINE_PERIOD>{number("LINE_PERIOD")}</SENSOR_LINE_PERIOD><Sensor_Viewing_Model>
<Position_In_Retina><FIRST_COL>5</FIRST_COL></Position_In_Retina><Viewing_Directions>
<PsiX_Model><COEFFICIENTS>{x}</COEFFICIENTS></PsiX_Model>
<PsiY_Model><COEFFICIENTS>{y}</COEFFICIENTS></PsiY_Model></Viewing_Directions>
</Sensor_Viewing_Model></Sensor_Model_Characteristics></Geometric_Data></PHR_Dimap_Document>"""


def test_early_products_of_pleiades(tmp_path):
    """Their own names, or those of DIMAP 2 under another root, are the same image."""
    texts = [dimap(), early()]
    texts.append(dimap(change=lambda t: t.replace("Dimap_Document", "PHR_DIMAP_Document")))
    images = []
    for text in texts:
        (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
        images.append(read_scanner(tmp_path / "DIM.XML"))
        assert not images[-1].warnings
    for other in images[1:]:
        for a, b in zip(*(jax.tree.leaves(i.image) for i in (images[0], other)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_stated_unit_is_used(tmp_path):
    """PerúSat states seconds, which no profile is known to have."""
    text = dimap(unit=1.0).replace("PHR_", "PER1_")
    text = text.replace("<LINE_PERIOD>", '<LINE_PERIOD unit="S">')
    (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
    assert float(read_scanner(tmp_path / "DIM.XML").image.times.period) == pytest.approx(PERIOD)
    (tmp_path / "DIM.XML").write_text(text.replace('"S"', '"h"'), encoding="latin-1")
    with pytest.raises(InputError, match="LINE_PERIOD is in 'h'; expected one of s, second"):
        read_scanner(tmp_path / "DIM.XML")


def test_units_in_words_of_whole_products(tmp_path):
    """"microsecond" of Pléiades Neo; polynomials of Pléiades whose times state seconds."""
    text = dimap(unit=1e6).replace("PHR_", "PNEO_")
    text = text.replace("<LINE_PERIOD>", '<LINE_PERIOD unit="microsecond">')
    (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
    assert float(read_scanner(tmp_path / "DIM.XML").image.times.period) == pytest.approx(PERIOD)
    images = []
    stated = dimap().replace("<OFFSET>", '<OFFSET unit="s">')
    stated = stated.replace("<SCALE>3.0", '<SCALE unit="ms">3000.0')
    assert stated != dimap()
    for text in (dimap(), stated):
        (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
        images.append(read_scanner(tmp_path / "DIM.XML"))
        assert images[-1].warnings == images[0].warnings
    for a, b in zip(*(jax.tree.leaves(i.image) for i in images), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-9)


def test_biases_are_reported(tmp_path):
    bias = "<Instrument_Biases><YAW>0</YAW><PITCH>1e-5</PITCH></Instrument_Biases>"
    text = dimap(change=lambda t: t.replace("<Swath_Range>", f"{bias}<Swath_Range>"))
    (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
    assert "0, 1e-05, 0) are not applied" in read_scanner(tmp_path / "DIM.XML").warnings[0]


def test_the_unit_of_the_period_of_few_lines_is_that_of_the_product(tmp_path):
    """START to END says nothing of it where there is one line."""
    text = dimap(change=lambda t: t.replace(f"<NROWS>{LINES}<", "<NROWS>1<")
                 .replace(f"<END>{stamp(PERIOD * (LINES - 1))}", f"<END>{stamp(0)}"))
    (tmp_path / "DIM.XML").write_text(text, encoding="latin-1")
    assert float(read_scanner(tmp_path / "DIM.XML").image.times.period) == pytest.approx(PERIOD)


REFUSED = {
    "level": (worldview, "Basic1B", "ORStandard2A", ["IMAGEDESCRIPTOR", "ORStandard2A", "RPC"]),
    "backwards": (
        worldview, f"{LINES} {LINES * PERIOD!r}", f"{LINES} -4.0", ["TLCLIST", "backwards"],
    ),
    "distortion": (worldview, "<ALIST>0 0", "<ALIST>0 1e-7", ["OPTICAL_DISTORTION", "ALIST"]),
    "quaternion": (worldview, "<ATTLIST>1 ", "<ATTLIST>1 3 ", ["ATTLIST, row 1", "length"]),
    "numbers": (worldview, "<ATTLIST>1 ", "<ATTLIST>one ", ["ATTLIST 1", "'one'"]),
    "missing": (worldview, "<CX>0.2</CX>", "", ["PERSPECTIVE_CENTER/CX is missing"]),
    "late": (
        lambda change: worldview(change, last=3.5), "", "", ["EPHEMLIST: image line", "0.1 s"],
    ),
    "period": (
        lambda change: dimap(change=lambda t: change(t.replace("PHR_", "ABC_"))),
        f"<LINE_PERIOD>{1e3 * PERIOD!r}", "<LINE_PERIOD>50", ["LINE_PERIOD is 50", "600 lines"],
    ),
    "location": (lambda change: dimap(change=change), "<LOCATION_XYZ>", "<LOCATION_XYZ>1 ",
                 ["Point 1, LOCATION_XYZ has 4 numbers"]),
    "no quaternion": (lambda change: dimap(change=change), "<COEFFICIENTS>", "<COEFFICIENTS>9 ",
                      ["Attitudes, quaternion 1", "length"]),
    "rpc": (lambda change: change("<Dimap_Document><Rational_Function_Model><Global_RFM/>"
                                  "</Rational_Function_Model></Dimap_Document>"),
            "", "", ["RPC alone", "pushbroom rpc"]),
    "projected": (lambda change: dimap(change=change), "<Raster_Data>", "<Geoposition><Raster_CRS>"
                  "<RASTER_GEOMETRY>GROUND</RASTER_GEOMETRY></Raster_CRS></Geoposition>"
                  "<Raster_Data>", ["RASTER_GEOMETRY is 'GROUND'", "projected", "RPC"]),
    "ortho": (lambda change: change("<Dimap_Document><METADATA_PROFILE>S6_ORTHO</METADATA_PROFILE>"
                                    "<Raster_Data/></Dimap_Document>"),
              "", "", ["DIMAP (S6_ORTHO) without a model of the camera"]),
    "early": (lambda change: change("<PHR_Dimap_Document><METADATA_PROFILE>PHR_X</METADATA_PROFILE>"
                                    "</PHR_Dimap_Document>"), "", "", ["DIMAP (PHR_X) without"]),
    "distortion without a list": (
        worldview, "<ALISTList><ALIST>0 0</ALIST></ALISTList>", "<ALIST>0 1e-7</ALIST>",
        ["OPTICAL_DISTORTION (ALIST)"],
    ),
    "other": (lambda change: change("<gpx/>"), "", "", ["another kind", "<gpx>", "DigitalGlobe"]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(tmp_path, case):
    written, old, new, words = REFUSED[case]

    def change(text):
        assert old in text
        return text.replace(old, new, 1)

    (tmp_path / "image.xml").write_text(written(change))
    with pytest.raises(InputError) as refused:
        read_scanner(tmp_path / "image.xml")
    for word in ("image.xml", *words):
        assert word in str(refused.value), refused.value
