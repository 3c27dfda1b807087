"""`design`: the network with the smallest σ under given conditions.

    network = jaxbundle.simulate(stations, targets, camera, noise=0.002)
    room = jaxbundle.Conditions(room=((-4, -4, 0), (4, 4, 3)), distance=(1, 6), apart=0.5)
    designed = jaxbundle.design(network, "mean", conditions=room)
    print(designed, designed.proof)

The orders are those of Grafarend (1974), in the words of Fraser (1984): zero, the datum; first, the
configuration; second, the weights of observations, here of whole photographs; third, the
densification of an existing network.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.arguments import integer, one_of, positive, show
from jaxbundle.choices import DESIGNED, ORDERS
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.io.formats import as_network, recognise_format
from jaxbundle.io.networks.project import project_file
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.network.subsets import split_check_points
from jaxbundle.network.tables import Network, units_of
from jaxbundle.network_design.aims import Aim
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.configuration import design_configuration
from jaxbundle.network_design.datum_order import design_datum
from jaxbundle.network_design.further_photographs import add_photographs
from jaxbundle.network_design.pairs import make_pairs
from jaxbundle.network_design.priors import use_prior_tables
from jaxbundle.network_design.result import Design
from jaxbundle.network_design.selected_photographs import select_photographs
from jaxbundle.network_design.settings import DEFAULTS, DesignSettings


def design(  # noqa: PLR0913 (public: a table of options, all but two by name)
    network: Network | str | Path,
    aim: str | Aim = "mean",
    *,
    order: str = "first",
    conditions: Conditions | None = None,
    free: Sequence[str] = DESIGNED[:3],
    stations: Sequence[str] | None = None,
    photographs: int | None = None,
    sigma_image: float | None = None,
    starts: int = 1,
    max_iterations: int = 60,
    seed: int = 0,
    settings: DesignSettings = DEFAULTS,
) -> Design:
    """Design a network: minimise an aim under conditions.

    **Arguments:**

    - `network`: cameras with their `image_size`, targets, and stations to start from, or the path
      of such a project; image points are needed only to add a photograph to an existing network.
    - `aim`: "mean", "worst", "determinant" of the σ of points, "reliability", or an `Aim`.
    - `order`: "zero": the datum of smallest mean σ. "first": positions, directions and roll of
      stations, and targets (`free`: some of "position", "direction", "roll", "targets"), of all
      stations or those in `stations`; for a calibration these are the poses of the board
      (`Design.board_poses`). "second": select this number of `photographs` from the given
      candidates. "third": add this number of `photographs`, default 1, with the last camera.
    - `sigma_image`: σ of future image coordinates, in the unit of the camera models; default: the
      median of the network, or that of a project without image points.
    - `starts`: number of searches of first order, all but one from random stations in the room.
    - `max_iterations`: per round of the search; `seed`: random seed; `settings`: of the search.

    **Returns:** a `Design`. Both of its states are without softness of the visibility.

    **Raises:** `InputError` for conditions that no station satisfies, targets that none sees, an
    aim that depends on the datum; `NotSolvedError` if no network that determines the aim was found.
    """
    require_x64()
    one_of("order", order, tuple(ORDERS))
    aim = aim if isinstance(aim, Aim) else Aim(aim)
    if conditions is not None and not isinstance(conditions, Conditions):
        raise InputError(f"conditions must be Conditions, but is {show(conditions)}")
    conditions = Conditions() if conditions is None else conditions
    # Check points have no part in an adjustment, and so none in its σ.
    given_network = as_network(network, oriented=True)
    if sigma_image is None and isinstance(network, str | os.PathLike):
        sigma_image = _sigma_of_project(Path(network), given_network)
    network = use_prior_tables(split_check_points(given_network)[0])
    sigma = _sigma(network, sigma_image)
    integer("starts", starts)
    if order == "zero":
        return design_datum(network, aim, conditions, sigma, seed)
    if order == "second":
        return select_photographs(
            network, aim, conditions, sigma, photographs, max_iterations, seed, settings
        )
    if order == "third":
        number_added = 1 if photographs is None else integer("photographs", photographs)
        return add_photographs(
            network, aim, conditions, sigma, number_added, max_iterations, seed, settings
        )
    if photographs is not None:
        raise InputError('photographs: their number is designed by order "second" or "third"')
    pairs = make_pairs(network, aim, conditions, sigma)
    return design_configuration(
        pairs, network, tuple(free), stations, starts, max_iterations, seed, settings
    )


def _sigma(network: Network, stated: float | None) -> float:
    if stated is not None:
        return positive("sigma_image", stated)
    sigma = network.observations.sigma
    if not len(sigma) or not np.isfinite(sigma).any():
        raise InputError("sigma_image: the network has no image points; give the σ they will have")
    return float(np.nanmedian(sigma))


def _sigma_of_project(path: Path, network: Network) -> float | None:
    """`sigma_image` of a project without image points; None if image points or no setting give
    it."""
    if len(network.observations) or recognise_format(path) != "project":
        return None
    stated = read_toml(project_file(path))["project"].get("sigma_image")
    if stated is None or network.image_unit != units_of(network.cameras):
        return None
    return positive("sigma_image", stated)
