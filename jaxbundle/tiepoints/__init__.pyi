# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.tiepoints.features import Features as Features
from jaxbundle.tiepoints.features import find_features as find_features
from jaxbundle.tiepoints.matching import FeatureMatches as FeatureMatches
from jaxbundle.tiepoints.matching import FeatureMatchingSettings as FeatureMatchingSettings
from jaxbundle.tiepoints.matching import match_features as match_features
from jaxbundle.tiepoints.tracks import TrackSettings as TrackSettings
from jaxbundle.tiepoints.tracks import make_tracks as make_tracks

__all__ = [
    "FeatureMatches",
    "FeatureMatchingSettings",
    "Features",
    "TrackSettings",
    "find_features",
    "make_tracks",
    "match_features",
]
