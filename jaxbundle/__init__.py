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
from jaxbundle.bundle import adjust as adjust
from jaxbundle.errors import InputError as InputError
from jaxbundle.errors import NotSolvedError as NotSolvedError
from jaxbundle.gradients import check_gradients as check_gradients
from jaxbundle.io import read_network as read_network
from jaxbundle.network import Camera as Camera
from jaxbundle.network import Network as Network
from jaxbundle.network.arrays import Data as Data
from jaxbundle.network.arrays import Values as Values
from jaxbundle.network.build import make_network as make_network
from jaxbundle.result import Adjustment as Adjustment


def enable_x64() -> None:
    """Switch JAX to 64-bit floats; call it before the first JAX computation."""
    import jax

    jax.config.update("jax_enable_x64", True)


__version__ = "0.1.0"
