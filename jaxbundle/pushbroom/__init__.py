"""Line scanners: from trajectory and optics to the ground and back.

    table = locate("scanner.toml", grid=(3, 3))           # the commands, on files

    image = read_scanner("scanner.toml").image            # jaxbundle.io.scanner; or make_image(…)
    X = locate_lines(image, Ground(), lines, pixels)      # [3, lines, pixels], metres
    found = project_points(image, make_search(image), X.reshape(3, -1))

    fit, check = fit_image(image, WGS84, (0.0, 3000.0))   # rational polynomials instead:
    line, sample, status = rpc.project_points(fit.rpc, longitude, latitude, height)

Every array of a `PushbroomImage` is a parameter: `equinox.tree_at` replaces it, `jax.jacfwd`
differentiates by it. Times are in seconds, angles in radians, the Earth is WGS 84 unless another
ellipsoid is given. `docs/pushbroom.md` has the conventions.
"""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.commands.corrected_maps": (
        "CorrectedImage",
        "correct",
    ),
    "jaxbundle.commands.scanner_images": (
        "refine",
        "simulate",
    ),
    "jaxbundle.commands.scanner_info": (
        "ScannerInfo",
        "info",
    ),
    "jaxbundle.commands.scanner_ties": ("tie",),
    "jaxbundle.commands.scanner_tables": (
        "ScannerTable",
        "accuracy",
        "locate",
        "project",
    ),
    "jaxbundle.pushbroom.ancillary": (
        "attitude_table",
        "position_table",
    ),
    "jaxbundle.pushbroom.corrections": ("Corrections",),
    "jaxbundle.pushbroom.earth_frames": (
        "EarthOrientation",
        "circular_orbit",
        "to_earth",
        "turn_positions",
        "turn_quaternions",
        "two_line_orbit",
    ),
    "jaxbundle.pushbroom.error_propagation": (
        "closed_form",
        "ground_errors",
        "propagate_accuracy",
        "simulate_accuracy",
        "spread_positions",
    ),
    "jaxbundle.pushbroom.flight": (
        "Flight",
        "measured_image",
        "take_image",
        "true_image",
    ),
    "jaxbundle.pushbroom.ground_to_image": (
        "Projected",
        "ProjectionStatus",
        "make_search",
        "project_from",
        "project_near",
        "project_points",
    ),
    "jaxbundle.pushbroom.image": (
        "Offsets",
        "PushbroomImage",
        "make_image",
        "pose_at",
    ),
    "jaxbundle.pushbroom.image_to_ground": (
        "locate_lines",
        "locate_point",
        "locate_points",
    ),
    "jaxbundle.pushbroom.map_accuracy": (
        "MapErrors",
        "covariance_lattice",
    ),
    "jaxbundle.pushbroom.noise": (
        "Noise",
        "add_errors",
    ),
    "jaxbundle.pushbroom.orbit": ("state_orbit",),
    "jaxbundle.pushbroom.rectification": ("BLOCK_SIZE", "NODE_STEP", "block_places"),
    "jaxbundle.pushbroom.resampling": ("resample",),
    "jaxbundle.pushbroom.rpc.agreement": (
        "Agreement",
        "compare_with_rpc",
    ),
    "jaxbundle.pushbroom.rpc.polynomials": (
        "Rpc",
        "RpcStatus",
    ),
    "jaxbundle.pushbroom.rpc.image": ("RpcImage",),
    "jaxbundle.pushbroom.rpc.bias": (
        "apply_bias",
        "fit_bias",
    ),
    "jaxbundle.pushbroom.rpc.fitting": (
        "RpcCheck",
        "RpcFit",
        "RpcTable",
        "check_rpc",
        "fit_image",
        "fit_rpc",
    ),
    "jaxbundle.pushbroom.scanner": (
        "AnglePolynomial",
        "AngleTable",
        "FocalLine",
        "LineTimes",
    ),
    "jaxbundle.pushbroom.search_settings": ("SearchSettings",),
    "jaxbundle.pushbroom.study": (
        "AccuracyTable",
        "accuracy_table",
    ),
    "jaxbundle.pushbroom.surfaces": (
        "Ground",
        "Height",
        "Plane",
    ),
    "jaxbundle.pushbroom.terrain": (
        "Terrain",
        "make_terrain",
    ),
    "jaxbundle.pushbroom.trajectory": ("Trajectory",),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
