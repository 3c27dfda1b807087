"""Cameras calibrated by a wand, against repeated simulation:
`python benchmarks/wand.py [DRAWS] [FRAMES]`.

Four cameras around a room, a wand of two markers 0.5 m apart waved through it
(`tests/calibration/wand_scenes.py`). Every draw has new noise of the image points (0.1 px) and
another error of the length of the wand, the same in all its frames. For each camera the RMS of
errors over stated σ of the three coordinates of the base, the three angles, and of its length; and
the same of all. The wand is known to 0.01 and to 0.5 mm: the scale is then determined by the noise,
or by the wand. The same of a rig two of whose cameras see a board as well, which gives their
interior orientation; the others see only the wand. Ends with status 1 if an overall ratio is
outside 0.9 to 1.1.
"""

import sys
import time
from pathlib import Path

import numpy as np

import jaxbundle
from jaxbundle.calibration import Wand

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / "calibration")]
NOISE, LENGTH = 0.1, 0.5


def tables(seed, ends):
    """Markers of every camera with noise: those within the image."""
    import test_wand as room
    import wand_scenes as scenes

    rng, found = np.random.default_rng(seed), {}
    for k, name in enumerate(room.NAMES):
        camera = room.CAMERAS[name]
        exact = scenes.markers_in_images(camera, room.ROTATIONS[k], room.PLACES[k], ends, [0, 1])
        noisy = exact + NOISE * rng.normal(size=exact.shape)
        # by the exact place: all draws have the same points
        inside = ((exact > 3) & (exact < np.array(camera.image_size) - 4)).all(2)
        f, m = np.nonzero(inside)
        x, y = noisy[inside].T
        found[name] = {"frame": f, "marker": np.array(["A", "B"])[m], "x": x, "y": y}
    return found


def errors_over_sigma(found):
    """[cameras, 7]: base, turn and length."""
    import test_wand as room

    from jaxbundle.geometry import omega_phi_kappa_from_matrix

    over = []
    for k, name in enumerate(room.NAMES[1:], 1):
        m, (base, R) = found.mountings[name], room.truth(k)
        turn = m.angles - np.degrees(omega_phi_kappa_from_matrix(R))
        turn, sigma = (turn + 180) % 360 - 180, m.sigma
        length = (m.length - np.linalg.norm(base)) / m.length_sigma
        over.append([*((m.base - base) / sigma[:3]), *(turn / sigma[3:]), length])
    return np.array(over)


def by_wand(seed, ends, sigma_length):
    """The cameras by the wand alone, their interior orientations given."""
    import test_wand as room

    return jaxbundle.calibrate_wand(
        tables(seed, ends), room.CAMERAS, LENGTH, sigma_length=sigma_length, sigma_image=NOISE,
        second_minimum=False,
    )  # fmt: skip


def with_boards(seed, ends, sigma_length):
    """The same as a rig, of which two cameras see a board."""
    import test_wand as room
    import wand_scenes as scenes

    views = {name: scenes.views_of_board(room, name, seed) for name in room.NAMES[:2]}
    others = {name: room.CAMERAS[name] for name in room.NAMES[2:]}
    wand = Wand(tables(seed, ends), LENGTH, sigma_length, others)
    return jaxbundle.calibrate_rig(
        views, wand=wand, free=("fx", "fy", "cx", "cy"), cross_validation=False, correlated=False
    )


def main() -> int:
    import test_wand as room
    import wand_scenes as scenes

    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    frames = int(sys.argv[2]) if len(sys.argv) > 2 else 40
    status = 0
    for calibrate, sigma_length in ((by_wand, 1e-5), (by_wand, 5e-4), (with_boards, 5e-4)):
        begin, over, sigma0 = time.process_time(), [], []
        for seed in range(draws):
            wrong = sigma_length * np.random.default_rng([seed, 1]).normal()
            ends = scenes.wave(frames, length=LENGTH + wrong)
            found = calibrate(seed, ends, sigma_length)
            over.append(errors_over_sigma(found))
            sigma0.append(getattr(found, "adjustment", found).sigma0)
        over = np.array(over)
        took = (time.process_time() - begin) / draws
        print(
            f"{calibrate.__name__}, σ of the length {1e3 * sigma_length:g} mm: {draws} draws, "
            f"{frames} frames, mean σ0 {np.mean(sigma0):.3f}, {took:.1f} s of processor each"
        )
        rms = np.sqrt((over**2).mean(0))
        for name, row in zip(room.NAMES[1:], rms):
            listed = " ".join(f"{r:.2f}" for r in row)
            print(f"  {name}: errors over σ of base, angles, length {listed}")
        parts = [np.sqrt((over[..., k] ** 2).mean()) for k in (slice(3), slice(3, 6), 6)]
        status |= any(not 0.9 < r < 1.1 for r in parts)
        print("  all: base {:.3f}, angles {:.3f}, length {:.3f}".format(*parts), flush=True)
    return int(status)


if __name__ == "__main__":
    jaxbundle.enable_x64()
    sys.exit(main())
