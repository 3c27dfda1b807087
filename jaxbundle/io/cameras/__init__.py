"""Cameras by themselves."""
