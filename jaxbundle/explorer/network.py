"""The network explorer: the adjusted network, and the expected σ after moving stations.

The σ after a move are those of a design (`jaxbundle.precision`): J at the adjusted values with the
stations at their new positions, predicted image coordinates, the weights of the adjustment. σ
before the move are computed in the same way from the adjusted values, so that the two differ only
by the geometry. Both are multiplied by σ0 of the adjustment. Visibility is not changed; the answer
counts image points outside the image, or behind the camera.
"""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import coordinates
from jaxbundle.adjustment.quality.precision import Precision, precision
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.explorer.page import Switch, draw_controls, draw_tools, make_page, place
from jaxbundle.explorer.view import File, Given, check_keys, switch
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    omega_phi_kappa_near,
    quaternion_from_matrix,
)
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.leastsquares.spaces import PoseValue
from jaxbundle.network.columns import count, did_you_mean
from jaxbundle.network.tables import EXTERIOR
from jaxbundle.plotting.frame import image_frame
from jaxbundle.report.layout import clean, significant
from jaxbundle.report.page import (
    UNKNOWN,
    Origin,
    Page,
    Section,
    give_verdict,
)
from jaxbundle.report.page.markup import facts, grid, paragraph, text
from jaxbundle.report.page.scene import describe_frames, describe_network
from jaxbundle.report.page.sections import network as network_section
from jaxbundle.report.page.sections import photographs
from jaxbundle.report.page.tables import collect_tables
from jaxbundle.report.summary import summary
from jaxbundle.types import AnyArray

MEANING = {"omega": "ω", "phi": "φ", "kappa": "κ"}


class Moved(NamedTuple):
    """A station where it is now: its row, projection centre (object unit) and M."""

    row: int
    centre: Float[np.ndarray, "3"]
    M: Float[np.ndarray, "3 3"]


