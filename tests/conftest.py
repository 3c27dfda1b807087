"""All tests run in float64, which the package itself never switches on."""

import jax

jax.config.update("jax_enable_x64", True)
