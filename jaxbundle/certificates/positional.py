"""Positional accuracy from check points: ASPRS Positional Accuracy Standards, edition 2.

American Society for Photogrammetry and Remote Sensing (2024), *ASPRS Positional Accuracy Standards
for Digital Geospatial Data*, Edition 2, Version 2. With d the differences product − check point,

    RMSE_x = √(Σdx²/n),  RMSE_y,          RMSE_H1 = √(RMSE_x² + RMSE_y²),   RMSE_V1 = √(Σdz²/n)
    RMSE_H = √(RMSE_H1² + RMSE_H2²),      RMSE_V = √(RMSE_V1² + RMSE_V2²)
    RMSE_3D = √(RMSE_H² + RMSE_V²)

RMSE_H2 and RMSE_V2 are those of the survey of the check points, here from the σ of every point:
RMSE_H2² = Σ(σx² + σy²)/n, RMSE_V2² = Σσz²/n. Edition 2 wants at least 30 check points, and a survey
of twice the accuracy of the product; fewer may be reported with a statement that says so. A mean
error of more than a quarter of the RMSE is a systematic error to be looked for.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import positive, show
from jaxbundle.certificates.units import convert, kind_of
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.network.columns import count
from jaxbundle.network.units import METRES
from jaxbundle.report.layout import fixed, significant, table
from jaxbundle.results import TableMethods
from jaxbundle.types import not_none

STANDARD = (
    "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, Version 2 (2024)"
)
LEAST_POINTS = 30
# The largest share of a mean error in the RMSE.
MEAN_SHARE = 0.25
# What a check point has that is one of a direction.
KNOWN = {"horizontal": "X and Y", "vertical": "Z"}


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class PositionalAccuracy(TableMethods):
    """Differences at check points, and the accuracy after ASPRS.

    **Fields:** `id`; `difference` product − check point and `sigma` of the survey of the check
    points [n, 3] (NaN: an axis that is not known, or whose σ is not stated); `horizontal_class`
    and `vertical_class`: RMSE to be met, None without; `unit` of all.
    """

    id: tuple[str, ...]
    difference: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n 3"]
    unit: str
    horizontal_class: float | None = None
    vertical_class: float | None = None

    @property
    def number(self) -> tuple[int, int]:
        """Horizontal and vertical check points."""
        is_known = np.isfinite(self.difference)
        return int(is_known[:, :2].all(1).sum()), int(is_known[:, 2].sum())

    @property
    def rmse_axes(self) -> Float[np.ndarray, "3"]:
        """RMSE_x, RMSE_y, RMSE_z of the differences."""
        return _rms(self.difference)

    @property
    def mean(self) -> Float[np.ndarray, "3"]:
        """The mean differences."""
        is_known = np.isfinite(self.difference)
        with np.errstate(invalid="ignore"):
            return np.where(is_known, self.difference, 0.0).sum(0) / is_known.sum(0)

    @property
    def survey(self) -> tuple[float, float]:
        """RMSE_H2 and RMSE_V2, of the survey of the check points whose σ is stated; 0 without
        any."""
        s = np.nan_to_num(_rms(np.where(np.isfinite(self.difference), self.sigma, np.nan)))
        return float(np.hypot(s[0], s[1])), float(s[2])

    @property
    def rmse_h(self) -> float:
        """RMSE_H, with the survey of the check points."""
        x, y, _ = self.rmse_axes
        return math.sqrt(x * x + y * y + self.survey[0] ** 2)

    @property
    def rmse_v(self) -> float:
        """RMSE_V, with the survey of the check points."""
        return math.sqrt(float(self.rmse_axes[2]) ** 2 + self.survey[1] ** 2)

    @property
    def rmse_3d(self) -> float:
        """RMSE_3D."""
        return math.hypot(self.rmse_h, self.rmse_v)

    @property
    def enough(self) -> bool:
        """Whether there are as many check points as the standard wants."""
        return min((n for n in self.number if n), default=0) >= LEAST_POINTS

    @property
    def verdict(self) -> str:
        """ "met" or "not met" of the classes; empty without any, and where a class has no check
        points, unless the other is not met."""
        classes = (self.horizontal_class, self.vertical_class)
        stated = [
            (number, value <= limit)
            for number, value, limit in zip(self.number, (self.rmse_h, self.rmse_v), classes)
            if limit is not None
        ]
        if any(number and not is_within for number, is_within in stated):
            return "not met"
        return "met" if stated and all(number for number, _ in stated) else ""

    def statements(self) -> list[str]:
        """The accuracy in the words of the standard."""
        sentences = []
        for direction, value, limit, number in (
            ("horizontal", self.rmse_h, self.horizontal_class, self.number[0]),
            ("vertical", self.rmse_v, self.vertical_class, self.number[1]),
        ):
            symbol = "RMSE_H" if direction == "horizontal" else "RMSE_V"
            if not number:
                if limit is not None:
                    sentences.append(
                        f"The {direction} accuracy class of {self._centimetres(limit)} {symbol} is "
                        f"not tested: no check point has {KNOWN[direction]}."
                    )
                continue
            tested = (
                f"Tested {direction} positional accuracy: {symbol} = {self._centimetres(value)}"
            )
            if limit is not None:
                verb = "meets" if value <= limit else "does not meet"
                accuracy_class = f"accuracy class of {self._centimetres(limit)} {symbol}"
                tested += f"; {verb} the {direction} {accuracy_class}"
            sentences.append(f"{tested}, of {count(number, 'check point')}.")
        if all(self.number):
            sentences.append(f"Three-dimensional: RMSE_3D = {self._centimetres(self.rmse_3d)}.")
        if not self.enough:
            sentences.append(
                f"Fewer check points than the {LEAST_POINTS} that the standard wants: the figures "
                "are of these points, and no statement on the class of the whole."
            )
        return sentences

    def remarks(self) -> list[str]:
        """What the standard wants to be looked at: mean errors, the survey of the check points."""
        sentences = []
        for axis, mean, rms in zip("XYZ", self.mean, self.rmse_axes):
            if rms > 0 and abs(mean) > MEAN_SHARE * rms:
                sentences.append(
                    f"mean error in {axis} {significant(float(mean))} {self.unit}: more than a "
                    f"quarter of its RMSE {significant(float(rms))}; look for its cause"
                )
        is_known, is_stated = np.isfinite(self.difference), np.isfinite(self.sigma)
        for direction, axes, survey, product in (
            ("horizontal", [0, 1], self.survey[0], self.rmse_h),
            ("vertical", [2], self.survey[1], self.rmse_v),
        ):
            of_direction = is_known[:, axes].all(1)
            number, stated = of_direction.sum(), (of_direction & is_stated[:, axes].all(1)).sum()
            if not number:
                continue
            if 0 < stated < number:
                sentences.append(
                    f"the σ of the {direction} survey is stated of {stated} of {number} check "
                    "points: taken as that of the others, too"
                )
            if survey == 0:
                sentences.append(
                    f"no σ of the {direction} survey of the check points is stated: taken as 0"
                )
            elif survey > product / 2:
                sentences.append(
                    f"the {direction} survey of the check points ({significant(survey)} "
                    f"{self.unit}) is not twice as accurate as the product"
                )
        return sentences

    def _centimetres(self, value: float) -> str:
        if self.unit not in METRES:
            return f"{significant(value)} {self.unit}"
        return f"{significant(convert(value, self.unit, 'cm'))} cm"

    def table(self) -> dict[str, np.ndarray]:
        """A row a check point: id, dX, dY, dZ, sX, sY, sZ (of the survey)."""
        return (
            {"id": np.array(self.id, dtype=object)}
            | {f"d{a}": self.difference[:, i] for i, a in enumerate("XYZ")}
            | {f"s{a}": self.sigma[:, i] for i, a in enumerate("XYZ")}
        )

    def summary(self) -> list[tuple[str, ...]]:
        """Quantity, fit to the check points, their survey, and both together, as text."""
        x, y, z = self.rmse_axes
        h2, v2 = self.survey
        text = lambda *numbers: [significant(float(n)) for n in numbers]
        return [
            ("RMSE_H", *text(math.hypot(x, y), h2, self.rmse_h)),
            ("RMSE_V", *text(z, v2, self.rmse_v)),
            ("RMSE_3D", *text(np.sqrt(x * x + y * y + z * z), math.hypot(h2, v2), self.rmse_3d)),
        ]

    def rows(self) -> list[tuple[str, ...]]:
        """The check points as text: id, differences, σ of the survey."""
        places = _places(self.rmse_axes)
        return [
            (id, *(fixed(float(v), places) for v in (*d, *s)))
            for id, d, s in zip(self.id, self.difference, self.sigma)
        ]

    def to_dict(self) -> dict[str, Any]:
        """The accuracy as plain dicts and numbers, as in JSON."""
        columns = {name: column.tolist() for name, column in self.table().items()}
        return {
            "standard": STANDARD,
            "unit": self.unit,
            "number": list(self.number),
            "RMSE_H": self.rmse_h,
            "RMSE_V": self.rmse_v,
            "RMSE_3D": self.rmse_3d,
            "fit": self.rmse_axes.tolist(),
            "survey": list(self.survey),
            "mean": self.mean.tolist(),
            "horizontal_class": self.horizontal_class,
            "vertical_class": self.vertical_class,
            "verdict": self.verdict or None,
            "statements": self.statements(),
            "remarks": self.remarks(),
            "points": [dict(zip(columns, row)) for row in zip(*columns.values())],
        }

    def __str__(self) -> str:
        lines = table(SUMMARY_HEADER, self.summary(), "lrrr")
        sentences = [*self.statements(), *self.remarks()]
        return "\n".join([f"Positional accuracy in {self.unit}", *lines, *sentences])


SUMMARY_HEADER = ("", "fit to check points", "survey of check points", "accuracy")
HEADER = ("check point", "dX", "dY", "dZ", "σX", "σY", "σZ")


def _rms(x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    is_known = np.isfinite(x)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(is_known, x**2, 0.0).sum(0) / is_known.sum(0))


def _places(rmse: Float[np.ndarray, "3"]) -> int:
    known_rmse = rmse[np.isfinite(rmse) & (rmse > 0)]
    return (
        int(np.clip(2 - math.floor(math.log10(known_rmse.min())), 0, 9)) if len(known_rmse) else 4
    )


def positional_accuracy(
    given: Any, horizontal_class: float | None = None, vertical_class: float | None = None
) -> PositionalAccuracy:
    """The accuracy of an adjustment at its check points, after ASPRS.

    **Arguments:** `given`: an `Adjustment`, or a result that has one as `adjustment`;
    `horizontal_class`, `vertical_class`: RMSE_H and RMSE_V to be met, object unit.

    **Returns:** a `PositionalAccuracy`.

    **Raises:** `InputError` without check points, or if the object unit is no length.
    """
    adjustment = getattr(given, "adjustment", given)
    if not isinstance(adjustment, Adjustment):
        raise InputError(f"expected a result of jaxbundle.adjust, got {show(given)}")
    check_points = adjustment.check_points
    if check_points is None or not np.isfinite(check_points.difference).any():
        raise InputError(
            "there are no check points with given coordinates: give some the role check, or "
            "choose them by check"
        )
    unit = adjustment.network.object_unit
    if kind_of(unit) not in ("length", ""):
        raise InputError(f"the object unit {unit!r} is no length")
    for name, value in (("horizontal", horizontal_class), ("vertical", vertical_class)):
        if value is not None:
            positive(f"{name}_class", value)
    sigma = np.array(not_none(adjustment.check)[0].sigma, float)
    sigma[~np.isfinite(sigma)] = np.nan
    return PositionalAccuracy(
        check_points.id, check_points.difference, sigma, unit, horizontal_class, vertical_class
    )
