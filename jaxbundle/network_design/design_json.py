"""The result of a design as JSON (the fields are listed in docs/design.md)."""

from typing import TYPE_CHECKING, Any

from jaxbundle.network.tables import EXTERIOR
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.network_design.proof import Proof

if TYPE_CHECKING:
    from jaxbundle.network_design.result import Design, DesignState


def design_dict(designed: "Design", proof: Proof | None = None) -> dict[str, Any]:
    """A design as plain dicts and numbers."""
    network = designed.network
    images, unit = network.images, ANGLE_UNITS[network.angle_unit]
    return {
        "order": designed.order,
        "aim": str(designed.aim),
        "units": {"object": network.object_unit, "angle": network.angle_unit},
        "before": _state(designed.before),
        "after": _state(designed.after),
        "gain": designed.gain,
        "converged": designed.converged,
        "path": [{"softness": s.softness, "aim": s.aim} for s in designed.path],
        "stations": {
            id: dict(zip(EXTERIOR, [*X0.tolist(), *(angles / unit).tolist()]))
            for id, X0, angles in zip(images.id, images.position, images.angles)
        },
        "bound": designed.bound,
        "weights": designed.weights,
        "dropped": list(designed.dropped),
        "added": list(designed.added),
        "proof": None
        if proof is None
        else {
            "predicted": proof.predicted,
            "found": proof.found,
            "ratio": proof.ratio,
            "limit": proof.limit,
            "draws": proof.draws,
            "failed": proof.failed,
            "agrees": bool(proof.agrees),
        },
    }


def _state(state: "DesignState") -> dict[str, Any]:
    return {
        "aim": state.aim,
        "photographs": state.photographs,
        "image_points": state.rays,
        "lost": list(state.lost),
    }
