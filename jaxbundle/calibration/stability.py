r"""Stability of a camera: calibrations at n epochs or temperatures, and their significant
differences.

With interior orientations pᵢ and covariances Cᵢ, independent of each other:

**Homogeneity.** p̄ = (ΣCᵢ⁻¹)⁻¹·ΣCᵢ⁻¹pᵢ, and without changes

    Σ (pᵢ − p̄)ᵀ·Cᵢ⁻¹·(pᵢ − p̄)   ~   χ²((n − 1)·k)

A second test ignores changes that an exterior orientation absorbs. With A the derivatives of images
by the parameters, A' those after the best rotation, G and H the means of AᵀA and A'ᵀA' over the
image,

    H·s = μ·G·s,        0 ≤ μ ≤ 1

gives the fraction μ of the image motion by a change s that no rotation removes. Changes with μ
below a tenth (a shift of the principal point is nearly a rotation) are excluded from this χ².

**Between epochs.** For each parameter τ², a variance on top of its σᵢ², by Paule and Mandel:
Σ (pᵢ − m)²/(σᵢ² + τ²) = n − 1, m the mean with these weights. Against a temperature or a date the
same with a straight line a + b·xᵢ in place of m, and n − 2: its slope b has its own τ, about the
line, since a trend is not scatter. In the image, rotation removed, the
variance between epochs is that of the differences less what is expected by chance,

    Σ (pᵢ − p̄ₐ)ᵀ·H·(pᵢ − p̄ₐ)/(n − 1) − mean of tr(H·Cᵢ),        p̄ₐ the arithmetic mean

Source: Rao (1973), Linear Statistical Inference, 4f (homogeneity); Paule and Mandel (1982), Journal
of Research of the NBS 87, 377-385.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.quality.expected_difference import Covariance
from jaxbundle.calibration.mapping_error import mapping_form
from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import chi2_tail, f_tail
from jaxbundle.network.tables import Camera
from jaxbundle.report.layout import table
from jaxbundle.results import TableMethods


@dataclasses.dataclass(frozen=True)
class Homogeneity:
    """χ² that all epochs have the same values, its degrees of freedom, and its probability."""

    chi2: float
    degrees: int

    @property
    def probability(self) -> float:
        """1 where nothing is left to be tested."""
        return chi2_tail(self.chi2, self.degrees) if self.degrees else 1.0

    def __str__(self) -> str:
        if not self.degrees:
            return "nothing is left to be tested"
        return f"χ² = {self.chi2:.1f} ({self.degrees}), p = {self.probability:.2g}"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Stability(TableMethods):
    """**Fields:** `names` of the free parameters; `values`, `sigma` [epochs, k]; `mean`,
    `mean_sigma`, `between` (τ), `probability` (of its χ² alone) [k]; `all_parameters`,
    `rotation_removed`: tests of homogeneity; `image_found`, `image_expected`, `image_between`: RMS
    over the image of an epoch against the mean, pixels; `at`, `slope`, `slope_sigma`,
    `slope_probability` (of as large a slope by chance), `about_slope` (τ about the line): if
    numbers of the epochs (temperatures) are given, else None."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "epochs k"]
    sigma: Float[np.ndarray, "epochs k"]
    mean: Float[np.ndarray, " k"]
    mean_sigma: Float[np.ndarray, " k"]
    between: Float[np.ndarray, " k"]
    probability: Float[np.ndarray, " k"]
    all_parameters: Homogeneity
    rotation_removed: Homogeneity
    image_found: float
    image_expected: float
    image_between: float
    at: Float[np.ndarray, " epochs"] | None = None
    slope: Float[np.ndarray, " k"] | None = None
    slope_sigma: Float[np.ndarray, " k"] | None = None
    slope_probability: Float[np.ndarray, " k"] | None = None
    about_slope: Float[np.ndarray, " k"] | None = None

    def table(self) -> dict[str, np.ndarray]:
        """Columns by name, one row a parameter; those of slopes if numbers of the epochs are
        known."""
        columns = {
            "mean": self.mean,
            "sigma": self.mean_sigma,
            "between": self.between,
            "probability": self.probability,
            "slope": self.slope,
            "sigma_slope": self.slope_sigma,
            "probability_slope": self.slope_probability,
            "about_slope": self.about_slope,
        }
        known_columns = {name: column for name, column in columns.items() if column is not None}
        return {"parameter": np.array(self.names, dtype=object), **known_columns}

    def __str__(self) -> str:
        """Parameters and tests in lines."""
        digits = {"mean": 6, "sigma": 6, "between": 6, "probability": 2, "slope": 4}
        columns = self.table()
        rows = [
            [
                str(name),
                *(f"{x:.{digits.get(column, 2)}g}" for column, x in zip([*columns][1:], numbers)),
            ]
            for name, *numbers in zip(*columns.values())
        ]
        head = ["parameter", "mean", "σ", "between", "p", "slope", "σ slope", "p", "about it"]
        head = head[: len(columns)]  # those of slopes come last
        return "\n".join(
            [
                *table(head, rows, "l" + "r" * (len(head) - 1)),
                "",
                f"all epochs the same, all parameters: {self.all_parameters}",
                f"the same, rotation removed:          {self.rotation_removed}",
                f"images against the mean (RMS, rotation removed): {self.image_found:.4g} px, "
                f"expected by the σ {self.image_expected:.4g} px; between epochs "
                f"{self.image_between:.4g} px",
            ]
        )

    def to_dict(self) -> dict:
        """The result as plain dicts and numbers, as in JSON."""
        test = lambda chi2_test: {
            "chi2": chi2_test.chi2,
            "degrees": chi2_test.degrees,
            "probability": chi2_test.probability,
        }
        rows = {}
        for k, name in enumerate(self.names):
            rows[name] = {
                "mean": float(self.mean[k]),
                "sigma": float(self.mean_sigma[k]),
                "between": float(self.between[k]),
                "probability": float(self.probability[k]),
                "epochs": self.values[:, k].tolist(),
                "sigma_epochs": self.sigma[:, k].tolist(),
            }
            for key, value in {
                "slope": self.slope,
                "sigma_slope": self.slope_sigma,
                "probability_slope": self.slope_probability,
                "about_slope": self.about_slope,
            }.items():
                if value is not None:
                    rows[name][key] = float(value[k])
        return {
            "parameters": rows,
            "all_parameters": test(self.all_parameters),
            "rotation_removed": test(self.rotation_removed),
            "image": {
                "found": self.image_found,
                "expected": self.image_expected,
                "between": self.image_between,
            },
            "at": None if self.at is None else self.at.tolist(),
        }


