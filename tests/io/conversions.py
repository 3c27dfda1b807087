"""Networks written in every format and read back: what is lost, and the greatest differences.

    python tests/io/conversions.py [--write]      the table of docs/conversions.md; round trips
"""

import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from exchange_cases import POINTS, matrix

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.geometry.rotations import omega_phi_kappa_from_matrix
from jaxbundle.io import read_network
from jaxbundle.io.formats import FORMATS
from jaxbundle.io.networks.losses import PARTS, QUANTITIES
from jaxbundle.io.output_formats import TARGETS
from jaxbundle.network import Camera
from jaxbundle.network.build import make_network
from jaxbundle.network.kinds import KINDS as KINDS
from jaxbundle.network.tables import Network

PAGE = Path(__file__).parents[2] / "docs" / "conversions.md"
NAMES = {
    "bundler": "bundle.out", "bal": "problem.txt", "openmvg": "sfm_data.json",
    "transforms": "transforms.json", "kalibr": "camchain.yaml", "micmac": "Ori-A",
    "anipose": "calibration.toml", "jaicov": "project.phc", "opencv-stereo": "stereo.yaml",
    "realityscan-csv": "realityscan.csv", "alicevision": "scene.sfm",
    "ply": "n.ply", "dxf": "n.dxf", "csv": "n.csv",
}  # fmt: skip
DRAWINGS = ("ply", "dxf", "csv")
"""Outputs that are not read as networks."""

PARAMETERS = {
    "opencv": dict(fx=1000.0, fy=1000.0, cx=641.0, cy=358.5, k1=-0.1, k2=0.02, p1=1e-3),
    "snavely": dict(f=1000.0, k1=-0.1, k2=0.02),
    "brown-projected": dict(c=5.0, x0=0.01, y0=-0.02, K1=2e-3, K2=-3e-5, P1=1e-4, b1=1e-4),
    "brown": dict(c=5.0, x0=0.01, y0=-0.02, K1=2e-3, K2=-3e-5, P1=1e-4, P2=-5e-5),
}
PIXEL = 0.005
COLUMNS = ("X0", "Y0", "Z0", "omega", "phi", "kappa")


def model_for(kind: str) -> str:
    """A camera model that a kind of output holds."""
    models = TARGETS[kind].models
    return next(m for m in PARAMETERS if not models or m in models)


