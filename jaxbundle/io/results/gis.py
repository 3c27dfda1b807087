"""Points, stations and error ellipses for geographic information systems: GeoJSON, GeoPackage.

| layer | geometry | attributes |
|---|---|---|
| points | point Z | id, role, X, Y, Z, sX, sY, sZ, rays |
| control | point Z | id, dX, dY, dZ (predicted by all others − given), their σ, probability |
| checks | point Z | id, X, Y, Z, dX, dY, dZ (intersected − given), sX, sY, sZ, rays |
| stations | point Z | id, camera, X0, Y0, Z0, omega, phi, kappa, their σ |
| ellipses | polygon | id, of, a, b (semi-axes of the standard ellipse in plan), bearing, factor |

The bearing is that of a, in degrees, clockwise from Y. An ellipse is drawn `factor` times larger
than the standard one (39 % of probability, k = 1). The σ are those shown with the values. GeoJSON
has WGS 84 longitude and latitude (RFC 7946, 4): the
coordinates are transformed from their `crs` by pyproj (extra `geo`). A GeoPackage (OGC 12-128r18)
keeps the coordinates of the project, with the number of their system; without one they are
Cartesian and undefined (srs_id −1).
"""

import json
import math
import re
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import positive
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.writing.replacing import replace_file
from jaxbundle.network.tables import EXTERIOR

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

# Corners of a drawn ellipse: a circle of 36 differs from its polygon by 0.4 % of the radius.
CORNERS = 36
# "GPKG" as a number, and version 1.3 (OGC 12-128r18, requirement 2).
APPLICATION, VERSION = 0x47504B47, 10300
LAYERS = ("points", "control", "checks", "stations", "ellipses")
UNDEFINED = -1


class Feature(NamedTuple):
    """A feature: its layer, a point [3] or the ring of a polygon [n, 2], attributes."""

    layer: str
    coordinates: Float[np.ndarray, "..."]
    attributes: dict[str, Any]


def write_geojson(
    result: "Adjustment", path: str | Path, crs: str = "", factor: float | None = None
) -> None:
    """Write points, stations and error ellipses of a result as GeoJSON, for QGIS and the web.

    **Arguments:** `crs` of the object coordinates, such as `"EPSG:25832"`; `factor` of the
    ellipses: by default a round one, with which the largest is a fiftieth of the network.

    **Raises:** `InputError` without `crs` or pyproj, for an unknown `crs`, or coordinates outside
    of it; `NotSolvedError` without a solution.
    """
    transform = require_transformation(crs)
    features = []
    for feature in collect_features(result, factor):
        coordinates = np.atleast_2d(feature.coordinates)
        lonlat = np.column_stack(transform(coordinates[:, 0], coordinates[:, 1]))
        if not np.isfinite(lonlat).all() or not (np.abs(lonlat) <= [180.0, 90.0]).all():
            raise InputError(f"{crs}: the coordinates are outside of this system")
        features.append(
            {
                "type": "Feature",
                "id": f"{feature.layer}/{feature.attributes['id']}",
                "geometry": _geometry(lonlat, coordinates, feature.layer),
                "properties": {"layer": feature.layer, **_json_attributes(feature.attributes)},
            }
        )
    document = {"type": "FeatureCollection", "features": features}
    write_text(Path(path), json.dumps(document, ensure_ascii=False) + "\n")


def _geometry(
    lonlat: Float[np.ndarray, "n 2"], coordinates: Float[np.ndarray, "n d"], layer: str
) -> dict[str, Any]:
    # Nine digits: a tenth of a millimetre.
    rounded = np.round(lonlat, 9).tolist()
    if layer != "ellipses":
        return {"type": "Point", "coordinates": [*rounded[0], float(coordinates[0, 2])]}
    # RFC 7946, 3.1.6: closed, the exterior ring counterclockwise
    ring = rounded if _is_counterclockwise(lonlat) else rounded[::-1]
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}


def _is_counterclockwise(ring: Float[np.ndarray, "n 2"]) -> bool:
    # About its centre: of map coordinates the area is in the last digits.
    x, y = (ring - ring.mean(0)).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 0


def write_geopackage(
    result: "Adjustment", path: str | Path, crs: str = "", factor: float | None = None
) -> None:
    """Write points, stations and error ellipses of a result as the layers of a GeoPackage.

    **Arguments:** as `write_geojson`; without `crs` the coordinates are Cartesian, of no known
    system.

    **Raises:** `InputError` for an unknown `crs`, or if the file cannot be written;
    `NotSolvedError` without a solution.
    """
    system = check_crs(crs)
    features = list(collect_features(result, factor))
    with replace_file(path) as temporary:
        try:
            with closing(sqlite3.connect(temporary)) as database, database:
                _fill_database(database, features, system)
        except sqlite3.Error as error:
            raise InputError(f"{path}: cannot be written: {error}") from None


