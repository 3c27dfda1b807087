"""Refinement of scanner images with control and tie points, jointly with photographs.

`refine` turns tables into a `Refinement`: least squares with the unknowns of `freedom`, the
equations of `kinds`, statistics, blunders, check points, warnings, and the refined images.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic
from jaxbundle.leastsquares.quality.correlation import correlation_matrix
from jaxbundle.leastsquares.quality.global_test import chi_squared_test, contradicts
from jaxbundle.leastsquares.quality.robust import residual_lengths, robust_scale
from jaxbundle.network.blunders import Removed
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import STATED, Network, Observations
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.bias import RpcBias, apply_bias
from jaxbundle.pushbroom.rpc.fitting import RpcCheck
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.rpc.polynomials import RpcStatus
from jaxbundle.refinement.beyond_priors import describe_beyond
from jaxbundle.refinement.build import check_input, choose_rays, start_points
from jaxbundle.refinement.check_points import RefinementCheckPoints, intersect
from jaxbundle.refinement.declare import declare
from jaxbundle.refinement.freedom import UnknownName, change_of
from jaxbundle.refinement.inputs import IMAGE, SENSOR, RefinementInput, gather
from jaxbundle.refinement.inspection import RefinementInspection, adjust
from jaxbundle.refinement.refined_image import refined_image
from jaxbundle.refinement.report import report as describe_refinement
from jaxbundle.refinement.report import to_json
from jaxbundle.refinement.rpc_points import RPC_IMAGE, misclosures
from jaxbundle.refinement.tables import (
    AnyScannerImage,
    GroundPoints,
    has_upright_checks,
    with_frames,
)
from jaxbundle.refinement.terrain_heights import TERRAIN_HEIGHTS, HeightModel
from jaxbundle.refinement.weakness import weaknesses
from jaxbundle.results import TableMethods, finite
from jaxbundle.types import not_none

TESTS = ("none", "baarda", "pope")


class TerrainFit(NamedTuple):
    """Residuals of heights of a terrain model: their number, `mean` and `rms` (metres), √(vᵀPv/Σr)
    as their `ratio` to σ, and whether it contradicts σ more than those of other observations."""

    number: int
    mean: float
    rms: float
    ratio: float
    is_contradicted: bool


@dataclasses.dataclass(frozen=True)
class Refinement(TableMethods):
    """The result: `inspection` holds its numbers."""

    inspection: RefinementInspection
    check: RefinementCheckPoints | None
    warnings: tuple[str, ...]

    def report(self) -> str:
        """The report as text."""
        return describe_refinement(self)

    def __str__(self) -> str:
        return self.report()

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON."""
        return finite(to_json(self))

    def table(self) -> dict[str, np.ndarray]:
        """One row an unknown shared by points: columns of, parameter, change, sigma, unit."""
        factor = np.array([name.factor for name in self.names])
        return {
            "of": np.array([name.owner for name in self.names], dtype=object),
            "parameter": np.array([name.parameter for name in self.names], dtype=object),
            "change": self.estimate * factor,
            "sigma": np.sqrt(np.diag(self.covariance)) * factor,
            "unit": np.array([name.unit for name in self.names], dtype=object),
        }

    @property
    def inputs(self) -> RefinementInput:
        """What was given."""
        return self.inspection.declared.inputs

    @property
    def images(self) -> list[AnyScannerImage]:
        """The given scanner images, rigorous ones before those with RPC."""
        return self.inputs.images

    @property
    def frames(self) -> Network | None:
        """The given photographs."""
        return self.inputs.frames

    @property
    def points(self) -> GroundPoints:
        """All given points, including those of the photographs."""
        return self.inputs.points

    @property
    def point_ids(self) -> list[str]:
        """The points used."""
        return [self.points.id[k] for k in self.inspection.declared.rays.points]

    @property
    def names(self) -> list[UnknownName]:
        """Names of the unknowns shared by points."""
        return [column.name for column in self.inspection.declared.columns]

    @property
    def prior_sigma(self) -> Float[np.ndarray, " m"]:
        """σ of the priors of these; infinite: none."""
        return np.array([column.sigma for column in self.inspection.declared.columns])

    @property
    def prior_change(self) -> Float[np.ndarray, " m"]:
        """The changes that the priors of these state: 0, unless a camera was observed elsewhere
        than at its start values."""
        return np.array([column.prior for column in self.inspection.declared.columns])

    @property
    def removed(self) -> tuple[Removed, ...]:
        """Observations removed by data snooping, in the order of removal."""
        return self.inspection.removed

    @property
    def sigma0(self) -> float:
        """σ0 a posteriori."""
        return self.inspection.sigma0

    def rays(self) -> dict[int, int]:
        """The number of points used by their number of rays."""
        declared = self.inspection.declared
        n, parts = len(declared.rays.points), declared.parts
        number = np.zeros(n, int)
        for part in parts:
            has_weight = self.inspection.has_weight[part.set].any(1)
            number += np.bincount(part.point[has_weight], minlength=n)
        rays, points = np.unique(number, return_counts=True)
        return dict(zip(rays.tolist(), points.tolist()))

    @property
    def robust_sigma0(self) -> float:
        """σ0 by the median of the residuals of image points (MAD), which blunders hardly change;
        1 without redundancy."""
        solution = self.inspection.solution
        if self.redundancy <= 0:
            return 1.0
        return robust_scale(solution.problem, residual_lengths(solution))

    def counts(self) -> dict[str, int]:
        """Observations with weight by their type, unknowns and redundancy: the first ones minus
        the second ones."""
        declared, solution = self.inspection.declared, self.inspection.solution
        images = {part.set for part in declared.parts}
        words = {"control points": "control coordinates", "distances": "distances"}
        words |= {TERRAIN_HEIGHTS: "terrain heights"}
        number = dict.fromkeys(("image coordinates", *words.values(), "priors"), 0)
        for observation_set in solution.problem.observations:
            word = (
                "image coordinates"
                if observation_set.name in images
                else words.get(observation_set.kind.name)
            )
            # Those of further kinds, unlike priors, are tested for blunders.
            kind = observation_set.kind
            word = word or (kind.name if kind.snooped else "priors")
            weighted = int(self.inspection.has_weight[observation_set.name].sum())
            number[word] = number.get(word, 0) + weighted
        free = {t.name: int((t.free > 0).sum()) for t in solution.problem.tables}
        of_points = free.pop("point")
        return number | {
            "point coordinates": of_points,
            "shared unknowns": sum(free.values()),
            "redundancy": self.redundancy,
        }

    @property
    def redundancy(self) -> int:
        """Observations and priors minus unknowns."""
        return self.inspection.redundancy

    def global_test(self) -> dict:
        """χ² test of vᵀPv (`leastsquares.quality.global_test`); `passed` is None where
        nobody stated σ of line and pixel, or of the image coordinates of photographs."""
        inputs, r = self.inspection.declared.inputs, self.redundancy
        frames = [] if inputs.frames is None else [inputs.frames.observations]
        sets = [inputs.observations, *frames]
        # One set of unstated σ makes vᵀPv a number without scale.
        origin = next(
            (source.sigma_origin for source in sets if source.sigma_origin != STATED), STATED
        )
        return chi_squared_test(r * self.sigma0**2, r, origin)

    @property
    def estimate(self) -> Float[np.ndarray, " m"]:
        """The changes of the shared unknowns, in the units of `freedom`."""
        return self.inspection.estimate

    @property
    def covariance(self) -> Float[np.ndarray, "m m"]:
        """The covariance of `estimate`, with σ0 a posteriori."""
        return self.inspection.sigma0**2 * self.inspection.cofactor

    @property
    def correlation(self) -> Float[np.ndarray, "m m"]:
        """The correlations of `estimate`."""
        return correlation_matrix(self.inspection.cofactor)

    @property
    def positions(self) -> Float[np.ndarray, "points 3"]:
        """Adjusted coordinates of the points used."""
        return self.inspection.positions

    def image(self, id: str) -> PushbroomImage | RpcImage:
        """A refined scanner image, for `locate`, `project` and the correction; of an image with
        RPC one with coefficients that contain its bias (`compensated`)."""
        index_of = {scanner_image.id: k for k, scanner_image in enumerate(self.images)}
        if id not in index_of:
            raise InputError(f"no scanner image {id!r}; there are {', '.join(index_of)}")
        k, inputs = index_of[id], self.inputs
        if k >= len(inputs.rigorous):
            return self.compensated[id][0]
        values, form = self.inspection.solution.values, inputs.forms[k]
        p = np.concatenate([values[IMAGE][k], values[SENSOR][inputs.sensor[k]]])
        return refined_image(inputs.rigorous[k].image, form, change_of(form.sizes, p))

    def bias(self, id: str) -> RpcBias:
        """The estimated bias of an image with RPC, pixels."""
        index_of = {rpc_image.id: k for k, rpc_image in enumerate(self.inputs.rpc)}
        if id not in index_of:
            raise InputError(f"no image with RPC {id!r}; there are {', '.join(index_of) or 'none'}")
        terms = np.shape(self.inputs.rpc[index_of[id]].bias_sigma)[1]
        bias = np.asarray(self.inspection.solution.values[RPC_IMAGE].bias)[index_of[id]]
        return RpcBias(*bias[:, :terms])

    @functools.cached_property
    def compensated(self) -> dict[str, tuple[RpcImage, RpcCheck | None]]:
        """By id the images with RPC that contain their biases, and the residuals of their fit (None
        for a shift, which is exact)."""
        images_and_residuals = {}
        for rpc_image in self.inputs.rpc:
            rpc, check = apply_bias(rpc_image.image.rpc, self.bias(rpc_image.id))
            images_and_residuals[rpc_image.id] = (
                dataclasses.replace(rpc_image.image, rpc=rpc),
                check,
            )
        return images_and_residuals

    def image_points(self) -> list[dict]:
        """One row per image point used, image by image: ids, v, r and w of both
        coordinates, whether it was removed."""
        declared, points = self.inspection.declared, self.point_ids
        images = self.inputs.ids
        rows = [
            {
                "image": images[i],
                "point": points[p],
                "v": v,
                "r": r,
                "w": w,
                "removed": bool(is_removed),
            }
            for part in declared.parts
            for i, p, v, r, w, is_removed in zip(
                part.image, part.point, *self.inspection.rows(part.set)
            )
        ]
        return [rows[k] for k in np.argsort(declared.image, kind="stable")]

    def terrain_heights(self) -> list[dict]:
        """One row per height of the terrain model used: id of the point, v (m), r, w, whether it
        was removed."""
        levelled, ids = self.inspection.declared.levelled, self.point_ids
        if not len(levelled):
            return []
        return [
            {"point": ids[p], "v": v, "r": r, "w": w, "removed": is_removed}
            for p, v, r, w, is_removed in zip(
                levelled.tolist(),
                *(x.ravel().tolist() for x in self.inspection.rows(TERRAIN_HEIGHTS)),
            )
        ]

    @functools.cached_property
    def terrain_fit(self) -> TerrainFit | None:
        """How the heights of the terrain model fit; None without any that is tested."""
        rows = [row for row in self.terrain_heights() if not row["removed"]]
        v, r = (np.array([row[name] for row in rows]) for name in ("v", "r"))
        if not (model := self.inputs.terrain) or not r.sum() > 0:
            return None
        ratio = float(np.sqrt((v**2).sum() / r.sum()) / model.sigma)
        # Where all fit as badly, or others worse, the terrain is not the cause.
        is_contradicted = ratio > max(self.sigma0, 1.0) and contradicts(ratio, float(r.sum()))
        return TerrainFit(
            len(v), float(v.mean()), float(np.sqrt((v**2).mean())), ratio, is_contradicted
        )

    def distances(self) -> list[dict]:
        """One row per distance used: ids of both points, v, r, w, whether it was
        removed."""
        inspection, rows = self.inspection, []
        for distances in inspection.declared.problem.observations:
            if distances.kind.name == "distances":
                rows += [
                    {
                        "from": self.point_ids[a],
                        "to": self.point_ids[b],
                        "v": float(v[0]),
                        "r": float(r[0]),
                        "w": float(w[0]),
                        "removed": bool(is_removed),
                    }
                    for a, b, v, r, w, is_removed in zip(
                        *distances.rows, *inspection.rows(distances.name)
                    )
                ]
        return rows


