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

from jaxbundle.pushbroom import rpc
from jaxbundle.pushbroom.accuracy import (
    closed_form,
    ground_errors,
    propagate_accuracy,
    simulate_accuracy,
    spread_positions,
)
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.earth_frames import (
    EarthOrientation,
    circular_orbit,
    to_earth,
    turn_positions,
    turn_quaternions,
    two_line_orbit,
)
from jaxbundle.pushbroom.image import Offsets, PushbroomImage, make_image, pose_at
from jaxbundle.pushbroom.locate import locate_lines, locate_point, locate_points
from jaxbundle.pushbroom.noise import Noise, add_errors
from jaxbundle.pushbroom.orbit import state_orbit
from jaxbundle.pushbroom.project import (
    Projected,
    ProjectionStatus,
    make_search,
    project_from,
    project_near,
    project_points,
)
from jaxbundle.pushbroom.rpc import Rpc, RpcStatus
from jaxbundle.pushbroom.rpc_bias import apply_bias, fit_bias
from jaxbundle.pushbroom.rpc_fit import RpcCheck, RpcFit, RpcTable, check_rpc, fit_image, fit_rpc
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable, FocalLine, LineTimes
from jaxbundle.pushbroom.search_settings import SearchSettings
from jaxbundle.pushbroom.simulate import Flight, measured_image, true_image
from jaxbundle.pushbroom.study import AccuracyTable, accuracy_table
from jaxbundle.pushbroom.surfaces import Ground, Height, Plane
from jaxbundle.pushbroom.terrain import Terrain, make_terrain
from jaxbundle.pushbroom.trajectory import Trajectory

__all__ = [
    "AccuracyTable",
    "AnglePolynomial",
    "AngleTable",
    "Corrections",
    "EarthOrientation",
    "Flight",
    "FocalLine",
    "Ground",
    "Height",
    "LineTimes",
    "Noise",
    "Offsets",
    "Plane",
    "Projected",
    "PushbroomImage",
    "Rpc",
    "RpcCheck",
    "RpcFit",
    "RpcStatus",
    "RpcTable",
    "SearchSettings",
    "ProjectionStatus",
    "Terrain",
    "Trajectory",
    "accuracy_table",
    "add_errors",
    "apply_bias",
    "attitude_table",
    "check_rpc",
    "circular_orbit",
    "closed_form",
    "fit_bias",
    "fit_image",
    "fit_rpc",
    "ground_errors",
    "locate_lines",
    "locate_point",
    "locate_points",
    "make_image",
    "make_search",
    "make_terrain",
    "measured_image",
    "pose_at",
    "position_table",
    "project_from",
    "project_near",
    "project_points",
    "propagate_accuracy",
    "rpc",
    "simulate_accuracy",
    "spread_positions",
    "state_orbit",
    "to_earth",
    "true_image",
    "turn_positions",
    "turn_quaternions",
    "two_line_orbit",
]
