"""Start values of a camera and its photographs of a board, and exclusion of impossible views.

The camera is that of `batches.first_cameras`.

A view whose points do not fit the others (a wrong board, a wrong order of corners) is excluded:
more than a third of its residuals are gross compared with the median of all, or it looks at the
board from behind, like a mirror image.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.batches.camera import STATUS
from jaxbundle.batches.camera import WEAK as WEAK_NUMBER
from jaxbundle.batches.first_cameras import FirstCamera, first_cameras, parameters_of
from jaxbundle.calibration.pixels import images_of_board
from jaxbundle.cameras import CameraModel
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.columns import count

MIRRORED = "its points are numbered as in a mirror: it would see the board from behind"
WEAK = STATUS[WEAK_NUMBER]


@dataclasses.dataclass(frozen=True)
class CalibrationStart:
    """Usable views, camera parameters, X0 and ω, φ, κ (radians) of every view.

    `behind`: every view shows the board as a mirror image.
    """

    views: BoardViews
    parameters: dict[str, float]
    position: Float[np.ndarray, "views 3"]
    angles: Float[np.ndarray, "views 3"]
    behind: bool = False


def start_values(
    views: BoardViews,
    model: CameraModel,
    free: tuple[str, ...],
    pixel_size: tuple[float, float] | None = None,
    given_values: Mapping[str, float] | None = None,
) -> CalibrationStart:
    """Start values for the adjustment of one camera; `given_values`: parameters known beforehand.

    **Raises:** `InputError` for too few views; `NotSolvedError` if they do not determine the
    camera.
    """
    while True:
        if len(views) < 2:
            why = f" ({views.failed[0][0]}: {views.failed[0][1]})" if views.failed else ""
            raise InputError(
                f"only {count(len(views), 'photograph')} can be used{why}; a camera needs "
                "several, 8 or more, from different directions"
            )
        solved = _solve(views, model, free)
        is_used = solved.views
        if not is_used.all():
            views = views.take(is_used, "its points are too few or lie on a line")
            continue
        # Seen from behind in some views only: their numbering is wrong. In all views: the
        # photographs may be mirrored, which is said but changes no residual.
        behind = solved.position[:, 2] < views.board.points[:, 2].mean()
        if behind.any() and not behind.all():
            views = views.take(~behind, MIRRORED)
            continue
        gross = _gross_views(views, solved)
        if not gross.any():
            break
        # Fewer than two views would be left: nothing says which are right.
        if gross.sum() > len(views) - 2:
            raise NotSolvedError(
                "not solved: the photographs contradict one another: the points of "
                f"{int(gross.sum())} of {len(views)} do not fit a camera; look for different "
                "boards, another camera, a zoom that moved"
            )
        views = views.take(~gross, "its points do not fit those of the other photographs")
    parameters = parameters_of(
        solved, views.xy[views.visible], views.image_size, model, free, pixel_size, given_values
    )
    return CalibrationStart(views, parameters, solved.position, solved.angles, bool(behind.all()))


def _solve(views: BoardViews, model: CameraModel, free: Sequence[str]) -> FirstCamera:
    (first_camera,) = first_cameras(
        views.board.points, views.xy[None], views.image_size, model, free, threads=1
    )
    if first_camera.solved:
        return first_camera
    why = first_camera.remark if first_camera.status == WEAK else first_camera.status
    raise NotSolvedError(
        f"not solved: {len(views)} photographs of the board do not determine the camera "
        f"({why}); take it from different directions, tilted by 20° to 45°, some with "
        "the camera turned by 90°, or free fewer parameters",
        free,
    )


def _gross_views(views: BoardViews, solved: FirstCamera) -> Bool[np.ndarray, " views"]:
    """Views with more than a third of gross residuals."""
    model, interior = solved.model, np.array(list(solved.interior.values()))
    computed = images_of_board(
        model, interior, solved.position, solved.rotation, views.board.points
    )
    # Lengths of the residuals, pixels; NaN for missing points.
    v = np.linalg.norm(computed - in_model_units(views.xy, model, views.image_size), axis=2)
    typical = NORMAL_SIGMA_BY_MAD * np.nanmedian(v)
    # Gross: above 12 times the typical size and 3 pixels. (Of lengths 1.4826·median is not σ of a
    # coordinate, but 1.75 times as much.) The camera of the start may have fewer coefficients than
    # its model, and what they leave grows towards the corners to several times its median; a wrong
    # board or order of corners is off by squares of the board. Single blunders are left to data
    # snooping.
    gross = v > max(12.0 * typical, 3.0)
    return gross.sum(1) > views.visible.sum(1) / 3
