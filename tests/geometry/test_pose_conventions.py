"""Poses of computer vision and Bundler: both directions, by what they project, against cv2."""

import cv2
import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxbundle.geometry.pose_conventions import (
    bundler_pose,
    cv_pose,
    exterior_from_bundler,
    exterior_from_cv,
)

RNG = np.random.default_rng(2)
M = Rotation.random(20, random_state=3).as_matrix()
X0 = RNG.normal(size=(20, 3)) * 10
X = RNG.normal(size=3)


def test_there_and_back():
    for there, back in ((cv_pose, exterior_from_cv), (bundler_pose, exterior_from_bundler)):
        R, t = there(M, X0)
        assert_allclose(np.linalg.det(R), 1)
        assert_allclose(back(R, t)[0], M, atol=1e-15)
        assert_allclose(back(R, t)[1], X0, atol=1e-13)
        one = there(M[0], X0[0])
        assert_allclose(one[0], R[0])
        assert_allclose(one[1], t[0])


def test_a_point_has_the_same_image():
    """[r, s, q] of the collinearity equations against cv2.projectPoints and Bundler's −P/P_z."""
    f = 1000.0
    K = np.array([[f, 0, 0], [0, f, 0], [0, 0, 1]])
    for m, x0 in zip(M, X0):
        r, s, q = m @ (X - x0)
        x, y = -f * r / q, -f * s / q
        R, t = cv_pose(m, x0)
        theirs, _ = cv2.projectPoints(X[None], cv2.Rodrigues(R)[0], t, K, None)
        assert_allclose(theirs.ravel(), (x, -y), rtol=1e-9)
        R, t = bundler_pose(m, x0)
        P = R @ X + t
        assert_allclose(-f * P[:2] / P[2], (x, y), rtol=1e-12)
