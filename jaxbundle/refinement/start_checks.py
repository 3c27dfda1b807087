"""Measurements that contradict the start values: exchanged columns, points in another place."""

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.errors import InputError
from jaxbundle.pushbroom.exchanged_columns import refuse_exchanged
from jaxbundle.refinement.inputs import RefinementInput


def check_columns(
    inputs: RefinementInput, rows: Int[np.ndarray, " n"], v: Float[np.ndarray, "n 2"]
) -> None:
    """Refuse measurements whose line and pixel are exchanged, where points with given coordinates
    show it."""
    points, observations = inputs.points, inputs.observations
    role = np.array(points.role, dtype=object)[observations.point[rows]]
    image = observations.image[rows]
    for i in np.unique(image):
        is_of_image = (image == i) & (role != "tie")
        xy = observations.xy[rows][is_of_image]
        name, where = observations.source.name, f" in image {inputs.ids[i]!r}"
        refuse_exchanged(xy, xy + v[is_of_image], name, where)


def check_near(
    inputs: RefinementInput, rows: Int[np.ndarray, " n"], v: Float[np.ndarray, "n 2"]
) -> None:
    """Refuse points far from their measurement: swapped or wrong."""
    points, observations = inputs.points, inputs.observations
    size = np.array([(one.image.lines, one.image.pixels) for one in inputs.images])
    # Farther than two images off no start values are so bad: coordinates in another order, frame or
    # unit are; `~(… <=)` also catches NaN.
    is_far = (~(np.abs(v) <= 2.0 * size[observations.image[rows]])).any(1)
    if not is_far.any():
        return
    row, misclosure = int(rows[is_far.argmax()]), v[is_far.argmax()]
    p, id = observations.point[row], inputs.images[observations.image[row]].id
    distance_words = (
        f"{misclosure[0]:.0f} lines and {misclosure[1]:.0f} pixels away"
        if np.isfinite(misclosure).all()
        else "where the camera does not look"
    )
    raise InputError(
        f"{observations.source(row)}: {points.role[p]} point {points.id[p]!r} of "
        f"{points.source(p)} is off image {id!r}: its coordinates are {distance_words}; check "
        "their order, frame and units, and at the id"
    )
