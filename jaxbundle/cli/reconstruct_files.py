"""Output of `jaxbundle reconstruct`: every part with model and cloud, pairs, figures."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxbundle.cli.outputs import FILES as RESULTS
from jaxbundle.cli.outputs import PAGE, Supplement, can_plot, fill_results, write_result
from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap import FILES as COLMAP
from jaxbundle.io.networks.colmap import fill_colmap
from jaxbundle.io.results.ply import write_ply
from jaxbundle.io.results.result_json import result_text, verdict_dict
from jaxbundle.io.results.result_project import adjusted_network
from jaxbundle.io.text.csv_tables import write_csv, write_text
from jaxbundle.io.writing.folders import MARKER, read_marker, replace_folder
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.plotting.files import PAIRS as PAIR_FIGURES
from jaxbundle.plotting.files import TRACKS, draw_pairs, draw_tracks
from jaxbundle.reconstruction.page import compose_part, conclude_part, describe_part
from jaxbundle.reconstruction.result import ReconstructedPart, Reconstruction
from jaxbundle.report.page import UNKNOWN, Origin
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.types import Progress

COMMAND, STORE, MODEL, CLOUD, PAIRS = "reconstruct", "matches", "colmap", "points.ply", "pairs.csv"
CONTROL, POSITIONS = "control.csv", "camera_positions.csv"
PART_FILES = (*RESULTS, CONTROL, POSITIONS, *(f"{MODEL}/{name}" for name in COLMAP), CLOUD, TRACKS)
FILES = (*PART_FILES, *(f"part_*/{name}" for name in PART_FILES), PAIRS, *PAIR_FIGURES)


@contextmanager
def keep_matches(out: Path, force: bool) -> Iterator[Path]:
    """The folder of stored features and matches; --out belongs to the command from now on. Bad
    input leaves no trace of a new one, unless features of the photographs are in it already, which
    the next run uses."""
    store, new = out / STORE, read_marker(out) is None
    made = [p for p in (out, *out.absolute().parents) if not p.exists()]
    if new:
        with replace_folder(out, COMMAND, (), force):
            pass
    try:
        yield store
    except InputError:
        if new and not any(store.glob("*.npz")):
            (out / MARKER).unlink(missing_ok=True)
            for folder in (store, *made):
                with suppress(OSError):  # not there yet, or somebody has put a file into it
                    folder.rmdir()
        raise


def write_reconstruction(
    found: Reconstruction,
    json: str,
    out: Path,
    brief: bool,
    plots: bool,
    force: bool,
    html: str = "",
    origin: Origin = UNKNOWN,
    progress: Progress | None = None,
    more: Supplement | None = None,
) -> None:
    """Write JSON and page, and the folder with each part, its pairs and figures, and what `more`
    options add."""
    first, plots = found.parts[0], plots and can_plot()
    also = {"reconstruction": found.to_dict(), "verdict": verdict_dict(conclude_part(found, first))}
    also |= {} if more is None else more.json
    text = result_text(first.adjustment, brief, also)
    page = partial(
        compose_part, found, first, origin, NO_ADDITION if more is None else more.addition
    )
    with write_result(json, text, out, COMMAND, FILES, force, html, page) as new:
        if new is None:
            return
        verdict = f"{found.prefix(first)}{conclude_part(found, first).words}"
        told = f"{verdict}\n{found}\n\n{describe_part(found, first)}"
        _write_part(found, first, new, plots, told, also, progress, origin.computed, more)
        for number, part in enumerate(found.parts[1:], 2):
            folder = new / f"part_{number}"
            folder.mkdir()
            own = (
                f"warning: {said}" for said in found.warnings if said.startswith(f"{part.name}:")
            )
            verdict = conclude_part(found, part)
            note = "\n".join([verdict.words, *own, describe_part(found, part)])
            entries = {"verdict": verdict_dict(verdict)}
            _write_part(found, part, folder, plots, note, entries, progress, origin.computed)
            write_text(folder / PAGE, compose_part(found, part, origin))
        if plots:
            draw_pairs(list(found.photographs), found.pairs, list(found.left_out), new, progress)
        write_csv(new / PAIRS, ["image", "other", "matches", "verified", "kind"], found.pairs)


def _write_part(
    found: Reconstruction,
    part: ReconstructedPart,
    folder: Path,
    plots: bool,
    note: str,
    also: Mapping[str, Any],
    progress: Progress | None,
    date: str,
    more: Supplement | None = None,
) -> None:
    fill_results(
        part.adjustment,
        folder,
        plots,
        note,
        also,
        more,
        progress=progress,
        date=date,
        verdict=conclude_part(found, part),
    )
    _write_tables(part, folder)
    if plots:
        read = lambda name: _thumbnail(found.photographs[name])
        draw_tracks(part.adjustment, read, folder, progress)
    network = adjusted_network(part.adjustment)
    write_ply(network, folder / CLOUD)
    try:
        fill_colmap(network, folder / MODEL, False)
    except InputError as error:
        # A camera that COLMAP cannot have must not cost the rest of the result.
        print(f"no COLMAP model: {error}")


def _write_tables(part: ReconstructedPart, folder: Path) -> None:
    """Control and check points, and camera positions, as tables."""
    if part.control is not None:
        axes = [f"{kind}{a}" for kind in ("", "s", "d") for a in "XYZ"]
        write_csv(
            folder / CONTROL,
            ["id", "role", "used", "rays", *axes, "px", "verdict"],
            (
                (
                    p.id,
                    p.role,
                    p.used,
                    p.rays,
                    *p.given,
                    *p.sigma,
                    *p.residual,
                    p.image_residual,
                    p.verdict,
                )
                for p in part.control.points
            ),
        )
    positions = part.block.positions
    if positions is not None:
        rows = ((id, *d) for id, d in positions.difference.items())
        write_csv(folder / POSITIONS, ["image", "dX", "dY", "dZ"], rows)


def _thumbnail(path: Path, max_pixels: int = 1200) -> UInt8[np.ndarray, "rows columns"]:
    """The grey values of a photograph, reduced to the resolution of a figure, 8 inches of 150 dots;
    a blank image without the file, or the memory."""
    try:
        grey = read_photograph(path)
    except (InputError, MemoryError):
        return np.full((2, 2), 255, np.uint8)
    step = max(1, max(grey.shape) // max_pixels)
    return grey[::step, ::step]
