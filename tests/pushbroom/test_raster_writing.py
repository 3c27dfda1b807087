"""A full disk: the raster is named with its disk, and nothing is left behind."""

import os

import numpy as np
import pytest
import rasterio
from full_disk import files_end_at

from jaxbundle.errors import InputError
from jaxbundle.io.rasters import correction, error_maps
from jaxbundle.io.rasters import writing as raster_writing
from jaxbundle.io.rasters.map_blocks import MapBands, write_map
from jaxbundle.io.rasters.maps import MapGrid, MapSystem
from jaxbundle.pushbroom.surfaces import Plane
from jaxbundle.system.temporaries import defer


def write(target):
    values = np.random.default_rng(1).integers(0, 255, (1, 256, 256), dtype=np.uint8)
    write_map(target, MapSystem(None, None), MapGrid(0.0, 0.0, 1.0, 600, 600), Plane(0.0),
              MapBands(1, "uint8"), lambda nodes: values.astype(float))  # fmt: skip


@pytest.mark.parametrize("cache", [64, 2**20], ids=["at closing", "at a block"])
def test_a_full_disk_names_the_map_and_its_disk(tmp_path, capfd, cache):
    """GDAL with a large cache writes when the file is closed, and ignores errors then."""
    target = tmp_path / "map.tif"
    target.write_text("the old one")
    with rasterio.Env(GDAL_CACHEMAX=cache), files_end_at(100_000):
        with pytest.raises(InputError) as found:
            write(target)
    said = str(found.value)
    assert said.startswith(f"{target}: cannot be written: ")
    assert " are free on the disk at /" in said
    assert "\n" not in said and capfd.readouterr().err == ""
    assert target.read_text() == "the old one" and os.listdir(tmp_path) == ["map.tif"]
    write(target)
    with rasterio.open(target) as raster:
        assert raster.read(1)[300:].any()


def test_a_disk_too_small_is_found_before_anything_is_made(tmp_path, monkeypatch):
    usage = lambda path: type("", (), {"free": 300_000})
    monkeypatch.setattr(raster_writing.shutil, "disk_usage", usage)
    with pytest.raises(InputError, match="map.tif: cannot be written: 0.36 MB are needed; 0.3 MB"):
        write(tmp_path / "map.tif")
    assert os.listdir(tmp_path) == []


def test_no_interrupt_waits_while_a_raster_is_written_or_verified(tmp_path, monkeypatch, capfd):
    """Both take minutes for a large one, and nobody sees what libraries say of it."""
    moments = []

    def note(package, name):
        work = getattr(package, name)

        def noted(*arguments, **options):
            os.write(2, name.encode())
            moments.append((name, defer(lambda: None)))
            return work(*arguments, **options)

        monkeypatch.setattr(package, name, noted)

    for name in ("write", "close"):
        note(rasterio.io.DatasetWriter, name)
    note(rasterio.io.DatasetReader, "read")
    write(tmp_path / "map.tif")
    assert moments == [("write", False)] * 9 + [("close", False)] + [("read", False)] * 9
    assert capfd.readouterr().err == ""


def test_a_raster_of_errors_on_a_full_disk(tmp_path):
    bands = {"east [m]": np.random.default_rng(1).normal(size=(200, 200))}
    with files_end_at(50_000), pytest.raises(InputError, match="e.tif: cannot be written: .*disk"):
        error_maps.write_image_raster(tmp_path / "e.tif", np.arange(200.0), np.arange(200.0), bands)
    assert os.listdir(tmp_path) == []


def test_a_source_that_cannot_be_read_is_named_itself(tmp_path, monkeypatch):
    source = tmp_path / "source.tif"
    with rasterio.open(source, "w", driver="GTiff", width=4, height=4, count=1, dtype="uint8",
                       compress="deflate",
                       transform=rasterio.transform.Affine(1, 0, 5, 0, -1, 5)) as raster:
        raster.write(np.arange(16, dtype=np.uint8).reshape(1, 4, 4))
        window = raster.block_window(1, 0, 0)
    content = source.read_bytes()
    begin = content.index(b"x\x9c")  # of zlib
    source.write_bytes(content[: begin + 2] + b"\xff" * 6 + content[begin + 8 :])
    assert window.height == 4  # one strip
    anywhere = np.ones((correction.BLOCK_SIZE, correction.BLOCK_SIZE))
    monkeypatch.setattr(correction, "block_places", lambda *_: (anywhere, anywhere))
    image = type("", (), {"lines": 4, "pixels": 4})
    with pytest.raises(InputError, match=f"^{source}: is not a raster.*: Read failed"):
        correction.write_corrected(
            source, tmp_path / "map.tif", image, None, Plane(0.0), MapSystem(None, None),
            MapGrid(5.0, 5.0, 1.0, 4, 4),
        )  # fmt: skip
    assert os.listdir(tmp_path) == ["source.tif"]


def test_a_device_is_not_replaced_by_a_map(tmp_path):
    (tmp_path / "null.tif").symlink_to("/dev/null")
    with pytest.raises(InputError, match="null.tif: cannot be written: it is not a file"):
        write(tmp_path / "null.tif")
