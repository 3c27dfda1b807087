r"""Bias test of a calibration: its residuals compared with an independent estimate of corner noise.

The residuals contain the noise of the measured corners, and systematic errors of camera model
and board: a missing coefficient, a bent board, a rolling shutter.

**Cells.** Four neighbouring corners form a small board. Its pose is estimated separately, with the
calibrated camera: systematic errors are nearly constant over a cell and absorbed by the
pose; noise remains. In linear form, with J the derivatives of four corners by the pose, and N an
orthonormal basis of the remaining 8 − 6 = 2 dimensions,

    NᵀJ = 0,        t = Nᵀ·v/σ

The σ of the corners is estimated robustly from the median of |t|. The bias ratio, the systematic
fraction of the residual variance, compares it with σ0 of the calibration:

    BR = 1 − σ²_corner/σ0²

The test compares two nested linear models: the calibration, Ω = vᵀPv with r degrees of freedom,
and the one in which every cell has a pose of its own (camera, board and priors are estimated from
all t), Ω' with r'. Without a bias

    F = ((Ω − Ω')/(r − r')) / (Ω'/r')   ~   F(r − r', r')

**Smooth biases.** The cell test has little power because it is unspecific. Two more tests add a
smooth field with q free coefficients b to the calibration
(`observation_equations.lagrange_multipliers`, no second adjustment),

    F = (bᵀSb/q) / ((Ω − bᵀSb)/(r − q))   ~   F(q, r − q)

"camera": polynomials of the fifth degree in the image, the same in all photographs; "board":
polynomials of the fourth degree on the board for its heights, of the second in its plane. Fields
that the unknowns can absorb to 99 % are dropped and do not count in q. The level is divided evenly
among the tests that can be made (`found`).

Source: Hagemann, Knorr, Janssen, Stiller (2022), Inferring bias and uncertainty in camera
calibration, International Journal of Computer Vision 130 (cells, robust noise, bias ratio); F tests
of nested models: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models,
section 4.2.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.calibration.observation_equations import (
    LinearisedImagePoints,
    lagrange_multipliers,
    linearise_image_points,
)
from jaxbundle.calibration.pixels import unit_size
from jaxbundle.calibration.quality import used_rays
from jaxbundle.cameras import get_model
from jaxbundle.leastsquares.quality.distributions import f_tail, normal_quantile

# Joint level of the tests: one good calibration in a hundred is suspected.
SIGNIFICANCE = 0.01


@dataclasses.dataclass(frozen=True)
class BiasSettings:
    """What the tests of a bias look for.

    **Fields:**

    - `min_cells`: of four corners, and degrees of freedom they must leave: with 10 the σ of a
      corner is known to a third (1/√(2·10·0.37), since a median has 37 % of the efficiency of a
      standard deviation).
    - `camera_degree`: of the polynomials in the image: the fifth contains r⁴·x, the term of k2, and
      everything below.
    - `height_degree`, `plane_degree`: of those on the board: a board bends in its length and its
      width, and twists (fourth); its plane is stretched and sheared (second).
    - `min_remainder`: fraction of the square of a field that the unknowns must leave; less is not
      worth a degree of freedom.
    """

    min_cells: int = 10
    camera_degree: int = 5
    height_degree: int = 4
    plane_degree: int = 2
    min_remainder: float = 0.01


@dataclasses.dataclass(frozen=True)
class FTest:
    """F, its degrees of freedom, and its p-value."""

    F: float
    degrees: tuple[int, int]
    probability: float

    def __str__(self) -> str:
        q, r = self.degrees
        return f"F = {self.F:.2f} ({q}, {r}), p = {self.probability:.2g}"


@dataclasses.dataclass(frozen=True)
class CalibrationBias:
    """Corner noise compared with the residuals of a calibration.

    **Fields:** `cells` of four corners; `corner_sigma`: σ of a coordinate from them, robust;
    `residual_sigma`: σ0 of the calibration as σ of a coordinate, both pixels; `tests`: by "cells",
    "camera", "board" (not if its points are free).
    """

    cells: int
    corner_sigma: float
    residual_sigma: float
    tests: dict[str, FTest]

    @property
    def ratio(self) -> float:
        """The bias ratio; without a bias around 0, possibly negative."""
        return 1 - (self.corner_sigma / self.residual_sigma) ** 2

    @property
    def found(self) -> tuple[str, ...]:
        """The tests that detect a bias, the most significant first; joint level 1 %."""
        tests = sorted(self.tests.items(), key=lambda item: (item[1].probability, -item[1].F))
        level = SIGNIFICANCE / len(tests)
        return tuple(name for name, test in tests if test.probability < level)

    @property
    def sentence(self) -> str:
        """The conclusion in words."""
        if not self.found:
            return "no bias is found at a level of 1 %"
        smooth = [name for name in self.found if name != "cells"]
        remedy = {
            "camera": "another camera model (--models)",
            "board": "estimate the points of the board (--board-free)",
        }
        description = (
            f"as of the {smooth[0]}: {remedy[smooth[0]]}" if smooth else "of no smooth kind"
        )
        part = f", {100 * self.ratio:.0f} % of the residual variance" if self.ratio > 0 else ""
        return f"the residuals contain a bias{part}, {description}"


def find_bias(
    adjustment: Adjustment, *grids: tuple[int, int], settings: BiasSettings | None = None
) -> CalibrationBias | None:
    """Test the calibration of one camera from photographs of boards.

    **Arguments:** the adjustment; `grids`: rows and columns of each board, whose points follow each
    other row by row, board by board.

    **Returns:** None if there are too few complete cells, or no redundancy.
    """
    settings = settings or BiasSettings()
    problem = adjustment.problem
    cells = cells_of_four(problem, *grids)
    if len(cells) < settings.min_cells or not adjustment.sigma0 > 0:
        return None
    linearised = linearise_image_points(problem, adjustment.values)
    t, A = _equations(adjustment, linearised, cells)
    # An orthonormal basis of what camera and board can move in all t: the projection needs no
    # normal equations, whose condition is the square of that of A. Columns to the length 1, since
    # k3 and f differ by ten powers of ten.
    U, size, _ = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=0), 1e-300), False)
    U = U[:, size > len(A) * np.finfo(float).eps * size[0]]
    remaining, degrees = t - U @ (U.T @ t), len(t) - U.shape[1]
    further_redundancy = adjustment.redundancy - degrees
    if degrees < settings.min_cells or further_redundancy < 1:
        return None
    omega, of_cells = float(remaining @ remaining), slice(0, 2 * len(cells))
    # Each over the root of its redundancy number, so that its σ is 1; the median of |x| as σ; 1e-3:
    # a t that determines a parameter alone has the number 0 but for rounding.
    root = np.sqrt(np.clip(1 - np.sum(U**2, 1), 1e-3, None))
    noise = float(np.median(np.abs(remaining / root)[of_cells])) / normal_quantile(0.75)
    tests = {"cells": _f_test(adjustment.vtpv - omega, further_redundancy, omega, degrees)}
    fields = {
        "camera": _image_fields(problem, settings.camera_degree),
        "board": _board_fields(problem, linearised, settings),
    }
    for name, B in fields.items():
        gain, q = _gain(adjustment, linearised, B, settings.min_remainder)
        r = adjustment.redundancy - q
        if q and r > 0:
            tests[name] = _f_test(gain, q, adjustment.vtpv - gain, r)
    camera = problem.network.cameras[0]
    pixel = np.array(unit_size(get_model(camera.model), camera.pixel_size))
    weight = problem.image_weights[np.ravel(cells)]
    sigma = float(np.sqrt(np.mean(1 / (weight * pixel) ** 2)))
    return CalibrationBias(len(cells), sigma * noise, sigma * adjustment.sigma0, tests)


def _f_test(gain: float, q: int, remaining: float, r: int) -> FTest:
    F = (gain / q) / (remaining / r)
    return FTest(float(F), (q, r), f_tail(max(float(F), 0.0), q, r))


def _gain(
    adjustment: Adjustment,
    linearised: LinearisedImagePoints,
    B: Float[np.ndarray, "n 2 k"],
    min_remainder: float,
) -> tuple[float, int]:
    """The decrease of vᵀPv by the parameters of B, and the number of independent ones."""
    B = B / np.maximum(np.sqrt((B**2).sum((0, 1))), 1e-300)
    # Along the eigenvectors of S the coefficients are independent; a small eigenvalue is a field of
    # which the unknowns, or the other fields, leave less than `min_remainder`.
    score, S = lagrange_multipliers(adjustment, linearised, B)
    size, V = np.linalg.eigh(S)
    new = size > min_remainder
    return float(((V[:, new].T @ score) ** 2 / size[new]).sum()), int(new.sum())


def _powers(
    xy: Float[np.ndarray, "n 2"], lowest_degree: int, highest_degree: int
) -> Float[np.ndarray, "n terms"]:
    """Products of Legendre polynomials of x and y [n, 2], both scaled to −1 … 1, of all degrees
    from `lowest_degree` to `highest_degree`."""
    scaled = [2 * (a - a.min()) / max(np.ptp(a), 1e-300) - 1 for a in xy.T]
    P, R = (np.polynomial.legendre.legvander(a, highest_degree) for a in scaled)
    pairs = [
        (i, j)
        for i in range(highest_degree + 1)
        for j in range(highest_degree + 1)
        if lowest_degree <= i + j <= highest_degree
    ]
    return np.stack([P[:, i] * R[:, j] for i, j in pairs], 1)


def _image_fields(problem: NetworkProblem, degree: int) -> Float[np.ndarray, "n 2 k"]:
    """Smooth displacements in x and y over the image, divided by σ."""
    field = _powers(problem.image_coordinates(), 0, degree)
    weighted = problem.image_weights[:, :, None] * field[:, None]
    zeros = np.zeros_like(weighted[:, 0])
    return np.stack([np.hstack([weighted[:, 0], zeros]), np.hstack([zeros, weighted[:, 1]])], 1)


def _board_fields(
    problem: NetworkProblem, linearised: LinearisedImagePoints, settings: BiasSettings
) -> Float[np.ndarray, "n 2 k"]:
    """Image effects of smooth displacements of the board points, divided by σ."""
    XY = problem.network.points.position[problem.point, :2]
    plane = _powers(XY, 0, settings.plane_degree)
    height = _powers(XY, 2, settings.height_degree)  # a height and a tilt are those of the pose
    slopes_of_points = linearised.slopes["point"]
    return np.concatenate(
        [
            slopes_of_points[:, :, :1] * plane[:, None],
            slopes_of_points[:, :, 1:2] * plane[:, None],
            slopes_of_points[:, :, 2:] * height[:, None],
        ],
        2,
    )


def cells_of_four(problem: NetworkProblem, *grids: tuple[int, int]) -> Int[np.ndarray, "cells 4"]:
    """The image points of every complete cell of 2 × 2 points of the boards, in all photographs."""
    used_points = np.flatnonzero(used_rays(problem))
    sizes = [rows * columns for rows, columns in grids]
    place = np.full((len(problem.network.images), sum(sizes)), -1)
    place[problem.image[used_points], problem.point[used_points]] = used_points
    cells = []
    for (rows, columns), rays_of_board in zip(
        grids, np.split(place, np.cumsum(sizes)[:-1], axis=1)
    ):
        # Cells share no corner, so that their t are independent; an odd last row or column is not
        # used.
        even_part = rays_of_board.reshape(-1, rows, columns)[:, : rows // 2 * 2, : columns // 2 * 2]
        corners = [even_part[:, i::2, j::2].ravel() for i in (0, 1) for j in (0, 1)]
        cells.append(np.stack(corners, 1))
    all_cells = np.concatenate(cells)
    return all_cells[(all_cells >= 0).all(1)]


def _equations(
    adjustment: Adjustment, linearised: LinearisedImagePoints, cells: Int[np.ndarray, "cells 4"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m u"]]:
    """t of all cells, followed by the pseudo-observations, and their derivatives by the free
    parameters of camera and board."""
    problem = adjustment.problem
    (name,) = (table.name for table in problem.cameras)
    by_cell = lambda x: x[cells].reshape(len(cells), 8, -1)
    # The last left singular vectors of J [8, 6] span what no pose of the cell can move.
    N = np.linalg.svd(by_cell(linearised.slopes["image"]))[0][:, :, 6:]
    t = np.einsum("cek,cep->ckp", N, by_cell(linearised.v)).ravel()
    of_camera = np.einsum("cek,cep->ckp", N, by_cell(linearised.slopes[name]))
    # A free or weighted board: its coordinates are columns of A, too.
    free = problem.table("point").free.astype(bool)
    of_points = np.zeros((len(cells), 2, *free.shape))
    if free.any():
        slope = linearised.slopes["point"][cells]
        by_corner = np.einsum("cqrk,cqrw->qckw", N.reshape(-1, 4, 2, 2), slope)
        for corner, part in enumerate(by_corner):
            of_points[np.arange(len(cells)), :, problem.point[cells[:, corner]]] = part
    flat = lambda x: x.reshape(len(t), -1)
    A = np.concatenate([flat(of_camera), flat(of_points)[:, free.ravel()]], 1)
    # Pseudo-observations of a weighted board, and of the camera.
    v, width = adjustment.inspection.residuals, of_camera.shape[2]
    place = np.full(free.shape, -1)
    place[free] = width + np.arange(free.sum())
    table, moving = problem.table(name), list(problem.table(name).vector.moving)
    of_table = np.full((table.rows, table.vector.size), -1)
    of_table[:, moving] = np.arange(width)
    for kind, columns in (("control", place), ("interior", of_table)):
        if kind not in v:
            continue
        x, weight = v[kind], problem.weights(kind)
        column = columns[problem.observations_of(kind).rows[0]]
        has_weight = weight > 0
        rows = np.zeros((int(has_weight.sum()), A.shape[1]))
        rows[np.arange(len(rows)), column[has_weight]] = weight[has_weight]
        t, A = np.append(t, x[has_weight]), np.concatenate([A, rows])
    return t, A
