"""`fit`, `apply`, `compensate` of rational polynomial coefficients: from files to a table."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxbundle.choices import TESTS
from jaxbundle.commands.scanner_inputs import (
    LOCATED_COLUMNS,
    Message,
    check_spheroid,
    geographic,
    ignore,
    open_scanner,
    surface_of,
    with_points,
)
from jaxbundle.commands.scanner_tables import ScannerTable
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.rasters.extent import pole_in_image
from jaxbundle.io.rasters.geoid import undulations_at
from jaxbundle.io.rasters.maps import MapSystem
from jaxbundle.io.scanner.rpc import read_rpc, read_stated_errors, write_rpc
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.leastsquares.quality.distributions import critical_w
from jaxbundle.leastsquares.quality.global_test import contradicts
from jaxbundle.network.columns import Columns
from jaxbundle.pushbroom.rpc.bias import (
    MODELS,
    BiasFit,
    RpcBias,
    apply_bias,
    check_domain,
    fit_bias,
    project_compensated,
)
from jaxbundle.pushbroom.rpc.fitting import RpcCheck, RpcTable, fit_image, fit_rpc
from jaxbundle.pushbroom.rpc.polynomials import Rpc, RpcStatus, locate_points_on, project_points
from jaxbundle.refinement.beyond_priors import describe_beyond
from jaxbundle.refinement.rpc_points import names_of_terms, prior_of_errors
from jaxbundle.system.programs import compile_once
from jaxbundle.types import not_none

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

    - `source`: scanner file, or table longitude, latitude (degrees), height, line, sample; also
      one that `locate` wrote.
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
        raise InputError(f"heights {low:g}, {high:g}: expected two finite numbers, the lower first")
    if path.suffix.lower() == ".csv":
        table, columns = _read_points(path, tell=tell)
        fitted = fit_rpc(table, ridge=ridge, source=columns.source)
    else:
        file = open_scanner(path, tell)
        if file.earth is None:
            raise InputError(f"{path}: a local frame has no longitudes; RPCs need an Earth")
        check_spheroid(file.earth)
        if file.earth != WGS84:
            tell(f"{path}: the ellipsoid is not WGS84, as other programs assume")
        fitted, check = fit_image(file.image, file.earth, (low, high), ridge=ridge)
        pole = pole_in_image(file.image, file.earth)
    if not fitted.converged:
        raise NotSolvedError(
            f"{path}: the fit does not converge; give a larger --ridge than "
            f"{fitted.ridge.max():.3g}, or points over more heights"
        )
    checks = {"fit": fitted.check} | ({"check": check} if check is not None else {})
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
    figures: dict[str, float] = {"points": len(fitted.check.residuals)}
    for name, check_of_fit in checks.items():
        figures |= _figures(name, check_of_fit)
    figures |= {"ridge_line": float(fitted.ridge[0]), "ridge_sample": float(fitted.ridge[1])}
    east, north, *image_columns = fitted.check.table
    values = np.degrees(east), np.degrees(north), *image_columns, *fitted.check.residuals.T
    return ScannerRpc(dict(zip((*COLUMNS, "v_line", "v_sample"), values)), figures, fitted.rpc)


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
    height[, id] (degrees, metres), line, sample[, id], or what `locate` wrote, whose ground is
    projected; surface and `tell` as of `locate`.

    **Raises:** `InputError`, also if no point has a solution.
    """
    unknown = UnknownKeys()
    rpc, table = read_rpc(Path(coefficients), unknown), read_csv(Path(points))
    for message in unknown.messages():
        tell(message)
    is_located = "pixel" in table.values and "sample" not in table.values
    optional = ("id", *LOCATED_COLUMNS, *COLUMNS[3:]) if is_located else ("id",)
    table = _as_rpc_table(table, tell) if is_located else table
    # Of what `locate` wrote the ground is projected, and its lines and pixels are left.
    if "line" in table.values and not {*COLUMNS[:3]} <= {*table.values}:
        table.check_names(("line", "sample"), optional)
        place = [table.numbers(name, required=True) for name in ("line", "sample")]
        surface = surface_of(WGS84, height, dem, rpc, geoid)
        east, north, h, status = map(np.asarray, locate_points_on(rpc, surface, *place))
        columns = dict(zip(COLUMNS, (np.degrees(east), np.degrees(north), h, *place)))
    else:
        table.check_names(COLUMNS[:3], optional)
        place = geographic(table)
        line, sample, status = map(np.asarray, project_points(rpc, *place))
        columns = dict(zip(COLUMNS, (*np.degrees(place[:2]), place[2], line, sample)))
    if (bad := status != RpcStatus.INSIDE).any():
        row = int(bad.argmax())
        fault = (
            f"{table.source(row)}: {RpcStatus(int(status[row])).meaning} "
            f"({bad.sum()} of {len(status)} points)"
        )
        if (status == RpcStatus.NOT_CONVERGED).all():
            raise InputError(f"{fault}; check coordinates and units")
        tell(fault)
    meaning = [RpcStatus(int(s)).meaning for s in status]
    return ScannerTable({"id": _ids(table), **columns, "status": meaning}, {})


