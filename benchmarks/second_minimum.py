"""Second minima found, missed and invented, in random images of planar and nearly planar objects.

    python benchmarks/second_minimum.py [--cases 1000] [--seed 0] [--networks 200]

Every case is one image of 4 to 25 known points of a plane, or up to a twentieth of their extent off
it, with random tilt, distance, and σ, from where the second solution cannot be told from the first
to where perspective decides at once. Half of the adjustments start from the true pose, half from
the second one. The truth about each case is found without the package: all minima that a dense
Levenberg-Marquardt with derivatives by differences reaches from 51 poses. Networks of 2 to 5 images
with unknown points (a free network) follow; their truth is the reversed network, adjusted densely.

Ambiguous: two minima whose poses differ beyond the ellipsoid of their covariance (99.9 %), with
E below 13.8 (`adjustment/second_minima/evidence.py`). A false alarm is a report where there is no
such minimum, in parts of the cases without.
"""

import argparse
import time
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxbundle
from jaxbundle.geometry import omega_phi_kappa_from_matrix
from jaxbundle.network import Camera, Images, Network, Observations, Points

THRESHOLD = 2 * np.log(999)
C = 50.0


class Case(NamedTuple):
    """Points, projection centres and rotations, measured image coordinates of every image, σ."""

    X: np.ndarray
    X0: np.ndarray
    M: np.ndarray
    xy: np.ndarray
    sigma: float


def residuals(X0, M, X, xy, sigma):
    """Of poses [..., 3], [..., 3, 3] and points [..., n, 3], divided by σ."""
    d = np.einsum("...ij,...nj->...ni", M, X - X0[..., None, :])
    return ((-C * d[..., :2] / d[..., 2:] - xy) / sigma).reshape(*d.shape[:-2], -1)


def looking_at(view, distance, roll):
    """The pose of a camera at a distance in the direction `view` of the origin."""
    z = view / np.linalg.norm(view)
    x = np.cross([0.3, 1.0, 0.1], z)
    x /= np.linalg.norm(x)
    M = np.stack([x, np.cross(z, x), z])
    return distance * z, Rotation.from_euler("z", roll).as_matrix() @ M


def views(rng, number, smallest=0.0, largest=75.0):
    """Random directions to a camera above the plane, of tilts in degrees."""
    tilt = np.deg2rad(rng.uniform(smallest, largest, number))
    azimuth = rng.uniform(0, 2 * np.pi, number)
    return np.stack(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)], 1
    )


def draw_image(rng):
    """One image of known points; the effect of perspective is drawn, the distance follows."""
    n = int(rng.integers(4, 26))
    X = np.concatenate([rng.uniform(-1, 1, (n, 2)), np.zeros((n, 1))], 1)
    if rng.random() < 0.5:
        X[:, 2] += 0.05 * rng.random() * rng.uniform(-1, 1, n)
    distance = np.exp(rng.uniform(np.log(2.5), np.log(200.0)))
    # σ from 1/20 000 to 1/100 of the size of the object in the image.
    sigma = C / distance * np.exp(rng.uniform(np.log(1e-4), np.log(0.02)))
    X0, M = looking_at(views(rng, 1)[0], distance, rng.uniform(0, 2 * np.pi))
    xy = C * np.zeros((n, 2))
    xy = sigma * (residuals(X0, M, X, xy, sigma).reshape(n, 2) + rng.normal(size=(n, 2)))
    return Case(X, X0[None], M[None], xy[None], sigma)


