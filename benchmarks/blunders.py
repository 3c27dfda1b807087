"""Blunders in a big block: how long data snooping and robust estimation take, and what they find.

    python benchmarks/blunders.py [--images N] [--points N] [--share X] [--size X] [--json FILE]

The block of `big_block.py`; a share of its image points (1 %) is moved by half to twice `size` σ in
a random direction. It is adjusted without treatment, with data snooping (Pope's test) and with
Tukey's estimator, once each: times include compilation. The output gives wall-clock and processor
time, and the blunders and good points that were removed or suspected. The exit status is 1 if one
of the two finds less than 90 % of the blunders (some are uncontrolled).
"""

import dataclasses
import os
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
import numpy as np
from big_block import SIGMA, block

import jaxbundle

METHODS = {"least squares": {}, "snooping": {"snooping": "pope"}, "Tukey": {"robust": "tukey"}}


def with_blunders(network, share: float, size: float, seed: int = 5):
    """The network with some image points moved, and which."""
    random, rays = np.random.default_rng(seed), network.observations
    rows = random.choice(len(rays), int(share * len(rays)), replace=False)
    turn = random.uniform(0, 2 * np.pi, len(rows))
    length = SIGMA * size * random.uniform(0.5, 2.0, len(rows))
    xy = rays.xy.copy()
    xy[rows] += length[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    return network.replace(observations=dataclasses.replace(rays, xy=xy)), rows


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--images", type=machine.positive, default=60)
    parser.add_argument("--points", type=machine.positive, default=26_000)
    parser.add_argument("--share", type=float, default=0.01)
    parser.add_argument("--size", type=float, default=20.0)
    parser.add_argument("--json", type=machine.target)
    given = parser.parse_args()
    jaxbundle.enable_x64()
    network, rows = with_blunders(
        block(given.images, given.points).network, given.share, given.size
    )  # fmt: skip
    figures, wrong = {"machine": machine.machine()}, []
    print(machine.in_words(figures["machine"]))
    print(f"{len(network.images)} images, {len(network.points)} points, "
          f"{2 * len(network.observations)} image coordinates, {len(rows)} blunders")  # fmt: skip
    for name, options in METHODS.items():
        begin, cpu = time.perf_counter(), time.process_time()
        result = jaxbundle.adjust(network, **options)
        clock, cpu = time.perf_counter() - begin, time.process_time() - cpu
        told = [*result.removed, *result.suspects]
        told = [item for item in told if item.kind == "image"]
        named = {row for item in told for row in getattr(item, "rows", (item.row,))}
        share = len(named & {*rows}) / len(rows)
        figures[name] = {"seconds": clock, "processor": cpu, "sigma0": result.sigma0,
                         "found": share, "good": len(named - {*rows})}  # fmt: skip
        what = f"; {share:.1%} of the blunders, {len(named - {*rows})} good ones" if told else ""
        print(f"{name:14} {clock:6.1f} s, processor {cpu:6.1f} s, sigma0 {result.sigma0:.4f}{what}")
        if options and share < 0.9:
            wrong.append(f"{name} found {share:.1%} of the blunders")
    machine.write_json(figures, given.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
