"""The result of `calibrate_batch`: numbers by camera, as arrays, a table, or HTML."""

import dataclasses
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxbundle.arguments import show as quoted
from jaxbundle.batches.camera import CONVERGED, SOLVED, STATUS
from jaxbundle.batches.error_spans import COMPONENTS
from jaxbundle.batches.population import Population
from jaxbundle.cameras import CameraModel
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.report.layout import significant
from jaxbundle.results import TableMethods
from jaxbundle.types import not_none


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class BatchCalibration(TableMethods):
    """The cameras of a batch; all values of a camera without a solution are NaN.

    **Fields:**

    - `model`, `parameters`: the camera model and its k free parameters.
    - `status`: "converged"; "weak", the same, but the views do not determine the principal distance
      or point, whose σ is above a fiftieth of the principal distance (NaN for the values if
      the iterations could not end because of the geometry of the views, see `remark`); "misfit": it
      has values, but the residuals are too large, on their own (gross errors) or compared with the
      other cameras of the batch (see `jaxbundle.batches.misfit`). Without a solution "iteration
      limit", "singular", "not finite" (an infinite number among the measurements, or the start) or
      "too few points" (no usable view, or no redundancy).
    - `remark`: suspicious image points, or for an undetermined camera an RMS far above that of the
      others; mostly empty.
    - `undetermined`: the free parameters that the views do not determine, if that is why the
      camera is weak, singular or at the iteration limit.
    - `values`, `sigma`, `covariance`: of the free parameters; pixels, dimensionless coefficients.
    - `interior`: all parameters of the model, in its order.
    - `sigma0`: √(vᵀv/redundancy), pixels; all σ and covariances are a posteriori.
    - `rms`: √(Σ(vx² + vy²)/points), pixels, as OpenCV defines it.
    - `redundancy`, `iterations` (evaluations of the normal equations).
    - `views`: the used views. A view with fewer than 4 points of a planar object (6 of a spatial
      one), or with all of them on a line (in a plane), is excluded.
    - `sigma_correlated`, `covariance_correlated`, `sigma_position_correlated`,
      `sigma_angles_correlated`: under errors that image points share; `component_sizes` of them in
      pixels, in the order of `jaxbundle.batches.correlated.COMPONENTS` (NaN: not looked for); None
      if not requested.
    - `removed`: the image points removed by data snooping; None without it.
    - `position`, `angles`: X0, Y0, Z0 in the unit of the object; ω, φ, κ in radians, with
      `sigma_position`, `sigma_angles`; `rotation`: the matrices M.
    """

    model: str | CameraModel
    parameters: tuple[str, ...]
    status: Shaped[np.ndarray, " cameras"]
    remark: Shaped[np.ndarray, " cameras"]
    undetermined: Bool[np.ndarray, "cameras k"]
    values: Float[np.ndarray, "cameras k"]
    sigma: Float[np.ndarray, "cameras k"]
    covariance: Float[np.ndarray, "cameras k k"]
    interior: Float[np.ndarray, "cameras parameters"]
    sigma0: Float[np.ndarray, " cameras"]
    rms: Float[np.ndarray, " cameras"]
    redundancy: Int[np.ndarray, " cameras"]
    iterations: Int[np.ndarray, " cameras"]
    views: Bool[np.ndarray, "cameras views"]
    position: Float[np.ndarray, "cameras views 3"]
    angles: Float[np.ndarray, "cameras views 3"]
    sigma_position: Float[np.ndarray, "cameras views 3"]
    sigma_angles: Float[np.ndarray, "cameras views 3"]
    rotation: Float[np.ndarray, "cameras views 3 3"]
    removed: Bool[np.ndarray, "cameras views points"] | None = None
    covariance_correlated: Float[np.ndarray, "cameras k k"] | None = None
    sigma_correlated: Float[np.ndarray, "cameras k"] | None = None
    sigma_position_correlated: Float[np.ndarray, "cameras views 3"] | None = None
    sigma_angles_correlated: Float[np.ndarray, "cameras views 3"] | None = None
    component_sizes: Float[np.ndarray, "cameras components"] | None = None

    @property
    def converged(self) -> Bool[np.ndarray, " cameras"]:
        """Which have a determined solution that fits."""
        return self.status == STATUS[CONVERGED]

    @property
    def solved(self) -> Bool[np.ndarray, " cameras"]:
        """Which have values, including misfits and those of the weak ones that have any."""
        return np.isin(self.status, SOLVED) & np.isfinite(self.interior).all(1)

    def __len__(self) -> int:
        return len(self.status)

    def to_dict(self) -> dict[str, Any]:
        """Model and free parameters, and a row per camera."""
        return {
            "model": str(self.model),
            "parameters": list(self.parameters),
            "cameras": [
                {
                    "status": str(self.status[k]),
                    "remark": str(self.remark[k]),
                    "values": self.values[k].tolist(),
                    "sigma": self.sigma[k].tolist(),
                    **self._correlated(k),
                    "sigma0": float(self.sigma0[k]),
                    "rms": float(self.rms[k]),
                    "redundancy": int(self.redundancy[k]),
                    "iterations": int(self.iterations[k]),
                }
                for k in range(len(self))
            ],
        }

    def _correlated(self, i: int) -> dict[str, Any]:
        """σ of a camera under correlated errors and their sizes; nothing where not requested."""
        if self.sigma_correlated is None:
            return {}
        return {
            "sigma_correlated": self.sigma_correlated[i].tolist(),
            "error_components": self._components(i),
        }

    def _components(self, i: int) -> list[dict[str, Any]]:
        sizes = not_none(self.component_sizes)[i]
        return [
            {"name": name, "sigma": float(size), "unit": "px"}
            for name, size in zip(COMPONENTS, sizes)
            if np.isfinite(size)
        ]

    @property
    def sigma_ratio(self) -> float:
        """The median of σ under correlated errors over classical σ; NaN where not requested."""
        if self.sigma_correlated is None:
            return float("nan")
        ratio = self.sigma_correlated / self.sigma
        return float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else float("nan")

    def __str__(self) -> str:
        names, counts = np.unique(self.status, return_counts=True)
        states = ", ".join(f"{count} {name}" for name, count in zip(names, counts))
        rms = f"median RMS {np.nanmedian(self.rms):.4g} px" if self.solved.any() else "no result"
        lines_of_summary = [f"{len(self)} cameras, model {self.model}: {states}; {rms}"]
        if np.isfinite(self.sigma_ratio):
            lines_of_summary.append(
                f"σ under correlated errors {significant(self.sigma_ratio, 3)} times the classical "
                "ones (median)"
            )
        if self.removed is not None:
            lines_of_summary.append(
                f"{int(self.removed.sum())} image points removed by data snooping"
            )
        remarks, first_row, counts = np.unique(self.remark, return_index=True, return_counts=True)
        lines = [
            f"camera {row}{f' and {count - 1} more' if count > 1 else ''}: {remark}"
            for row, remark, count in sorted(zip(first_row, remarks, counts))
            if remark
        ]
        max_shown = 10  # of remarks that differ
        if len(lines) > max_shown:
            lines[max_shown:] = [f"and {len(lines) - max_shown} more remarks, see `remark`"]
        return "\n".join(lines_of_summary + lines)

    def row(self, i: int, brief: bool = False, views: int | None = None) -> dict:
        """The result of camera i as plain dicts and numbers (angles in radians), as a line of
        `jaxbundle batch`; `brief`: without covariance and poses; `views`: their number without
        padding; default: all."""
        row = {
            "status": str(self.status[i]),
            "model": str(self.model),
            "iterations": int(self.iterations[i]),
            "redundancy": int(self.redundancy[i]),
            "views": int(self.views[i].sum()),
            "views_left_out": np.flatnonzero(~self.views[i][:views]).tolist(),
        }
        if self.remark[i]:
            row["remark"] = str(self.remark[i])
        if self.removed is not None:
            removed_points = np.argwhere(self.removed[i])
            row["removed"] = len(removed_points) if brief else removed_points.tolist()
        if self.undetermined[i].any():
            row["undetermined"] = np.array(self.parameters)[self.undetermined[i]].tolist()
        if not self.solved[i]:
            return row | ({"rms": float(self.rms[i])} if np.isfinite(self.rms[i]) else {})
        estimates = zip(self.parameters, self.values[i].tolist(), self.sigma[i].tolist())
        row |= {
            "rms": float(self.rms[i]),
            "sigma0": float(self.sigma0[i]),
            "parameters": {name: {"value": v, "sigma": s} for name, v, s in estimates},
        }
        if self.sigma_correlated is not None:
            for name, s in zip(self.parameters, self.sigma_correlated[i].tolist()):
                row["parameters"][name]["sigma_correlated"] = s
            row["error_components"] = self._components(i)
        if not brief:
            names = ("position", "angles", "sigma_position", "sigma_angles")
            if self.sigma_correlated is not None:
                names += ("sigma_position_correlated", "sigma_angles_correlated")
                row["covariance_correlated"] = not_none(self.covariance_correlated)[i].tolist()
            columns = zip(*(getattr(self, name)[i][:views].tolist() for name in names))
            row |= {
                "covariance": self.covariance[i].tolist(),
                "poses": [dict(zip(names, values)) for values in columns],
            }
        return row

    def population(self, ids: Sequence | None = None) -> Population:
        """The distribution of the cameras, the outlying ones, and correlations of their parameters.

        **Arguments:** `ids` of the cameras; 0, 1, 2, … if not given.

        **Raises:** `InputError` where there are not as many ids as cameras."""
        ids = range(len(self)) if ids is None else ids
        if np.shape(ids) != (len(self),):
            raise InputError(f"ids must be {len(self)}, one for each camera, but are {quoted(ids)}")
        return Population({"key": str(id)} | self.row(i, True) for i, id in enumerate(ids))

    def table(self) -> dict[str, np.ndarray]:
        """One row per camera: status, remark, rms and sigma0 (pixels), redundancy, iterations,
        views, points removed where there was data snooping, every parameter and its σ, also under
        correlated errors where requested."""
        columns = {
            "status": self.status,
            "remark": self.remark,
            "rms": self.rms,
            "sigma0": self.sigma0,
            "redundancy": self.redundancy,
            "iterations": self.iterations,
            "views": self.views.sum(1),
        }
        if self.removed is not None:
            columns["removed"] = self.removed.sum((1, 2))
        for k, name in enumerate(self.parameters):
            columns |= {name: self.values[:, k], f"sigma_{name}": self.sigma[:, k]}
            if self.sigma_correlated is not None:
                columns[f"sigma_{name}_correlated"] = self.sigma_correlated[:, k]
        return columns

    def _repr_html_(self) -> str:
        """The cameras as a table, unconverged ones first."""
        table = self.table()
        if not (self.remark != "").any():
            del table["remark"]
        rows = np.argsort(self.converged, kind="stable")[:20]  # a screen
        cell = 'style="text-align:left;padding:2px 12px 2px 0"'
        cell_text = lambda x: f"{x:.6g}" if isinstance(x, float | np.floating) else escape(str(x))
        line = lambda tag, texts: (
            "<tr>" + "".join(f"<{tag} {cell}>{text}</{tag}>" for text in texts) + "</tr>"
        )
        body = "".join(
            line("td", [row, *(cell_text(column[row]) for column in table.values())])
            for row in rows
        )
        rest_in_words = f"<p>and {len(self) - len(rows)} more</p>" if len(self) > len(rows) else ""
        head = "<br>".join(map(escape, str(self).splitlines()))
        return (
            f'<div><b>{head}</b><table style="border-collapse:collapse;font-size:90%">'
            f"{line('th', ['camera', *table])}{body}</table>{rest_in_words}</div>"
        )