def refine(
    images: Sequence[AnyScannerImage],
    points: GroundPoints,
    observations: Observations,
    frames: Network | None = None,
    *,
    terrain: HeightModel | None = None,
    snooping: str = "none",
    significance: float = 0.001,
) -> Refinement:
    """Adjust scanner images, rigorous ones and those with RPC, and photographs that share points
    with them.

    **Arguments:**

    - `images`: `ScannerImage` and `RpcScannerImage` in any order.
    - `observations` of the scanner images: `xy` are line and pixel, `sigma` theirs.
    - `frames`: a network in the same object frame; its points are joined by their ids to `points`,
      its exterior orientations have priors, are held (σ 0) or free (NaN).
    - `terrain`: a terrain model whose heights are observations of tie points.
    - `snooping`: `"none"`, `"baarda"` (σ a priori, every observation separately) or `"pope"` (σ a
      posteriori, the largest of all), with the `significance` α, two-sided.

    **Raises:** `InputError` for unusable input, with its row; `NotSolvedError` if unknowns are not
    determined, with their names.
    """
    require_x64()
    if snooping not in TESTS:
        raise InputError(f"snooping {snooping!r}; expected one of {', '.join(TESTS)}")
    images = list(images)
    points = with_frames(points, frames)
    check_input(images, points, observations, frames)
    points = _checks_upright(points, images[0].earth)
    rays, check_rays, warnings = choose_rays(points, observations, frames)
    inputs = gather(images, points, observations, frames, terrain)
    inspection = adjust(declare(inputs, rays, start_points(inputs, rays)), snooping, significance)
    warnings += [
        *_without_terrain(inspection),
        *_outside_domains(inspection),
        *_unsettled(inspection),
    ]
    for weak in weaknesses(inspection.declared, inspection.solution):
        warnings.append(f"{weak.sentence}; only priors, if any, separate them")
    check = intersect(inspection, check_rays) if len(check_rays.points) else None
    result = Refinement(inspection, check, tuple(warnings))
    doubts = _contradicted_terrain(result), _beyond_priors(result, significance)
    return dataclasses.replace(result, warnings=(*result.warnings, *itertools.chain(*doubts)))


