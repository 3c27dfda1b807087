"""What a reader of README and docs has: the files that their commands name, small, made here.

`OWN` lists them by their names; `write_own_files` makes those that a text names. `OWN_NAMES` are
the variables that a page takes from its reader.
"""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
ROOMS = (
    "", "measure", "reconstruction", "surfaces", "io", "refinement", "cli", "pushbroom",
    "calibration",
)  # fmt: skip
sys.path[:0] = [*(str(ROOT / "tests" / room) for room in ROOMS), str(ROOT / "benchmarks")]

import jaxbundle  # noqa: E402

BOARD, SQUARE = (9, 6), 0.03
PHOTOGRAPHS = sorted((EXAMPLES / "board").glob("photo_*.jpg"))[:12]
TARGETS = sorted((EXAMPLES / "targets" / "photos").glob("photo_*.jpg"))

OWN_NAMES = {
    "docs/howto/coming_from.md": """
import cv2, glob, numpy
image_size, pattern = (480, 360), (9, 6)
board = numpy.zeros((54, 3), numpy.float32)
board[:, :2] = 0.03 * numpy.mgrid[:9, :6].T.reshape(-1, 2)
imgpoints = [cv2.findChessboardCorners(cv2.imread(path, 0), pattern)[1]
             for path in sorted(glob.glob("examples/board/photo_0*.jpg"))]
objpoints = [board] * len(imgpoints)
"""
}
"""As they stand before the page's code in a program that calls `cv2.calibrateCamera`."""


def write_project(path: Path) -> None:
    """The network of four photographs."""
    shutil.copytree(EXAMPLES / "convergent4", path)


def write_project_here(path: Path) -> None:
    """The same, of a camera whose pixels are known."""
    for file in (EXAMPLES / "convergent4").iterdir():
        shutil.copy(file, path.parent)
    text = path.read_text(encoding="utf-8")
    size = "image_size = [3000, 2000]\npixel_size = [0.008, 0.008]\n"
    path.write_text(text.replace("c = 18.556\n", f"{size}c = 18.556\n"), encoding="utf-8")


def write_surveyed(path: Path) -> None:
    for name in ("north", "south"):
        write_project(path / name)


def write_photomodeler(path: Path) -> None:
    from test_photomodeler import export

    path.write_text(export(), encoding="utf-8")


def write_control(path: Path) -> None:
    from exchange_cases import POINTS

    rows = [f"{k + 1},control,{','.join(map(repr, map(float, POINTS[k])))},0.01,0.01,0.01"
            for k in range(4)]  # fmt: skip
    path.write_text("\n".join(["id,role,X,Y,Z,sX,sY,sZ", *rows]) + "\n", encoding="utf-8")


def run(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "jaxbundle", *map(str, words)], check=True, cwd=ROOT,
                   stdout=subprocess.DEVNULL)  # fmt: skip


def write_bal(path: Path) -> None:
    run("convert", EXAMPLES / "convergent4", path, "--to", "bal", "--model", "snavely",
        "--image-size", "3000,2000", "--pixel-size", "0.008,0.008")  # fmt: skip


def write_opencv_camera(path: Path) -> None:
    run("convert", f"{EXAMPLES / 'video_cameras' / 'cameras.toml'}", path, "--camera", "1-indoor",
        "--model", "opencv")  # fmt: skip


def write_camera(path: Path) -> None:
    """Near the camera of examples/board."""
    path.write_text(
        '[[camera]]\nid = "cam"\nmodel = "opencv"\nimage_size = [480, 360]\nfx = 620.0\n'
        "fy = 620.0\ncx = 242.0\ncy = 178.0\nk1 = -0.12\nk2 = 0.05\n", encoding="utf-8",
    )  # fmt: skip


def write_calibration(photographs: slice) -> Callable[[Path], None]:
    return lambda path: run("calibrate", *PHOTOGRAPHS[photographs], "--board", "9x6", "--square",
                            SQUARE, "--free", "fx,fy,cx,cy,k1", "--json", path)  # fmt: skip


