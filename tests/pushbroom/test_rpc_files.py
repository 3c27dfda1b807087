"""Files of RPC: round trips to the last digit, GDAL's reading of the same, what is refused."""

import jax
import numpy as np
import pytest
import rasterio
from rpc_scenes import made_up

from jaxbundle.errors import InputError
from jaxbundle.io.scanner.rpc import StatedErrors, read_rpc, read_stated_errors, write_rpc

RPC = made_up(longitude_offset=12.3)


def assert_same(found, expected=RPC):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def write_raster(path):
    with rasterio.open(
        path, "w", driver="GTiff", height=4, width=4, count=1, dtype="uint8",
        transform=rasterio.transform.Affine(1, 0, 5, 0, -1, 9),
    ) as target:  # fmt: skip
        target.write(np.arange(16, dtype="uint8").reshape(1, 4, 4))


@pytest.mark.parametrize("name", ["image_RPC.TXT", "image.RPB", "image.tif"])
def test_round_trips(tmp_path, name):
    path = tmp_path / name
    if path.suffix == ".tif":
        write_raster(path)
    write_rpc(path, RPC)
    if path.suffix == ".tif":
        for a, b in zip(jax.tree.leaves(read_rpc(path)), jax.tree.leaves(RPC), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13)
    else:
        assert_same(read_rpc(path))
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("errors", [StatedErrors(3.29, 0.26), StatedErrors()])
@pytest.mark.parametrize("name", ["image_RPC.TXT", "image.RPB", "image.tif"])
def test_stated_errors_are_kept_and_none_is_not_zero(tmp_path, name, errors):
    path = tmp_path / name
    write_raster(tmp_path / "image.tif")
    write_rpc(path, RPC, errors)
    assert read_stated_errors(path) == errors
    if path.suffix != ".tif":
        assert ("err" in path.read_text().lower()) == bool(errors.bias)
    with rasterio.open(tmp_path / "image.tif") as source:
        tags = source.rpcs
    unknown = [(-1.0, -1.0), (None, None)]
    assert (tags.err_bias, tags.err_rand) in ([(*errors,)] if errors.bias else unknown)


def test_an_unknown_ending_of_coefficients_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"x.rbp: coefficients end in .txt, .rpb"):
        write_rpc(tmp_path / "x.rbp", RPC)


@pytest.mark.parametrize("name", ["image_RPC.TXT", "image.RPB"])
def test_gdal_reads_what_is_written(tmp_path, name):
    """The file beside a raster gives GDAL the same coefficients."""
    write_rpc(tmp_path / name, RPC)
    write_raster(tmp_path / "image.tif")
    with rasterio.open(tmp_path / "image.tif") as source:
        tags = source.rpcs
    assert tags.line_off == float(RPC.line_offset) and tags.samp_scale == float(RPC.sample_scale)
    assert tags.long_off == float(RPC.longitude_offset) and tags.lat_off == -23.4
    assert tags.line_num_coeff == RPC.line_numerator.tolist()
    assert tags.samp_den_coeff == RPC.sample_denominator.tolist()


def test_as_providers_write_it(tmp_path):
    """Signs, leading zeros, units, exponents, and lines about other things."""
    write_rpc(tmp_path / "own.txt", RPC)
    text = (tmp_path / "own.txt").read_text().replace("LINE_OFF: 3000.5", "LINE_OFF: +003000.50")
    path = tmp_path / "theirs_RPC.TXT"
    path.write_text("ERR_BIAS: 4.5 meters\r\n" + text.replace("\n", "\r\n"))
    assert_same(read_rpc(path))


BROKEN = {
    "missing": ("_RPC.TXT", "LAT_OFF", "LAT_OFT", ["LAT_OFF is missing"]),
    "no number": ("_RPC.TXT", "LONG_OFF: 12.3", "LONG_OFF: twelve", ["line 3", "'twelve'"]),
    "no value": ("_RPC.TXT", "LONG_OFF: 12.3 degrees", "LONG_OFF:", ["line 3", "finite"]),
    "infinite": ("_RPC.TXT", "LONG_OFF: 12.3", "LONG_OFF: inf", ["line 3", "finite"]),
    "feet": ("_RPC.TXT", "600.0 meters", "600.0 feet", ["line 10", "feet", "meters"]),
    "twice": ("_RPC.TXT", "SAMP_OFF", "LINE_OFF", ["line 2", "LINE_OFF", "twice"]),
    "no name": ("_RPC.TXT", "SAMP_OFF: ", "SAMP_OFF ", ["line 2", "NAME: value"]),
    "scale": ("_RPC.TXT", "HEIGHT_SCALE: 600", "HEIGHT_SCALE: 0", ["height is 0"]),
    "RPC00A": (".RPB", "RPC00B", "RPC00A", ["line 3", "RPC00A", "order"]),
    "coefficients": (".RPB", "lineNumCoef = (", "lineNumCoef = (1.0,", ["21 coef", "20"]),
    "bracket": (".RPB", "lineDenCoef = (\n\t\t\t1.0", "lineDenCoef = (\n\t\t\tone", ["'one'"]),
    "gone": (".RPB", "sampOffset", "sumpOffset", ["'sumpOffset'", "mean 'sampOffset'"]),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_refused(tmp_path, case):
    name, old, new, words = BROKEN[case]
    path = tmp_path / f"image{name}"
    write_rpc(path, RPC)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as refused:
        read_rpc(path)
    for word in ("image" + name, *words):
        assert word in str(refused.value), refused.value


def test_rasters_without_tags(tmp_path):
    write_raster(tmp_path / "bare.tif")
    with pytest.raises(InputError, match="no RPC tags"):
        read_rpc(tmp_path / "bare.tif")
    (tmp_path / "empty.tif").write_text("")
    with pytest.raises(InputError, match="empty.tif"):
        read_rpc(tmp_path / "empty.tif")
    with pytest.raises(InputError, match="raster that exists"):
        write_rpc(tmp_path / "nowhere.tif", RPC)
    with pytest.raises(InputError, match="no such file"):
        read_rpc(tmp_path / "nowhere_RPC.TXT")
