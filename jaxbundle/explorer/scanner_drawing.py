"""What the line scanner explorer draws: track and attitude trajectories, footprints on the ground,
the error map, the accuracy table."""

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxbundle.geometry import omega_phi_kappa_from_matrix
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed, geodetic
from jaxbundle.pushbroom.error_propagation import east_north
from jaxbundle.pushbroom.image import PushbroomImage, pose_at, recorded_pose
from jaxbundle.pushbroom.image_to_ground import locate_points
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.pushbroom.trajectory import orbital_frame
from jaxbundle.report.layout import significant
from jaxbundle.report.page.charts import ChartLayout, Curve, draw_curves, draw_field, draw_plan
from jaxbundle.report.page.markup import figure, grid, paragraph

# The index of an angle in an attitude error: about right (pitch), forward (roll), up (yaw).
ANGLES = {"roll": 1, "pitch": 0, "yaw": 2}


def draw_flight(
    image: PushbroomImage, truth: PushbroomImage, earth: Ellipsoid | None, places: int = 240
) -> str:
    """The ends of the track; roll, pitch and yaw over the lines, true and as recorded, in the
    orbital or the local frame."""
    lines = np.linspace(0, image.lines - 1, places)
    angles = [
        np.degrees(_angles(image_or_truth, jnp.asarray(lines), earth is not None))
        for image_or_truth in (truth, image)
    ]
    charts = []
    for name, k in ANGLES.items():
        curves = [
            Curve(label, lines, values[k], None, kind)
            for values, label, kind in zip(angles, ("true", "recorded"), ("second", "first"))
        ]
        chart = draw_curves(curves, "line", f"{name} [°]", layout=ChartLayout(height=220))
        charts.append(figure(chart, name))
    ends = np.array(_positions(truth, jnp.asarray([0.0, image.lines - 1.0])))
    if earth is None:
        header = ("track", "X [m]", "Y [m]", "Z [m]")
        rows = [[f"{v:.3f}" for v in P] for P in ends]
    else:
        header = ("track", "longitude [°]", "latitude [°]", "height [m]")
        geodetic_ends = np.array([[float(v) for v in geodetic(earth, tuple(P))] for P in ends])
        rows = [
            (f"{np.degrees(a):.6f}", f"{np.degrees(b):.6f}", f"{h:.1f}")
            for a, b, h in geodetic_ends
        ]
    seconds = float(image.times.time(image.lines - 1.0) - image.times.time(0.0))
    length = np.linalg.norm(ends[1] - ends[0])
    length_and_speed = f"{seconds:.6g} s, {length:.6g} m"
    if seconds > 0:
        length_and_speed += f", {length / seconds:.6g} m/s"
    return (
        grid(header, [("first line", *rows[0]), ("last line", *rows[1])])
        + paragraph(f"From the first line to the last: {length_and_speed}.", "hint")
        + f'<div class="pictures">\n{"".join(charts)}</div>\n'
    )


def draw_ground(
    image: PushbroomImage, truth: PushbroomImage, surface: GroundSurface, earth: Ellipsoid | None
) -> str:
    """The footprints of an image and its truth, and the track below or above the ground."""
    # The last place is the middle of the image, from which east and north are counted.
    size = image.lines, image.pixels
    border = [np.append(v, (n - 1) / 2) for v, n in zip(outline(image), size)]
    reference = np.asarray(_locate(truth, surface, *border))
    O = reference[:, -1]
    axes = np.asarray(_east_north(surface, tuple(O)))

    def curve(label: str, X: ArrayLike, kind: str) -> Curve:
        east, north = 1e-3 * axes @ (np.asarray(X) - O[:, None])
        return Curve(label, east, north, None, kind)

    curves = [
        curve(label, X[:, :-1], kind)
        for X, label, kind in (
            (reference, "footprint, reference", "second"),
            (np.asarray(_locate(image, surface, *border)), "footprint", "first"),
        )
    ]
    # As many places as the border has.
    lines = np.linspace(0, image.lines - 1, len(border[0]) - 1)
    P = np.array(_positions(image, jnp.asarray(lines))).T
    if earth is None:
        P[2] = 0.0
        curves.append(curve("track, from above", P, "given"))
    elif earth.a == earth.b:
        curves.append(curve("ground track, below the platform", _on_ellipsoid(earth, P), "given"))
    return figure(
        draw_plan(curves, "east [km]", "north [km]"),
        "Relative to the image centre; both axes at one scale",
    )


def draw_errors(field: Float[np.ndarray, "rows columns"], overall: Mapping[str, float]) -> str:
    """The error map; `overall`: `rms` and `ce90` over the whole image, metres."""
    return figure(
        draw_field(field, 3),
        f"Error on the ground in metres, RMS of each part of the image, line 0 at the top: RMS "
        f"{significant(overall['rms'])} m, CE90 {significant(overall['ce90'])} m",
    )


def draw_accuracy(
    overall: Mapping[str, float],
    errors: Float[np.ndarray, "n 2"],
    expected: Sequence[Mapping[str, float]],
) -> str:
    """The table of errors on the ground, and that of the accuracy expected of attitudes."""
    east, north = np.sqrt(np.mean(errors**2, 0))
    rows = [
        ("RMS", overall["rms"]),
        ("RMS east", east),
        ("RMS north", north),
        ("CE90", overall["ce90"]),
        ("largest", overall["largest"]),
    ]
    table_of_errors = grid(("error on the ground", "m"), [(n, significant(v, 4)) for n, v in rows])
    header = (
        "σ of the attitude, each axis",
        "RMS [m]",
        "CE90 [m]",
        "RMS, level camera",
        "CE90, level camera",
    )
    names = ("rms", "ce90", "closed_rms", "closed_ce90")
    table = [
        (f"{row['sigma']:g}°", *(significant(row[name], 4) for name in names)) for row in expected
    ]
    return (
        table_of_errors
        + "<h3>Expected accuracy for a constant error over the image</h3>\n"
        + grid(header, table)
    )


def outline(image: PushbroomImage, places: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Lines and pixels around the image, closed, at `places` places of each side."""
    s, zero, ones = np.linspace(0, 1, places), np.zeros(places), np.ones(places)
    line_share = np.concatenate([zero, s, ones, s[::-1]])
    pixel_share = np.concatenate([s, ones, s[::-1], zero])
    return line_share * (image.lines - 1), pixel_share * (image.pixels - 1)


_locate = jax.jit(locate_points)
_east_north = jax.jit(east_north)
_positions = jax.jit(
    lambda image, lines: jax.vmap(lambda line: pose_at(image, image.times.time(line)).P)(lines)
)


@partial(jax.jit, static_argnums=2)
def _angles(image: PushbroomImage, lines: Float[Array, " n"], orbital: bool) -> Float[Array, "3 n"]:
    """Pitch, roll, yaw of the platform at some lines, radians."""

    def of_line(line: Array) -> Float[Array, "3"]:
        P, R, V = recorded_pose(image, image.times.time(line))
        # Angles are those of the transpose, as of ω, φ, κ.
        return omega_phi_kappa_from_matrix((orbital_frame(P, V).T @ R if orbital else R).T)

    return jax.vmap(of_line, out_axes=1)(lines)


@jax.jit
def _on_ellipsoid(earth: Ellipsoid, P: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    longitude, latitude, _ = geodetic(earth, tuple(P))
    return jnp.stack(earth_fixed(earth, (longitude, latitude, 0 * longitude)))
