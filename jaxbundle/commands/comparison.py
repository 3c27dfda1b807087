"""`compare`: two calibrations of one camera, or two adjustments."""

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.compare import AdjustmentComparison
from jaxbundle.adjustment.compare import compare as compare_adjustments
from jaxbundle.adjustment.load_saved import load_adjustment
from jaxbundle.adjustment.quality.expected_difference import expected_difference
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import show
from jaxbundle.calibration.result import Calibration
from jaxbundle.cameras import Comparison, compare_cameras, difference_rings, get_model
from jaxbundle.commands.cameras import CameraSource, Pair, open_calibration
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.tables import Camera
from jaxbundle.results import TableMethods
from jaxbundle.system.file_content import beginning

# The beginning of a saved adjustment, an .npz.
SAVED_ADJUSTMENT = b"PK\x03\x04"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CalibrationComparison(TableMethods):
    """Two calibrations of one camera compared.

    **Fields:** `a`, `b`: the cameras; `images`: the difference map; `rings` about the image centre,
    columns r (outer radius), radial, tangential, rms, largest, points, and `expected` where both
    covariances are known; `covariance` [rows, columns, 2, 2] of the map, then, else None.
    """

    a: Camera
    b: Camera
    images: Comparison
    rings: Mapping[str, np.ndarray]
    covariance: Float[np.ndarray, "rows columns 2 2"] | None = None

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Parameters of a and b that one of them has, by name; none for two different models."""
        if self.a.model != self.b.model:
            return {}
        p, q = all_parameters(self.a), all_parameters(self.b)
        return {name: (p[name], q[name]) for name in p if p[name] or q[name]}

    @property
    def expected_rms(self) -> float | None:
        """RMS of the difference that the covariances of both let expect."""
        if self.covariance is None:
            return None
        return float(np.sqrt(np.nanmean(np.trace(self.covariance, axis1=2, axis2=3))))

    @property
    def ratio(self) -> float | None:
        """RMS of the difference in units of its σ; about 1 by chance."""
        if self.covariance is None:
            return None
        variance = np.trace(self.covariance, axis1=2, axis2=3)
        return float(np.sqrt(np.nanmean(self.images.length**2 / variance)))

    def table(self) -> dict[str, np.ndarray]:
        """The rings, columns by name."""
        return dict(self.rings)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dicts and numbers."""
        return without_nan(
            {
                "unit": self.images.unit,
                "parameters": {
                    name: {"a": p, "b": q, "difference": q - p}
                    for name, (p, q) in self.parameters.items()
                },
                "rms": float(self.images.rms),
                "largest": float(self.images.largest),
                "covered": float(self.images.covered),
                "expected_rms": self.expected_rms,
                "ratio": self.ratio,
                "rings": {name: column.tolist() for name, column in self.rings.items()},
            }
        )

    def __str__(self) -> str:
        """Parameters, differences in the image, and the whole table of rings, in lines."""
        lines = []
        if self.a.model == self.b.model:
            lines.append(f"{'':14}{'A':>16}{'B':>16}{'B − A':>16}")
            for name, (p, q) in self.parameters.items():
                lines.append(f"{name:14}{p:16.8g}{q:16.8g}{q - p:16.6g}")
        lines += str(self.images).splitlines()
        if self.images.covered < 1:
            share = 100 * (1 - self.images.covered)
            lines.append(f"{share:.1f} % of the image has no ray in one of them")
        columns = ["r", "radial", "tangential", "rms", "largest"]
        if self.covariance is not None:
            columns.append("expected")
            lines.append(
                f"expected by the σ of both: RMS {self.expected_rms:.4g} {self.images.unit}; "
                f"the difference is {self.ratio:.2g} times its σ (1: by chance)"
            )
        lines.append(
            "rings about the image centre, each out to r; means of the radial and tangential parts"
        )
        lines.append("".join(f"{name:>12}" for name in columns) + f"  [{self.images.unit}]")
        for row in zip(*(self.rings[name] for name in columns)):
            lines.append("".join(f"{value:12.4g}" for value in row))
        return "\n".join(lines)


@overload
def compare(
    a: Adjustment,
    b: Adjustment | str | Path,
    *,
    similarity: bool | None = None,
    held_by: Sequence[str] = (),
    significance: float = 0.05,
) -> AdjustmentComparison: ...


@overload
def compare(
    a: CameraSource,
    b: CameraSource,
    *,
    step: float | None = None,
    rotate: bool = True,
    radius: float = np.inf,
    image_size: Pair | None = None,
    pixel_size: Pair | None = None,
) -> CalibrationComparison: ...


