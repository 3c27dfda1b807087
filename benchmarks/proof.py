"""The page docs/proof.md: real photographs, targets and satellite files, each by its command.

    python benchmarks/proof.py REAL [--folder FOLDER] [--page FILE]

REAL: a folder with `facade8`, `drone_gcp`, `targets39`, `rig4` and `satellite` (docs/proof.md says
what they are and where they come from). Every command runs as a process of its own, into FOLDER,
where a result that is there already is used again. COLMAP, as pycolmap, runs beside where it is
installed.
"""

# Its prose is that of a page:
# ruff: noqa: E501

import json
import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

import jaxbundle
from jaxbundle.orientation.alignment import similarity

ROOT = Path(__file__).parents[1]
HALVES = ("photographs", "points", "runs")


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("real", type=Path)
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "proof")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "proof.md")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    parts = (facade, drone, targets, rig, satellites)
    texts = [HEAD, *("\n".join(part(given.real, given.folder)) for part in parts), TAIL]
    given.page.write_text("\n\n".join(text.strip() for text in texts) + "\n", encoding="utf-8")
    return 0


def run(*arguments: object, out: Path | None = None) -> str:
    """What a command prints; nothing is run if `out` is there."""
    if out is not None and out.exists():
        return ""
    words = ["jaxbundle", *map(str, arguments)]
    print(*words, file=sys.stderr, flush=True)
    done = subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True)
    if done.returncode not in (0, 3):
        raise SystemExit(done.stderr)
    return done.stdout


def result_of(folder: Path) -> dict[str, Any]:
    """The JSON of a result: of the adjustment, not of the run."""
    return json.loads((folder / "result.json").read_text(encoding="utf-8"))


def paragraph(text: str) -> str:
    """A paragraph in lines of 120 letters, as the pages of docs are."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def row(*cells: object) -> str:
    """A row of a table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def head(*cells: str) -> Iterator[str]:
    """The head of a table, after an empty line."""
    yield from ("", row(*cells), row(*("---" for _ in cells)))


def replicated(project: Path, folder: Path) -> dict[str, dict[str, Any]]:
    """d²/n of halves of a network, by what they do not share."""
    found = {}
    for by in HALVES:
        file = folder / f"{project.parent.parent.name}_{by}.json"
        repeat = 1 if by == "runs" else 4
        run("replicate", project, "--by", by, "--repeat", repeat, "--json", file, out=file)
        found[by] = json.loads(file.read_text(encoding="utf-8"))
    return found


def centres_off(
    X0: Mapping[str, np.ndarray],
    others: Mapping[str, np.ndarray],
    unit: Mapping[str, np.ndarray] | None = None,
) -> float:
    """RMS of projection centres against others after a similarity, in the unit of the others, or of
    those of `unit`."""
    names = [name for name in others if name in X0]
    one, other = (np.array([of[name] for name in names]) for of in (X0, others))
    if unit is not None:
        A, t = similarity(other, np.array([unit[name] for name in names]))
        other = other @ A.T + t
    A, t = similarity(one, other)
    return float(np.sqrt(((one @ A.T + t - other) ** 2).sum(1).mean()))


def by_colmap(photographs: Path, folder: Path) -> dict[str, np.ndarray] | None:
    """Projection centres by COLMAP's incremental mapper; None if it is not installed."""
    if not machine.installed("pycolmap"):
        return None
    import pycolmap

    model = folder / f"{photographs.parent.name}_colmap"
    if not model.exists():
        database = folder / "colmap.db"
        database.unlink(missing_ok=True)
        pycolmap.set_random_seed(0)
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(database, photographs, camera_mode=mode, reader_options=reader)
        pycolmap.match_exhaustive(database)
        model.mkdir()
        pycolmap.incremental_mapping(database, photographs, model)
    found = pycolmap.Reconstruction(next(model.iterdir()))
    return {image.name: image.projection_center() for image in found.images.values()}


