"""Tie points of photographs without targets: features, pairs, matches, tracks, measured places."""
