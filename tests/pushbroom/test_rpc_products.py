"""RPC in the files of products: DIMAP, DigitalGlobe, OSSIM; negative scales; XML of other kinds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rpc_scenes import made_up, places
from test_rpc_files import RPC, assert_same, write_raster

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.scanner.rpc import read_rpc, write_rpc
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.pushbroom.rpc.polynomials import locate_points_on, project_points
from jaxbundle.pushbroom.surfaces import Height

PARTS = [("LINE", "line"), ("SAMP", "sample"), ("LONG", "longitude"), ("LAT", "latitude"),
         ("HEIGHT", "height")]  # fmt: skip
POLYNOMIALS = [(f"{short}_{part[:3].upper()}", f"{axis}_{part}")
               for short, axis in PARTS[:2] for part in ("numerator", "denominator")]  # fmt: skip


def dimap(rpc, profile="PHR_SENSOR", origin=1.0, domain=(1, 1), inverse="Inverse_Model"):
    """As in the Pléiades User Guide: coefficients one by one; `origin` is the row and column of
    the centre of the first pixel, `domain` where the coefficients begin to hold."""
    value = lambda name: float(getattr(rpc, name))
    shift = {"line": origin, "sample": origin}
    scales = "".join(
        f"<{short}_OFF>{value(f'{axis}_offset') + shift.get(axis, 0)!r}</{short}_OFF>"
        f"<{short}_SCALE>{value(f'{axis}_scale')!r}</{short}_SCALE>" for short, axis in PARTS
    )  # fmt: skip
    coefficients = "".join(
        f"<{short}_COEFF_{k}>{float(c)!r}</{short}_COEFF_{k}>"
        for short, name in POLYNOMIALS for k, c in enumerate(getattr(rpc, name), 1)
    )  # fmt: skip
    row, column = domain or (0, 0)
    limits = f"<FIRST_ROW>{row}</FIRST_ROW><FIRST_COL>{column}</FIRST_COL>" if domain else ""
    kind = "ImagetoGround" if inverse == "GroundtoImage_Values" else "Direct_Model"
    domain = f"{kind}_Validity_Domain"
    head = f"<METADATA_PROFILE>{profile}</METADATA_PROFILE>" if profile else ""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document xmlns="http://example.org/dimap">
<Metadata_Identification>{head}</Metadata_Identification><Rational_Function_Model><Global_RFM>
<Direct_Model><SAMP_NUM_COEFF_1>7</SAMP_NUM_COEFF_1></Direct_Model>
<{inverse}>{coefficients}</{inverse}><RFM_Validity><{domain}>{limits}</{domain}>{scales}
</RFM_Validity></Global_RFM></Rational_Function_Model></Dimap_Document>"""


def digitalglobe(rpc):
    value = lambda name: repr(float(getattr(rpc, name)))
    scales = "".join(
        f"<{short}OFFSET>{value(f'{axis}_offset')}</{short}OFFSET>"
        f"<{short}SCALE>{value(f'{axis}_scale')}</{short}SCALE>" for short, axis in PARTS
    )  # fmt: skip
    lists = ""
    for short, name in POLYNOMIALS:
        tag = short.replace("_", "") + "COEF"
        numbers = " ".join(repr(float(c)) for c in getattr(rpc, name))
        lists += f"<{tag}List><{tag}>{numbers}</{tag}></{tag}List>"
    return f"<isd><RPB><SPECID>RPC00B</SPECID><IMAGE>{scales}{lists}</IMAGE></RPB></isd>"


def geom(rpc):
    lines = ["polynomial_format:  B", "type:  ossimRpcModel"]
    for short, axis in PARTS:
        lines.append(f"{short.lower()}_off:  {float(getattr(rpc, f'{axis}_offset'))!r}")
        lines.append(f"{short.lower()}_scale:  {float(getattr(rpc, f'{axis}_scale'))!r}")
    for short, name in POLYNOMIALS:
        lines += [f"{short.lower()}_coeff_{k:02d}:  {float(c)!r}"
                  for k, c in enumerate(getattr(rpc, name))]  # fmt: skip
    lines += ["adjustment_0.adj_param_0.parameter:  0"]
    return "\n".join(lines) + "\n"


