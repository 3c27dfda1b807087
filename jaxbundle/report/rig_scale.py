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
    rigs = next((one for one in network.further if isinstance(one, Rigs)), None)
    if rigs is None or not (rigs.settings.get("mounting") or rigs.settings.get("bases")):
        return ""
    known = network.points.has_role("control", "fixed").sum()
    known += len(problem.data.measured.get("exterior", ()))
    known += (problem.table("image").free == 0).all(1).sum()
    others = any(one.GIVES_SCALE for one in network.further)
    if known or others or len(network.distances):
        return ""
    bases = _given_bases(adjustment, rigs)
    if not bases:
        return ""

    def lengths(values: Values) -> Float[Array, " n"]:
        centre = values[MOUNTING].position
        return jnp.stack([jnp.linalg.norm(centre[one] - centre[other]) for one, other in bases])

    length = np.asarray(lengths(adjustment.values))
    sigma = np.sqrt(np.maximum(np.diag(adjustment.covariance_of(lengths)), 0.0))
    best = int((sigma / length).argmin())
    table = problem.table(MOUNTING)
    one, other = (table.label(row) for row in bases[best])
    # A held mounting has a σ of rounding.
    held = (table.free[list(bases[best]), :3] == 0).all()
    how = "held" if held else f"± {sigma[best]:.2g} ({100 * sigma[best] / length[best]:.2g} %)"
    return f"the scale is that of the rig: base of {one} and {other} {length[best]:.6g}, {how}"


def _given_bases(adjustment: "Adjustment", rigs: Rigs) -> list[tuple[int, int]]:
    """The rows of the two mountings of every base with a given length."""
    network, table = adjustment.problem.network, adjustment.problem.table(MOUNTING)
    row = {table.label(k): k for k in range(table.rows)}
    mountings, bases = rigs.given(network)
    found = []
    for rig, mounted in rigs.mounted(network).items():
        reference = f"{network.cameras[mounted.reference].id} of {rig}"
        pairs = [
            (f"{name} of {rig}", reference)
            for name, known in mountings.items()
            if known.length is not None
        ]
        pairs += [tuple(f"{name} of {rig}" for name in base.cameras) for base in bases]
        found += [(row[a], row[b]) for a, b in pairs if a in row and b in row]
    return found
