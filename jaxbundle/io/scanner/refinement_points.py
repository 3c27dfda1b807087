"""Points and measurements of a refine file: CSV tables, files of Ames Stereo Pipeline and ISIS."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.io.scanner.asp_points import (
    ControlFile,
    images_of_match,
    join_matches,
    read_gcp,
    read_match,
)
from jaxbundle.io.scanner.isis_points import (
    IsisPoints,
    is_jigsaw_residuals,
    read_control_network,
    read_jigsaw_residuals,
)
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.io.text.sections import TomlSection
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.tables import STATED, UNIT, Network, Observations, Source
from jaxbundle.refinement.refining import east_north_up
from jaxbundle.refinement.tables import AnyScannerImage, GroundPoints, check_points_table
from jaxbundle.types import not_none

GCP, MATCH, ISIS = ".gcp", ".match", (".pvl", ".net")
MEASURED = ("image", "point", "line", "pixel", "sline", "spixel")


def read_points(
    section: TomlSection,
    names: Mapping[str, str],
    images: Sequence[AnyScannerImage],
    frames: Network | None,
    radians: float,
) -> tuple[GroundPoints, Observations, list[str]]:
    """Points, measurements and warnings of [refine].

    **Arguments:** `names`: ids of images by the names that other programs know them by.
    """
    ties_alone = "tie_points" in section and "observations" not in section
    files = [] if ties_alone else section.paths("observations", "a CSV table, .match, .gcp or .pvl")
    by_suffix = {s: [f for f in files if f.suffix.lower() == s] for s in (GCP, MATCH)}
    isis_files = [f for f in files if f.suffix.lower() in ISIS or is_jigsaw_residuals(f)]
    foreign_files = (*by_suffix[GCP], *by_suffix[MATCH], *isis_files)
    tables = [read_csv(f) for f in files if f not in foreign_files]
    for table in tables:
        table.check_names(MEASURED[:4], MEASURED[4:])
    parts, warnings = [], []
    if "points" in section or not (len(foreign_files) or ties_alone):
        parts.append(_points_of(section.table("points"), images[0].earth, radians))
    for path in by_suffix[GCP]:
        control = read_gcp(path)
        parts.append(_control_points(control, path, images[0].earth))
        table, unknown = _measured_control(control, path, names)
        tables.append(table)
        if unknown:
            warnings.append(
                f"{path}: measurements in images that are not in [images], or whose name several "
                f"of them have: {unknown}"
            )
    if by_suffix[MATCH]:
        table, ties, match_warnings = _matched_points(
            by_suffix[MATCH], names, [image.id for image in images]
        )
        tables.append(table)
        parts.append(ties)
        warnings += match_warnings
    for path in isis_files:
        existing_ids = {id for part in parts for id in part.id}
        is_network = path.suffix.lower() in ISIS
        isis_points = read_control_network(path) if is_network else read_jigsaw_residuals(path)
        warnings += isis_points.messages
        table, unknown = _measured_by_isis(isis_points, path, names)
        tables.append(table)
        parts.append(_points_of_isis(isis_points, path, existing_ids))
        if unknown:
            warnings.append(
                f"{path}: measurements in images that are not in [images]: {list_some(unknown, 3)}"
                "; of serial numbers give [serial_numbers]"
            )
    if "tie_points" in section:
        existing_ids = {id for part in parts for id in part.id}
        measured: set[tuple[object, ...]] = set()
        for path in section.paths("tie_points", "a CSV table of measurements of tie points"):
            table = read_csv(path)
            table.check_names(MEASURED[:4], MEASURED[4:])
            tables.append(_without_repeated(table, measured))
            new_ids = [id for id in dict.fromkeys(table.values["point"]) if id not in existing_ids]
            existing_ids |= set(new_ids)
            parts.append(_tie_points(new_ids, Source(str(path))))
    points = _join_points(parts)
    # Checked first: the ids of observations are looked up in it.
    check_points_table(points)
    ids = {id: k for k, id in enumerate(points.id)}
    if frames is not None:
        # Points that only photographs show follow those of the table.
        photo_point_ids = (id for id in frames.points.id if id not in ids)
        ids |= {id: k for k, id in enumerate(photo_point_ids, len(ids))}
    image_ids = [image.id for image in images]
    table = _join_tables(tables)
    return points, _observations(table, ids, image_ids, section, points.source.name), warnings


def _without_repeated(table: Columns, measured: set[tuple[object, ...]]) -> Columns:
    """A table of tie points without the measurements of earlier ones, `measured`: a corner
    of an image is the same measurement in the tables of all its pairs. These are added to
    `measured`."""
    rows = list(zip(*(table.values[name] for name in MEASURED[:4])))
    new_rows = np.array([k for k, row in enumerate(rows) if row not in measured], int)
    measured |= set(rows)
    if len(new_rows) == len(rows):
        return table
    values = {name: [column[k] for k in new_rows] for name, column in table.values.items()}
    return Columns(values, table.source.take(new_rows))


def _control_points(control: ControlFile, path: Path, earth: Ellipsoid | None) -> GroundPoints:
    """The control points of a `.gcp` file: σ along X, Y, Z, or, where these are equal, along any
    axes."""
    if earth is None or earth.a != earth.b:
        raise InputError(
            f"{path}: longitudes need an ellipsoid of revolution as [scanner] earth; give X, Y, Z "
            "in a CSV table"
        )
    longitude, latitude, height = control.geographic.T
    ground = np.radians(longitude), np.radians(latitude), height
    X = np.stack([np.asarray(v) for v in earth_fixed(earth, ground)], 1)
    source = Source(str(path), control.row, "line")
    for row, sigma in enumerate(control.sigma):
        if not (sigma > 0).all():
            raise InputError(f"{source(row)}: σ must be positive, in metres")
    role, names = ("control",) * len(X), ("X", "Y", "Z")
    axes = np.tile(np.eye(3), (len(X), 1, 1))
    if (control.sigma == control.sigma[:, :1]).all():
        axes, names = east_north_up(earth, X), ("east", "north", "up")
    return GroundPoints(tuple(control.id), role, X, control.sigma, axes, names, source)


def _measured_control(
    control: ControlFile, path: Path, names: Mapping[str, str]
) -> tuple[Columns, str]:
    """The measurements of a `.gcp` file as a table, and its images that nobody knows, in words."""
    images = [names.get(name) or names.get(Path(name).stem) for name in control.image]
    unknown = {name for name, id in zip(control.image, images) if id is None}
    used_rows = np.array([k for k, id in enumerate(images) if id is not None], int)
    point = control.point[used_rows]
    values = {
        "image": [images[k] for k in used_rows],
        "point": [control.id[p] for p in point],
        **dict(zip(("line", "pixel"), control.xy[used_rows].T.tolist())),
        **dict(zip(("sline", "spixel"), control.xy_sigma[used_rows].T.tolist())),
    }
    return Columns(values, Source(str(path), control.row[point], "line")), ", ".join(
        sorted(unknown)
    )


def _points_of_isis(isis_points: IsisPoints, path: Path, existing_ids: set[str]) -> GroundPoints:
    """The points of a file of ISIS that are not given otherwise: σ along the axes of each one's
    covariance."""
    new_rows = np.array([k for k, id in enumerate(isis_points.id) if id not in existing_ids], int)
    variances, vectors = np.linalg.eigh(isis_points.covariance[new_rows])
    X = isis_points.X[new_rows].copy()
    roles = [isis_points.role[k] for k in new_rows]
    # Tie points begin at the intersection of their rays.
    X[np.array(roles, object) == "tie"] = np.nan
    return GroundPoints(
        tuple(isis_points.id[k] for k in new_rows),
        tuple(roles),
        X,
        np.sqrt(np.maximum(variances, 0.0)),
        np.swapaxes(vectors, 1, 2),
        ("first axis", "second axis", "third axis"),
        Source(str(path), isis_points.row[new_rows], "line"),
    )


def _measured_by_isis(
    isis_points: IsisPoints, path: Path, names: Mapping[str, str]
) -> tuple[Columns, list[str]]:
    """The measurements of a file of ISIS as a table, and its images that nobody knows."""
    images = [
        next((names[n] for n in image_names if n in names), None)
        for image_names in isis_points.image
    ]
    unknown = sorted(
        {image_names[0] for image_names, id in zip(isis_points.image, images) if id is None}
    )
    used_rows = np.array([k for k, id in enumerate(images) if id is not None], int)
    sigma = [
        [None if np.isnan(v) else v for v in isis_points.xy_sigma[used_rows, k].tolist()]
        for k in (0, 1)
    ]
    values = {
        "image": [images[k] for k in used_rows],
        "point": [isis_points.id[p] for p in isis_points.point[used_rows]],
        **dict(zip(("line", "pixel"), isis_points.xy[used_rows].T.tolist())),
        **dict(zip(("sline", "spixel"), sigma)),
    }
    table = Columns(
        values, Source(str(path), isis_points.ray_row[used_rows], "line"), may_be_empty=True
    )
    return table, unknown


def _matched_points(
    files: Sequence[Path], names: Mapping[str, str], ids: Sequence[str]
) -> tuple[Columns, GroundPoints, list[str]]:
    """The tie points of `.match` files: their measurements, themselves, and warnings."""
    pairs, image_index = [], {id: k for k, id in enumerate(ids)}
    for path in files:
        first_image, second_image = (
            image_index[names[name]] for name in images_of_match(path, list(names))
        )
        pairs.append((first_image, second_image, *read_match(path)))
    tracks = join_matches(pairs)
    number = int(tracks.point.max(initial=-1)) + 1
    labels = [f"M{k + 1}" for k in range(number)]
    values = {
        "image": [ids[i] for i in tracks.image],
        "point": [labels[p] for p in tracks.point],
        **dict(zip(("line", "pixel"), tracks.xy.T.tolist())),
    }
    source = Source("match files")
    ties = _tie_points(labels, source)
    warnings = []
    if tracks.contradicting:
        warnings.append(
            f"match files: {count(tracks.contradicting, 'tie point')} with two places in one "
            "image, left out"
        )
    return Columns(values, source), ties, warnings


def _tie_points(ids: Sequence[str], source: Source) -> GroundPoints:
    """Tie points without coordinates."""
    n = len(ids)
    unknown, axes = np.full((n, 3), np.nan), np.tile(np.eye(3), (n, 1, 1))
    return GroundPoints(tuple(ids), ("tie",) * n, unknown, np.zeros((n, 3)), axes, source=source)


def _join_points(parts: Sequence[GroundPoints]) -> GroundPoints:
    """The points of several files as one table."""
    if len(parts) == 1:
        return parts[0]
    controlled = [part for part in parts if "control" in part.role]
    axes = {part.axis_names for part in controlled}
    if len(axes) > 1:
        files = " and ".join(part.source.name for part in controlled)
        raise InputError(
            f"{files}: σ of control points are along X, Y, Z in one and along east, north, up in "
            "another; give all along the same axes"
        )
    concatenate = lambda name: np.concatenate([getattr(part, name) for part in parts])
    return GroundPoints(
        tuple(id for part in parts for id in part.id),
        tuple(role for part in parts for role in part.role),
        concatenate("X"),
        concatenate("sigma"),
        concatenate("axes"),
        axes.pop() if axes else parts[0].axis_names,
        _join_sources([(part.source, len(part)) for part in parts], "points"),
    )


def _join_tables(tables: Sequence[Columns]) -> Columns:
    """Tables of measurements as one."""
    if len(tables) == 1:
        return tables[0]
    nothing = lambda table: [None] * len(table)
    values = {
        name: [v for table in tables for v in table.values.get(name, nothing(table))]
        for name in MEASURED
    }
    sources = [(table.source, len(table)) for table in tables]
    return Columns(values, _join_sources(sources, "observations"))


def _join_sources(sources: Sequence[tuple[Source, int]], name: str) -> Source:
    """The source of rows of several sources."""
    row_names = [
        f"{n + 1 if source.numbers is None else source.numbers[n]} of {source.name}"
        for source, number in sources
        for n in range(number)
    ]
    return Source(name, np.array(row_names, object), sources[0][0].word)


def _points_of(table: Columns, earth: Ellipsoid | None, radians: float) -> GroundPoints:
    geographic = "longitude" in table.values
    names = ("longitude", "latitude", "height") if geographic else ("X", "Y", "Z")
    sigmas = ("sE", "sN", "sh") if geographic else ("sX", "sY", "sZ")
    table.check_names(("id", "role", *names), sigmas)
    X = np.stack([table.numbers(n) for n in names], 1)
    words = {"free": math.inf, "held": 0.0}
    sigma = np.stack([table.numbers(n, words=words) for n in sigmas], 1)
    axes = np.tile(np.eye(3), (len(X), 1, 1))
    if geographic:
        if earth is None or earth.a != earth.b:
            raise InputError(
                f"{table.source.name}: longitudes need an ellipsoid of revolution as [scanner] "
                "earth; give X, Y, Z"
            )
        beyond = np.abs(X[:, 1] * radians) > np.pi / 2 + 1e-12  # some thousand eps, as of 100 gon
        if beyond.any():
            row = int(beyond.argmax())
            raise InputError(
                f"{table.source(row)}: latitude {X[row, 1]:g} is beyond the pole; check the "
                "order of columns and angle_unit"
            )
        X = np.stack(
            [
                np.asarray(v)
                for v in earth_fixed(earth, (radians * X[:, 0], radians * X[:, 1], X[:, 2]))
            ],
            1,
        )
        is_known = np.isfinite(X).all(1)
        # An unknown place has no east and north: its σ are of the axes.
        axes[is_known] = east_north_up(earth, X[is_known])
    return GroundPoints(
        table.ids("id"),
        table.ids("role"),
        X,
        np.nan_to_num(sigma, nan=0.0, posinf=np.inf),
        axes,
        ("east", "north", "up") if geographic else ("X", "Y", "Z"),
        table.source,
    )


def _observations(
    table: Columns,
    ids: Mapping[str, int],
    images: Sequence[str],
    section: TomlSection,
    where_points: str,
) -> Observations:
    table.check_names(("image", "point", "line", "pixel"), ("sline", "spixel"))
    sigma, has_sigma = section.number("sigma", 1.0), "sigma" in section.values
    if sigma <= 0:
        raise InputError(f"{section.where}sigma is {sigma:g}; positive, in lines and pixels")
    stated_sigma = np.stack([table.numbers(n) for n in ("sline", "spixel")], 1)
    is_missing = np.isnan(stated_sigma)
    if not has_sigma and is_missing.any() and not is_missing.all():
        row = int(is_missing.any(1).argmax())
        raise InputError(
            f"{table.source(row)}: sline or spixel is missing, which other rows have; give it, or "
            f"sigma in [refine] for those without"
        )
    index = {id: k for k, id in enumerate(images)}
    where_images = f"{not_none(section.file).path}, [images]"
    return Observations(
        table.indices("image", "image", index, where_images),
        table.indices("point", "point", ids, where_points),
        np.stack([table.numbers(n, required=True) for n in ("line", "pixel")], 1),
        np.where(is_missing, sigma, stated_sigma),
        table.source,
        STATED if has_sigma or not is_missing.any() else UNIT,
    )
