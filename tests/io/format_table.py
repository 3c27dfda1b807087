"""What the readers of keyed files know, and what a round trip changes: tables from the
declarations and the formats themselves.

    PYTHONPATH=.:tests/io:tests/pushbroom:tests/photographs:tests/surfaces:tests/measure \
        python tests/io/format_table.py [--write]

`used`: keys that a reader uses; `left`: those that it may leave, with a reason in its module;
`warned`: those that it does not read and says so. Every other key is a warning, or refused if its
name may change the geometry. `samples`: small files in the tests. A round trip writes the network
of `exchange_cases` and reads it: the greatest differences of rays, projection centres, points and
image points. `--write` puts both tables into `docs/exchange.md`.
"""

import dataclasses
import importlib
import pkgutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from exchange_cases import matrix, network
from foreign_samples import SAMPLES
from readers import READERS

import jaxbundle.io.cameras
import jaxbundle.io.networks
import jaxbundle.io.scanner
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_network, write_project
from jaxbundle.io.formats import FORMATS
from jaxbundle.io.output_formats import CAMERA_KINDS, TARGETS
from jaxbundle.io.text.known_keys import Keys
from jaxbundle.network.tables import Network

TESTS = Path(__file__).parents[1]
PAGE = TESTS.parent / "docs" / "exchange.md"
BEGIN, END = "<!-- by tests/io/format_table.py --write -->\n", "<!-- end of the tables -->"
# Where a format is recognised by its name, and the model of a camera that it holds exactly.
NAMES = {"bal": "p.bal", "bundler": "p.out", "openmvg": "sfm_data.json", "jaicov": "n.phc",
         "transforms": "transforms.json", "kalibr": "camchain.yaml", "micmac": "Ori-x",
         "mrcal": "mrcal", "colmap": "colmap", "opensfm": "opensfm", "anipose": "calibration.toml",
         "opencv-stereo": "stereo.yaml", "ros-stereo": "camera_info"}  # fmt: skip
MODELS = {"bal": "snavely", "bundler": "snavely", "jaicov": "brown-projected"}
# The samples of a module, if not those of its name.
OF_MODULE = {
    "spellings": ("opencv-json",), "opencv_file": ("opencv", "opencv-xml", "ros", "euroc"),
    "slam_yaml": ("camodocal", "camodocal-lens"), "ros_ini": ("ros-ini",),
    "metashape_camera": ("metashape",), "metashape_lens": ("metashape-lens",),
    "micmac_camera": ("autocal",), "mounted_files": ("vins",), "orb_slam": ("orb-slam",
    "orb-slam-pair"), "opencv_rigs": ("opencv-stereo", "opencv-nested"),
    "csm_frame": ("csm-frame",),
    "kalibr": ("kalibr", "kalibr-camera"), "opensfm": ("opensfm", "opensfm-cameras"),
    "dimap_keys": ("dimap", "dimap2", "dimap2-table", "dimap2-early"),
}  # fmt: skip


def declarations() -> dict[str, list[Keys]]:
    """The keys that each module declares."""
    found: dict[str, list[Keys]] = {}
    for package in (jaxbundle.io.networks, jaxbundle.io.cameras, jaxbundle.io.scanner):
        for module in pkgutil.iter_modules(package.__path__):
            values = vars(importlib.import_module(f"{package.__name__}.{module.name}")).values()
            trees = [value.values() for value in values if isinstance(value, dict)]
            every = [*values, *(one for tree in trees for one in tree)]
            if keys := {id(one): one for one in every if isinstance(one, Keys)}:
                found[module.name] = list(keys.values())
    return found


def keys_table() -> str:
    """Rows of modules, and the number of inputs and outputs."""
    lines = ["| reader | samples | objects | used | left | warned |", "|---|---|---|---|---|---|"]
    for name, keys in declarations().items():
        numbers = [len({*(k for one in keys for k in part(one))}) for part in
                   (lambda k: k.used, lambda k: k.ignored, lambda k: k.warned)]  # fmt: skip
        samples = OF_MODULE.get(name, (name,) if name in SAMPLES else ())
        row = (f"`{name}`", len(samples), len(keys), *numbers)
        lines.append(f"| {' | '.join(map(str, row))} |")
    return "\n".join(
        [
            *lines, "",
            f"{len(FORMATS)} inputs of networks, {len(TARGETS)} outputs of networks, "
            f"{len(CAMERA_KINDS)} of cameras; {len(SAMPLES)} keyed samples, each read by the tests "
            f"with a further key in every place; {len(READERS)} inputs that "
            "`make mutations` damages.",
        ]
    )  # fmt: skip


def differences(before: Network, after: Network) -> tuple[float, float, float, float]:
    """The greatest of angles (radians), projection centres, points, image points, by names where
    the format keeps them, else in their order; NaN for what it does not have."""
    row = {name: k for k, name in enumerate(after.images.id)}
    order = [row.get(name, k) for k, name in enumerate(before.images.id)]
    turns = np.stack([matrix(a) for a in before.images.angles])
    back = np.stack([matrix(a) for a in after.images.angles])[order]
    greatest = lambda a, b: float(np.abs(a - b).max()) if a.shape == b.shape and a.size else np.nan
    rays = lambda n: n.observations.xy[np.lexsort((n.observations.point, n.observations.image))]
    return (
        greatest(turns, back),
        greatest(before.images.position, after.images.position[order]),
        greatest(before.points.position, after.points.position),
        greatest(rays(before), rays(after)),
    )


def round_trips() -> str:
    """A row a format that is read and written."""
    lines = ["| format | rotations | centres | points | image points, px or mm |",
             "|---|---|---|---|---|"]  # fmt: skip
    for kind in TARGETS:
        if kind not in FORMATS or kind in ("project", "kalibr", "opencv-stereo", "ros-stereo",
                                              "anipose"):
            continue  # rigs alone, and our own
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            names = ("0", "1", "2") if kind == "bal" else ("a", "b", "c")
            model = MODELS.get(kind, "opencv")
            before = network("opencv" if model == "brown-projected" else model, names,
                             0 if kind == "bal" else 1)  # fmt: skip
            if kind in ("openmvg", "micmac"):  # one focal length
                (camera,) = before.cameras
                square = {**camera.parameters, "fy": camera.parameters["fx"]}
                before = before.replace(cameras=(dataclasses.replace(camera, parameters=square),))
            source = write_project(before, folder / "n")
            if model == "brown-projected":
                convert(source, folder / "m", model=model)
                source, before = folder / "m", read_network(folder / "m")
            out = folder / NAMES.get(kind, f"out_{kind}")
            try:
                convert(source, out, to=kind)
                after = read_network(out)
            except InputError as error:
                raise SystemExit(f"{kind}: {error}") from None
        cells = ["–" if np.isnan(d) else f"{d:.1g}" for d in differences(before, after)]
        lines.append(f"| `{kind}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    text = f"{keys_table()}\n\n{round_trips()}\n"
    if "--write" not in sys.argv:
        print(text)
        return
    page = PAGE.read_text(encoding="utf-8")
    head, _, rest = page.partition(BEGIN)
    PAGE.write_text(f"{head}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    import jaxbundle

    jaxbundle.enable_x64()
    main()
