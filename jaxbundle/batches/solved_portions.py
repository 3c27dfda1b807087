"""The programs of error components (`correlated`), run on the portions of a solved batch; their
results in the order of the cameras and views of the user.

Portions come one after the other: large products use all cores, and two programs that wait for the
same threads never end."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from jaxbundle.adjustment.quality.correlated_errors import DEFAULTS
from jaxbundle.batches.camera import CONVERGED
from jaxbundle.batches.compiled import ProgramKey, Rows
from jaxbundle.batches.correlated import (
    ComponentForms,
    ComponentParts,
    forms_of_portion,
    parts_of_portion,
    scatter_of_portion,
    traces_of_portion,
)
from jaxbundle.batches.error_spans import COMPONENTS
from jaxbundle.batches.error_traces import SUMS, ComponentTraces
from jaxbundle.batches.input import Portion
from jaxbundle.batches.normal import POSE, CameraUnknowns, Sightings


class SolvedPortions(NamedTuple):
    """The portions of a batch with their rows, padded as they were solved; how many `cameras` the
    batch has, and how many views each."""

    key: ProgramKey
    portions: Sequence[Portion]
    rows: Sequence[Rows]
    cameras: int
    views: int

    def sampled(self, common: bool) -> Bool[np.ndarray, " cameras"]:
        """Cameras from which sizes are estimated: every solved one, or for one set of sizes some of
        them, as far as there are with views enough for components by view."""
        solved, views = np.zeros((2, self.cameras), int)
        for portion, rows in zip(self.portions, self.rows):
            number = len(portion.cameras)
            solved[portion.cameras] = rows["status"][:number] == CONVERGED
            views[portion.cameras] = rows["views"][:number].sum(1)
        is_sampled = solved > 0
        if common:
            has_many_views = is_sampled & (views >= DEFAULTS.min_images)
            candidates = np.flatnonzero(has_many_views if has_many_views.any() else is_sampled)
            step = max(len(candidates) / SUMS.cameras, 1)
            is_sampled = np.zeros(self.cameras, bool)
            is_sampled[candidates[np.arange(0, len(candidates), step).astype(int)]] = True
        return is_sampled

    def forms(self, is_wanted: Bool[np.ndarray, " cameras"]) -> ComponentForms:
        """Those of some cameras."""
        number = len(COMPONENTS)
        q, number_given = np.zeros((self.cameras, number)), np.zeros(self.cameras)
        for portion, rows, wanted_of_portion in self._wanted_portions(is_wanted):
            forms_found = forms_of_portion(
                self.key, DEFAULTS, *_adjusted(portion, rows), wanted_of_portion
            )
            q[portion.cameras], number_given[portion.cameras] = _without_padding(
                portion, forms_found
            )
        return ComponentForms(q, number_given)

    def traces(self, is_wanted: Bool[np.ndarray, " cameras"]) -> ComponentTraces:
        """Those of some cameras."""
        number = len(COMPONENTS)
        T, cubes = (np.zeros((self.cameras, *(number,) * n)) for n in (2, 3))
        for portion, rows, wanted_of_portion in self._wanted_portions(is_wanted):
            traces_found = traces_of_portion(
                self.key, DEFAULTS, *_adjusted(portion, rows), wanted_of_portion
            )
            T[portion.cameras], cubes[portion.cameras] = _without_padding(portion, traces_found)
        return ComponentTraces(T, cubes)

    def parts(self, is_wanted: Bool[np.ndarray, "cameras k"]) -> ComponentParts:
        """Those of some components of cameras."""
        number, k = len(COMPONENTS), len(self.key.free)
        remaining, interior = (np.zeros((self.cameras, number, *n)) for n in ((), (k, k)))
        pose = np.zeros((self.cameras, number, self.views, POSE))
        for portion, rows, wanted_of_portion in self._wanted_portions(is_wanted):
            adjusted = *_adjusted(portion, rows), portion.axes, portion.middle
            parts_found = parts_of_portion(self.key, DEFAULTS, *adjusted, wanted_of_portion)
            remaining[portion.cameras], interior[portion.cameras], padded = _without_padding(
                portion, parts_found
            )
            number_of_views = portion.views.shape[1]
            # Indices on both sides of a slice put the cameras and views in front.
            pose[portion.cameras[:, None], :, portion.views] = padded.swapaxes(1, 2)[
                :, :number_of_views
            ]
        return ComponentParts(remaining, interior, pose)

    def scatter(self, theta: Float[np.ndarray, "cameras k"]) -> Float[np.ndarray, "cameras k k"]:
        """The covariances of the forms of all cameras under errors of these sizes."""
        covariances = np.zeros((self.cameras, len(COMPONENTS), len(COMPONENTS)))
        for portion, rows, theta_of_portion in self._wanted_portions(theta):
            forms = scatter_of_portion(
                self.key, DEFAULTS, *_adjusted(portion, rows), theta_of_portion
            )
            (covariances[portion.cameras],) = _without_padding(portion, [forms])
        return covariances

    def _wanted_portions(self, wanted_of_all: Shaped[np.ndarray, "cameras *axes"]) -> Any:
        """The portions with rows in which something is wanted, and what, filled up with zeros."""
        for portion, rows in zip(self.portions, self.rows):
            wanted_of_portion = wanted_of_all[portion.cameras]
            if wanted_of_portion.any():
                number_missing = len(portion.axes) - len(wanted_of_portion)
                yield (
                    portion,
                    rows,
                    np.pad(
                        wanted_of_portion,
                        [(0, number_missing), *[(0, 0)] * (wanted_of_portion.ndim - 1)],
                    ),
                )


def _adjusted(portion: Portion, rows: Rows) -> tuple[Sightings, CameraUnknowns]:
    """What was adjusted of a portion, with its weights, and the unknowns found."""
    weight = np.asarray(portion.sightings.weight) * rows["views"][:, :, None]
    if "removed" in rows:
        weight = weight * ~rows["removed"]
    numbers = portion.sightings.point, portion.sightings.xy, weight
    sightings = Sightings(*(np.asarray(x, float) for x in numbers))
    return sightings, CameraUnknowns(rows["interior"], rows["quaternion"], rows["shift"])


def _without_padding(portion: Portion, padded: Sequence[Any]) -> list[np.ndarray]:
    return [np.asarray(x)[: len(portion.cameras)] for x in padded]