@cache
def full_network(model: str, plain: bool = False) -> Network:
    """Two cameras at two moments, with everything a network may have; `plain`: nothing but what
    every format holds, with names that are numbers from 0."""
    given = PARAMETERS[model]
    unit = get_model(model).unit
    sigma = 0.002 if unit == "mm" else 0.5
    more = {} if plain else {"free": tuple(given)[:1], "sigma": {next(iter(given)): 0.5}}
    sizes = {} if plain and model == "snavely" else {"image_size": (1280, 720)}
    if not plain or model.startswith("brown"):
        sizes["pixel_size"] = (PIXEL, PIXEL)
    first = next(iter(given))
    cameras = [
        Camera(id, model, given | {first: (1 + 0.01 * k) * given[first]}
               | ({"fy": (1 + 0.01 * k) * given[first]} if first == "fx" else {}), **sizes, **more)
        for k, id in enumerate(("0", "1") if plain else ("left", "right"))
    ]  # fmt: skip
    D, t = matrix([0.02, -0.3, 0.05]), np.array([0.6, 0.05, -0.02])
    poses = []
    for angles, X0 in zip(([0.1, -0.2, 0.2], [-0.2, 0.3, -2.9]), ([-1.2, -0.2, 4], [1, 0.6, 4.2])):
        M = matrix(angles)
        poses += [(M, np.array(X0)), (D @ M, X0 + M.T @ t)]
    images, rays = [], []
    poses = poses[:2] if plain else poses
    for k, (M, X0) in enumerate(poses):
        angles = np.asarray(omega_phi_kappa_from_matrix(M))
        id = str(k) if plain else f"{'lr'[k % 2]}{k // 2}.jpg"
        images.append({"id": id, "camera": cameras[k % 2].id, **dict(zip(COLUMNS, (*X0, *angles)))})
        values = {**default_parameters(get_model(model)), **cameras[k % 2].parameters}
        for p, (x, y) in enumerate(images_of(get_model(model), values, (POINTS - X0) @ M.T)):
            point = str(p) if plain else f"P{p}"
            rays.append({"image": id, "point": point, "x": float(x), "y": float(y)})
    if not plain:
        for k, row in enumerate(images):
            row |= {f"s{name}": 0.01 + 0.001 * k for name in COLUMNS}
        for k, row in enumerate(rays):
            row |= {"sx": sigma * (1 + k % 3), "sy": sigma}
    roles = {1: "control", 2: "control", 3: "fixed", 4: "check"}
    points = []
    for p, X in enumerate(POINTS):
        row = {"id": str(p) if plain else f"P{p}", "role": "tie", **dict(zip("XYZ", X))}
        if not plain and p in roles:
            row["role"] = roles[p]
            row |= dict(sX=0.01, sY=0.02, sZ=0.03) if roles[p] == "control" else {}
        row |= {} if plain else dict(red=20 * p, green=255 - p, blue=p)
        points.append(row)
    tables = {} if plain else {
        "distances": [{"from": "P5", "to": "P6", "value": 1.25, "sigma": 0.01}],
        "rigs": [{"rig": "pair", "epoch": str(k // 2), "image": row["id"]}
                 for k, row in enumerate(images)],
        "antennas": [{"image": row["id"], **dict(zip("XYZ", X0)), "sX": 0.1, "sY": 0.1, "sZ": 0.1}
                     for row, (_, X0) in zip(images, poses)],
        "differences": [{"from": "P5", "to": "P6", "dX": 0.1, "sdX": 0.01}],
    }  # fmt: skip
    return make_network(
        cameras, images, points, rays, image_unit=unit, residuals="measured",
        datum="inner", datum_points=() if plain else ("P5", "P6", "P7"), **tables,
    )  # fmt: skip


def write(kind: str, network: Network, folder: Path) -> tuple[Path, tuple[str, ...]]:
    """Where a network is written, and what the writer says that it does not keep."""
    path = folder / NAMES.get(kind, kind)
    if TARGETS[kind].files:
        path.mkdir()
    return path, tuple(TARGETS[kind].write(network, path))


def _pairs(a: tuple[str, ...], b: tuple[str, ...]) -> list[tuple[int, int]]:
    """Rows of two tables that belong together: by name, else in their order."""
    row = {id: k for k, id in enumerate(b)}
    named = [(k, row[id]) for k, id in enumerate(a) if id in row]
    return named if len(named) == min(len(a), len(b)) else list(zip(range(len(a)), range(len(b))))


def _rows(kind) -> set:
    columns = kind.columns(1.0)
    return {tuple(map(str, row)) for row in zip(*columns.values())}


class Comparison:
    """Two networks, the second read back: which quantities are lost, which differences there are.

    Rotations are compared up to that of the first image if only mountings are kept."""

    def __init__(self, before: Network, after: Network):
        self.before, self.after = before, after
        a, b = before, after
        self.images = _pairs(a.images.id, b.images.id)
        self.points = _pairs(a.points.id, b.points.id)
        if len(b.points) and not {*a.points.id} <= {*b.points.id}:
            far = np.linalg.norm(a.points.position[:, None] - b.points.position, axis=2)
            self.points = [*enumerate(far.argmin(1).tolist())]
        self.cameras = {
            (int(a.images.camera[i]), int(b.images.camera[j])) for i, j in self.images
        }

    def lost(self) -> set[str]:
        """The names of what is lost, without what goes with it."""
        a, b = self.before, self.after
        two = lambda name: QUANTITIES[name](a) > QUANTITIES[name](b)
        # of a rig with fewer epochs, the orientations of the others are lost
        whole = ("rigs", "that images share a camera") if len(b.images) < len(a.images) else ()
        lost = {name for name in QUANTITIES if two(name) and name not in whole}
        if {c.id for c in a.cameras} != {c.id for c in b.cameras}:
            lost.add("names of cameras")
        if not {*a.images.id} <= {*b.images.id} and len(a.images) == len(b.images):
            lost.add("names of images")
        if not {*a.points.id} <= {*b.points.id}:
            lost.add("names of points")
        roles = [(a.points.role[i], b.points.role[j]) for i, j in self.points]
        if any(x != y for x, y in roles):
            lost.add("roles of points")
        if "colours of points" not in lost and a.points.colour is not None:
            rows = np.array(self.points, int).reshape(-1, 2)
            if (a.points.colour[rows[:, 0]] != b.points.colour_or_grey()[rows[:, 1]]).any():
                lost.add("colours of points")
        for name, x, y in (
            ("σ of control points", a.points.sigma, b.points.sigma),
            ("prior σ of orientations", a.images.sigma, b.images.sigma),
        ):
            rows = np.array(self.points if "points" in name else self.images, int).reshape(-1, 2)
            if not np.allclose(x[rows[:, 0]], y[rows[:, 1]], rtol=1e-14, equal_nan=True):
                lost.add(name)
        if "image points" not in lost:
            x, y = (self._rays(n, k) for k, n in enumerate((a, b)))
            if not all(np.allclose(x[key][1], y[key][1], rtol=1e-12) for key in x):
                lost.add("σ of image points")
        for kind in a.further:
            other = [k for k in b.further if k.TABLE == kind.TABLE]
            images = {a.images.id[i]: b.images.id[j] for i, j in self.images}
            if kind.TABLE in whole and other:
                continue
            if kind.TABLE not in ("rigs", "antennas") or not other:
                if not other or _rows(kind) != _rows(other[0]):
                    lost.add(kind.TABLE)
            elif {images.get(i) for i in kind.image} != {*other[0].image}:
                lost.add(kind.TABLE)
        if a.distances.value.tolist() != b.distances.value.tolist():
            lost.add("distances")
        return lost - {part for name in lost for part in PARTS.get(name, ())}

    def _rays(self, network: Network, side: int) -> dict:
        """(image, point) as rows of the first network → xy, σ."""
        image = {pair[side]: pair[0] for pair in self.images}
        point = {pair[side]: pair[0] for pair in self.points}
        rays = network.observations
        return {
            (image.get(i), point.get(p)): (xy, s)
            for i, p, xy, s in zip(rays.image.tolist(), rays.point.tolist(), rays.xy, rays.sigma)
        }

    def greatest(self) -> dict[str, float]:
        """The greatest differences of what is kept."""
        a, b = self.before, self.after
        found: dict[str, float] = {}
        M, N = (np.array([matrix(x) for x in n.images.angles]) for n in (a, b))
        X, Y = a.images.position, b.images.position
        if len(a.images) != len(b.images) or not np.isfinite(Y).all():
            # only mountings are kept: the frame of the first image
            base = lambda M, X: (M @ M[0].T, (X - X[0]) @ M[0].T)
            (M, X), (N, Y) = base(M, X), base(N, Y)
        i, j = np.array(self.images).T
        found["projection centre"] = abs(X[i] - Y[j]).max()
        found["rotation, rad"] = abs(M[i] - N[j]).max()
        if self.points and len(b.points):
            i, j = np.array(self.points).T
            found["point"] = abs(a.points.position[i] - b.points.position[j]).max()
        x, y = (self._rays(n, k) for k, n in enumerate((a, b)))
        if y:
            found["image point"] = max(abs(x[key][0] - y[key][0]).max() for key in y)
        parameters = 0.0
        for i, j in self.cameras:
            p, q = a.cameras[i], b.cameras[j]
            assert p.model == q.model, (p.model, q.model)
            full = lambda c: {**default_parameters(get_model(c.model)), **c.parameters}
            parameters = max(parameters, *(abs(v - full(q)[k]) / max(abs(v), 1e-12)
                                           for k, v in full(p).items()))  # fmt: skip
        found["camera parameter, relative"] = parameters
        return found


def round_trip(kind: str, network: Network) -> tuple[Comparison, tuple[str, ...]]:
    """A network written and read back, and what was said to be lost."""
    with tempfile.TemporaryDirectory() as name:
        path, said = write(kind, network, Path(name))
        size = (1280, 720) if kind.startswith("realityscan") else None
        back = read_network(path, format=None if kind not in FORMATS else kind, image_size=size)
    return Comparison(network, back), said


# --- the page ---------------------------------------------------------------------------------


LETTERS = {
    "interior orientations": "C", "names of cameras": "N", "that images share a camera": "S",
    "image sizes of cameras": "W", "pixel sizes of cameras": "U",
    "prior σ of camera parameters": "σC", "orientations of images": "O",
    "names of images": "I", "prior σ of orientations": "σO", "points": "P",
    "names of points": "M", "roles of points": "R", "σ of control points": "σR",
    "colours of points": "K",
    "datum points": "D", "image points": "X", "σ of image points": "σX", "distances": "L",
    "rigs": "B", "antennas": "G",
}  # fmt: skip
OTHERS = "F"
"""All other tables."""
ALWAYS = {
    "interior orientations", "names of cameras", "that images share a camera",
    "orientations of images", "names of images", "points", "names of points", "image points",
}  # fmt: skip
HOLDS: dict[str, set[str]] = {
    "photo-list": {"prior σ of orientations", "roles of points", "σ of control points",
                   "σ of image points"},
    "photomodeler": {"image sizes of cameras", "pixel sizes of cameras", "roles of points",
                     "σ of control points", "σ of image points"},
    "metashape": {"image sizes of cameras", "pixel sizes of cameras", "roles of points",
                  "σ of control points", "colours of points"},
    "bingo": {"prior σ of camera parameters", "roles of points", "image sizes of cameras",
              "pixel sizes of cameras"},
    "csm-frame": {"image sizes of cameras", "pixel sizes of cameras"},
    "nvm": {"pixel sizes of cameras", "σ of image points", "colours of points"},
    "opf": {"image sizes of cameras", "roles of points", "σ of control points",
            "colours of points"},
    "orb-slam": {"image sizes of cameras", "rigs"},
    "vins": {"image sizes of cameras", "rigs"},
    "euroc": {"image sizes of cameras", "rigs"},
    "rig": {"image sizes of cameras", "pixel sizes of cameras", "rigs"},
    "rig-line": {"image sizes of cameras", "pixel sizes of cameras", "rigs"},
    "column-map": {name for name in LETTERS if name not in ("rigs", "antennas")},
    # beside what is written
    "opensfm": {"roles of points", "σ of control points"},
    "micmac": {"pixel sizes of cameras"},
}  # fmt: skip
"""What the inputs may have, beside `ALWAYS` and what an output of the same name keeps."""
MOUNTED = {"anipose", "orb-slam", "vins", "euroc", "rig", "rig-line", "kalibr", "opencv-stereo",
           "ros-stereo"}  # fmt: skip
WITHOUT_POINTS = MOUNTED | {"transforms", "micmac", "mrcal", "csm-frame", "realityscan"}


def holds(kind: str) -> set[str]:
    """What an input of this kind may have."""
    always = ALWAYS - ({"points", *PARTS["points"]} if kind in WITHOUT_POINTS else set())
    kept = set()
    if kind in TARGETS:
        losses = TARGETS[kind].losses
        lost = {name for name in losses if not _in_part(kind, name)}
        kept = {*QUANTITIES} - lost - {part for name in lost for part in PARTS.get(name, ())}
        always -= lost & {"that images share a camera"}
    return always | kept | HOLDS.get(kind, set())


def _in_part(kind: str, name: str) -> bool:
    losses = TARGETS[kind].losses
    return name in losses and losses[name] is not QUANTITIES[name]


def cell(given: str, kind: str) -> str:
    """What a conversion loses, in letters; those in brackets in part, or by the names."""
    has, letters = holds(given), []
    for name in TARGETS[kind].losses:
        if name in has:
            letter = LETTERS.get(name, OTHERS)
            letter = f"({letter})" if _in_part(kind, name) else letter
            if letter not in letters:
                letters.append(letter)
    return " ".join(letters) or "–"


def table() -> str:
    """The table of conversions."""
    kinds = [k for k in TARGETS if k not in ("colmap-text", "ros-stereo", "realityscan-csv")]
    titles = {"colmap": "colmap, colmap-text", "opencv-stereo": "opencv-stereo, ros-stereo",
              "realityscan": "realityscan, realityscan-csv"}  # fmt: skip
    lines = [f"| from, to | {' | '.join(titles.get(kind, kind) for kind in kinds)} | not read |",
             "|---" * (len(kinds) + 2) + "|"]  # fmt: skip
    for given, form in FORMATS.items():
        unread = "; ".join(what.removesuffix(", which are not read") for what in form.unread)
        lines.append(f"| `{given}` | {' | '.join(cell(given, k) for k in kinds)} | {unread} |")
    return "\n".join(lines)


def legend() -> str:
    """What the letters mean."""
    others = [name for name in QUANTITIES if name not in LETTERS]
    parts = [f"{letter} {name}" for name, letter in LETTERS.items()]
    return "; ".join([*parts, f"{OTHERS} the tables {', '.join(others)}"]) + "."


BEGIN, END = "<!-- by tests/io/conversions.py --write -->", "<!-- end -->"


def page(text: str) -> str:
    """The page with the table as the code has it."""
    head, rest = text.split(BEGIN)
    return f"{head}{BEGIN}\n\n{legend()}\n\n{table()}\n\n{END}{rest.split(END)[1]}"


def main() -> None:
    import jaxbundle

    jaxbundle.enable_x64()
    if "--write" in sys.argv:
        PAGE.write_text(page(PAGE.read_text()))
    print("| format | camera model | lost | greatest differences |\n|---|---|---|---|")
    for kind in TARGETS:
        if kind not in DRAWINGS:
            found, said = round_trip(kind, full_network(model_for(kind)))
            greatest = "; ".join(f"{name} {value:.2g}" for name, value in found.greatest().items())
            print(f"| {kind} | {model_for(kind)} | {len(said)} | {greatest} |")


if __name__ == "__main__":
    main()
