"""All tests run in float64, which the package itself never switches on."""

from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(scope="session")
def convergent4():
    """The four convergent photographs, all ten parameters free, adjusted once."""
    import jaxbundle

    return jaxbundle.adjust(jaxbundle.read_network(EXAMPLES / "convergent4" / "project.toml"))
