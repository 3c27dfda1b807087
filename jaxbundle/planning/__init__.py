"""Planned networks: stations, targets, simulated and rendered measurements."""
