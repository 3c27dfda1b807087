"""Every reader of the package with a small valid input of its own, for damage to all of them.

A reader is a function that makes the input in an empty folder, and one that reads the folder. Those
of networks and cameras are of `test_hostile_files`, those of line scanners of
`test_hostile_scanner_files`: what is added there is damaged too.
"""

import json
import shutil
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import test_hostile_files as networks
import test_hostile_scanner_files as scanners
import test_metashape_projects
import test_opf
import test_realityscan
from exchange_cases import CAMERAS, network
from PIL import Image

from jaxbundle.batches.stacks import read_camera_stack
from jaxbundle.io import read_cameras, read_network
from jaxbundle.io.boards.board_sets import read_boards
from jaxbundle.io.boards.corners import read_corners
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.io.boards.targets import read_target, write_target
from jaxbundle.io.cameras.camera_files import write_cameras
from jaxbundle.io.cameras.kalibr_results import read_kalibr_results
from jaxbundle.io.networks.bal import write_bal
from jaxbundle.io.networks.control import read_control
from jaxbundle.io.networks.orientation_covariance import (
    OrientationCovariance,
    read_orientation_covariance,
    write_orientation_covariance,
)
from jaxbundle.io.results.json_lines import JsonLines
from jaxbundle.io.scanner.asp_points import read_gcp, read_match
from jaxbundle.io.scanner.isis_points import read_control_network, read_jigsaw_residuals
from jaxbundle.io.scanner.refined_orientations import read_refined_orientations
from jaxbundle.io.writing.folders import check_folder, read_marker, replace_folder
from jaxbundle.measure.boards import Board
from jaxbundle.network.surface_models import read_mesh

EXAMPLES = Path(__file__).parents[2] / "examples"
ROOM = 1 << 20
"""Pixels: a sample has fewer."""


class Reader(NamedTuple):
    """`make(folder)` writes a valid input, `read(folder)` reads it."""

    make: Callable[[Path], Any]
    read: Callable[[Path], Any]


READERS: dict[str, Reader] = {}


def reader(name: str, read: Callable[[Path], Any]):
    def add(make):
        READERS[name] = Reader(make, read)
        return make

    return add


for kind in networks.KINDS:
    READERS[kind] = Reader(partial(networks.made, kind), partial(networks.read, kind))
for kind, read in scanners.READ.items():
    READERS[f"scanner {kind}"] = Reader(partial(scanners.made, kind), read)


# --- networks, cameras and tables beside them ---------------------------------------------------


for suffix in ("gz", "bz2"):
    @reader(f"bal {suffix}", lambda f: read_network(next(f.iterdir()), format="bal"))
    def _(folder, suffix=suffix):
        write_bal(network("snavely", ("0", "1", "2"), 0), folder / f"problem.bal.{suffix}")


@reader("project of an example", lambda f: read_network(f / "project.toml"))
def _(folder):
    for name in ("images.csv", "points.csv", "observations.csv", "project.toml"):
        shutil.copy(EXAMPLES / "resection63" / name, folder)


@reader("cameras toml", lambda f: read_cameras(f / "cameras.toml"))
def _(folder):
    write_cameras([CAMERAS["opencv"], CAMERAS["snavely"]], folder / "cameras.toml")


@reader("opf", lambda f: read_network(f / "project.opf"))
def _(folder):
    test_opf.write(folder)


@reader("metashape project", lambda f: read_network(f / "block.psx"))
def _(folder):
    test_metashape_projects.write(folder)


@reader("realityscan xmp", lambda f: read_network(f, format="realityscan", image_size=(1280, 720)))
def _(folder):
    test_realityscan.folder(folder)


@reader("realityscan csv", lambda f: read_network(f / "cameras.csv", image_size=(1280, 720)))
def _(folder):
    test_realityscan.table(folder)


@reader("kalibr results", lambda f: read_kalibr_results(f / "results-cam.txt"))
def _(folder):
    from test_boards_of_others import RESULTS

    (folder / "results-cam.txt").write_text(RESULTS)


CORNERS = ((0.0, 0.0, 1.5), (1.0, 0.0, 0.5), (0.0, 1.0, 0.25), (1.0, 1.0, 0.125))