def compensate(
    coefficients: str | Path,
    control: str | Path,
    *,
    model: str = "shift",
    sigma: float | None = None,
    snooping: str = "none",
    significance: float = 0.001,
    crs: str | None = None,
    geoid: str | Path | None = None,
    tell: Message = ignore,
) -> ScannerRpc:
    """Remove the bias of coefficients that control points show. Of arrays: `fit_bias`,
    `apply_bias`.

    **Arguments:**

    - `control`: table longitude, latitude, height, line, sample[, id, role, seast, snorth, sheight]
      (degrees, metres, pixels); `role` is `control`, the default, or `check`: compared only.
    - `model`: "shift", "affine" or "quadratic", in the image; `sigma`: of measured lines and
      samples, pixels; 1, a unit of weight that is not tested, if None.
    - `snooping`: "none", "baarda" or "pope": points whose w is beyond the limit of this
      `significance` are left out, the worst one first.
    - `crs`: a projected system, in which the table has x and y instead of longitude and latitude;
      `geoid`: heights are above it, as of `locate`.
    - `tell`: called with every warning: residuals that contradict `sigma`, a bias beyond the errors
      that the coefficients state.

    **Returns:** the compensated coefficients; of every point residuals, of control points
    redundancy numbers and w, and what it was used for; the bias with σ, the RMS of check points.

    **Raises:** `InputError`.
    """
    if snooping not in ("none", *TESTS):
        raise InputError(f"snooping {snooping!r}; expected one of none, {', '.join(TESTS)}")
    if not 0 < significance < 1:
        raise InputError(f"significance is {significance:g}; expected between 0 and 1")
    rpc = read_rpc(Path(coefficients))
    optional = ("id", "role", *GROUND_SIGMA)
    table, columns = _read_points(Path(control), optional, crs, geoid)
    ground = np.zeros((len(columns), 3))
    if any(name in columns.values for name in GROUND_SIGMA):
        ground = np.stack([columns.numbers(name, required=True) for name in GROUND_SIGMA], 1)
    role = _roles(columns)
    check, control_rows = (np.flatnonzero(role == word) for word in ("check", "control"))
    rows_of_table = lambda rows: RpcTable(*(np.asarray(column)[rows] for column in table))
    fit = lambda rows: fit_bias(
        rpc,
        rows_of_table(rows),
        model=model,
        sigma=1.0 if sigma is None else sigma,
        ground_sigma=ground[rows],
        source=columns.source.take(rows),
    )
    if not len(control_rows):
        raise InputError(f"{columns.source.name}: no control point; role is check in all rows")
    compensation = fit(control_rows)
    # The fit has checked the others.
    check_domain(rpc, rows_of_table(check), columns.source.take(check))
    while snooping != "none" and compensation.redundancy > 0:
        w = np.nan_to_num(np.abs(compensation.w))
        limit = critical_w(
            snooping, significance, w.size, compensation.redundancy, compensation.sigma0
        )
        # With one point less at least as many as the bias needs, and one that tests it.
        min_points = len(compensation.cofactor) // 2 + 1
        if w.max() <= limit or len(control_rows) <= min_points:
            break
        worst = int(w.max(1).argmax())
        role[control_rows[worst]] = "removed"
        control_rows = np.delete(control_rows, worst)
        compensation = fit(control_rows)
    if sigma is not None:
        _tell_misfit(compensation, sigma, columns.source.name, tell)
    _tell_beyond_stated(compensation, rpc, Path(coefficients), significance, tell)
    changed, remainder = apply_bias(rpc, compensation.bias)
    # The same terms in lines and in samples.
    k = len(compensation.cofactor) // 2
    names = [f"{axis}_{term}" for axis in ("line", "sample") for term in TERMS[:k]]
    values = [
        float(v) for axis in (compensation.bias.line, compensation.bias.sample) for v in axis[:k]
    ]
    figures = {
        "sigma0": compensation.sigma0,
        "redundancy": compensation.redundancy,
        **dict(zip(names, values)),
    }
    sigmas = np.sqrt(np.diag(compensation.covariance)).tolist()
    figures |= {f"s_{name}": s for name, s in zip(names, sigmas)}
    residuals = _residuals_of_all(rpc, compensation.bias, table)
    figures |= {
        "control_points": len(control_rows),
        "removed_points": int((role == "removed").sum()),
    }
    if len(check):
        rms = np.sqrt(np.mean(residuals[check] ** 2, axis=0))
        figures |= {"check_points": len(check)}
        figures |= {f"check_rms_{a}": float(v) for a, v in zip(("line", "sample"), rms)}
    if remainder is not None:
        figures |= _figures("refit", remainder)
    in_all_rows = lambda values: _in_rows(values, control_rows, len(columns))
    rows: dict[str, Any] = {"id": _ids(columns), "role": role.tolist()}
    for i, axis in enumerate(("line", "sample")):
        rows |= {f"v_{axis}": residuals[:, i]}
        rows |= {f"r_{axis}": in_all_rows(compensation.redundancy_numbers[:, i])}
        rows |= {f"w_{axis}": in_all_rows(compensation.w[:, i])}
    return ScannerRpc(rows, figures, changed)


