"""The correction of matches for curved surfaces, and their σ where there is none."""

from types import SimpleNamespace

import numpy as np
from scipy import ndimage

from jaxbundle.measure.least_squares_matching import MatchingStatus
from jaxbundle.surfaces import bending
from jaxbundle.surfaces.bending import BendingSettings, GuideNodes, correct_bending
from jaxbundle.surfaces.guide import Guide
from jaxbundle.surfaces.subpixel_matching import SubpixelMatches, WindowSettings

# Two parabolas along u, around 30 and 90: of the second derivatives, the second shifts a window by
# more than half a pixel. Around 150 there are no nodes.
PLACES = np.array([[30.0, 50.0], [90.0, 50.0], [150.0, 50.0]])
SECOND = np.array([0.02, 0.15, 0.02])


def curved():
    """A pair of which q is the parallax itself, its guide, and exact matches."""
    texture = np.random.default_rng(0).standard_normal((100, 180))
    base = SimpleNamespace(
        grey=128 + 100 * ndimage.gaussian_filter(texture, 1.5),
        points=lambda uv, q: np.column_stack([uv, q]),
    )
    other = SimpleNamespace(project=lambda X: X[:, :2] + X[:, 2:] * [1.0, 0.0])
    step, shape = 4.0, (25, 45)
    u = np.broadcast_to(step * np.arange(shape[1]), shape)
    part = np.minimum(u // 60, 2).astype(int)
    q = SECOND[part] * (u - PLACES[part, 0]) ** 2 / 2
    one = np.ones(shape)
    guide = Guide(step, 0.0, q, one, one, np.zeros((*shape, 3)), part < 2)
    n = len(PLACES)
    match = SubpixelMatches(
        PLACES, np.tile(np.eye(2), (n, 1, 1)), np.tile(1e-4 * np.eye(2), (n, 1, 1)),
        np.ones(n), np.ones(n), np.zeros(n, int),
    )  # fmt: skip
    return (base, other), GuideNodes(guide, 0.01 * one), match


def test_a_refused_correction_leaves_the_sigma_of_an_unknown_one():
    """It is larger than that of any correction that was made, not smaller."""
    pair, nodes, match = curved()
    place, covariance = correct_bending(
        pair, nodes, PLACES, np.zeros(3), match, 6, BendingSettings()
    )
    shift = np.linalg.norm(place - PLACES, axis=1)
    assert 0.05 < shift[0] < 0.5
    np.testing.assert_array_equal(shift[1:], 0.0)
    added = np.trace(covariance - match.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(added[0], (0.3 * shift[0]) ** 2)
    assert added[2] > added[0]
    np.testing.assert_allclose(added[1], added[2])


def test_good_nodes_are_refined_where_they_match(monkeypatch):
    """By what matching moves them along their lines of sight; the others stay as they were, with
    the σ of correlation."""
    pair, nodes, _ = curved()
    rough = nodes.guide
    matched = lambda uv: uv[:, 0] < 60

    def refine(base, other, uv, start, *_):
        n, uv_in = len(uv), start + [0.25, 0.1]
        status = np.where(matched(uv), int(MatchingStatus.CONVERGED), int(MatchingStatus.OUTSIDE))
        C = np.tile([[4e-4, 0.0], [0.0, 9e-4]], (n, 1, 1))
        return SubpixelMatches(uv_in, None, C, np.ones(n), np.ones(n), status)

    shape = lambda base, other, X, normal: SimpleNamespace(usable=np.ones(len(X), bool), A=None)
    monkeypatch.setattr(bending, "refine", refine)
    monkeypatch.setattr(bending, "windows", shape)
    settings = BendingSettings()
    found = bending.sharpen(pair[0], [pair[1]], rough, 6, settings, WindowSettings())
    u = rough.step * np.arange(rough.q.shape[1]) * np.ones(rough.q.shape)
    moved = rough.good & (u < 60)
    np.testing.assert_allclose(found.guide.q - rough.q, np.where(moved, 0.25, 0.0), atol=1e-9)
    expected = np.where(moved, 0.02, settings.unmatched_sigma)
    np.testing.assert_allclose(found.sigma, expected, rtol=1e-6)
