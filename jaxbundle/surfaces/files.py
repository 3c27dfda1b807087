"""Clouds as files: CSV with σ and the pixel of the base image; the report as a dictionary."""

import csv
import dataclasses
import io
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.errors import InputError
from jaxbundle.io.rasters.vertical import name_system
from jaxbundle.io.text.csv_tables import read_csv, write_text
from jaxbundle.network.tables import Source
from jaxbundle.surfaces.accuracy import accuracy_of, at_check_points
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.reconstruct import SurfaceResult

COLUMNS = ("X", "Y", "Z", "sX", "sY", "sZ", "rays", "image", "u", "v")
REQUIRED_COLUMNS = COLUMNS[:3]
SIGMAS = COLUMNS[3:6]


def write_cloud_csv(cloud: Cloud, path: str | Path) -> None:
    """A row for each point, columns `COLUMNS`; unknown σ are left empty."""
    names = np.array([*map(_quote, cloud.images), ""], dtype=object)
    # 65 536 lines at once, about 8 MB of text, whatever the size of the cloud
    rows_at_once = 1 << 16
    starts = range(0, len(cloud), rows_at_once)
    lines = (_format_rows(cloud, names, slice(k, k + rows_at_once)) for k in starts)
    write_text(Path(path), itertools.chain([",".join(COLUMNS) + "\n"], lines))


def _format_rows(cloud: Cloud, names: np.ndarray, part: slice) -> str:
    """Some points as lines of text: much faster than the csv library."""
    # Repr is the shortest text that reads back as the same number; σ need no more than 8 digits.
    exact = lambda a: ("" if x != x else repr(x) for x in a.tolist())
    short = lambda a: ("" if x != x else f"{x:.8g}" for x in a.tolist())
    C = cloud.covariance[part]
    columns = [
        *map(exact, cloud.X[part].T),
        *(short(np.sqrt(C[:, k, k])) for k in range(3)),
        map(str, cloud.rays[part].tolist()),
        names[cloud.image[part]].tolist(),
        *map(exact, cloud.uv[part].T),
    ]
    return "".join(",".join(row) + "\n" for row in zip(*columns))


