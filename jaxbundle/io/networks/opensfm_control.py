"""Ground control points of OpenSfM: `ground_control_points.json` beside a reconstruction.

    {"points": [{"id": …, "position": {"latitude", "longitude", "altitude"},
                 "observations": [{"shot_id": image, "projection": [x, y]}, …]}, …]}

Latitude and longitude in degrees, altitude above the ellipsoid in metres, of WGS 84. They become
topocentric about `reference_lla.json`, as the reconstruction is: with the geocentric X, X₀ of point
and reference, and the axes east, north, up of the reference as rows of R, X_local = R·(X − X₀).
Image points are relative to the centre of the image, in units of its larger side, as in the tracks.
A point without position is a tie point.

The file has no σ: those of OpenSfM's settings are taken, 0.01 m in position, 0.1 m in height.

Source: OpenSfM documentation, "Ground control points"; its config.py, gcp_horizontal_sd and
gcp_vertical_sd; its geo.py, topocentric coordinates.
"""

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.float64 import local_x64
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.json_fields import JsonFields, read_object
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera, Points, Source
from jaxbundle.types import not_none

CONTROL = "ground_control_points.json"
HORIZONTAL_SIGMA, VERTICAL_SIGMA = 0.01, 0.1
FILE_KEYS = Keys(("points",), {"crs": "coordinates are latitude and longitude"})
POINT_KEYS = Keys(
    ("id", "position", "observations", "has_altitude"), {"role": "optimised or not by OpenSfM"}
)
POSITION_KEYS = Keys(("latitude", "longitude", "altitude"))
RAY_KEYS = Keys(("shot_id", "projection"), {"uid": "a name"})


class GroundControl(NamedTuple):
    """Control points, None without one with a position; rows of image points: image, point, x, y in
    pixels; names of the points without a position; messages."""

    points: Points | None
    rays: list[tuple[str, str, float, float]]
    unknown: list[str]
    messages: tuple[str, ...]

    def renamed(self, track_ids: Collection[str]) -> "GroundControl":
        """With names of their own: tracks and control are numbered apart, and may be equal."""
        control_ids = [*(self.points.id if self.points else ()), *self.unknown]
        new = {id: f"control {id}" if id in track_ids else id for id in control_ids}
        points = self.points and dataclasses.replace(
            self.points, id=tuple(new[id] for id in self.points.id)
        )
        rays = [(image, new[point], x, y) for image, point, x, y in self.rays]
        return GroundControl(points, rays, [new[id] for id in self.unknown], self.messages)


def read_ground_control(
    file: Path, reference: Path, cameras: Mapping[str, Camera]
) -> GroundControl:
    """The points of a file.

    **Arguments:** `reference`: the file of the origin; `cameras`: by image, of those that are read.

    **Raises:** `InputError` naming file, point and field."""
    unknown = UnknownKeys()
    document = JsonFields(file, read_object(file, read_text(file), "ground control points"))
    unknown.check(document.document, FILE_KEYS, file)
    ids: list[str] = []
    geodetic, rays, unpositioned_ids = [], [], []
    for point in document.rows("points"):
        unknown.check(point.document, POINT_KEYS, point.path)
        id = point.text("id")
        if id in ids or id in unpositioned_ids:
            raise InputError(f"{point.path}: the point {id!r} occurs twice")
        if point.get("position") is None:
            unpositioned_ids.append(id)
        else:
            position = point.child("position")
            unknown.check(position.document, POSITION_KEYS, position.path)
            if point.get("has_altitude") is False:
                raise InputError(f"{point.path}: has_altitude is false; expected an altitude")
            ids.append(id)
            geodetic.append([position.number(name) for name in POSITION_KEYS.used])
        for ray in point.rows("observations"):
            unknown.check(ray.document, RAY_KEYS, ray.path)
            image = ray.text("shot_id")
            if image in cameras:
                x, y = ray.array("projection", (2,)).tolist()
                w, h = not_none(cameras[image].image_size)
                side = max(w, h)
                rays.append((image, id, side * x + (w - 1) / 2, side * y + (h - 1) / 2))
    measured_ids = {point for _, point, *_ in rays}
    messages = list(unknown.messages())
    measured_rows = [k for k, id in enumerate(ids) if id in measured_ids]
    points = None
    if measured_rows and not reference.is_file():
        messages.append(
            f"{file.name}: left out {count(len(measured_rows), 'control point')}: latitudes and "
            f"longitudes need {reference.name}, which is not beside it"
        )
        dropped_ids = {ids[k] for k in measured_rows}
        rays = [ray for ray in rays if ray[1] not in dropped_ids]
    elif measured_rows:
        sigma = np.tile(
            [HORIZONTAL_SIGMA, HORIZONTAL_SIGMA, VERTICAL_SIGMA], (len(measured_rows), 1)
        )
        local = _topocentric(_origin(reference), np.array(geodetic)[measured_rows])
        names = tuple(ids[k] for k in measured_rows)
        points = Points(names, ("control",) * len(measured_rows), local, sigma, Source(str(file)))
        messages.append(
            f"{file.name}: {len(measured_rows)} control points, whose σ are not in it; taken as "
            f"OpenSfM's, {HORIZONTAL_SIGMA:g} m, {VERTICAL_SIGMA:g} m in height (--control FILE "
            "gives others)"
        )
    return GroundControl(
        points, rays, [id for id in unpositioned_ids if id in measured_ids], tuple(messages)
    )


def _origin(reference: Path) -> Float[np.ndarray, "3"]:
    fields = JsonFields(reference, read_object(reference, read_text(reference), "a reference"))
    return np.array([fields.number(name) for name in POSITION_KEYS.used])


def _topocentric(
    origin: Float[np.ndarray, "3"], geodetic_positions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """East, north, up of latitude, longitude [°] and altitude, about an origin in the same form."""
    with local_x64():
        X = np.array(
            [_geocentric(geodetic_position) for geodetic_position in (origin, *geodetic_positions)]
        )
    latitude, longitude = np.radians(origin[:2])
    (sf, cf), (sl, cl) = ((np.sin(a), np.cos(a)) for a in (latitude, longitude))
    R = np.array([[-sl, cl, 0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]])
    return (X[1:] - X[0]) @ R.T


def _geocentric(geodetic_position: Any) -> Float[np.ndarray, "3"]:
    latitude, longitude, altitude = geodetic_position
    return np.array(earth_fixed(WGS84, (np.radians(longitude), np.radians(latitude), altitude)))
