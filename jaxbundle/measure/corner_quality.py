"""What is required of a corner, and what is said where it is not met."""

# Corners of a larger σ, pixels, are left out: detection without refinement is as good. On rendered
# photographs σ is 0.005 to 0.03, and up to 0.15 for markers of 30 pixels at 65°: half or double
# change nothing there.
MAX_SIGMA = 0.5
TOO_SMALL = "too small, or too blurred"
NO_EDGE = "no straight edge beside it"
NO_CORNER = "no corner of four squares"
