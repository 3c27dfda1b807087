"""Bundle adjustment: a network in, start values, rounds of the engine, an `Adjustment` out."""