def _tell_misfit(compensation: BiasFit, sigma: float, name: str, tell: Message) -> None:
    """That residuals of control are larger than their stated σ by more than chance explains."""
    sigma0, redundancy = compensation.sigma0, compensation.redundancy
    if redundancy > 0 and sigma0 > 1 and contradicts(sigma0, redundancy):
        tell(
            f"{name}: residuals are {sigma0:.3g} times as large as --sigma {sigma:g} pixel and the "
            "σ of the points imply (sigma0); look for blunders (--snooping pope) and points of "
            "another image, or give larger σ"
        )


def _tell_beyond_stated(
    compensation: BiasFit, rpc: Rpc, path: Path, significance: float, tell: Message
) -> None:
    """That the bias is beyond the errors that the coefficients state of themselves."""
    errors, terms = read_stated_errors(path), len(compensation.cofactor) // 2
    if not any(errors):
        return
    # What is not stated is not compared.
    degree = next(k for k, number in enumerate(MODELS.values()) if number == terms)
    prior = prior_of_errors(rpc, degree, *(e or np.inf for e in errors))
    bias = np.r_[compensation.bias.line[:terms], compensation.bias.sample[:terms]]
    # The bias is estimated without the prior: its own σ, a priori, adds to that.
    ratio = np.abs(bias) / np.hypot(prior.ravel(), np.sqrt(np.diag(compensation.cofactor)))
    if beyond := describe_beyond(names_of_terms(terms), ratio, significance):
        tell(
            f"{path}: beyond the errors that it states (ERR_BIAS {errors.bias:g} m, ERR_RAND "
            f"{errors.random:g} m; 0: not stated): {beyond}"
        )