def minima_of_image(case, rng):
    """All minima with the points in front, best first: vᵀPv, X0, M, Jacobian by (X0, δθ)."""
    X, xy, sigma = case.X, case.xy[0], case.sigma
    distance = np.linalg.norm(case.X0[0])
    starts = [(case.X0[0], case.M[0])]
    d = (X.mean(0) - case.X0[0]) @ case.M[0].T
    for view in views(rng, 49, 0, 85):
        # Turned about the object so that its centre and roll in the image stay about the same.
        X0, M = looking_at(view, distance, 0.0)
        A, B = (P[:, :2] @ X[:, :2].T for P in (M[:2], case.M[0][:2]))
        U, _, V = np.linalg.svd(B @ A.T)
        roll = U @ np.diag([1, np.sign(np.linalg.det(U @ V))]) @ V
        M = np.block([[roll, np.zeros((2, 1))], [np.zeros((1, 2)), np.eye(1)]]) @ M
        starts.append((X.mean(0) - M.T @ d, M))
    # And from the first solution with the tilt reflected about the line of sight.
    sight = case.X0[0] / distance
    half_turn = lambda a: 2 * np.outer(a, a) - np.eye(3)
    M = half_turn(case.M[0] @ sight) @ case.M[0] @ half_turn(np.array([0.0, 0.0, 1.0]))
    starts.append((M.T @ case.M[0] @ case.X0[0], M))
    X0, M = (np.stack(part) for part in zip(*starts))
    X0, M, cost, J = levenberg_marquardt(X0, M, X, xy, sigma)
    front = (np.einsum("kj,knj->kn", M[:, 2], X - X0[:, None]) < 0).all(1)
    good = np.flatnonzero(front & np.isfinite(cost))
    found = []
    for k in good[np.argsort(cost[good])]:
        if all(apart(one, (cost[k], X0[k], M[k]), 0.1) for one in found):
            found.append((cost[k], X0[k], M[k], J[k]))
    return found


def apart(one, other, quantile):
    """Whether another pose is outside of the ellipsoid of the first one."""
    turn = Rotation.from_matrix(other[2] @ one[2].T).as_rotvec()
    # The inverse covariance is JᵀJ.
    return ((one[3] @ np.concatenate([other[1] - one[1], turn])) ** 2).sum() > quantile


def levenberg_marquardt(X0, M, X, xy, sigma, steps=150):
    """Many poses at once: (X0, M, vᵀPv, Jacobian); NaN where it did not settle."""
    starts, h = len(X0), 1e-6
    scale = np.linalg.norm(X0[0])
    value = lambda X0, M: residuals(X0, M, X, xy, sigma)
    change = lambda X0, M, d: (
        X0 + scale * d[..., :3], Rotation.from_rotvec(d[..., 3:]).as_matrix() @ M
    )  # fmt: skip
    r, damping = value(X0, M), np.full(starts, 1e-3)
    cost, last = (r**2).sum(1), np.full(starts, np.inf)
    for _ in range(steps):
        J = np.zeros((*r.shape, 6))
        for j in range(6):
            d = np.zeros((starts, 6))
            d[:, j] = h
            J[..., j] = (value(*change(X0, M, d)) - value(*change(X0, M, -d))) / (2 * h)
        N, g = np.einsum("kni,knj->kij", J, J), np.einsum("kni,kn->ki", J, r)
        D = np.einsum("kii->ki", N)
        lifted = N + damping[:, None, None] * D[:, None, :] * np.eye(6) + 1e-300 * np.eye(6)
        step = -np.einsum("kij,kj->ki", np.linalg.pinv(lifted), g)
        there = change(X0, M, step)
        trial = value(*there)
        square = np.nan_to_num((trial**2).sum(1), nan=np.inf)
        better = square <= cost
        X0 = np.where(better[:, None], there[0], X0)
        M = np.where(better[:, None, None], there[1], M)
        r = np.where(better[:, None], trial, r)
        last = np.where(better, cost - square, last)
        cost = np.where(better, square, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 4), 1e-12, 1e12)
        if (last < 1e-9 * (1 + cost)).all():
            break
    J[..., :3] /= scale
    return X0, M, np.where(last < 1e-6 * (1 + cost), cost, np.nan), J