def write_poses(path: Path, result: jaxbundle.Adjustment, in_hand: bool) -> None:
    """The poses of a robot: its hand 0.1 before the camera, or with the object before it."""
    from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix

    rng = np.random.default_rng(6)
    degree = np.pi / 180
    rows = ["image,X,Y,Z,omega,phi,kappa"]
    for id, values in zip(result.network.images.id, result.image_values):
        X0, angles = values[:3], values[3:]
        M = np.asarray(matrix_from_omega_phi_kappa(angles))
        place = X0 - 0.1 * M[2] if in_hand else -M @ X0
        of_hand = angles if in_hand else np.asarray(omega_phi_kappa_from_matrix(M.T))
        measured = [*(place + rng.normal(0, 2e-4, 3)), *(of_hand / degree + rng.normal(0, 0.02, 3))]
        rows.append(f"{id},{','.join(f'{x:.6f}' for x in measured)}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_robot(path: Path) -> None:
    """With the camera that took `views`."""
    board = jaxbundle.Board(*BOARD, SQUARE)
    seen = jaxbundle.calibrate(PHOTOGRAPHS[:6], board)
    write_poses(path, seen.adjustment, True)


def write_arm(path: Path) -> None:
    """Before the camera of the project."""
    project = EXAMPLES / "convergent4" / "project.toml"
    write_poses(path, jaxbundle.adjust(jaxbundle.read_network(project)), False)


def copy_photographs(folder: Path, photographs: Iterable[Path]) -> None:
    folder.mkdir(parents=True)
    for path in photographs:
        shutil.copy(path, folder)


def write_cameras(path: Path) -> None:
    """Folders of photographs of one board: as if by two cameras."""
    copy_photographs(path / "A17", PHOTOGRAPHS[::2])
    copy_photographs(path / "A18", PHOTOGRAPHS[1::2])


def write_charuco(path: Path) -> None:
    import render
    from board_photographs import poses

    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(BOARD, 30, 22, words)
    picture = board.generateImage((1080, 720), marginSize=0)
    pattern = render.print_of(picture, BOARD[0] * SQUARE, 0.02)
    (path / "A19").mkdir(parents=True)
    for k, (M, X0) in enumerate(poses(6)):
        grey = render.photograph(render.LENS, M, X0, pattern, seed=k)
        cv2.imwrite(str(path / "A19" / f"photo_{k}.png"), grey)


def rig_poses(seed: int) -> tuple[list, list]:
    """Poses of two cameras of one rig, at 8 epochs: 40 mm apart, turned by 3°."""
    from board_photographs import poses
    from scipy.spatial.transform import Rotation

    left = poses(8, seed, turned=False)
    turn = Rotation.from_euler("y", 3, degrees=True).as_matrix()
    return left, [(turn @ M, X0 + M.T @ [0.04, 0.0, 0.0]) for M, X0 in left]


def write_view_of_rig(path: Path, side: int, seed: int = 0) -> None:
    import render
    from board_photographs import PATTERN

    path.mkdir(parents=True)
    for k, (M, X0) in enumerate(rig_poses(seed)[side]):
        grey = render.photograph(render.LENS, M, X0, PATTERN, seed=100 * side + k)
        cv2.imwrite(str(path / f"{'lr'[side]}_{k:03}.png"), grey)


def write_waved(path: Path, camera: str) -> None:
    """What a camera of the rig, or one far from it, saw of a wand of 0.2 m; beside it the file of
    the far one."""
    import render
    from scipy.spatial.transform import Rotation

    from jaxbundle.cameras import get_model
    from jaxbundle.io import write_cameras
    from jaxbundle.network.tables import Camera

    turn = lambda degrees: Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    poses = {
        "left": (np.eye(3), np.zeros(3)),
        "right": (turn(3), np.array([0.04, 0, 0])),
        "far": (turn(-50), np.array([0.9, 0.05, -0.2])),
    }
    shape, rng = np.random.default_rng(1), np.random.default_rng(list(poses).index(camera))
    middle = shape.uniform([-0.1, -0.1, -1.1], [0.1, 0.1, -0.8], (40, 3))
    along = shape.normal(size=(40, 3))
    along *= 0.1 / np.linalg.norm(along, axis=1)[:, None]
    lines = ["frame,marker,x,y"]
    for marker, X in (("A", middle - along), ("B", middle + along)):
        xy = render.LENS.image_of(*poses[camera], X) + 0.05 * rng.normal(size=(40, 2))
        lines += [f"{f},{marker},{x},{y}" for f, (x, y) in enumerate(xy)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    names = get_model("opencv").parameters
    values = dict(zip(names, render.LENS.parameters))
    lens = Camera("far", "opencv", values, (), image_size=render.LENS.size)
    write_cameras([lens], path.parent / "far.toml")


def write_video(path: Path, side: int) -> None:
    """A camera of the rig, moved by hand from place to place before a board: eight of them, with
    rests."""
    import render
    from board_photographs import PATTERN
    from scipy.spatial.transform import Rotation

    rng, steps, moving, resting = np.random.default_rng(4), 8, 13, 2
    azimuth = 2 * np.pi * np.arange(steps) / 5
    tilt = rng.uniform(12, 30, steps)
    places = np.stack([
        tilt * np.cos(azimuth), tilt * np.sin(azimuth), rng.uniform(-25, 25, steps),
        *(0.12 + rng.uniform(-0.02, 0.02, steps), 0.075 + rng.uniform(-0.02, 0.02, steps)),
        rng.uniform(0.46, 0.58, steps),
    ], 1)  # fmt: skip
    turn = Rotation.from_euler("y", 3, degrees=True).as_matrix()
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, (480, 360))
    for begin, end in zip(places, places[1:]):
        part = np.concatenate([np.arange(moving) / moving, np.ones(resting)])
        for share in part**3 * (10 - 15 * part + 6 * part**2):  # without jumps of acceleration
            omega, phi, kappa, x, y, distance = begin + share * (end - begin)
            M, X0 = render.pose(omega, phi, kappa, (x, y), distance)
            if side:
                M, X0 = turn @ M, X0 + M.T @ [0.04, 0.0, 0.0]
            grey = render.photograph(render.LENS, M, X0, PATTERN, noise=0.5)
            video.write(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    video.release()


def write_wand_video(path: Path, camera: str) -> None:
    """A wand of three markers before a camera; beside it the file of both cameras."""
    import cv2
    import wand_scenes as scenes
    from test_wand import CAMERAS, PLACES, ROTATIONS

    from jaxbundle.io import write_cameras

    size, names = (640, 480), {"left": "c0", "right": "c1"}
    half = {"fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5}
    known = {
        name: dataclasses.replace(
            CAMERAS[own], id=name, parameters={**CAMERAS[own].parameters, **half}, image_size=size
        )
        for name, own in names.items()
    }
    k = int(names[camera][1])
    seen = scenes.markers_in_images(
        known[camera], ROTATIONS[k], PLACES[k], scenes.wave(40), [0, 0.3, 1]
    )
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, size)
    for uv in seen:
        grey = scenes.render_frame(uv, size, np.random.default_rng(k))
        video.write(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    video.release()
    write_cameras([*known.values()], path.parent / "wand.toml")


def write_wand(path: Path, camera: str) -> None:
    """What a camera saw of the two ends of a wand; beside it the file of all cameras."""
    from test_wand import CAMERAS, waved

    from jaxbundle.io import write_cameras

    names = {"left": "c0", "right": "c1"}
    rows = waved(40, markers={"A": 0.0, "B": 0.5})[names[camera]]
    lines = [",".join(map(str, row)) for row in zip(*rows.values())]
    path.write_text("\n".join([",".join(rows), *lines]) + "\n", encoding="utf-8")
    known = [dataclasses.replace(CAMERAS[own], id=name) for name, own in names.items()]
    write_cameras(known, path.parent / "cameras.toml")


def write_raster(path: Path, values: np.ndarray, dtype: str = "float32") -> None:
    import rasterio

    rows, columns = values.shape
    with rasterio.open(path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype=dtype,
                       crs="EPSG:32633",
                       transform=rasterio.Affine(1, 0, 1000, 0, -1, 2000)) as target:  # fmt: skip
        target.write(values.astype(dtype), 1)


def write_heights(path: Path, seed: int) -> None:
    """A surface model with its σ, in the second year with a heap; beside it where it is stable."""
    i, j = np.indices((60, 80))
    heap = 2.0 * (seed % 2) * (np.hypot(i - 30, j - 40) < 8)
    path.mkdir()
    noise = np.random.default_rng(seed).normal(0, 0.1, i.shape)
    write_raster(path / "dsm.tif", 100 + np.sin(i / 9) + 0.05 * j + heap + noise)
    write_raster(path / "dsm_sigma.tif", np.full(i.shape, 0.1))
    write_raster(path.parent / "stable.tif", j < 25, "uint8")


def write_rigs(path: Path) -> None:
    for seed, name in enumerate(("car_1", "car_2")):
        for side, camera in enumerate(("left", "right")):
            write_view_of_rig(path / name / camera, side, seed)


def write_rig_arrays(path: Path) -> None:
    import render
    from board_photographs import BOARD as board
    from board_photographs import corners

    rng = np.random.default_rng(1)
    exact = np.array([
        [corners(render.LENS, rig_poses(seed)[side]) for side in (0, 1)] for seed in (0, 1)
    ])  # fmt: skip
    np.savez(path, object_points=board.points, image_size=(480, 360), ids=["car_1", "car_2"],
             image_points=exact + rng.normal(0, 0.05, exact.shape))  # fmt: skip


def write_camera_arrays(path: Path) -> None:
    from batch_cameras import images_of
    from batch_cameras import write_cameras as write_arrays

    write_arrays(path, images_of(4))


def write_made(path: Path) -> None:
    path.write_text("id,made\nA17,2026-05-01\nA18,2026-06-01\n", encoding="utf-8")


def write_photos(path: Path) -> None:
    """Eight rendered photographs, and points in them as a list of control."""
    from rendered_photographs import write_photographs

    write_photographs(path, "photo_", 8, 1)


def write_control_of_photos(path: Path) -> None:
    """Corners of the roof and three points on the ground, as they are seen in the photographs."""
    from rendered_photographs import CAMERA, SIZE, hills, stations

    from jaxbundle.cameras import get_model, project

    ground = [(x, y, hills(x, y)) for x, y in ((-2.0, 1.5), (2.0, 2.0), (1.5, -2.0), (-2.2, -1.8))]
    points = [*ground, (-1.2, -1.0, 1.4), (0.8, -1.0, 1.8), (0.8, 1.0, 1.8), (-1.2, 1.0, 1.4)]
    model, rng = get_model("opencv"), np.random.default_rng(2)
    p = tuple(CAMERA.parameters.get(name, 0.0) for name in model.parameters)
    lines = ["EPSG:32633"]
    for number, X in enumerate(points):
        for k, (X0, M) in enumerate(zip(*stations(8, 1))):
            u, v = np.array(project(model, p, *(M @ (X - X0)))) + rng.normal(0, 0.2, 2)
            if 5 < u < SIZE[0] - 5 and 5 < v < SIZE[1] - 5:
                at = " ".join(f"{value:.3f}" for value in (X[0] + 5e5, X[1] + 5e6, X[2]))
                lines.append(f"{at} {u:.2f} {v:.2f} photo_{k}.png gcp{number}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@cache
def flight() -> Path:
    """A line scanner of 64 lines and 50 pixels."""
    import tempfile

    folder = Path(tempfile.mkdtemp())
    text = (EXAMPLES / "line_scanner" / "flight.toml").read_text(encoding="utf-8")
    text = text.replace("lines = 2000", "lines = 128").replace("pixels = 1000", "pixels = 50")
    (folder / "flight.toml").write_text(text, encoding="utf-8")
    run("pushbroom", "simulate", folder / "flight.toml", "--out", folder / "out")
    return folder / "out"


def write_scanner(path: Path) -> None:
    for file in flight().iterdir():
        if file.is_file() and not file.name.startswith("."):
            shutil.copy(file, path.parent)


def write_refinement(path: Path) -> None:
    """A satellite image with bias and jitter, and 40 control points."""
    from test_refine_files import write_refinement

    write_refinement(path.parent)


def write_rpc_images(path: Path) -> None:
    from test_surface_commands import write_satellite

    write_satellite(path.parent)
    rpc = jaxbundle.io.read_rpc(path.parent / "a_RPC.TXT")
    write_geoid(path.parent, float(rpc.longitude_offset), float(rpc.latitude_offset))


def write_geoid(folder: Path, longitude: float, latitude: float) -> None:
    """A geoid 20 m above the ellipsoid, three degrees around a place, under the name of PROJ's."""
    import rasterio

    grid = {
        "driver": "GTiff", "width": 12, "height": 12, "count": 1, "dtype": "float32",
        "crs": "EPSG:4326",
        "transform": rasterio.Affine(0.5, 0, longitude - 3, 0, -0.5, latitude + 3),
    }  # fmt: skip
    with rasterio.open(folder / "us_nga_egm96_15.tif", "w", **grid) as geoid:
        geoid.write(np.full((12, 12), 20, "float32"), 1)


def write_product(path: Path) -> None:
    """A satellite image with RPC, terrain in tiles, and a geoid."""
    import tempfile

    import rasterio
    from test_whole_maps import write_product

    with tempfile.TemporaryDirectory() as folder:
        made = write_product(Path(folder))
        for file in made.glob("image*"):
            shutil.copy(file, path.parent)
        shutil.copytree(made / "tiles", path.parent / "tiles")
    with rasterio.open(path.parent / "tiles" / "00.tif") as tile:
        write_geoid(path.parent, tile.transform.c, tile.transform.f)


def write_strips(path: Path) -> None:
    from test_surface_of_strips import write_strips

    write_strips(path.parent, ("ahead", "back"))


def write_sparse_model(path: Path) -> None:
    """A disturbed model of COLMAP with wrong image points."""
    from splat_poses import draw

    from jaxbundle.io import write_colmap

    folder = path / "sparse" / "0"
    folder.parent.mkdir(parents=True)
    write_colmap(draw(0)[0], folder)


def write_metashape(path: Path) -> None:
    """A project of Metashape: ten photographs around 80 tie points, measured with 0.3 pixels."""
    from test_metashape import P, published
    from test_metashape_projects import pack, ply

    from jaxbundle.geometry import matrix_from_omega_phi_kappa

    square = P | {"b1": 0.0}
    stations = jaxbundle.ring_of_stations(10, 3.0, 3.0, roll_every=2)
    X, rng = jaxbundle.cloud_of_targets(80, (1.6, 1.6, 0.8), seed=3), np.random.default_rng(1)
    number, images, cameras, entries = np.arange(len(X)), {}, "", ""
    for i, (X0, angles) in enumerate(zip(stations.position, stations.angles)):
        M = np.asarray(matrix_from_omega_phi_kappa(angles))
        uv = np.stack(published(*((X - X0) @ M.T * [1, -1, -1]).T, b1=0.0), 1)
        seen = (uv > 5).all(1) & (uv < [1275, 715]).all(1)
        uv = uv[seen] + rng.normal(0, 0.3, (seen.sum(), 2))
        images[f"p{i}_ply"] = ply(("x", "y", "size", "id"), *uv.T, np.ones(len(uv)), number[seen],
                                  text="double")  # fmt: skip
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = M.T * [1, -1, -1], X0
        values = " ".join(map(repr, T.ravel().tolist()))
        cameras += (f'<camera id="{i}" sensor_id="0" label="photo_{i}.jpg"><transform>{values}'
                    "</transform></camera>")  # fmt: skip
        entries += f'<projections camera_id="{i}" path="p{i}.ply"/>'
    calibration = "".join(f"<{name}>{value}</{name}>" for name, value in square.items())
    sensor = (
        '<sensor id="0" label="cam" type="frame"><resolution width="1280" height="720"/>'
        '<calibration type="frame" class="adjusted"><resolution width="1280" height="720"/>'
        f"{calibration}</calibration></sensor>"
    )
    path.write_text('<document version="1.2.0" path="{projectname}.files/project.zip"/>')
    files = path.with_suffix(".files")
    pack(files / "project.zip",
         doc_xml='<document version="1.2.0"><chunks next_id="1" active_id="0">'
                 '<chunk id="0" path="0/chunk.zip"/></chunks></document>')  # fmt: skip
    pack(files / "0" / "chunk.zip",
         doc_xml=f'<chunk label="c" enabled="true"><sensors>{sensor}</sensors>'
                 f"<cameras>{cameras}</cameras><frames next_id=\"1\">"
                 '<frame id="0" path="0/frame.zip"/></frames></chunk>')  # fmt: skip
    pack(files / "0" / "0" / "frame.zip", doc_xml="<frame/>")
    pack(files / "0" / "0" / "point_cloud" / "point_cloud.zip",
         doc_xml='<point_cloud version="1.2.0"><tracks path="tracks.ply"/>'
                 f'<points path="points0.ply"/>{entries}</point_cloud>',
         points0_ply=ply(("x", "y", "z", "id"), *X.T, number, text="double"),
         tracks_ply=ply(("red", "green", "blue"), *np.full((3, len(X)), 90), text="uchar"),
         **images)  # fmt: skip


OWN: dict[str, Callable[[Path], None]] = {
    "PROJECT": write_project,
    "my": write_project,
    "project.toml": write_project_here,
    "surveyed": write_surveyed,
    "export.txt": write_photomodeler,
    "EXPORT.txt": write_photomodeler,
    "control.csv": write_control,
    "problem-16-22106-pre.txt.bz2": write_bal,
    "calibration.yaml": write_opencv_camera,
    "spring.json": write_calibration(slice(0, 4)),
    "summer.json": write_calibration(slice(4, 8)),
    "autumn.json": write_calibration(slice(8, 12)),
    "cameras": write_cameras,
    "phones": write_cameras,
    "charuco": write_charuco,
    "left": lambda path: write_view_of_rig(path, 0),
    "right": lambda path: write_view_of_rig(path, 1),
    "rigs": write_rigs,
    "rigs.npz": write_rig_arrays,
    "cameras.npz": write_camera_arrays,
    "made.csv": write_made,
    "views": lambda path: copy_photographs(path, PHOTOGRAPHS[:6]),
    "base.toml": write_camera,
    "robot.csv": write_robot,
    "arm.csv": write_arm,
    "photos": write_photos,
    "gcp_list.txt": write_control_of_photos,
    "scanner.toml": write_scanner,
    "refine.toml": write_refinement,
    "a.tif": write_rpc_images,
    "ahead.toml": write_strips,
    "scene": write_sparse_model,
    "left.mp4": lambda path: write_video(path, 0),
    "right.mp4": lambda path: write_video(path, 1),
    "wand_left.mp4": lambda path: write_wand_video(path, "left"),
    "wand_right.mp4": lambda path: write_wand_video(path, "right"),
    "wand_left.csv": lambda path: write_waved(path, "left"),
    "wand_right.csv": lambda path: write_waved(path, "right"),
    "wand_far.csv": lambda path: write_waved(path, "far"),
    "left.csv": lambda path: write_wand(path, "left"),
    "right.csv": lambda path: write_wand(path, "right"),
    "spring_2024": lambda path: write_heights(path, 0),
    "spring_2025": lambda path: write_heights(path, 1),
    "block.psx": write_metashape,
    "image.tif": write_product,
    "camera_a": lambda path: copy_photographs(path, TARGETS[::2]),
    "camera_b": lambda path: copy_photographs(path, TARGETS[1::2]),
    "bars.csv": lambda path: shutil.copy(EXAMPLES / "targets" / "bars.csv", path),
}  # fmt: skip
MADE_BY = {
    "docs/calibrate.md": ["cameras.npz"], "docs/reconstruct.md": ["surveyed"],
}
"""Files that the page itself makes."""


def write_own_files(folder: Path, page: str, texts: Iterable[str]) -> list[str]:
    """The files named by commands and code, as words or as the first part of a path."""
    words = {word for text in texts for word in re.split(r"[\s\"'=#]+", text)}
    first = {word.split("/")[0] for word in words} | words
    named = [name for name in OWN if name in first and name not in MADE_BY.get(page, ())]
    for name in named:
        OWN[name](folder / name)
    return named


if __name__ == "__main__":
    jaxbundle.enable_x64()
    print(json.dumps(write_own_files(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])))
