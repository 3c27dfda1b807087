"""Line scanners: from trajectory and optics to the ground and back.

    image = read_scanner("scanner.toml").image            # jaxbundle.io.scanner; or make_image(…)
    X = locate_lines(image, Ground(), lines, pixels)      # [3, lines, pixels], metres
    found = project_points(image, make_search(image), X.reshape(3, -1))

    fit, check = fit_image(image, WGS84, (0.0, 3000.0))   # rational polynomials in its place:
    line, sample, status = rpc.project_points(fit.rpc, longitude, latitude, height)

Every array of a `PushbroomImage` is a parameter: `equinox.tree_at` replaces it, `jax.jacfwd`
differentiates by it. Times are in seconds, angles in radians, the Earth is WGS 84 unless another
ellipsoid is given. `docs/pushbroom.md` has the conventions.
"""

from . import rpc as rpc
from .accuracy import closed_form as closed_form
from .accuracy import drawn as drawn
from .accuracy import ground_errors as ground_errors
from .accuracy import propagated as propagated
from .ancillary import attitude_table as attitude_table
from .ancillary import position_table as position_table
from .corrections import Corrections as Corrections
from .frames import EarthOrientation as EarthOrientation
from .frames import circular_orbit as circular_orbit
from .frames import to_earth as to_earth
from .frames import turn_positions as turn_positions
from .frames import turn_quaternions as turn_quaternions
from .frames import two_line_orbit as two_line_orbit
from .image import Offsets as Offsets
from .image import PushbroomImage as PushbroomImage
from .image import make_image as make_image
from .image import pose_at as pose_at
from .locate import locate_lines as locate_lines
from .locate import locate_point as locate_point
from .locate import locate_points as locate_points
from .noise import Noise as Noise
from .noise import disturbed as disturbed
from .orbit import state_orbit as state_orbit
from .project import Projected as Projected
from .project import Status as Status
from .project import make_search as make_search
from .project import project_from as project_from
from .project import project_near as project_near
from .project import project_points as project_points
from .rpc import Rpc as Rpc
from .rpc import RpcStatus as RpcStatus
from .rpc_bias import compensated as compensated
from .rpc_bias import fit_bias as fit_bias
from .rpc_fit import RpcCheck as RpcCheck
from .rpc_fit import RpcFit as RpcFit
from .rpc_fit import RpcTable as RpcTable
from .rpc_fit import check_rpc as check_rpc
from .rpc_fit import fit_image as fit_image
from .rpc_fit import fit_rpc as fit_rpc
from .scanner import AnglePolynomial as AnglePolynomial
from .scanner import AngleTable as AngleTable
from .scanner import FocalLine as FocalLine
from .scanner import LineTimes as LineTimes
from .simulate import Flight as Flight
from .simulate import measured_image as measured_image
from .simulate import true_image as true_image
from .study import AccuracyTable as AccuracyTable
from .study import accuracy_table as accuracy_table
from .surfaces import Ground as Ground
from .surfaces import Height as Height
from .surfaces import Plane as Plane
from .terrain import Terrain as Terrain
from .terrain import make_terrain as make_terrain
from .trajectory import Trajectory as Trajectory