@reader("mesh obj", lambda f: read_mesh(f / "mesh.obj"))
def _(folder):
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    (folder / "mesh.obj").write_text("\n".join([*lines, "f 1/1 2/2 3/3", "f 2 4 -2", ""]))


for form in ("ascii", "binary_little_endian"):
    @reader(f"mesh ply {form}", lambda f: read_mesh(f / "mesh.ply"))
    def _(folder, form=form):
        head = (f"ply\nformat {form} 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
                "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
                "end_header\n")  # fmt: skip
        if form == "ascii":
            rows = [" ".join(map(str, v)) for v in CORNERS]
            body = "\n".join([*rows, "3 0 1 2", "3 1 3 2", ""]).encode()
        else:
            body = b"".join(struct.pack("<fff", *v) for v in CORNERS)
            body += struct.pack("<BiiiBiii", 3, 0, 1, 2, 3, 1, 3, 2)
        (folder / "mesh.ply").write_bytes(head.encode() + body)


@reader("control", lambda f: read_control(f / "control.csv"))
def _(folder):
    (folder / "control.csv").write_text(
        "role,id,X,Y,Z,sX,sY,sZ\n,7,1.5,-2,3e1,0.1,0.2,free\nfixed,a,0,0,1,,,\n,c,2,3,4,1,1,1\n"
    )


@reader("control without header", lambda f: read_control(f / "control.txt"))
def _(folder):
    (folder / "control.txt").write_text("P1 1 2 3 0.1 0.1 0,2\nP2 4 5,5 6 0.1 0.1 0.2\n")


def _measurements(folder: Path):
    from jaxbundle.reconstruction.control import read_control_measurements

    return read_control_measurements(next(folder.iterdir()))


@reader("control measurements", _measurements)
def _(folder):
    (folder / "gcp.csv").write_text(
        "id,X,Y,Z,image,u,v,sX,sY,sZ,role,suv\n"
        "P1,1,2,3,a.jpg,5,6,0.1,0.1,0.1,control,0.5\nP1,1,2,3,b.jpg,7,8,0.1,0.1,0.1,,\n"
        "P2,4,5,6,a.jpg,9,10,,,,check,\n"
    )


@reader("gcp list", _measurements)
def _(folder):
    (folder / "gcp_list.txt").write_text(
        "EPSG:4326\n13.1 40.2 100 5 6 a.jpg P1\n13.1 40.2 100 7 8 b.jpg P1\n"
        "13.2 40.1 50 1 2 a.jpg\n"
    )


@reader("gcp list in metres", _measurements)
def _(folder):
    (folder / "gcp_list.txt").write_text(
        "WGS84 UTM 33N\n500000 4000000 100 5 6 a.jpg P1\n500010 4000000 90 7 8 b.jpg P2\n"
    )


def _distances(folder: Path):
    from jaxbundle.reconstruction.named import read_distances

    return read_distances(folder / "distances.csv")


@reader("distances", _distances)
def _(folder):
    (folder / "distances.csv").write_text("from,to,value,sigma\nA,B,1.5,0.001\nC,D,0.7,0.002\n")


@reader("precision", lambda f: read_orientation_covariance(f / "precision.csv", 0.0174))
def _(folder):
    names = [("image", "a", n) for n in ("X0", "Y0", "Z0")] + [("camera", "c", "fx")]
    A = np.random.default_rng(0).normal(size=(4, 4))
    given = OrientationCovariance(tuple(names), A @ A.T + np.eye(4))
    write_orientation_covariance(given, folder / "precision.csv", 0.0174)


@reader("refined", lambda f: read_refined_orientations(f))
def _(folder):
    names = [("image", "A", n) for n in ("line shift", "sample shift")] + [("sensor", "S", "x")]
    given = OrientationCovariance(tuple(names), np.eye(3) + 0.2)
    write_orientation_covariance(given, folder / "precision.csv", 1.0)
    for name in ("A_RPC.TXT", "B.toml"):
        (folder / name).write_text("x\n")
    (folder / "refined.csv").write_text(
        "id,file,raster,sensor,knot_spacing,line_offset,line_scale,sample_offset,sample_scale\n"
        "A,A_RPC.TXT,a.tif,,,100,90,80,70\nB,B.toml,,S,0.25,,,,\n"
    )


