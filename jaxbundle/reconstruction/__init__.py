"""Photographs to an adjusted network."""
