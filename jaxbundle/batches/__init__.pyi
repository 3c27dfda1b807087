# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.batches.population import Population as Population
from jaxbundle.batches.population import PopulationSettings as PopulationSettings
from jaxbundle.batches.run_on_files import result_rows as result_rows

__all__ = [
    "Population",
    "PopulationSettings",
    "result_rows",
]
