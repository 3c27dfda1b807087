"""The index plan: which observation touches which unknowns, in arrays of round sizes."""
