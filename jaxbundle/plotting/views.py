"""The network as a map and in perspective: points by role, cameras as pyramids, error ellipses."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.cameras import get_model, image_ray
from jaxbundle.cameras.model import CameraModel
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.plotting.ellipses import (
    PERSPECTIVE,
    PLAN,
    PROBABILITY,
    Ellipses,
    choose_ellipses,
    error_ellipses,
    median_neighbour,
    principal_sections,
)
from jaxbundle.plotting.frame import image_frame, pyramid_lines
from jaxbundle.plotting.style import (
    BLUE,
    GREY,
    INK,
    MAX_LABELS,
    ROLE_STYLE,
    RUST,
    axes,
    axes_3d,
    extent,
    legend,
    plain,
    quiet,
    quiet_3d,
    title,
)
from jaxbundle.plotting.ticks import label_coordinates
from jaxbundle.system.programs import compile_once

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox
    from mpl_toolkits.mplot3d import Axes3D

    from jaxbundle.adjustment.result import Adjustment


# Points whose ellipses are too wide to be drawn.
TOO_WIDE = {
    "s": 16,
    "marker": "o",
    "facecolors": "none",
    "edgecolors": RUST,
    "linewidths": 0.6,
    "label": "ellipse too wide to be drawn",
}


def network_plan(adjustment: "Adjustment", ax: "Axes | None" = None) -> "Axes":
    """The network seen along Z: points by role, cameras, error ellipses of X and Y.

    The ellipses are 1σ (a posteriori) and exaggerated; legend and title state the factor, and of
    which points they are drawn (`choose_ellipses`). A camera is the pyramid of its image corners,
    with its projection centre and viewing direction.

    **Returns:** matplotlib `Axes`, in the object unit.
    """
    ax = axes(ax, (7.5, 6.5))
    points, centres = _points(adjustment), adjustment.image_values[:, :3]
    _, size = extent(np.concatenate([points["xyz"], centres]))
    pyramids = camera_pyramids(adjustment, pyramid_size(centres, size))
    _draw_cameras(ax, pyramids)
    for role in ROLE_STYLE:
        points_of_role = points["xyz"][points["role"] == role]
        if len(points_of_role):
            ax.scatter(
                points_of_role[:, 0],
                points_of_role[:, 1],
                label=f"{role} points",
                linewidths=0,
                zorder=5,
                **_lighter(role, len(points["id"])),
            )
    ellipses, selection = _draw_ellipses(adjustment, ax, size)
    parts_drawn = (points["xyz"][:, :2], pyramids[:, :, :2].reshape(-1, 2), ellipses.reshape(-1, 2))
    low, high = _inside(np.concatenate(parts_drawn))
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    quiet(ax)
    unit = adjustment.network.object_unit
    for name in "xy":
        label_coordinates(ax, name, unit)
    name = f"{adjustment.network.name}: seen along Z"
    title(ax, name, selection and f"error ellipses {selection}")
    _legend_below(ax)
    backward = centres - pyramids[:, 1:].mean(1)
    upper_right = np.full((len(points["id"]), 2), 0.7)
    ids = []
    if len(centres) <= MAX_LABELS // 2:
        ids.append((adjustment.images["id"], centres, INK, backward[:, :2] / size))
    if len(points["id"]) <= MAX_LABELS:
        ids.append((points["id"], points["xyz"], BLUE, upper_right))
    # Beyond some thousands of dots an id finds no room in any case.
    places = np.concatenate([centres, points["xyz"][: 50 * MAX_LABELS]])[:, :2]
    _write_ids(ax, ids, places)
    return ax


def _draw_cameras(ax: "Axes", pyramids: Float[np.ndarray, "images 5 3"]) -> None:
    """Cameras from above: their pyramids, with projection centre and viewing direction."""
    from matplotlib.collections import LineCollection

    edges = pyramid_lines(pyramids)[..., :2].reshape(-1, 2, 2)
    ax.add_collection(LineCollection(list(edges), colors=GREY, linewidths=0.6, zorder=2))
    axis = np.stack([pyramids[:, 0], pyramids[:, 1:].mean(1)], 1)[:, :, :2]
    ax.add_collection(LineCollection(list(axis), colors=INK, linewidths=1.0, zorder=3))
    ax.scatter(*pyramids[:, 0, :2].T, s=9, color=INK, zorder=4, label="cameras")


def _legend_below(ax: "Axes") -> None:
    """A legend half an inch below the axes, under their label."""
    from matplotlib.transforms import ScaledTranslation

    legend(
        ax,
        loc="upper left",
        bbox_to_anchor=(0, 0),
        bbox_transform=ax.transAxes + ScaledTranslation(0, -0.5, ax.figure.dpi_scale_trans),
        ncols=5,
        frameon=False,
        borderaxespad=0,
        handletextpad=0.3,
        columnspacing=1.5,
    )


def network_perspective(adjustment: "Adjustment", ax: "Axes3D | None" = None) -> "Axes3D":
    """The network in perspective: cameras as pyramids of their image corners, points by role, error
    ellipsoids by their three principal sections.

    The ellipsoids are 1σ (a posteriori) and exaggerated; legend and title state the factor, and of
    which points they are drawn (`choose_ellipses`).

    **Returns:** matplotlib 3D `Axes`, in the object unit.
    """
    view = axes_3d(ax, (7.5, 6.5))
    from matplotlib.colors import to_rgba
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    points, centres = _points(adjustment), adjustment.image_values[:, :3]
    _, size = extent(np.concatenate([points["xyz"], centres]))
    pyramids = camera_pyramids(adjustment, pyramid_size(centres, size))
    ellipses = choose_ellipses(adjustment, size, PERSPECTIVE)
    edges = pyramid_lines(pyramids).reshape(-1, 2, 3)
    faces = Poly3DCollection(pyramids[:, 1:], facecolors=BLUE, alpha=0.12, edgecolors="none")
    view.add_collection3d(faces)
    view.add_collection3d(Line3DCollection(edges, colors=GREY, linewidths=0.7))
    view.scatter(*centres.T, s=8, color=INK, label="cameras", depthshade=False)
    for role in ROLE_STYLE:
        points_of_role = points["xyz"][points["role"] == role]
        if len(points_of_role):
            view.scatter(
                *points_of_role.T,
                label=f"{role} points",
                linewidths=0,
                depthshade=False,
                **_behind_ellipsoids(role, len(points["id"]), ellipses),
            )
    if ellipses.total:
        sections = Poly3DCollection(
            list(principal_sections(adjustment, ellipses)),
            facecolors=to_rgba(BLUE, 0.1),
            edgecolors=to_rgba(BLUE, 0.8),
            linewidths=0.6,
            label=f"error ellipsoids (1σ, {PROBABILITY[3]}) {ellipses.exaggeration}",
        )
        view.add_collection3d(sections)
    if len(ellipses.wide):
        places = adjustment.point_values[ellipses.wide]
        view.scatter(*places.T, depthshade=False, **TOO_WIDE)
    everything = np.concatenate([points["xyz"], pyramids.reshape(-1, 3)])
    low, high = _inside(everything)
    for name, a, b in zip("xyz", low, high):
        getattr(view, f"set_{name}lim")(a, b)
    view.set_box_aspect(np.maximum(high - low, 0.05 * (high - low).max()), zoom=1.0)
    quiet_3d(view)
    unit = adjustment.network.object_unit
    for name in "xyz":
        view.locator_params(axis=name, nbins=5)
        label_coordinates(view, name, unit)
    selection = ellipses.selection
    title(
        view,
        f"{adjustment.network.name}: perspective",
        selection and f"error ellipsoids {selection}",
    )
    legend(view, frameon=False, loc="upper right")
    return view


# --- cameras --------------------------------------------------------------------------------


def camera_pyramids(adjustment: "Adjustment", size: float) -> np.ndarray:
    """Projection centre and the four image corners in object space [images, 5, 3].

    The slanted edges have the length `size` on average; corners by the model of the camera, so
    that the principal point and the distortion are visible.
    """
    network, values = adjustment.problem.network, adjustment.values
    M = np.asarray(jax.vmap(matrix_from_quaternion)(values["image"].rotation))
    centres = adjustment.image_values[:, :3]
    models = [get_model(network_camera.model) for network_camera in network.cameras]
    frames = np.array([np.stack(image_frame(adjustment, c.id)[:2]) for c in network.cameras])
    corners = np.zeros((len(models), 4, 3))
    interior = np.asarray(adjustment.problem.interior_orientation(values))
    for model in dict.fromkeys(models):
        cameras_of_model = [c for c, other_model in enumerate(models) if other_model == model]
        p = interior[np.array(cameras_of_model), : len(model.parameters)]
        corners[cameras_of_model] = _corner_rays(model, p, frames[cameras_of_model])
    # If the distortion turns back inside the frame there is no ray: an approximate corner instead.
    is_missing = ~np.all(np.isfinite(corners), axis=2)
    # A depth of 1.4 to a half side of 1: a field of 71°, as of a wide-angle lens.
    approximate = np.array([(-1, -1, -1.4), (1, -1, -1.4), (1, 1, -1.4), (-1, 1, -1.4)])
    approximate /= np.linalg.norm(approximate, axis=1)[:, None]  # as long as the other rays
    corners = np.where(is_missing[:, :, None], approximate, corners)
    # Corners at one depth, of a lens far from a hemisphere, make a plane rectangle. Up to 78° off
    # the axis, where the cosine is 0.2: beyond, one depth would draw an edge out to five times.
    flat = np.all(corners[:, :, 2] < -0.2, axis=1)
    corners[flat] /= -corners[flat][:, :, 2:]
    corners /= np.linalg.norm(corners, axis=2).mean(1)[:, None, None]
    edges = size * corners[network.images.camera]
    return np.concatenate([centres[:, None], centres[:, None] + edges @ M], 1)


@partial(compile_once, static=0)
def _corner_rays(
    model: CameraModel,
    parameters: Float[Array, "cameras parameters"],
    frames: Float[Array, "cameras 2 2"],
) -> Float[Array, "cameras 4 3"]:
    """Rays of the four corners of every frame (lowest and highest x, y) [cameras, 4, 3]."""
    x, y = frames[:, jnp.array([0, 1, 1, 0]), 0], frames[:, jnp.array([0, 0, 1, 1]), 1]

    def ray(p: Array, x: Array, y: Array) -> Array:
        return jnp.stack(image_ray(model, tuple(p), x, y))

    return jax.vmap(jax.vmap(ray, (None, 0, 0)))(parameters, x, y)


def pyramid_size(centres: Float[np.ndarray, "n 3"], size: float) -> float:
    """A visible size that keeps neighbours apart."""
    return float(np.clip(0.9 * median_neighbour(centres), 0.045 * size, 0.15 * size))


# --- points ---------------------------------------------------------------------------------


def _points(adjustment: "Adjustment") -> dict[str, np.ndarray]:
    """Ids, roles and coordinates, including check points; without points at any distance."""
    table = adjustment.points
    is_located = adjustment.located
    id, role, xyz = (
        table["id"][is_located],
        table["role"][is_located],
        adjustment.point_values[is_located],
    )
    checks = adjustment.check_points
    if checks is not None:
        id = np.concatenate([id, np.array(checks.id, dtype=object)])
        role = np.concatenate([role, np.full(len(checks.id), "check", dtype=object)])
        xyz = np.concatenate([xyz, checks.position])
    return {"id": id, "role": role, "xyz": xyz}


def _lighter(role: str, number: int) -> dict[str, Any]:
    """Smaller marks for many tie points."""
    style = ROLE_STYLE[role]
    factor = 1 if role != "tie" or number <= 300 else 2 if number <= 3000 else 8
    return style | {"s": style["s"] / factor}


def _behind_ellipsoids(role: str, number: int, ellipses: "Ellipses") -> dict[str, Any]:
    """Marks of tie points that leave their ellipsoids visible: smaller, and pale if many have none;
    of those that have one, its centre is the point."""
    style = _lighter(role, number)
    if role != "tie" or not ellipses.total:
        return style
    pale = {} if len(ellipses.rows) == ellipses.total else {"alpha": 0.35}
    return style | {"s": min(style["s"], 4)} | pale


# Left, right, low, top of a text, pixels.
Box = tuple[float, float, float, float]


def _draw_ellipses(adjustment: "Adjustment", ax: "Axes", size: float) -> tuple[np.ndarray, str]:
    """Draw the error ellipses in a visible, comparable size; returns their polygons, and which are
    drawn, in words."""
    from matplotlib.collections import LineCollection

    ellipses = choose_ellipses(adjustment, size, PLAN)
    if not ellipses.total:
        return np.zeros((0, 1, 2)), ""
    if len(ellipses.wide):
        places = adjustment.point_values[ellipses.wide, :2]
        ax.scatter(*places.T, zorder=6, **TOO_WIDE)
    polygons = error_ellipses(adjustment, ellipses)
    outlines = LineCollection(
        list(polygons),
        colors=BLUE,
        linewidths=0.8,
        zorder=3,
        alpha=0.8 if len(ellipses.rows) == ellipses.total else 0.5,
        label=f"error ellipses (1σ, {PROBABILITY[2]}) {ellipses.exaggeration}",
    )
    ax.add_collection(outlines)
    return polygons, ellipses.selection


def _write_ids(
    ax: "Axes",
    tables: Iterable[tuple[Sequence[object], np.ndarray, str, Float[np.ndarray, "n 2"]]],
    places: Float[np.ndarray, "n 2"],
) -> None:
    """Ids beside their points without covering other ids, points or the frame; first on the side
    away from the object. Ids without room are omitted.

    **Arguments:** `tables`: ids, coordinates, colour, direction to the first side; `places` to be
    kept free.
    """
    ax.figure.canvas.figure.draw_without_rendering()  # the layout moves the axes
    frame = ax.get_window_extent()
    dots = ax.figure.dpi / 72
    # Of text of 7 points: a letter, a line and the gap between a dot and its text, in points.
    letter, line, gap = 4.9, 8.0, 4.0
    occupied = [(x - dots, x + dots, y - dots, y + dots) for x, y in ax.transData.transform(places)]
    for ids, xyz, colour, directions in tables:
        for id, place, direction in zip(ids, xyz, directions):
            text = plain(id)
            x, y = ax.transData.transform(place[:2])
            angle = np.arctan2(*direction[::-1]) if np.hypot(*direction) > 0.01 else np.pi / 4
            turns = angle + np.pi / 4 * np.array([0, 1, -1, 2, -2, 3, -3, 4])
            extent_of = dots * letter * len(text), dots * line, dots * gap
            boxes = [_box(x, y, *extent_of, turn) for turn in turns]
            best = min(range(len(boxes)), key=lambda i: _count_covered(boxes[i], occupied, frame))
            if _count_covered(boxes[best], occupied, frame) > 0:
                continue
            occupied.append(boxes[best])
            left, right, low, top = boxes[best]
            ax.annotate(
                text,
                place[:2],
                xytext=((0.5 * (left + right) - x) / dots, (0.5 * (low + top) - y) / dots),
                textcoords="offset points",
                fontsize=7,
                color=colour,
                parse_math=False,
                annotation_clip=True,
                zorder=6,
                ha="center",
                va="center",
            )


def _box(
    x: float, y: float, wide: float, high: float, gap: float, turn: float
) -> tuple[float, float, float, float]:
    """Left, right, low, top of a text beside (x, y) in a direction, pixels."""
    dx, dy = np.cos(turn), np.sin(turn)
    middle_x = x + dx * gap + 0.5 * wide * np.clip(1.5 * dx, -1, 1)
    middle_y = y + dy * gap + 0.5 * high * np.clip(1.5 * dy, -1, 1)
    return (middle_x - wide / 2, middle_x + wide / 2, middle_y - high / 2, middle_y + high / 2)


def _count_covered(box: Box, occupied: Sequence[Box], frame: "Bbox") -> float:
    """The number of occupied boxes that a box covers, and whether it leaves the frame."""
    left, right, low, top = box
    is_outside = left < frame.x0 or right > frame.x1 or low < frame.y0 or top > frame.y1
    return is_outside + sum(
        left <= b[1] and b[0] <= right and low <= b[3] and b[2] <= top for b in occupied
    )


def _inside(
    xyz: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """The corners of the visible part, with a margin."""
    centre, size = extent(xyz)
    near_points = xyz[(np.abs(xyz - centre) <= 0.5 * size * (1 + 1e-9)).all(1)]
    low, high = near_points.min(0), near_points.max(0)
    margin = 0.05 * (high - low).max()
    return low - margin, high + margin
