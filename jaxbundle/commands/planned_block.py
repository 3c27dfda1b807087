"""`plan`: an aerial block of vertical photographs."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from jaxbundle.adjustment.quality.expected_precision import ExpectedPrecision, expected_precision
from jaxbundle.cameras.field_of_view import (
    FieldOfView,
    angle_class,
    equivalent_35mm,
    field_of_view,
)
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.network.tables import Camera, Network
from jaxbundle.planning.block_design import BlockDesign, design_block, relief_displacement
from jaxbundle.planning.block_network import planned_network
from jaxbundle.results import TableMethods

# Photographs whose covariance is computed: that of 12 000 elements takes 1.2 GB.
MAX_PHOTOGRAPHS = 2000


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class PlannedBlock(TableMethods):
    """A planned block: its `design`, and the values it was planned with (mm in the image, metres on
    the ground; `errors`: sizes of errors that image points share, by name)."""

    design: BlockDesign
    c: float
    image: tuple[float, float]
    area: tuple[float, float]
    sigma_image: float
    control_sigma: float
    control_every: int | None
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def field_of_view(self) -> FieldOfView:
        """Along and across the flight, diagonal; radians."""
        return field_of_view(self.c, self.image)

    @cached_property
    def network(self) -> Network:
        """The block as a simulated network, for `jaxbundle.adjust` or `write_project`."""
        return planned_network(
            self.design,
            Camera("cam", "brown", {"c": self.c}),
            self.image,
            self.area,
            self.sigma_image,
            self.control_sigma,
            self.control_every,
        )

    @cached_property
    def precision(self) -> ExpectedPrecision:
        """σ of the simulated block, from its covariance.

        **Raises:** `InputError` for a block of more than 2000 photographs."""
        if self.design.photographs > MAX_PHOTOGRAPHS:
            raise InputError(
                f"{self.design.photographs} photographs: too many for a covariance; give "
                "--no-network, or plan a part of the area"
            )
        return expected_precision(self.network, self.errors)

    def table(self) -> dict[str, np.ndarray]:
        """One row a figure of the block: columns quantity, value (object unit; of the pixel on the
        ground NaN if the pixel is unknown)."""
        figures: dict[str, Any] = dataclasses.asdict(self.design)
        figures["footprint_along"], figures["footprint_across"] = figures.pop("footprint")
        figures["photographs"] = self.design.photographs
        return {
            "quantity": np.array([*figures], dtype=object),
            "value": np.array([*figures.values()], dtype=float),
        }

    def to_dict(self) -> dict[str, Any]:
        """The plan as plain dicts and numbers; angles in degrees. The σ of the simulated block are
        there if they were computed."""
        design = dataclasses.asdict(self.design)
        design |= {
            "photographs": self.design.photographs,
            "field_of_view": [float(np.degrees(angle)) for angle in self.field_of_view],
        }
        if "precision" in self.__dict__:
            names = ("mean", "smallest", "largest")
            design["precision"] = {
                axis: dict(zip(names, statistics))
                for axis, statistics in self.precision.summary().items()
            }
        return without_nan(design)

    def __str__(self) -> str:
        """The plan in lines; with the simulated block if it was computed."""
        return "\n".join(f"{name:22}{value}" for name, value in self._rows())

    def _rows(self) -> list[tuple[str, str]]:
        design, view = self.design, self.field_of_view
        degrees = ", ".join(f"{np.degrees(angle):.2f}°" for angle in view)
        # Of 1 % of the flying height, so that other heights follow by proportion.
        relief = relief_displacement(self.image[1] / 2, 0.01 * design.height, design.height)
        ground = "" if design.pixel_on_ground is None else f"  pixel {design.pixel_on_ground:.4g} m"
        rows = [
            ("field of view", f"{degrees} (along, across, diagonal): {angle_class(view.diagonal)}"),
            ("35 mm equivalent", f"{equivalent_35mm(self.c, self.image):.1f} mm"),
            ("flying height", f"{design.height:.6g} m above ground"),
            ("scale", f"1 : {design.scale_number:.6g}{ground}"),
            ("footprint", f"{design.footprint[0]:.6g} × {design.footprint[1]:.6g} m"),
            ("relief displacement", f"{relief:.4g} mm at the edge for 1 % of the flying height"),
            ("base", f"{design.base:.6g} m  b/H {design.base_to_height:.3f}"),
            (
                "strips",
                f"{design.strips}, {design.spacing:.6g} m apart "
                f"(side overlap {100 * design.side_overlap:.1f} %)",
            ),
            (
                "photographs",
                f"{design.photographs_per_strip} per strip, {design.photographs} in all",
            ),
            ("σX, σH by formula", f"{design.sigma_plan:.4g} m, {design.sigma_height:.4g} m"),
        ]
        if "network" in self.__dict__:
            points = self.network.points
            control = int(points.has_role("control", "fixed").sum())
            rows.append(("simulated block", f"{len(points)} points, {control} of them control"))
        if "precision" in self.__dict__:
            for axis, (mean, low, high) in self.precision.summary().items():
                rows.append((f"σ{axis} of tie points", f"{mean:.4g} m ({low:.4g} to {high:.4g})"))
        return rows


def plan(  # noqa: PLR0913 (public: the options of the command, all but four by name)
    c: float,
    image: tuple[float, float],
    area: tuple[float, float],
    sigma_image: float,
    *,
    height: float | None = None,
    scale: float | None = None,
    ground_pixel: float | None = None,
    pixel: float | None = None,
    forward: float = 0.6,
    side: float = 0.3,
    control_sigma: float = 0.05,
    control_every: int | None = None,
    network: bool = True,
    errors: Mapping[str, float] = MappingProxyType({}),
) -> PlannedBlock:
    """Plan a block of vertical photographs: strips, photographs, expected precision.

    **Arguments:**

    - `c`: principal distance, `image`: format along and across the flight, `sigma_image`: σ of an
      image coordinate, all in mm; `area`: length and width, metres.
    - one of `height` above ground (m), `scale` number m of 1 : m, `ground_pixel` (m, with the
      `pixel` size in mm).
    - `forward`, `side`: overlaps, parts of 1.
    - `control_sigma`: σ of control points (m); `control_every`: bases and strips between them, by
      default nine in all.
    - `errors`: sizes (mm) of errors that image points share, by name as `adjust` lists them, such
      as `{"principal point by photograph": 0.001}`: σ of the simulated block under them.
    - `network`: simulate the block and compute its σ; otherwise `PlannedBlock.network` and
      `precision` do when they are used.

    **Raises:** `InputError` for an impossible block, or one too large for its covariance.
    """
    design = design_block(
        c,
        image,
        area,
        sigma_image,
        height=height,
        scale_number=scale,
        pixel_on_ground=ground_pixel,
        pixel=pixel,
        forward_overlap=forward,
        side_overlap=side,
    )
    block = PlannedBlock(
        design, c, image, area, sigma_image, control_sigma, control_every, dict(errors)
    )
    if network:
        block.precision  # noqa: B018 - computed now, kept by the property
    return block
