"""Against Orekit Rugged (package orekit-jpype): to 1e-6 m, on terrain to 1e-3 m, with refraction to
1e-3 of it: Rugged traces layers of air, which are given the standard atmosphere here in 200 m (its
own layers have the index of their lower borders, which bends 17 % too much).

The Earth is a uniformly turning frame, so that no data files of Orekit are needed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import orekit_jpype
import pytest
from scipy.spatial.transform import Rotation

from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed, geodetic
from jaxbundle.pushbroom import (
    AnglePolynomial,
    Corrections,
    Ground,
    LineTimes,
    Trajectory,
    attitude_table,
    circular_orbit,
    locate_lines,
    make_image,
    make_terrain,
    position_table,
    turn_positions,
    turn_quaternions,
)
from jaxbundle.pushbroom.earth_frames import EARTH_RATE
from jaxbundle.pushbroom.refractivity import refractivity
from jaxbundle.pushbroom.trajectory import orbital_frame

A, F = 6378137.0, 1 / 298.257223563
EARTH = Ellipsoid(A, A, A * (1 - F))
PERIOD, LINES = 0.005, np.array([0.0, 100.0, 517.0, 1000.0])
XI, ETA = np.linspace(-0.02, 0.02, 9), 0.001
POSITIONS, TURNS = np.arange(-10.0, 16.0), np.arange(-2.0, 8.0, 0.1)
NEAR, OBLIQUE = 0.05, 0.87
"""Roll, radians: 3° and 50° off the nadir, where refraction is 60 times as large."""
CASES = [
    (0, 0, 0, NEAR), (1, 0, 0, NEAR), (0, 1, 0, NEAR), (0, 0, 1, NEAR), (1, 1, 1, NEAR),
    (0, 0, 1, OBLIQUE), (1, 1, 1, OBLIQUE),
]  # fmt: skip
locate = jax.jit(locate_lines)


def layers_of_air(step=200.0, top=50e3):
    """Lower borders and mean refractive indices of layers, from the top down to −1 km."""
    borders = np.arange(top, -1000.0 - step / 2, -step)
    above = np.array(jax.vmap(refractivity)(borders)[1])
    means = np.diff(above) / step
    return [(top, 1.0), *zip(borders[1:], 1 + means)]



def spin(t):
    """Earth-fixed to inertial."""
    return Rotation.from_euler("z", (EARTH_RATE * t)[:, None])


def inertial_orbit(t):
    P, V = circular_orbit(t, 505e3, np.radians(97.4), 1.9, 0.1)
    return spin(t).apply(P), spin(t).apply(V + np.cross([0, 0, EARTH_RATE], P))


def inertial_attitude(t, roll):
    wobble = np.stack([1e-4 * np.sin(t), roll + 1e-4 * np.cos(0.7 * t), 0 * t + 0.2], 1)
    frame = np.asarray(jax.vmap(orbital_frame)(*inertial_orbit(t)))
    return Rotation.from_matrix(frame) * Rotation.from_euler("XYZ", wobble)


def our_image(corrections, roll):
    P, _ = turn_positions(spin(POSITIONS).inv().as_matrix(), *inertial_orbit(POSITIONS))
    q = np.roll(inertial_attitude(TURNS, roll).as_quat(), 1, axis=1)
    q = turn_quaternions(spin(TURNS).inv().as_matrix(), q)
    attitude = attitude_table(TURNS, q, method="lagrange", order=5)
    optics = AnglePolynomial(
        jnp.array([0.0, 0.02]), jnp.array([ETA]), jnp.asarray(4.0), jnp.asarray(4.0)
    )
    return make_image(
        Trajectory(position_table(POSITIONS, P), attitude),
        LineTimes(jnp.asarray(0.0), jnp.asarray(PERIOD)), optics, 1001, len(XI),
        corrections=Corrections(*map(bool, corrections)),
    )  # fmt: skip


def ours(corrections, surface, roll=NEAR):
    X = locate(our_image(corrections, roll), surface, LINES, jnp.arange(len(XI)) * 1.0)
    return np.moveaxis(np.asarray(X), 0, -1)


@pytest.fixture(scope="module")
def rugged():
    """A function of (corrections, roll, terrain or None) that gives Rugged's points."""
    orekit_jpype.initVM()
    import jpype
    from java.util import ArrayList
    from org.hipparchus.geometry.euclidean.threed import Rotation as Turn
    from org.hipparchus.geometry.euclidean.threed import RotationConvention, Vector3D
    from org.orekit.bodies import OneAxisEllipsoid
    from org.orekit.frames import Frame, FramesFactory, Transform, TransformProvider
    from org.orekit.rugged.api import AlgorithmId, RuggedBuilder
    from org.orekit.rugged.linesensor import LinearLineDatation, LineSensor
    from org.orekit.rugged.los import LOSBuilder
    from org.orekit.rugged.raster import TileUpdater
    from org.orekit.rugged.refraction import ConstantRefractionLayer, MultiLayerModel
    from org.orekit.rugged.utils import ExtendedEllipsoid
    from org.orekit.time import AbsoluteDate
    from org.orekit.utils import (
        AngularDerivativesFilter,
        CartesianDerivativesFilter,
        TimeStampedAngularCoordinates,
        TimeStampedPVCoordinates,
    )

    epoch = AbsoluteDate.J2000_EPOCH
    inertial = FramesFactory.getGCRF()
    real = jpype.JDouble
    vector = lambda v: Vector3D(*map(float, v))

    def listed(items):
        made = ArrayList()
        for item in items:
            made.add(item)
        return made

    @jpype.JImplements(TransformProvider)
    class Spin:
        @jpype.JOverride
        def getTransform(self, date):
            angle = real(EARTH_RATE * date.durationFrom(epoch))
            turn = Turn(Vector3D.PLUS_K, angle, RotationConvention.FRAME_TRANSFORM)
            return Transform(date, turn, Vector3D(0.0, 0.0, EARTH_RATE))

    body = Frame(inertial, Spin(), "turning Earth", False)
    at = lambda t: epoch.shiftedBy(float(t))
    states = listed(
        TimeStampedPVCoordinates(at(t), vector(p), vector(v))
        for t, p, v in zip(POSITIONS, *inertial_orbit(POSITIONS))
    )

    def located(corrections, roll=NEAR, terrain=None):
        turns = listed(
            TimeStampedAngularCoordinates(
                at(t), Turn(jpype.JArray(real, 2)(m.T.tolist()), 1e-9), Vector3D.ZERO, Vector3D.ZERO
            )
            for t, m in zip(TURNS, inertial_attitude(TURNS, roll).as_matrix())
        )
        light, aberration, refraction = map(bool, corrections)
        builder = RuggedBuilder()
        if terrain is None:
            builder.setAlgorithm(AlgorithmId.IGNORE_DEM_USE_ELLIPSOID)
        else:
            (x0, y0), (dx, dy), z = terrain

            @jpype.JImplements(TileUpdater)
            class Tiles:
                @jpype.JOverride
                def updateTile(self, latitude, longitude, tile):
                    tile.setGeometry(y0, x0, dy, dx, *z.shape)
                    for i, j in np.ndindex(z.shape):
                        tile.setElevation(i, j, float(z[i, j]))

            builder.setAlgorithm(AlgorithmId.DUVENHAGE)
            builder.setDigitalElevationModel(Tiles(), 2, True)
        builder.setEllipsoid(OneAxisEllipsoid(A, F, body))
        builder.setTimeSpan(at(-1.5), at(6.0), 0.001, 5.0)
        builder.setTrajectory(
            inertial, states, 8, CartesianDerivativesFilter.USE_P, turns, 6,
            AngularDerivativesFilter.USE_R,
        )  # fmt: skip
        builder.setLightTimeCorrection(light)
        builder.setAberrationOfLightCorrection(aberration)
        if refraction:
            layers = listed(ConstantRefractionLayer(float(h), float(n)) for h, n in layers_of_air())
            ellipsoid = ExtendedEllipsoid(A, F, body)
            builder.setRefractionCorrection(MultiLayerModel(ellipsoid, layers))
        looks = LOSBuilder(listed(Vector3D(float(x), ETA, -1.0) for x in XI)).build()
        times = LinearLineDatation(epoch, 0.0, 1 / PERIOD)
        builder.addLineSensor(LineSensor("line", times, Vector3D.ZERO, looks))
        points = [builder.build().directLocation("line", float(l)) for l in LINES]
        return np.array([[earth_fixed(EARTH, (
            float(g.getLongitude()), float(g.getLatitude()), float(g.getAltitude())
        )) for g in row] for row in points])  # fmt: skip

    return located


