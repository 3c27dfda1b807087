"""The output folder of a calibration.

| file | |
|---|---|
| report.txt, report.html, result.json | the full report; the same as a page; its numbers |
| CAMERA.toml | the camera for a project; σ as comments |
| CAMERA.yaml, colmap/ | the camera for OpenCV; camera, poses and board for COLMAP |
| network/ | the adjusted network, for `jaxbundle adjust FOLDER/network`; of a rig also that of all
its cameras, on mountings |
| coverage, uncertainty, uncertainty_far, uncertainty_distance, halves .png | accuracy |
| models.txt, models.json, difference_MODEL.png | comparison of `--models` |
| plan, perspective, histogram, residuals_…, distortion_…, correlations_… .png | as in `adjust` |

A model that OpenCV and COLMAP lack is converted to `opencv`, or to `kannala-brandt`
if rays may be 90° and more from the axis; the error is a comment in the TOML.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbundle.calibration.page import compose_calibration, compose_calibrations
from jaxbundle.calibration.rig.network import network_of_views
from jaxbundle.calibration.several_report import calibrations_dict as calibrations_dict
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.io import adjusted_network
from jaxbundle.io.cameras.opencv_writing import opencv_text
from jaxbundle.io.networks.colmap import FILES as COLMAP_FILES
from jaxbundle.io.networks.colmap import fill_colmap
from jaxbundle.io.networks.losses import METRIC_FORMATS
from jaxbundle.io.networks.mrcal import FILES as MRCAL_FILES
from jaxbundle.io.networks.project import ADJUSTED, cameras_text, fill_project
from jaxbundle.io.networks.project import FILES as NETWORK_FILES
from jaxbundle.io.networks.stereo import ROS_FILES
from jaxbundle.io.output_formats import TARGETS
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.conversion import convert_cameras
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.tables import Camera, Network
from jaxbundle.network.units import METRES
from jaxbundle.plotting import write_figures
from jaxbundle.plotting.files import FIGURES, draw_figures
from jaxbundle.plotting.style import need_matplotlib
from jaxbundle.report.page import UNKNOWN, Origin, head_line
from jaxbundle.types import Progress

if TYPE_CHECKING:
    from jaxbundle.calibration.model_choice import ModelComparison
    from jaxbundle.calibration.result import Calibration
    from jaxbundle.calibration.rig.result import RigCalibration
    from jaxbundle.calibration.several import Calibrations

COMMAND = "calibrate"
REPORT, PAGE, RESULT = "report.txt", "report.html", "result.json"
COLMAP = "colmap"
OWN_FIGURES = ("coverage.png", "uncertainty*.png", "halves.png")
# Files of a comparison of models.
COMPARED = ["models.txt", "models.json", "difference_*.png"]
RIG, CONVERSIONS = "rig", "conversions.txt"
# Files and folders of a rig for other programs, by their format; `opencv-stereo` and `ros-stereo`
# in pairs of cameras.
RIG_FILES: dict[str, tuple[str, tuple[str, ...]]] = {
    "kalibr": ("camchain.yaml", ()),
    "mrcal": ("mrcal", MRCAL_FILES),
    "opencv-stereo": ("stereo.yaml", ()),
    "ros-stereo": ("camera_info", ROS_FILES),
    "anipose": ("calibration.toml", ()),
}
STEREO_PAIRS = "stereo_*.yaml"
# Models that OpenCV and COLMAP have.
FOREIGN = ("opencv", "kannala-brandt")


def camera_text(camera: Camera, sigma: Mapping[str, float], *remarks: str) -> str:
    """A calibrated camera in our TOML, its σ and remarks as comments."""
    comments = [f"# σ of {name}: {value:.4g}" for name, value in sigma.items()]
    comments += [f"# {remark}" for remark in remarks]
    return "\n".join([cameras_text([camera]).rstrip(), *comments]) + "\n"


def file_name(name: str) -> str:
    """A name that is valid in a file system."""
    # ASCII, not hidden, and short: camera names are free text, and folders go to other systems
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII).strip("._")[:60] or "camera"


def check_names(cameras: Iterable[str]) -> None:
    """Refuse cameras that would share an output folder.

    **Raises:** `InputError`."""
    folders: dict[str, str] = {}
    for name in cameras:
        # Some systems do not tell the letters of a name from capitals.
        earlier = folders.setdefault(file_name(name).casefold(), name)
        if earlier != name:
            raise InputError(
                f"cameras {earlier!r} and {name!r} would have the same folder "
                f"{file_name(name)!r}; choose other names (--camera)"
            )


def files_of(names: Sequence[str]) -> list[str]:
    """Files that a calibration of these cameras may write, figures as patterns."""
    # What may be replaced in a folder that is written again; anything else in it is somebody's.
    patterns = [REPORT, PAGE, RESULT]
    for name in map(file_name, names):
        place = "" if len(names) == 1 else f"{name}/"
        patterns += [
            f"{place}{file}"
            for file in (
                REPORT,
                PAGE,
                RESULT,
                f"{name}.toml",
                f"{name}.yaml",
                *OWN_FIGURES,
                *FIGURES,
                *(f"{ADJUSTED}/{file}" for file in NETWORK_FILES),
                *(f"{COLMAP}/{file}" for file in COLMAP_FILES),
            )
        ]
    if len(names) > 1:
        # Names of a rig may be of cameras that see no board.
        patterns += ["rig_*.toml", "rig_*.png"]
        patterns += rig_files()
        patterns += [f"{ADJUSTED}/{file}" for file in NETWORK_FILES]
    return patterns


def rig_files() -> list[str]:
    """Files that `fill_rig` may write into the folder `RIG`, pairs of cameras as patterns."""
    return [
        f"{RIG}/{file}"
        for file in (
            CONVERSIONS,
            STEREO_PAIRS,
            *(name for name, files in RIG_FILES.values() if not files),
            *(f"{name}/{file}" for name, files in RIG_FILES.values() for file in files),
        )
    ]


def write_calibration(
    calibration: "Calibration", folder: str | Path, plots: bool = True, force: bool = False
) -> None:
    """Write a calibration into a folder (see the module's docstring).

    **Arguments:** `force`: replace foreign files.

    **Raises:** `InputError` if the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`); `ImportError` for plots without matplotlib.
    """
    if plots:
        need_matplotlib()
    with replace_folder(folder, COMMAND, files_of([calibration.name]), force) as new:
        _fill(calibration, new, plots, UNKNOWN)


def _fill(
    calibration: "Calibration",
    folder: Path,
    plots: bool,
    origin: Origin,
    choice: "ModelComparison | None" = None,
    progress: Progress | None = None,
) -> None:
    name = file_name(calibration.name)
    folder.mkdir(exist_ok=True)
    write_text(folder / REPORT, head_line(origin) + calibration.report())
    write_text(folder / PAGE, compose_calibration(calibration, origin, choice))
    write_text(folder / RESULT, json_text(calibration.to_dict()))
    # The report says why; files of a camera that is none would be used.
    if not calibration.converged:
        return
    network = adjusted_network(calibration.adjustment)
    fill_project(network, folder / ADJUSTED)
    remark = _write_foreign(network, folder, name, calibration.limits)
    text = camera_text(calibration.camera, calibration.stated_sigma, *calibration.limits, *remark)
    write_text(folder / f"{name}.toml", text)
    if plots:
        save_plots(calibration, folder, progress)


def _write_foreign(network: Network, folder: Path, name: str, limits: Sequence[str]) -> list[str]:
    """The camera for OpenCV, with its `limits`, and COLMAP; the error of a conversion of its model,
    in words."""
    remark = []
    model = get_model(network.cameras[0].model)
    if model.name not in FOREIGN:
        try:
            # Beyond 90° a perspective model has no image.
            nearest = "kannala-brandt" if model.wide else "opencv"
            network, cost = convert_cameras(network, nearest)
        except InputError as error:
            return [f"not written for OpenCV and COLMAP: {error}"]
        remark = [f"{name}.yaml and {COLMAP}: {conversion}" for conversion in cost.values()]
    # Whoever undistorts whole images with this file meets the radius at which it ends.
    comments = "".join(f"# {limit}\n" for limit in limits)
    write_text(folder / f"{name}.yaml", opencv_text(network.cameras[0]) + comments)
    fill_colmap(network, folder / COLMAP)
    return remark


def write_calibrations(
    calibrations: "Calibrations", folder: str | Path, plots: bool = True, force: bool = False
) -> None:
    """Write one calibration into a folder, several into separate subfolders.

    Several have a common report.txt, report.html and result.json; a rig adds its
    cameras as rig_CAMERA.toml, and figures of their coverage and uncertainty in it.
    Arguments and errors as in `write_calibration`.
    """
    if plots:
        need_matplotlib()
    with replace_folder(folder, COMMAND, files_of([*calibrations.cameras]), force) as new:
        fill_calibrations(calibrations, new, plots)


def fill_calibrations(
    calibrations: "Calibrations",
    folder: Path,
    plots: bool,
    origin: Origin = UNKNOWN,
    choice: "ModelComparison | None" = None,
    progress: Progress | None = None,
) -> None:
    """Write a calibration into an existing folder; `origin` is for report and page, `choice` for
    the page.

    **Raises:** `InputError` for cameras that would share a folder."""
    if len(calibrations.cameras) == 1 and calibrations.rig is None:
        calibration = next(iter(calibrations.cameras.values()))
        return _fill(calibration, folder, plots, origin, choice, progress)
    rig_names = [] if calibrations.rig is None else calibrations.rig.names
    check_names({**calibrations.cameras, **dict.fromkeys(rig_names)})
    for name, calibration in calibrations.cameras.items():
        _fill(calibration, folder / file_name(name), plots, origin, progress=progress)
    write_text(folder / REPORT, head_line(origin) + calibrations.report())
    write_text(folder / PAGE, compose_calibrations(calibrations, origin))
    write_text(folder / RESULT, json_text(calibrations_dict(calibrations)))
    if calibrations.rig is not None:
        rig = calibrations.rig
        for name in rig.names:
            text = camera_text(rig.camera(name), rig.stated_sigma[name])
            write_text(folder / f"rig_{file_name(name)}.toml", text)
        fill_rig(calibrations.rig.network(), folder / RIG)
        views = network_of_views(calibrations.rig)
        # A camera may have the name of this folder.
        if views is not None and ADJUSTED not in map(file_name, calibrations.cameras):
            fill_project(views, folder / ADJUSTED)
        if plots:
            save_rig_plots(calibrations.rig, folder, progress)


def fill_rig(network: Network, folder: Path) -> None:
    """Write a rig for other programs: Kalibr, mrcal, and in pairs of cameras OpenCV and ROS. What a
    program cannot hold is fitted, or left out; both are said in `conversions.txt`."""
    folder.mkdir(exist_ok=True)
    conversion_lines = [_lengths_of_rig(network)]
    for kind, (name, _) in RIG_FILES.items():
        target, refusal = TARGETS[kind], ""
        # As it is, else with the models that the format has, its best one first.
        for model in (None, *target.models[:2]):
            try:
                fitted, costs = network, {}
                if model is not None:
                    fitted, costs = convert_cameras(network, model)
                losses = target.write(fitted, folder / name)
            except InputError as error:
                refusal = refusal or f"{name}: not written: {error}"
                continue
            conversion_lines += [f"{name}: camera {id!r} → {cost}" for id, cost in costs.items()]
            # The mounting itself is in every format.
            conversion_lines += [
                f"{name}: not kept: {loss}" for loss in losses if loss != Rigs.TABLE
            ]
            if target.parts is not None and len(network.cameras) > 2:
                parts = (
                    part.relative_to(folder).as_posix()
                    for part in target.parts(network, folder / name)
                    if part.exists()
                )
                conversion_lines.append(f"{name}: one for each pair of cameras: {', '.join(parts)}")
            break
        else:
            conversion_lines.append(refusal)
    write_text(folder / CONVERSIONS, "".join(f"{line}\n" for line in conversion_lines))


def _lengths_of_rig(network: Network) -> str:
    """In which units the lengths of the files are, and what makes a wrong one noticed."""
    unit, (reference, *others) = network.object_unit, network.images.id
    bases = np.linalg.norm(network.images.position - network.images.position[0], axis=1)[1:]
    distances = ", ".join(f"{name!r} {base:.4g} {unit}" for name, base in zip(others, bases))
    metric = ", ".join(name for kind, (name, _) in RIG_FILES.items() if kind in METRIC_FORMATS)
    units = f"; {metric} are in metres, the other files in {unit}" if unit in METRES else ""
    return f"distances from {reference!r}: {distances}{units}"


def fill_comparison(
    choice: "ModelComparison", folder: Path, plots: bool, progress: Progress | None = None
) -> None:
    """Write a comparison of models (`model_choice.ModelComparison`) into an existing folder."""
    write_text(folder / "models.txt", choice.report())
    write_text(folder / "models.json", json_text(choice.to_dict()))
    if plots:
        write_figures(
            folder,
            {
                f"difference_{file_name(model)}": (
                    (7.5, 6),
                    None,
                    partial(choice.plot_difference, model),
                )
                for model, difference in choice.differences.items()
                if difference is not None
            },
            progress,
        )


def save_plots(calibration: "Calibration", folder: Path, progress: Progress | None = None) -> None:
    """The figures of quality, and those of the adjustment."""
    # Drawn when needed: most of the time of a figure is matplotlib's.
    median_distance = float(np.median(calibration.distances))
    drawings = {
        "coverage": ((7, 5.6), None, calibration.plot_coverage),
        "uncertainty": ((7, 5.6), None, partial(calibration.plot_uncertainty, median_distance)),
        "uncertainty_far": ((7, 5.6), None, calibration.plot_uncertainty),
        "uncertainty_distance": ((6.5, 4.2), None, calibration.plot_uncertainty_over_distance),
    }
    halves = calibration.cross_validation
    if halves is not None and halves.comparison is not None:
        drawings["halves"] = ((7.5, 6), None, calibration.plot_halves)
    write_figures(folder, drawings, progress)
    draw_figures(calibration.adjustment, folder, progress)


def save_rig_plots(rig: "RigCalibration", folder: Path, progress: Progress | None = None) -> None:
    """Coverage and uncertainty of every camera in the rig."""
    drawings = {}
    for name in rig.names:
        file = f"rig_{file_name(name)}"
        draw = partial(rig.plot_uncertainty, name)
        drawings |= {
            f"{file}_coverage": ((7, 5.6), None, partial(rig.plot_coverage, name)),
            f"{file}_uncertainty": ((7, 5.6), None, partial(draw, rig.distance)),
            f"{file}_uncertainty_far": ((7, 5.6), None, draw),
        }
    write_figures(folder, drawings, progress)


def json_text(document: dict) -> str:
    """One JSON object; non-finite numbers are null."""
    return json.dumps(_plain(document), ensure_ascii=False, indent=1) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    # JSON has neither NaN nor infinity, and readers refuse what Python writes for them
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
