"""`reconstruct`: photographs to an adjusted network, with the options of the command."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path

from jaxbundle.arguments import truth
from jaxbundle.commands.cameras import CameraSource, open_camera
from jaxbundle.errors import InputError
from jaxbundle.io.networks.control import select_checks
from jaxbundle.measure.coded_targets import check_kind
from jaxbundle.reconstruction.control import Control, read_control_measurements, with_sigma
from jaxbundle.reconstruction.named import read_distances
from jaxbundle.reconstruction.reconstruct import DEFAULT
from jaxbundle.reconstruction.reconstruct import reconstruct as reconstruct_photographs
from jaxbundle.reconstruction.result import Reconstruction
from jaxbundle.reconstruction.settings import ReconstructionSettings
from jaxbundle.tiepoints.features import FeatureSettings
from jaxbundle.types import Progress


def reconstruct(  # noqa: PLR0913 (public: the options of the command, all but one by name)
    photos: str | Path | Sequence[str | Path],
    *,
    camera: CameraSource | None = None,
    control: Control | str | Path | None = None,
    control_sigma: str | float | None = None,
    check: Sequence[str] = (),
    name: str = "",
    targets: str | None = None,
    uncoded: bool = False,
    distances: Sequence[dict] | str | Path = (),
    features: str | None = None,
    pairs: str | None = None,
    points: int | None = None,
    square_pixels: bool = True,
    camera_per_folder: bool = False,
    angle_unit: str | None = None,
    unit: str | None = None,
    correlated: bool = True,
    settings: ReconstructionSettings = DEFAULT,
    store: str | Path | None = None,
    progress: Progress = lambda *_: None,
) -> Reconstruction:
    """Reconstruct a network from photographs: tie points, self-calibration, adjustment.

    **Arguments:**

    - `photos`: files and folders of photographs.
    - `camera`: a calibrated camera of all photographs, held fixed: `Camera`, `Calibration`, FILE or
      FILE#ID.
    - `control`: control points, or their file: a gcp_list.txt, or a table, with or without
      measurements; `control_sigma`: σ of those without their own, metres, or "SIGMA,HEIGHT";
      `check`: names, or `"every 3rd"`: only compared with the result.
    - `name` of the job; default: the folder.
    - `targets`: kind of coded targets; `uncoded`: discs without a code, too, once the photographs
      are oriented; `distances`: scale bars, rows `from`, `to`, `value`, `sigma`
      between named points, or their table.
    - `features`: `"sift"`, `"akaze"`, `"orb"`, or `"none"`: the coded targets alone; `pairs`: which
      photographs are matched; `points`: desired tie points per photograph. They replace those of
      `settings`.
    - `square_pixels`: observe fy/fx as 1; otherwise both focal lengths are unknown.
    - `camera_per_folder`: photographs of two folders were taken with two cameras.
    - `angle_unit` of the results: `"deg"`, `"gon"` or `"rad"`; `unit` of the distances, and of the
      results where they alone give the scale: `"m"`, `"mm"`, `"in"`, …
    - `correlated`: state σ under errors that image points share, and compare halves by photographs,
      of eight photographs or more (`Adjustment.error_model`, `Adjustment.replication`).
    - `store`: folder of features and matches, for a repeated run.
    - `progress(stage, done, total)`.

    **Raises:** `InputError` if the photographs cannot be used; `NotSolvedError` if no two of
    them can be oriented.
    """
    if targets is not None:
        check_kind(targets)
        settings = replace(settings, targets=targets)
    if features == "none":
        settings = replace(settings, natural_points=False)
    elif features is not None:
        settings = replace(settings, detection=FeatureSettings(features))
    if truth("camera_per_folder", camera_per_folder):
        settings = replace(settings, camera_per_folder=True)
    if angle_unit is not None:
        settings = replace(settings, angle_unit=angle_unit)
    if unit is not None:
        settings = replace(settings, unit=unit)
    if truth("uncoded", uncoded):
        settings = replace(settings, uncoded=True)
    if pairs is not None:
        settings = replace(settings, pairs=pairs)
    if points is not None:
        settings = replace(settings, points=points)
    if not square_pixels:
        # An infinite σ is no prior.
        settings = replace(settings, aspect_sigma=inf)
    if not truth("correlated", correlated):
        settings = replace(settings, correlated=False)
    opened_camera = open_camera(camera) if camera is not None else None
    measured = open_control(control, control_sigma, check)
    bars = read_distances(distances) if isinstance(distances, str | Path) else distances
    return reconstruct_photographs(
        [photos] if isinstance(photos, str | Path) else photos,
        opened_camera,
        settings,
        None if store is None else Path(store),
        progress,
        measured,
        bars,
        name,
    )


def open_control(
    control: Control | str | Path | None,
    control_sigma: str | float | None = None,
    check: Sequence[str] = (),
) -> Control | None:
    """Control of a reconstruction, with σ where it has none, and some of it as check points.

    **Raises:** `InputError`."""
    if control is None:
        if control_sigma or check:
            raise InputError("--control-sigma and --check need --control")
        return None
    opened = control if isinstance(control, Control) else read_control_measurements(control)
    if control_sigma:
        opened = with_sigma(opened, str(control_sigma))
    return replace(opened, points=select_checks(opened.points, check)) if check else opened