def _beyond_priors(result: Refinement, significance: float) -> Iterator[str]:
    """Unknowns that leave their priors by more than chance explains, as a warning."""
    ratio = np.abs(result.estimate - result.prior_change) / result.prior_sigma
    if beyond := describe_beyond(result.names, ratio, significance):
        yield f"beyond their priors: {beyond}, or the priors"


def _contradicted_terrain(result: Refinement) -> Iterator[str]:
    """That points are not on the terrain model, as a warning."""
    fit = result.terrain_fit
    if fit is not None and fit.is_contradicted:
        model = not_none(result.inputs.terrain)
        yield (
            f"{model.name} does not fit: residuals of {count(fit.number, 'height')} are "
            f"{fit.ratio:.3g} times as large as their σ of {model.sigma:g} m implies (RMS "
            f"{fit.rms:.3g} m, points on average {abs(fit.mean):.3g} m "
            f"{'above' if fit.mean > 0 else 'below'} it); check its heights (ellipsoid or geoid, "
            "metres or feet), its place and its age, trees and buildings, or their σ"
        )


def _without_terrain(inspection: RefinementInspection) -> Iterator[str]:
    """Tie points that the terrain model does not have, as a warning."""
    inputs, uncovered = inspection.declared.inputs, inspection.declared.uncovered
    if len(uncovered):
        ids = np.array(inputs.points.id)[inspection.declared.rays.points[uncovered]]
        yield (
            f"{not_none(inputs.terrain).name} has no height at {count(len(ids), 'tie point')}, "
            f"adjusted without one: {list_some(ids)}"
        )


