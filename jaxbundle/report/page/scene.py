"""Drawings of the page: the stations of the network, and the frames of images."""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.plotting.distortion import principal_point
from jaxbundle.plotting.ellipses import PROBABILITY, SCENE, choose_ellipses, thin_out
from jaxbundle.plotting.frame import image_frame
from jaxbundle.plotting.style import extent, micrometres, round_number
from jaxbundle.plotting.views import camera_pyramids, pyramid_size
from jaxbundle.report.layout import clean
from jaxbundle.report.page.columns import encode_values

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


def describe_network(adjustment: "Adjustment") -> dict[str, Any]:
    """Centre, size and unit of the network; its error ellipsoids: the factor, the rows of points
    and stations that have one, in words, and whether those of stations are too wide to be drawn;
    the pyramid of every image (projection centre and four corners, relative to the centre)."""
    centres = adjustment.image_values[:, :3]
    located_points = adjustment.point_values[adjustment.located]
    centre, size = extent(np.concatenate([located_points, centres]))
    pyramids = camera_pyramids(adjustment, pyramid_size(centres, size)) - centre
    ellipsoids = choose_ellipses(adjustment, size, SCENE)
    largest = np.sqrt(np.trace(adjustment.image_covariance[:, :3, :3], axis1=1, axis2=2))
    if not ellipsoids.total and largest.max(initial=0.0) > 0:
        # No point has one: the largest of the stations is a twentieth of the network.
        factor = round_number(0.05 * size / largest.max())
        ellipsoids = ellipsoids._replace(factor=factor)
    return {
        "centre": centre.tolist(),
        "size": size,
        "unit": clean(adjustment.network.object_unit),
        "factor": ellipsoids.factor,
        "ellipsoids": {
            "points": ellipsoids.rows.tolist(),
            "images": thin_out(centres, np.nan_to_num(largest), size, SCENE).tolist(),
        },
        "drawn": " ".join(
            [
                f"error ellipsoids: 1σ a posteriori (probability {PROBABILITY[3]}), drawn",
                ellipsoids.exaggeration,
                ellipsoids.selection,
            ]
        ).rstrip(),
        # Wider than this part of the network they hide it: drawn on request.
        "wide": bool(ellipsoids.factor * largest.max(initial=0.0) > 0.15 * size),
        "pyramids": encode_values(pyramids.ravel()),
    }


def describe_frames(adjustment: "Adjustment") -> dict[str, dict[str, Any]]:
    """By camera the frame of its images, its principal point, and the unit of residuals."""
    frames = {}
    for camera in adjustment.problem.network.cameras:
        model = get_model(camera.model)
        low, high, is_known = image_frame(adjustment, camera.id)
        scale, unit = micrometres(model.unit)
        centre = principal_point(adjustment, camera.id)
        frames[camera.id] = {
            "low": low.tolist(),
            "high": high.tolist(),
            "known": bool(is_known),
            "down": model.axes == "down",
            "scale": scale,
            "unit": unit,
            "centre": centre.tolist() if np.isfinite(centre).all() else None,
        }
    return frames
