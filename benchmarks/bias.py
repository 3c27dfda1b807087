"""The bias test of a calibration over many draws: how often it rejects, and with which cause.

    python benchmarks/bias.py [--draws N] [--json FILE]

Twelve views of a chessboard of 9 × 6 corners, 480 × 360 pixels, σ = 0.05 pixels, OpenCV's model.
Clean data; a lens with k2 = −0.4 calibrated without k2 and k3; a board bent by 0.1 mm over its 240
mm. The first draw of a case is calibrated from its corners alone, all others are adjusted again
from there. Exit status 1 if clean data are called biased in more than 3 % of the draws, or a bias
is missed or attributed to the wrong cause in more than 5 %.
"""

import dataclasses
import sys
import time
from pathlib import Path

import machine

CASES = {
    "clean": ({}, 0.0),
    "k2 missing": ({"free": ("fx", "fy", "cx", "cy", "k1", "p1", "p2")}, 0.0),
    "board bent": ({}, 1e-4),
}
CAUSE = {"k2 missing": "camera", "board bent": "board"}
K2 = -0.4


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--draws", type=machine.positive, default=200)
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    import jaxbundle
    from jaxbundle.adjustment.result import Adjustment
    from jaxbundle.calibration.bias import find_bias
    from jaxbundle.leastsquares.problem import with_data
    from jaxbundle.leastsquares.solution import find_minimum

    jaxbundle.enable_x64()
    tests = Path(__file__).parent.parent / "tests"
    sys.path[:0] = [str(tests / "calibration"), str(tests / "measure")]
    import board_photographs as taken
    import numpy as np
    import render
    from test_calibrate import simulated

    X = taken.BOARD.points
    away = (X - X.mean(0))[:, 0] / 0.12
    p = render.LENS.parameters
    strong = dataclasses.replace(render.LENS, parameters=(*p[:5], K2, *p[6:]))
    figures, wrong = {"machine": machine.machine(), "draws": options.draws}, []
    begin = time.perf_counter()
    for name, (given, bend) in CASES.items():
        lens = strong if name == "k2 missing" else render.LENS
        points = X + np.outer(bend * away**2, [0, 0, 1])
        views = simulated(lens, points=points, seed=0)
        first = jaxbundle.calibrate(views, snooping=None, cross_validation=False, **given)
        problem, found = first.adjustment.problem, [first.bias]
        for seed in range(1, options.draws):
            xy = simulated(lens, points=points, seed=seed).xy.reshape(-1, 2)
            again = with_data(problem, problem.with_image_coordinates(problem.data, xy))
            one = Adjustment(problem.network, again, find_minimum(again, first.adjustment.values))
            found.append(find_bias(one, taken.BOARD.grid))
        rate = lambda of, found=found: float(np.mean([bool(of(bias)) for bias in found]))
        figures[name] = {
            "speaks": rate(lambda bias: bias.found),
            **{f"by {test}": rate(lambda bias, test=test: test in bias.found)
               for test in ("cells", "camera", "board")},
            "right cause": rate(lambda bias, name=name: bias.found[:1] == (CAUSE.get(name),)),
            "bias ratio": round(float(np.median([bias.ratio for bias in found])), 3),
            "corner sigma": round(float(np.median([bias.corner_sigma for bias in found])), 4),
        }  # fmt: skip
        if name == "clean" and figures[name]["speaks"] > 0.03:
            wrong.append("clean data are called biased")
        if name in CAUSE and figures[name]["right cause"] < 0.95:
            wrong.append(f"{name}: not found")
    figures["s"] = round(time.perf_counter() - begin, 1)
    if options.json != "-":
        print(machine.in_words(figures["machine"]))
        for name in CASES:
            print(f"{name:12}", *(f"{key} {value:g};" for key, value in figures[name].items()))
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