@reader("corners", lambda f: read_corners(f / "corners.vnl", Board(4, 3, 1.0), (640, 480)))
def _(folder):
    rows = [f"{n}.jpg {x}.5 {y}.25 {k % 2}" for n in "ab" for k, (x, y) in
            enumerate((x, y) for y in range(3) for x in range(4))]  # fmt: skip
    text = "\n".join(["## by hand", "# filename x y level", *rows, "c.jpg - - -"])
    (folder / "corners.vnl").write_text(text + "\n")


@reader("boards", lambda f: read_boards(f / "boards.toml"))
def _(folder):
    text = "[board.front]\ncolumns = 9\nrows = 6\nsquare = 0.03\nbody = \"room\"\n"
    (folder / "boards.toml").write_text(f'{text}cameras = ["left"]\n')


for board in (Board(6, 7, 0.06), Board(6, 5, 0.088 * 1.3, "aprilgrid", marker=0.088)):
    @reader(f"target {board.kind}", lambda f: read_target(f / "target.yaml"))
    def _(folder, board=board):
        write_target(board, folder / "target.yaml")


def _kept(folder: Path):
    with KeptCorners(folder / "kept.sqlite") as kept:
        found = kept.content(folder / "a.jpg")
        kept.look("content", Board(4, 3, 1.0))
        kept.keep(found, Board(4, 3, 1.0), "none")


@reader("kept corners", _kept)
def _(folder):
    (folder / "a.jpg").write_bytes(b"a photograph")
    with KeptCorners(folder / "kept.sqlite") as kept:
        kept.content(folder / "a.jpg")
        kept.keep("content", Board(4, 3, 1.0), ((640, 480), np.arange(24.0).reshape(12, 2)))


def _continued(folder: Path):
    """A file that is continued is complete afterwards."""
    file = folder / "results.jsonl"
    lines = JsonLines(file)
    lines.append([{"key": "one more", "status": "weak"}])
    whole = file.read_bytes().removesuffix(b"\n").split(b"\n")
    assert {json.loads(line)["key"] for line in whole} == {*lines.heads}
    assert JsonLines(file).heads.keys() == lines.heads.keys()


@reader("json lines", _continued)
def _(folder):
    JsonLines(folder / "results.jsonl").append(
        {"key": f"a.npz#{i}", "status": "converged", "settings": {"free": ["fx"]}, "data": "f" * 16}
        for i in range(5)
    )


def _folder_again(folder: Path):
    read_marker(folder / "o")
    check_folder(folder / "o", "adjust", ("result.json",))


@reader("marker of a folder", _folder_again)
def _(folder):
    with replace_folder(folder / "o", "adjust", ("result.json",)) as new:
        (new / "result.json").write_text("{}")


# --- archives -----------------------------------------------------------------------------------


@reader("stack packed", lambda f: read_camera_stack(f / "cameras.npz"))
def _(folder):
    rng = np.random.default_rng(0)
    np.savez_compressed(
        folder / "cameras.npz", object_points=rng.normal(size=(2, 4, 3)),
        image_points=rng.uniform(0, 400, (2, 3, 4, 2)), image_size=np.array([640, 480]),
        ids=np.array(["left", "right"]),
    )  # fmt: skip


def _large_stack(folder: Path):
    stack = read_camera_stack(folder / "cameras.npz")
    return stack.arguments(np.array([0, len(stack.ids) - 1]))


@reader("stack large", _large_stack)
def _(folder):
    xy = np.random.default_rng(0).uniform(0, 400, (40, 50, 50, 2))
    np.savez(folder / "cameras.npz", object_points=np.ones((50, 3)), image_points=xy,
             image_size=np.array([640, 480]))  # fmt: skip


@reader("stack of rigs", lambda f: read_camera_stack(f / "rigs.npz").rigs([0, 1]))
def _(folder):
    rng = np.random.default_rng(0)
    np.savez(
        folder / "rigs.npz", object_points=rng.normal(size=(4, 3)), cameras=np.array(["l", "r"]),
        image_points=rng.uniform(0, 400, (2, 2, 3, 4, 2)), image_size=np.array([640, 480]),
        visible=np.ones((2, 2, 3, 4), bool), ids=np.array([7, 8]),
    )  # fmt: skip


@cache
def _adjusted():
    import jaxbundle

    return jaxbundle.adjust(read_network(EXAMPLES / "resection63" / "project.toml"))


