"""Where a result comes from: fingerprints of the input files, and the chosen settings."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from jaxbundle.io.networks.project import FILE_NAME
from jaxbundle.io.writing.fingerprints import input_files
from jaxbundle.network.tables import Network
from jaxbundle.report.page import Origin, fingerprint_files
from jaxbundle.system.clock import in_words, now


def network_files(
    input: Path, network: Network, control: Path | None = None
) -> tuple[str | Path, ...]:
    """The input files of a network."""
    tables = (network.images, network.points, network.observations, network.distances)
    files = (input, input / FILE_NAME, *(table.source.name for table in tables))
    return files if control is None else (*files, control)


def trace_origin(
    input: Path, network: Network, control: Path | None, settings: Mapping[str, object]
) -> Origin:
    """The fingerprints of the input files of a network, and the chosen settings."""
    return trace_files((*input_files(input), *network_files(input, network, control)), settings)


def trace_files(files: Iterable[str | Path], settings: Mapping[str, object]) -> Origin:
    """The fingerprints of files, and the chosen settings."""
    chosen_settings = {
        name: value for name, value in settings.items() if value not in (None, False, "")
    }
    return Origin(fingerprint_files(files), chosen_settings, in_words(now()))