EARLY = (("line", "Row"), ("sample", "Col"), ("longitude", "Lon"), ("latitude", "Lat"),
         ("height", "Alt"))  # fmt: skip


def early(rpc):
    """As in the first products of Pléiades: A the scale, B the offset, pixels counted from 1."""
    scales = "".join(
        f"<{name}><A>{float(getattr(rpc, f'{axis}_scale'))!r}</A>"
        f"<B>{float(getattr(rpc, f'{axis}_offset')) + (axis in ('line', 'sample'))!r}</B></{name}>"
        for axis, name in EARLY
    )
    lists = ""
    for axis, name in (("line", "F_ROW"), ("sample", "F_COL")):
        both = (*getattr(rpc, f"{axis}_numerator"), *getattr(rpc, f"{axis}_denominator"))
        lists += f"<{name}>{' '.join(repr(float(c)) for c in both)}</{name}>"
    return f"""<PHR_Dimap_Document><Geoposition><Rational_Sensor_Model><Global_RFM>
<Inverse_Model>{lists}</Inverse_Model><RFM_Validity>{scales}</RFM_Validity></Global_RFM>
</Rational_Sensor_Model></Geoposition></PHR_Dimap_Document>"""


PRODUCTS = {
    "Pleiades, first products": ("PHRDIMAP.XML", early(RPC)),
    "Pleiades": ("RPC_PHR.XML", dimap(RPC)),
    "Pleiades, domain beyond the image": ("RPC_PHR.XML", dimap(RPC, domain=(-27, -791))),
    "SPOT 6": ("RPC_SPOT6.XML", dimap(RPC, "S6_SENSOR", 0.0, (0, 0))),
    "SPOT 7, domain within the image": ("RPC_SPOT7.XML", dimap(RPC, "S7_SENSOR", 0.0, (40, 9))),
    "Pleiades Neo": ("RPC_PNEO.XML", dimap(
        RPC, "PNEO_SENSOR", 0.0, (-12, -3), "GroundtoImage_Values"
    )),
    "DIMAP 2 of another": ("rpc.xml", dimap(RPC, "", 1.0, None)),
    "DIMAP 3 of another": ("rpc.xml", dimap(RPC, "X_SENSOR", 0.0, None, "GroundtoImage_Values")),
    "WorldView": ("image.XML", digitalglobe(RPC)),
    "OSSIM": ("image.geom", geom(RPC)),
    "OSSIM, prefix": ("rpc.txt", geom(RPC).replace("line_", "image0.geometry.projection.line_")),
}  # fmt: skip


@pytest.mark.parametrize("case", PRODUCTS)
def test_files_of_products(tmp_path, case):
    name, text = PRODUCTS[case]
    (tmp_path / name).write_text(text)
    found = read_rpc(tmp_path / name)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(RPC), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-15)


