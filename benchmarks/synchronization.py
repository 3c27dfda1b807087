"""Clocks of cameras that are not synchronised, against repeated simulation:
`python benchmarks/synchronization.py [DRAWS] [FRAMES]`.

Videos of `tests/calibration/video_scenes.py`: a board moved by hand before two cameras at 30 Hz,
whose offset and rate are unknown; and the same with rolling shutters, whose read-out times are
unknown, too. Every draw has new noise of the image points (0.05 px). For each unknown of the
clocks, and the base: the RMS of errors, this over the median stated σ, the mean error over its own
σ, and the largest |error|/σ.
"""

import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

import jaxbundle
from jaxbundle.calibration.rig.synchronize import adjust_unsynchronized

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / folder) for folder in ("calibration", "measure")]
READ_OUT, NOISE = 0.018, 0.05


def exact_points(rig, frames, read_out):
    """The image points of a rig without noise, in its order."""
    import video_scenes as scenes

    found = {}
    for k in "ab":
        views = scenes.video(k, frames, noise=0.0, read_out=read_out)
        found |= {f"{k} {name}": xy for name, xy in zip(views.names, views.xy)}
    return np.array([found[rig.epochs[e]][p] for e, p in zip(rig.epoch, rig.point)])


def draw_all(rig, exact, draws):
    """Values and σ of clocks and base of camera b, by draw: [draws, 9, 2]."""
    found = []
    for seed in range(draws):
        noise = NOISE * np.random.default_rng(seed).normal(size=exact.shape)
        with_noise = dataclasses.replace(rig, xy=exact + noise)
        _, result, held = adjust_unsynchronized(with_noise)
        assert not held
        clock, mounting = result["clock"], result["mounting"]
        value = [*clock.value.ravel(), *mounting.value.position[1]]
        sigma = [*clock.sigma.ravel(), *mounting.sigma[1, :3]]
        found.append(np.stack([value, sigma], 1))
    return np.array(found)


def main() -> None:
    import video_scenes as scenes

    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    frames = int(sys.argv[2]) if len(sys.argv) > 2 else 90
    T = scenes.MOUNTINGS["b"]
    names = [f"{n} {k}" for k in "ab" for n in ("offset", "rate", "read-out")]
    names += [f"base {axis}" for axis in "xyz"]
    for unknowns, read_out in (("offset,rate", 0.0), ("offset,rate,read-out", READ_OUT)):
        views = {k: scenes.video(k, frames, 1, read_out=read_out) for k in "ab"}
        first = jaxbundle.calibrate_rig(
            views, synchronize=unknowns, times=30.0, cross_validation=False, correlated=False,
            free=scenes.FREE, snooping=None, sigma_image=NOISE,
        )  # fmt: skip
        rig = first.rig
        begin = time.perf_counter()
        found = draw_all(rig, exact_points(rig, frames, read_out), draws)
        took = (time.perf_counter() - begin) / draws
        spacing = rig.trajectory.runs[0].spacing
        said = f"{draws} draws, {frames} frames, knots {spacing:.3f} s, {took:.1f} s each"
        print(f"{unknowns}: {said}")
        truth = [0, 0, read_out, *scenes.CLOCKS["b"], read_out, *(-T[:3, :3].T @ T[:3, 3])]
        for k, name in enumerate(names):
            error, sigma = found[:, k, 0] - truth[k], found[:, k, 1]
            if not sigma.any():
                continue
            rms = np.sqrt((error**2).mean())
            print(
                f"  {name:10} RMS {rms:.2e}, of σ {rms / np.median(sigma):.2f}; mean "
                f"{error.mean() / (error.std() / np.sqrt(draws)):5.1f} of its σ; largest "
                f"{np.abs(error / sigma).max():.1f} σ",
                flush=True,
            )


if __name__ == "__main__":
    jaxbundle.enable_x64()
    main()
