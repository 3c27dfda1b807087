"""Calibrations and orientations of MicMac: its formula for one point, by hand, there and back."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from exchange_cases import ANGLES, POSITION, matrix, network
from numpy.testing import assert_allclose
from scipy.optimize import fsolve

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_cameras, read_network
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.micmac import write_micmac
from jaxbundle.io.networks.micmac_unified import FORMULAS

F, PP, SIZE = 4037.1, (3036.5, 1998.75), (6000, 4000)
R = [-5.2e-9, 1.1e-16, -2e-24]
CASES = {
    "none": dict(kind="ModNoDist"), "radial": dict(R=R), "Fraser": dict(R=R, P1=3e-7, P2=-2e-7),
    "Fraser, affine": dict(R=R, P1=3e-7, P2=-2e-7, b1=1e-3, b2=-4e-4),
    "radial std": dict(R=R, C=(3050.0, 1980.0)), "radial extended": dict(R=[*R, 1e-32, 1e-40]),
    "to the world": dict(R=R, P1=3e-7, known="eConvApero_DistC2M"),
}  # fmt: skip
EXACT = ("none", "radial", "Fraser", "Fraser, affine", "to the world")


def published(X, Y, Z, R=(), C=PP, P1=0.0, P2=0.0, b1=0.0, b2=0.0, known="", kind=""):
    """MicMac's image of a point, as its documentation and code have it."""

    def distortion(q):
        dx, dy = q[0] - C[0], q[1] - C[1]
        r2 = dx * dx + dy * dy
        radial = sum(k * r2 ** (i + 1) for i, k in enumerate(R))
        return np.array([
            q[0] + dx * radial + P1 * (2 * dx * dx + r2) + 2 * P2 * dx * dy + b1 * dx + b2 * dy,
            q[1] + dy * radial + P2 * (2 * dy * dy + r2) + 2 * P1 * dx * dy,
        ])

    q = np.array([PP[0] + F * X / Z, PP[1] + F * Y / Z])
    if known.endswith("C2M"):
        return fsolve(lambda p: distortion(p) - q, q, xtol=1e-13)
    return distortion(q)


def calibration(R=(), C=PP, P1=None, P2=0.0, b1=0.0, b2=0.0, known="eConvApero_DistM2C",
                kind="ModRad") -> str:  # fmt: skip
    radial = f"<CDist>{C[0]} {C[1]}</CDist>" + "".join(f"<CoeffDist>{k!r}</CoeffDist>" for k in R)
    inner = radial + "<CoeffDistInv>1</CoeffDistInv><PPaEqPPs>true</PPaEqPPs>"
    if P1 is not None:
        kind = "ModPhgrStd"
        inner = (f"<RadialePart>{inner}</RadialePart><P1>{P1!r}</P1><P2>{P2!r}</P2>"
                 f"<b1>{b1!r}</b1><b2>{b2!r}</b2>")  # fmt: skip
    return f"""<CalibrationInternConique><KnownConv>{known}</KnownConv>
<PP>{PP[0]} {PP[1]}</PP><F>{F}</F><SzIm>{SIZE[0]} {SIZE[1]}</SzIm>
<CalibDistortion><{kind}>{"" if kind == "ModNoDist" else inner}</{kind}></CalibDistortion>
<RayonUtile>3000</RayonUtile></CalibrationInternConique>"""


def wrapped(text) -> str:
    return f'<?xml version="1.0" ?>\n<ExportAPERO>\n{text}\n</ExportAPERO>\n'


def orientation(i: int, calibration="<FileInterne>Ori-Test/AutoCal_cam.xml</FileInterne>") -> str:
    rows = matrix(ANGLES[i]).T * [1, -1, -1]
    text = lambda v: " ".join(repr(float(x)) for x in v)
    lines = "".join(f"<L{k}>{text(row)}</L{k}>" for k, row in enumerate(rows, 1))
    return wrapped(f"""<OrientationConique>
<OrIntImaM2C><I00>0 0</I00><V10>1 0</V10><V01>0 1</V01></OrIntImaM2C>
<TypeProj>eProjStenope</TypeProj>{calibration}<RelativeNameFI>true</RelativeNameFI>
<Externe><AltiSol>1</AltiSol><KnownConv>eConvApero_DistM2C</KnownConv>
<Centre>{text(POSITION[i])}</Centre><ParamRotation><CodageMatr>{lines}</CodageMatr></ParamRotation>
</Externe><ConvOri><KnownConv>eConvApero_DistM2C</KnownConv></ConvOri></OrientationConique>""")