class NetworkView:
    """An adjusted network.

    **Raises:** `InputError` for one that was not solved.
    """

    def __init__(self, adjustment: Adjustment, origin: Origin = UNKNOWN):
        if not adjustment.converged:
            raise InputError(
                f"the adjustment did not converge ({adjustment.termination}); "
                "jaxbundle adjust says why"
            )
        self.adjustment, self.origin = adjustment, origin
        self.problem = adjustment.problem
        self.ids = self.problem.network.images.id
        self.units = np.array([1, 1, 1, *[adjustment.angle_scale] * 3])

    # --- σ of a design ----------------------------------------------------------------------

    @cached_property
    def _sigma(self):
        problem, sigma0 = self.problem, self.adjustment.sigma0
        scale = sigma0 if np.isfinite(sigma0) and sigma0 > 0 else 1.0
        return jax.jit(lambda data: precision(problem, data, sigma0=scale))

    def sigma(self, start: Values) -> Precision:
        """All σ of the network at these values.

        **Raises:** `InputError` if it leaves unknowns undetermined."""
        data: Data = dataclasses.replace(self.problem.data, start=start)
        all_sigma = jax.tree.map(np.asarray, self._sigma(data))
        if not np.isfinite(all_sigma.images).all():
            raise InputError(
                "the moved network does not determine all unknowns, or a camera has "
                "no image of one of its points"
            )
        model = self.adjustment.error_model
        if model is None:
            return all_sigma
        # The same sizes in the moved network: they are of cameras and pictures, not of geometry.
        sigma0 = self.adjustment.sigma0
        errors = precision(self.problem, data, sigma0=sigma0, errors=model.widened_sizes)
        return _larger(all_sigma, jax.tree.map(np.asarray, errors))

    @cached_property
    def before(self) -> Precision:
        """σ of the network as adjusted."""
        return self.sigma(self.adjustment.values)

    # --- moves ------------------------------------------------------------------------------

    def moves(self, given: Given) -> list[Moved]:
        """The moved stations; with `aim` rotated to look at their points.

        **Raises:** `InputError`."""
        check_keys(given, ("moves", "aim"))
        aim, requested = switch(given, "aim"), given.get("moves", {})
        if not isinstance(requested, Mapping):
            raise InputError(f"moves must be values by station, but is {show(requested)}")
        return [self._move(str(id), values, aim) for id, values in requested.items()]

    def _move(self, id: str, values: Any, aim: bool) -> Moved:
        if id not in self.ids:
            raise InputError(f"there is no image {id!r}{did_you_mean(id, self.ids)}")
        if (
            not isinstance(values, list)
            or len(values) != 6
            or not all(
                isinstance(v, int | float) and not isinstance(v, bool) and np.isfinite(v)
                for v in values
            )
        ):
            raise InputError(
                f"image {id!r}: expected six numbers {', '.join(EXTERIOR)}, got {show(values)}"
            )
        row = self.ids.index(id)
        pose = np.array(values, float) / self.units
        if not aim:
            M = np.asarray(matrix_from_omega_phi_kappa(jnp.asarray(pose[3:])))
            return Moved(row, pose[:3], M)
        return Moved(row, pose[:3], self._turn_to_points(row, pose[:3]))

    def _turn_to_points(self, row: int, centre: Float[np.ndarray, "3"]) -> np.ndarray:
        """M that keeps the image of the centre of the station's points, by the smallest
        rotation."""
        problem = self.problem
        points_seen = problem.point[(problem.image == row) & self.adjustment.located[problem.point]]
        pose = self.adjustment.image_values[row]
        M = np.asarray(matrix_from_quaternion(self.adjustment.values["image"].rotation[row]))
        if not len(points_seen):
            return M
        middle = self.adjustment.point_values[points_seen].mean(0)
        rays = (middle - X for X in (pose[:3], centre))
        old, new = (ray / (np.linalg.norm(ray) or 1.0) for ray in rays)
        return M @ _smallest_turn(old, new).T

    def start(self, moves: list[Moved]) -> Values:
        """The adjusted values with the stations at their new places."""
        values = self.adjustment.values
        position, rotation = map(np.array, values["image"])
        # Positions of the engine are relative to the origin of the network.
        for row, centre, M in moves:
            position[row] = centre - self.problem.origin
            rotation[row] = np.asarray(quaternion_from_matrix(jnp.asarray(M)))
        return values | {"image": PoseValue(jnp.asarray(position), jnp.asarray(rotation))}

    # --- what the server asks ---------------------------------------------------------------

    def answer(self, given: Given) -> dict[str, Any]:
        """`parts`; `stations`: by id the values of those moved, in the units of the network, and
        their pyramids; `sigma`: before and after, of points, the cameras' parameters and images;
        `ellipsoids`: after, of those drawn, the rows and six elements each."""
        moves = self.moves(given)
        if not moves:
            return {"parts": {"moved": paragraph("No station is moved.", "hint")}, "stations": {}}
        precision_before, precision_after = self.before, self.sigma(self.start(moves))
        parts = [
            self._say_visibility(moves),
            self._compare(moves, precision_before, precision_after),
        ]
        upper = np.triu_indices(3)  # the six independent elements of a covariance
        six = lambda C: C.reshape(-1, 3, 3)[:, *upper].ravel().tolist()
        covariance = {
            "points": precision_after.point_covariance,
            "images": precision_after.centre_covariance,
        }
        return {
            "ellipsoids": {
                table: {"rows": rows, "elements": six(covariance[table][np.array(rows, int)])}
                for table, rows in self._scene["ellipsoids"].items()
            },
            "parts": {"moved": "".join(parts)},
            "stations": {self.ids[m.row]: self._describe(m) for m in moves},
            "sigma": {
                when: {
                    "points": p.points.tolist(),
                    "cameras": p.cameras.tolist(),
                    "images": (p.images * self.units).tolist(),
                }
                for when, p in (("before", precision_before), ("after", precision_after))
            },
        }

    def export(self, name: str, _: Given, /) -> File:
        """There is none: the report of `adjust` has the tables.

        **Raises:** `InputError`."""
        raise InputError(f"there is no file {name!r}; jaxbundle adjust --out writes the tables")

    def _describe(self, moved: Moved) -> dict[str, list[float]]:
        angles_given = self.problem.network.images.angles[moved.row]
        angles = np.asarray(omega_phi_kappa_near(jnp.asarray(moved.M), jnp.asarray(angles_given)))
        return {
            "values": (np.concatenate([moved.centre, angles]) * self.units).tolist(),
            "pyramid": self._pyramid(moved).ravel().tolist(),
        }

    @cached_property
    def _scene(self) -> dict:
        return describe_network(self.adjustment)

    @cached_property
    def _corners(self) -> Float[np.ndarray, "images 5 3"]:
        """The pyramid of every image in the frame of its camera, from the projection centre."""
        from jaxbundle.plotting.style import extent
        from jaxbundle.plotting.views import camera_pyramids, pyramid_size

        centres = self.adjustment.image_values[:, :3]
        located_points = self.adjustment.point_values[self.adjustment.located]
        _, size = extent(np.concatenate([located_points, centres]))
        pyramids = camera_pyramids(self.adjustment, pyramid_size(centres, size))
        M = np.asarray(jax.vmap(matrix_from_quaternion)(self.adjustment.values["image"].rotation))
        return (pyramids - centres[:, None]) @ M.transpose(0, 2, 1)

    def _pyramid(self, moved: Moved) -> Float[np.ndarray, "5 3"]:
        position = moved.centre - np.array(self._scene["centre"])
        return position + self._corners[moved.row] @ moved.M

    def _say_visibility(self, moves: list[Moved]) -> str:
        """Messages about image points of moved stations outside the image or behind the camera."""
        problem, lines = self.problem, []
        for moved in moves:
            is_used = problem.used
            rays = np.flatnonzero(is_used & (problem.image == moved.row))
            camera = problem.network.cameras[problem.network.images.camera[moved.row]]
            model = get_model(camera.model)
            low, high, is_known = image_frame(self.adjustment, camera.id)
            p = self.adjustment.camera_parameters(camera.id)
            X = np.asarray(coordinates(self.adjustment.values))[problem.point[rays]]
            ray = (X - (moved.centre - problem.origin)) @ moved.M.T
            xy = images_of(model, p, ray)
            behind = np.zeros(len(rays), bool) if model.wide else ray[:, 2] >= 0
            is_outside = ~((xy >= low) & (xy <= high)).all(1) & is_known
            number_lost = int((behind | is_outside).sum())
            if number_lost:
                lines.append(
                    f"{number_lost} of {count(len(rays), 'image point')} of image "
                    f"{clean(self.ids[moved.row])} would be outside the image or behind "
                    "the camera; the σ below still include them"
                )
            elif not is_known:
                lines.append(
                    f"the size of the images of camera {clean(camera.id)} is not known: "
                    "whether all image points lie in them is not checked"
                )
        return "".join(paragraph(f"{line}.", "hint") for line in lines)

    def _compare(
        self,
        moves: list[Moved],
        precision_before: Precision,
        precision_after: Precision,
        max_points: int = 200,
    ) -> str:
        """The σ before and after: of all points together, cameras, moved stations, and of the
        points that change most."""
        network, unit = self.problem.network, clean(self.adjustment.network.object_unit)
        # Held points have σ 0 before and after.
        is_free = self.adjustment.located & (precision_before.points > 0).any(1)
        root = lambda s: np.sqrt(np.mean(s[is_free] ** 2, 0))
        rows = (
            [
                (f"σ{axis} of the points, RMS [{unit}]", a, b)
                for axis, a, b in zip(
                    "XYZ", root(precision_before.points), root(precision_after.points)
                )
            ]
            if is_free.any()
            else []
        )
        for c, camera in enumerate(network.cameras):
            names = get_model(camera.model).parameters
            rows += [
                (
                    f"σ {name} of camera {camera.id}",
                    precision_before.cameras[c, k],
                    precision_after.cameras[c, k],
                )
                for k, name in enumerate(names)
                if precision_before.cameras[c, k] > 0
            ]
        units = dict(zip(EXTERIOR, [unit] * 3 + [network.angle_unit] * 3))
        for moved in moves:
            a, b = (p.images[moved.row] * self.units for p in (precision_before, precision_after))
            rows += [
                (
                    f"σ {MEANING.get(name, name)} of image {self.ids[moved.row]} [{units[name]}]",
                    a[k],
                    b[k],
                )
                for k, name in enumerate(EXTERIOR)
                if a[k] > 0
            ]
        header = ("", "as adjusted", "moved", "change")
        table = grid(header, [(name, *_pair(a, b)) for name, a, b in rows])
        ids = np.array(network.points.id, dtype=object)
        change = np.where(
            is_free, np.abs(np.log(_ratio(precision_before.points, precision_after.points))), -1
        )
        order = [p for p in np.argsort(-change)[:max_points] if is_free[p]]
        points = [
            (
                ids[p],
                *(
                    significant(float(s))
                    for axis in range(3)
                    for s in (precision_before.points[p, axis], precision_after.points[p, axis])
                ),
            )
            for p in order
        ]
        header = ("point", *(f"σ{axis} {when}" for axis in "XYZ" for when in ("before", "after")))
        table_of_points = f"<h3>Points, the largest change first [{text(unit)}]</h3>\n" + grid(
            header, points
        )
        return table + table_of_points

    def page(self, given: Given, live: bool) -> Page:
        """The network of the report to turn, and the place for the chosen station and its moves."""
        adjustment, answer = self.adjustment, self.answer(given)
        drawings = {"network-data": self._scene, "frames": describe_frames(adjustment)}
        title = f"{clean(adjustment.network.name) or 'network'}: explorer"
        shown_first = give_verdict(
            adjustment.verdict.findings,
            adjustment.warnings,
            facts(row for row in summary(adjustment) if row[0] != "Note"),
        )
        sections = [
            shown_first,
            network_section(),
            _selection(),
            self._move_section(given, live),
            photographs(),
        ]
        state = {"moves": given.get("moves", {}), "aim": given.get("aim", True)}
        return make_page(
            title,
            sections,
            self.origin,
            live,
            "network",
            answer,
            tables=collect_tables(adjustment),
            drawings=drawings,
            given=state,
        )

    def _move_section(self, given: Given, live: bool) -> Section:
        dead = "" if live else " disabled"
        unit = text(clean(self.adjustment.network.object_unit))
        angle = text(self.adjustment.network.angle_unit)
        fields = "".join(
            f'<label><span>{MEANING.get(name, name)}</span><input type="number" step="any" '
            f'id="move-{name}"{dead}><span>{unit if name.endswith("0") else angle}</span></label>\n'
            for name in EXTERIOR
        )
        aim = draw_controls(
            [Switch("aim", "turned to its points", given.get("aim", True) is True)], live
        )
        hint = (
            "Where would a station be better? Same measurements, new geometry: σ to "
            "first order, times σ0, with image points as they would be seen from there. "
            "The error ellipsoids of the drawing are then the expected ones."
        )
        if self.adjustment.error_model is not None:
            hint += (
                " σ are the larger of the classical ones and of those under correlated errors of "
                f"the sizes found, {significant(self.adjustment.sigma_ratio, 3)} times as large "
                "as adjusted (median of the orientations)."
            )
        parts = [
            paragraph(hint, "hint"),
            '<div class="controls"><label><span>station</span><select id="move-station"></select>'
            "</label></div>\n",
            f'<div class="controls">\n{fields}</div>\n',
            aim,
            f'<div class="tools"><button type="button" id="move-back"{dead}>all as adjusted'
            "</button></div>\n",
            draw_tools(live),
            place("moved"),
        ]
        return Section("move", "Move a station", "".join(parts), "Move a station")


