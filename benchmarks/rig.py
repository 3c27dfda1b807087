"""σ of mountings against repeated simulation: `python benchmarks/rig.py [DRAWS]`.

Rigs of `tests/calibration/rig_scenes.py`: four cameras in a row, neighbours of which see a moved
board together; and two cameras back to back, each before a board of its own on a wall, tied by the
motion of the rig alone. Every draw has new noise of the image points, everything else is the same.
For every mounting (and the place of the rear board): the standard deviation of the draws over the
median stated σ, for base and rotation; d²/6 of all six with their covariance (1 where it is right);
and the largest |error|/σ.
"""

import sys
from pathlib import Path

import numpy as np

import jaxbundle

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / folder) for folder in ("calibration", "measure")]


def errors(found, truth):
    """Base and rotation vector (degrees) of a mounting minus the truth."""
    R, base = truth[:3, :3], -truth[:3, :3].T @ truth[:3, 3]
    D = found.rotation @ R.T
    turn = np.degrees([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]) / 2
    return np.concatenate([found.base - base, turn])


def tangent(found):
    """From ω, φ, κ to the rotation vector at a mounting, by differences of its angles."""
    from jaxbundle.geometry import matrix_from_omega_phi_kappa as matrix

    step, angles = 1e-5, np.radians(found.angles)
    columns = []
    for k in range(3):
        a = angles.copy()
        a[k] += step
        D = np.asarray(matrix(a)) @ found.rotation.T
        columns.append([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    T = np.eye(6)
    T[3:, 3:] = np.array(columns).T / (2 * step)
    return T


def main() -> None:
    import rig_scenes as scenes

    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    options = {
        "cross_validation": False, "correlated": False, "free": scenes.FREE, "snooping": None,
    }  # fmt: skip
    truth = {"rear": np.linalg.inv(scenes.REAR)}
    cases = {
        "four cameras in a row": lambda seed: jaxbundle.calibrate_rig(
            scenes.chain(seed, epochs=8), **options
        ),
        "back to back, by motion": lambda seed: jaxbundle.calibrate_rig(
            scenes.back_to_back(seed), fixed=True, **options
        ),
    }
    truth |= scenes.CHAIN | {"b": scenes.BACK}
    for title, make in cases.items():
        error, covariance = {}, {}
        for seed in range(draws):
            found = make(seed)
            for name, one in (found.mountings | found.placements).items():
                T = tangent(one)
                error.setdefault(name, []).append(errors(one, truth[name]))
                covariance.setdefault(name, []).append(T @ one.covariance @ T.T)
        print(f"{title}, {draws} draws")
        for name in error:
            e, C = np.array(error[name]), np.array(covariance[name])
            sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
            ratio = np.sqrt((e**2).mean(0)) / np.median(sigma, 0)
            d2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e) / 6
            largest = np.abs(e / sigma).max()
            shown = " ".join(f"{r:.2f}" for r in ratio)
            print(f"  {name}: RMS error/σ {shown}; d²/6 {d2.mean():.3f}; largest {largest:.1f} σ")


if __name__ == "__main__":
    jaxbundle.enable_x64()
    main()