def _load(folder: Path):
    import jaxbundle

    return jaxbundle.load_adjustment(folder / "saved.npz")


@reader("saved adjustment", _load)
def _(folder):
    _adjusted().save(folder / "saved.npz")


def _store(folder: Path):
    from jaxbundle.tiepoints.features import FeatureSettings
    from jaxbundle.tiepoints.store import Store

    return Store(folder, FeatureSettings())


def _kept_features(folder: Path):
    """Damaged ones are computed again, good ones are the same."""
    features = _store(folder).load_features("photograph")
    matches = _store(folder).load_matches("photograph", "other")
    assert features is None or (features.xy == np.ones((5, 2))).all()
    assert matches is None or (matches[0] == np.arange(6).reshape(3, 2)).all()


@reader("kept features", _kept_features)
def _(folder):
    from jaxbundle.tiepoints.features import Features

    store = _store(folder)
    store.save_features("photograph", Features(np.ones((5, 2)), np.ones(5), np.zeros(5),
                                               np.full((5, 128), 7, np.uint8)))  # fmt: skip
    store.save_matches("photograph", "other", np.arange(6).reshape(3, 2), np.ones(3) / 2,
                       np.ones(3, bool))  # fmt: skip


# --- clouds -------------------------------------------------------------------------------------


def _points(system=None):
    from jaxbundle.surfaces.cloud import Cloud

    X = np.arange(90.0).reshape(30, 3) + [500_000, 4_000_000, 0]
    C = np.tile(1e-4 * np.eye(3), (30, 1, 1))
    colour = np.arange(90, dtype=np.uint8).reshape(30, 3)
    return Cloud(X, C, np.full(30, 2), np.zeros(30, int), np.zeros((30, 2)), ("a",), colour, system)


def _cloud(folder: Path):
    from jaxbundle.surfaces.point_files import read_cloud

    cloud = read_cloud(next(folder.iterdir()))
    s = cloud.sigma[np.isfinite(cloud.sigma)]
    assert np.isfinite(cloud.X).all() and (s >= 0).all() and (cloud.rays >= 0).all()
    return cloud


for suffix in ("csv", "ply", "las", "laz"):
    @reader(f"cloud {suffix}", _cloud)
    def _(folder, suffix=suffix):
        from jaxbundle.surfaces.point_files import write_cloud

        write_cloud(_points("EPSG:32633" if "la" in suffix else None), folder / f"c.{suffix}")


@reader("cloud ply as text", _cloud)
def _(folder):
    fields = [f"property double {a}" for a in "xyz"]
    fields += [f"property uchar {c}" for c in ("red", "green", "blue")]
    rows = [f"{k} {k}.5 {-k} {k} 0 255" for k in range(9)]
    head = ["ply", "format ascii 1.0", "comment by hand", "element vertex 9", *fields, "end_header"]
    (folder / "c.ply").write_text("\n".join([*head, *rows]) + "\n")


for kind, suffix in ((1, "laz"), (3, "las"), (10, "laz")):
    @reader(f"cloud {suffix}, points of format {kind}", _cloud)
    def _(folder, kind=kind, suffix=suffix):
        import laspy

        header = laspy.LasHeader(point_format=kind, version="1.4" if kind > 5 else "1.2")
        header.scales, header.offsets = np.full(3, 0.01), np.array([5e5, 4e6, 0])
        if kind == 3:  # geographic keys as in files of surveys
            keys = laspy.vlrs.known.GeoKeyDirectoryVlr()
            keys.parse_record_data(struct.pack("<8H", 1, 1, 0, 1, 3072, 0, 1, 32633))
            header.vlrs.append(keys)
        las = laspy.LasData(header)
        las.x, las.y, las.z = _points().X.T
        las.write(folder / f"c.{suffix}")


# --- photographs --------------------------------------------------------------------------------


def _photograph(folder: Path):
    from jaxbundle.photographs import read_exif, read_photograph
    from jaxbundle.photographs.reading import photograph_size

    file = next(folder.iterdir())
    outcome, coloured = None, partial(read_photograph, colour=True)
    for read in (photograph_size, read_exif, read_photograph, coloured):
        try:
            read(file)
        except ValueError as error:  # the others are tried too
            outcome = error
    if outcome is not None:
        raise outcome


def _picture(size=(90, 60)):
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([x * 2, y * 3, x + y], 2).astype(np.uint8)


