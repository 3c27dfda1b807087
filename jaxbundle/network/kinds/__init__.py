"""Further kinds of observations of a network: one file per kind, with a common interface
(`base.ObservationTable`)."""

from jaxbundle.network.kinds.antennas import Antennas as Antennas
from jaxbundle.network.kinds.attitudes import Attitudes as Attitudes
from jaxbundle.network.kinds.azimuths import Azimuths as Azimuths
from jaxbundle.network.kinds.base import ObservationTable as ObservationTable
from jaxbundle.network.kinds.camera_parameters import CameraParameters as CameraParameters
from jaxbundle.network.kinds.differences import Angles as Angles
from jaxbundle.network.kinds.differences import Differences as Differences
from jaxbundle.network.kinds.exterior_orientation import ExteriorPriors as ExteriorPriors
from jaxbundle.network.kinds.figures import Figures as Figures
from jaxbundle.network.kinds.figures import Shapes as Shapes
from jaxbundle.network.kinds.interfaces import Interfaces as Interfaces
from jaxbundle.network.kinds.lines import Edges as Edges
from jaxbundle.network.kinds.rigs import Rigs as Rigs
from jaxbundle.network.kinds.robot_poses import RobotPoses as RobotPoses
from jaxbundle.network.kinds.rolling_shutter import RollingShutter as RollingShutter
from jaxbundle.network.kinds.surface_points import SurfacePoints as SurfacePoints
from jaxbundle.network.kinds.ties import Ties as Ties
from jaxbundle.network.kinds.tilts import Tilts as Tilts

# By the name of their table.
KINDS = {
    kind.TABLE: kind
    for kind in (
        Antennas,
        Attitudes,
        Tilts,
        Azimuths,
        Rigs,
        RobotPoses,
        RollingShutter,
        Interfaces,
        Differences,
        Angles,
        Figures,
        Shapes,
        SurfacePoints,
        Edges,
        Ties,
        CameraParameters,
        ExteriorPriors,
    )
}
SECTIONS = tuple(kind.SECTION for kind in KINDS.values() if kind.SECTION)