def check_crs(crs: str) -> int | None:
    """The number of a coordinate system EPSG:NUMBER; None without one.

    **Raises:** `InputError` for other texts."""
    if not crs:
        return None
    match = re.fullmatch(r"(?i)epsg:(\d{4,6})", crs.strip())
    if match is None:
        raise InputError(f"crs {crs!r}: expected EPSG:NUMBER, such as EPSG:25832")
    return int(match[1])


def require_transformation(crs: str) -> Any:
    """The transformation of coordinates to longitude and latitude.

    **Raises:** `InputError` without `crs` or pyproj, and for an unknown one."""
    if check_crs(crs) is None:
        raise InputError(
            "GeoJSON has longitude and latitude (RFC 7946): give the crs of the coordinates, such "
            "as EPSG:25832, or write a GeoPackage"
        )
    try:
        import pyproj
        from pyproj.exceptions import ProjError
    except ImportError:
        raise InputError("GeoJSON needs pyproj: pip install 'jaxbundle[geo]'") from None
    try:
        return pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform
    except ProjError as error:
        raise InputError(f"crs {crs!r}: {' '.join(str(error).split())}") from None


def collect_features(result: "Adjustment", factor: float | None = None) -> Iterator[Feature]:
    """All features of a result.

    **Raises:** `InputError` for a factor that is not positive; `NotSolvedError`."""
    points, images = result.points, result.images
    C = result.point_covariance
    variances = np.diagonal(C, axis1=1, axis2=2)
    if (modelled := result.correlated_point_covariance) is not None:
        # σ as in the report, of every coordinate the larger; an ellipse is of one covariance.
        variances = np.fmax(variances, np.diagonal(modelled, axis1=1, axis2=2))
        size = lambda C: np.trace(C, axis1=1, axis2=2)[:, None, None]
        C = np.where(size(modelled) > size(C), modelled, C)
    coordinates = result.point_values
    has_coordinates = np.asarray(np.isfinite(coordinates).all(1))
    for row in np.flatnonzero(has_coordinates):
        sigma = np.sqrt(np.clip(variances[row], 0, None))
        yield Feature(
            "points",
            coordinates[row],
            {
                "id": str(points["id"][row]),
                "role": str(points["role"][row]),
                **dict(zip("XYZ", coordinates[row].tolist())),
                **dict(zip(("sX", "sY", "sZ"), sigma.tolist())),
                "rays": int(points["rays"][row]),
            },
        )
    place_of = dict(zip(points["id"].tolist(), coordinates))
    for layer in ("control", "checks"):
        columns = result.table(layer)
        for values in zip(*(np.asarray(column).tolist() for column in columns.values())):
            row_of_table = dict(zip(columns, values))
            given_place = [row_of_table.get(axis) for axis in "XYZ"]
            place = np.array(place_of.get(row_of_table["id"], given_place), float)
            if np.isfinite(place).all():
                yield Feature(layer, place, row_of_table)
    cameras = [result.network.cameras[c].id for c in result.network.images.camera]
    sigmas = [f"s{name}" for name in EXTERIOR]
    for row, centre in enumerate(result.image_values[:, :3]):
        yield Feature(
            "stations",
            centre,
            {
                "id": str(images["id"][row]),
                "camera": cameras[row],
                **{name: float(images[name][row]) for name in (*EXTERIOR, *sigmas)},
            },
        )
    ids = [str(id) for id in points["id"]]
    yield from _ellipses(coordinates, C, has_coordinates, ids, factor)


def _ellipses(
    coordinates: Float[np.ndarray, "n 3"],
    C: Float[np.ndarray, "n 3 3"],
    has_coordinates: np.ndarray,
    ids: Sequence[str],
    factor: float | None,
) -> Iterator[Feature]:
    rows = [
        r for r in np.flatnonzero(has_coordinates) if np.isfinite(C[r]).all() and C[r, 0, 0] > 0
    ]
    if not rows:
        return
    w, E = np.linalg.eigh(C[rows][:, :2, :2])
    axes = np.sqrt(np.clip(w, 0, None))
    if factor is None:
        extent = float(np.ptp(coordinates[has_coordinates][:, :2], axis=0).max()) or 1.0
        factor = round_down(0.02 * extent / float(axes.max()))
    factor = positive("factor", factor)
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for row, axis, vectors in zip(rows, axes, E):
        ring = coordinates[row, :2] + factor * ((vectors * axis) @ circle).T
        major_axis = vectors[:, 1]
        yield Feature(
            "ellipses",
            ring,
            {
                "id": ids[int(row)],
                "of": "point",
                "a": float(axis[1]),
                "b": float(axis[0]),
                "bearing": math.degrees(math.atan2(major_axis[0], major_axis[1])) % 180.0,
                "factor": factor,
            },
        )


