"""Which further photographs would determine the mountings of a rig better, in words."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.calibration.advice import ADVICE
from jaxbundle.network.columns import count, list_some

if TYPE_CHECKING:
    from jaxbundle.calibration.rig.result import RigCalibration


def undetermined_mountings(rig: "RigCalibration") -> dict[str, tuple[float, np.ndarray]]:
    """Cameras whose position has a σ beyond the distance of the boards, which is no knowledge of
    it: by name the σ and its direction."""
    weak = {name: mounting.weakest for name, mounting in rig.mountings.items()}
    return {
        name: sigma_and_direction
        for name, sigma_and_direction in weak.items()
        if sigma_and_direction[0] > rig.distance
    }


def shared_epochs(rig: "RigCalibration") -> Float[np.ndarray, "cameras cameras"]:
    """Number of epochs at which two cameras see the same board; of one, those with any."""
    declared_rig, is_used = rig.rig, rig.used
    board = declared_rig.board_of_points[declared_rig.point[is_used]]
    views = np.unique(
        np.stack([declared_rig.camera[is_used], declared_rig.epoch[is_used], board]), axis=1
    )
    number, rows = len(declared_rig.cameras), len(declared_rig.epochs)
    is_seen = np.zeros((number, rows * len(declared_rig.boards)), bool)
    is_seen[views[0], views[1] * len(declared_rig.boards) + views[2]] = True
    seen_by_both = is_seen[:, None] & is_seen[None]
    return seen_by_both.reshape(number, number, rows, -1).any(3).sum(2)


def advise_rig(rig: "RigCalibration") -> list[str]:
    """Advice in words, the most serious first."""
    return [
        *_advise_undetermined(rig),
        *_advise_overlaps(rig),
        *_advise_boards(rig),
        _advise_weakest(rig),
    ]


def _advise_undetermined(rig: "RigCalibration") -> Iterator[str]:
    for name, (sigma, direction) in undetermined_mountings(rig).items():
        yield (
            f"the position of {name!r} is not determined along {_direction(direction)}: σ "
            f"{sigma:.3g} {rig.object_unit} is beyond the distance of the boards; "
            f"{_remedy(rig, name)}"
        )


def _advise_overlaps(rig: "RigCalibration") -> Iterator[str]:
    """Cameras that see a board with others, but at few epochs."""
    shared = shared_epochs(rig).astype(int)
    np.fill_diagonal(shared, 0)
    for k, name in enumerate(rig.names):
        largest_number = int(shared[k].max())
        if 0 < largest_number < ADVICE.min_views:
            partner = rig.names[int(shared[k].argmax())]
            yield (
                f"camera {name!r} sees a board together with {partner!r} at "
                f"{count(largest_number, 'epoch')}, "
                f"with others at no more: photograph a board with both at the same time, at "
                f"{ADVICE.min_views} epochs or more"
            )


def _advise_boards(rig: "RigCalibration") -> Iterator[str]:
    for boards in rig.separate:
        yield (
            f"boards {list_some(boards, 6)} are fixed to each other, but nothing relates them: "
            "photograph them at the same epoch; each is used by itself"
        )


def _advise_weakest(rig: "RigCalibration") -> str:
    """The photograph that the weakest mounting needs."""
    name, mounting = max(rig.mountings.items(), key=lambda item: item[1].weakest[0])
    sigma, direction = mounting.weakest
    weakest = (
        f"next: the position of {name!r} is the weakest, σ {sigma:.2g} {rig.object_unit} along "
        f"{_direction(direction)}: "
    )
    view = rig.next_view(name)
    if view is None or view.after >= view.before:
        return weakest + _remedy(rig, name)
    board = "the board" if len(rig.rig.boards) == 1 else f"board {view.board!r}"
    return (
        f"{weakest}hold {board} at {view.distance:.2g} {rig.object_unit} before {name!r}, its "
        f"middle near pixel ({view.pixel[0]:.0f}, {view.pixel[1]:.0f}), tilted by "
        f"{view.tilt:.0f}° and rolled by {view.roll:.0f}°, where {list_some(view.seen_by, 6)} see "
        f"it: σ would be {view.after / view.before:.2f} times that"
    )


def _remedy(rig: "RigCalibration", name: str) -> str:
    """What determines the mounting of a camera better."""
    # A tie by motion divides the cameras: those on the other side of the reference depend on it.
    if any(name in tie.cameras[1] for tie in rig.ties):
        return (
            "rotate the rig about an axis across this direction, by larger angles, with all boards "
            "in view"
        )
    shared = shared_epochs(rig).astype(float)
    np.fill_diagonal(shared, -1)
    partner = rig.names[int(shared[rig.names.index(name)].argmax())]
    return (
        f"photograph a board with {name!r} and {partner!r} at the same time, near, tilted, and at "
        "the edges of both images"
    )


def _direction(direction: Float[np.ndarray, "3"]) -> str:
    # The sign of an axis is arbitrary: its largest part is positive.
    direction = direction * np.sign(direction[np.abs(direction).argmax()])
    # No negative zeros.
    return f"({', '.join(f'{x + 0.0:.2f}' for x in direction.round(2))})"