def folder(tmp_path):
    made = tmp_path / "Ori-Test"
    made.mkdir(exist_ok=True)
    (made / "AutoCal_cam.xml").write_text(wrapped(calibration(**CASES["Fraser"])))
    for i in range(2):
        (made / f"Orientation-{i}.jpg.xml").write_text(orientation(i))
    inline = f"<Interne>{calibration(**CASES['radial'])}</Interne>"
    (made / "Orientation-2.jpg.xml").write_text(orientation(2, inline))
    return made


@pytest.mark.parametrize("name", CASES)
def test_the_published_formula_is_the_camera(tmp_path, name):
    path = tmp_path / "AutoCal_cam.xml"
    path.write_text(wrapped(calibration(**CASES[name])))
    (camera,) = read_cameras(path)
    ray = np.array([0.35, -0.22, -1.1])
    found = images_of(get_model(camera.model), all_parameters(camera), ray[None])[0]
    if camera.model != "opencv":
        px, py = camera.pixel_size
        found = found / [px, -py] + (np.array(SIZE) - 1) / 2
    told = getattr(camera, "message", "")
    assert ("pixel size is taken" in told) == (camera.model != "opencv" and name in EXACT)
    told = "" if name in EXACT else told
    limit = float(told.partition("difference ")[2].split()[0]) if told else 1e-9
    assert bool(told) == (name not in EXACT) and limit < 0.6
    assert_allclose(found, published(ray[0], -ray[1], -ray[2], **CASES[name]), atol=limit)
    if name in EXACT:
        assert convert(path, tmp_path / "autocal2.xml").kind == "autocal"
        again = all_parameters(read_cameras(tmp_path / "autocal2.xml")[0])
        assert again == pytest.approx(all_parameters(camera), rel=1e-13)


def test_a_folder(tmp_path):
    net = read_network(folder(tmp_path))
    assert net.images.id == ("0.jpg", "1.jpg", "2.jpg") and len(net.cameras) == 2
    assert_allclose(net.images.position, POSITION, atol=1e-12)
    X = np.array([0.2, 0.1, -0.3])
    for i in range(3):
        camera = net.cameras[net.images.camera[i]]
        ray = matrix(net.images.angles[i]) @ (X - net.images.position[i])
        found = images_of(get_model(camera.model), all_parameters(camera), ray[None])[0]
        C2W = matrix(ANGLES[i]).T * [1, -1, -1]
        theirs = C2W.T @ (X - POSITION[i])
        wanted = published(*theirs, **CASES["Fraser" if i < 2 else "radial"])
        assert_allclose(found, wanted, atol=1e-8)


def test_there_and_back(tmp_path):
    net = network("opencv", ("a.jpg", "b.jpg", "c.jpg"))
    square = dataclasses.replace(
        net.cameras[0], parameters=dict(net.cameras[0].parameters, fy=1000.0)
    )
    net = net.replace(cameras=(square,))
    assert write_micmac(net, tmp_path / "Ori-Out") == ("pixel sizes of cameras (1)", "points (12)")
    back = read_network(tmp_path / "Ori-Out")
    assert_allclose(back.images.position, POSITION, atol=1e-12)
    assert_allclose([matrix(a) for a in back.images.angles], [*map(matrix, ANGLES)], atol=1e-12)
    assert all_parameters(back.cameras[0]) == pytest.approx(all_parameters(square), rel=1e-13)
    assert convert(tmp_path / "Ori-Out", tmp_path / "Ori-Again").kind == "micmac"


