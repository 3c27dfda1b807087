"""Tie points of photographs without targets: features, pairs, matches, tracks, measured places."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.tiepoints.features": (
        "Features",
        "find_features",
    ),
    "jaxbundle.tiepoints.matching": (
        "FeatureMatches",
        "FeatureMatchingSettings",
        "match_features",
    ),
    "jaxbundle.tiepoints.tracks": (
        "TrackSettings",
        "make_tracks",
    ),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
