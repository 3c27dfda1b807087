"""BAL problems, real or synthetic: our solver and its peers, on one machine, in one run.

    python benchmarks/bal.py PROBLEM ... [--street IMAGES POINTS] [--arc IMAGES POINTS]
        [--peers NAME ...] [--ceres BINARY] [--solver NAME] [--jaxls PYTHON] [--baseline]

PROBLEM is a file in the BAL format (.txt, .gz, .bz2); `scenes.py` writes --street and --arc. Every
solver runs in its own process, in turn, twice (--rounds), on two cores: Ceres with two threads,
ours with two CPU devices of JAX, or on the GPU. The peers, by default all installed ones:

    pycolmap   Ceres as it comes with pycolmap (pip install pycolmap)
    ceres      Ceres' own program `bundle_adjuster`: --ceres BINARY, or BUNDLE_ADJUSTER
    scipy      least_squares with exact derivatives, for a few evaluations
    jaxls      of github.com/brentyi/jaxls (PyPI's package of this name is a different one): in this
               environment, or in that of --jaxls PYTHON

Missing peers are listed as skipped. The output gives the lowest cost ½Σv² in pixels² and whether
the evaluation limit ended the search, the time of an iteration (the whole solution divided by its
iterations, without compilation), the time from the start values to 1.0001 × the lowest cost of all,
its ratio to a peer's (ours / peer), compilation with an empty folder of compiled programs and in a
second process with that folder, and the peak memory of the process. --json has the cost after every
evaluation and its time for all, --plot draws them.

The exit status is 1 if our cost is higher than a peer's by 1e-6; if our search has not converged
and a converged peer, Ceres within the same limit, or `baseline.json` has a lower cost; and with
--baseline if the result disagrees with `baseline.json` (see `baseline.py`; --write-baseline makes a
new one). A failing peer is reported.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import baseline
import machine

HERE = Path(__file__).parent
PEERS = ("pycolmap", "ceres", "scipy", "jaxls")
FEW = {"scipy": 20, "jaxls": 30}
"""Evaluations of the slow solvers."""
SEED = 0
CERES = ("pycolmap", "ceres")
READ = """
import sys, jaxbundle
try:
    jaxbundle.read_network(sys.argv[1], format="bal")
except jaxbundle.InputError as error:
    sys.exit(str(error))
"""
IS_JAXLS = "import jaxls; jaxls.LeastSquaresProblem"


def commands(given) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Command of every solver without the problem, and why others are skipped."""
    cores = ["--threads", str(given.threads), "--solver", given.solver]
    found = {"ours": [sys.executable, "bal_ours.py", "--devices", str(given.devices)]}
    if given.reduction:
        found["ours"] += ["--reduction", given.reduction]
    skipped, wanted = {}, PEERS if given.peers is None else given.peers
    if "pycolmap" in wanted:
        if machine.installed("pycolmap"):
            found["pycolmap"] = [sys.executable, "bal_pycolmap.py", *cores]
        else:
            skipped["pycolmap"] = "not installed (pip install pycolmap)"
    if "ceres" in wanted:
        if given.ceres and not shutil.which(given.ceres):
            skipped["ceres"] = f"{given.ceres} is no program"
        elif given.ceres:
            found["ceres"] = [sys.executable, "bal_ceres.py", "--binary", given.ceres, *cores]
        else:
            skipped["ceres"] = "no binary given (--ceres BINARY or BUNDLE_ADJUSTER)"
    if "scipy" in wanted:
        found["scipy"] = [sys.executable, "bal_scipy.py"]
    if "jaxls" in wanted:
        python = given.jaxls or sys.executable
        if not shutil.which(python):
            skipped["jaxls"] = f"{python} is not a program"
        elif subprocess.run([python, "-c", IS_JAXLS], capture_output=True).returncode == 0:
            found["jaxls"] = [python, "bal_jaxls.py"]
        else:
            skipped["jaxls"] = (
                "that of github.com/brentyi/jaxls is not installed here (--jaxls PYTHON names an "
                "environment that has it)"
            )
    return found, skipped


class Failed(Exception):
    """A solver without figures, and its last line of output."""


