"""`precision.csv` beside a project: the joint covariance of its orientations and cameras.

| column | |
|---|---|
| `kind`, `id`, `parameter` | `image`, its id, `X0` … `kappa`; `camera`, its id, a parameter |
| `sigma` | object unit, angle unit of the project, unit of the parameter |
| `1`, `2`, … | correlations with the rows above, and with itself |

It is not a table of the project: it adds no observations. Parameters not listed are held.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv, write_csv
from jaxbundle.network.tables import EXTERIOR

FILE = "precision.csv"
HEAD = ("kind", "id", "parameter", "sigma")
ANGLES = EXTERIOR[3:]

# Kind (`image`, `camera`), id, parameter.
Unknown = tuple[str, str, str]


@dataclasses.dataclass(frozen=True)
class OrientationCovariance:
    """Unknowns of images and cameras, and their covariance (angles in radians)."""

    unknowns: tuple[Unknown, ...]
    matrix: Float[np.ndarray, "n n"]

    def index(self, unknowns: Sequence[Unknown]) -> Int[np.ndarray, " k"]:
        """The rows of some unknowns; −1: held."""
        row_of = {unknown: k for k, unknown in enumerate(self.unknowns)}
        return np.array([row_of.get(unknown, -1) for unknown in unknowns], int)

    def rows(self, image: str, camera: str, parameters: Sequence[str]) -> Int[np.ndarray, " k"]:
        """The rows of X0 … kappa of an image and of parameters of its camera; −1: held."""
        return self.index(unknowns_of_photograph(image, camera, parameters))


def unknowns_of_photograph(
    image: str, camera: str, parameters: Sequence[str]
) -> tuple[Unknown, ...]:
    """X0 … kappa of an image and the parameters of its camera."""
    return (
        *(("image", image, name) for name in EXTERIOR),
        *(("camera", camera, name) for name in parameters),
    )


def write_orientation_covariance(
    covariance: OrientationCovariance, path: str | Path, radians: float
) -> None:
    """Write the file; `radians`: the unit of angles."""
    sigma = np.sqrt(np.diagonal(covariance.matrix))
    R = covariance.matrix / np.outer(sigma, sigma)
    unit = np.array([_unit(kind, name, radians) for kind, _, name in covariance.unknowns])
    n = len(sigma)
    rows = (
        (*unknown, s, *R[k, : k + 1].tolist(), *[""] * (n - k - 1))
        for k, (unknown, s) in enumerate(zip(covariance.unknowns, (sigma / unit).tolist()))
    )
    write_csv(Path(path), (*HEAD, *(str(k + 1) for k in range(n))), rows)


def read_orientation_covariance(path: str | Path, radians: float) -> OrientationCovariance:
    """Read it back; `radians`: the unit of angles.

    **Raises:** `InputError` naming the file, and the line."""
    table = read_csv(Path(path))
    n = len(table)
    columns = tuple(str(k + 1) for k in range(n))
    table.check_names((*HEAD, *columns))
    # Only the lower triangle is written: R = L + Lᵀ − I, and Q = diag(σ)·R·diag(σ).
    numbers = np.full((n, n + 1), np.nan)
    for j, name in enumerate(("sigma", *columns)):
        for k, text in enumerate(table.values[name]):
            if j == 0 or k >= j - 1:
                numbers[k, j] = _number(table.source(k), name, text)
    kinds, ids, names = (table.values[name] for name in HEAD[:3])
    unit = np.array([_unit(kind, name, radians) for kind, name in zip(kinds, names)])
    sigma, lower = numbers[:, 0] * unit, np.tril(np.nan_to_num(numbers[:, 1:]), -1)
    R = lower + lower.T + np.eye(n)
    unknowns = tuple(
        (str(a).strip(), str(b).strip(), str(c).strip()) for a, b, c in zip(kinds, ids, names)
    )
    first_rows: dict[Unknown, int] = {}
    for k, unknown in enumerate(unknowns):
        if unknown in first_rows:
            raise InputError(
                f"{table.source(k)}: {' '.join(unknown)} is listed twice, also in "
                f"{table.source(first_rows[unknown])}"
            )
        first_rows[unknown] = k
    # Correlations are written with all digits: what is below 0 is rounding of them, or edited.
    if n and np.linalg.eigvalsh(R)[0] < -1e-6 * n:
        raise InputError(
            f"{path}: the correlations are not those of any errors (an eigenvalue of "
            f"{np.linalg.eigvalsh(R)[0]:.3g}); take the file as it was written"
        )
    return OrientationCovariance(unknowns, np.outer(sigma, sigma) * R)


def _unit(kind: str, parameter: str, radians: float) -> float:
    """The unit of an unknown: a camera may have a parameter with the name of an angle."""
    return radians if parameter in ANGLES and kind == "image" else 1.0


def _number(where: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    # 1e-9: a correlation of 1 may be rounded above it
    if not np.isfinite(value) or (value <= 0 if name == "sigma" else abs(value) > 1 + 1e-9):
        expected = "a σ above 0" if name == "sigma" else "a correlation"
        raise InputError(f"{where}: {name} is {text!r}; expected {expected}")
    return value
