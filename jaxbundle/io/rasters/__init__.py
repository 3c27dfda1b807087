"""Rasters: terrain models, scenes, maps, corrected images."""
