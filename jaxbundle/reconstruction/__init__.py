"""Reconstruction: from photographs to an adjusted network."""