def _metadata():
    head = Image.Exif()
    head[0x010F], head[0x0110], head[0x0112] = "NIKON CORPORATION", "NIKON D800", 1
    details = head.get_ifd(0x8769)
    details[0x920A], details[0x9003], details[0xA405] = 24.0, "2021:05:03 10:11:12", 36
    details[0xA20E], details[0xA210], details[0xA002], details[0xA003] = 254.0, 3, 90, 60
    gps = head.get_ifd(0x8825)
    gps[1], gps[2], gps[3], gps[4] = "S", (33.0, 30.0, 36.0), "W", (70.0, 45.0, 0.0)
    gps[5], gps[6] = b"\x00", 512.5
    return head


for suffix in ("jpg", "png", "tif", "bmp", "webp", "ppm", "jp2"):
    @reader(f"photograph {suffix}", _photograph)
    def _(folder, suffix=suffix):
        from test_xmp import DJI

        more = {"jpg": {"exif": _metadata(), "xmp": DJI.encode()}, "png": {"exif": _metadata()},
                "webp": {"exif": _metadata(), "xmp": DJI.encode()},
                "tif": {"exif": _metadata(), "compression": "tiff_lzw"}}  # fmt: skip
        Image.fromarray(_picture()).save(folder / f"a.{suffix}", **more.get(suffix, {}))


@reader("photograph of 16 bits", _photograph)
def _(folder):
    Image.fromarray(_picture()[..., 0].astype(np.uint16) * 200).save(folder / "a.png")


@reader("xmp", lambda f: __import__("jaxbundle.photographs.xmp").photographs.xmp.parse_xmp(
    (f / "packet.xmp").read_bytes()))  # fmt: skip
def _(folder):
    from test_xmp import PIX4D

    (folder / "packet.xmp").write_text(PIX4D)


# --- line scanners: products --------------------------------------------------------------------


for name in ("image.RPB", "image.tif"):
    @reader(f"rpc {name}", lambda f: scanners.read_rpc(next(f.iterdir())))
    def _(folder, name=name):
        from test_rpc_files import RPC, write_raster

        if name.endswith("tif"):
            write_raster(folder / name)
        scanners.write_rpc(folder / name, RPC)


def _rpc_product(case):
    def make(folder):
        from test_rpc_products import PRODUCTS

        name, text = PRODUCTS[case]
        (folder / name).write_text(text)

    return make


for case in ("Pleiades", "Pleiades, first products", "Pleiades Neo", "WorldView", "OSSIM"):
    READERS[f"rpc {case}"] = Reader(
        _rpc_product(case), lambda f: scanners.read_rpc(next(f.iterdir()))
    )


@reader("scanner worldview as text", lambda f: scanners.read_scanner(f / "image.IMD"))
def _(folder):
    from test_xml_products import as_text, worldview

    for group in ET.fromstring(worldview()):
        (folder / f"image.{group.tag}").write_text(as_text(group) + "\nEND;\n")


@reader("scanner with a source", lambda f: scanners.read_scanner(f / "scanner.toml"))
def _(folder):
    from test_csm import support_data

    (folder / "isd.json").write_text(json.dumps(support_data(older=True), indent=1))
    (folder / "scanner.toml").write_text(
        '[scanner]\nsource = "isd.json"\ninterpolation = "lagrange"\n\n[corrections]\n'
        "refraction = true\naberration = false\n"
    )


@reader("control network of ISIS", lambda f: read_control_network(f / "network.pvl"))
def _(folder):
    from isis_samples import GOOD

    (folder / "network.pvl").write_text(GOOD + "End_Object\nEnd\n")


