"""Model states of usgscsm written and read back: the same ground, to a micrometre."""

import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from pushbroom_scenes import above_a_plane, satellite
from rpc_scenes import smooth_image

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io import read_scanner
from jaxbundle.io.scanner.csm_writing import write_csm_state
from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable, LineTimes
from jaxbundle.pushbroom.surfaces import Height


def differences(one, other, heights=(0.0, 3000.0)):
    lines = np.linspace(0, one.lines - 1, 13)
    pixels = np.linspace(0, one.pixels - 1, 9)
    X = [[np.asarray(locate_lines(i, Height(h), lines, pixels)) for h in heights]
         for i in (one, other)]  # fmt: skip
    return float(np.linalg.norm(np.array(X[0]) - X[1], axis=1).max())


def straight():
    """A straight line of detectors, beside the axis."""
    middle, half = jnp.asarray(199.5), jnp.asarray(200.0)
    return AnglePolynomial(jnp.array([2e-3, 0.015]), jnp.array([0.001]), middle, half)


def images():
    smooth = smooth_image()
    yield "a straight line", dataclasses.replace(smooth, optics=straight())
    yield "polynomials", smooth
    yield "angles", satellite(turns="angles", optics=straight())
    t = smooth.times.time(np.arange(smooth.lines))
    t = t + 1e-5 * (np.arange(len(t)) > 300) * (np.arange(len(t)) - 300)
    yield "two periods", dataclasses.replace(
        smooth, times=LineTimes(jnp.zeros(()), jnp.zeros(()), jnp.asarray(t))
    )


@pytest.mark.parametrize("name, image", [
    pytest.param(*one, id=one[0], marks=() if one[0] == "polynomials" else pytest.mark.further)
    for one in images()
])  # fmt: skip
def test_a_state_read_back_sees_the_same_ground(tmp_path, name, image):
    fit = write_csm_state(tmp_path / "state.json", image, WGS84)
    text = (tmp_path / "state.json").read_text()
    assert text.startswith("USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL\n{")
    found = read_scanner(tmp_path / "state.json")
    assert (found.image.lines, found.image.pixels) == (image.lines, image.pixels)
    off = differences(image, found.image)
    # in metres; what is told is what is found, and only rounding is without a lens
    assert off < 1.5 * fit.ground, fit
    assert off - 1.5 * fit.optics < 1e-6, fit
    assert (fit.optics > 1e-6) == (name in ("polynomials", "two periods"))
    # as in other states: numbers of a row each, all finite
    state = json.loads(text[text.index("{") :])
    assert len(state["m_positions"]) == state["m_numPositions"] == 3 * fit.rows
    assert np.linalg.norm(np.reshape(state["m_quaternions"], (-1, 4)), axis=1) == pytest.approx(1)


@pytest.mark.further
def test_corrections_go_into_the_attitude(tmp_path):
    """What a rotation of a line cannot contain is told, and is a centimetre."""
    for corrections in (Corrections(aberration=True), Corrections(True, True, True)):
        image = dataclasses.replace(smooth_image(), corrections=corrections, optics=straight())
        fit = write_csm_state(tmp_path / "state.json", image, WGS84, height=1000.0)
        found = read_scanner(tmp_path / "state.json").image
        assert not found.corrections.any
        without = dataclasses.replace(image, corrections=Corrections())
        off = differences(image, found, (500.0, 1500.0))
        assert off < 1.2 * fit.ground + 1e-6 and fit.ground < 0.02
        assert differences(image, without, (500.0, 1500.0)) > 10


@pytest.mark.further
def test_what_a_state_cannot_contain_is_told(tmp_path):
    """Jumps of the angular velocity between the rows of slerp; a lens of a high degree."""
    jumps = satellite(optics=straight())
    fit = write_csm_state(tmp_path / "jumps.json", jumps, WGS84, max_rows=1000)
    off = differences(jumps, read_scanner(tmp_path / "jumps.json").image)
    assert 1e-6 < fit.trajectory < 1 and off < 2 * fit.ground
    assert 500 < fit.rows <= 1000
    u = np.linspace(-1, 1, 400)
    wavy = AngleTable(jnp.arctan(0.015 * u + 1e-6 * np.sin(9 * u)), jnp.arctan(0.001 * u**2))
    fit = write_csm_state(
        tmp_path / "lens.json", dataclasses.replace(smooth_image(), optics=wavy), WGS84
    )
    assert 0.1 < fit.optics < 2


def test_offsets_are_not_lost_in_writing(tmp_path):
    """A scanner file has no place for them."""
    pitch = jnp.array([0.01, 0.0, 0.0])
    image = eqx.tree_at(lambda image: image.offsets.attitude, above_a_plane(), pitch)
    with pytest.raises(InputError, match="A: the trajectory has offsets"):
        write_scanner_image(tmp_path, "A", image, None)


def test_a_local_frame_has_no_state(tmp_path):
    with pytest.raises(InputError, match="ellipsoid of revolution"):
        write_csm_state(tmp_path / "state.json", above_a_plane(), None)
