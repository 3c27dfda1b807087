"""What the settings of a surface do: half and double of each, on rendered photographs.

    python benchmarks/surface_settings.py [STAGE …] [--dense] [--scene NAME]

STAGE: parts of the names of settings classes, all if none. Half and double of whole numbers are
rounded; of correlations, shares and ratios below 1 the double is halfway to 1 instead.

Scene, figures and their meaning are those of `surface_accuracy.py`: points, share within 0.2 pixel,
RMS of the errors over σ, share within 3 σ, share wrong by more than a pixel.
"""

import argparse
import dataclasses
from collections.abc import Iterator

import jax
from surface_accuracy import SCENES, make, row

import jaxbundle
from jaxbundle.surfaces.reconstruct import SurfaceSettings

FIGURES = ("points", "% < 0.2", "RMS", "RMS robust", "% < 3s", "% out", "factor", "s")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stages", nargs="*")
    parser.add_argument("--dense", action="store_true", help="every pixel, else every fifth")
    parser.add_argument("--scene", default="no texture", choices=SCENES)
    options = parser.parse_args()
    jaxbundle.enable_x64()
    made = make(options.scene)
    way = {"dense": True} if options.dense else {"step": 5}
    for name, settings in [("as it is", SurfaceSettings()), *variants(SurfaceSettings())]:
        if name == "as it is" or not options.stages or any(s in name for s in options.stages):
            figures = row(*made, **way, settings=settings)[0]
            told = "  ".join(f"{key} {figures[key]:.4g}" for key in FIGURES)
            print(f"{name:60} {told}", flush=True)
            # settings of compiled programs are constants in them
            jax.clear_caches()


def variants(settings: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Names, and the settings with one field at half and at double."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        name = f"{path}{type(settings).__name__}.{field.name}"
        if dataclasses.is_dataclass(value):
            for inner, other in variants(value, path):
                yield inner, dataclasses.replace(settings, **{field.name: other})
        elif isinstance(value, int | float) and not isinstance(value, bool):
            for other in scale(value):
                changed = dataclasses.replace(settings, **{field.name: other})
                yield f"{name} {value} → {other}", changed


def scale(value: float) -> tuple[float, float]:
    """Half, and double or halfway to 1."""
    if isinstance(value, int):
        return max(1, value // 2), 2 * value
    return value / 2, (1 + value) / 2 if 0.5 <= value < 1 else 2 * value


if __name__ == "__main__":
    main()