def _quote(name: str) -> str:
    """A name in the form of csv."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow([name])
    return text.getvalue()


def read_cloud_csv(path: str | Path) -> Cloud:
    """A cloud from a table X,Y,Z[,sX,sY,sZ,rays,image,u,v]; other columns are ignored.

    **Raises:** `InputError` naming file, line and column.
    """
    table = read_csv(Path(path))
    X = np.stack([table.numbers(name, required=True) for name in REQUIRED_COLUMNS], axis=1)
    ids = list(table.values["image"]) if "image" in table.values else [""] * len(X)
    names = tuple(dict.fromkeys(ids)) or ("",)
    index = {name: k for k, name in enumerate(names)}
    image = np.array([index[i] for i in ids], int).reshape(len(X))
    columns = {name: table.numbers(name) for name in (*SIGMAS, "rays") if name in table.values}
    cloud = make_cloud(table.source, X, columns)
    uv = np.stack([table.numbers("u"), table.numbers("v")], axis=1)
    return dataclasses.replace(cloud, image=image, images=names, uv=uv)


def make_cloud(
    source: Source,
    X: Float[np.ndarray, "n 3"],
    columns: Mapping[str, np.ndarray],
    colour: UInt8[np.ndarray, "n 3"] | None = None,
    system: str | None = None,
    max_coordinate: float = 1e15,
) -> Cloud:
    """The cloud of the columns of a file: its σ (`SIGMAS`) and `rays`, where it has them.

    **Arguments:** `max_coordinate`: larger ones are damaged: the Sun is at 1.5e14 mm.

    **Raises:** `InputError` naming the point: a coordinate that is not finite, a negative or
    infinite σ, a number of rays that is none."""
    n = len(X)
    # The extremes of millions of points first: NaN compares as false.
    if n and not (X.max() < max_coordinate and X.min() > -max_coordinate):
        bad = ~(np.abs(X) < max_coordinate).all(axis=1)
        where = source(int(bad.argmax()))
        raise InputError(
            f"{where}: coordinates {', '.join(f'{x:g}' for x in X[bad.argmax()])}: {bad.sum()} of "
            f"{n} points have coordinates that are not finite, or too large"
        )
    columns = {name: np.asarray(values, float) for name, values in columns.items()}
    for name, limit, expected in (
        *((name, max_coordinate, "a positive number, or nothing,") for name in SIGMAS),
        ("rays", np.iinfo(np.int32).max, "a number of images"),
    ):
        if name not in columns:
            continue
        values = columns[name]
        if values.shape != (n,):
            raise InputError(f"{source.name}: {name} has {values.shape[1:]} values a point; one is")
        if (bad := (values < 0) | (values > limit)).any():
            row = int(bad.argmax())
            raise InputError(f"{source(row)}: {name} is {values[row]:g}; expected {expected}")
    # What the file does not have is one value for all points, without memory of its own.
    repeated = lambda value, shape, kind=float: np.broadcast_to(np.array(value, kind), shape)
    covariance = repeated(np.diag(np.full(3, np.nan)), (n, 3, 3))
    if columns.keys() & {*SIGMAS}:
        covariance = np.zeros((n, 3, 3))
        for k, name in enumerate(SIGMAS):
            covariance[:, k, k] = columns.get(name, np.full(n, np.nan)) ** 2
    rays = np.nan_to_num(columns["rays"]).astype(int) if "rays" in columns else repeated(0, n, int)
    return Cloud(
        X, covariance, rays, repeated(0, n, int), repeated(np.nan, (n, 2)), ("",), colour, system
    )


def report_of(
    surface: SurfaceResult,
    check: Float[np.ndarray, "n 3"] | None = None,
    heights: str = "",
) -> dict[str, Any]:
    """Counts and accuracy, for JSON; RMS at check points, if there are any; `heights`: what they
    are above, empty if it is not known."""
    cloud = surface.cloud
    number = np.bincount(cloud.rays) if len(cloud) else np.zeros(0, int)
    return {
        "points": len(cloud),
        "rays": {str(k): int(n) for k, n in enumerate(number) if n},
        "images": [dict(row) for row in surface.bases],
        "system": cloud.system,
        "heights": heights or None,
        "sigma_includes": ["matching", *(["orientation"] if surface.orientation else [])],
        "accuracy": accuracy_of(cloud),
        **(
            {}
            if check is None or not len(check)
            else {"check_points": at_check_points(cloud, check)}
        ),
        "warnings": [*surface.messages],
    }


def text_of(report: Mapping[str, Any]) -> str:
    """The report in lines."""
    accuracy = report["accuracy"]
    lines = [
        f"{report['points']} points, by rays: "
        + ", ".join(f"{k}: {n}" for k, n in report["rays"].items())
    ]
    if report.get("system"):
        heights_in_words = f", heights {report['heights']}" if report.get("heights") else ""
        lines.append(f"coordinates in {name_system(report['system'])}{heights_in_words}")
    for row in report["images"]:
        factor = row["variance_factor"]
        factor_in_words = "" if factor is None else f", variance factor {factor:.3g}"
        lines.append(
            f"{row['image']} with {', '.join(row['with'])}: {row['matched']} of "
            f"{row['points']} points{factor_in_words}"
        )
        lines += [f"    {n:8} {reason}" for reason, n in row["rejected"].items()]
    for axis in "XYZ":
        s = accuracy[f"s{axis}"]
        if s:
            lines.append(
                f"σ{axis}  mean {s['mean']:.4g}  smallest {s['smallest']:.4g}  "
                f"largest {s['largest']:.4g}"
            )
    for c in accuracy["classes"]:
        upper = "∞" if c["to"] is None else f"{c['to']:g}"
        lines.append(f"σ from {c['from']:g} to {upper}: {c['points']} points")
    lines.append(f"σ contains: {', '.join(report['sigma_includes'])}")
    check = report.get("check_points", {})
    if check.get("points"):
        lines.append(
            f"{check['points']} check points: RMS of heights {check['rms_Z']:.4g}, "
            f"mean {check['mean_Z']:.4g}, largest {check['largest_Z']:.4g}"
        )
    return "\n".join(lines)
