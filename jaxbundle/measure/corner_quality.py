"""What is required of a corner, and what is said where it is not met."""

LARGEST_SIGMA = 0.5
"""Corners of a larger σ, pixels, are left out: they say less than detection without refinement."""
TOO_SMALL = "too small, or too blurred"
NO_EDGE = "no straight edge beside it"
NO_CORNER = "no corner of four squares"
