"""Half and double of the settings of a reconstruction: what each of them costs.

    python benchmarks/reconstruct_settings.py SETTING … [--set NAME] [--width PIXELS]
                                              [--factors 0.5 2] [--folder FOLDER]

SETTING: a field of `ReconstructionSettings`, with the stage before a point, as in
`track_matching.max_sigma`. A set of rendered photographs (`photograph_sets.py`) is reconstructed
with the default, then with each factor of each setting (whole numbers are rounded, to odd ones for
windows), and the accuracy is printed as by `reconstruct.py`: errors of the centres relative to
their extent, over their σ (1 expected), of c in σ, image points, worst factor of σ.
"""

import dataclasses
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import machine
from photograph_sets import SETS, WIDTH, write
from reconstruct import of_part

import jaxbundle
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.reconstruction.reconstruct import reconstruct
from jaxbundle.reconstruction.settings import ReconstructionSettings


def scale(settings, name: str, factor: float):
    """The settings with one of them multiplied, and its new value."""
    first, _, rest = name.partition(".")
    value = getattr(settings, first)
    if rest:
        value, new = scale(value, rest, factor)
        return dataclasses.replace(settings, **{first: value}), new
    new = tuple(factor * v for v in value) if isinstance(value, tuple) else value * factor
    if isinstance(value, int):
        new = max(1, round(new)) if "window" not in first else 2 * round(new / 2 - 0.5) + 1
    return dataclasses.replace(settings, **{first: new}), new


def describe(folder: Path, truth: dict, settings: ReconstructionSettings, store: Path) -> str:
    """The accuracy of the largest part in one line."""
    start = time.perf_counter()
    try:
        result = reconstruct([folder], settings=settings, store=store)
    except (InputError, NotSolvedError) as error:
        return f"failed: {str(error)[:60]}"
    seconds, figures = time.perf_counter() - start, of_part(result.parts[0], truth)
    c = max(figures["c_error_sigma"].values(), default=float("nan"))
    return (
        f"{figures['photographs']:3} photographs {figures['image_points']:6} image points  "
        f"centres {figures['centres_rms']:.1e} over σ {figures['centres_over_sigma']:.2f}  "
        f"c {c:.1f} σ  factor {max(figures['factors'].values(), default=1):.2f}  {seconds:.0f} s"
    )


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("settings", nargs="+", metavar="SETTING")
    parser.add_argument("--set", choices=SETS, default="depth")
    parser.add_argument("--width", type=machine.positive, default=WIDTH)
    parser.add_argument("--factors", type=float, nargs="+", default=[0.5, 2.0])
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    jaxbundle.enable_x64()
    shots = SETS[given.set](given.width)
    truth = {shot.name: shot for shot in shots}
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given.folder or Path(temporary)) / f"{given.set}_{given.width}"
        write(shots, folder)
        store = Path(temporary) / "matches"
        default = ReconstructionSettings()
        print(f"{'default':42}", describe(folder, truth, default, store), flush=True)
        for name in given.settings:
            for factor in given.factors:
                try:
                    settings, value = scale(default, name, factor)
                except InputError as error:
                    print(f"{name} × {factor:g}: {error}")
                    continue
                label = f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
                print(f"{label:42}", describe(folder, truth, settings, store), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
