"""Surfaces from oriented images: matching, clouds with the covariance of every point, DSM."""
