"""What is adjusted: the tables of a network, their checks, and the index plan of the solver."""

from jaxbundle.network.arrays import Data as Data
from jaxbundle.network.arrays import Tangent as Tangent
from jaxbundle.network.arrays import Values as Values
from jaxbundle.network.arrays import retract as retract
from jaxbundle.network.structure import Structure as Structure
from jaxbundle.network.structure import make_structure as make_structure
from jaxbundle.network.tables import Camera as Camera
from jaxbundle.network.tables import Distances as Distances
from jaxbundle.network.tables import Images as Images
from jaxbundle.network.tables import Network as Network
from jaxbundle.network.tables import Observations as Observations
from jaxbundle.network.tables import Points as Points
from jaxbundle.network.tables import Source as Source
