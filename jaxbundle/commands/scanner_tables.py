"""`locate`, `project`, `accuracy` of line scanners: from files to a table."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.commands.scanner_inputs import (
    OFF_IMAGE,
    Message,
    ignore,
    off_image,
    open_image,
    open_scanner,
    places,
    points_of,
    surface_of,
    surface_under,
    with_points,
)
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns
from jaxbundle.pushbroom.error_propagation import (
    ground_errors,
    propagate_accuracy,
    simulate_accuracy,
    spread_positions,
)
from jaxbundle.pushbroom.ground_to_image import ProjectionStatus, make_search, project_points
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.noise import Noise
from jaxbundle.pushbroom.rpc.image import RpcImage, heights_in_words, locate_rpc_points
from jaxbundle.pushbroom.rpc.polynomials import RpcStatus
from jaxbundle.pushbroom.rpc.polynomials import project_points as rpc_project_points
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.pushbroom.terrain import Terrain
from jaxbundle.results import TableMethods
from jaxbundle.types import Column

GAP_REASON = "found beyond a place without height"
# Lines that see one point: several do where they overlap, as of a platform that sways.
MAX_IMAGES = 4
NO_RAY = "no ray meets the surface: check attitude, mounting and height"
# The RMS of n draws is uncertain by up to 1/√n, here 22 %.
MIN_DRAWS = 20


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ScannerTable(TableMethods):
    """A table of positions: `columns` by name, and `figures` of the whole."""

    columns: Mapping[str, Column]
    figures: Mapping[str, Any]

    def table(self) -> dict[str, np.ndarray]:
        """The columns as arrays."""
        return {name: np.asarray(column) for name, column in self.columns.items()}

    def to_dict(self) -> dict[str, Any]:
        """Figures and rows as plain dicts and numbers, as in JSON."""
        columns = [column.tolist() for column in self.table().values()]
        rows = [dict(zip(self.columns, row)) for row in zip(*columns)]
        return without_nan({**self.figures, "rows": rows})

    def __str__(self) -> str:
        """The table as CSV; NaN is an empty cell."""
        rows = [",".join(self.columns)]
        for row in zip(*(column.tolist() for column in self.table().values())):
            rows.append(",".join("" if v != v else str(v) for v in row))
        return "\n".join(rows)


def locate(
    scanner: str | Path,
    *,
    points: str | Path | None = None,
    grid: tuple[int, int] = (11, 11),
    height: float | None = None,
    dem: str | Path | None = None,
    geoid: str | Path | None = None,
    tell: Message = ignore,
) -> ScannerTable:
    """Locate image positions of a scanner file on the ground; (0, 0) is the centre of the first
    pixel. Of arrays: `locate_points`.

    **Arguments:**

    - `scanner`: scanner file, product file, or an image with rational polynomials: its raster or
      the file of the coefficients.
    - `points`: table line, pixel[, id]; without it a `grid` of lines × pixels over the image.
    - `height`: of the ground, metres above the ellipsoid (Z in a local frame), default 0, or, where
      polynomials, or those of its product, do not hold for 0, the middle of their heights; or
      `dem`: terrain raster, with `geoid`: geoid heights, where its heights are orthometric.
    - `tell`: called with every warning.

    **Returns:** columns line, pixel, X, Y, Z, on the Earth longitude, latitude (degrees), height,
    and status.

    **Raises:** `InputError`, also if no position meets the surface.
    """
    file = open_image(scanner, tell)
    surface = surface_under(file, height, dem, geoid, tell)
    ids, line, pixel, source = places(file.image, points, grid)
    is_off = off_image(file.image, line, pixel, source, tell)
    X, extrapolated = _locate(file.image, surface, line, pixel)
    X[:, is_off] = np.nan
    missed = np.isnan(X).any(0) & ~is_off
    is_outside_terrain = np.zeros_like(missed)
    if isinstance(surface, Terrain):
        strict = dataclasses.replace(surface, over_voids=False)
        is_outside_terrain = ~(missed | is_off) & np.isnan(
            _locate(file.image, strict, line, pixel)[0]
        ).any(0)
    extrapolated &= ~is_off
    if extrapolated.any() and isinstance(file.image, RpcImage):
        tell(
            f"{source(int(extrapolated.argmax()))}: {_extrapolated(file.image)} "
            f"({extrapolated.sum()} of {len(line)} points)"
        )
    reason = "no terrain there" if dem else "misses the surface"
    if missed.any():
        row = int(missed.argmax())
        remedy = (
            f"give a model that covers the image instead of {dem}"
            if dem
            else "check attitude, mounting and height"
        )
        message = (
            f"{source(row)}: the ray of line {line[row]:g}, pixel {pixel[row]:g}: {reason}; "
            f"{remedy} ({missed.sum()} of {len(line)} points)"
        )
        if (missed | is_off).all():
            raise InputError(message)
        tell(message)
    columns: dict[str, Column] = {"id": ids} if ids else {}
    columns |= {"line": line, "pixel": pixel, "X": X[0], "Y": X[1], "Z": X[2]}
    if file.earth is not None and file.earth.a == file.earth.b:
        longitude, latitude, h = (np.asarray(v) for v in jax.jit(geodetic)(file.earth, tuple(X)))
        columns |= {"longitude": np.degrees(longitude), "latitude": np.degrees(latitude)}
        columns |= {"height": h}
    reasons = [OFF_IMAGE, reason, GAP_REASON, RpcStatus.OUTSIDE.meaning]
    columns["status"] = np.select(
        [is_off, missed, is_outside_terrain, extrapolated], reasons, "found"
    ).tolist()
    return ScannerTable(columns, {"scanner": file.name})


def _locate(
    image: PushbroomImage | RpcImage,
    surface: GroundSurface,
    line: Float[np.ndarray, " n"],
    pixel: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "3 n"], Bool[np.ndarray, " n"]]:
    """The points, and which of them polynomials extrapolate."""
    if isinstance(image, RpcImage):
        X, status = jax.jit(locate_rpc_points)(image, surface, line, pixel)
        return np.array(X), np.asarray(status) == RpcStatus.OUTSIDE
    return np.array(jax.jit(locate_points)(image, surface, line, pixel)), np.zeros(len(line), bool)


def _extrapolated(image: RpcImage) -> str:
    heights = heights_in_words(image.rpc)
    return f"{RpcStatus.OUTSIDE.meaning}; they hold for heights from {heights} m"


def project(scanner: str | Path, points: str | Path, *, tell: Message = ignore) -> ScannerTable:
    """Project ground points into the image of a scanner file: a row for every line that sees one.
    Of arrays: `project_points`.

    **Arguments:** `scanner`: as of `locate`; `points`: table X, Y, Z[, id] (m) or longitude,
    latitude, height[, id] (degrees); `tell`: called with every warning.

    **Returns:** columns id, line, pixel, count (of lines that see the point), status.

    **Raises:** `InputError`, also if no point is in the image.
    """
    file = open_image(scanner, tell)
    table = with_points(read_csv(Path(points)), tell)
    X = points_of(table, file.earth)
    if isinstance(file.image, RpcImage):
        return ScannerTable(_project_rpc(file.image, table, X, tell), {"scanner": file.name})
    search = make_search(file.image, file.earth)
    projected = project_points(file.image, search, X, most=MAX_IMAGES)
    line, pixel = np.asarray(projected.line), np.asarray(projected.pixel)
    status, count = np.asarray(projected.status), np.asarray(projected.count)
    if (status != ProjectionStatus.SEEN).all():
        raise InputError(
            f"{table.source(0)}: no point is in the image; this one is "
            f"{ProjectionStatus(int(status[0])).meaning}: check coordinates, frame and units"
        )
    unseen = np.flatnonzero(status != ProjectionStatus.SEEN)
    if len(unseen):
        first = unseen[0]
        tell(
            f"{table.source(first)}: not in the image but "
            f"{ProjectionStatus(int(status[first])).meaning} "
            f"({len(unseen)} of {len(status)} points)"
        )
    first = (np.arange(MAX_IMAGES) == 0)[:, None]
    solution, point = np.nonzero(~np.isnan(line) | (first & (count == 0)))
    order = np.lexsort((solution, point))
    solution, point = solution[order], point[order]
    ids = table.ids("id") if "id" in table.values else [str(k + 1) for k in range(len(status))]
    columns = {
        "id": [ids[p] for p in point],
        "line": line[solution, point],
        "pixel": pixel[solution, point],
        "count": count[point],
        "status": [ProjectionStatus(int(status[p])).meaning for p in point],
    }
    return ScannerTable(columns, {"scanner": file.name})


def _project_rpc(
    image: RpcImage, table: Columns, X: Float[np.ndarray, "3 n"], tell: Message
) -> dict[str, Column]:
    """The columns of `project` for rational polynomials, a row for every point.

    **Raises:** `InputError`, if no point is in the image."""
    place = jax.jit(geodetic)(WGS84, tuple(X))
    line, pixel, status = (np.array(v) for v in rpc_project_points(image.rpc, *place))
    is_seen = (line >= -0.5) & (line <= image.lines - 0.5)
    is_seen &= (pixel >= -0.5) & (pixel <= image.pixels - 0.5) & (status != RpcStatus.NOT_CONVERGED)
    extrapolated = status != RpcStatus.INSIDE
    if not image.sized:
        is_seen = ~extrapolated
    if not is_seen.any():
        raise InputError(
            f"{table.source(0)}: no point is in the image; this one is at line {line[0]:.6g}, "
            f"pixel {pixel[0]:.6g} of {image.lines} × {image.pixels}: check coordinates, frame and "
            "units"
        )
    outside_words = f"not in the image of {image.lines} × {image.pixels}"
    for rows, words in (
        (~is_seen, outside_words if image.sized else RpcStatus.OUTSIDE.meaning),
        (is_seen & extrapolated, _extrapolated(image)),
    ):
        if rows.any():
            tell(
                f"{table.source(int(rows.argmax()))}: {words} ({rows.sum()} of {len(is_seen)} "
                "points)"
            )
    line[~is_seen], pixel[~is_seen] = np.nan, np.nan
    words = [OFF_IMAGE if image.sized else RpcStatus.OUTSIDE.meaning, RpcStatus.OUTSIDE.meaning]
    return {
        "id": table.ids("id")
        if "id" in table.values
        else [str(k + 1) for k in range(len(is_seen))],
        "line": line,
        "pixel": pixel,
        "count": is_seen.astype(int),
        "status": np.select(
            [~is_seen, extrapolated], words, ProjectionStatus.SEEN.meaning
        ).tolist(),
    }


def check_draws(draws: int) -> None:
    """Refuse a Monte Carlo simulation of too few draws; 0: none is wanted."""
    if 0 < draws < MIN_DRAWS:
        raise InputError(
            f"--draws {draws}: too few for an RMS; at least {MIN_DRAWS}, 1000 are accurate to 3 %"
        )


def accuracy(  # noqa: PLR0913 (public: the options of the command, all but one by name)
    scanner: str | Path,
    *,
    truth: str | Path | None = None,
    attitude_bias: float = 0.0,
    attitude_drift: float = 0.0,
    attitude_white: float = 0.0,
    position_bias: float = 0.0,
    position_drift: float = 0.0,
    position_white: float = 0.0,
    draws: int = 0,
    seed: int = 0,
    grid: tuple[int, int] = (11, 11),
    height: float | None = None,
    dem: str | Path | None = None,
    geoid: str | Path | None = None,
    tell: Message = ignore,
) -> ScannerTable:
    """Ground RMS and CE90 for given σ of the ancillary data, or errors against a known truth; of
    about a thousand irregular positions, so that none of them falls in step with the records.

    **Arguments:**

    - `scanner`: scanner file; `truth`: that of the truth, whose errors need no σ.
    - `attitude_…`, `position_…`: σ in degrees and metres, of drifts per second.
    - `draws`: of a Monte Carlo simulation in addition to propagation; `seed`: of it.
    - `grid`: parts of the image, lines × pixels, a row of the table each.
    - `height`, `dem`, `geoid`: as of `locate`.

    **Raises:** `InputError`.
    """
    check_draws(draws)
    degree = np.pi / 180
    noise = Noise(
        degree * attitude_bias,
        degree * attitude_drift,
        degree * attitude_white,
        position_bias,
        position_drift,
        position_white,
    )
    if truth is not None:
        _refuse_beside_truth(noise, draws)
    file = open_scanner(scanner, tell)
    surface = surface_of(file.earth, height, dem, file.image, geoid)
    size = file.image.lines, file.image.pixels
    line, pixel = (v.ravel() for v in spread_positions(*size, grid))
    row, column = ((np.arange(k) + 0.5) * n / k - 0.5 for k, n in zip(grid, size))
    columns: dict[str, Column] = {
        "line": np.repeat(row, len(column)),
        "pixel": np.tile(column, len(row)),
    }
    by_cell = lambda values: np.asarray(values).reshape(len(row) * len(column), -1)
    count_finite = lambda values: np.isfinite(values).sum(1)
    # A cell where every ray misses the surface has no mean.
    mean = lambda values: (
        np.nansum(values, 1) / np.where(count_finite(values) > 0, count_finite(values), np.nan)
    )
    rms = lambda values: np.sqrt(mean(values**2))
    if truth is not None:
        true = open_scanner(truth, tell).image
        errors = ground_errors(file.image, true, surface, line, pixel)
        length = np.hypot(*errors.T)
        columns |= {
            "east": mean(by_cell(errors[:, 0])),
            "north": mean(by_cell(errors[:, 1])),
            "error": rms(by_cell(length)),
        }
        if not np.isfinite(length).any():
            raise InputError(NO_RAY)
        figures = {
            "rms": float(np.sqrt(np.nanmean(length**2))),
            "ce90": float(np.nanquantile(length, 0.9)),
        }
    else:
        if not any(noise):
            raise InputError("no σ is given: --attitude-white 0.01, for example, or --truth FILE")
        if isinstance(surface, Terrain):
            raise InputError("--dem: use --height with σ; terrain has no reverse mode")
        propagated = propagate_accuracy(file.image, surface, line, pixel, noise)
        columns |= {"rms": rms(by_cell(propagated.rms)), "ce90": mean(by_cell(propagated.ce90))}
        figures = {"rms": propagated.overall, "ce90": propagated.overall_ce90}
        if np.isnan(propagated.overall):
            raise InputError(NO_RAY)
        if draws:
            simulated = simulate_accuracy(file.image, surface, line, pixel, noise, draws, seed)
            columns |= {
                "drawn_rms": rms(by_cell(simulated.rms)),
                "drawn_ce90": mean(by_cell(simulated.ce90)),
            }
            figures |= {
                "drawn_rms": simulated.overall,
                "drawn_ce90": simulated.overall_ce90,
                "draws": draws,
            }
    return ScannerTable(columns, {"scanner": file.name, **figures, "positions": len(line)})


def _refuse_beside_truth(noise: Noise, draws: int) -> None:
    """Refuse σ of errors, or draws of them, where the truth shows the errors themselves."""
    for name, value in (*noise._asdict().items(), ("draws", draws)):
        if value:
            option = f"--{name.replace('_', '-')}"
            raise InputError(
                f"--truth and {option}: errors against a truth do not depend on {option}; give "
                "one of them"
            )
