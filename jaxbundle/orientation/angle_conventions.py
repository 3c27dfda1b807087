"""Start values of images in another convention than the expected one: angles in another unit,
matrices in the other direction, axes of computer vision, a translation for the projection centre.

Start values of images and points predict every image point. If the predictions are far from the
measurements, but close with the same numbers in another convention, that is theirs.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.pose_conventions import D
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation import batched
from jaxbundle.orientation.incremental import Model, misclosures
from jaxbundle.orientation.rays import make_sights
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings

Angles = Float[np.ndarray, "images 3"]
Matrices = Float[np.ndarray, "images 3 3"]
Centres = Float[np.ndarray, "images 3"]

EXPECTED = (
    "the projection centre X0, Y0, Z0, and the angles of M = R3(kappa)·R2(phi)·R1(omega), which "
    "leads from the object to a camera with x right and y up that looks along −z"
)
ANGLE_NAMES = np.array(["omega", "phi", "kappa"])


def name_angle_convention(network: Network, settings: StartValueSettings = DEFAULTS) -> str:
    """The unit or convention in which the start values of the images fit the measurements, in
    words; empty if the given one fits, or no other does."""
    sights, images = make_sights(network), network.images
    poses = np.concatenate([images.position, images.angles], axis=1)
    has_pose = np.all(np.isfinite(poses), axis=1)
    has_coordinates = np.all(np.isfinite(network.points.position), axis=1)
    rows = has_pose[sights.image] & has_coordinates[sights.point]
    if not rows.any():
        return ""
    angles, centres = images.angles[has_pose], images.position[has_pose]

    def misclosure(M: Matrices, X0: Centres) -> float:
        model = Model.empty(sights)
        model.place(has_pose, X0, M)
        model.X[has_coordinates] = network.points.position[has_coordinates]
        relative = misclosures(sights, model)[rows] / sights.tolerance[sights.image[rows]]
        return float(np.median(relative))

    # Half of the image points out of the question in the given convention, half within the
    # tolerance in another; start values that are only poor are neither.
    if not misclosure(batched.matrices(angles), centres) > settings.gross_ratio:
        return ""
    for words, M, X0 in itertools.chain(
        _in_other_units(angles, centres, network.angle_unit), _in_conventions(angles, centres)
    ):
        if misclosure(M, X0) < 1:
            return f"the start values of the images fit the measurements if {words}"
    return ""


def _in_other_units(
    angles: Angles, centres: Centres, given_unit: str
) -> Iterator[tuple[str, Matrices, Centres]]:
    for unit, factor in ANGLE_UNITS.items():
        if unit != given_unit:
            words = (
                f'omega, phi, kappa are in {unit}, not in {given_unit}: set angle_unit = "{unit}"'
            )
            yield words, batched.matrices(angles * factor / ANGLE_UNITS[given_unit]), centres


def _in_conventions(angles: Angles, centres: Centres) -> Iterator[tuple[str, Matrices, Centres]]:
    """Other meanings of the same numbers, the usual ones first."""
    remedy = f"; expected are {EXPECTED}: convert them in the input"
    G = batched.matrices(angles)
    for is_vision, is_inverse, is_translation in itertools.product([False, True], repeat=3):
        R = _transposed(G) if is_inverse else G
        words = (
            "the axes of the cameras have y down and z forward" * is_vision,
            "the rotations lead from the camera to the object" * is_inverse,
            "X0, Y0, Z0 is the translation t of x = R·X + t" * is_translation,
        )
        if any(words):
            M = D[:, None] * R if is_vision else R
            X0 = -np.einsum("nji,nj->ni", R, centres) if is_translation else centres
            yield " and ".join(filter(None, words)) + remedy, M, X0
    for order in itertools.permutations(range(3)):
        if order != (0, 1, 2):
            given = ", ".join(ANGLE_NAMES[list(np.argsort(order))])
            yield (
                f"omega, phi, kappa are in fact {given}{remedy}",
                batched.matrices(angles[:, order]),
                centres,
            )
    yield f"the angles have the opposite sign{remedy}", batched.matrices(-angles), centres
    R1, R2, R3 = (batched.matrices(angles * np.eye(3)[k]) for k in range(3))
    for words, product in (
        ("R1(omega)·R2(phi)·R3(kappa)", R1 @ R2 @ R3),
        ("R3(kappa)·R1(omega)·R2(phi)", R3 @ R1 @ R2),
    ):
        yield f"the matrix is {words}{remedy}", product, centres


def _transposed(M: Matrices) -> Matrices:
    return M.transpose(0, 2, 1)