def run(command: list[str], problem: Path, evaluations: int, repeat: int) -> dict:
    """The figures of one solver in its own process."""
    python, program, *options = command
    done = subprocess.run(
        [python, str(HERE / program), str(problem), *options,
         "--evaluations", str(evaluations), "--repeat", str(repeat)],
        capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        words = (done.stderr.strip() or "no message").splitlines()[-1]
        raise Failed(f"{program} ended with status {done.returncode}: {words}")
    return json.loads(done.stdout)


def best_of(runs: list[dict]) -> dict:
    """The fastest run of one solver; compilation and memory of the first."""
    best = min(runs, key=lambda figures: figures["seconds"])
    first, *later = runs
    best = best | {name: first[name] for name in ("compile_s", "prepare_s", "peak_mb")
                   if name in first}  # fmt: skip
    if "prepare_s" in first and later:
        best["compile_cached_s"] = later[0]["compile_s"]
    return best


def time_to(figures: dict, cost: float) -> float | None:
    """Seconds from the start values until the cost was reached; None if it was not."""
    return next((t for c, t in zip(figures["costs"], figures["at_s"]) if c <= cost), None)


def compare(key: str, path: Path, todo: dict, given) -> dict:
    """All solvers on one problem, in turns, beginning without compiled programs."""
    runs, failed = {name: [] for name in todo}, {}
    with tempfile.TemporaryDirectory() as cache:
        todo = todo | {"ours": [*todo["ours"], "--cache", cache]}
        for _ in range(given.rounds):
            for name, command in todo.items():
                if name in failed:
                    continue
                few = min(given.evaluations, FEW.get(name, given.evaluations))
                repeat = 1 if name in FEW else given.repeat
                try:
                    runs[name].append(run(command, path, few, repeat))
                except Failed as error:
                    failed[name] = str(error)
    solvers = {name: best_of(some) for name, some in runs.items() if name not in failed}
    lowest = min((f["cost"] for f in solvers.values() if f.get("comparable", True)), default=0.0)
    for figures in solvers.values():
        figures["to_1.0001_s"] = time_to(figures, 1.0001 * lowest)
    return {"key": key, "failed": failed} | solvers


def complaints(found: dict) -> list[str]:
    """What is wrong with our answer."""
    if "ours" not in found:
        return [f"{found['key']}: {found['failed']['ours']}"]
    ours, key = found["ours"], found["key"]
    peers = {name: found[name] for name in PEERS
             if name in found and found[name].get("comparable", True)}  # fmt: skip
    wrong = [f"{key}: our cost is higher than that of {name}" for name, peer in peers.items()
             if not ours["cost"] <= (1 + 1e-6) * peer["cost"]]  # fmt: skip
    vouched = any(name in CERES or not peer["at_limit"] for name, peer in peers.items())
    if not (wrong or ours["settled"] or vouched or baseline.agrees(found)):
        wrong = [f"{key}: not converged ({ours['ended']}), and nothing to compare with"]
    return wrong


def ratio(ours: float | None, theirs: float | None) -> str:
    return f"{ours / theirs:.2f}" if ours and theirs else ""


def told(found: dict) -> str:
    """The figures as text."""
    rows = [("", "cost", "evaluations", "ms/iteration", "ratio", "s to 1.0001", "ratio",
             "compile s, cached", "peak MB")]  # fmt: skip
    ours, notes = found["ours"], [f"failed: {text}" for text in found["failed"].values()]
    for name in ("ours", *(name for name in PEERS if name in found)):
        f, peer = found[name], name != "ours"
        to, limit = f["to_1.0001_s"], f["at_limit"]
        compiled = [f[n] for n in ("compile_s", "compile_cached_s") if n in f]
        comparable = f.get("comparable", True)
        rows.append((
            f["solver"], f"{f['cost']:.4f}" + ("" if comparable else " ≠"),
            f"{f['evaluations']}" + (" = limit" if limit else ""),
            f"{1e3 * f['iteration_s']:.1f}", ratio(ours["iteration_s"], f["iteration_s"]) * peer,
            f"{to:.3f}" if to and comparable else "–",
            ratio(ours["to_1.0001_s"], to) * (peer and comparable),
            ", ".join(f"{s:.1f}" for s in compiled), f"{f['peak_mb']:.0f}",
        ))  # fmt: skip
        if limit:
            notes.append(f"{f['solver']}: stopped at the limit of {f['evaluations']} evaluations; "
                         "its cost is not final")  # fmt: skip
        if not comparable:
            said, of_all = f["costs_said"], f["costs_of_all_rays"]
            notes.append(
                f"{f['solver']}: leaves out rays of points behind the camera, its costs are not "
                f"those of the problem: {said[0]:.4f} at the start, that of all rays is "
                f"{of_all[0]:.4f}; at the end {said[1]:.4f} and {of_all[1]:.4f}"
            )
    above = ours["peak_mb"] - ours["import_mb"]
    notes.append(f"jaxbundle: {ours['ended']}; peak {ours['peak_mb']:.0f} MB, "
                 f"{above:.0f} MB above importing JAX ({ours['import_mb']:.0f} MB)")  # fmt: skip
    if ours["device_peak_mb"]:
        notes.append(f"jaxbundle: peak of the memory of the device {ours['device_peak_mb']:.0f} MB")
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = [
        "  ".join([row[0].ljust(widths[0])] + [c.rjust(w) for c, w in zip(row[1:], widths[1:])])
        for row in rows
    ]
    return "\n".join([found["key"], *(f"  {line}" for line in lines + notes)])


def problems(given, folder: Path):
    """Name and plain file of every problem, one at a time."""
    import scenes

    for path in given.problems:
        plain = scenes.unpack(path, folder)
        yield baseline.name_of_file(path, plain), plain
    for kind in ("street", "arc"):
        for images, points in getattr(given, kind) or ():
            plain = folder / f"{kind}.txt"
            # In its own process: its memory would count as that of the solvers.
            name = f"{kind} of {images} images, {points} points, seed {SEED}"
            made = subprocess.run([sys.executable, str(HERE / "scenes.py"), kind, str(images),
                                   str(points), str(SEED), str(plain)],
                                  capture_output=True, text=True)  # fmt: skip
            if made.returncode:
                sys.exit(f"{name}: cannot be created: {made.stderr.strip().splitlines()[-1]}")
            yield name, plain


def arguments():
    """The arguments of the command line."""
    parser = machine.parser_of(__doc__)
    number = {"type": machine.positive}
    size = number | {"nargs": 2, "metavar": ("IMAGES", "POINTS"), "action": "append"}
    parser.add_argument("problems", nargs="*", type=Path)
    parser.add_argument("--street", **size)
    parser.add_argument("--arc", **size)
    parser.add_argument("--peers", nargs="*", choices=PEERS, help="only these; none: --peers alone")
    parser.add_argument("--ceres", default=os.environ.get("BUNDLE_ADJUSTER"), metavar="BINARY")
    parser.add_argument("--solver", default="dense_schur",
                        choices=("dense_schur", "sparse_schur", "iterative_schur"),
                        help="of Ceres; iterative_schur with schur_jacobi")  # fmt: skip
    parser.add_argument("--jaxls", metavar="PYTHON")
    parser.add_argument("--reduction", choices=("dense", "banded", "iterative"),
                        help="ours; chosen if not given")  # fmt: skip
    parser.add_argument("--baseline", action="store_true", help="compare with baseline.json")
    parser.add_argument("--write-baseline", action="store_true")
    parser.add_argument("--evaluations", **number, default=200, help="limit, of all but "
                        + ", ".join(f"{name} ({n})" for name, n in FEW.items()))  # fmt: skip
    parser.add_argument("--rounds", **number, default=2, help="turns; the best counts")
    parser.add_argument("--repeat", **number, default=2, help="timed runs a turn")
    parser.add_argument("--devices", **number, default=2, help="of the processor, for JAX")
    parser.add_argument("--threads", **number, default=2, help="of Ceres")
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures; - for standard output")  # fmt: skip
    parser.add_argument("--plot", type=machine.target, metavar="FILE",
                        help="draw cost against iteration and time")  # fmt: skip
    given = parser.parse_args()
    if not (given.problems or given.street or given.arc):
        parser.error("no problem: name a file, or --street or --arc")
    for path in given.problems:
        if not path.is_file():
            parser.error(f"there is no file {path}")
        # In its own process: reading starts to use the device.
        read = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True,
                              text=True)  # fmt: skip
        if read.returncode:
            parser.error((read.stderr.strip() or f"{path} cannot be read").splitlines()[-1])
    if given.plot and not machine.installed("matplotlib"):
        parser.error("--plot needs matplotlib (pip install matplotlib)")
    return given


def main() -> int:
    """Run, print, check."""
    given = arguments()
    show = sys.stderr if given.json == "-" else sys.stdout
    todo, skipped = commands(given)
    for name, why in skipped.items():
        print(f"skipped: {name}: {why}", file=show)
    settings = {"reduction": given.reduction or "chosen",
                "evaluations": f"≤ {given.evaluations}", "atol": 1e-5}  # fmt: skip
    all_found, solved, wrong = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for problem, path in problems(given, Path(folder)):
            found = compare(baseline.key_of(problem, settings), path, todo, given)
            all_found.append(found)
            wrong += complaints(found)
            if given.json != "-":
                machine.write_json(all_found, given.json)
            if "ours" in found:
                if not solved:
                    print(machine.in_words(found["ours"]["machine"]), file=show)
                solved.append(found)
                print(f"\n{told(found)}", file=show, flush=True)
    if given.json == "-":
        machine.write_json(all_found, "-")
    if given.write_baseline:
        baseline.write(solved)
    elif given.baseline:
        more, known = baseline.compare(solved)
        wrong += more
        for line in known:
            print(f"note: {line}", file=show)
    if given.plot:
        import plots

        plots.draw(all_found, given.plot)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