def _unsettled(inspection: RefinementInspection) -> Iterator[str]:
    """That linearised observations still change, as a warning."""
    if inspection.unsettled:
        yield (
            "in the last round the heights of the terrain model still changed by "
            f"{inspection.unsettled:.2g} σ, or the scales of image points by as much of "
            "themselves; look for tie points at steps of the terrain, or leave it out"
        )


def _outside_domains(inspection: RefinementInspection) -> Iterator[str]:
    """Images with RPC that have points outside the domain of their coefficients, as warnings."""
    inputs, positions = inspection.declared.inputs, inspection.positions
    for part in inspection.declared.parts:
        if part.table != RPC_IMAGE:
            continue
        row, xy = part.image - len(inputs.rigorous), inputs.observations.xy[part.rows]
        X, values = positions[part.point], inspection.solution.values[RPC_IMAGE]
        is_outside = misclosures(values, row, X, xy)[1] != RpcStatus.INSIDE
        for i in np.unique(row[is_outside]):
            is_of_image = is_outside & (row == i)
            ids = np.array(inputs.points.id)[
                inspection.declared.rays.points[part.point[is_of_image]]
            ]
            yield (
                f"image {inputs.rpc[i].id!r}: {count(int(is_of_image.sum()), 'point')} of "
                f"{int((row == i).sum())} outside the domain of its coefficients, which are "
                f"extrapolated there: {list_some(ids)}"
            )


def _checks_upright(points: GroundPoints, earth: Ellipsoid | None) -> GroundPoints:
    """The axes of check points as east, north, up, for points at a given height."""
    if not has_upright_checks(earth):
        return points
    # One ray at a given height leaves two unknowns, which must be along the surface of that height.
    axes, checks = points.axes.copy(), np.array(points.role, dtype=object) == "check"
    axes[checks] = east_north_up(not_none(earth), points.X[checks])
    return dataclasses.replace(points, axes=axes)


def east_north_up(
    earth: Ellipsoid, X: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points 3 3"]:
    """The axes east, north and up at points, as rows."""
    longitude, latitude, _ = (np.asarray(v) for v in geodetic(earth, tuple(X.T)))
    s, c, z, k = np.sin(longitude), np.cos(longitude), np.sin(latitude), np.cos(latitude)
    nil = np.zeros_like(s)
    rows = (-s, c, nil), (-z * c, -z * s, k), (k * c, k * s, z)
    return np.stack([np.stack(row, -1) for row in rows], -2)
