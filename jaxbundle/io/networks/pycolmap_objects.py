"""Reconstructions of pycolmap in memory: to networks and back.

They go through the binary form of COLMAP's models in a temporary folder, which all versions of
pycolmap write and read, with rigs and frames (`io/networks/colmap.py` has the conventions).
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap import fill_colmap, read_colmap
from jaxbundle.io.networks.settings import require_overrides
from jaxbundle.io.results.result_project import adjusted_network
from jaxbundle.network.tables import Network, require_network


def from_pycolmap(reconstruction: Any, overrides: Sequence[str] = ()) -> Network:
    """The network of a `pycolmap.Reconstruction`, ready for `jaxbundle.adjust`.

    **Arguments:** `overrides`: settings KEY=VALUE as in `jaxbundle.read_network`, such as
    `["free=f,k"]`: no camera parameter is free without them. Cameras are named by number, images by
    name; image points without an object point are left out; σ is 1 px, the datum inner.

    **Raises:** `InputError` for other objects, a reconstruction without images, and for settings.
    """
    require_overrides(overrides)
    write = getattr(reconstruction, "write_binary", None)
    if write is None:
        raise InputError(f"expected a pycolmap.Reconstruction, got {type(reconstruction).__name__}")
    with tempfile.TemporaryDirectory() as folder:
        write(folder)
        try:
            network = read_colmap(folder, overrides)
        except InputError as error:
            raise InputError(str(error).replace(folder, "reconstruction")) from None
    return network.replace(name="reconstruction")


def to_pycolmap(network: Any) -> Any:
    """A `pycolmap.Reconstruction` of a network, or of an `Adjustment` at its solution.

    Cameras and points keep their ids if these are whole numbers, otherwise they are numbered from
    1; every image keeps its name. Rigs become rigs and frames. σ are lost.

    **Raises:** `InputError` without pycolmap, for a camera whose model COLMAP does not have, or
    missing coordinates.
    """
    try:
        import pycolmap
    except ImportError:
        raise InputError("pycolmap is needed: pip install pycolmap") from None
    if hasattr(network, "minimum"):
        network = adjusted_network(network)
    require_network(network)
    with tempfile.TemporaryDirectory() as folder:
        fill_colmap(network, Path(folder), text=False)
        return pycolmap.Reconstruction(folder)
