"""Planned networks: stations, targets, simulated and rendered measurements."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.planning.rendering": (
        "Rendered",
        "Scene",
        "Sensor",
        "render",
        "render_rays",
    ),
    "jaxbundle.planning.shapes": (
        "HeightField",
        "Rectangle",
    ),
    "jaxbundle.planning.texture": ("Texture",),
    "jaxbundle.planning.stations": (
        "Stations",
        "aerial_block",
        "cloud_of_targets",
        "grid_of_targets",
        "ring_of_stations",
        "stations_looking_at",
    ),
    "jaxbundle.planning.block_network": ("planned_network",),
    "jaxbundle.planning.block_design": (
        "BlockDesign",
        "design_block",
        "relief_displacement",
        "scale",
        "sigma_height",
        "sigma_plan",
    ),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
