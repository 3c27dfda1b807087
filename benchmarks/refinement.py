"""A satellite image and a photograph refined together: first call, further calls, memory.

    python benchmarks/refinement.py [--points N] [--repeat N] [--json FILE]

One scanner image (attitude, its rate, jitter by splines) and one photograph see the same points, of
which one in ten is a control point. The scene is that of `tests/refinement` next to the imported
package: with PYTHONPATH the same command measures an earlier version.

σ0 must be 1 within 4 of its σ; otherwise the exit status is 1.
"""

import dataclasses
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np

import jaxbundle

sys.path.insert(0, str(Path(jaxbundle.__file__).parents[1] / "tests" / "refinement"))


def scene(count: int):
    """Arguments of `refine`: images, points, measurements, photographs."""
    import refinement_scenes as scenes
    from test_with_photographs import photograph

    from jaxbundle.network.tables import Distances
    from jaxbundle.refinement.freedom import make_form

    rng = np.random.default_rng(1)
    one = scenes.scanner()
    form = make_form(one.image, one.earth, scenes.FREEDOM)
    truth = np.zeros(16 + 3 * form.spline.unknowns + 5)
    truth[:6] = np.array([20, -30, 50, 4, -3, 10]) * scenes.ARCSEC
    places, heights = scenes.spread(rng, count)
    X = np.asarray(scenes.ground(one.image, form, truth, heights, places))
    known = np.arange(count) % 10 == 0
    roles = tuple("control" if one else "tie" for one in known)
    points = dataclasses.replace(
        scenes.control(X), X=np.where(known[:, None], X, np.nan), role=roles
    )
    frames = dataclasses.replace(photograph(X, rng), distances=Distances.none())
    return [one], points, scenes.measured(places, rng), frames


def main() -> int:
    """Run, print, check."""
    parser = machine.parser_of(__doc__)
    parser.add_argument("--points", type=machine.positive, default=2000)
    parser.add_argument("--repeat", type=machine.positive, default=5)
    parser.add_argument("--json", type=machine.target, metavar="FILE",
                        help="write the figures as JSON (-: to standard output)")  # fmt: skip
    given = parser.parse_args()
    jaxbundle.enable_x64()
    from jaxbundle.refinement import refine

    arguments, seconds = scene(given.points), []
    for _ in range(given.repeat + 1):
        begin = time.perf_counter()
        found = refine(*arguments)
        seconds.append(time.perf_counter() - begin)
    figures = {
        "points": given.points, "first_s": seconds[0], "further_s": min(seconds[1:]),
        "sigma0": found.sigma0, "redundancy": found.redundancy, "peak_mb": machine.peak_mb(),
        "machine": machine.machine(),
    }  # fmt: skip
    if given.json != "-":
        print(machine.in_words(figures["machine"]))
        print(f"{given.points} points: first call {seconds[0]:.2f} s, further ones "
              f"{figures['further_s']:.3f} s, peak {figures['peak_mb']:.0f} MB, "
              f"σ0 {found.sigma0:.4f}")  # fmt: skip
    machine.write_json(figures, given.json)
    bad = abs(found.sigma0 - 1) > 4 / np.sqrt(2 * found.redundancy)
    return machine.verdict([f"σ0 is {found.sigma0:.4f}, not 1"] if bad else [])


if __name__ == "__main__":
    sys.exit(main())
