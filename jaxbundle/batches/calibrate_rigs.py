"""`calibrate_rigs`: many rigs, moving cameras, or cameras of any model, each its own network."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import integer, numeric_array, one_of, positive, show, vector
from jaxbundle.batches.camera import CONVERGED, SOLVED, STATUS
from jaxbundle.batches.input import any_model, free_parameters
from jaxbundle.batches.population import Population
from jaxbundle.batches.rigs import RigSettings, RigViews, solve_rigs, with_free
from jaxbundle.batches.snooping import TESTS
from jaxbundle.cameras import CameraModel
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.io.text.stored_rows import StoredRows
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.network.build import make_further
from jaxbundle.network.columns import did_you_mean
from jaxbundle.results import TableMethods
from jaxbundle.types import Progress

# Sections of a project that the rigs of a batch may have.
SECTIONS = ("rolling_shutter", "rig")


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class RigBatch(TableMethods):
    """The rigs of a batch.

    **Fields:** `rows`, as the lines of `jaxbundle batch`: status, and the fields of the JSON of a
    network, or an error; `adjustments`, None for a rig without a result.
    """

    rows: tuple[dict, ...]
    adjustments: tuple[Adjustment | None, ...]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def status(self) -> np.ndarray:
        return np.array([row["status"] for row in self.rows])

    @property
    def converged(self) -> np.ndarray:
        """Which rigs have a determined solution that fits."""
        return self.status == STATUS[CONVERGED]

    def to_dict(self) -> dict[str, Any]:
        """The rows, as the lines of `jaxbundle batch`."""
        return {"rigs": list(self.rows)}

    def table(self) -> dict[str, np.ndarray]:
        """One row per rig."""
        return self.population().table({})

    def __str__(self) -> str:
        names, counts = np.unique(self.status, return_counts=True)
        states = ", ".join(f"{count} {name}" for name, count in zip(names, counts))
        rms = [row["rms"] for row in self.rows if row["status"] in SOLVED and "rms" in row]
        rms_in_words = f"median RMS {np.median(rms):.4g} px" if rms else "no result"
        return f"{len(self)} rigs: {states}; {rms_in_words}"

    def population(self, ids: Sequence | None = None) -> Population:
        """How parameters and mountings are distributed; `ids` of the rigs, 0, 1, 2, … if not given.

        **Raises:** `InputError` where there are not as many ids as rigs."""
        ids = range(len(self)) if ids is None else ids
        if np.shape(ids) != (len(self),):
            raise InputError(f"ids must be {len(self)}, one a rig, but are {show(ids)}")
        return Population({"key": str(id)} | row for id, row in zip(ids, self.rows))


def calibrate_rigs(  # noqa: PLR0913 keyword arguments of a public function
    object_points: Float[np.ndarray, "*rigs points 3"],
    image_points: Float[np.ndarray, "rigs cameras epochs points 2"],
    image_size: tuple[int, int] | Sequence[tuple[int, int]],
    *,
    visible: Bool[np.ndarray, "rigs cameras epochs points"] | None = None,
    cameras: Sequence[str] | None = None,
    model: str | CameraModel = "opencv",
    free: Sequence[str] | None = None,
    pixel_size: float | tuple[float, float] | None = None,
    rolling_shutter: Mapping[str, Any] | None = None,
    rig: Mapping[str, Any] | None = None,
    sigma_image: float | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    progress: Progress | None = None,
) -> RigBatch:
    """Calibrate many rigs from simultaneous views of points with known coordinates.

    A rig of one camera is a camera: moving (`rolling_shutter`), or of a model that
    `calibrate_batch` refuses (millimetres, splines).

    **Arguments:**

    - `object_points`: [points, 3] for all rigs, or [rigs, points, 3].
    - `image_points`: pixels (0, 0 is the centre of the upper-left pixel, v down); NaN: missing.
    - `image_size`: columns and rows, for all cameras or one pair a camera.
    - `visible`: mask of measured points; `cameras`: their names, the first is the reference.
    - `model`, `free`: as in `calibrate_batch`; `pixel_size`: mm, for a model in mm.
    - `rolling_shutter`, `rig`: sections of a project: `{"line_time": 2e-5}`, seconds per line
      (every image then has velocities, `free`: all six, with prior `sigma` by name), and
      `{"sigma_position": …, "sigma_angle": …}` of an unstable mounting.
    - `sigma_image`: a priori σ of an image coordinate, pixels; it matters beside the priors of
      velocities and splines, whose σ are multiplied by σ0 as all others.
    - `snooping`: `"pope"`: exclude epochs that contradict the mounting, then blunders, rig by rig.
    - `progress(stage, done, total)`: rigs done.

    **Returns:** a `RigBatch`; check `status` first.

    **Raises:** `InputError` for inconsistent shapes and names; `RuntimeError` without 64-bit
    floats.
    """
    require_x64()
    xy = numeric_array("image_points", image_points, "pixels [rigs, cameras, epochs, points, 2]")
    points = numeric_array("object_points", object_points, "numbers [points, 3]").astype(float)
    sections = {"rolling_shutter": rolling_shutter, "rig": rig}
    settings = rig_settings(
        model,
        free,
        {name: section for name, section in sections.items() if section is not None},
        pixel_size,
        sigma_image,
        max_iterations,
        snooping,
        significance,
    )
    if visible is not None:
        expected = "true or false [rigs, cameras, epochs, points]"
        visible = numeric_array("visible", visible, expected, truths=True)
    rigs = rigs_of_arrays(points, xy.astype(float), image_size, visible, cameras)

    def tell(part: float) -> None:
        if progress is not None:
            progress("calibrating", round(part * len(rigs)), len(rigs))

    solved = solve_rigs(rigs, settings, tell)
    return RigBatch(tuple(row for row, _ in solved), tuple(adjustment for _, adjustment in solved))


def rig_settings(
    model: str | CameraModel,
    free: Sequence[str] | None,
    sections: Mapping[str, Any],
    pixel_size: float | tuple[float, float] | None = None,
    sigma_image: float | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
) -> RigSettings:
    """Checked settings.

    **Raises:** `InputError`."""
    rig_model = any_model(model)
    one_of("snooping", snooping, TESTS, allow_none=True)
    check_test(snooping, significance)
    for name, section in sections.items():
        if name not in SECTIONS:
            raise InputError(f"unknown section {name!r}{did_you_mean(name, SECTIONS)}")
        if not isinstance(section, Mapping):
            raise InputError(f"{name} is {show(section)}; expected a table of settings")
    if moves := sections.get("rolling_shutter"):
        positive("rolling_shutter: line_time", moves.get("line_time"))
        make_further({"velocities": {"image": ["1"]}, "rolling_shutter": with_free(moves)}, 1.0)
    if unstable := sections.get("rig"):
        row = {"rig": ["1"], "epoch": ["1"], "image": ["1"]}
        make_further({"rigs": row, "rig": unstable}, 1.0)
    size = None
    if pixel_size is not None:
        pair = vector("pixel_size", pixel_size, 2, "a positive length in mm, or two")
        if not (pair > 0).all():
            raise InputError(f"pixel size {pixel_size}: expected a positive length in mm")
        size = float(pair[0]), float(pair[1])
    if rig_model.unit == "mm" and size is None:
        raise InputError(
            f"model {rig_model.name!r} is in mm: give the size of a pixel (--pixel-size)"
        )
    return RigSettings(
        rig_model,
        free_parameters(rig_model, free),
        size,
        dict(sections),
        None if sigma_image is None else positive("sigma_image", sigma_image),
        integer("max_iterations", max_iterations),
        snooping,
        significance,
    )


def rigs_of_arrays(
    points: Float[np.ndarray, "*rigs points 3"],
    xy: Float[np.ndarray, "rigs cameras epochs points 2"],
    image_size: Any,
    visible: Shaped[np.ndarray, "rigs cameras epochs points"] | None = None,
    cameras: Sequence[str] | None = None,
) -> list[RigViews]:
    """The rigs of checked arrays of numbers.

    **Raises:** `InputError`."""
    names, sizes = check_rigs(points, xy, image_size, visible, cameras)
    epochs = tuple(map(str, range(xy.shape[2])))
    images = tuple(
        epochs if len(names) == 1 else tuple(f"{name} {epoch}" for epoch in epochs)
        for name in names
    )
    if visible is not None:
        xy = np.where(np.asarray(visible, bool)[..., None], xy, np.nan)
    return [
        RigViews(names, sizes, images, epochs, points if points.ndim == 2 else points[i], xy[i])
        for i in range(len(xy))
    ]


def check_rigs(
    points: np.ndarray | StoredRows,
    xy: np.ndarray | StoredRows,
    image_size: Any,
    visible: np.ndarray | StoredRows | None,
    cameras: Sequence[str] | None,
) -> tuple[tuple[str, ...], tuple[tuple[int, int], ...]]:
    """Names and image sizes of the cameras of rigs whose arrays, or what has their shapes, fit.

    **Raises:** `InputError`."""
    if xy.ndim != 5 or xy.shape[4] != 2 or not all(xy.shape):
        raise InputError(
            "image_points of rigs must have the shape [rigs, cameras, epochs, points, "
            f"2], but has {xy.shape}"
        )
    rigs, number, _, n, _ = xy.shape
    if points.shape not in ((n, 3), (rigs, n, 3)):
        raise InputError(
            f"object_points must have the shape [{n}, 3] or [{rigs}, {n}, 3], as image_points "
            f"has {n} points a view, but has {points.shape}"
        )
    if visible is not None and visible.shape != xy.shape[:4]:
        raise InputError(
            f"visible must have the shape {xy.shape[:4]} of image_points, but has {visible.shape}"
        )
    size = numeric_array("image_size", image_size, "columns and rows in pixels").astype(float)
    if size.shape not in ((2,), (number, 2)) or not (np.isfinite(size) & (size > 0)).all():
        raise InputError(
            f"image_size must be columns and rows in pixels, for all cameras or each of {number}, "
            f"but is {show(size.tolist())}"
        )
    sizes = tuple((int(w), int(h)) for w, h in np.broadcast_to(size, (number, 2)))
    default_names = [f"cam{c + 1}" if number > 1 else "cam" for c in range(number)]
    names = tuple(map(str, default_names if cameras is None else cameras))
    if len({*names}) != number:
        raise InputError(f"cameras must be {number} different names, but are {show(cameras)}")
    return names, sizes