def stability(
    calibrations: Sequence[tuple[Camera, Covariance]], at: Sequence[float] | None = None
) -> Stability:
    """Compare two or more calibrations of a camera.

    **Arguments:** camera, and names and covariance of its free parameters, of every epoch
    (`Calibration.camera`, `Calibration.adjustment.camera_covariance`; of files
    `read_calibrated`); `at`: a number for each epoch, such as its temperature, for the slopes.

    **Raises:** `InputError` if they are not of one camera.
    """
    cameras = [camera for camera, _ in calibrations]
    names = _check(calibrations, at)
    p = np.array([[camera.parameters[name] for name in names] for camera in cameras])
    orders = [[list(free).index(name) for name in names] for _, (free, _) in calibrations]
    C = np.array([np.asarray(c[1])[np.ix_(i, i)] for i, (_, c) in zip(orders, calibrations)])
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    columns = [_line_of(p[:, k], sigma[:, k]) for k in range(len(names))]
    mean, mean_sigma, tau, probability = np.array(columns).T
    model = get_model(cameras[0].model)
    # The derivatives of the image at the mean camera.
    all_names, changes = _changes_of_tied(cameras[0], names)
    mean_of = {
        **default_parameters(model),
        **cameras[0].parameters,
        **dict(zip(all_names, changes @ mean)),
    }
    mean_parameters = np.array([mean_of[name] for name in model.parameters])
    G, H = (
        changes.T @ mapping_form(cameras[0], mean_parameters, all_names, frame=f) @ changes
        for f in ("camera", "rotation")
    )
    # Images by H, without rotation: what matters to a user who orients each photograph anew.
    F = _without_rotation(G, H, sigma.mean(0))
    d = p - p.mean(0)
    mean_square = float(np.einsum("nk,kl,nl->", d, H, d)) / (len(p) - 1)
    expected = float(np.einsum("kl,nlk->", H, C)) / len(p)
    x, trend = None, (None,) * 4
    if at is not None:
        x = np.array(at, float)
        columns = [_line_of(p[:, k], sigma[:, k], x) for k in range(len(names))]
        trend = np.array([_trend(*column[:3], len(x)) for column in columns]).T
    return Stability(
        names,
        p,
        sigma,
        mean,
        mean_sigma,
        tau,
        probability,
        _homogeneity(p, C),
        _homogeneity(p @ F.T, F @ C @ F.T),
        np.sqrt(mean_square),
        np.sqrt(expected),
        float(np.sqrt(max(mean_square - expected, 0.0))),
        x,
        *trend,
    )


