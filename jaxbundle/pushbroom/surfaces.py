"""Surfaces for intersection: a plane, an ellipsoid (or sphere), a constant height above it.

A terrain model is a surface too (`terrain`). A surface gives the distance s, in lengths of d, of
the first point o + s·d in front, NaN if there is none, and the height of a point near it.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxbundle.geometry.ellipsoid import (
    WGS84,
    Ellipsoid,
    at_height,
    geodetic,
    ray_to_ellipsoid,
    ray_to_height,
    residual,
)
from jaxbundle.geometry.vectors import Scalar, Vector


class GroundSurface(eqx.Module):
    """A surface."""

    earth: eqx.AbstractVar[Ellipsoid | None]
    """The ellipsoid that heights refer to; None in a local frame, Z up."""
    iterative: ClassVar[bool] = False
    """Whether the distance is found iteratively, with a varying number of steps."""

    @abc.abstractmethod
    def distance(self, o: Vector, d: Vector) -> Scalar:
        """s of the first point of the ray o + s·d on the surface; NaN for none."""

    def height(self, X: Vector) -> Scalar:
        """The height of a point, metres."""
        return X[2] if self.earth is None else geodetic(self.earth, X)[2]


class Plane(GroundSurface):
    """Z = height, in a local frame with Z up."""

    level: Scalar = 0.0
    earth: Ellipsoid | None = None

    def distance(self, o: Vector, d: Vector) -> Scalar:
        s = (self.level - o[2]) / jnp.where(d[2] == 0, jnp.nan, d[2])
        return jnp.where(s > 0, s, jnp.nan)


class Ground(GroundSurface):
    """The ellipsoid itself; three semi-axes may differ."""

    earth: Ellipsoid = WGS84

    def distance(self, o: Vector, d: Vector) -> Scalar:
        return _from_outside(self.earth, o, ray_to_ellipsoid(self.earth, o, d))


class Height(GroundSurface):
    """All points of one geodetic height above an ellipsoid of revolution."""

    level: Scalar
    earth: Ellipsoid = WGS84

    def distance(self, o: Vector, d: Vector) -> Scalar:
        s = ray_to_height(self.earth, self.level, o, d)
        return _from_outside(at_height(self.earth, self.level), o, s)


def _from_outside(ellipsoid: Ellipsoid, o: Vector, s: Scalar) -> Scalar:
    """A ray from below the surface would end on the other side of the Earth."""
    return jnp.where(residual(ellipsoid, o) > 0, s, jnp.nan)
