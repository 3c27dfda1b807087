# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.planning.block_design import BlockDesign as BlockDesign
from jaxbundle.planning.block_design import design_block as design_block
from jaxbundle.planning.block_design import relief_displacement as relief_displacement
from jaxbundle.planning.block_design import scale as scale
from jaxbundle.planning.block_design import sigma_height as sigma_height
from jaxbundle.planning.block_design import sigma_plan as sigma_plan
from jaxbundle.planning.block_network import planned_network as planned_network
from jaxbundle.planning.rendering import Rendered as Rendered
from jaxbundle.planning.rendering import Scene as Scene
from jaxbundle.planning.rendering import Sensor as Sensor
from jaxbundle.planning.rendering import render as render
from jaxbundle.planning.rendering import render_rays as render_rays
from jaxbundle.planning.shapes import HeightField as HeightField
from jaxbundle.planning.shapes import Rectangle as Rectangle
from jaxbundle.planning.stations import Stations as Stations
from jaxbundle.planning.stations import aerial_block as aerial_block
from jaxbundle.planning.stations import cloud_of_targets as cloud_of_targets
from jaxbundle.planning.stations import grid_of_targets as grid_of_targets
from jaxbundle.planning.stations import ring_of_stations as ring_of_stations
from jaxbundle.planning.stations import stations_looking_at as stations_looking_at
from jaxbundle.planning.texture import Texture as Texture

__all__ = [
    "BlockDesign",
    "HeightField",
    "Rectangle",
    "Rendered",
    "Scene",
    "Sensor",
    "Stations",
    "Texture",
    "aerial_block",
    "cloud_of_targets",
    "design_block",
    "grid_of_targets",
    "planned_network",
    "relief_displacement",
    "render",
    "render_rays",
    "ring_of_stations",
    "scale",
    "sigma_height",
    "sigma_plan",
    "stations_looking_at",
]
