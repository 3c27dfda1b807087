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
    new_folders = [p for p in (out, *out.absolute().parents) if not p.exists()]
    if new:
        with replace_folder(out, COMMAND, (), force):
            pass
    try:
        yield store
    except InputError:
        if new and not any(store.glob("*.npz")):
            (out / MARKER).unlink(missing_ok=True)
            for folder in (store, *new_folders):
                with suppress(OSError):  # not there yet, or somebody has put a file into it
                    folder.rmdir()
        raise


def write_reconstruction(
    reconstruction: Reconstruction,
    json: str,
    out: Path,
    brief: bool,
    plots: bool,
    force: bool,
    html: str = "",
    origin: Origin = UNKNOWN,
    progress: Progress | None = None,
    supplement: Supplement | None = None,
) -> None:
    """Write JSON and page, and the folder with each part, its pairs and figures, and what options
    add (`supplement`)."""
    main_part, plots = reconstruction.parts[0], plots and can_plot()
    entries_of_main = {
        "reconstruction": reconstruction.to_dict(),
        "verdict": verdict_dict(conclude_part(reconstruction, main_part)),
    }
    entries_of_main |= {} if supplement is None else supplement.json
    text = result_text(main_part.adjustment, brief, entries_of_main)
    page = partial(
        compose_part,
        reconstruction,
        main_part,
        origin,
        NO_ADDITION if supplement is None else supplement.addition,
    )
    with write_result(json, text, out, COMMAND, FILES, force, html, page) as new:
        if new is None:
            return
        verdict = (
            f"{reconstruction.prefix(main_part)}{conclude_part(reconstruction, main_part).words}"
        )
        report_text = f"{verdict}\n{reconstruction}\n\n{describe_part(reconstruction, main_part)}"
        _write_part(
            reconstruction,
            main_part,
            new,
            plots,
            report_text,
            entries_of_main,
            progress,
            origin.computed,
            supplement,
        )
        for number, part in enumerate(reconstruction.parts[1:], 2):
            folder = new / f"part_{number}"
            folder.mkdir()
            warnings = (
                f"warning: {warning}"
                for warning in reconstruction.warnings
                if warning.startswith(f"{part.name}:")
            )
            verdict = conclude_part(reconstruction, part)
            note = "\n".join([verdict.words, *warnings, describe_part(reconstruction, part)])
            entries = {"verdict": verdict_dict(verdict)}
            _write_part(
                reconstruction, part, folder, plots, note, entries, progress, origin.computed
            )
            write_text(folder / PAGE, compose_part(reconstruction, part, origin))
        if plots:
            draw_pairs(
                list(reconstruction.photographs),
                reconstruction.pairs,
                list(reconstruction.left_out),
                new,
                progress,
            )
        write_csv(
            new / PAIRS, ["image", "other", "matches", "verified", "kind"], reconstruction.pairs
        )


def _write_part(
    reconstruction: Reconstruction,
    part: ReconstructedPart,
    folder: Path,
    plots: bool,
    note: str,
    entries: Mapping[str, Any],
    progress: Progress | None,
    date: str,
    supplement: Supplement | None = None,
) -> None:
    fill_results(
        part.adjustment,
        folder,
        plots,
        note,
        entries,
        supplement,
        progress=progress,
        date=date,
        verdict=conclude_part(reconstruction, part),
    )
    _write_tables(part, folder)
    if plots:
        read_thumbnail = lambda name: _thumbnail(reconstruction.photographs[name])
        draw_tracks(part.adjustment, read_thumbnail, folder, progress)
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
