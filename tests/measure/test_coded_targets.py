"""Coded targets, rendered with blur, noise and a tilt."""

import cv2
import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.measure.coded_targets import find_coded_targets
from jaxbundle.measure.ring_targets import (
    RingSettings,
    find_plain_discs,
    find_ring_targets,
    ring_codes,
)

SIDE, FINE = 110, 6


def ring(code, bits, middle, phase, radius=8.0):
    """A ring-coded target of white on black, seen at a tilt."""
    v, u = (np.mgrid[: SIDE * FINE, : SIDE * FINE] + 0.5) / FINE - 0.5
    x, y = 1.25 * (u - middle[0]) + 0.15 * (v - middle[1]), v - middle[1]
    r, t = np.hypot(x, y), (np.arctan2(y, x) - phase) % (2 * np.pi)
    word = np.array([int(c) for c in f"{code:0{bits}b}"])
    lit = word[(t / (2 * np.pi) * bits).astype(int) % bits] == 1
    fine = np.where((r < radius) | (lit & (r > 2 * radius) & (r < 3 * radius)), 210.0, 35.0)
    grey = cv2.resize(fine, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.8)
    noise = 2 * np.random.default_rng(code).normal(size=grey.shape)
    return np.clip(grey + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("bits, code", [(12, 0b000000101101), (12, 0b000001011111), (14, 45)])
def test_ring_codes_do_not_depend_on_how_the_target_is_turned(bits, code):
    for phase in (0.0, 0.4, 2.9):
        middle = np.array([54.3, 55.7]) + phase
        found = find_coded_targets(ring(code, bits, middle, phase), f"ring{bits}:codes")
        assert found.names == (str(code),)
        assert np.linalg.norm(found.xy[0] - middle) < 0.05
        assert np.all(found.sigma < 0.05)


def test_printed_numbers():
    """The numbers printed on targets of a surveyed panel; how many targets makers offer."""
    codes = ring_codes(14)
    for number, code in {2: 135, 22: 215, 37: 291, 62: 437, 74: 489}.items():
        assert codes[number - 1] == code
    assert len(codes) == 516 and len(ring_codes(12)) == 147
    # turned by any number of sectors no two targets are alike
    turns = {(c << k | c >> (14 - k)) & (2**14 - 1) for c in codes for k in range(14)}
    assert len(turns) == sum(14 // (2 if c >> 7 == c & 127 else 1) for c in codes)


def test_a_target_is_named_by_its_number_and_others_are_not_targets():
    number = 22
    code = ring_codes(14)[number - 1]
    middle = np.array([52.0, 50.0])
    assert find_coded_targets(ring(code, 14, middle, 0.3), "ring14").names == ("22",)
    # an odd number of sectors: one was read wrongly
    assert len(find_coded_targets(ring(code ^ 1, 14, middle, 0.3), "ring14")) == 0


def test_the_ground_of_a_target_may_be_cut_by_the_edge_of_the_photograph():
    grey = ring(ring_codes(14)[21], 14, np.array([55.0, 55.0]), 0.3)
    # the ring ends at 24 pixels from the centre; its ground is looked at 27 from it
    assert find_coded_targets(grey[30:], "ring14").names == ("22",)
    assert len(find_coded_targets(grey[40:], "ring14")) == 0


def test_plain_discs():
    """Discs beside a coded target, without the sectors of its ring."""
    grey = ring(ring_codes(14)[73], 14, np.array([40.0, 40.0]), 0.3)
    cv2.circle(grey, (92, 90), 6, 210, -1, cv2.LINE_AA)
    coded = [target for _, target in find_ring_targets(grey, 14, RingSettings())]
    (disc,) = find_plain_discs(grey, coded, RingSettings())
    assert np.linalg.norm(disc.xy - [92, 90]) < 0.1


def test_a_plain_disc_on_a_dark_patch_is_found_once():
    """The light ground about the patch has two outlines with the disc in their middle."""
    grey = np.full((200, 300), 200, np.uint8)
    for column in (80, 210):
        cv2.circle(grey, (column, 100), 24, 40, -1, cv2.LINE_AA)
        cv2.circle(grey, (column, 100), 8, 220, -1, cv2.LINE_AA)
    discs = find_plain_discs(grey, [], RingSettings())
    assert sorted(round(disc.xy[0]) for disc in discs) == [80, 210]


def test_a_disc_without_a_ring_is_no_target():
    grey = np.full((80, 80), 30, np.uint8)
    cv2.circle(grey, (40, 40), 9, 220, -1, cv2.LINE_AA)
    assert len(find_coded_targets(grey, "ring12")) == 0


@pytest.mark.parametrize("kind, dictionary", [
    ("aruco:DICT_5X5_100", "DICT_5X5_100"), ("apriltag", "DICT_APRILTAG_36h11"),
])  # fmt: skip
def test_corners_of_markers(kind, dictionary):
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    marker = cv2.aruco.generateImageMarker(words, 7, 160)
    grey = np.pad(marker, 80, constant_values=255)
    fine = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = find_coded_targets(cv2.GaussianBlur(fine, (0, 0), 0.7), kind)
    assert found.names == ("7-1", "7-2", "7-3", "7-4")
    a, b = 39.5, 119.5
    assert np.allclose(found.xy, [[a, a], [b, a], [b, b], [a, b]], atol=0.15)
    twice = np.hstack([fine, fine])
    assert len(find_coded_targets(twice, kind)) == 0


def test_grey_values_of_other_kinds():
    grey = ring(ring_codes(14)[21], 14, np.array([55.0, 55.0]), 0.3)
    hidden = np.ma.masked_array(grey, np.arange(SIDE)[:, None] < 60 + 0 * grey)
    assert len(find_coded_targets(hidden, "ring14")) == 0
    nothing = np.ma.masked_array(grey, np.zeros(grey.shape, bool))
    assert find_coded_targets(nothing, "ring14").names == ("22",)
    for other in (grey / 255.0, np.stack([grey] * 3, -1)):
        with pytest.raises(InputError, match="expected 8-bit grey values"):
            find_coded_targets(other, "ring14")


def test_unknown_kinds_are_refused():
    grey = np.zeros((50, 50), np.uint8)
    for kind, said in (("ring13", "ring12"), ("aruco:DICT_9", "DICT_9"), ("charuco:8", "8x6")):
        with pytest.raises(InputError, match=said):
            find_coded_targets(grey, kind)