def as_network(case, X0, M, known=True):
    """The case as a network that starts from these poses."""
    n, images = len(case.X), len(X0)
    angles = np.stack([np.asarray(omega_phi_kappa_from_matrix(m)) for m in M])
    role = ("fixed" if known else "tie",) * n
    return Network(
        name="case",
        cameras=(Camera("cam", "brown", {"c": C}, ()),),
        images=Images(
            tuple(f"i{k}" for k in range(images)), np.zeros(images, int), X0, angles,
            np.full((images, 6), np.nan),
        ),
        points=Points(tuple(f"p{k}" for k in range(n)), role, case.X, np.full((n, 3), np.nan)),
        observations=Observations(
            np.repeat(np.arange(images), n), np.tile(np.arange(n), images),
            case.xy.reshape(-1, 2), np.full((images * n, 2), case.sigma),
        ),
        datum="control" if known else "inner",
    )  # fmt: skip


def compare(found, result, redundancy):
    """What became of a case whose minima are known: a word, and E of the second one."""
    best = found[0]
    s2 = max(1.0, best[0] / max(redundancy, 1))
    limit = chi2.ppf(0.999, 6) * s2
    others = [one for one in found[1:] if apart(best, one, limit)]
    E = (others[0][0] - best[0]) / s2 if others else np.inf
    told = [one for one in result.second_minima if one.ambiguous]
    if abs(result.vtpv - best[0]) > 1e-4 * (1 + best[0]):
        return "worse minimum", E, None
    if E >= THRESHOLD:
        return ("false alarm" if told else "none"), E, None
    if not told:
        return "missed", E, None
    return "found", E, min(abs(one.difference - (others[0][0] - best[0])) for one in told)


def run_images(cases, seed):
    """Counts of what became of the cases, the largest error of a difference of vᵀPv, and times."""
    rng = np.random.default_rng(seed)
    counts, error, taken, spent = {}, 0.0, 0, []
    for k in range(cases):
        case = draw_image(rng)
        found = minima_of_image(case, np.random.default_rng(k))
        if not found:
            counts["no minimum"] = counts.get("no minimum", 0) + 1
            continue
        start = found[min(k % 2, len(found) - 1)]
        begin = time.perf_counter()
        result = jaxbundle.adjust(as_network(case, start[1][None], start[2][None]))
        spent.append(time.perf_counter() - begin)
        if not result.converged:
            counts["not solved"] = counts.get("not solved", 0) + 1
            continue
        word, E, off = compare(found, result, 2 * len(case.X) - 6)
        counts[word] = counts.get(word, 0) + 1
        error = max(error, off or 0.0)
        taken += any(one.taken for one in result.second_minima)
        if word not in ("none", "found"):
            lines = [f"{one[0]:.4f}" for one in found[:4]]
            told = [(round(one.other_vtpv, 4), one.taken) for one in result.second_minima]
            print(f"  case {k}: {word}, E {E:.3g}, n {len(case.X)}, minima {lines}, "
                  f"result {result.vtpv:.4f}, {told}")  # fmt: skip
    return counts, error, taken, float(np.median(spent))


def draw_network(rng):
    """Two to five images of 20 unknown points, flat or as deep as wide."""
    images, n = int(rng.integers(2, 6)), 20
    X = rng.uniform(-1, 1, (n, 3)) * [1, 1, np.exp(rng.uniform(np.log(0.1), 0))]
    distance = np.exp(rng.uniform(np.log(20.0), np.log(3000.0)))
    sigma = C / distance * np.exp(rng.uniform(np.log(1e-4), np.log(0.005)))
    X0, M = zip(*(
        looking_at(view, distance, rng.uniform(0, 2 * np.pi)) for view in views(rng, images, 5, 50)
    ))  # fmt: skip
    X0, M = np.stack(X0), np.stack(M)
    xy = sigma * residuals(X0, M, X, 0.0, sigma).reshape(images, n, 2)
    return Case(X, X0, M, xy + sigma * rng.normal(size=xy.shape), sigma)


def reverse(case):
    """The object reflected on the plane across the mean line of sight, and its images."""
    n = case.X0.mean(0) / np.linalg.norm(case.X0.mean(0))
    S, o = np.eye(3) - 2 * np.outer(n, n), case.X.mean(0)
    X0, M = np.empty_like(case.X0), np.empty_like(case.M)
    for k, (x, m) in enumerate(zip(case.X0, case.M)):
        local = m @ (o - x)
        u = local / np.linalg.norm(local)
        M[k] = (np.eye(3) - 2 * np.outer(u, u)) @ m @ S
        X0[k] = o - M[k].T @ local
    return case._replace(X=o + (case.X - o) @ S, X0=X0, M=M)


