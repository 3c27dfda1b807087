"""Cameras mounted rigidly to each other: declared on the engine, calibrated, and the result."""
