"""The table of control and check points of a reconstruction."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.orientation.control_consistency import MIN_REDUNDANCY_OF_TEST, Assessment
from jaxbundle.report.layout import column_decimals, fixed, significant

# The columns of the table; d: adjusted minus given; px: RMS distance of the projected point from
# its measurements.
HEADER = ("point", "rays", "dX", "dY", "dZ", "σX", "σY", "σZ", "px", "verdict")


@dataclasses.dataclass(frozen=True)
class ControlMeasurement:
    """A measurement of a control or check point: its photograph; whether it was used; its distance
    from where everything else predicts it, and the σ of a coordinate of this, pixels; None: not
    predicted."""

    image: str
    used: bool
    distance: float | None
    sigma: float | None


@dataclasses.dataclass(frozen=True)
class ControlPoint:
    """A control or check point: `role` as given, whether it was `used`; rays that were used; given
    coordinates and their σ (NaN: exact, infinite: not controlled); adjusted minus given; RMS image
    residual, pixels; `verdict` in words; `prediction` of it from everything else, predicted minus
    given, and its σ; `measurements`: every image measurement; `removed_axes`: its coordinates that
    data snooping removed, of "XYZ". Lengths in the object unit, NaN: not there."""

    id: str
    role: str
    used: bool
    rays: int
    given: Float[np.ndarray, "3"]
    sigma: Float[np.ndarray, "3"]
    residual: Float[np.ndarray, "3"]
    image_residual: float
    verdict: str
    prediction: Float[np.ndarray, "3"]
    prediction_sigma: Float[np.ndarray, "3"]
    measurements: tuple["ControlMeasurement", ...]
    removed_axes: str = ""

    @property
    def agreeing_residual(self) -> Float[np.ndarray, "3"]:
        """The residual without the coordinates that were removed: the fit of what was used."""
        return np.where([axis in self.removed_axes for axis in "XYZ"], np.nan, self.residual)

    @property
    def wrong_measurements(self) -> list[str]:
        """The photographs whose measurement of it contradicts the others."""
        # The verdict decides: measurements of a point that takes no part are not wrong by that. Its
        # reasons follow a colon or a semicolon (`georeferencing`): 11.jpg ends with 1.jpg, too.
        return [
            measurement.image
            for measurement in self.measurements
            if any(f"{mark} {measurement.image} is a wrong" in self.verdict for mark in ":;")
        ]

    def cells(self, places: int) -> tuple[str, ...]:
        """The row of the table as text, in the order of `HEADER`; decimal `places` of lengths."""
        sigma = ("free" if np.isinf(s) else fixed(s, places) for s in self.sigma)
        return (
            self.id,
            str(self.rays),
            *(fixed(d, places) for d in self.residual),
            *sigma,
            fixed(self.image_residual, 2),
            self.verdict,
        )

    def numbers(self) -> dict:
        """The row as numbers by name; None: not there."""
        axes = lambda values: {
            a: float(v) if np.isfinite(v) else None for a, v in zip("XYZ", values)
        }
        return {
            "role": self.role,
            "used": self.used,
            "rays": self.rays,
            "given": axes(self.given),
            "sigma": axes(self.sigma),
            "residual": axes(self.residual),
            "image_residual": self.image_residual if np.isfinite(self.image_residual) else None,
            "verdict": self.verdict,
            "removed": list(self.removed_axes),
            "prediction": {"error": axes(self.prediction), "sigma": axes(self.prediction_sigma)},
            "measurements": [dataclasses.asdict(measurement) for measurement in self.measurements],
        }


@dataclasses.dataclass(frozen=True)
class ControlTable:
    """The `points`, where their σ come from (`sigma`, in words), further `notes`; `unit` of
    lengths; `warnings`: what makes the frame doubtful."""

    points: tuple[ControlPoint, ...]
    sigma: str
    notes: tuple[str, ...]
    unit: str
    warnings: tuple[str, ...] = ()

    def rms(self, role: str) -> Float[np.ndarray, "3"]:
        """RMS residual in X, Y, Z of the used control points, or of the check points; NaN without
        any."""
        if role == "check":
            residuals = [p.residual for p in self.points if p.role == "check"]
        else:
            # Without those left out: the fit of what the result rests on.
            residuals = [p.agreeing_residual for p in self.points if p.used]
        residual_rows = np.array(residuals).reshape(-1, 3)
        number = np.isfinite(residual_rows).sum(0)
        with np.errstate(invalid="ignore"):
            return np.sqrt(
                np.where(np.isfinite(residual_rows), residual_rows**2, 0).sum(0) / number
            )

    def rows(self) -> list[tuple[str, ...]]:
        """The table as text, the RMS last."""
        # Decimals by σ: two significant digits of it (GUM, 7.2.6), for all lengths alike; at most
        # a tenth of a millimetre, which no control in metres exceeds.
        places = column_decimals(np.concatenate([point.sigma for point in self.points]), 2, 4)
        rows = [point.cells(places) for point in self.points]
        for role, words in (("control", "RMS, used control"), ("check", "RMS, check points")):
            rms = self.rms(role)
            if np.isfinite(rms).any():
                rows.append((words, "", *(fixed(x, places) for x in rms), *[""] * 5))
        return rows

    def as_dict(self) -> dict:
        """The table for JSON."""
        rms = lambda role: {
            a: float(v) if np.isfinite(v) else None for a, v in zip("XYZ", self.rms(role))
        }
        return {
            "sigma": self.sigma,
            "notes": list(self.notes),
            "rms": rms("control"),
            "rms_check": rms("check"),
            "points": {p.id: p.numbers() for p in self.points},
        }

    @property
    def left_out(self) -> list[str]:
        """The control points that are not used."""
        return [p.id for p in self.points if p.role != "check" and not p.used]


def describe_sigma(
    stated_sigma: Float[np.ndarray, "n 3"],
    assessed: Assessment,
    fixed: Sequence[str],
    unit: str,
    assumed_pixels: float,
    heights_as_in_plane: bool = False,
) -> str:
    """Where the σ of control come from, in one line.

    **Arguments:** `stated_sigma` σ, NaN: not given; `fixed`: ids of points that are held;
    `assumed_pixels`: the assumed σ, pixels on the ground; `heights_as_in_plane`: σ of heights that
    are all 0 is that in the plane."""
    words = []
    unknown = np.isnan(stated_sigma)
    finite_sigma = stated_sigma[np.isfinite(stated_sigma)]
    if len(finite_sigma):
        ends = dict.fromkeys(significant(s, 2) for s in (finite_sigma.min(), finite_sigma.max()))
        sentence = f"σ of control as stated ({' to '.join(ends)} {unit})"
        if assessed.factor > 1:
            sentence += (
                f", multiplied by {significant(assessed.factor)}: most points contradict "
                "each other by more than the stated σ"
            )
        words.append(sentence)
    # One σ for X and Y: the residuals of few points do not determine two.
    for part, (axes, name) in enumerate((([0, 1], "in the plane"), ([2], "in height"))):
        of_part = unknown[:, axes]
        if not of_part.any():
            continue
        sigma = float(assessed.sigma[:, axes][of_part][0])
        r = assessed.redundancy[part]
        if name == "in height" and heights_as_in_plane:
            how = "as in the plane: heights that are all 0 are not taken for better ones"
        elif assessed.assumed[part]:
            how = (
                f"assumed, {assumed_pixels:g} pixels on the ground, because its residuals do not "
                "show a larger one (state it with --control-sigma)"
            )
        else:
            how = f"estimated from the residuals of control (redundancy {r:.1f}"
            if r < MIN_REDUNDANCY_OF_TEST:
                how += ": too low to find wrong points; state it with --control-sigma"
            how += ")"
        words.append(f"control without σ: {significant(sigma, 2)} {unit} {name}, {how}")
    if fixed:
        words.append(
            f"held exactly, as stated by the role fixed: {', '.join(fixed[:5])}"
            + (" …" if len(fixed) > 5 else "")
        )
    return "; ".join(words)
