"""GeoTIFFs written completely or not at all: a full disk is reported with the file.

GDAL keeps blocks in memory and writes some of them when the file is closed; an error there is not
reported, and the file is incomplete. So every block is read again and compared before the file gets
its name. Messages of libtiff are silenced: the command line ends in one line.
"""

import os
import shutil
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.writing.replacing import disk_of, replace_file
from jaxbundle.system.rasters import open_plain, rasterio
from jaxbundle.system.temporaries import temporary

if TYPE_CHECKING:
    from rasterio.io import DatasetWriter


class RasterWriter:
    """A raster being written, block by block, from any thread."""

    def __init__(self, raster: "DatasetWriter"):
        self._raster = raster
        self._lock = threading.Lock()
        self.sums: dict[tuple, int] = {}
        """The checksum of every block, by its window."""

    def write(self, values: np.ndarray, first_row: int = 0, first_column: int = 0) -> None:
        """Write values [band, row, column] from a row and a column on."""
        window = (
            (first_row, first_row + values.shape[1]),
            (first_column, first_column + values.shape[2]),
        )
        with self._lock, _silence:
            self._raster.write(values, window=window)
        self.sums[window] = _checksum(values)

    def describe(self, names: Sequence[str]) -> None:
        """Name the bands."""
        self._raster.descriptions = tuple(names)

    def scale(self, scales: Sequence[float], offsets: Sequence[float]) -> None:
        """Scales and offsets of the stored values of the bands; 1 and 0 need none."""
        if any(s != 1 for s in scales) or any(o != 0 for o in offsets):
            self._raster.scales, self._raster.offsets = tuple(scales), tuple(offsets)


@contextmanager
def write_raster(
    target: str | Path,
    width: int,
    height: int,
    count: int,
    dtype: np.dtype | str,
    finish: Callable[[Path], None] | None = None,
    **profile: Any,
) -> Iterator[RasterWriter]:
    """A GeoTIFF to write, which gets its name when it is completely on the disk.

    **Arguments:** as of `rasterio.open`; `finish` is called with the complete file before it gets
    its name, and may replace it by one of the same values (`add_overviews`, `make_cog`).

    **Raises:** `InputError` if it cannot be written, naming it and its disk.
    """
    package = rasterio()
    needed = width * height * count * np.dtype(dtype).itemsize
    with suppress(OSError):
        if needed > shutil.disk_usage(Path(os.path.realpath(target)).parent).free:
            raise _unwritable(target, f"{needed / 1e6:.6g} MB are needed")
    with replace_file(target) as name:
        try:
            with _silence:
                raster = open_plain(
                    name,
                    "w",
                    driver="GTiff",
                    width=width,
                    height=height,
                    count=count,
                    dtype=dtype,
                    BIGTIFF="IF_SAFER",  # where the file might exceed 4 GB
                    **profile,
                )
            writer = RasterWriter(raster)
            try:
                yield writer
            finally:
                with _silence:
                    raster.close()
            is_complete = _is_complete(name, writer.sums)
            if is_complete and finish is not None:
                with _silence:
                    finish(name)
                is_complete = _is_complete(name, writer.sums)
        except package.errors.RasterioError as error:
            reason = error.__cause__ or error
            raise _unwritable(target, " ".join(str(reason).split()).rstrip(".")) from None
        if not is_complete:
            raise _unwritable(target, "the written data are not on the disk")


def add_overviews(path: Path, size: tuple[int, int], nearest: bool, min_size: int = 256) -> None:
    """Add overviews to a GeoTIFF: half the size, a quarter and so on, each pixel the mean of those
    with data that it covers, or one of them (`nearest`).

    **Arguments:** `min_size`: rows and columns down to which the overviews go, those of a tile.
    """
    package = rasterio()
    factors = []
    while max(size) > min_size * 2 ** len(factors):
        factors.append(2 ** (len(factors) + 1))
    if not factors:
        return
    kinds = package.enums.Resampling
    with open_plain(path, "r+") as raster:
        raster.build_overviews(factors, kinds.nearest if nearest else kinds.average)


def make_cog(path: Path, compress: str, block: int, nearest: bool) -> None:
    """Replace a GeoTIFF with its overviews by a Cloud Optimized GeoTIFF of the same values."""
    import rasterio.shutil

    cog_path = path.with_name(f"{path.stem}.cog{path.suffix}")
    with temporary(cog_path):
        options = {"compress": compress, "predictor": "yes"} if compress != "none" else {}
        rasterio.shutil.copy(
            path,
            cog_path,
            driver="COG",
            BLOCKSIZE=block,
            OVERVIEWS="AUTO",
            OVERVIEW_RESAMPLING="nearest" if nearest else "average",
            BIGTIFF="IF_SAFER",
            **options,
        )
        os.replace(cog_path, path)


def _is_complete(path: Path, sums: Mapping[tuple, int]) -> bool:
    """Whether a file has the values that were written, by the checksum of every block."""
    with _silence, open_plain(path) as raster:
        return all(_checksum(raster.read(window=window)) == sum for window, sum in sums.items())


def _unwritable(target: str | Path, reason: str) -> InputError:
    return InputError(f"{target}: cannot be written: {reason}{disk_of(target)}")


def _checksum(values: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(values).data)


class _Silence:
    """Standard error of the process is silenced while any thread is in such a block.

    The line of an interrupt is still printed: `system.interrupts` keeps a separate stream.
    """

    def __init__(self):
        self._lock = threading.Lock()
        self._blocks = 0
        self._kept: int | None = None

    def __enter__(self) -> None:
        with self._lock:
            self._blocks += 1
            if self._blocks == 1:
                with suppress(OSError), open(os.devnull, "wb") as null_device:
                    # Libtiff writes to the descriptor itself, past Python's sys.stderr.
                    self._kept = os.dup(2)
                    os.dup2(null_device.fileno(), 2)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0 and self._kept is not None:
                os.dup2(self._kept, 2)
                os.close(self._kept)
                self._kept = None


_silence = _Silence()
