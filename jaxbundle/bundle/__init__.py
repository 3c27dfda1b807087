"""Bundle adjustment: start values, rounds of the engine, and the `Adjustment`."""
