"""Common points of photographs: the match graph, the overlap, tracks in a photograph."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from jaxbundle.plotting.frame import image_index
from jaxbundle.plotting.style import (
    BLUE,
    GREY,
    INK,
    MAX_LABELS,
    RUST,
    axes,
    image_axes,
    legend,
    plain,
    quiet,
    title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from jaxbundle.adjustment.result import Adjustment

# Colour and line of a pair that a relative orientation, a plane, a rotation explains.
KINDS = {"relative": (BLUE, "-"), "plane": (GREY, "--"), "rotation": (RUST, ":")}

# Two photographs, matches found, matches verified, kind.
Pairs = Sequence[tuple[str, str, int, int, str]]


def match_graph(
    names: Sequence[str], pairs: Pairs, alone: Sequence[str] = (), ax: "Axes | None" = None
) -> "Axes":
    """Photographs on a circle, in their order, and a line for every verified pair, wider for
    more matches; those in no part (`alone`) are coloured.

    **Returns:** matplotlib `Axes`.
    """
    ax = axes(ax, (7, 7))
    turn = np.pi / 2 - 2 * np.pi * np.arange(len(names)) / max(len(names), 1)
    place = dict(zip(names, np.stack([np.cos(turn), np.sin(turn)], 1)))
    largest_number = max((verified for *_, verified, _ in pairs), default=1)
    kinds_drawn = set()
    for image, partner, _, verified, kind in pairs:
        colour, line = KINDS[kind]
        share = verified / largest_number
        ax.plot(
            *np.stack([place[image], place[partner]], 1),
            line,
            color=colour,
            alpha=0.25 + 0.6 * share,
            linewidth=4.0 * max(share, 0.1),  # below 0.4 points a line vanishes
            label="" if kind in kinds_drawn else kind,
            zorder=2,
        )
        kinds_drawn.add(kind)
    places_of_images = np.array(list(place.values()))
    is_alone = np.isin(names, list(alone))
    ax.scatter(*places_of_images.T, s=36, color=np.where(is_alone, RUST, INK), zorder=3)
    if len(names) <= MAX_LABELS:
        for name, angle in zip(names, turn):
            c, s = 1.06 * np.cos(angle), 1.06 * np.sin(angle)
            ax.text(
                c,
                s,
                plain(name),
                fontsize=7,
                color=INK,
                parse_math=False,
                ha="center" if abs(c) < 0.2 else "left" if c > 0 else "right",
                va="center",
            )
    ax.set_axis_off()
    ax.set_aspect("equal")
    ax.margins(0.25)
    title(
        ax,
        "Match graph",
        f"{len(names)} photographs, {len(pairs)} verified pairs, "
        f"{largest_number if pairs else 0} matches at most",
    )
    if len(kinds_drawn) > 1:
        legend(ax, loc="lower right")
    return ax


def overlap_matrix(names: Sequence[str], pairs: Pairs, ax: "Axes | None" = None) -> "Axes":
    """The number of verified matches of every two photographs, as a matrix.

    **Returns:** matplotlib `Axes`.
    """
    ax = axes(ax, (7, 6))
    index = {name: k for k, name in enumerate(names)}
    number = np.full((len(names), len(names)), np.nan)
    for image, partner, _, verified, _ in pairs:
        i, j = index[image], index[partner]
        number[i, j] = number[j, i] = verified
    drawn_matrix = ax.imshow(number, cmap="Blues", vmin=0)
    ax.figure.colorbar(drawn_matrix, ax=ax, shrink=0.8, label="verified matches")
    if len(names) <= MAX_LABELS:
        ax.set_xticks(range(len(names)), map(plain, names), rotation=90, parse_math=False)
        ax.set_yticks(range(len(names)), map(plain, names), parse_math=False)
    if len(names) <= MAX_LABELS // 3:
        for i, j in np.argwhere(np.isfinite(number)):
            dark = number[i, j] > 0.6 * np.nanmax(number)
            ax.text(
                j,
                i,
                f"{number[i, j]:.0f}",
                ha="center",
                va="center",
                fontsize=7,
                color="white" if dark else INK,
            )
    quiet(ax, grid=False)
    title(ax, "Overlap", "verified matches of every two photographs")
    return ax


def tracks_in_photograph(
    adjustment: "Adjustment",
    image: str,
    picture: UInt8[np.ndarray, "r c"],
    ax: "Axes | None" = None,
) -> "Axes":
    """The measurements of a photograph in its picture, coloured by the number of photographs of the
    point; removed ones as crosses.

    **Arguments:** `picture`: grey values, of any size: it is stretched over the photograph.

    **Returns:** matplotlib `Axes`.
    """
    ax = axes(ax, (8, 6))
    problem, i = adjustment.problem, image_index(adjustment, image)
    is_used = problem.used
    rays = np.bincount(problem.point[is_used], minlength=len(problem.network.points))
    rows = problem.image == i
    xy = problem.image_coordinates()
    columns, height = problem.network.cameras[problem.network.images.camera[i]].image_size
    ax.imshow(
        picture,
        cmap="gray",
        vmin=0,
        vmax=255,
        alpha=0.75,
        extent=(-0.5, columns - 0.5, height - 0.5, -0.5),
    )
    good = rows & is_used
    scatter = ax.scatter(
        *xy[good].T,
        s=7,
        c=rays[problem.point[good]],
        cmap="viridis",
        vmin=2,
        linewidths=0,
        zorder=3,
    )
    bad = rows & ~is_used
    ax.scatter(*xy[bad].T, s=18, marker="x", color=RUST, linewidths=0.8, zorder=4)
    ax.figure.colorbar(scatter, ax=ax, shrink=0.8, label="photographs that show the point")
    ax.set_xlim(-0.5, columns - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    quiet(ax, grid=False)
    image_axes(ax, "px")
    title(ax, f"Photograph {image}: tracks", f"{good.sum()} measurements, {bad.sum()} removed")
    return ax
