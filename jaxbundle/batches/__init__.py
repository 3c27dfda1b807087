"""Many cameras of one model, calibrated in one program; many networks in one run."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.batches.population": (
        "Population",
        "PopulationSettings",
    ),
    "jaxbundle.batches.run_on_files": ("result_rows",),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
