"""Further kinds of observations of a network: one file per kind, with a common interface
(`base.Further`)."""

from jaxbundle.network.further import attitudes, differences
from jaxbundle.network.further.antennas import Antennas as Antennas
from jaxbundle.network.further.attitudes import Attitudes as Attitudes
from jaxbundle.network.further.base import Further as Further
from jaxbundle.network.further.camera_parameters import CameraParameters as CameraParameters
from jaxbundle.network.further.differences import Angles as Angles
from jaxbundle.network.further.differences import Differences as Differences
from jaxbundle.network.further.exterior_priors import ExteriorPriors as ExteriorPriors
from jaxbundle.network.further.figures import Figures as Figures
from jaxbundle.network.further.figures import Shapes as Shapes
from jaxbundle.network.further.lines import Edges as Edges
from jaxbundle.network.further.rigs import Rigs as Rigs
from jaxbundle.network.further.rolling_shutter import RollingShutter as RollingShutter
from jaxbundle.network.further.ties import Ties as Ties

KINDS = {
    kind.TABLE: kind
    for kind in (
        Antennas,
        Attitudes,
        Rigs,
        RollingShutter,
        Differences,
        Angles,
        Figures,
        Shapes,
        Edges,
        Ties,
        CameraParameters,
        ExteriorPriors,
    )
}
"""By the name of their table."""
OF_ANGLES = {kind.name for kind in (attitudes.ATTITUDE, attitudes.PRIOR, differences.ANGLE)}
"""The kinds whose residuals are angles, radians."""
SECTIONS = tuple(kind.SECTION for kind in KINDS.values() if kind.SECTION)
