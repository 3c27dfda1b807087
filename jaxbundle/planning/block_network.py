"""The network of a planned block: photographs over a grid of tie points, control at the edges."""

import math

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.tables import Camera, Network
from jaxbundle.planning.block_design import BlockDesign
from jaxbundle.planning.simulate import simulate
from jaxbundle.planning.stations import aerial_block


def planned_network(
    design: BlockDesign,
    camera: Camera,
    image_format: tuple[float, float],
    area: tuple[float, float],
    sigma_image: float,
    control_sigma: float,
    control_every: int | None = None,
    seed: int = 0,
    relief: float = 0.02,
) -> Network:
    """A simulated network of the block, datum by control.

    Tie points are half a base apart along the strips and half a strip spacing across. Control
    points are the nine at the corners of the area, the middles of its edges and its centre, or,
    with `control_every`, one per this number of bases along and strips across.

    **Arguments:** `camera` of a model in mm; `image_format` and `sigma_image` in mm; `area` as in
    `design_block`; `control_sigma` object unit; `relief`: heights of tie points vary by ± this
    fraction of the flying height.
    """
    counts = [
        _odd_number_of_points(length / step * 2)
        for length, step in zip(area, (design.base, design.spacing))
    ]
    columns, rows = counts
    # A margin of points inside the area: relief moves an image at the edge of the format, half a
    # footprint from the nadir, outwards by half its fraction of the footprint. 2 % more: distortion
    # may narrow the footprint by 4 %. An area narrower than a footprint needs less.
    margin = relief / 2 + 0.02
    x, y = (
        np.linspace(-0.5, 0.5, n) * (length - 2 * min(margin * side, length / 4))
        for n, length, side in zip(counts, area, design.footprint)
    )
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    heights = np.random.default_rng(seed).uniform(-1, 1, len(grid)) * relief * design.height
    targets = np.concatenate([grid, heights[:, None]], axis=1)
    control_columns, control_rows = (_control(n, control_every) for n in counts)
    control = [row * columns + column for row in control_rows for column in control_columns]
    stations = aerial_block(
        design.strips,
        design.photographs_per_strip,
        height=design.height,
        footprint=design.footprint,
        forward_overlap=design.forward_overlap,
        side_overlap=design.side_overlap,
    )
    return simulate(
        stations,
        targets,
        camera,
        noise=sigma_image,
        seed=seed,
        datum="control",
        image_format=image_format,
        control=control,
        control_sigma=control_sigma,
        min_rays=2,
        name="planned block",
    )


def _control(points: int, interval: int | None) -> list[int]:
    """Which points of a row, two per base, are control points, always including the last."""
    if interval is None:
        return [0, points // 2, points - 1]
    if interval < 1:
        raise InputError(f"control every {interval} bases: expected a number from 1")
    return sorted({*range(0, points, 2 * interval), points - 1})


def _odd_number_of_points(steps: float) -> int:
    """An odd number of points for at least this many steps, so that control points can be at the
    middles; at least five, so that a point is between those of control."""
    n = max(5, math.ceil(steps - 1e-9) + 1)  # 3.0000000001 steps are three
    return n + (n + 1) % 2
