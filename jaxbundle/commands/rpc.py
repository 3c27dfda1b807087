"""`fit`, `apply`, `compensate` of rational polynomial coefficients: from files to a table."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.commands.scanner_inputs import (
    Message,
    check_spheroid,
    geographic,
    ignore,
    open_scanner,
    surface_of,
)
from jaxbundle.commands.scanner_tables import ScannerTable
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.rasters.extent import pole_in_image
from jaxbundle.io.scanner.rpc import read_rpc, write_rpc
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.network.columns import Columns
from jaxbundle.pushbroom.rpc.bias import apply_bias, fit_bias
from jaxbundle.pushbroom.rpc.fitting import RpcCheck, RpcTable, fit_image, fit_rpc
from jaxbundle.pushbroom.rpc.polynomials import Rpc, RpcStatus, locate_points_on, project_points

COLUMNS = ("longitude", "latitude", "height", "line", "sample")
GROUND_SIGMA = ("seast", "snorth", "sheight")
TERMS = ("shift", "by_line", "by_sample", "by_line_line", "by_line_sample", "by_sample_sample")


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ScannerRpc(ScannerTable):
    """Coefficients with the table they come from: `figures` of the whole, `columns` of its
    points."""

    rpc: Rpc

    def write(self, path: str | Path) -> None:
        """Write the coefficients: .txt, .rpb, or the tags of an existing .tif.

        **Raises:** `InputError`."""
        write_rpc(Path(path), self.rpc)

    def __str__(self) -> str:
        return "\n".join(f"{name:22} {value:.6g}" for name, value in self.figures.items())


def fit(
    source: str | Path,
    *,
    heights: tuple[float, float] = (0.0, 3000.0),
    ridge: float | None = None,
    tell: Message = ignore,
) -> ScannerRpc:
    """Fit coefficients to a scanner file or a table. Of arrays: `fit_rpc`, `fit_image`.

    **Arguments:**

    - `source`: scanner file, or table longitude, latitude (degrees), height, line, sample.
    - `heights`: of the ground, low and high, metres above the ellipsoid.
    - `ridge`: ridge parameter, in units of the normalised equations; automatic if None.
    - `tell`: called with every warning.

    **Returns:** residuals v_line, v_sample of all points, in pixels; figures of them, and of a
    check between the points of a scanner file.

    **Raises:** `InputError`; `NotSolvedError` if the fit does not converge.
    """
    path, check, pole = Path(source), None, None
    low, high = heights
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(
            f"heights {low:g}, {high:g}: two finite numbers, the lower first, are expected"
        )
    if path.suffix.lower() == ".csv":
        table, columns = _read_points(path)
        found = fit_rpc(table, ridge=ridge, source=columns.source)
    else:
        file = open_scanner(path, tell)
        if file.earth is None:
            raise InputError(f"{path}: a local frame has no longitudes; RPCs need an Earth")
        check_spheroid(file.earth)
        if file.earth != WGS84:
            tell(f"{path}: the ellipsoid is not WGS84, as other programs assume")
        found, check = fit_image(file.image, file.earth, (low, high), ridge=ridge)
        pole = pole_in_image(file.image, file.earth)
    if not found.converged:
        raise NotSolvedError(
            f"{path}: the fit does not converge; give a larger --ridge than "
            f"{found.ridge.max():.3g}, or points over more heights"
        )
    checks = {"fit": found.check} | ({"check": check} if check is not None else {})
    largest = max(c.largest.max() for c in checks.values())
    if largest > 0.5:  # pixel: places may then fall into the neighbouring one
        reason = "the coefficients do not follow jitter faster than a cubic over the image"
        if pole is not None:
            reason = (
                f"it shows the {pole}, where no polynomials of longitude and latitude follow it"
            )
        tell(
            f"{path}: residuals up to {largest:.3g} pixel: {reason}; cut it into shorter pieces, "
            "or use the rigorous model"
        )
    figures: dict[str, float] = {"points": len(found.check.residuals)}
    for name, one in checks.items():
        figures |= _figures(name, one)
    figures |= {"ridge_line": float(found.ridge[0]), "ridge_sample": float(found.ridge[1])}
    east, north, *rest = found.check.table
    values = np.degrees(east), np.degrees(north), *rest, *found.check.residuals.T
    return ScannerRpc(dict(zip((*COLUMNS, "v_line", "v_sample"), values)), figures, found.rpc)


def apply(
    coefficients: str | Path,
    points: str | Path,
    *,
    height: float | None = None,
    dem: str | Path | None = None,
    geoid: str | Path | None = None,
    tell: Message = ignore,
) -> ScannerTable:
    """Project ground points to the image, or locate image positions on a surface. Of arrays:
    `project_points`, `locate_points_on`.

    **Arguments:** `coefficients`: any file that holds some; `points`: table longitude, latitude,
    height[, id] (degrees, metres), or line, sample[, id]; surface and `tell` as of `locate`.

    **Raises:** `InputError`, also if no point has a solution.
    """
    unknown = UnknownKeys()
    given, table = read_rpc(Path(coefficients), unknown), read_csv(Path(points))
    for message in unknown.messages():
        tell(message)
    if "line" in table.values:
        table.check_names(("line", "sample"), ("id",))
        place = [table.numbers(name, required=True) for name in ("line", "sample")]
        surface = surface_of(WGS84, height, dem, given, geoid)
        east, north, h, status = map(np.asarray, locate_points_on(given, surface, *place))
        columns = dict(zip(COLUMNS, (np.degrees(east), np.degrees(north), h, *place)))
    else:
        table.check_names(COLUMNS[:3], ("id",))
        place = geographic(table)
        line, sample, status = map(np.asarray, project_points(given, *place))
        columns = dict(zip(COLUMNS, (*np.degrees(place[:2]), place[2], line, sample)))
    if (bad := status != RpcStatus.INSIDE).any():
        row = int(bad.argmax())
        said = (
            f"{table.source(row)}: {RpcStatus(int(status[row])).meaning} "
            f"({bad.sum()} of {len(status)} points)"
        )
        if (status == RpcStatus.NOT_CONVERGED).all():
            raise InputError(f"{said}; check coordinates and units")
        tell(said)
    meaning = [RpcStatus(int(s)).meaning for s in status]
    return ScannerTable({"id": _ids(table), **columns, "status": meaning}, {})


def compensate(
    coefficients: str | Path,
    control: str | Path,
    *,
    model: str = "shift",
    sigma: float = 1.0,
) -> ScannerRpc:
    """Remove the bias of coefficients that control points show. Of arrays: `fit_bias`,
    `apply_bias`.

    **Arguments:** `control`: table longitude, latitude, height, line, sample[, id, seast, snorth,
    sheight] (degrees, metres, pixels); `model`: "shift", "affine" or "quadratic", in the image;
    `sigma`: of measured lines and samples, pixels.

    **Returns:** the compensated coefficients; of every control point residuals, redundancy numbers
    and w; the bias with σ.

    **Raises:** `InputError`.
    """
    given = read_rpc(Path(coefficients))
    table, columns = _read_points(Path(control), ("id", *GROUND_SIGMA))
    ground = None
    if any(name in columns.values for name in GROUND_SIGMA):
        ground = np.stack([columns.numbers(name, required=True) for name in GROUND_SIGMA], 1)
    found = fit_bias(
        given, table, model=model, sigma=sigma, ground_sigma=ground, source=columns.source
    )
    changed, left = apply_bias(given, found.bias)
    # the same terms in lines and in samples
    k = len(found.cofactor) // 2
    names = [f"{axis}_{term}" for axis in ("line", "sample") for term in TERMS[:k]]
    values = [float(v) for axis in (found.bias.line, found.bias.sample) for v in axis[:k]]
    figures = {"sigma0": found.sigma0, "redundancy": found.redundancy, **dict(zip(names, values))}
    sigmas = np.sqrt(np.diag(found.covariance)).tolist()
    figures |= {f"s_{name}": s for name, s in zip(names, sigmas)}
    if left is not None:
        figures |= _figures("refit", left)
    rows = {"id": _ids(columns)}
    for i, axis in enumerate(("line", "sample")):
        rows |= {f"v_{axis}": found.residuals[:, i], f"r_{axis}": found.redundancy_numbers[:, i]}
        rows |= {f"w_{axis}": found.w[:, i]}
    return ScannerRpc(rows, figures, changed)


def _read_points(path: Path, optional: tuple[str, ...] = ()) -> tuple[RpcTable, Columns]:
    columns = read_csv(path)
    columns.check_names(COLUMNS, ("id", *optional))
    measured = (columns.numbers(name, required=True) for name in COLUMNS[3:])
    return RpcTable(*geographic(columns), *measured), columns


def _ids(columns: Columns) -> Sequence[str]:
    given = "id" in columns.values
    return columns.ids("id") if given else [str(k + 1) for k in range(len(columns))]


def _figures(name: str, check: RpcCheck) -> dict[str, float]:
    axes = ("line", "sample")
    told = {f"{name}_rms_{axis}": float(v) for axis, v in zip(axes, check.rms)}
    return told | {f"{name}_largest_{axis}": float(v) for axis, v in zip(axes, check.largest)}
