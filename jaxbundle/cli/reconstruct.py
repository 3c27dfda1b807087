"""`jaxbundle reconstruct`: photographs to an adjusted network."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Force, Quiet, app
from jaxbundle.cli.cameras_given import camera_given
from jaxbundle.cli.outputs import FILES as RESULTS
from jaxbundle.cli.outputs import can_plot, check_writable, fill_results, written
from jaxbundle.cli.progress import staging
from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap import FILES as COLMAP
from jaxbundle.io.networks.colmap import fill_colmap
from jaxbundle.io.results.ply import write_ply
from jaxbundle.io.results.result_json import result_text
from jaxbundle.io.results.result_project import adjusted_network
from jaxbundle.io.text.csv_tables import write_csv
from jaxbundle.io.writing.folders import read_marker, replaced_folder
from jaxbundle.measure.coded_targets import KINDS as TARGETS
from jaxbundle.measure.coded_targets import check_kind
from jaxbundle.reconstruction.control import read_control_measurements
from jaxbundle.reconstruction.named import read_distances
from jaxbundle.reconstruction.photographs import find_photographs
from jaxbundle.reconstruction.reconstruct import Part, Reconstruction, reconstruct
from jaxbundle.reconstruction.settings import Settings
from jaxbundle.tiepoints.features import KINDS, Detection
from jaxbundle.tiepoints.pairs import WAYS

BY, KEPT, MODEL, CLOUD, PAIRS = "reconstruct", "matches", "colmap", "points.ply", "pairs.csv"
OF_A_PART = (*RESULTS, *(f"{MODEL}/{name}" for name in COLMAP), CLOUD)
FILES = (*OF_A_PART, *(f"part_*/{name}" for name in OF_A_PART), PAIRS)


@app.command(name="reconstruct")
def reconstruct_command(
    photos: Annotated[list[Path], typer.Argument(help="photographs, or folders of them")],
    out: Annotated[Path, typer.Option(help="folder for report, JSON, tables, COLMAP model, PLY")],
    camera: Annotated[
        str | None, typer.Option(help="calibrated camera of all: FILE or FILE#ID; held as it is")
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option(help="control points: gcp_list.txt, or a table, with or without measurements"),
    ] = None,
    targets: Annotated[
        str | None, typer.Option(help=f"coded targets: {', '.join(TARGETS)}; :OPTION after it")
    ] = None,
    distances: Annotated[
        Path | None, typer.Option(help="scale bars: table from,to,value,sigma of named points")
    ] = None,
    features: Annotated[str, typer.Option(help=", ".join(KINDS))] = "sift",
    pairs: Annotated[str, typer.Option(help=f"matched: {', '.join(WAYS)}")] = "auto",
    points: Annotated[int, typer.Option(min=20, help="tie points wanted a photograph")] = 1500,
    json: Annotated[str, typer.Option(help="write the result as JSON; - for stdout alone")] = "",
    brief: Annotated[bool, typer.Option("--brief", help="no points and residuals in JSON")] = False,
    surface: Annotated[
        bool, typer.Option("--surface", help="match the oriented photographs for a surface")
    ] = False,
    plots: Annotated[bool, typer.Option(help="plots in the folder of --out")] = True,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Orient photographs by what they show: tie points, self-calibration, adjustment."""
    if features not in KINDS:
        raise InputError(f"--features {features!r}: {', '.join(KINDS)}")
    if pairs not in WAYS:
        raise InputError(f"--pairs {pairs!r}: {', '.join(WAYS)}")
    if surface and not (len(photos) == 1 and photos[0].is_dir()):
        raise InputError("--surface: give one folder of photographs")
    if targets is not None:
        check_kind(targets)
    settings = Settings(Detection(features), pairs, points, targets=targets)
    given = None if camera is None else camera_given(camera)
    known = None if control is None else read_control_measurements(control)
    bars = () if distances is None else read_distances(distances)
    files = [p for p in (*photos, control, distances) if p is not None and p.is_file()]
    check_writable(json, out, BY, FILES, files, force)
    found, _ = find_photographs(photos)
    check_writable(json, out, BY, FILES, [p.path for p in found], force)
    store = _store(out, force)
    with staging(quiet or json == "-") as tell:
        result = reconstruct(photos, given, settings, store, tell, known, bars)
    _write(result, json, out, brief, plots, force)
    if not quiet and json != "-":
        print(result)
        print(out)
    if surface:
        _surface(out, photos[0], force, quiet)


def _store(out: Path, force: bool) -> Path:
    """The folder in which features and matches are kept; --out is the command's own from now on."""
    if read_marker(out) is None:
        with replaced_folder(out, BY, (), force):
            pass
    return out / KEPT


def _write(
    found: Reconstruction, json: str, out: Path, brief: bool, plots: bool, force: bool
) -> None:
    first, plots = found.parts[0], plots and can_plot()
    also = {"reconstruction": _summary(found)}
    text = result_text(first.adjustment, brief, also)
    with written(json, text, out, BY, FILES, force) as new:
        if new is None:
            return
        _write_part(first, new, plots, str(found) + "\n\n", also)
        for number, part in enumerate(found.parts[1:], 2):
            folder = new / f"part_{number}"
            folder.mkdir()
            _write_part(part, folder, plots, f"{part.name}\n\n", {})
        write_csv(new / PAIRS, ["image", "other", "matches", "verified", "kind"], found.pairs)


def _write_part(part: Part, folder: Path, plots: bool, note: str, also) -> None:
    fill_results(part.adjustment, folder, plots, note, also)
    network = adjusted_network(part.adjustment)
    write_ply(network, folder / CLOUD, part.colours)
    try:
        fill_colmap(network, folder / MODEL, False)
    except InputError as error:
        print(f"no COLMAP model: {error}")


def _summary(found: Reconstruction) -> dict:
    return {
        "parts": [
            {"name": part.name, "images": list(part.adjustment.network.images.id),
             "sigma0": part.adjustment.sigma0, "sigma_factors": dict(part.factors),
             "removed": len(part.adjustment.removed),
             "global_test_passed": part.adjustment.global_test()["passed"]}
            for part in found.parts
        ],
        "left_out": dict(found.left_out), "notes": list(found.notes), "pairs": len(found.pairs),
    }  # fmt: skip


def _surface(out: Path, photos: Path, force: bool, quiet: bool) -> None:
    from jaxbundle.cli.surface import surface

    surface([out / "network"], out / "surface", photos, force=force, quiet=quiet)
