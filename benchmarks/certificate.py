"""How often stated expanded uncertainties hold: coverage of certificates of simulated artefacts.

    python benchmarks/certificate.py [--draws N] [--json FILE]

Every draw is another artefact: 24 targets with control of σ = 0.2 mm on six of them, a scale bar
of 20 µm, ten photographs of σ = 0.6 µm (stated as 1 µm: only the residuals know it), and a camera
whose K3, which the adjustment holds at 0, is drawn from its rectangular limits. The budget of its
principal distance, principal point, K1 and K2 (`jaxbundle.uncertainty_budget`) knows the stated σ,
the limits of K3, and the residuals. A calibrated length of known uncertainty is compared with the
result as in VDI/VDE 2634-1.

Reported are the share of draws in which truth is within ± U of each quantity (95 % expected), and
the mean k. Exit status 1 if the mean over all quantities is outside of 95 ± 1.5 %, or one of them
by more than three standard errors of its draws beyond.
"""

import dataclasses
import sys

import machine
import numpy as np

NOISE, STATED, CONTROL, BAR, LIMITS = 0.0006, 0.001, 2e-4, 2e-5, 3e-10
FREE = ("c", "x0", "y0", "K1", "K2")


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--draws", type=machine.positive, default=1000)
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    import jax
    import jax.numpy as jnp

    import jaxbundle
    from jaxbundle.certificates import HeldInput

    jaxbundle.enable_x64()
    truth = {"c": 28.0, "x0": 0.02, "y0": -0.01, "K1": -1e-4, "K2": 1e-7}
    stations = jaxbundle.ring_of_stations(10, radius=2.4, height=1.8, roll_every=2)
    targets = jaxbundle.cloud_of_targets(24, (1.6, 1.6, 0.8), seed=3)
    held = {"camera:cam:K3": HeldInput.from_limits(LIMITS)}
    length = float(np.linalg.norm(targets[20] - targets[21]))
    inside, k = [], []
    # one function, so that its program is compiled once
    between = lambda values: jnp.linalg.norm(values["point"][21] - values["point"][20])
    for seed in range(options.draws):
        if seed % 100 == 99:  # budgets of new functions are new programs: memory maps are limited
            jax.clear_caches()
            print(f"{seed + 1}: {100 * np.mean(inside):.2f} %", file=sys.stderr, flush=True)
        rng = np.random.default_rng(seed)
        K3 = rng.uniform(-LIMITS, LIMITS)
        camera = jaxbundle.Camera("cam", "brown", {**truth, "K3": K3}, FREE)
        network = jaxbundle.simulate(
            stations, targets, camera, noise=NOISE, seed=seed, control=range(6),
            control_sigma=CONTROL, distances=[(22, 23)], distance_sigma=BAR,
            start=jaxbundle.Camera("cam", "brown", truth, FREE),
        )  # fmt: skip
        rays = network.observations
        sigma = np.full_like(rays.sigma, STATED)
        rays = dataclasses.replace(rays, sigma=sigma, sigma_origin="unit")
        result = jaxbundle.adjust(network.replace(observations=rays), second_minimum=False)
        budget = jaxbundle.uncertainty_budget(result, held=held)
        values = np.array([one.value for one in budget.measurands])
        within = np.abs(values - [truth[name] for name in FREE]) <= budget.expanded
        of_length = jaxbundle.uncertainty_budget(result, between, held=held)
        away = abs(of_length.measurands[0].value - length)
        within = np.append(within, away <= of_length.expanded)
        inside.append(within)
        k.append(np.append(budget.k, of_length.k))
    coverage, names = np.mean(inside, 0), [*FREE, "length"]
    error = np.sqrt(0.95 * 0.05 / options.draws)
    print(f"{options.draws} artefacts: share within ± U (95 %), mean k")
    for name, share, factor in zip(names, coverage, np.mean(k, 0)):
        print(f"{name:10}{100 * share:8.1f} %{factor:8.3f}")
    print(f"{'mean':10}{100 * coverage.mean():8.2f} %")
    wrong = [
        f"{name}: {100 * share:.1f} %"
        for name, share in zip(names, coverage)
        if abs(share - 0.95) > 0.015 + 3 * error
    ]
    if abs(coverage.mean() - 0.95) > 0.015:
        wrong.append(f"mean coverage {100 * coverage.mean():.2f} %")
    figures = {
        "machine": machine.machine(), "draws": options.draws,
        "coverage": dict(zip(names, coverage.tolist())), "mean": float(coverage.mean()),
    }  # fmt: skip
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