def round_down(x: float) -> float:
    """1, 2 or 5 times a power of ten, not larger than x."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(max(step for step in (1, 2, 5) if step * power <= x * (1 + 1e-9)) * power)


def _json_attributes(attributes: dict[str, Any]) -> dict[str, Any]:
    """Attributes without what JSON does not have."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in attributes.items()
    }


# --- GeoPackage -----------------------------------------------------------------------------

TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL
    DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""
# The records that every GeoPackage has (requirement 11).
SYSTEMS = (
    ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian coordinates"),
    ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinates"),
    (
        "WGS 84 geodetic",
        4326,
        "EPSG",
        4326,
        'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]',
        "longitude and latitude",
    ),
)


def _fill_database(
    database: sqlite3.Connection, features: list[Feature], system: int | None
) -> None:
    database.execute(f"PRAGMA application_id = {APPLICATION}")
    database.execute(f"PRAGMA user_version = {VERSION}")
    for statement in TABLES.split(";"):
        database.execute(statement)
    insert = "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)"
    database.executemany(insert, SYSTEMS)
    srs = UNDEFINED if system is None else system
    if system is not None and system != 4326:  # noqa: PLR2004 - WGS 84 is there already
        name, definition = _definition(system)
        database.execute(insert, (name, system, "EPSG", system, definition, name))
    for layer in LAYERS:
        layer_features = [feature for feature in features if feature.layer == layer]
        if layer_features:
            _add_layer(database, layer, layer_features, srs)


def _definition(system: int) -> tuple[str, str]:
    """Name and WKT of a system; without pyproj only its number, by which programs know it."""
    try:
        import pyproj
        from pyproj.exceptions import CRSError
    except ImportError:
        return f"EPSG:{system}", "undefined"
    try:
        crs = pyproj.CRS.from_epsg(system)
        return crs.name, crs.to_wkt("WKT1_GDAL")
    except CRSError as error:
        raise InputError(f"crs EPSG:{system}: {' '.join(str(error).split())}") from None


def _add_layer(database: sqlite3.Connection, layer: str, features: list[Feature], srs: int) -> None:
    kind, z = ("POLYGON", 0) if layer == "ellipses" else ("POINT", 1)
    names = list(features[0].attributes)
    types = [
        "TEXT" if isinstance(v, str) else "INTEGER" if isinstance(v, int) else "DOUBLE"
        for v in features[0].attributes.values()
    ]
    columns = ", ".join(f'"{name}" {type}' for name, type in zip(names, types))
    database.execute(
        f'CREATE TABLE "{layer}" (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {kind}, '
        f"{columns})"
    )
    corners = np.concatenate([np.atleast_2d(feature.coordinates)[:, :2] for feature in features])
    low, high = corners.min(0).tolist(), corners.max(0).tolist()
    database.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, "
        "srs_id) VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (layer, layer, *low, *high, srs),
    )
    database.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, ?, 0)", (layer, kind, srs, z)
    )
    marks = ", ".join("?" * (len(names) + 1))
    column_names = ", ".join(f'"{name}"' for name in names)
    database.executemany(
        f'INSERT INTO "{layer}" (geom, {column_names}) VALUES ({marks})',
        [
            (_geometry_blob(feature, srs), *_json_attributes(feature.attributes).values())
            for feature in features
        ],
    )


def _geometry_blob(feature: Feature, srs: int) -> bytes:
    """A geometry: the header of a GeoPackage (little-endian, no envelope), and ISO WKB."""
    header = b"GP" + struct.pack("<BBi", 0, 1, srs)
    if feature.layer != "ellipses":
        return header + struct.pack("<BI3d", 1, 1001, *feature.coordinates.tolist())
    ring = (
        feature.coordinates
        if _is_counterclockwise(feature.coordinates)
        else feature.coordinates[::-1]
    )
    ring = np.concatenate([ring, ring[:1]])
    return header + struct.pack("<BIII", 1, 3, 1, len(ring)) + ring.astype("<f8").tobytes()