@pytest.mark.further
@pytest.mark.parametrize("case", CASES)
def test_on_the_ellipsoid(rugged, case):
    *corrections, roll = case
    found, expected = ours(corrections, Ground(EARTH), roll), rugged(corrections, roll)
    bent = {NEAR: 0.2, OBLIQUE: 11.0}[roll] if corrections[2] else 0.0
    np.testing.assert_allclose(found, expected, atol=1e-6 + 1e-3 * bent)


@pytest.mark.further
def test_on_rough_terrain(rugged):
    """σ 200 m over cells of 200 m, seen at 3° to 5° from the vertical."""
    level = ours((0, 0, 0), Ground(EARTH))
    level = tuple(np.moveaxis(level, -1, 0))
    longitude, latitude, _ = (np.asarray(v) for v in geodetic(EARTH, level))
    step = 200 / 6.37e6
    x0, y0 = longitude.min() - 20 * step, latitude.min() - 20 * step
    shape = (int((np.ptp(latitude)) / step) + 40, int(np.ptp(longitude) / step) + 40)
    z = 500 + 200 * np.random.default_rng(4).normal(size=shape)
    terrain = make_terrain(z, (x0, y0), (step, step), EARTH)
    expected = rugged((0, 0, 0), NEAR, ((x0, y0), (step, step), z))
    np.testing.assert_allclose(ours((0, 0, 0), terrain), expected, atol=1e-3)
