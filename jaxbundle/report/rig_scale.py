"""The scale of a network that nothing gives but its rigs, in words."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.network.kinds.mountings import MOUNTING
from jaxbundle.network.kinds.rigs import Rigs

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


def scale_of_rigs(adjustment: "Adjustment") -> str:
    """Which base of a rig gives the scale, with its σ; empty where other lengths are known."""
    problem, network = adjustment.problem, adjustment.problem.network
    rigs = next((table for table in network.further if isinstance(table, Rigs)), None)
    if rigs is None or not (rigs.settings.get("mounting") or rigs.settings.get("bases")):
        return ""
    number_known = network.points.has_role("control", "fixed").sum()
    number_known += len(problem.data.measured.get("exterior", ()))
    number_known += (problem.table("image").free == 0).all(1).sum()
    has_other_scale = any(table.GIVES_SCALE for table in network.further)
    if number_known or has_other_scale or len(network.distances):
        return ""
    bases = _given_bases(adjustment, rigs)
    if not bases:
        return ""

    def lengths(values: Values) -> Float[Array, " n"]:
        centre = values[MOUNTING].position
        return jnp.stack(
            [
                jnp.linalg.norm(centre[mounting_a] - centre[mounting_b])
                for mounting_a, mounting_b in bases
            ]
        )

    length = np.asarray(lengths(adjustment.values))
    sigma = np.sqrt(np.maximum(np.diag(adjustment.covariance_of(lengths)), 0.0))
    best = int((sigma / length).argmin())
    table = problem.table(MOUNTING)
    mounting_a, mounting_b = (table.label(row) for row in bases[best])
    # A held mounting has a σ of rounding.
    is_held = (table.free[list(bases[best]), :3] == 0).all()
    how = "held" if is_held else f"± {sigma[best]:.2g} ({100 * sigma[best] / length[best]:.2g} %)"
    base = f"base of {mounting_a} and {mounting_b} {length[best]:.6g}"
    return f"the scale is that of the rig: {base}, {how}"


def _given_bases(adjustment: "Adjustment", rigs: Rigs) -> list[tuple[int, int]]:
    """The rows of the two mountings of every base with a given length."""
    network, table = adjustment.problem.network, adjustment.problem.table(MOUNTING)
    row = {table.label(k): k for k in range(table.rows)}
    mountings, bases = rigs.read_settings(network)
    rows_of_bases = []
    for rig, mounted in rigs.mounted(network).items():
        reference = f"{network.cameras[mounted.reference].id} of {rig}"
        pairs = [
            (f"{name} of {rig}", reference)
            for name, mounting in mountings.items()
            if mounting.length is not None
        ]
        pairs += [tuple(f"{name} of {rig}" for name in base.cameras) for base in bases]
        rows_of_bases += [(row[a], row[b]) for a, b in pairs if a in row and b in row]
    return rows_of_bases