def compare(
    a: Any,
    b: Any,
    *,
    similarity: bool | None = None,
    held_by: Sequence[str] = (),
    significance: float = 0.05,
    step: float | None = None,
    rotate: bool = True,
    radius: float = np.inf,
    image_size: Pair | None = None,
    pixel_size: Pair | None = None,
) -> AdjustmentComparison | CalibrationComparison:
    """Compare two adjustments (two epochs of an object, two calibrations with their networks, one
    network adjusted in two ways), or two calibrations of one camera.

    **Arguments:**

    - `a`, `b`: two `Adjustment`s or their files (`Adjustment.save`), of which all common unknowns
      are compared, with a test of each difference; or two cameras: `Camera`, `Calibration`, FILE
      or FILE#ID.

    Of adjustments:

    - `similarity`: whether coordinates are compared after a similarity (of seven parameters, or six
      if both networks have their own scale). Default: if the observations of one of them leave its
      datum open.
    - `held_by`: ids of the points it is found on, such as those known to be stable; default: all
      common points.
    - `significance`: the probability that any row is called different by chance.

    Of cameras:

    - `step`: width of the rings in the unit of a; default: a tenth of the image's radius.
    - `rotate`: remove the best rotation, found within `radius` of the centre.
    - `image_size`, pixels, `pixel_size`, mm: where a and b have none.

    **Raises:** `InputError` if they have nothing in common, different units, or too few points for
    a similarity; `NotSolvedError` if an adjustment has no result.
    """
    of_adjustments = {"similarity": similarity, "held_by": held_by, "significance": significance}
    of_cameras = {
        "step": step,
        "rotate": rotate,
        "radius": radius,
        "image_size": image_size,
        "pixel_size": pixel_size,
    }
    is_adjusted = lambda source: isinstance(source, Adjustment) or is_saved_adjustment(source)
    if is_adjusted(a) or is_adjusted(b):
        _require_adjustments(a, b)
        _refuse(of_cameras, "adjustments")
        return compare_adjustments(_open_adjustment(a), _open_adjustment(b), **of_adjustments)
    for name, source in (("a", a), ("b", b)):
        if not isinstance(source, Camera | Calibration | str | Path | tuple):
            raise InputError(
                f"{name} must be an Adjustment, a camera or a file of one, but is {show(source)}"
            )
    _refuse(of_adjustments, "cameras")
    return _compare_calibrations(a, b, step, rotate, radius, image_size, pixel_size)


def is_saved_adjustment(source: Any) -> bool:
    """Whether this is a file that `Adjustment.save` has written."""
    # No camera file begins like an archive.
    return (
        isinstance(source, str | Path)
        and beginning(source, len(SAVED_ADJUSTMENT)) == SAVED_ADJUSTMENT
    )


def _open_adjustment(source: Adjustment | str | Path) -> Adjustment:
    return source if isinstance(source, Adjustment) else load_adjustment(source)


def _require_adjustments(a: Any, b: Any) -> None:
    """Refuse what cannot be compared with an adjustment."""
    for name, source, partner in (("a", a, b), ("b", b, a)):
        if isinstance(source, Adjustment) or is_saved_adjustment(source):
            continue
        if not isinstance(source, str | Path):
            raise InputError(
                f"{name} must be an Adjustment, but is {show(source)}: jaxbundle.adjust or "
                "jaxbundle.load_adjustment gives one"
            )
        if not Path(str(source).partition("#")[0]).exists():
            raise InputError(f"{source}: no such file")
        partner_is = f"{partner} is" if isinstance(partner, str | Path) else "the other one is"
        raise InputError(
            f"{source}: is not a saved adjustment, as {partner_is}; give two files that jaxbundle "
            "adjust --save has written"
        )


def _refuse(options: Mapping[str, Any], compared: str) -> None:
    """Refuse options of the other kind of comparison."""
    defaults = inspect.signature(compare).parameters
    for name, value in options.items():
        default = defaults[name].default
        if value is not default and value != default:
            raise InputError(f"{name}: is not for the comparison of {compared}; omit it")


def _compare_calibrations(
    a: CameraSource,
    b: CameraSource,
    step: float | None,
    rotate: bool,
    radius: float,
    image_size: Pair | None,
    pixel_size: Pair | None,
) -> CalibrationComparison:
    (camera_a, C_a), (camera_b, C_b) = open_calibration(a), open_calibration(b)
    names = [
        str(x) if isinstance(x, str | Path) else c.id for x, c in ((a, camera_a), (b, camera_b))
    ]
    sizes = [list(c.image_size) for c in (camera_a, camera_b) if c.image_size is not None]
    if len(sizes) == 2 and sizes[0] != sizes[1]:
        raise InputError(
            f"{', '.join(names)}: images of {sizes[0]} and {sizes[1]} pixels are not from one "
            "camera"
        )
    model_a, model_b = ((get_model(c.model), c.parameters) for c in (camera_a, camera_b))
    sensor = {
        "image_size": image_size or camera_a.image_size or camera_b.image_size,
        "pixel_size": pixel_size or camera_a.pixel_size or camera_b.pixel_size,
        "rotate": rotate,
    }
    try:
        comparison = compare_cameras(model_a, model_b, radius=radius, **sensor)
        # A tenth of half the diagonal: ten rings.
        width = np.hypot(np.ptp(comparison.x), np.ptp(comparison.y)) / 20 if step is None else step
        rings = difference_rings(comparison, width)
    except ValueError as error:
        raise InputError(
            f"{', '.join(names)}: {error}; see --image-size, --pixel-size, --step"
        ) from None
    if C_a is None or C_b is None:
        return CalibrationComparison(camera_a, camera_b, comparison, rings)
    C = expected_difference(comparison, model_a, model_b, (C_a, C_b), **sensor)
    expected = np.sqrt(np.trace(C, axis1=2, axis2=3))
    # Rings of a difference that is σ everywhere: their RMS is what is expected.
    as_map = dataclasses.replace(comparison, difference=expected[..., None] * [1.0, 0.0])
    rings["expected"] = difference_rings(as_map, width)["rms"]
    return CalibrationComparison(camera_a, camera_b, comparison, rings, C)