@reader("residuals of jigsaw", lambda f: read_jigsaw_residuals(f / "residuals.csv"))
def _(folder):
    from isis_samples import RESIDUALS

    row = "P{},/data/left.cub,s{},0.1,0.2,{}.5,7.25,0.3,-0.4,0.5\n"
    rows = [row.format(k // 2, k % 2, 3 * k) for k in range(6)]
    (folder / "residuals.csv").write_text(RESIDUALS + "".join(rows))


# --- rasters ------------------------------------------------------------------------------------


def _dem(folder, crs="EPSG:4326", origin=(13.0, 41.0), step=0.01, name="dem.tif", **options):
    import rasterio

    x, y = np.meshgrid(np.arange(24), np.arange(20))
    with rasterio.open(
        folder / name, "w", driver=options.pop("driver", "GTiff"), width=24, height=20, count=1,
        dtype=options.pop("dtype", "float32"), crs=crs, nodata=options.pop("nodata", -9999),
        transform=rasterio.transform.Affine(step, 0, origin[0], 0, -step, origin[1]), **options,
    ) as target:  # fmt: skip
        target.write((100 + x + y)[None])


def _terrain(folder: Path, earth=True):
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io.rasters.extent import Extent
    from jaxbundle.io.rasters.terrain_models import read_terrain

    dem = next(p for p in folder.iterdir() if p.suffix != ".xml")
    if not earth:
        return read_terrain(dem, None)
    read_terrain(dem, WGS84, Extent(13.02, 40.85, 13.1, 40.95))
    return read_terrain(dem, WGS84)


@reader("terrain", _terrain)
def _(folder):
    _dem(folder)


@reader("terrain packed", _terrain)
def _(folder):
    _dem(folder, compress="deflate", predictor=3, tiled=True, blockxsize=16, blockysize=16)


@reader("terrain in UTM", _terrain)
def _(folder):
    _dem(folder, "EPSG:32633", (331_792.0, 4_540_683.0), 1000.0, dtype="int16", compress="lzw")


@reader("terrain of a local frame", partial(_terrain, earth=False))
def _(folder):
    _dem(folder, None)


@reader("terrain as text", _terrain)
def _(folder):
    rows = "\n".join(" ".join(str(100 + x + y) for x in range(24)) for y in range(20))
    (folder / "dem.asc").write_text(
        f"ncols 24\nnrows 20\nxllcorner 13.0\nyllcorner 40.8\ncellsize 0.01\n{rows}\n"
    )
    (folder / "dem.prj").write_text(
        'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
    )


def _asc(folder: Path):
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io.rasters.terrain_models import read_terrain

    return read_terrain(folder / "dem.asc", WGS84)


READERS["terrain as text"] = READERS["terrain as text"]._replace(read=_asc)


def _geoid(folder: Path):
    from jaxbundle.io.rasters.geoid import undulations

    return undulations(folder / "geoid.gtx", np.array([13.05, 13.1]), np.array([40.9]))


@reader("geoid", _geoid)
def _(folder):
    _dem(folder, name="geoid.gtx", driver="GTX")


def _scene(folder: Path):
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io.rasters.scenes import read_scene

    return read_scene(folder / "dem.tif", WGS84)


@reader("scene", _scene)
def _(folder):
    _dem(folder, "EPSG:32633", (331_792.0, 4_540_683.0), 1000.0, dtype="uint16", nodata=0)


def _grey(folder: Path):
    from jaxbundle.surfaces.scanner_inputs import read_grey

    return read_grey(next(folder.iterdir()))


for suffix in ("tif", "png", "jpg", "jp2"):
    @reader(f"grey values {suffix}", _grey)
    def _(folder, suffix=suffix):
        Image.fromarray(_picture()).save(folder / f"a.{suffix}")


@reader("grey values of 16 bits", _grey)
def _(folder):
    _dem(folder, None, dtype="uint16", compress="deflate", nodata=0)


# --- tie points of scanner images ---------------------------------------------------------------


@reader("asp match", lambda f: read_match(f / "run-a__b.match"))
def _(folder):
    records = b"".join(
        struct.pack("<ffiifff?IIQff", x, y, 3, 4, 0.5, 1.0, 2.0, True, 1, 2, 2, 0.5, 0.25)
        for x, y in ((3.25, 4.5), (30.0, 4.0), (3.5, 5.0), (31.0, 4.25))
    )
    (folder / "run-a__b.match").write_bytes(struct.pack("<QQ", 2, 2) + records)


@reader("asp gcp", lambda f: read_gcp(f / "control.gcp"))
def _(folder):
    (folder / "control.gcp").write_text(
        "# id lat lon height\n1 23.7 160.1 427.1 1 1 1 a.tif 124.5 19.7 1 1 b.tif 254.3 73.9 1 1\n"
        "2, 23.8, 160.2, 400.0, 1, 1, 2, a.tif, 10.5, 90.25, 0.5, 0.5\n"
    )
