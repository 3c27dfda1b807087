"""Products with a rigorous model and RPC: both are compared when they are read."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from pushbroom_scenes import LINES, PERIOD
from test_rpc_products import digitalglobe
from test_rpc_products import dimap as dimap_rpc
from test_xml_products import dimap, worldview

from jaxbundle.commands.scanner_inputs import surface_under
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.scanner.csm_writing import write_csm_state
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.rpc import read_rpc, write_rpc
from jaxbundle.pushbroom import rpc as polynomials
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.rpc.fitting import fit_rpc, image_table
from jaxbundle.pushbroom.surfaces import Height

FOLDER = Path(__file__).parents[2] / ".." / "shared" / "data" / "real" / "satellite"
real = pytest.mark.skipif(not FOLDER.is_dir(), reason="../shared/data/real/satellite is not here")
HEIGHTS = np.linspace(0.0, 1000.0, 4)
locate = jax.jit(locate_points)
ground = jax.jit(jax.vmap(polynomials.locate, (None, 0, 0, None)))


def scene():
    """Lines of 1 m: 0.1 s in all, smooth enough for polynomials."""
    last = f"{LINES} {LINES * PERIOD / 40!r}"
    return worldview(tlc=f"<TLCLIST>0 0</TLCLIST><TLCLIST>{last}</TLCLIST>")


def moved(rpc, lines):
    return eqx.tree_at(lambda r: r.line_offset, rpc, rpc.line_offset + lines)


@pytest.fixture(scope="module")
def uncorrected(tmp_path_factory):
    """RPC fitted to the rigorous model of a WorldView file without corrections."""
    folder = tmp_path_factory.mktemp("worldview")
    (folder / "image.xml").write_text(scene())
    (folder / "plain.toml").write_text(
        '[scanner]\nsource = "image.xml"\n[corrections]\nlight_time = false\naberration = false\n'
        "refraction = false\n"
    )
    image = read_scanner(folder / "plain.toml").image
    return fit_rpc(image_table(image, WGS84, HEIGHTS, (9, 9))).rpc


def with_rpc(folder, rpc, error=0.1):
    inner = digitalglobe(rpc).removeprefix("<isd>").removesuffix("</isd>")
    inner = inner.replace("<IMAGE>", f"<IMAGE><ERRBIAS>3.0</ERRBIAS><ERRRAND>{error}</ERRRAND>")
    path = folder / "image.xml"
    path.write_text(scene().replace("</isd>", f"{inner}</isd>"))
    return path


@pytest.mark.further
def test_corrections_are_those_that_agree_with_the_rpc(tmp_path, uncorrected):
    found = read_scanner(with_rpc(tmp_path, uncorrected))
    assert found.image.corrections == Corrections()
    (said,) = found.warnings
    assert "image.xml: no correction applied" in said and "light time, aberration and refr" in said


def test_corrections_that_are_given_are_kept_and_the_difference_is_said(tmp_path, uncorrected):
    """Aberration moves the ground by ρ·v/c: 600 km, 7.5 km/s."""
    with_rpc(tmp_path, uncorrected)
    path = tmp_path / "given.toml"
    path.write_text('[scanner]\nsource = "image.xml"\n[corrections]\nrefraction = false\n')
    found = read_scanner(path)
    assert found.image.corrections == (True, True, False)
    (said,) = found.warnings
    assert "differ by more than their accuracy explains" in said and "[corrections]" in said
    assert 12 < float(said.partition("explains: ")[2].split()[0]) < 18
    assert "With no correction they agree" in said
    assert read_scanner(with_rpc(tmp_path, uncorrected, 20.0)).warnings == ()


def test_corrections_that_the_rpc_choose_are_asked_for(tmp_path, uncorrected):
    """`corrections = "auto"` is the default, and says so where there are no RPC; none explain RPC
    that are moved along the line."""
    with_rpc(tmp_path, uncorrected)
    path = tmp_path / "auto.toml"
    path.write_text('[scanner]\nsource = "image.xml"\ncorrections = "auto"\n')
    assert read_scanner(path).image.corrections == Corrections()
    for shift, others in ((40, "others leave more"), (-40, "the smallest difference, with ")):
        offset = uncorrected.sample_offset + shift
        away = eqx.tree_at(lambda r: r.sample_offset, uncorrected, offset)
        with_rpc(tmp_path, away)
        (said,) = read_scanner(path).warnings
        assert f"No corrections explain it; {others}" in said and "Check the origin" in said
    (tmp_path / "image.xml").write_text(scene())
    (said,) = read_scanner(path).warnings
    assert "has no RPC" in said and "light time, aberration and refraction applied" in said
    path.write_text(path.read_text() + "[corrections]\nrefraction = true\n")
    with pytest.raises(InputError, match="give one of them"):
        read_scanner(path)
    path.write_text('[scanner]\nsource = "image.xml"\ncorrections = "none"\n')
    with pytest.raises(InputError, match='expected "auto"'):
        read_scanner(path)


@pytest.mark.parametrize("shift, expected", [(0.0, None), (1.0, "origin of lines and pixels")])
def test_files_beside_each_other(tmp_path, shift, expected):
    """DIM_….XML with RPC_….XML, whose pixels may be counted from another origin."""
    path = tmp_path / "DIM_PHR.XML"
    path.write_text(dimap(), encoding="latin-1")
    image = read_scanner(path).image
    rpc = fit_rpc(image_table(image, WGS84, HEIGHTS, (9, 9))).rpc
    (tmp_path / "RPC_PHR.XML").write_text(dimap_rpc(moved(rpc, shift), domain=(-30, 5)))
    found = read_scanner(path)
    assert found.image.corrections == Corrections()
    if expected is None:
        assert found.warnings == ()
    else:
        (said,) = found.warnings
        assert expected in said and "RPC_PHR.XML" in said and " 1 pixel" in said


def test_damaged_rpc_do_not_prevent_reading(tmp_path, uncorrected):
    path = with_rpc(tmp_path, uncorrected)
    path.write_text(path.read_text().replace("<LATSCALE>", "<LATSCALE>x"))
    found = read_scanner(path)
    (said,) = found.warnings
    assert "not compared with its RPC" in said and "LATSCALE" in said
    write_rpc(tmp_path / "image_RPC.TXT", uncorrected)  # of another name: not looked for
    path.write_text(scene())
    assert read_scanner(path).warnings == ()


def distances(name):
    """Metres on the ground between the model as it is read and the RPC of a file, at the height of
    the latter, and the warnings."""
    found, rpc = read_scanner(FOLDER / name), read_rpc(FOLDER / name)
    line, pixel = (np.linspace(0, n - 1, 9) for n in (found.image.lines, found.image.pixels))
    places = [v.ravel() for v in np.meshgrid(line, pixel)]
    height = float(rpc.height_offset)
    X = locate(found.image, Height(height, WGS84), *places)
    longitude, latitude, _ = ground(rpc, *places, height)
    here = geodetic(WGS84, tuple(np.asarray(X)))
    east = (np.asarray(here[0]) - longitude) * np.cos(latitude) * WGS84.a
    return np.hypot(east, (np.asarray(here[1]) - latitude) * WGS84.a), found


@real
def test_states_adjusted_by_another_program_are_read():
    """Lengths of quaternions from 0.99992 to 1.00029: less than is worth a word."""
    found = read_scanner(FOLDER / "jitter_solved_a.adjusted_state.json")
    assert found.warnings == ()


@pytest.mark.parametrize("height, expected, said", [
    (None, 3443.0, "from 2942 to 3944 m, not for 0: the ground is taken at 3443 m"),
    (100.0, 100.0, ""),
])  # fmt: skip
def test_without_a_height_the_ground_is_where_the_rpc_hold(
    uncorrected, tmp_path, height, expected, said
):
    product = read_scanner(with_rpc(tmp_path, uncorrected))
    low, high = product.rpc_heights
    assert low <= 0 <= high
    high_up, told = dataclasses.replace(product, rpc_heights=(2942.0, 3944.0)), []
    assert surface_under(high_up, height, None, None, told.append).level == expected
    assert len(told) == bool(said) and said in "".join(told)


@real
@pytest.mark.further
def test_a_state_follows_worldview_1(tmp_path):
    """Its tables are coarser than those of the product at first, and come no nearer by chance."""
    product = read_scanner(FOLDER / "wv01.xml")
    fit = write_csm_state(tmp_path / "state.json", product.image, product.earth, height=3443.0)
    assert fit.trajectory < 1.5e-4 and 0.03 < fit.corrections < 0.05


@real
@pytest.mark.further
def test_worldview_1_agrees_with_its_rpc():
    """With all corrections to centimetres (17 m apart without them): the origin of lines and pixels
    and the refraction are those of the vendor."""
    off, found = distances("wv01.xml")
    assert found.image.corrections == (True, True, True) and found.warnings == ()
    assert off.max() < 0.1


@real
def test_worldview_3_agrees_with_its_rpc():
    """Its attitudes contain the corrections; 18 m apart with those of WorldView-1."""
    off, found = distances("wv03_a.xml")
    assert found.image.corrections == Corrections() and len(found.warnings) == 1
    assert np.sqrt(np.mean(off**2)) < 0.4
