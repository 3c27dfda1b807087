"""What is required of a corner, and what is said where it is not met."""

MAX_SIGMA = 0.5
"""Corners of a larger σ, pixels, are left out: detection without refinement is as good. Fits of
edges and of saddles of a usable photograph have 0.01 to 0.1, so that half or double change nothing
there."""
TOO_SMALL = "too small, or too blurred"
NO_EDGE = "no straight edge beside it"
NO_CORNER = "no corner of four squares"