def halves_table(found: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    yield from head("halves that do not share", "classical σ", "σ under correlated errors")
    for by, one in found.items():
        n = one["dof"]
        yield row(by, f"{one['d2'] / n:.2f}", f"{one['d2_correlated'] / n:.2f}")


def components(result: Mapping[str, Any]) -> str:
    """The sizes of what image points share, in words."""
    sizes = [
        f"{one['name']} {one['sigma']:.2g} ± {one['sigma_of_sigma']:.1g} {one['unit']}"
        for one in result["error_components"]
        if one["sigma"] > 0
    ]
    ratio = result["sigma_ratio"]
    return paragraph(
        f"Image points share: {', '.join(sizes)}. σ are {ratio:.1f} times the classical ones."
    )


def facade(real: Path, folder: Path) -> Iterator[str]:
    photographs, out = real / "facade8" / "images", folder / "facade8"
    run("reconstruct", photographs, "--out", out, out=out)
    result, network = result_of(out), jaxbundle.read_network(out / "network")
    truth = {
        file.name.removesuffix(".camera"): np.array(file.read_text().split()[21:24], float)
        for file in sorted((real / "facade8" / "truth").glob("*.camera"))
    }
    ours = dict(zip(network.images.id, network.images.position))
    colmap, c = by_colmap(photographs, folder), next(iter(result["cameras"].values()))["parameters"]
    given = dict(zip(("fx", "fy", "cx", "cy"), (2759.48, 2764.16, 1520.69, 1006.81)))
    yield "## Eight photographs of a façade"
    yield ""
    yield paragraph(
        "`jaxbundle reconstruct facade8/images --out facade8`: 3072 × 2048 pixels, published in 2008 "
        "with a calibration of the camera and an orientation by laser scans (Strecha et al.)."
    )
    yield from head("", "found, px", "classical σ", "σ under correlated errors", "published")
    for name, value in given.items():
        p = c[name]
        yield row(
            name, f"{p['value']:.2f}", f"{p['sigma']:.2f}", f"{p['sigma_correlated']:.2f}", value
        )
    yield ""
    yield paragraph(
        "d²/n of the interior orientations of halves of the set (1 where σ are right; "
        "`jaxbundle replicate facade8/network --by …`):"
    )
    yield from halves_table(replicated(out / "network" / "project.toml", folder))
    yield ""
    yield components(result)
    yield ""
    yield paragraph("Projection centres, RMS of the differences after a similarity:")
    yield from head("", "mm")
    yield row("jaxbundle against the published ones", f"{1e3 * centres_off(ours, truth):.1f}")
    if colmap is not None:
        yield row("COLMAP against the published ones", f"{1e3 * centres_off(colmap, truth):.1f}")
        yield row("jaxbundle against COLMAP", f"{1e3 * centres_off(ours, colmap, truth):.1f}")
    off = [
        f"{abs(c[name]['value'] - value) / c[name]['sigma_correlated']:.1f} ({name})"
        for name, value in given.items()
    ]
    yield ""
    yield paragraph(
        "COLMAP's camera (SIMPLE_RADIAL, its default) has one focal length, the principal point in "
        "the middle of the image and one radial term; ours has nine free parameters. The published "
        "orientation is no truth for millimetres, the published camera none for its pixels: it "
        f"differs by {', '.join(off)} times σ under correlated errors. No setting was chosen by "
        "either."
    )


def drone(real: Path, folder: Path) -> Iterator[str]:
    block, out = real / "drone_gcp", folder / "drone_gcp"
    run("reconstruct", block, "--control", block / "gcp_list.txt", "--out", out, out=out)
    result = result_of(out)
    (part,) = result["reconstruction"]["parts"]
    picture = "images/proof_drone.png"
    shutil.copy(out / "plan.png", ROOT / "docs" / picture)
    yield "## A drone flight with handheld control"
    yield ""
    yield f"![The stations of the flight, tie points with error ellipses, and control]({picture})"
    yield ""
    yield paragraph(
        "`jaxbundle reconstruct drone_gcp --control drone_gcp/gcp_list.txt --out drone_gcp`: a compact "
        "camera over flat ground, ten control points of a handheld receiver without heights, no satellite "
        "positions. Known of it, from the block alone: the label gcp04 in IMG_0031 is at the place of "
        "gcp00, 20 m off; gcp06 is 3.7 m off."
    )
    yield ""
    yield paragraph(f"{len(result['images'])} of 41 photographs are oriented. Control points:")
    metres = lambda given: ["–" if given[axis] is None else f"{given[axis]:.2f}" for axis in "XY"]
    yield from head("point", "", "rays", "dE, m", "dN, m", "predicted by all others: dE", "dN")
    for name, point in part["control"]["points"].items():
        predicted = (point["prediction"] or {"error": {"X": None, "Y": None}})["error"]
        verdict = point["verdict"].partition(":")[0]
        cells = verdict, point["rays"], *metres(point["residual"]), *metres(predicted)
        yield row(name, *cells)
    yield ""
    for note in part["control"]["notes"]:
        yield textwrap.fill(note, 120, initial_indent="- ", subsequent_indent="  ")
    rms = part["control"]["rms"]
    yield ""
    yield paragraph(
        f"RMS {rms['X']:.2f} m east, {rms['Y']:.2f} m north, the precision of such a receiver."
    )
    yield ""
    yield components(result)


def targets(real: Path, folder: Path) -> Iterator[str]:
    project, out = real / "targets39" / "project.toml", folder / "targets39"
    run("adjust", project, "--out", out, out=out)
    result, panel = result_of(out), jaxbundle.read_network(project).points
    given = dict(zip(panel.id, panel.position))
    found = {
        name: np.array([point[axis]["value"] for axis in "XYZ"])
        for name, point in result["points"].items()
    }
    names = [name for name in found if np.isfinite(given[name]).all()]
    one, other = (np.array([of[name] for name in names]) for of in (found, given))
    A, t = similarity(one, other)
    micrometres = 1e3 * np.sqrt(((one @ A.T + t - other) ** 2).mean(0))
    agreed = " / ".join(f"{d:.1f}" for d in micrometres)
    yield "## Targets of a surveyed panel"
    yield ""
    yield paragraph(
        "`jaxbundle adjust targets39/project.toml`: 39 photographs by two cameras, measured by another "
        "program, as a free network of coded and plain targets."
    )
    yield from head("principal distance, px", "jaxbundle", "the other program")
    for (name, camera), theirs in zip(result["cameras"].items(), (2095.53, 2091.95)):
        fx = camera["parameters"]["fx"]
        yield row(f"camera {name}", f"{fx['value']:.2f} ± {fx['sigma']:.2f}", theirs)
    yield ""
    yield paragraph(
        f"After a similarity {len(names)} points agree with the surveyed ones to {agreed} µm "
        "(X / Y / Z) over 0.74 m. The other program has one principal distance for both axes; ours "
        "are free."
    )


def rig(real: Path, folder: Path) -> Iterator[str]:
    folders, out = real / "rig4", folder / "rig4"
    cameras = ("back", "mid", "side", "top")
    words = [word for name in cameras for word in ("--camera", f"{name}={folders / name}")]
    board = (
        "--board",
        "8x11",
        "--kind",
        "charuco",
        "--square",
        24,
        "--marker",
        18.75,
        "--dictionary",
        "DICT_4X4_1000",
    )
    run("calibrate", *words, "--rig", *board, "--out", out, out=out)
    result = result_of(out)["rig"]
    yield "## Four cameras around a cage"
    yield ""
    yield paragraph(
        "`jaxbundle calibrate --camera back=rig4/back … --rig --board 8x11 --kind charuco …`: 21 "
        f"photographs a camera of one board; {len(result['epochs'])} epochs are used, "
        f"{result['observations']} coordinates."
    )
    yield from head("camera", "RMS of residuals, px")
    for name, rms in result["rms"].items():
        yield row(name, f"{rms:.2f}")


def satellites(real: Path, folder: Path) -> Iterator[str]:
    yield "## Satellite images: the rigorous model and the vendor's polynomials"
    yield ""
    yield paragraph(
        "`jaxbundle pushbroom info FILE`: attitudes and positions of the file, our model of the scanner, "
        "against the polynomials that the vendor made from his own model:"
    )
    yield from head("file", "corrections that agree", "RMS on the ground, m", "RMS, pixels")
    for name in ("wv01", "wv03_a"):
        file = folder / f"{name}.json"
        run("pushbroom", "info", real / "satellite" / f"{name}.xml", "--json", file, out=file)
        found = json.loads(file.read_text(encoding="utf-8"))
        corrections = found["corrections"] or "none"
        words = corrections if isinstance(corrections, str) else ", ".join(corrections)
        yield row(name, words, f"{found['rpc_rms']:.3f}", f"{found['rpc_rms_pixels']:.3f}")
    yield ""
    yield paragraph(
        "Vendors' files do not say which corrections their polynomials contain; both files are read, the "
        "one that agrees is used, and what the others would give is said (wv03_a: 18 m)."
    )


HEAD = """
# The proof

What `jaxbundle` gives on real photographs, targets and satellite files, by its commands, each its own process. Made by
`python benchmarks/proof.py REAL`; the files are public, their sources are named.

Real data have no truth beside them: published orientations have errors of their own. Two things can be tested without it.
**Halves**: a set is cut into two that share no observation; the difference of what both determine, over its covariance, is 1
where σ are right. **Others**: independent programs on the same photographs.
"""
TAIL = """
## What this cannot tell

Halves by photographs share the remainder of the lens model, and a drift of the camera along the sequence; another principal
point in another session is in none of them. Sizes of photograph-wise errors from eight to eleven photographs are uncertain by
20 to 30 %. With simulated truth, σ are tested by coverage: [statistics](statistics.md#correlated-errors). Independent
computations of the same measurements, to 1e-6 and better: [beside other programs](beside.md).
"""

if __name__ == "__main__":
    sys.exit(main())