def _smallest_turn(old: Float[np.ndarray, "3"], new: Float[np.ndarray, "3"]) -> np.ndarray:
    """The rotation of one direction into another, about the axis across both."""
    axis = np.cross(old, new)
    sine, cosine = np.linalg.norm(axis), old @ new
    # Below 1e-8 rounding has half the digits of the axis, and any axis across both is as good: of
    # the upright ones, since a station looks to the other side without being turned over.
    if cosine < 0 and sine < 1e-8:
        upright = np.eye(3)[2 - np.argmin(abs(old[::-1]))]
        axis = upright - upright @ old * old
        return np.asarray(matrix_from_rotation_vector(np.pi * axis / np.linalg.norm(axis)))
    if sine == 0:
        return np.eye(3)
    return np.asarray(matrix_from_rotation_vector(axis / sine * np.arctan2(sine, cosine)))


def _larger(precision_a: Precision, precision_b: Precision) -> Precision:
    """The larger σ of every unknown, and of two covariances that of the larger trace."""
    is_first_larger = lambda a, b: np.trace(a, axis1=1, axis2=2) >= np.trace(b, axis1=1, axis2=2)
    pick = lambda a, b: np.where(is_first_larger(a, b)[:, None, None], a, b)
    return Precision(
        images=np.maximum(precision_a.images, precision_b.images),
        cameras=np.maximum(precision_a.cameras, precision_b.cameras),
        points=np.maximum(precision_a.points, precision_b.points),
        covariance=precision_a.covariance,
        point_covariance=pick(precision_a.point_covariance, precision_b.point_covariance),
        centre_covariance=pick(precision_a.centre_covariance, precision_b.centre_covariance),
    )


def _selection() -> Section:
    """The place for the clicked item."""
    parts = [
        paragraph(
            "Click a point, a station, a ray, or an image point in a photograph: its "
            "observations with σ a priori, redundancy number r, w, τ, the minimal detectable "
            "blunder and its effect.",
            "hint",
        ),
        '<div id="chosen" class="scroll" aria-live="polite"></div>\n',
    ]
    return Section("chosen-section", "What is chosen", "".join(parts), "What is chosen")


def _ratio(
    sigma_before: Float[AnyArray, "points 3"], sigma_after: Float[AnyArray, "points 3"]
) -> Float[np.ndarray, " points"]:
    """Ratio of the σ of points after and before, RMS over their axes; 1 where one of them is 0."""
    a, b = (np.sqrt(np.mean(s**2, 1)) for s in (sigma_before, sigma_after))
    return np.where((a > 0) & (b > 0), b / np.where(a > 0, a, 1.0), 1.0)


def _pair(a: float, b: float) -> tuple[str, str, str]:
    change = f"{100 * (b / a - 1):+.1f} %" if a > 0 else ""
    return significant(a, 4), significant(b, 4), change
