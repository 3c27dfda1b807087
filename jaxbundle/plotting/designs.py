"""A designed network: its stations before and after, the path of the search, trial positions."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert import image_area
from jaxbundle.cameras.convert_fit import rays_of
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network.tables import Network, are_among
from jaxbundle.plotting.frame import pyramid_lines
from jaxbundle.plotting.style import (
    BLUE,
    GREY,
    INK,
    RUST,
    axes,
    axes_3d,
    extent,
    label,
    legend,
    quiet,
    quiet_3d,
    title,
)
from jaxbundle.plotting.ticks import label_coordinates

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

    from jaxbundle.network_design.result import Design


def network_view(
    designed: "Design", ax: "Axes3D | None" = None, after: bool = True, camera_size: float = 0.12
) -> "Axes3D":
    """The stations in perspective, before or after the design, with their paths.

    **Arguments:** `camera_size`: length of the edges of a camera relative to the network.

    **Returns:** matplotlib 3D `Axes`, in the object unit."""
    view = axes_3d(ax, (7.5, 6.5))
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    both_networks = designed.before.network, designed.after.network
    boxes = np.array(designed.conditions.obstacles).reshape(-1, 2, 3)
    places = [x for n in both_networks for x in (n.points.position, n.images.position)]
    everything = np.concatenate([*places, *boxes])
    centre, size = extent(everything)
    network = both_networks[after]
    new = are_among(network.images.id, designed.added)
    for is_of_kind, colour, name in ((~new, INK, "stations"), (new, RUST, "new photograph")):
        if is_of_kind.any():
            lines = camera_lines(network, camera_size * size)[is_of_kind].reshape(-1, 2, 3)
            view.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=0.8))
            view.scatter(
                *network.images.position[is_of_kind].T,
                s=9,
                color=colour,
                label=name,
                depthshade=False,
            )
    steps = [step.position for step in designed.path if len(step.position)]
    if after and designed.order == "first" and steps:
        for path in np.stack(steps, 1):
            view.plot(*path.T, color=BLUE, linewidth=0.7, alpha=0.7)
    view.scatter(*network.points.position.T, s=9, color=BLUE, label="targets", depthshade=False)
    for box in boxes:
        view.add_collection3d(Line3DCollection(_box_edges(box), colors=GREY, linewidths=0.8))
    low, high = everything.min(0), everything.max(0)
    half_extent = 0.55 * max((high - low).max(), size * camera_size)
    for name, middle in zip("xyz", (low + high) / 2):
        getattr(view, f"set_{name}lim")(middle - half_extent, middle + half_extent)
        label(view, name, name.upper(), network.object_unit)
    quiet_3d(view)
    view.set_box_aspect((1, 1, 1), zoom=0.95)
    state = designed.after if after else designed.before
    title(view, "after" if after else "before", f"{designed.aim}: {state.aim:.3g}")
    legend(view, frameon=False, loc="upper right")
    return view


def camera_lines(network: Network, size: float) -> np.ndarray:
    """The edges of a pyramid for every image, [images, 8, 2, 3]; slanted ones are `size` long."""
    corners = []
    for camera in network.cameras:
        model = get_model(camera.model)
        low, high = image_area(model, camera.image_size, camera.pixel_size)
        xy = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
        rays = rays_of(model, {**default_parameters(model), **camera.parameters}, xy)
        corners.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    images = network.images
    M = np.array([matrix_from_omega_phi_kappa(a) for a in images.angles])
    ends = images.position[:, None] + size * np.array(corners)[images.camera] @ M
    places = np.concatenate([images.position[:, None], ends], 1)
    return pyramid_lines(places)


def aim_path(designed: "Design", ax: "Axes | None" = None) -> "Axes":
    """The aim by iteration; conditions become sharper in every round.

    **Returns:** matplotlib `Axes`."""
    ax = axes(ax, (6.5, 4.0))
    steps = np.arange(len(designed.path))
    softness = np.array([s.softness for s in designed.path])
    aims = np.array([s.aim for s in designed.path])
    for value in dict.fromkeys(softness.tolist()):
        is_of_round = softness == value
        name = f"conditions soft to {value:g}" if value else "weights between 0 and 1"
        ax.plot(steps[is_of_round], aims[is_of_round], ".-", linewidth=1, markersize=3, label=name)
    ax.axhline(designed.after.aim, color=INK, linewidth=0.8, linestyle="--", label="designed")
    if np.isfinite(designed.before.aim):
        ax.axhline(designed.before.aim, color=GREY, linewidth=0.8, linestyle="--", label="before")
    ax.set_yscale("log")
    quiet(ax)
    label(ax, "x", "iteration")
    label(ax, "y", str(designed.aim))
    title(ax, "path of the search")
    legend(ax)
    return ax


def places_tried(designed: "Design", ax: "Axes | None" = None) -> "Axes":
    """Trial positions of a further photograph, from above, coloured by the aim; and the chosen
    positions.

    **Raises:** `ValueError` for a design of another order. **Returns:** matplotlib `Axes`."""
    if designed.tried is None:
        raise ValueError("places are tried in a design of third order")
    ax = axes(ax, (6.5, 5.5))
    from matplotlib.colors import LogNorm

    position, aims = designed.tried
    # A place from which the network is nearly singular would take the whole range of colours.
    network, good = designed.network, aims < 1e3 * np.min(aims)
    marks = ax.scatter(*position[good, :2].T, c=aims[good], norm=LogNorm(), s=26, cmap="viridis_r")
    ax.figure.colorbar(marks, ax=ax, label=f"{designed.aim} with a photograph there")
    new = are_among(network.images.id, designed.added)
    ax.scatter(*network.points.position[:, :2].T, s=9, color=BLUE, label="targets")
    ax.scatter(*network.images.position[~new, :2].T, s=34, color=INK, marker="^", label="stations")
    ax.scatter(*network.images.position[new, :2].T, s=120, color=RUST, marker="*", label="chosen")
    ax.set_aspect("equal")
    quiet(ax)
    for name in "xy":
        label_coordinates(ax, name, network.object_unit)
    title(ax, "where should the next photograph be taken?")
    legend(ax)
    return ax


def _box_edges(box: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "12 2 3"]:
    """The twelve edges of a box, [12, 2, 3]."""
    corners = np.array(
        [[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    # The bits of a corner's number are its sides: along an edge one of them differs.
    pairs = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
    return corners[np.array(pairs)]
