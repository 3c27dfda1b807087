"""Line scanners: from trajectory and optics to the ground and back.

    image = read_scanner("scanner.toml").image            # jaxbundle.io.scanner; or make_image(…)
    X = locate_lines(image, Ground(), lines, pixels)      # [3, lines, pixels], metres
    found = project_points(image, make_search(image), X.reshape(3, -1))

    fit, check = fit_image(image, WGS84, (0.0, 3000.0))   # rational polynomials instead:
    line, sample, status = rpc.project_points(fit.rpc, longitude, latitude, height)

Every array of a `PushbroomImage` is a parameter: `equinox.tree_at` replaces it, `jax.jacfwd`
differentiates by it. Times are in seconds, angles in radians, the Earth is WGS 84 unless another
ellipsoid is given. `docs/pushbroom.md` has the conventions.
"""

from jaxbundle.pushbroom import rpc as rpc
from jaxbundle.pushbroom.accuracy import closed_form as closed_form
from jaxbundle.pushbroom.accuracy import ground_errors as ground_errors
from jaxbundle.pushbroom.accuracy import propagate_accuracy as propagate_accuracy
from jaxbundle.pushbroom.accuracy import simulate_accuracy as simulate_accuracy
from jaxbundle.pushbroom.accuracy import spread_positions as spread_positions
from jaxbundle.pushbroom.ancillary import attitude_table as attitude_table
from jaxbundle.pushbroom.ancillary import position_table as position_table
from jaxbundle.pushbroom.corrections import Corrections as Corrections
from jaxbundle.pushbroom.earth_frames import EarthOrientation as EarthOrientation
from jaxbundle.pushbroom.earth_frames import circular_orbit as circular_orbit
from jaxbundle.pushbroom.earth_frames import to_earth as to_earth
from jaxbundle.pushbroom.earth_frames import turn_positions as turn_positions
from jaxbundle.pushbroom.earth_frames import turn_quaternions as turn_quaternions
from jaxbundle.pushbroom.earth_frames import two_line_orbit as two_line_orbit
from jaxbundle.pushbroom.image import Offsets as Offsets
from jaxbundle.pushbroom.image import PushbroomImage as PushbroomImage
from jaxbundle.pushbroom.image import make_image as make_image
from jaxbundle.pushbroom.image import pose_at as pose_at
from jaxbundle.pushbroom.locate import locate_lines as locate_lines
from jaxbundle.pushbroom.locate import locate_point as locate_point
from jaxbundle.pushbroom.locate import locate_points as locate_points
from jaxbundle.pushbroom.noise import Noise as Noise
from jaxbundle.pushbroom.noise import add_errors as add_errors
from jaxbundle.pushbroom.orbit import state_orbit as state_orbit
from jaxbundle.pushbroom.project import Projected as Projected
from jaxbundle.pushbroom.project import Status as Status
from jaxbundle.pushbroom.project import make_search as make_search
from jaxbundle.pushbroom.project import project_from as project_from
from jaxbundle.pushbroom.project import project_near as project_near
from jaxbundle.pushbroom.project import project_points as project_points
from jaxbundle.pushbroom.rpc import Rpc as Rpc
from jaxbundle.pushbroom.rpc import RpcStatus as RpcStatus
from jaxbundle.pushbroom.rpc_bias import apply_bias as apply_bias
from jaxbundle.pushbroom.rpc_bias import fit_bias as fit_bias
from jaxbundle.pushbroom.rpc_fit import RpcCheck as RpcCheck
from jaxbundle.pushbroom.rpc_fit import RpcFit as RpcFit
from jaxbundle.pushbroom.rpc_fit import RpcTable as RpcTable
from jaxbundle.pushbroom.rpc_fit import check_rpc as check_rpc
from jaxbundle.pushbroom.rpc_fit import fit_image as fit_image
from jaxbundle.pushbroom.rpc_fit import fit_rpc as fit_rpc
from jaxbundle.pushbroom.scanner import AnglePolynomial as AnglePolynomial
from jaxbundle.pushbroom.scanner import AngleTable as AngleTable
from jaxbundle.pushbroom.scanner import FocalLine as FocalLine
from jaxbundle.pushbroom.scanner import LineTimes as LineTimes
from jaxbundle.pushbroom.search_settings import SearchSettings as SearchSettings
from jaxbundle.pushbroom.simulate import Flight as Flight
from jaxbundle.pushbroom.simulate import measured_image as measured_image
from jaxbundle.pushbroom.simulate import true_image as true_image
from jaxbundle.pushbroom.study import AccuracyTable as AccuracyTable
from jaxbundle.pushbroom.study import accuracy_table as accuracy_table
from jaxbundle.pushbroom.surfaces import Ground as Ground
from jaxbundle.pushbroom.surfaces import Height as Height
from jaxbundle.pushbroom.surfaces import Plane as Plane
from jaxbundle.pushbroom.terrain import Terrain as Terrain
from jaxbundle.pushbroom.terrain import make_terrain as make_terrain
from jaxbundle.pushbroom.trajectory import Trajectory as Trajectory
