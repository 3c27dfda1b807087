"""Positions and attitudes of products as tables that cover the whole image."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxbundle.io.scanner.csm_trajectory import LAGRANGE_ORDER, view_directions
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import (
    attitude_table,
    extrapolation_limit,
    position_table,
    warn_of_extrapolation,
)
from jaxbundle.pushbroom.trajectory import Trajectory


class Tables(NamedTuple):
    """Positions (metres, Earth-fixed) at t, rotations camera → Earth at rows, seconds; sources."""

    t: Float[np.ndarray, " n"]
    P: Float[np.ndarray, "n 3"]
    rows: Float[np.ndarray, " m"]
    R: Rotation
    positions: Source
    attitude: Source

    def directions(self, time: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Approximate directions down and of flight in the camera frame."""
        return view_directions(self.t, self.P, self.rows, self.R, time)


def trajectory_of(
    tables: Tables, rotation: Rotation, lines: Float[np.ndarray, " lines"]
) -> tuple[Trajectory, tuple[str, ...]]:
    """The trajectory, the camera turned by `rotation`, and warnings.

    Lagrange's polynomial through eight rows; a table that ends a little before the lines is
    extrapolated linearly (`usgscsm` of `pushbroom.interpolation`).

    **Raises:** `InputError` naming the line that is too far outside.
    """
    warnings: list[str] = []

    def options(rows: Float[np.ndarray, " n"], source: Source) -> dict[str, Any]:
        new_warnings = warn_of_extrapolation(rows, lines, source)
        warnings.extend(new_warnings)
        return {
            "method": "usgscsm" if new_warnings else "lagrange",
            "order": min(LAGRANGE_ORDER, len(rows) - 1),
            "gap": np.inf,
            "extrapolate": extrapolation_limit(rows),
            "source": source,
        }

    q = np.roll((tables.R * rotation).as_quat(), 1, axis=1)
    trajectory = Trajectory(
        position_table(tables.t, tables.P, **options(tables.t, tables.positions)),
        attitude_table(tables.rows, q, **options(tables.rows, tables.attitude)),
    )
    return trajectory, tuple(warnings)
