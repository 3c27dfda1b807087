"""Networks: tables, checks, and their declaration to the engine."""

from jaxbundle.network.tables import Camera as Camera
from jaxbundle.network.tables import Distances as Distances
from jaxbundle.network.tables import Images as Images
from jaxbundle.network.tables import Network as Network
from jaxbundle.network.tables import Observations as Observations
from jaxbundle.network.tables import Points as Points
from jaxbundle.network.tables import Source as Source
