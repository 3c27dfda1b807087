"""A block of RPC images: seconds of a large one; σ of a mixed one against draws.

    python benchmarks/rpc_block.py [--images N] [--points N] [--repeat N] [--draws N] [--json FILE]

The large block has `--images` images with polynomials and `--points` points, each in about four of
them: start values, adjustment, σ of all biases, check points, warnings; with data snooping; and the
redundancy numbers and report. The mixed block, of twelve such images, six line scanners and twenty
photographs, is adjusted `--draws` times with new biases, measurements and control coordinates (0:
not at all): the errors of biases, attitudes, orientations of photographs, their principal distance,
tie and check points divided by their σ a priori have an RMS of 1. In the first draw, a blunder in a
control point and one in a tie point are found, and a bias that nothing determines is named.

The scene is that of `tests/refinement` next to the imported package: with PYTHONPATH the same
command measures an earlier version. σ0 of the large block must be 1 within 4 of its σ, the RMS
between 0.9 and 1.1; otherwise the exit status is 1.
"""

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

import jaxbundle

sys.path.insert(0, str(Path(jaxbundle.__file__).parents[1] / "tests" / "refinement"))


def measure(images: int, points: int, repeat: int) -> dict:
    """Seconds of a block of RPC images."""
    from rpc_block import block

    from jaxbundle.refinement import refine

    scene = block(rpc=images, scanner=0, points=points, control=12, checks=8)
    arguments, _ = scene.draw(np.random.default_rng(3))
    seconds = {"refine": [], "snoop": [], "report": []}
    for _ in range(repeat + 1):
        for name, options in (("refine", {}), ("snoop", {"snooping": "pope"})):
            begin = time.perf_counter()
            found = refine(*arguments, **options)
            seconds[name].append(time.perf_counter() - begin)
        begin = time.perf_counter()
        found.report()
        seconds["report"].append(time.perf_counter() - begin)
    figures = {f"{name}_first_s": values[0] for name, values in seconds.items()}
    figures |= {f"{name}_further_s": min(values[1:]) for name, values in seconds.items()}
    return figures | {
        "images": images, "points": points, "image_points": len(arguments[2]),
        "sigma0": found.sigma0, "redundancy": found.redundancy, "removed": len(found.removed),
    }  # fmt: skip


def cover(draws: int, photographs: int = 20) -> dict:
    """RMS of errors divided by σ a priori, by type of unknown, over draws of a mixed block."""
    from rpc_block import block

    from jaxbundle.refinement import refine

    scene, rng = block(photographs=photographs), np.random.default_rng(11)
    errors, sigma0, seconds = {}, [], []
    for k in range(draws):
        arguments, bias = scene.draw(rng)
        frames, to_truth, distance = scene.draw_photographs(rng)
        begin = time.perf_counter()
        found = refine(*arguments, frames)
        seconds.append(time.perf_counter() - begin)
        if k == 0:
            told = find_faults(scene, arguments, frames)
        at, sigma = found.inspection, found.inspection.sigma / found.sigma0
        truth = {
            "image S": scene.attitudes, "image R": bias, "photograph ": to_truth,
            "camera ": np.array([distance]),
        }  # fmt: skip
        truth = np.concatenate([values.ravel() for values in truth.values()])
        # unknowns are in the order: line scanners, RPC, photographs, camera
        owners = np.array([name.owner for name in found.names])
        starts = ("image S", "image R", "photograph ", "camera ")
        order = np.concatenate(
            [np.flatnonzero(np.char.startswith(owners, start)) for start in starts]
        )
        ratio = (found.estimate[order] - truth) / sigma[order]
        of = {start: ratio[np.char.startswith(owners[order], start)] for start in starts}
        chosen = at.declared.rays.points
        off = np.einsum("pij,pj->pi", found.points.axes[chosen], found.positions - scene.X[chosen])
        ties = np.array([scene.roles[k] == "tie" for k in chosen])
        of_points = (off / (at.point_sigma / found.sigma0))[ties]
        check = found.check
        parts = {
            "biases": of["image R"], "attitudes": of["image S"], "photographs": of["photograph "],
            "principal distance": of["camera "], "tie points": of_points.ravel(),
            "check points": (check.difference / check.sigma * found.sigma0).ravel(),
        }  # fmt: skip
        for name, values in parts.items():
            errors.setdefault(name, []).append(values)
        sigma0.append(found.sigma0)
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in errors.items()}
    within = {name: float(np.mean(np.abs(values) < 3)) for name, values in errors.items()}
    return {
        "draws": draws, "rms_of_errors_by_sigma": rms, "part_within_3_sigma": within,
        "numbers": {name: int(np.size(values[0])) for name, values in errors.items()},
        "mean_square_sigma0": float(np.mean(np.square(sigma0))),
        "mixed_first_s": seconds[0], "mixed_further_s": float(np.median(seconds[1:] or seconds)),
        **told,
    }  # fmt: skip


