"""A block of RPC images and rigorous scanner images that see the same ground, by simulation.

Twelve images by polynomials, 3 m a pixel, look at it from three directions along and across the
track; six line scanners, 20 m a pixel, along theirs. Every point is in some images of each. Where
asked for, photographs from an aircraft see it too, with free orientations and an uncertain
principal distance.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from refinement_scenes import ARCSEC, LINES, PERIOD, PIXELS

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    omega_phi_kappa_from_matrix,
    quaternion_from_matrix,
)
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed, geodetic
from jaxbundle.geometry.quaternions import quaternion_difference
from jaxbundle.network.tables import Camera, Distances, Images, Network, Observations, Points
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.earth_frames import circular_orbit
from jaxbundle.pushbroom.ground_to_image import make_search, project_points
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.rpc.bias import bias_terms
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.pushbroom.rpc.polynomials import project_points as project_rpc
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.trajectory import Trajectory
from jaxbundle.refinement import Freedom, RpcScannerImage, ScannerImage, local_points
from jaxbundle.refinement.refining import east_north_up
from jaxbundle.refinement.rpc_points import prior_of_bias

RPC_SIZE = 4000
SHIFT, VARIATION = 6.0, 0.8
"""σ of the terms of a bias, pixels."""
SIGMA_RPC, SIGMA_SCANNER, SIGMA_CONTROL = 0.4, 0.3, 0.5
"""Of measurements, pixels, and of control coordinates, metres."""
FREE = Freedom(attitude=3 * (np.inf,))
SIGMA_PHOTOGRAPH, PRINCIPAL_DISTANCE, SIGMA_DISTANCE, FLYING_HEIGHT = 0.006, 100.0, 0.02, 8000.0
"""Of photographs: image coordinates, principal distance and its σ in mm, height above ground in m:
0.5 m on the ground."""


def scanner_image(pitch, argument, node=1.9):
    """The image of a level satellite that looks ahead by a pitch, radians."""
    t = np.arange(-4.0, 8.0)
    P, V = circular_orbit(t, 505e3, np.radians(97.4), node, argument)
    rows = np.tile([pitch, 0.0, 0.0], (4, 1)) + np.outer(np.arange(4), [0.0, 1e-4, 0.0])
    attitude = attitude_table(
        np.array([-1.0, 1.0, 3.0, 5.0]), rows, method="linear", gap=9.0, reference="orbit"
    )
    return make_image(
        Trajectory(position_table(t, P, V, method="hermite"), attitude),
        LineTimes(jnp.float64(0.0), jnp.float64(PERIOD)),
        FocalLine(jnp.array([700.0] + 10 * [0.0]), jnp.float64(0.028),
                  jnp.float64((PIXELS - 1) / 2), jnp.float64(0.0)),
        LINES, PIXELS,
    )  # fmt: skip


def middle_of(image):
    """Longitude, latitude of the middle of a scanner image, radians."""
    X = locate_point(image, Height(400.0, WGS84), (LINES - 1) / 2, (PIXELS - 1) / 2)
    return np.array([float(v) for v in geodetic(WGS84, tuple(X))[:2]])


def scanners(number):
    """Images from along the track whose middles are at the same place, and that place."""
    place = middle_of(scanner_image(0.0, 0.1))
    images = []
    for pitch in np.linspace(-0.35, 0.35, number):
        argument = 0.1
        for _ in range(4):  # Newton's method by differences: the middle at the latitude of `place`
            here = middle_of(scanner_image(pitch, argument))[1]
            slope = (middle_of(scanner_image(pitch, argument + 1e-3))[1] - here) / 1e-3
            argument += (place[1] - here) / slope
        # the node turns longitudes alone
        node = 1.9 + place[0] - middle_of(scanner_image(pitch, argument))[0]
        images.append(scanner_image(pitch, argument, node))
    return images, place


def rpc_image(place, k, rng):
    """Polynomials of a view of the kth direction, all of their terms in use."""
    size = np.r_[1e-3, np.full(3, 1e-3), np.full(6, 1e-4), np.full(10, 1e-5)]
    a, b, c, d = rng.normal(size=(4, 20)) * size
    # 400 m of half the heights, 3 m a pixel, 2000 pixels: tan 25° is 0.031
    a[2], a[3] = a[2] - 1.0, a[3] + 0.031 * (k % 3 - 1)
    c[1], c[3] = c[1] + 1.0, c[3] + 0.02 * (k // 3 % 3 - 1)
    b[0] = d[0] = 1.0
    half = RPC_SIZE / 2
    degrees = np.degrees(place)
    scale = np.degrees(3.0 * half / 6.37e6)
    given = {
        "line_numerator": a, "line_denominator": b, "sample_numerator": c, "sample_denominator": d,
        "line_offset": half, "line_scale": half, "sample_offset": half, "sample_scale": half,
        "longitude_offset": degrees[0], "longitude_scale": scale / np.cos(place[1]),
        "latitude_offset": degrees[1], "latitude_scale": scale,
        "height_offset": 400.0, "height_scale": 400.0,
    }  # fmt: skip
    rpc = Rpc(**{name: jnp.asarray(value, float) for name, value in given.items()})
    return RpcImage(rpc, RPC_SIZE, RPC_SIZE)


@dataclasses.dataclass
class Block:
    """A block and its truth: images, ground points [n, 3], and by image the places without bias of
    all points and the terms of these; attitudes of the line scanners [images, 3]."""

    images: list
    X: np.ndarray
    roles: tuple
    places: np.ndarray
    seen: np.ndarray
    terms: np.ndarray
    attitudes: np.ndarray
    stations: tuple | None = None

    def draw(self, rng, noise=1.0):
        """Arguments of `refine` but those of photographs, and the bias of every RPC image
        [images, 2, terms]."""
        rpc = [one for one in self.images if isinstance(one, RpcScannerImage)]
        places, sigma = self.places.copy(), np.full(self.places.shape, SIGMA_SCANNER)
        sigma[: len(rpc)] = SIGMA_RPC
        bias = np.stack([one.bias_sigma for one in rpc])
        bias = np.where(np.isfinite(bias), bias, SHIFT) * rng.normal(size=bias.shape)
        places[: len(rpc)] += np.einsum("iak,ikp->ipa", bias, self.terms[:, : bias.shape[2]])
        places += noise * sigma * rng.normal(size=places.shape)
        image, point = np.nonzero(self.seen)
        observations = Observations(image, point, places[image, point], sigma[image, point])
        axes = east_north_up(WGS84, self.X)
        known = np.array(self.roles) != "tie"
        off = noise * SIGMA_CONTROL * rng.normal(size=self.X.shape)
        off[np.array(self.roles) == "check"] = 0.0
        given = np.where(known[:, None], self.X + np.einsum("pi,pij->pj", off, axes), np.nan)
        ids = [f"P{k}" for k in range(len(self.X))]
        points = dataclasses.replace(
            local_points(ids, self.roles, given, SIGMA_CONTROL),
            axes=axes, axis_names=("east", "north", "up"),
        )  # fmt: skip
        return (self.images, points, observations), bias

    def draw_photographs(self, rng, noise=1.0):
        """The network of the photographs; the changes from its start values to the truth: of every
        orientation [photographs, 6], and of the principal distance."""
        position, M = self.stations
        n, off = len(position), SIGMA_DISTANCE * rng.normal()
        image, point, xy = [], [], []
        for k in range(n):
            r, s, q = M[k] @ (self.X - position[k]).T
            places = -(PRINCIPAL_DISTANCE + off) * np.stack([r, s], 1) / q[:, None]
            seen = np.flatnonzero((np.abs(places) < 115.0).all(1))  # a frame of 23 cm
            image.append(np.full(len(seen), k))
            point.append(seen)
            xy.append(places[seen] + noise * SIGMA_PHOTOGRAPH * rng.normal(size=(len(seen), 2)))
        xy = np.concatenate(xy)
        moved, turned = 5.0 * rng.normal(size=(n, 3)), 1e-4 * rng.normal(size=(n, 3))
        angles = np.asarray(_angles(jnp.asarray(M))) + turned
        to_truth = np.asarray(_turns(jnp.asarray(M), jnp.asarray(angles)))
        nothing = np.full(self.X.shape, np.nan)
        camera = Camera("frame", "brown", {"c": PRINCIPAL_DISTANCE}, ("c",), {"c": SIGMA_DISTANCE})
        network = Network(
            (camera,),
            Images(tuple(f"F{k}" for k in range(n)), np.zeros(n, int), position + moved, angles,
                   np.full((n, 6), np.nan)),
            Points(tuple(f"P{k}" for k in range(len(self.X))), ("tie",) * len(self.X), nothing,
                   nothing),
            Observations(np.concatenate(image), np.concatenate(point), xy,
                         np.full(xy.shape, SIGMA_PHOTOGRAPH)),
            Distances.none(),
        )  # fmt: skip
        return network, np.concatenate([-moved, to_truth], 1), off


_angles = jax.jit(jax.vmap(omega_phi_kappa_from_matrix))


@jax.jit
@jax.vmap
def _turns(M, angles):
    """The rotation in the camera frame from the one of angles to M."""
    start = quaternion_from_matrix(matrix_from_omega_phi_kappa(angles))
    return quaternion_difference(quaternion_from_matrix(M), start)


def stations_above(place, half, number, rng):
    """Positions [n, 3] and matrices [n, 3, 3] of nearly vertical photographs in rows above a
    rectangle, longitude and latitude ± half."""
    columns = int(np.ceil(np.sqrt(number)))
    k = np.arange(number)
    rows = -(-number // columns)
    u = (k % columns) / max(columns - 1, 1) * 2 - 1
    v = (k // columns) / max(rows - 1, 1) * 2 - 1
    longitude, latitude = place[0] + 0.7 * half[0] * u, place[1] + 0.7 * half[1] * v
    ground = longitude, latitude, np.full(number, 400.0 + FLYING_HEIGHT)
    X = np.stack([np.asarray(a) for a in earth_fixed(WGS84, ground)], 1)
    axes = np.asarray(east_north_up(WGS84, X))
    turn = rng.normal(size=(number, 3)) * [0.03, 0.03, 0.05]
    turn[:, 2] += np.pi / 2 * (k % 2)  # crossed: κ and the principal distance are determined
    return X, np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(turn))) @ axes


def block(
    rpc=12, scanner=6, points=60, control=8, checks=4, degree=1, rays=4, seed=1, photographs=0
):
    """A block of so many images and points, each point in about `rays` images of each type, and in
    the photographs that see it."""
    rng = np.random.default_rng(seed)
    rigorous, place = scanners(scanner) if scanner else ([], np.array([0.4, 0.7]))
    polynomials = [rpc_image(place, k, rng) for k in range(rpc)]
    half = 0.85 * np.radians(
        [float(getattr(polynomials[0].rpc, f"{axis}_scale")) for axis in ("longitude", "latitude")]
    )
    plane = place + half * rng.uniform(-1, 1, (points, 2))
    ground = (*plane.T, rng.uniform(0.0, 800.0, points))
    X = np.stack([np.asarray(v) for v in earth_fixed(WGS84, ground)], 1)
    places, terms = [], []
    for image in polynomials:
        line, sample, _ = (np.asarray(v) for v in project_rpc(image.rpc, *ground))
        places.append(np.stack([line, sample], 1))
        terms.append(np.stack(bias_terms(image.rpc, line, sample)))
    attitudes = 30 * ARCSEC * rng.normal(size=(scanner, 3))
    for image, attitude in zip(rigorous, attitudes):
        offsets = dataclasses.replace(image.offsets, attitude=jnp.asarray(attitude))
        image = dataclasses.replace(image, offsets=offsets)
        found = project_points(image, make_search(image), X.T, most=1)
        assert (np.asarray(found.count) == 1).all()
        places.append(np.stack([np.ravel(found.line), np.ravel(found.pixel)], 1))
    images = [
        RpcScannerImage(f"R{k}", image, prior_of_bias(degree, SHIFT, VARIATION))
        for k, image in enumerate(polynomials)
    ]
    images += [ScannerImage(f"S{k}", image, WGS84, FREE) for k, image in enumerate(rigorous)]
    places = np.array(places)
    size = [(one.image.lines, one.image.pixels) for one in images]
    margin = 40
    on = ((places > margin) & (places < np.array(size)[:, None] - margin)).all(2)
    share = np.repeat([rays / max(rpc, 1), rays / max(scanner, 1)], [rpc, scanner])
    seen = on & (rng.uniform(size=on.shape) < share[:, None])
    # at least three rays: every point has a redundancy that finds a blunder
    for p in np.flatnonzero(seen.sum(0) < 3):
        seen[np.flatnonzero(on[:, p])[:3], p] = True
    roles = ("control",) * control + ("check",) * checks + ("tie",) * (points - control - checks)
    stations = stations_above(place, half, photographs, rng) if photographs else None
    return Block(images, X, roles, places, seen, np.array(terms), attitudes, stations)


def moved(observations, row, by):
    """The measurements with a blunder in one."""
    xy = observations.xy.copy()
    xy[row] += by
    return dataclasses.replace(observations, xy=xy)


