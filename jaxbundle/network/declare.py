"""A network as tables of unknowns and sets of observations for the engine.

| table | a row |
|---|---|
| image | projection centre, rotation as a unit quaternion (w, x, y, z), object → camera |
| camera | the parameters; cameras of several models have a table each, "camera, brown" |
| point | X, Y, Z; at any distance also the unit of distance (`leastsquares.any_distance`) |

| set of observations | declared in |
|---|---|
| image; of several models one each, "image, brown" | `kinds.image_points` |
| control | `kinds.control_points` |
| exterior | `kinds.exterior_orientation` |
| interior; of several models one each | `kinds.interior_orientation` |
| distance | `kinds.distances` |
| further ones, by the name of their kind | `kinds` |

Rotations live on the manifold: the change of an image is a rotation vector δθ in the camera frame,
M ← exp([δθ]×)·M. Everything else adds. Object coordinates are relative to an `origin`, so that a
national grid of 10⁷ m loses no digit.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.geometry.rotations import quaternion_from_omega_phi_kappa
from jaxbundle.leastsquares.any_distance import AnyDistance
from jaxbundle.leastsquares.declarations import Motions, ObservationSet, Table
from jaxbundle.leastsquares.indexing.indices import round_up
from jaxbundle.leastsquares.problem import distinct_names
from jaxbundle.leastsquares.spaces import Pose, PoseValue, Vector
from jaxbundle.network.camera_tables import CameraTable, camera_tables
from jaxbundle.network.kinds.base import included_tables
from jaxbundle.network.kinds.control_points import declare_control_points
from jaxbundle.network.kinds.distances import declare_distances
from jaxbundle.network.kinds.exterior_orientation import declare_exterior_orientation
from jaxbundle.network.kinds.image_points import declare_image_points
from jaxbundle.network.kinds.interior_orientation import declare_interior_orientation
from jaxbundle.network.motions import SIMILARITY, SIMILARITY_AT_ANY_DISTANCE
from jaxbundle.network.tables import EXTERIOR, Network
from jaxbundle.network.user_observations import place_in_object_space, split_by_type
from jaxbundle.system.programs import compile_once

# Smallest batch of rotations, so that networks of fewer images share one compiled program:
# compiling takes a second, converting 64 rotations no time.
LEAST_IMAGES = 64


@dataclasses.dataclass(frozen=True)
class DeclaredNetwork:
    """A network for the engine.

    `cameras`: their tables; `image_rows`: by set of image points, the rows of the network's
    observations that are in it; `further_sets`, `further_tables`: the names of those that a network
    of image points, control, priors and distances does not have; `origin` [3] was subtracted from
    all object coordinates; `lengths` [points]: the unit of distance of points at any distance, 0
    for the others, None if there are none; `motions`: the similarities that may be open."""

    tables: tuple[Table, ...]
    observations: tuple[ObservationSet, ...]
    cameras: tuple[CameraTable, ...]
    image_rows: Mapping[str, Int[np.ndarray, " rows"]]
    further_sets: tuple[str, ...]
    further_tables: tuple[str, ...]
    origin: Float[np.ndarray, "3"]
    lengths: Float[np.ndarray, " points"] | None
    motions: Motions


def declare(
    network: Network,
    origin: Float[np.ndarray, "3"] | None = None,
    also: Sequence[Table | ObservationSet] = (),
    lengths: Float[np.ndarray, " points"] | None = None,
) -> DeclaredNetwork:
    """The tables and observations of a checked network (`check_network`) without check points.

    `origin`: default the rounded centroid of the points; `also`: tables, and observations of other
    kinds (`user_observations.py`)."""
    # Rounded to whole units, a coordinate minus the origin keeps its written decimals.
    points = network.points
    if origin is None:
        origin = np.round(points.position.mean(0)) if len(points) else np.zeros(3)
    cameras = camera_tables(network.cameras)
    image_points, image_rows = declare_image_points(network, cameras)
    standard = [
        *image_points,
        *declare_control_points(network, origin),
        *declare_exterior_orientation(network, origin),
        *declare_interior_orientation(network, cameras),
        *declare_distances(network),
    ]
    # What image points touch is declared even where all of its rows are left out.
    changing = [
        table.restrict_to(network) for table in network.further if table.CHANGES_IMAGE_POINTS
    ]
    independent = [table for table in included_tables(network) if not table.CHANGES_IMAGE_POINTS]
    contributions = [table.declare(network, origin) for table in (*changing, *independent)]
    # Observations of users come last, and resolve ids of any table above.
    user_tables, user_sets = split_by_type(also)
    further_tables = user_tables + [
        table for contribution in contributions for table in contribution.tables
    ]
    tables = [
        _table_of_images(network, origin),
        *(table.unknowns(network.cameras) for table in cameras),
        _table_of_points(network, origin, lengths),
        *further_tables,
    ]
    further_sets = [
        place_in_object_space(user_set, origin).resolve_labels(tables) for user_set in user_sets
    ]
    further_sets += [
        further_set for contribution in contributions for further_set in contribution.observations
    ]
    observations = distinct_names([*standard, *further_sets])
    similarity = SIMILARITY if lengths is None else SIMILARITY_AT_ANY_DISTANCE
    actions = (
        *similarity.actions,
        *(action for contribution in contributions for action in contribution.actions),
    )
    return DeclaredNetwork(
        tuple(tables),
        observations,
        cameras,
        image_rows,
        tuple(further_set.name for further_set in observations[len(standard) :]),
        tuple(table.name for table in further_tables),
        origin,
        lengths,
        dataclasses.replace(similarity, actions=actions),
    )


def _table_of_images(network: Network, origin: Float[np.ndarray, "3"]) -> Table:
    images = network.images
    value = PoseValue(images.position - origin, _quaternions(images.angles))
    return Table("image", value, Pose(), images.sigma != 0, images.id, EXTERIOR)


def _table_of_points(
    network: Network,
    origin: Float[np.ndarray, "3"],
    lengths: Float[np.ndarray, " points"] | None,
) -> Table:
    points = network.points
    # X, Y, Z, and for a network with far points the unit of their distance as a fourth number; such
    # a row changes in direction and inverse distance.
    value, space = points.position - origin, Vector(3)
    if lengths is not None:
        value, space = np.concatenate([value, lengths[:, None]], 1), AnyDistance()
    free = ~points.has_role("fixed")
    return Table("point", value, space, free, points.id, ("X", "Y", "Z"))


def order_cameras(network: Network) -> Network:
    """The same network with its cameras in the order of the images, if each image has its own: the
    engine then uses one block for an image and its camera."""
    camera_of_image = network.images.camera
    if len(camera_of_image) == len(network.cameras) and len(set(camera_of_image)) == len(
        camera_of_image
    ):
        images = dataclasses.replace(network.images, camera=np.arange(len(camera_of_image)))
        network = network.replace(
            cameras=tuple(network.cameras[c] for c in camera_of_image), images=images
        )
    return network


def _quaternions(angles: Float[np.ndarray, "images 3"]) -> Float[np.ndarray, "images 4"]:
    """Rotations, by a program shared by small networks."""
    padded = np.resize(angles, (max(round_up(len(angles)), LEAST_IMAGES), 3))
    return np.asarray(_quaternions_of(padded))[: len(angles)]


_quaternions_of = compile_once(jax.vmap(quaternion_from_omega_phi_kappa), ())
