"""Features and matches kept in a folder, so that an interrupted reconstruction resumes.

A file is named by the fingerprint of the photograph's content and of the settings: nothing is found
for a changed photograph. Files are written under a temporary name and renamed.
"""

import hashlib
import os
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxbundle.errors import InputError
from jaxbundle.io.text.archives import read_arrays
from jaxbundle.io.writing.replacing import unwritable
from jaxbundle.system.temporaries import temporary
from jaxbundle.tiepoints.features import Features, FeatureSettings
from jaxbundle.tiepoints.matching import FeatureMatchingSettings

# Version of features and matches: files of others are not used. To be raised with every change of
# the program, other than of settings, that changes either.
RULES = "6"
# The array of a file that tells whether the others are as they were written.
DIGEST = "digest"


class Store:
    """Files of features and matches in a folder; without a folder nothing is stored. `settings`:
    all that features and matches depend on, beside the photographs."""

    def __init__(self, folder: Path | None, *settings: FeatureSettings | FeatureMatchingSettings):
        self.folder, self.settings = folder, "\n".join(map(repr, settings))
        self.used: set[str] = set()
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise unwritable(folder, error) from None

    def name(self, *fingerprints: str) -> str:
        """The name of a file about these photographs."""
        text = "\n".join((RULES, self.settings, *fingerprints))
        # 64 bits: among 10⁶ files two have the same name with a probability of 3e-8
        digest = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        self.used.add(digest)
        return digest

    def load_features(self, fingerprint: str) -> Features | None:
        """The stored features of a photograph, if any."""
        arrays = self._load(self.name(fingerprint), "xy", "size", "angle", "descriptor")
        return None if arrays is None else Features(*arrays)

    def save_features(self, fingerprint: str, features: Features) -> None:
        """Store the features of a photograph."""
        self._save(
            self.name(fingerprint),
            xy=features.xy,
            size=features.size,
            angle=features.angle,
            descriptor=features.descriptor,
        )

    def load_matches(self, photograph: str, partner: str) -> tuple[np.ndarray, ...] | None:
        """The stored rows of matching features of two photographs, the ratios of their
        distances, and which are unique, if any."""
        return self._load(self.name(photograph, partner), "rows", "distance_ratio", "unique")

    def save_matches(
        self,
        photograph: str,
        partner: str,
        rows: Int[np.ndarray, "n 2"],
        distance_ratio: Float[np.ndarray, " n"],
        unique: Bool[np.ndarray, " n"],
    ) -> None:
        """Store the matches of two photographs."""
        self._save(
            self.name(photograph, partner), rows=rows, distance_ratio=distance_ratio, unique=unique
        )

    def drop_unused(self) -> None:
        """Remove the files of photographs that no longer exist."""
        if self.folder is not None:
            for path in self.folder.glob("*.npz"):
                if path.stem not in self.used:
                    path.unlink(missing_ok=True)
            for path in self.folder.glob("*.part*"):
                # From a killed run, unless so new that another run may be writing it; a file of a
                # few megabytes takes no ten minutes, even on a slow disk.
                with suppress(OSError):
                    if time.time() - path.stat().st_mtime > 600:
                        path.unlink()

    def _load(self, name: str, *columns: str) -> tuple[np.ndarray, ...] | None:
        """The arrays of a file; None, to be computed again, if it is missing or damaged."""
        path = None if self.folder is None else self.folder / f"{name}.npz"
        if path is None or not path.is_file():
            return None
        try:
            arrays = read_arrays(path, "a file of features or matches")
        except InputError:
            return None
        arrays_found = tuple(arrays.get(column, np.zeros(0)) for column in columns)
        is_whole = np.array_equal(arrays.get(DIGEST, np.zeros(0)), _digest(*arrays_found))
        return arrays_found if is_whole else None

    def _save(self, name: str, **arrays: np.ndarray) -> None:
        if self.folder is None:
            return
        # Renamed when it is complete, which is atomic; by process, as two may run in one folder.
        path = self.folder / f"{name}.npz"
        with temporary(self.folder / f"{name}.part{os.getpid()}") as part:
            try:
                with part.open("wb") as file:
                    content = {**arrays, DIGEST: _digest(*arrays.values())}
                    np.savez(file, **content)  # pyright: ignore[reportArgumentType]
                part.replace(path)
            except OSError as error:
                raise unwritable(path, error) from None


def _digest(*arrays: np.ndarray) -> UInt8[np.ndarray, "16"]:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