def _check(
    calibrations: Sequence[tuple[Camera, Covariance]], at: Sequence[float] | None
) -> tuple[str, ...]:
    """The names of the free parameters."""
    if len(calibrations) < 2:
        raise InputError("stability: give two calibrations of a camera or more")
    if at is not None and not (
        len(at) == len(calibrations) and len({*at}) >= 3 and np.isfinite(at).all()
    ):
        raise InputError(
            f"stability: {len(at)} numbers for {len(calibrations)} calibrations; expected one for "
            "each, and three different ones at least"
        )
    first_camera, (free, _) = calibrations[0]
    names = _first_of_tied(first_camera, free)
    if first_camera.image_size is None:
        raise InputError(f"camera {first_camera.id!r}: its image_size in pixels is needed")
    changing, _ = _changes_of_tied(first_camera, names)
    for number, (camera, (free, _)) in enumerate(calibrations, 1):
        held_values = {n: v for n, v in camera.parameters.items() if n not in changing}
        held_of_first = {n: v for n, v in first_camera.parameters.items() if n not in changing}
        if (camera.model, camera.image_size) != (first_camera.model, first_camera.image_size):
            raise InputError(f"calibration {number} is of another camera model or image size")
        if {*_first_of_tied(camera, free)} != {*names} or any(
            held_values.get(n, 0.0) != held_of_first.get(n, 0.0)
            for n in held_values | held_of_first
        ):
            raise InputError(f"calibration {number} has other free parameters, or held values")
    values = [tuple(camera.parameters[n] for n in names) for camera, _ in calibrations]
    for number, of_camera in enumerate(values):
        if of_camera in values[:number]:
            raise InputError(
                f"calibrations {values.index(of_camera) + 1} and {number + 1} agree to all digits: "
                "they are of the same photographs; give calibrations from independent ones"
            )
    return names


def _first_of_tied(camera: Camera, names: Sequence[str]) -> tuple[str, ...]:
    """Free parameters, of equal ones (`Camera.tie`) the first: they are one unknown, and their
    covariance is singular."""
    equal_names = {name for group in camera.tie for name in [n for n in group if n in names][1:]}
    return tuple(name for name in names if name not in equal_names)


def _changes_of_tied(
    camera: Camera, names: Sequence[str]
) -> tuple[tuple[str, ...], Float[np.ndarray, "every k"]]:
    """All parameters that change with those of `names`, themselves and equal ones, and by how
    much."""
    equal = {name: next((g for g in camera.tie if name in g), (name,)) for name in names}
    all_names = tuple(dict.fromkeys(equal_name for group in equal.values() for equal_name in group))
    return all_names, np.array([[float(n in equal[name]) for name in names] for n in all_names])


