"""`jaxbundle pushbroom rpc`: fit, apply and compensate rational polynomial coefficients."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import RPC_BIASES
from jaxbundle.cli.app import Application, choice
from jaxbundle.cli.pushbroom.app import Csv, Dem, Geoid, Json, Level, pushbroom
from jaxbundle.errors import InputError, NotSolvedError

rpc = Application(help="Rational polynomial coefficients (RPC00B).")
pushbroom.add_typer(rpc, name="rpc")

GROUND_SIGMA = ("seast", "snorth", "sheight")
TERMS = ("shift", "by_line", "by_sample", "by_line_line", "by_line_sample", "by_sample_sample")

RpcFile = Annotated[
    Path,
    typer.Argument(
        help="coefficients: _RPC.TXT, .RPB, a tagged GeoTIFF, XML of DIMAP or DigitalGlobe, .geom"
    ),
]
Figures = Annotated[str, typer.Option(help="figures and all points as JSON; - for standard output")]
Out = Annotated[Path, typer.Option(help="file for the coefficients: .txt, .rpb, an existing .tif")]


@rpc.command(example="out/flight/scanner.toml --out out/image_RPC.TXT")
def fit(
    source: Annotated[
        Path, typer.Argument(help="scanner file, or table longitude,latitude,height,line,sample")
    ],
    out: Out,
    heights: Annotated[
        str, typer.Option(help="LOW:HIGH of the ground, metres above the ellipsoid")
    ] = "0:3000",
    ridge: Annotated[
        float | None, typer.Option(min=0, help="ridge parameter; default: automatic")
    ] = None,
    json: Figures = "",
) -> None:
    """Fit coefficients to a scanner or a table; print the residuals in pixels."""
    from jaxbundle.cli.pushbroom.rpc_tables import figures_of, heights_of, table_of, tell
    from jaxbundle.cli.pushbroom.shared import check_spheroid, keep_inputs, open_scanner, warn
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io.scanner.rpc import write_rpc
    from jaxbundle.pushbroom.rpc_fit import fit_image, fit_rpc

    keep_inputs([source], out=out, json=json)
    head = {}
    if source.suffix.lower() == ".csv":
        table, columns = table_of(source)
        found = fit_rpc(table, ridge=ridge, source=columns.source)
    else:
        file = open_scanner(source)
        if file.earth is None:
            raise InputError(f"{source}: a local frame has no longitudes; RPCs need an Earth")
        check_spheroid(file.earth)
        if file.earth != WGS84:
            warn(f"{source}: the ellipsoid is not WGS84, as other programs assume")
        found, check = fit_image(file.image, file.earth, heights_of(heights), ridge=ridge)
        head = figures_of("check", check)
    if not found.converged:
        raise NotSolvedError(
            f"{source}: the fit does not converge; give a larger --ridge than "
            f"{found.ridge.max():.3g}, or points over more heights"
        )
    write_rpc(out, found.rpc)
    largest = max(found.check.largest.max(), *(v for k, v in head.items() if "largest" in k), 0.0)
    if largest > 0.5:  # pixel: places may then fall into the neighbouring one
        warn(
            f"{source}: residuals up to {largest:.3g} pixel: the coefficients do not follow "
            "jitter faster than a cubic over the image; cut it into shorter pieces, or use the "
            "rigorous model"
        )
    head = {"points": len(found.check.residuals), **figures_of("fit", found.check), **head}
    head |= {"ridge_line": found.ridge[0], "ridge_sample": found.ridge[1]}
    tell(head, json, found.check)


@rpc.command(example="out/image_RPC.TXT --points points.csv")
def apply(
    coefficients: RpcFile,
    points: Annotated[
        Path,
        typer.Option(help="longitude,latitude,height[,id] (degrees, metres), or line,sample[,id]"),
    ],
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Project ground points to the image, or locate image positions on a surface."""
    import numpy as np

    from jaxbundle.cli.pushbroom.rpc_tables import COLUMNS
    from jaxbundle.cli.pushbroom.shared import geographic, keep_inputs, surface_of, warn, write_rows
    from jaxbundle.geometry.ellipsoid import WGS84
    from jaxbundle.io.scanner.rpc import read_rpc
    from jaxbundle.io.text.csv_tables import read_csv
    from jaxbundle.pushbroom.rpc import RpcStatus, locate_points_on, project_points

    keep_inputs([coefficients, points, dem], csv=csv, json=json)
    given, table = read_rpc(coefficients), read_csv(points)
    ids = table.ids("id") if "id" in table.values else [str(k + 1) for k in range(len(table))]
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
        warn(said)
    meaning = [RpcStatus(int(s)).meaning for s in status]
    write_rows({"id": ids, **columns, "status": meaning}, csv, json)


@rpc.command(example="out/image_RPC.TXT --control control.csv --out out/shifted_RPC.TXT")
def compensate(
    coefficients: RpcFile,
    control: Annotated[
        Path,
        typer.Option(help="table longitude,latitude,height,line,sample[,id,seast,snorth,sheight]"),
    ],
    out: Out,
    model: Annotated[str, choice(RPC_BIASES, "in the image")] = "shift",
    sigma: Annotated[float, typer.Option(help="σ of measured lines and samples, pixels")] = 1.0,
    csv: Csv = None,
    json: Figures = "",
) -> None:
    """Remove the bias found by control points; print residuals, redundancy numbers and w."""
    import numpy as np

    from jaxbundle.cli.pushbroom.rpc_tables import figures_of, table_of
    from jaxbundle.cli.pushbroom.shared import keep_inputs, write_rows
    from jaxbundle.io.scanner.rpc import RASTERS, read_rpc, write_rpc
    from jaxbundle.pushbroom.rpc_bias import apply_bias, fit_bias

    # the tags of a raster may be replaced in place
    keep_inputs([control], out=out, csv=csv, json=json)
    keep_inputs([coefficients], csv=csv, json=json, out=None if out.suffix in RASTERS else out)
    given = read_rpc(coefficients)
    table, columns = table_of(control, ("id", *GROUND_SIGMA))
    ground = None
    if any(name in columns.values for name in GROUND_SIGMA):
        ground = np.stack([columns.numbers(name, required=True) for name in GROUND_SIGMA], 1)
    found = fit_bias(
        given, table, model=model, sigma=sigma, ground_sigma=ground, source=columns.source
    )
    changed, left = apply_bias(given, found.bias)
    write_rpc(out, changed)
    # the same terms in lines and in samples
    k = len(found.cofactor) // 2
    names = [f"{axis}_{term}" for axis in ("line", "sample") for term in TERMS[:k]]
    values = [float(v) for axis in (found.bias.line, found.bias.sample) for v in axis[:k]]
    head = {"sigma0": found.sigma0, "redundancy": found.redundancy, **dict(zip(names, values))}
    sigmas = np.sqrt(np.diag(found.covariance)).tolist()
    head |= {f"s_{name}": s for name, s in zip(names, sigmas)}
    if left is not None:
        head |= figures_of("refit", left)
    ids = columns.ids("id") if "id" in columns.values else [str(i + 1) for i in range(len(columns))]
    rows = {"id": ids}
    for i, axis in enumerate(("line", "sample")):
        rows |= {f"v_{axis}": found.residuals[:, i], f"r_{axis}": found.redundancy_numbers[:, i]}
        rows |= {f"w_{axis}": found.w[:, i]}
    write_rows(rows, csv, json, head)
    if json != "-":
        typer.echo("; ".join(f"{k} {v:.6g}" for k, v in head.items()), err=True)