REFUSED = {
    "other xml": ("a.xml", "<PAMDataset><Metadata/></PAMDataset>", ["another kind", "PAMDataset"]),
    "rigorous": (
        "DIM.XML", "<Dimap_Document><Geometric_Data/></Dimap_Document>", ["without RPC", "RPC_"],
    ),
    "no xml": ("a.xml", "<Dimap_Document>", ["not valid XML"]),
    "entities": ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', ["entities"]),
    "no number": (
        "a.xml", dimap(RPC).replace("<LAT_OFF>", "<LAT_OFF>x"), ["RFM_Validity/LAT_OFF", "'x-23.4"],
    ),
    "no inverse": ("a.xml", dimap(RPC, inverse="Other"), ["Inverse_Model is missing"]),
    "few": (
        "a.xml", digitalglobe(RPC).replace("<LINENUMCOEF>", "<LINENUMCOEF>1 "),
        ["LINENUMCOEF has 21 numbers; expected 20"],
    ),
    "RPC00A": ("a.xml", digitalglobe(RPC).replace("RPC00B", "RPC00A"), ["SPECID", "RPC00A"]),
    "format A": (
        "a.geom", geom(RPC).replace("format:  B", "format:  A"), ["line 1", "polynomial_format"],
    ),
    "adjusted": (
        "a.geom", geom(RPC).replace("parameter:  0", "parameter:  0.25"), ["adj_param_0", "not 0"],
    ),
    "geom": ("a.geom", geom(RPC).replace("samp_off", "samp_of"), ["samp_off is missing"]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(tmp_path, case):
    name, text, words = REFUSED[case]
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as refused:
        read_rpc(tmp_path / name)
    for word in (name, *words):
        assert word in str(refused.value), refused.value


def turned_over(rpc):
    """The same functions with negative scales: odd powers of every variable change sign."""
    powers = np.array([
        [0, 1, 0, 0, 1, 1, 0, 2, 0, 0, 1, 3, 1, 1, 2, 0, 0, 2, 0, 0],
        [0, 0, 1, 0, 1, 0, 1, 0, 2, 0, 1, 0, 2, 0, 1, 3, 1, 0, 2, 0],
        [0, 0, 0, 1, 0, 1, 1, 0, 0, 2, 1, 0, 0, 2, 0, 0, 2, 1, 1, 3],
    ])  # fmt: skip
    odd = jnp.asarray((-1.0) ** powers.sum(0))
    names = [f"{axis}_{part}" for axis in ("line", "sample") for part in ("numerator",)]
    fields = lambda r: tuple(
        getattr(r, n) for n in (*names, "line_denominator", "sample_denominator",
                                *(f"{axis}_scale" for _, axis in PARTS))
    )  # fmt: skip
    values = [-odd * getattr(rpc, n) for n in names]
    values += [odd * getattr(rpc, n) for n in ("line_denominator", "sample_denominator")]
    values += [-getattr(rpc, f"{axis}_scale") for _, axis in PARTS]
    return eqx.tree_at(fields, rpc, tuple(values))


@pytest.mark.parametrize("name", ["image_RPC.TXT", "image.RPB", "image.tif"])
def test_negative_scales_are_read_and_written(tmp_path, name):
    path = tmp_path / name
    if path.suffix == ".tif":
        write_raster(path)
    other = turned_over(RPC)
    write_rpc(path, other)
    found = read_rpc(path)
    if path.suffix != ".tif":
        assert_same(found, other)
    point = places(RPC, 5)
    for a, b in zip(project_points(found, *point), project_points(RPC, *point)):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_negative_scales_lead_to_the_same_ground():
    """The line of sight goes down from the highest height all the same."""
    rpc = made_up()
    line, sample = jnp.array([2000.0, 3500.0]), jnp.array([1800.0, 3000.0])
    surface = Height(500.0, WGS84)
    expected = locate_points_on(rpc, surface, line, sample)
    found = locate_points_on(turned_over(rpc), surface, line, sample)
    for a, b in zip(found, expected):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("name", ["own_RPC.TXT", "own.RPB", "own.XML", "dimap.XML"])
def test_unknown_keys_are_told_or_refused(tmp_path, name):
    path = tmp_path / name
    if name.endswith("XML"):
        path.write_text(dimap(RPC) if name == "dimap.XML" else digitalglobe(RPC))
        add = "</RFM_Validity>" if name == "dimap.XML" else "</IMAGE>"
        line = lambda key: f"<{key}>1</{key}>{add}"
    else:
        write_rpc(path, RPC)
        add = "\n"
        line = lambda key: f"\n{key} = 1;\n" if name == "own.RPB" else f"\n{key}: 1\n"
    text, unknown = path.read_text(), UnknownKeys()
    path.write_text(text.replace(add, line("operator"), 1))
    assert read_rpc(path, unknown).line_offset == read_rpc(path).line_offset
    (message,) = unknown.messages()
    assert path.name in message and "operator" in message.lower()
    path.write_text(text.replace(add, line("lineShift"), 1))
    with pytest.raises(InputError, match="(?i)lineshift.*geometry") as refused:
        read_rpc(path)
    assert path.name in str(refused.value)
