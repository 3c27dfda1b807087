"""Reconstructions of OpenSfM in memory, as networks.

They go through the files that OpenSfM writes of them, in a temporary folder (`opensfm.py` has the
conventions): by `opensfm.io.reconstructions_to_json`, and `TracksManager.as_string`.
"""

import importlib
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxbundle.errors import InputError
from jaxbundle.io.networks.opensfm import RECONSTRUCTION, TRACKS, read_opensfm
from jaxbundle.network.tables import Network


def from_opensfm(reconstruction: Any, tracks: Any = None, overrides: Sequence[str] = ()) -> Network:
    """The network of an `opensfm.types.Reconstruction`, ready for `jaxbundle.adjust`.

    **Arguments:** `tracks`: its `opensfm.pymap.TracksManager`, which has the image points (with
    `opensfm.dataset.DataSet`: `data.load_reconstruction()[0]` and `data.load_tracks_manager()`);
    without it the network has orientations and points only. `overrides`: settings KEY=VALUE as in
    `jaxbundle.read_network`, such as `["free=fx,k1"]`: no camera parameter is free without them.
    Cameras, images and points keep their names; σ is 1 px.

    **Raises:** `InputError` without OpenSfM, for other objects, a reconstruction without shots, and
    for settings.
    """
    if not all(hasattr(reconstruction, name) for name in ("cameras", "shots", "points")):
        raise InputError(
            f"expected an opensfm.types.Reconstruction, got {type(reconstruction).__name__}"
        )
    if tracks is not None and not hasattr(tracks, "as_string"):
        raise InputError(f"expected an opensfm.pymap.TracksManager, got {type(tracks).__name__}")
    try:
        opensfm_io = importlib.import_module("opensfm.io")
    except ImportError:
        raise InputError(
            "OpenSfM is needed, which made these objects; without it, read_network of its folder"
        ) from None
    # By files rather than attributes: these differ between versions of OpenSfM, the files hardly,
    # and their conventions stay in one reader.
    with tempfile.TemporaryDirectory() as folder:
        document = opensfm_io.reconstructions_to_json([reconstruction])
        (Path(folder) / RECONSTRUCTION).write_text(json.dumps(document), encoding="utf-8")
        if tracks is not None:
            (Path(folder) / TRACKS).write_text(tracks.as_string(), encoding="utf-8")
        try:
            network = read_opensfm(folder, overrides)
        except InputError as error:
            raise InputError(str(error).replace(folder, "reconstruction")) from None
    messages = {
        kind: tuple(text.replace(folder, "reconstruction") for text in getattr(network, kind))
        for kind in ("warnings", "notes")
    }
    return network.replace(name="reconstruction", **messages)