def _homogeneity(
    p: Float[np.ndarray, "epochs k"], C: Float[np.ndarray, "epochs k k"]
) -> Homogeneity:
    """Scaled by the σ of the first epoch, so that no parameter is tiny."""
    scale = np.sqrt(np.diagonal(C[0]))
    p, W = p / scale, np.linalg.inv(C / np.outer(scale, scale))
    mean = np.linalg.solve(W.sum(0), np.einsum("nkl,nl->k", W, p))
    d = p - mean
    return Homogeneity(float(np.einsum("nk,nkl,nl->", d, W, d)), (len(p) - 1) * p.shape[1])


def _without_rotation(
    G: Float[np.ndarray, "k k"], H: Float[np.ndarray, "k k"], scale: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "m k"]:
    """F of the functions F·p of the parameters that do not change with what is nearly a rotation;
    `scale`: the size of a change of each parameter."""
    unit = np.outer(scale, scale)
    # H·s = μ·G·s is reduced to an ordinary eigenvalue problem by a root of G. G is singular where
    # changes of parameters cancel in the image: these are dropped. 1e-12, since G holds squares:
    # they move the image by less than 1e-6 of what the others do.
    eigenvalues, U = np.linalg.eigh(G * unit)
    is_determined = eigenvalues > 1e-12 * eigenvalues[-1]
    root = U[:, is_determined] / np.sqrt(eigenvalues[is_determined])
    mu, V = np.linalg.eigh(root.T @ (H * unit) @ root)
    # μ below a tenth: nearly a rotation, as a shift of the principal point is. Larger: real changes
    # are left out too; smaller: changes count that the next orientation absorbs
    vectors = (root @ V)[:, mu > 0.1]
    return vectors.T @ (G * unit) / scale


def _line_of(
    p: Float[np.ndarray, " epochs"],
    sigma: Float[np.ndarray, " epochs"],
    x: Float[np.ndarray, " epochs"] | None = None,
) -> tuple[float, float, float, float]:
    """Mean, or slope against x, and its σ; τ about it, and the probability of χ² without τ."""
    # About the mean of x, mean and slope are nearly independent.
    A = np.ones((len(p), 1)) if x is None else np.stack([np.ones(len(p)), x - x.mean()], 1)
    degrees = len(p) - A.shape[1]

    def fit(variance: float) -> tuple[float, float, float]:
        w = 1 / (sigma**2 + variance)
        Q = np.linalg.inv(A.T @ (w[:, None] * A))
        coefficients = Q @ A.T @ (w * p)
        return coefficients[-1], np.sqrt(Q[-1, -1]), float(w @ (p - A @ coefficients) ** 2)

    # τ² is 0 if the epochs scatter no more than their σ; it is below n times their variance, where
    # χ² ≤ (n − 1)/n is already less than any number of degrees of freedom
    low, high = 0.0, float(np.var(p, ddof=1) * len(p))
    chi2 = fit(0.0)[2]
    if chi2 <= degrees:
        high = 0.0
    # Bisection, down to neighbouring numbers: χ² decreases with τ².
    for _ in range(200 if high else 0):
        middle = (low + high) / 2
        low, high = (middle, high) if fit(middle)[2] > degrees else (low, middle)
    value, of_value, _ = fit(high)
    return float(value), float(of_value), float(np.sqrt(high)), chi2_tail(chi2, degrees)


def _trend(
    slope: float, sigma: float, tau: float, epochs: int
) -> tuple[float, float, float, float]:
    """Slope, σ, probability, τ; by Student's t where τ was estimated, else by the normal one."""
    # t² ~ F(1, f): two-sided
    square = (slope / sigma) ** 2
    by_chance = f_tail(square, 1, epochs - 2) if tau else chi2_tail(square, 1)
    return slope, sigma, by_chance, tau
