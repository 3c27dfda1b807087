"""The observation equations of a refinement, one function for one observation.

**Scanner.** The pose at the time t(l) of the measured line is known, so the condition is explicit
(`jaxbundle.pushbroom.project.misclosure`): the slopes at which the point is seen, less those at
which the measured pixel looks,

    g = [−r/q − ξ(u), −s/q − η(u)],        [r, s, q] = Rᵀ(t)·(X̃ − P(t)),

with X̃ the point where corrections let X appear. In lines and pixels,

    v = S·g,        S = −(∂g/∂(l, u))⁻¹,

the first of Newton's steps from the measured place to where the point is projected: computed −
observed but for terms of v². S is taken at the start values and again at the solution, and held
while the equations are solved.

**Frame.** The collinearity equations of `jaxbundle.adjustment.residuals`, in the camera's unit.

**Points.** X = X₀ + Aᵀ·δ with the axes A of the point (rows: east, north, up; or X, Y, Z), each of
which may be held, controlled with σ, or free.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbundle import cameras
from jaxbundle.adjustment.residuals import exterior_residual, image_residual
from jaxbundle.geometry import matrix_from_quaternion, retract_quaternion
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.project import misclosure
from jaxbundle.refinement.freedom import Form, change_of, changed


class Unknowns(eqx.Module):
    """Changes: m of the images and sensors in order of their names, three a point in its axes."""

    shared: Float[Array, " m"]
    point: Float[Array, "points 3"]


class ScannerRays(eqx.Module):
    """The measured points of one scanner image.

    `columns`: where the numbers of its vector are among the shared unknowns; m: held. `weight`:
    1/σ, 1/lines and 1/pixels.
    """

    image: PushbroomImage
    columns: Int[Array, " n"]
    place: Float[Array, "rays 2"]
    point: Int[Array, " rays"]
    weight: Float[Array, "rays 2"]
    scale: Float[Array, "rays 2 2"]
    form: Form
    earth: Ellipsoid | None = eqx.field(static=True)


class FrameRays(eqx.Module):
    """The measured points of one photograph; its vector: δX0, δθ, interior parameters.

    `prior`, `prior_weight`: given exterior orientation (X0, Y0, Z0, ω, φ, κ) and 1/σ, 0: none.
    """

    position: Float[Array, "3"]
    rotation: Float[Array, "4"]
    interior: Float[Array, " parameters"]
    columns: Int[Array, " n"]
    xy: Float[Array, "rays 2"]
    point: Int[Array, " rays"]
    weight: Float[Array, "rays 2"]
    prior: Float[Array, "6"]
    prior_weight: Float[Array, "6"]
    model: str | cameras.CameraModel = eqx.field(static=True)
    domain: str = eqx.field(static=True)


class System(eqx.Module):
    """Everything an adjustment computes with; the point coordinates `X` are start values.

    `prior` [m]: 1/σ of the shared unknowns, 0: none. `free` [points, 3]: 0 or 1; `control`: 1/σ
    of the given coordinates `given` in the axes of the point, relative to the start values.
    """

    scanners: tuple[ScannerRays, ...]
    frames: tuple[FrameRays, ...]
    X: Float[Array, "points 3"]
    axes: Float[Array, "points 3 3"]
    free: Float[Array, "points 3"]
    given: Float[Array, "points 3"]
    control: Float[Array, "points 3"]
    prior: Float[Array, " m"]

    @property
    def rays(self) -> tuple[ScannerRays | FrameRays, ...]:
        """All images."""
        return (*self.scanners, *self.frames)

    def start(self) -> Unknowns:
        """No changes."""
        return Unknowns(jnp.zeros_like(self.prior), jnp.zeros_like(self.X))


def line_residual(
    image: PushbroomImage,
    earth: Ellipsoid | None,
    form: Form,
    p: Float[Array, " n"],
    X: Float[Array, "3"],
    place: Float[Array, "2"],
) -> Float[Array, "2"]:
    """g of one measured (line, pixel): the slopes of the point less those of the pixel."""
    t = image.times.time(place[0])
    return misclosure(changed(image, form, change_of(form, p), t), X, t, place[1], earth)


def scanner_residuals(rays: ScannerRays, p, X) -> Float[Array, "rays 2"]:
    """v of a scanner image in lines and pixels; p its vector, X [rays, 3]."""
    one = lambda X, place, S: S @ line_residual(rays.image, rays.earth, rays.form, p, X, place)
    return jax.vmap(one)(X, rays.place, rays.scale)


def scales(rays: ScannerRays, p, X) -> Float[Array, "rays 2 2"]:
    """S of every ray."""

    def one(X, place):
        g = lambda place: line_residual(rays.image, rays.earth, rays.form, p, X, place)
        return -jnp.linalg.inv(jax.jacfwd(g)(place))

    return jax.vmap(one)(X, rays.place)


def frame_residuals(rays: FrameRays, p, X) -> Float[Array, "rays 2"]:
    """v of a photograph in the unit of its camera."""
    model = cameras.get_model(rays.model)
    M = matrix_from_quaternion(retract_quaternion(rays.rotation, p[3:6])).ravel()
    centre, interior = rays.position + p[:3], rays.interior + p[6:]
    still = ((0.0,) * 3, (0.0,) * 3, (), (0.0,) * 3)

    def one(X, xy):
        arguments = map(tuple, (M, centre, interior, X, xy))
        return jnp.stack(image_residual(model, rays.domain, (), *arguments, (1.0, 1.0), still))

    return jax.vmap(one)(X, rays.xy)


def positions(system: System, unknowns: Unknowns) -> Float[Array, "points 3"]:
    """X of all points."""
    change = unknowns.point * system.free
    return system.X + jnp.einsum("pki,pk->pi", system.axes, change)


def vector_of(rays: ScannerRays | FrameRays, shared: Float[Array, " m"]) -> Float[Array, " n"]:
    """The vector of one image out of the shared unknowns."""
    return jnp.concatenate([shared, jnp.zeros(1)])[rays.columns]


def image_residuals(system: System, unknowns: Unknowns) -> list[Float[Array, "rays 2"]]:
    """v of every image, not divided by σ."""
    X = positions(system, unknowns)
    return [
        (scanner_residuals if isinstance(rays, ScannerRays) else frame_residuals)(
            rays, vector_of(rays, unknowns.shared), X[rays.point]
        )
        for rays in system.rays
    ]


def residuals(system: System, unknowns: Unknowns) -> Float[Array, " rows"]:
    """All v/σ: image points, control coordinates, priors, exterior orientations with priors.

    Two rows an image point, three a point, one a shared unknown, six a photograph; what has no
    weight is a row of zeros.
    """
    images = image_residuals(system, unknowns)
    rows = [(v * rays.weight).ravel() for v, rays in zip(images, system.rays)]
    change = unknowns.point * system.free
    rows.append((system.control * (change - system.given)).ravel())
    rows.append(system.prior * unknowns.shared)
    for rays in system.frames:
        change = vector_of(rays, unknowns.shared)[:6]
        rows.append(
            exterior_residual(rays.position, rays.rotation, rays.prior, rays.prior_weight, change)
        )
    return jnp.concatenate(rows)


def rescaled(system: System, unknowns: Unknowns) -> System:
    """The system with the S of these unknowns."""
    X = positions(system, unknowns)
    found = tuple(
        scales(rays, vector_of(rays, unknowns.shared), X[rays.point]) for rays in system.scanners
    )
    return eqx.tree_at(lambda s: [r.scale for r in s.scanners], system, list(found))


compiled_rescaled = eqx.filter_jit(rescaled)
compiled_image_residuals = eqx.filter_jit(image_residuals)
"""Compiled once and shared by all that look at a system."""
