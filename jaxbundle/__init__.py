"""jaxbundle: autodiff least squares for photogrammetry.

    import jaxbundle

    jaxbundle.enable_x64()
    network = jaxbundle.read_network("examples/convergent4/project.toml")
    result = jaxbundle.adjust(network)
    print(result)

Importing configures nothing; `enable_x64` switches JAX to the 64-bit floats adjustment needs.
"""

from jaxbundle.adjustment import Problem as Problem
from jaxbundle.adjustment import make_problem as make_problem
from jaxbundle.adjustment import solve as solve
from jaxbundle.adjustment.batch import BatchCalibration as BatchCalibration
from jaxbundle.adjustment.batch import calibrate_batch as calibrate_batch
from jaxbundle.bundle import adjust as adjust
from jaxbundle.errors import InputError as InputError
from jaxbundle.errors import NotSolvedError as NotSolvedError
from jaxbundle.gradients import check_gradients as check_gradients
from jaxbundle.io import read_network as read_network
from jaxbundle.io import write_project as write_project
from jaxbundle.network import Camera as Camera
from jaxbundle.network import Network as Network
from jaxbundle.network.arrays import Data as Data
from jaxbundle.network.arrays import Values as Values
from jaxbundle.network.build import make_network as make_network
from jaxbundle.network.check import check_network as check_network
from jaxbundle.network.simulate import simulate as simulate
from jaxbundle.network.simulate import simulate_with_truth as simulate_with_truth
from jaxbundle.network.stations import aerial_block as aerial_block
from jaxbundle.network.stations import cloud_of_targets as cloud_of_targets
from jaxbundle.network.stations import grid_of_targets as grid_of_targets
from jaxbundle.network.stations import ring_of_stations as ring_of_stations
from jaxbundle.network.stations import stations_looking_at as stations_looking_at
from jaxbundle.result import Adjustment as Adjustment


def enable_x64() -> None:
    """Switch JAX to 64-bit floats; call it before the first JAX computation."""
    import jax

    jax.config.update("jax_enable_x64", True)


__version__ = "0.1.0"