def _roles(columns: Columns) -> np.ndarray:
    """What every point is for: control or check."""
    if "role" not in columns.values:
        return np.full(len(columns), "control", object)
    roles = np.array(columns.ids("role"), object)
    if (strange := ~np.isin(roles, ("control", "check"))).any():
        row = int(strange.argmax())
        raise InputError(
            f"{columns.source(row)}: role is {roles[row]!r}; expected control or check"
        )
    return roles


def _residuals_of_all(rpc: Rpc, bias: RpcBias, table: RpcTable) -> np.ndarray:
    """Computed with the bias minus measured, of all points [n, 2]."""
    computed = _images(rpc, bias, *map(np.asarray, table[:3]))
    return np.stack([np.asarray(c) - m for c, m in zip(computed, table[3:])], 1)


_images = compile_once(jax.vmap(project_compensated, (None, None, 0, 0, 0)), ())


def _in_rows(values: np.ndarray, rows: np.ndarray, number: int) -> np.ndarray:
    """Values of some rows among all, NaN for the others."""
    column = np.full(number, np.nan)
    column[rows] = values
    return column


def _read_points(
    path: Path,
    optional: tuple[str, ...] = ("id",),
    crs: str | None = None,
    geoid: str | Path | None = None,
    tell: Message = ignore,
) -> tuple[RpcTable, Columns]:
    columns = read_csv(path)
    if "pixel" in columns.values and "sample" not in columns.values:
        columns, optional = _as_rpc_table(columns, tell), (*optional, *LOCATED_COLUMNS)
    names = COLUMNS if crs is None else ("x", "y", *COLUMNS[2:])
    columns.check_names(names, optional)
    if crs is None:
        east, north, height = geographic(columns)
    else:
        x, y, height = (columns.numbers(name, required=True) for name in names[:3])
        transformer = not_none(MapSystem(WGS84, crs).transformer)
        if not_none(transformer.target_crs).is_vertical:
            # Its heights would be taken for heights above the ellipsoid.
            raise InputError(
                f"--crs {crs}: has a system of heights; give its horizontal part, and --geoid for "
                "heights that are not above the ellipsoid"
            )
        east, north = np.radians(transformer.transform(x, y, direction="INVERSE"))
        if (bad := ~(np.isfinite(east) & np.isfinite(north))).any():
            row = int(bad.argmax())
            raise InputError(
                f"{columns.source(row)}: x, y are no place of {crs}; check their order"
            )
    if geoid is not None:
        N = undulations_at(Path(geoid), np.degrees(east), np.degrees(north))
        if (is_missing := ~np.isfinite(N)).any():
            row = int(is_missing.argmax())
            raise InputError(f"{columns.source(row)}: {geoid} has no height of the geoid there")
        height = height + N
    measured = (columns.numbers(name, required=True) for name in COLUMNS[3:])
    return RpcTable(east, north, height, *measured), columns


def _as_rpc_table(table: Columns, tell: Message) -> Columns:
    """A table that `locate` wrote: `pixel` is the sample; rows without a point are left out."""
    table = with_points(table, tell)
    values = {"sample" if name == "pixel" else name: x for name, x in table.values.items()}
    if "height" in values:
        # Of one --height they differ by the last digits of the intersection, which are no range.
        values["height"] = np.round(table.numbers("height"), 6)
    return Columns(values, table.source)


def _ids(columns: Columns) -> Sequence[str]:
    has_ids = "id" in columns.values
    return columns.ids("id") if has_ids else [str(k + 1) for k in range(len(columns))]


def _figures(name: str, check: RpcCheck) -> dict[str, float]:
    axes = ("line", "sample")
    figures = {f"{name}_rms_{axis}": float(v) for axis, v in zip(axes, check.rms)}
    return figures | {f"{name}_largest_{axis}": float(v) for axis, v in zip(axes, check.largest)}
