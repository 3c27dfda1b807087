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

# By module; __init__.pyi has their types, for editors and type checkers: `make stubs` writes it.
_HOME = {
    "jaxbundle.adjustment": (
        "make_problem",
        "solve",
    ),
    "jaxbundle.adjustment.gradients": ("check_gradients",),
    "jaxbundle.batches.calibrate": (
        "BatchCalibration",
        "calibrate_batch",
    ),
    "jaxbundle.batches.calibrate_rigs": (
        "RigBatch",
        "calibrate_rigs",
    ),
    "jaxbundle.adjustment.adjust": ("adjust",),
    "jaxbundle.adjustment.compare": ("AdjustmentComparison",),
    "jaxbundle.adjustment.influence": (
        "Influence",
        "influence",
    ),
    "jaxbundle.adjustment.load_saved": ("load_adjustment",),
    "jaxbundle.adjustment.orient": ("orient",),
    "jaxbundle.adjustment.replicate": (
        "Replication",
        "replicate",
    ),
    "jaxbundle.adjustment.result": ("Adjustment",),
    "jaxbundle.adjustment.error_budget": (
        "Budget",
        "sensitivity",
    ),
    "jaxbundle.adjustment.uncertainty_budget": (
        "UncertaintyBudget",
        "uncertainty_budget",
    ),
    "jaxbundle.calibration": (
        "Board",
        "BoardViews",
        "Calibration",
        "RigCalibration",
        "WandCalibration",
        "calibrate",
        "calibrate_cameras",
        "calibrate_rig",
        "calibrate_wand",
    ),
    "jaxbundle.calibration.as_opencv": ("calibrate_opencv",),
    "jaxbundle.calibration.stability": ("Stability",),
    "jaxbundle.cameras": ("CameraModel",),
    "jaxbundle.certificates.acceptance": (
        "Acceptance",
        "accept",
    ),
    "jaxbundle.certificates.document": (
        "Certificate",
        "certificate",
    ),
    "jaxbundle.certificates.lengths": (
        "LengthTest",
        "length_errors",
    ),
    "jaxbundle.certificates.positional": (
        "PositionalAccuracy",
        "positional_accuracy",
    ),
    "jaxbundle.commands.batch_run": (
        "BatchRun",
        "batch",
    ),
    "jaxbundle.commands.cameras": (
        "CameraDescription",
        "camera",
    ),
    "jaxbundle.commands.clouds": (
        "CloudResult",
        "cloud",
    ),
    "jaxbundle.commands.comparison": (
        "CalibrationComparison",
        "compare",
    ),
    "jaxbundle.commands.examples": ("example",),
    "jaxbundle.commands.exploring": ("explore",),
    "jaxbundle.commands.hand_eye": (
        "HandEye",
        "hand_eye",
    ),
    "jaxbundle.commands.planned_block": (
        "PlannedBlock",
        "plan",
    ),
    "jaxbundle.commands.reconstruction": ("reconstruct",),
    "jaxbundle.commands.stability_of_cameras": ("stability",),
    "jaxbundle.commands.surface_change": (
        "ChangeResult",
        "change",
    ),
    "jaxbundle.commands.surface": (
        "Surface",
        "surface",
    ),
    "jaxbundle.commands.video_frames": (
        "VideoFrames",
        "frames",
    ),
    "jaxbundle.errors": (
        "InputError",
        "NotSolvedError",
    ),
    "jaxbundle.float64": ("enable_x64",),
    "jaxbundle.io": (
        "convert",
        "read_network",
        "write_project",
    ),
    "jaxbundle.io.networks.opensfm_objects": ("from_opensfm",),
    "jaxbundle.io.networks.pycolmap_objects": (
        "from_pycolmap",
        "to_pycolmap",
    ),
    "jaxbundle.leastsquares": (
        "Data",
        "Problem",
        "Values",
    ),
    "jaxbundle.network": (
        "Camera",
        "Network",
    ),
    "jaxbundle.network.build": (
        "add_further",
        "make_network",
    ),
    "jaxbundle.network.check": ("check_network",),
    "jaxbundle.network_design.aims": ("Aim",),
    "jaxbundle.network_design.conditions": ("Conditions",),
    "jaxbundle.network_design.design": ("design",),
    "jaxbundle.network_design.result": ("Design",),
    "jaxbundle.orientation.network": ("Oriented",),
    "jaxbundle.planning.simulate": (
        "simulate",
        "simulate_with_truth",
    ),
    "jaxbundle.planning.simulate_further": ("simulate_further",),
    "jaxbundle.planning.stations": (
        "aerial_block",
        "cloud_of_targets",
        "grid_of_targets",
        "ring_of_stations",
        "stations_looking_at",
    ),
    "jaxbundle.reconstruction.result": ("Reconstruction",),
    "jaxbundle.adjustment.quality.precision": (
        "Precision",
        "precision",
        "redundancy",
    ),
    "jaxbundle.system.cores": ("use_cores",),
    "jaxbundle.system.joined_processes": ("join_processes",),
    "jaxbundle.system.kept_programs": ("keep_programs",),
    "jaxbundle.system.progress": ("show_progress",),
}
# Imported on first use, so that the command line can configure JAX and the linear algebra library
# before they start.
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)

__version__ = "0.3.0"
