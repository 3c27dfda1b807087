"""The cost of a focus ring that moves between photographs, and of a separate principal distance for
every photograph if it does not.

    python benchmarks/focus_ring.py [--draws N] [--json FILE]

Twelve convergent photographs of 60 targets in a box of 2 m, c = 28 mm, σ = 0.5 µm of an image
coordinate, every third rolled; four targets are control (0.01 mm). The principal distance of every
photograph is off by a normal deviate of τ, a fraction of c. Each draw is adjusted three times:

| way | the principal distance |
|---|---|
| one | one for all photographs |
| own | one for each, everything else of the camera in common (`ties`) |
| tied | one for each, within σ = τ of that of the first (`ties` with σ = √2·τ) |

Figures are over the draws: σ0 over the stated one, RMS error and RMS σ of a coordinate of the other
targets in µm, RMS of error/σ (1 if the σ are realistic), σ of the first c. Exit status 1 if the σ
of `own` or `tied` are wrong by more than a fifth.
"""

import dataclasses
import sys

import machine

FRACTIONS = (0.0, 3e-4, 1e-3, 3e-3, 1e-2)
PHOTOGRAPHS, TARGETS, CONTROL = 12, 60, 4
C, NOISE = 28.0, 5e-4
SHARED = ("x0", "y0", "K1", "K2")
LEAST_TIE = 1e-7
"""σ of a tie if the ring does not move, mm."""


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--draws", type=machine.positive, default=8)
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    import numpy as np

    import jaxbundle
    from jaxbundle.network.build import make_further

    jaxbundle.enable_x64()
    stations = jaxbundle.ring_of_stations(PHOTOGRAPHS, radius=4.0, height=2.5, roll_every=3)
    targets = jaxbundle.cloud_of_targets(TARGETS, 2.0, seed=4)
    names = [f"ring {i}" for i in range(PHOTOGRAPHS)]
    given = {"c": C, "x0": 0.05, "y0": -0.03, "K1": -5e-5, "K2": 3e-8}

    def simulate(tau, seed):
        """The network with a camera for every photograph, started from one c, and its truth."""
        off = 1 + tau * np.random.default_rng(1000 + seed).normal(size=PHOTOGRAPHS)
        of = lambda c: [jaxbundle.Camera(name, "brown", given | {"c": C * one}, ("c", *SHARED))
                        for name, one in zip(names, c)]  # fmt: skip
        return jaxbundle.simulate_with_truth(
            stations, targets, of(off), noise=NOISE, seed=seed, datum="control",
            control=range(CONTROL), control_sigma=1e-5, start=of(np.ones(PHOTOGRAPHS)),
            disturb=(1e-3, 1e-4, 1e-3),
        )  # fmt: skip

    def tied(network, tau):
        rows = [{"camera": names[0], "other": name, "parameter": parameter, "sigma": "exact"}
                for name in names[1:] for parameter in SHARED]  # fmt: skip
        if tau is not None:
            sigma = max(np.sqrt(2) * tau * C, LEAST_TIE)
            rows += [{"camera": names[0], "other": name, "parameter": "c", "sigma": sigma}
                     for name in names[1:]]  # fmt: skip
        return network.replace(further=make_further({"ties": rows}, 1.0))

    def together(network):
        camera = dataclasses.replace(network.cameras[0], id=names[0])
        images = dataclasses.replace(network.images, camera=np.zeros(PHOTOGRAPHS, np.int64))
        return network.replace(cameras=(camera,), images=images)

    figures, wrong = {"machine": machine.machine(), "draws": options.draws}, []
    for tau in FRACTIONS:
        ways = {"one": together, "own": lambda n: tied(n, None),
                "tied": lambda n, tau=tau: tied(n, tau)}  # fmt: skip
        found = {name: [] for name in ways}
        for seed in range(options.draws):
            made = simulate(tau, seed)
            for name, prepare in ways.items():
                result = jaxbundle.adjust(prepare(made.network))
                tie = result.points["role"] == "tie"
                error = (result.point_values - made.truth.points.position)[tie]
                sigma = np.stack([result.points[f"s{axis}"] for axis in "XYZ"], 1)[tie]
                c = result.cameras[names[0]]["parameters"]["c"]
                found[name].append((result.sigma0**2, np.mean(error**2), np.mean(sigma**2),
                                    np.mean((error / sigma) ** 2), c["sigma"] ** 2))  # fmt: skip
        rows = {}
        for name, draws in found.items():
            sigma0, error, sigma, ratio, c = np.sqrt(np.mean(draws, 0))
            rows[name] = {
                "sigma0": round(sigma0, 2), "error_um": round(1e6 * error, 1),
                "sigma_um": round(1e6 * sigma, 1), "error_over_sigma": round(ratio, 2),
                "sigma_c_um": round(1e3 * c, 2),
            }  # fmt: skip
            if name != "one" and not 0.8 < ratio < 1.2:
                wrong.append(f"τ/c {tau:g}, {name}: error/σ {ratio:.2f}")
        figures[f"{tau:g}"] = rows
    if options.json != "-":
        print(machine.in_words(figures["machine"]))
        for tau in FRACTIONS:
            for name, row in figures[f"{tau:g}"].items():
                print(f"τ/c {tau:<7g} {name:5}", *(f"{k} {v:g};" for k, v in row.items()))
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