def dense(case, steps=60):
    """vᵀPv of a free network by a dense Levenberg-Marquardt from its poses and points; None if it
    did not settle."""
    images, n = len(case.X0), len(case.X)
    size = np.linalg.norm(case.X0[0])

    def value(p):
        turn = Rotation.from_rotvec(p[3 * images : 6 * images].reshape(-1, 3)).as_matrix()
        X0 = case.X0 + size * p[: 3 * images].reshape(-1, 3)
        X = case.X + p[6 * images :].reshape(n, 3)
        return residuals(X0, turn @ case.M, X, case.xy, case.sigma).ravel()

    p, h, damping = np.zeros(6 * images + 3 * n), 1e-6, 1e-4
    r = value(p)
    for _ in range(steps):
        J = np.stack([(value(p + h * e) - value(p - h * e)) / (2 * h) for e in np.eye(len(p))], 1)
        N, g, before = J.T @ J, J.T @ r, r @ r
        for _ in range(20):
            D = np.diag(np.diag(N)) + 1e-9 * np.eye(len(p))
            step = np.linalg.solve(N + damping * D, -g)
            trial = value(p + step)
            if trial @ trial <= before:
                break
            damping *= 4
        p, r, damping = p + step, trial, damping / 5
        if abs(before - r @ r) < 1e-9 * (1 + before):
            return r @ r
    return None


def run_networks(cases, seed):
    """Counts of what became of networks, the largest error of a difference, further minima."""
    rng = np.random.default_rng(seed)
    counts, error, further = {}, 0.0, 0
    for k in range(cases):
        case = draw_network(rng)
        other = reverse(case)
        start = (case, other)[k % 2]
        try:
            result = jaxbundle.adjust(as_network(start, start.X0, start.M, known=False))
            solved = result.converged
        except jaxbundle.NotSolvedError:
            solved = False
        costs = [dense(case), dense(other)] if solved else [None]
        if None in costs:
            counts["not solved"] = counts.get("not solved", 0) + 1
            continue
        best, worst = sorted(costs)
        r = 4 * len(case.X0) * 10 - 6 * len(case.X0) - 60 + 7
        E = (worst - best) / max(1.0, best / r)
        told = [one for one in result.second_minima if one.ambiguous]
        right = [one for one in told if abs(one.difference - (worst - best)) < 1e-3 * (1 + worst)]
        further += len(told) - len(right)
        if result.vtpv > best + 1e-4 * (1 + best):
            word = "worse minimum"
        elif E < THRESHOLD:
            word = "found" if right else "missed"
        else:
            word = "false alarm" if right else "none"
        counts[word] = counts.get(word, 0) + 1
        if right and word == "found":
            error = max(error, abs(right[0].difference - (worst - best)))
        if word not in ("none", "found"):
            told = [(one.ambiguity, round(one.other_vtpv, 3)) for one in told]
            print(f"  network {k}: {word}, E {E:.3g}, {len(case.X0)} images, minima {best:.4f}, "
                  f"{worst:.4f}, result {result.vtpv:.4f}, {told}")  # fmt: skip
    return counts, error, further


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--networks", type=int, default=200)
    given = parser.parse_args()
    jaxbundle.enable_x64()
    counts, error, taken, spent = run_images(given.cases, given.seed)
    print(f"{given.cases} images of known points: {counts}")
    print(f"largest error of a difference of vᵀPv {error:.2g}; better one taken {taken} times; "
          f"median {1000 * spent:.0f} ms")  # fmt: skip
    counts, error, further = run_networks(given.networks, given.seed)
    print(f"{given.networks} free networks of 2 to 5 images: {counts}")
    print(f"largest error of a difference of vᵀPv {error:.2g}; {further} minima of other kinds")


if __name__ == "__main__":
    main()
