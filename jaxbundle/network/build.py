"""Networks from plain Python tables: data frames, dicts of columns, lists of dict rows.

The columns are those of the project format:

| table | columns |
|---|---|
| cameras | id, model, image_size, pixel_size, free, sigma, and the parameters of the model |
| images | id, camera, X0, Y0, Z0, omega, phi, kappa, and σ: sX0, sY0, sZ0, somega, sphi, skappa |
| points | id, role (tie, control, fixed, check), X, Y, Z, σ: sX, sY, sZ, and red, green, blue |
| observations | image, point, x, y, and σ: sx, sy |
| distances | from, to, value, sigma |
| antennas, attitudes, camera_parameters, … | `jaxbundle.network.kinds` |

The columns X0, Y0, Z0 of images, and omega, phi, kappa, are optional, all three together.
Missing values (None, NaN, empty text) mean no start value or no σ. A σ of an image may be "fixed"
(the value is held), a σ of a control point "free" (this axis is not controlled). Colours are whole
numbers from 0 to 255; a point without one among others is grey.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxbundle.arguments import show, text
from jaxbundle.cameras import CameraModel, is_known
from jaxbundle.errors import InputError
from jaxbundle.network.columns import (
    NO_NUMBERS,
    Columns,
    RepeatedIds,
    as_columns,
    as_id,
    count,
    is_missing,
    refuse_unknown,
)
from jaxbundle.network.kinds import KINDS, SECTIONS, ObservationTable
from jaxbundle.network.rules import (
    AXES,
    CHOICES,
    check_camera,
    check_choice,
    check_models,
    check_sigma_image,
    check_unique,
    model_of,
)
from jaxbundle.network.tables import (
    EXTERIOR,
    GREY,
    SIGMA_ORIGINS,
    STATED,
    UNIT,
    Camera,
    Distances,
    Images,
    Network,
    Observations,
    Points,
    Source,
    require_network,
)
from jaxbundle.network.units import ANGLE_UNITS, from_image_unit

CAMERA_FIELDS = ("id", "model", "image_size", "pixel_size", "free", "sigma", "observed", "tie")
IMAGE_COLUMNS = ("id", "camera", *EXTERIOR)
# Columns of images that may be omitted together.
GROUPS = EXTERIOR[:3], EXTERIOR[3:]
IMAGE_SIGMAS = tuple(f"s{name}" for name in EXTERIOR)
POINT_COLUMNS = ("id", "role", *AXES)
POINT_SIGMAS = tuple(f"s{name}" for name in AXES)
POINT_COLOURS = ("red", "green", "blue")
# Reprojection errors in written point tables; not used.
POINT_ERRORS = ("error_px", "error_mm")
OBSERVATION_COLUMNS = ("image", "point", "x", "y")
OBSERVATION_SIGMAS = ("sx", "sy")
DISTANCE_COLUMNS = ("from", "to", "value", "sigma")


def make_network(  # noqa: PLR0913 - the tables of a network
    cameras: Any,
    images: Any,
    points: Any,
    observations: Any,
    distances: Any = None,
    *,
    datum: str = "control",
    datum_points: Sequence[Any] = (),
    residuals: str = "corrected",
    sigma_image: float | None = None,
    sigma_origin: str | None = None,
    angle_unit: str = "rad",
    image_unit: str = "mm",
    object_unit: str = "m",
    name: str = "network",
    **further: Any,
) -> Network:
    """Make a network from plain tables (see the module's docstring for their columns).

    **Arguments:**

    - `cameras`: `Camera`s, dict rows, or a data frame; parameters in the unit of the model.
    - `images`: exterior orientation, start values (object unit, `angle_unit`) and prior σ.
    - `points`: object coordinates (object unit) and σ.
    - `observations`: image coordinates and σ in `image_unit`; they are converted to the unit of the
      camera's model, which needs its image_size and pixel_size. A NaN or masked coordinate is an
      error (unlike in `calibrate_batch`, where it means a missing measurement).
    - `sigma_image`: σ of image coordinates without their own; None: 1, a unit of weight.
    - `sigma_origin`: where the σ of image coordinates come from (`SIGMA_ORIGINS`): "stated", which
      the χ² test is about; "unit", of weight only; "estimated" from the residuals. None: stated,
      unless some image coordinate has none.
    - `further`: tables of further kinds of observations, and the settings of their sections, by
      name: `antennas=table, antenna={"lever_arm": [0.1, 0, 0.3], "free": ["shift"]}`.

    **Raises:** `InputError` naming table, row and column. `check_network` makes the other checks.
    """
    settings: dict[str, Any] = {
        "datum": datum,
        "residuals": residuals,
        "angle_unit": angle_unit,
        "image_unit": image_unit,
    }
    for key, choices in CHOICES.items():
        check_choice(key, settings[key], choices)
    if sigma_image is not None:
        check_sigma_image(sigma_image)
    if sigma_origin is not None:
        check_choice("sigma_origin", sigma_origin, SIGMA_ORIGINS)
    for key, value in (("object_unit", object_unit), ("name", name)):
        text(key, value)
    if isinstance(datum_points, str) or not isinstance(datum_points, Iterable):
        raise InputError(f"datum_points must be a list of ids, not {show(datum_points)}")

    cameras = make_cameras(cameras)
    images = _make_images(as_columns(images, "images"), cameras, ANGLE_UNITS[angle_unit])
    points = _make_points(as_columns(points, "points"))
    observations = as_columns(observations, "observations")
    # Some rows with σ and some without: 1 unit of weight beside real σ is most likely a mistake.
    lacks_sigma = np.isnan(_matrix(observations, OBSERVATION_SIGMAS))
    is_partial = sigma_image is None and lacks_sigma.any() and not lacks_sigma.all()
    observations = _make_observations(observations, images, points, sigma_image, sigma_origin)
    xy, sigma = from_image_unit(
        cameras, images.camera[observations.image], observations.xy, observations.sigma, image_unit
    )
    network = Network(
        cameras=cameras,
        images=images,
        points=points,
        observations=dataclasses.replace(observations, xy=xy, sigma=sigma),
        distances=Distances.none()
        if distances is None
        else _make_distances(as_columns(distances, "distances"), points),
        datum_points=tuple(str(id) for id in datum_points),
        object_unit=object_unit,
        name=name,
        further=make_further(further, ANGLE_UNITS[angle_unit]),
        **settings,
    )
    for table in network.further:
        table.check(network)
    if is_partial:
        network = network.warn(
            f"{count(int(lacks_sigma.sum()), 'image coordinate')} of {lacks_sigma.size} without "
            f"σ: theirs is 1 {image_unit}, beside those given; give sigma_image"
        )
    return network


def add_further(network: Network, *, angle_unit: str | None = None, **further: Any) -> Network:
    """The network with further observations, in place of those it has of the same kinds.

        jaxbundle.add_further(
            network, velocities={"image": network.images.id},
            rolling_shutter={"line_time": 3e-5, "free": ["vX", "vY", "vZ", "wx", "wy", "wz"]},
        )

    **Arguments:** `further`: tables and the settings of their sections, as of `make_network`;
    `angle_unit` of what is an angle in the tables, by default that of the network; angles in the
    settings of a section are always in that.

    **Raises:** `InputError` naming table, row and column.
    """
    network_unit = require_network(network).angle_unit
    angle_unit = network_unit if angle_unit is None else angle_unit
    check_choice("angle_unit", angle_unit, CHOICES["angle_unit"])
    new_tables = make_further(further, ANGLE_UNITS[angle_unit])
    for table in new_tables:
        if angle_unit != network_unit and table.ANGLES_IN_SETTINGS and table.settings:
            raise InputError(
                f"add_further: the settings of [{table.SECTION}] are in the unit of the network, "
                f"{network_unit}: expected the table in {network_unit} too, got angle_unit "
                f"{angle_unit!r}"
            )
    new_names = {table.TABLE for table in new_tables}
    kept_tables = tuple(table for table in network.further if table.TABLE not in new_names)
    network = network.replace(further=(*kept_tables, *new_tables))
    for table in new_tables:
        table.check(network)
    return network


def make_further(
    tables_and_settings: Mapping[str, Any], radians: float
) -> tuple[ObservationTable, ...]:
    """Observations of further kinds from their tables and the settings of their sections.

    **Raises:** `InputError`, also for an unknown name, and for settings without a table."""
    known_names = (*KINDS, *SECTIONS)
    for name in tables_and_settings:
        refuse_unknown(name, known_names, "", "table")
    tables = []
    for name, kind in KINDS.items():
        settings = tables_and_settings.get(kind.SECTION, {})
        if tables_and_settings.get(name) is not None:
            tables.append(
                kind.from_columns(as_columns(tables_and_settings[name], name), settings, radians)
            )
        elif settings:
            raise InputError(f"[{kind.SECTION}] is given, but no table {name}")
    return tuple(tables)


def make_cameras(
    cameras: Any, where: str = "", models: Sequence[CameraModel] = ()
) -> tuple[Camera, ...]:
    """Checked cameras from `Camera`s, dict rows, or a table; `where` begins every message.

    `models`: user-defined models that the rows may name.
    """
    if isinstance(cameras, Camera):
        cameras = [cameras]
    elif isinstance(cameras, Mapping) and isinstance(cameras.get("id"), str | int):
        cameras = [cameras]
    elif isinstance(cameras, Mapping) or hasattr(cameras, "columns"):
        table = as_columns(cameras, "cameras")
        rows = ({k: v[row] for k, v in table.values.items()} for row in range(len(table)))
        cameras = [{k: v for k, v in row.items() if not is_missing(v)} for row in rows]
    if isinstance(cameras, str | np.ndarray) or not isinstance(cameras, Iterable):
        raise InputError(
            f"{where}cameras: expected Camera objects, dict rows or a data frame of pandas, not "
            f"{show(cameras)}"
        )
    checked_cameras = tuple(
        camera if isinstance(camera, Camera) else _camera(camera, number, where, models)
        for number, camera in enumerate(cameras, 1)
    )
    if not checked_cameras:
        raise InputError(f"{where}no camera is given; give at least one")
    for camera in checked_cameras:
        check_camera(camera, where)
    check_unique([camera.id for camera in checked_cameras], Source(f"{where}cameras"), "camera")
    check_models(checked_cameras, where)
    return checked_cameras


def _camera(
    row: Mapping[str, Any], number: int, where: str, models: Sequence[CameraModel]
) -> Camera:
    id = as_id(row.get("id")) if isinstance(row, Mapping) else ""
    if not id:
        raise InputError(f"{where}camera {number}: id is missing")
    model = row.get("model", "brown")
    model = next((user_model for user_model in models if user_model.name == model), model)
    where = f"{where}camera {id!r}: "
    parameters = {key: value for key, value in row.items() if key not in CAMERA_FIELDS}
    if isinstance(model, CameraModel) or is_known(model):
        known_parameters = model_of(model, where).parameters
        for key in parameters:
            refuse_unknown(key, (*CAMERA_FIELDS, *known_parameters), where)
    sigma, observed = row.get("sigma", {}), row.get("observed", {})
    for key, mapping in (("sigma", sigma), ("observed", observed)):
        if not isinstance(mapping, Mapping):
            raise InputError(f"{where}{key} is {mapping!r}; expected a table such as {{ c = 0.1 }}")
    free = row.get("free", ())
    if isinstance(free, str):
        free = [name.strip() for name in free.split(",") if name.strip()]
    if not isinstance(free, Sequence | np.ndarray):
        raise InputError(f'{where}free is {free!r}; expected names such as ["c", "x0"]')
    return Camera(
        id=id,
        model=model,
        parameters={key: _number(where, key, value) for key, value in parameters.items()},
        free=tuple(free),
        sigma={k: _number(where, f"sigma of {k}", v) for k, v in sigma.items()},
        image_size=_pair(where, "image_size", row.get("image_size"), int),
        pixel_size=_pair(where, "pixel_size", row.get("pixel_size"), float),
        tie=_ties(where, row.get("tie", ())),
        observed={k: _number(where, f"observed {k}", v) for k, v in observed.items()},
    )


def _ties(where: str, groups: Any) -> tuple[tuple[str, ...], ...]:
    """Groups of names of parameters."""
    is_list = lambda g: isinstance(g, Sequence) and not isinstance(g, str)
    if not is_list(groups) or not all(is_list(g) and len(g) > 1 for g in groups):
        raise InputError(
            f'{where}tie is {show(groups)}; expected groups of names such as [["fx", "fy"]]'
        )
    return tuple(tuple(map(str, group)) for group in groups)


def _number(where: str, key: str, value: Any) -> float:
    if isinstance(value, NO_NUMBERS) or not isinstance(value, int | float | np.number):
        raise InputError(f"{where}{key} is {show(value)}; expected a number")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{where}{key} is {show(value)}; that is too large") from None


def _pair(where: str, key: str, value: Any, kind: type) -> tuple | None:
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray) or len(value) != 2:
        raise InputError(f"{where}{key} is {value!r}; expected two numbers [horizontal, vertical]")
    horizontal, vertical = (_number(where, key, v) for v in value)
    if kind is int and not (horizontal.is_integer() and vertical.is_integer()):
        raise InputError(f"{where}{key} is {list(value)}; expected whole numbers of pixels")
    return kind(horizontal), kind(vertical)


def _row_by_id(ids: Sequence[str]) -> dict[str, int]:
    return {id: row for row, id in enumerate(ids)}


def _matrix(
    table: Columns, names: Sequence[str], **options: Any
) -> Float[np.ndarray, "rows names"]:
    return np.stack([table.numbers(name, **options) for name in names], 1)


def _make_images(table: Columns, cameras: Sequence[Camera], radians: float) -> Images:
    # Without start values at all the columns may be missing; half a group is a mistake.
    needed = [n for group in GROUPS if {*group} & {*table.values} for n in group]
    table.check_names(("id", "camera", *needed), (*EXTERIOR, *IMAGE_SIGMAS))
    ids = table.ids("id")
    check_unique(ids, table.source, "image")
    unit = np.array([1, 1, 1, radians, radians, radians])
    exterior = _matrix(table, EXTERIOR) * unit
    return Images(
        id=ids,
        camera=table.indices(
            "camera", "camera", _row_by_id([c.id for c in cameras]), "the cameras"
        ),
        position=exterior[:, :3],
        angles=exterior[:, 3:],
        sigma=_matrix(table, IMAGE_SIGMAS, words={"fixed": 0.0}) * unit,
        source=table.source,
    )


def _make_points(table: Columns) -> Points:
    # All columns of coordinates, and of colours, or none.
    needed = [n for group in (AXES, POINT_COLOURS) if {*group} & {*table.values} for n in group]
    table.check_names(
        ("id", *needed), ("role", *AXES, *POINT_SIGMAS, *POINT_COLOURS, *POINT_ERRORS)
    )
    ids = table.ids("id")
    check_unique(ids, table.source, "point")
    return Points(
        id=ids,
        role=table.ids("role") if "role" in table.values else ("tie",) * len(ids),
        position=_matrix(table, AXES),
        sigma=_matrix(table, POINT_SIGMAS, words={"free": math.inf}),
        source=table.source,
        colour=_colours(table),
    )


def _colours(table: Columns) -> UInt8[np.ndarray, "points 3"] | None:
    """Red, green, blue; points without any are grey."""
    if POINT_COLOURS[0] not in table.values:
        return None
    colour = _matrix(table, POINT_COLOURS)
    colour[np.isnan(colour).all(1)] = GREY
    bad = ~((colour >= 0) & (colour <= 255) & (colour % 1 == 0))
    for row, k in np.argwhere(bad)[:1]:
        raise InputError(
            f"{table.source(row)}: {POINT_COLOURS[k]} is {show(colour[row, k])}; expected a whole "
            "number from 0 to 255, or no colour at all"
        )
    return colour.astype(np.uint8)


def _make_observations(
    table: Columns, images: Images, points: Points, sigma_image: float | None, origin: str | None
) -> Observations:
    table.check_names(OBSERVATION_COLUMNS, OBSERVATION_SIGMAS)
    if table.values.keys().isdisjoint(OBSERVATION_SIGMAS):
        # Millions of rows of other programs have none.
        sigma, lacks_sigma = np.full((len(table), 2), sigma_image or 1.0), len(table) > 0
    else:
        stated_sigma = _matrix(table, OBSERVATION_SIGMAS)
        sigma = np.where(np.isnan(stated_sigma), sigma_image or 1.0, stated_sigma)
        lacks_sigma = bool(np.isnan(stated_sigma).any())
    return Observations(
        image=_rows_in(images, table, "image"),
        point=_rows_in(points, table, "point"),
        xy=_matrix(table, ("x", "y"), required=True),
        sigma=sigma,
        source=table.source,
        sigma_origin=origin or (UNIT if sigma_image is None and lacks_sigma else STATED),
    )


def _rows_in(objects: Images | Points, table: Columns, name: str) -> Int[np.ndarray, " rays"]:
    """The rows of images or points that a column names."""
    values = table.column(name)
    if isinstance(values, RepeatedIds) and values.are_rows:
        return values.codes
    return table.indices(name, name, _row_by_id(objects.id), objects.source.name)


def _make_distances(table: Columns, points: Points) -> Distances:
    if not len(table):
        return Distances.none()
    table.check_names(DISTANCE_COLUMNS)
    index = _row_by_id(points.id)
    ends = [table.indices(name, "point", index, points.source.name) for name in ("from", "to")]
    return Distances(
        points=np.stack(ends, 1),
        value=table.numbers("value", required=True),
        sigma=table.numbers("sigma", required=True),
        source=table.source,
    )