BROKEN = {
    "convention": ("Orientation-0.jpg.xml", "eConvApero_DistM2C", "eConvAngErdas", "KnownConv is"),
    "projection": ("Orientation-0.jpg.xml", "eProjStenope", "x", "TypeProj is x"),
    "affine": ("Orientation-0.jpg.xml", "<I00>0 0", "<I00>5 0", "OrIntImaM2C must be the ident"),
    "file": ("Orientation-0.jpg.xml", "AutoCal_cam", "AutoCal", "AutoCal.xml: there is no such"),
    "row": ("Orientation-0.jpg.xml", "L2>", "X2>", "L2 is missing"),
    "turn": ("Orientation-0.jpg.xml", "<L1>", "<L1>9", "CodageMatr is not a rotation"),
    "centre": ("Orientation-0.jpg.xml", "<Centre>-1.5 ", "<Centre>", "Centre has 2 numbers"),
    "kind": ("AutoCal_cam.xml", "ModPhgrStd", "ModUnif", "ModUnif: unknown key 'P1'"),
    "F": ("AutoCal_cam.xml", "<F>4", "<F>-4", "F and SzIm must be positive"),
    "no F": ("AutoCal_cam.xml", "F>", "G>", "F is missing; expected a calibration of MicMac"),
    "NaN": ("AutoCal_cam.xml", "<P1>", "<P1>x", "P1 is 'x"),
    "size": ("AutoCal_cam.xml", "6000 4000", "6000", "SzIm has 1 numbers; expected 2"),
    "entity": ("AutoCal_cam.xml", "<ExportAPERO>", "<!DOCTYPE x [<!ENTITY a 'b'>]><ExportAPERO>",
               "entities"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_folders(tmp_path, name):
    file, old, new, message = BROKEN[name]
    path = folder(tmp_path) / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=f"{file}.*{message}"):
        read_network(tmp_path / "Ori-Test")


def unified(kind: str, V, S) -> str:
    numbers = "".join(f"<Params>{v!r}</Params>" for v in (*V, 0.0, 0.0))
    numbers += "".join(f"<Etats>{s!r}</Etats>" for s in S)
    text = calibration(kind="ModNoDist").replace(
        "<ModNoDist></ModNoDist>",
        f"<ModUnif><TypeModele>{kind}</TypeModele>{numbers}</ModUnif>",
    )
    return f"<ExportAPERO>{text}</ExportAPERO>"


def term_by_term(kind: str, V, S, X, Y, Z):
    """The image as the formulas of MicMac have it, sums of monomials x^i·y^j written as a list."""
    q = np.array([PP[0] + F * X / Z, PP[1] + F * Y / Z])
    if "FishEye" in kind:
        a = (q - V[:2]) / S[0]
        theta = np.arctan(np.hypot(*a))
        rho = 2 * np.sin(theta / 2) if "EquiSolid" in kind else theta
        x, y = u = a * rho / np.hypot(*a)
        r2 = rho**2
        out = u * (1 + sum(V[2 + i] * r2 ** (i + 1) for i in range(10)))
        out = out + np.array([V[22] * x + V[23] * y, V[23] * x])
        for k in range(5):
            P, Q = V[12 + 2 * k], V[13 + 2 * k]
            n = 2 * k + 2
            out = out + r2**k * np.array([P * (r2 + n * x * x) + Q * n * x * y,
                                          Q * (r2 + n * y * y) + P * n * x * y])  # fmt: skip
        return np.array(V[:2]) + S[0] * out
    if "PPaEqPPs" in kind:
        P1, P2, b1, b2 = (*V[5:], 0, 0, 0, 0)[:4]
        return published(X, Y, Z, R=V[:5], P1=P1, P2=P2, b1=b1, b2=b2)
    x, y = q
    if kind == "eModeleEbner":
        s, t = x * x - S[0] ** 2 / 1.5, y * y - S[0] ** 2 / 1.5
        dx = np.dot([x, y, -2 * s, x * y, t, 0, x * t, 0, y * s, 0, s * t, 0], V)
        dy = np.dot([-y, x, x * y, -2 * t, 0, s, 0, y * s, 0, x * t, 0, s * t], V)
        return q + [dx, dy]
    if kind == "eModeleDCBrown":
        s, t = x * x, y * y
        f = V[12] * s * t / S[0] + V[13] * (s + t)
        dx = np.dot([x, y, x * y, t, s * y, x * t, s * t], V[:7]) + x * f
        dy = np.dot([x * y, s, s * y, x * t, s * t], V[7:12]) + y * f
        return q + [dx, dy]
    x, y = (q - S[1:]) / S[0]
    dx = np.dot([x, y, -2 * x * x, x * y, y * y, 0], V[:6])
    dy = np.dot([-y, x, x * y, -2 * y * y, 0, x * x], V[:6])
    cubic = [x**3, x * x * y, x * y * y, y**3]
    return q + S[0] * np.array([dx + np.dot(cubic, V[6:10]), dy + np.dot(cubic, V[10:14])])


UNIFIED = {
    "eModelePolyDeg3": ([2e-3, -1e-3, 3e-4, 2e-4, -1e-4, 2e-4, 1e-3, 2e-4, 9e-4, 1e-4, -2e-4, 1e-3,
                         1e-4, 8e-4], [F, 3000.0, 2000.0]),
    "eModele_DRad_PPaEqPPs": ([*R, 1e-33, 1e-41], []),
    "eModele_Fraser_PPaEqPPs": ([*R, 0.0, 0.0, 3e-7, -2e-7, 1e-3, -4e-4], []),
    "eModele_FishEye_10_5_5": ([3030.0, 2005.0, -0.02, 3e-3, -4e-4, *[0.0] * 7, 2e-4, -1e-4, 3e-5,
                                *[0.0] * 7, 1e-4, -2e-4], [F - 3]),
    "eModele_EquiSolid_FishEye_10_5_5": ([*PP, -0.02, 3e-3, *[0.0] * 18, 1e-4, 0.0], [F]),
    "eModeleEbner": ([1e-4, 2e-5, 1e-9, 2e-9, -1e-9, 1e-9, 1e-13, 2e-13, 1e-13, -1e-13, 1e-17,
                      2e-17], [2000.0]),
    "eModeleDCBrown": ([1e-4, 2e-5, 1e-9, 2e-9, 1e-13, 2e-13, 1e-17, 1e-9, 2e-9, 1e-13, 2e-13,
                        1e-17, 1e-14, -1e-10], [F]),
}  # fmt: skip


@pytest.mark.parametrize("kind", UNIFIED)
def test_unified_distortions(tmp_path, kind):
    """The formula term by term; the fitted camera has the image it says, in ours."""
    V, S = UNIFIED[kind]
    rays = np.array([[0.5, 0.3, 1.0], [-0.4, 0.2, 1.0], [0.1, -0.35, 1.0], [0.02, 0.01, 1.0]])
    expected = np.array([term_by_term(kind, np.array(V), S, *ray) for ray in rays])
    formula, states, most = FORMULAS[kind]
    given = {"fx": F, "fy": F, "cx": PP[0], "cy": PP[1], "V": jnp.array((V + [0.0] * most)[:most]),
             "S": jnp.array(S)}  # fmt: skip
    assert states == len(S) and len(V) == most
    assert_allclose([formula(given, *ray) for ray in rays], expected, atol=1e-8)
    path = tmp_path / "AutoCal_cam.xml"
    path.write_text(unified(kind, V, S))
    (camera,) = read_cameras(path)
    largest = float(re.search(r"largest difference ([\d.e+-]+) px", camera.message)[1])
    assert kind in camera.message and largest < 12
    found = images_of(get_model(camera.model), all_parameters(camera), rays * [1, -1, -1])
    if get_model(camera.model).unit == "mm":
        found = np.array(camera.image_size) / 2 - 0.5 + found / camera.pixel_size * [1, -1]
    assert np.linalg.norm(found - expected, axis=1).max() < 1.05 * largest + 1e-3
    if "Fraser" in kind or "DRad" in kind:
        assert largest < 0.05


@pytest.mark.parametrize("given, said", [
    (("eModeleRadFour7x2", [0.0], [1.0]), "RadFour7x2 is not supported; expected one of eMo"),
    (("eModeleEbner", [0.0], []), "eModeleEbner needs 1 Etats, but has 0"),
    (("eModelePolyDeg2", [0.0], [-1.0, 0.0, 0.0]), "the first of Etats must be positive"),
    (("eModele_FishEye_10_5_5", [1.0] * 25, [1.0]), "only the first 24 Params are supported"),
])  # fmt: skip
def test_unified_distortions_that_are_refused(tmp_path, given, said):
    path = tmp_path / "AutoCal_cam.xml"
    path.write_text(unified(*given))
    with pytest.raises(InputError, match=said):
        read_cameras(path)
    path.write_text(unified(*given).replace("M2C", "C2M"))
    with pytest.raises(InputError, match="ModUnif with KnownConv eConvApero_DistC2M"):
        read_cameras(path)
