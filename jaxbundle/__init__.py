"""jaxbundle: autodiff least squares for photogrammetry.

    import jaxbundle

    jaxbundle.enable_x64()
    network = jaxbundle.read_network("examples/convergent4/project.toml")
    result = jaxbundle.adjust(network)
    print(result)

Importing configures nothing. `enable_x64` switches JAX to the required 64-bit floats, `use_cores`
uses all cores for large networks, `keep_programs` keeps compiled programs.
"""

from jaxbundle.lazy import import_on_use

TYPE_CHECKING = False  # avoids importing typing

if TYPE_CHECKING:
    from jaxbundle.adjustment import make_problem as make_problem
    from jaxbundle.adjustment import solve as solve
    from jaxbundle.adjustment.adjust import adjust as adjust
    from jaxbundle.adjustment.compare import AdjustmentComparison as AdjustmentComparison
    from jaxbundle.adjustment.compare import compare as compare
    from jaxbundle.adjustment.gradients import check_gradients as check_gradients
    from jaxbundle.adjustment.influence import Influence as Influence
    from jaxbundle.adjustment.influence import influence as influence
    from jaxbundle.adjustment.load import load_adjustment as load_adjustment
    from jaxbundle.adjustment.orient import orient as orient
    from jaxbundle.adjustment.quality.precision import Precision as Precision
    from jaxbundle.adjustment.quality.precision import precision as precision
    from jaxbundle.adjustment.quality.precision import redundancy as redundancy
    from jaxbundle.adjustment.result import Adjustment as Adjustment
    from jaxbundle.adjustment.sensitivity import Budget as Budget
    from jaxbundle.adjustment.sensitivity import sensitivity as sensitivity
    from jaxbundle.batch.calibrate import BatchCalibration as BatchCalibration
    from jaxbundle.batch.calibrate import calibrate_batch as calibrate_batch
    from jaxbundle.batch.calibrate_rigs import RigBatch as RigBatch
    from jaxbundle.batch.calibrate_rigs import calibrate_rigs as calibrate_rigs
    from jaxbundle.calibration import Board as Board
    from jaxbundle.calibration import BoardViews as BoardViews
    from jaxbundle.calibration import Calibration as Calibration
    from jaxbundle.calibration import calibrate as calibrate
    from jaxbundle.calibration import calibrate_cameras as calibrate_cameras
    from jaxbundle.cameras import CameraModel as CameraModel
    from jaxbundle.errors import InputError as InputError
    from jaxbundle.errors import NotSolvedError as NotSolvedError
    from jaxbundle.float64 import enable_x64 as enable_x64
    from jaxbundle.io import convert as convert
    from jaxbundle.io import read_network as read_network
    from jaxbundle.io import write_project as write_project
    from jaxbundle.leastsquares import Data as Data
    from jaxbundle.leastsquares import Problem as Problem
    from jaxbundle.leastsquares import Values as Values
    from jaxbundle.network import Camera as Camera
    from jaxbundle.network import Network as Network
    from jaxbundle.network.build import add_further as add_further
    from jaxbundle.network.build import make_network as make_network
    from jaxbundle.network.check import check_network as check_network
    from jaxbundle.network_design.aims import Aim as Aim
    from jaxbundle.network_design.conditions import Conditions as Conditions
    from jaxbundle.network_design.design import design as design
    from jaxbundle.network_design.result import Design as Design
    from jaxbundle.orientation.network import Oriented as Oriented
    from jaxbundle.planning.simulate import simulate as simulate
    from jaxbundle.planning.simulate import simulate_with_truth as simulate_with_truth
    from jaxbundle.planning.simulate_further import simulate_further as simulate_further
    from jaxbundle.planning.stations import aerial_block as aerial_block
    from jaxbundle.planning.stations import cloud_of_targets as cloud_of_targets
    from jaxbundle.planning.stations import grid_of_targets as grid_of_targets
    from jaxbundle.planning.stations import ring_of_stations as ring_of_stations
    from jaxbundle.planning.stations import stations_looking_at as stations_looking_at
    from jaxbundle.system.configuration import join_processes as join_processes
    from jaxbundle.system.configuration import keep_programs as keep_programs
    from jaxbundle.system.configuration import use_cores as use_cores
    from jaxbundle.system.progress import show_progress as show_progress

_HOME = {
    "jaxbundle.adjustment": ("make_problem", "solve"),
    "jaxbundle.batch.calibrate": ("BatchCalibration", "calibrate_batch"),
    "jaxbundle.batch.calibrate_rigs": ("RigBatch", "calibrate_rigs"),
    "jaxbundle.adjustment.adjust": ("adjust",),
    "jaxbundle.calibration": (
        "Board",
        "BoardViews",
        "Calibration",
        "calibrate",
        "calibrate_cameras",
    ),
    "jaxbundle.cameras": ("CameraModel",),
    "jaxbundle.system.configuration": ("join_processes", "keep_programs", "use_cores"),
    "jaxbundle.system.progress": ("show_progress",),
    "jaxbundle.errors": ("InputError", "NotSolvedError"),
    "jaxbundle.float64": ("enable_x64",),
    "jaxbundle.adjustment.gradients": ("check_gradients",),
    "jaxbundle.io": ("convert", "read_network", "write_project"),
    "jaxbundle.network": ("Camera", "Network"),
    "jaxbundle.leastsquares": ("Data", "Problem", "Values"),
    "jaxbundle.network.build": ("add_further", "make_network"),
    "jaxbundle.network.check": ("check_network",),
    "jaxbundle.network_design.aims": ("Aim",),
    "jaxbundle.network_design.conditions": ("Conditions",),
    "jaxbundle.network_design.design": ("design",),
    "jaxbundle.network_design.result": ("Design",),
    "jaxbundle.planning.simulate": ("simulate", "simulate_with_truth"),
    "jaxbundle.planning.simulate_further": ("simulate_further",),
    "jaxbundle.planning.stations": (
        "aerial_block",
        "cloud_of_targets",
        "grid_of_targets",
        "ring_of_stations",
        "stations_looking_at",
    ),
    "jaxbundle.orientation.network": ("Oriented",),
    "jaxbundle.adjustment.orient": ("orient",),
    "jaxbundle.adjustment.result": ("Adjustment",),
    "jaxbundle.adjustment.load": ("load_adjustment",),
    "jaxbundle.adjustment.compare": ("AdjustmentComparison", "compare"),
    "jaxbundle.adjustment.sensitivity": ("Budget", "sensitivity"),
    "jaxbundle.adjustment.influence": ("Influence", "influence"),
    "jaxbundle.adjustment.quality.precision": ("Precision", "precision", "redundancy"),
}
# Imported on first use, so that the command line can configure JAX and the linear algebra library
# before they start.
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)  # pyright: ignore[reportUnsupportedDunderAll]

__version__ = "0.3.0"
