"""Blurred photographs of little contrast, as of a small object in a room: they overlap."""

from itertools import combinations

import cv2
import numpy as np
import pytest
from rendered_photographs import CAMERA, scene, stations

from jaxbundle.planning.rendering import Sensor, render
from jaxbundle.tiepoints.features import FeatureSettings, find_features
from jaxbundle.tiepoints.matching import FeatureMatchingSettings
from jaxbundle.tiepoints.pairs import CandidateSettings
from jaxbundle.tiepoints.store import Store
from jaxbundle.tiepoints.verification import VerificationSettings, rotation_angle
from jaxbundle.tiepoints.verified_pairs import match, verify


def faint(grey, seed, blur=1.6, contrast=0.2, noise=1.0):
    """A photograph with a fifth of its contrast."""
    grey = cv2.GaussianBlur(grey.astype(float), (0, 0), blur)
    noise = np.random.default_rng(seed).normal(scale=noise, size=grey.shape)
    return np.clip(128 + contrast * (grey - 128) + noise, 0, 255).astype(np.uint8)


@pytest.mark.further
def test_faint_photographs_are_oriented_relatively():
    """25 degrees apart; with features of usual contrast no pair was found."""
    world, views = scene(1), list(zip(*stations(3, 1, 0.9)))
    features = [
        find_features(faint(render(world, CAMERA, *view, Sensor(noise=0, seed=k, fine=2)).grey, k))
        for k, view in enumerate(views)
    ]
    nothing = lambda *_: None
    store = Store(None, FeatureSettings())
    settings = FeatureMatchingSettings(), CandidateSettings()
    found = match(features, list("abc"), "all", None, store, 1, nothing, *settings)
    verified = verify([CAMERA], [0] * 3, features, found, nothing, VerificationSettings())
    pairs = {p.images: p for p in verified}
    assert set(pairs) == set(combinations(range(3), 2))
    for (i, j), pair in pairs.items():
        true = views[j][1] @ views[i][1].T
        assert rotation_angle(pair.M @ true.T) < np.radians(1.0)