def find_faults(scene, arguments: tuple, frames) -> dict:
    """What snooping finds of a blunder in control and of one in a tie point, of each type of
    image; and what is said of an image without measurements whose bias has no prior."""
    import dataclasses

    from rpc_block import moved

    from jaxbundle.errors import NotSolvedError
    from jaxbundle.refinement import prior_of_bias, refine

    images, points, observations = arguments
    ties = np.array([role == "tie" for role in scene.roles])
    row = int(np.flatnonzero(ties[observations.point])[5])
    of_frame = int(np.flatnonzero(ties[frames.observations.point])[7])
    X = points.X.copy()
    X[2] += 15.0 * points.axes[2, 0]
    wrong = dataclasses.replace(points, X=X), moved(observations, row, [6.0, 0.0])
    shifted = dataclasses.replace(
        frames, observations=moved(frames.observations, of_frame, [0.0, 0.12])
    )
    found = refine(images, *wrong, shifted, snooping="pope")
    rays = frames.observations
    expected = {
        "east of control point P2",
        f"point P{observations.point[row]} in image {images[observations.image[row]].id}",
        f"point P{rays.point[of_frame]} in image F{rays.image[of_frame]}",
    }
    free = [
        dataclasses.replace(one, bias_sigma=prior_of_bias(1)) if one.id == "R7" else one
        for one in images
    ]
    seventh = next(k for k, one in enumerate(images) if one.id == "R7")
    try:
        refine(free, points, observations.take(observations.image != seventh), frames)
        undetermined = ""
    except NotSolvedError as error:
        undetermined = str(error)
    return {
        "blunders_expected": sorted(expected),
        "blunders_found": sorted(blunder.name for blunder in found.removed),
        "undetermined": undetermined,
    }


def main() -> int:
    """Run, print, check."""
    parser = machine.parser_of(__doc__)
    parser.add_argument("--images", type=machine.positive, default=40)
    parser.add_argument("--points", type=machine.positive, default=20_000)
    parser.add_argument("--repeat", type=machine.positive, default=2)
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures as JSON (-: to standard output)")  # fmt: skip
    given = parser.parse_args()
    jaxbundle.enable_x64()
    figures = measure(given.images, given.points, given.repeat)
    figures |= {"peak_mb": machine.peak_mb(), "machine": machine.machine()}
    wrong = []
    if abs(figures["sigma0"] - 1) > 4 / np.sqrt(2 * figures["redundancy"]):
        wrong.append(f"σ0 is {figures['sigma0']:.4f}, not 1")
    if given.draws:
        figures |= cover(given.draws)
        for name, rms in figures["rms_of_errors_by_sigma"].items():
            if not 0.9 < rms < 1.1:
                # one number a draw is known to 1/√(2·draws) only
                if figures["numbers"][name] > 1 or abs(rms - 1) > 3 / np.sqrt(2 * given.draws):
                    wrong.append(f"errors of {name} have an RMS of {rms:.3f} σ, not 0.9 to 1.1")
        if figures["blunders_found"] != figures["blunders_expected"]:
            wrong.append(f"snooping removed {', '.join(figures['blunders_found'])}")
        if "image R7" not in figures["undetermined"]:
            wrong.append("the undetermined bias of image R7 is not named")
    if given.json != "-":
        print(machine.in_words(figures["machine"]))
        print(f"{given.images} images, {given.points} points, "
              f"{figures['image_points']} image points")  # fmt: skip
        for name in ("refine", "snoop", "report"):
            print(f"{name:8s} first call {figures[f'{name}_first_s']:.2f} s, further ones "
                  f"{figures[f'{name}_further_s']:.2f} s")  # fmt: skip
        print(f"peak {figures['peak_mb']:.0f} MB, σ0 {figures['sigma0']:.4f}")
        for name, rms in figures.get("rms_of_errors_by_sigma", {}).items():
            print(f"{name}: errors by σ, RMS of {given.draws} draws {rms:.3f}, within 3 σ "
                  f"{100 * figures['part_within_3_sigma'][name]:.2f} %")  # fmt: skip
        if given.draws:
            print(f"mixed block: first call {figures['mixed_first_s']:.1f} s, further ones "
                  f"{figures['mixed_further_s']:.2f} s; found {figures['blunders_found']}; "
                  f"{figures['undetermined'][:200]}")  # fmt: skip
    machine.write_json(figures, given.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
