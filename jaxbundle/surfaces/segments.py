"""Possible positions of a base point in another image: the segment between two ends of its line of
sight (vertical line locus, epipolar segment), curved by distortion or the scanner.

    λ(x) = α·x/(1 + γ·x),    x = (q − q₁)/(q₂ − q₁)

is the length along the segment, determined by three of its points: exact for perspective images.
Otherwise positions are nearly evenly spaced; each is projected individually.

`Windows` describe a window of the base image in the other one, through the local plane: its
axes are e, along the epipolar line in the base, and e⊥; in the other image they are A·e,
along its segment, and A·e⊥.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.surfaces.views import (
    OrientedImage,
    Places,
    Points,
    is_inside,
    line_of_sight,
    steps_on_plane,
)

# Windows of scales that differ by more show different details.
MAX_SCALE = 4.0


@dataclasses.dataclass(frozen=True)
class Windows:
    """Axes of the windows: e [n, 2] in the base, A·e and A·e⊥ [n, 2] in the other image; `A`;
    `usable`: A exists, and both images show the plane at similar scales."""

    axis: Float[np.ndarray, "n 2"]
    other_axis: Float[np.ndarray, "n 2"]
    other_cross_axis: Float[np.ndarray, "n 2"]
    A: Float[np.ndarray, "n 2 2"]
    usable: Bool[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class Segments:
    """Segments [n] in the other image: q at both ends, α and γ of their length, pixels."""

    q: Float[np.ndarray, "n 2"]
    alpha: Float[np.ndarray, " n"]
    gamma: Float[np.ndarray, " n"]

    @property
    def length(self) -> Float[np.ndarray, " n"]:
        """Pixels of the other image; NaN if the line of sight is not visible."""
        return self.alpha / (1 + self.gamma)

    def parameter(self, length: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """q at lengths along the segments."""
        x = length / (self.alpha[:, None] - self.gamma[:, None] * length)
        return self.q[:, :1] + x * (self.q[:, 1:] - self.q[:, :1])

    def length_at(self, q: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Lengths along the segments at q."""
        x = (q - self.q[:, :1]) / (self.q[:, 1:] - self.q[:, :1])
        return self.alpha[:, None] * x / (1 + self.gamma[:, None] * x)


def visible_range(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, "n 2"],
    margin: float = 0.0,
) -> Float[np.ndarray, "n 2"]:
    """The part of a range of q visible in the other image, to about a sixteenth of it; NaN: none.

    The range reaches one sample beyond the visible ones, so that nothing visible is cut off.
    """
    # Sampled, since a curved segment may leave an image and return. A segment that crosses only a
    # corner, between two samples, is lost. Half and double: the same points within 1.
    number = 17
    x = np.linspace(0, 1, number)
    sampled = q[:, :1] + x * (q[:, 1:] - q[:, :1])
    places = other.project(_points(base, uv, sampled))
    in_image = np.asarray(is_inside(other, places, margin)).reshape(-1, number)
    first_visible = np.maximum(np.argmax(in_image, axis=1) - 1, 0)
    last_visible = np.minimum(number - np.argmax(in_image[:, ::-1], axis=1), number - 1)
    rows = np.arange(len(q))
    range_found = np.stack([sampled[rows, first_visible], sampled[rows, last_visible]], axis=1)
    return np.where(np.any(in_image, axis=1)[:, None], range_found, np.nan)


def segments(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, "n 2"],
) -> Segments:
    """The segments of lines of sight between two parameters."""
    # λ(½) and λ(1) determine α and γ
    three = np.stack([q[:, 0], q.mean(1), q[:, 1]], axis=1)
    a, b, c = np.moveaxis(other.project(_points(base, uv, three)).reshape(-1, 3, 2), 1, 0)
    first_half = np.linalg.norm(b - a, axis=1)
    whole_length = first_half + np.linalg.norm(c - b, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        gamma = np.where(
            whole_length > first_half,
            (2 * first_half - whole_length) / (whole_length - first_half),
            0.0,
        )
    return Segments(q, whole_length * (1 + gamma), gamma)


def positions(
    base: OrientedImage,
    other: OrientedImage,
    uv: Float[np.ndarray, "n 2"],
    q: Float[np.ndarray, "n k"],
) -> Float[np.ndarray, "n k 2"]:
    """Positions in the other image of points along lines of sight."""
    return other.project(_points(base, uv, q)).reshape(*q.shape, 2)


def windows(
    base: OrientedImage,
    other: OrientedImage,
    X: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"] | None = None,
) -> Windows:
    """Windows around points X in both images, on planes with these normals; None: planes
    across the mean of both lines of sight."""
    J, K = base.derivative(X), other.derivative(X)
    d, f = line_of_sight(J), line_of_sight(K)
    # J₁ × J₂ has either sign: both in the direction of that of the base
    f = f * np.sign(np.sum(f * d, 1, keepdims=True))
    plane_normal = d + f
    plane_normal = plane_normal / np.linalg.norm(plane_normal, axis=1, keepdims=True)
    if normal is not None:
        # Sine of the smaller angle between the plane and a line of sight: 1 if seen from the front.
        facing = np.minimum(np.abs(np.sum(normal * d, 1)), np.abs(np.sum(normal * f, 1)))
        # A plane seen from nearly its side is stretched without limit. Below a sine of 0.2 (12°)
        # the windows would be five times as long in one direction; a normal of the guide is rarely
        # that steep, and mostly by an error.
        plane_normal = np.where((facing > 0.2)[:, None], normal, plane_normal)
    with np.errstate(invalid="ignore", divide="ignore"):
        A = K @ steps_on_plane(J, plane_normal)
        # The image in the base of the line of sight of the other: its epipolar line.
        e = np.einsum("nij,nj->ni", J, f)
        e = e / np.linalg.norm(e, axis=1, keepdims=True)
        axis_along = np.einsum("nij,nj->ni", A, e)
        beside = np.einsum("nij,nj->ni", A, np.stack([-e[:, 1], e[:, 0]], 1))
        singular = np.linalg.svd(np.nan_to_num(A), compute_uv=False)
        usable = (singular[:, 1] > 1 / MAX_SCALE) & (singular[:, 0] < MAX_SCALE)
    usable &= np.isfinite(e).all(1)
    return Windows(e, axis_along, beside, A, usable)


def _points(base: OrientedImage, uv: Places, q: Float[np.ndarray, "n k"]) -> Points:
    """Points [n·k, 3] of lines of sight at q [n, k]."""
    return base.points(np.repeat(uv, q.shape[1], axis=0), q.ravel())
