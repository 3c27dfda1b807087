"""Image points of RPC images: rational polynomials with a bias in the image as unknowns.

    v = [l + Σ aₖ·mₖ(l̂, ŝ) − line,  s + Σ bₖ·mₖ(l̂, ŝ) − sample],       m = 1, l̂, ŝ, l̂², l̂ŝ, ŝ²,

(l, s) the image of the point by the coefficients (`pushbroom.rpc.bias.project_compensated`), of
which a bias of degree 0, 1 or 2 has 1, 3 or 6 terms (Grodecki and Dial, 2003, PE&RS 69(1)). The
terms are about 1 at the edges of the image, so that every unknown is in pixels there.

The coefficients of an image are constants of its row in the table of RPC images, beside its
unknowns: they are looked up once for all of its points.

**Prior σ.** RPC00B states two errors of the ground coordinates of an image, in metres for each
horizontal axis (STDI-0002, appendix E: ERR_BIAS, the RMS of what is common to all points, and
ERR_RAND, of what differs from point to point). In lines, and likewise in samples,

    σ(a₀) = ERR_BIAS·|∂l/∂(east, north)|,      σ(a₁), σ(a₂), … = ERR_RAND·|∂l/∂(east, north)|.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, geodetic
from jaxbundle.geometry.vectors import Triple, point_on_ray
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.indexing.indices import fill_up
from jaxbundle.leastsquares.spaces import Change, WithoutChart
from jaxbundle.pushbroom.rpc.bias import (
    MODELS,
    RpcBias,
    images_and_slopes,
    project_compensated,
)
from jaxbundle.pushbroom.rpc.polynomials import ABOVE_DOMAIN, Rpc, domain, fit_inverse, sight
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# The table of the biases.
RPC_IMAGE = "RPC image"
# Terms of a bias of degree 0, 1, 2, of lines and of samples each.
BIAS_TERMS = tuple(MODELS.values())
TERM_NAMES = ("shift", "bias l̂", "bias ŝ", "bias l̂²", "bias l̂ŝ", "bias ŝ²")
AXES = ("line", "sample")


class BiasedRpc(NamedTuple):
    """The coefficients of images, and the terms of their biases: of lines, of samples, pixels."""

    bias: Float[AnyArray, "*rows 2 terms"]
    rpc: Rpc


class RpcBlock(NamedTuple):
    """A row of `BiasedRpc` as scalars, which blocks of observations are (`leastsquares.spaces`)."""

    bias: tuple[tuple[Scalar, ...], ...]
    rpc: Rpc


@dataclasses.dataclass(frozen=True)
class BiasSpace(WithoutChart):
    """The space of `BiasedRpc`: its bias changes, all terms of lines before those of samples."""

    terms: int

    @property
    def width(self) -> int:
        return 2 * self.terms

    def prepare(self, value: BiasedRpc) -> RpcBlock:
        unpacked = jax.tree.map(lambda x: tuple(x) if jnp.ndim(x) else x, value.rpc)
        return RpcBlock(tuple(map(tuple, value.bias)), unpacked)

    def move(self, block: RpcBlock, change: Change) -> RpcBlock:
        if not change:
            return block
        parts = change[: self.terms], change[self.terms :]
        add = lambda bias, change: tuple(a + d for a, d in zip(bias, change))
        return block._replace(bias=tuple(map(add, block.bias, parts)))

    def retract(self, value: BiasedRpc, change: Float[AnyArray, " width"]) -> BiasedRpc:
        return value._replace(bias=value.bias + change.reshape(2, self.terms))

    def difference(self, value: BiasedRpc, origin: BiasedRpc) -> Float[Array, " width"]:
        return jnp.ravel(value.bias - origin.bias)

    def hold(
        self, value: BiasedRpc, start: BiasedRpc, free: Float[AnyArray, " width"]
    ) -> BiasedRpc:
        moves = free.reshape(2, self.terms) > 0
        return value._replace(bias=jnp.where(moves, value.bias, start.bias))


@dataclasses.dataclass(frozen=True)
class RpcPoint:
    """v of a measured line and sample, pixels; `earth`: of the Earth-fixed points."""

    earth: Ellipsoid

    def __call__(
        self, image: RpcBlock, X: Triple, measured: tuple[Scalar, ...]
    ) -> tuple[Scalar, ...]:
        place = geodetic(self.earth, X)
        computed = project_compensated(image.rpc, RpcBias(*image.bias), *place)
        return tuple(value - observed for value, observed in zip(computed, measured))


def _bias_itself(image: RpcBlock, _: None) -> tuple[Scalar, ...]:
    return (*image.bias[0], *image.bias[1])


# Kinds are compared by their functions, as keys of compiled programs (`kinds`).
# Image points of RPC images, whose coefficients hold for the ellipsoid WGS84.
RPC_POINTS = Kind("RPC coordinates", RpcPoint(WGS84), (RPC_IMAGE, "point"), AXES, scalars=True)
BIAS_PRIORS = Kind("priors of biases", _bias_itself, (RPC_IMAGE,), scalars=True, snooped="")


def stack_images(rpcs: list[Rpc], terms: int) -> BiasedRpc:
    """The rows of the table of RPC images, without a bias."""
    stacked = jax.tree.map(lambda *rows: np.stack([np.asarray(x) for x in rows]), *rpcs)
    return BiasedRpc(np.zeros((len(rpcs), 2, terms)), stacked)


def names_of_terms(terms: int) -> list[str]:
    """The names of the unknowns of an image, in the order of its bias."""
    return [f"{axis} {term}" for axis in AXES for term in TERM_NAMES[:terms]]


def prior_of_bias(
    degree: int, shift: float = np.inf, variation: float = np.inf
) -> Float[np.ndarray, "2 terms"]:
    """The prior σ of a bias: `shift` of its constants, `variation` of all other terms, pixels; 0
    held, infinite free.

    **Raises:** `InputError` for a degree other than 0, 1, 2.
    """
    if degree not in range(len(BIAS_TERMS)):
        raise InputError(f"degree {degree} of a bias; expected 0, 1 or 2")
    return np.tile([shift, *[variation] * (BIAS_TERMS[degree] - 1)], (2, 1))


def prior_of_errors(
    rpc: Rpc, degree: int, bias: float, random: float
) -> Float[np.ndarray, "2 terms"]:
    """The prior σ of a bias from the errors that the coefficients state, metres for each
    horizontal axis (module docstring); pixels."""
    place = (
        np.radians(np.asarray(rpc.longitude_offset)[None]),
        np.radians(np.asarray(rpc.latitude_offset)[None]),
        np.asarray(rpc.height_offset)[None],
    )
    _, slopes = images_and_slopes(rpc, WGS84, *place)
    pixels = np.linalg.norm(np.asarray(slopes)[0, :, :2], axis=1)
    return pixels[:, None] * prior_of_bias(degree, bias, random)


@compile_once
def _misclosures(
    space: BiasSpace,
    images: BiasedRpc,
    image: Int[AnyArray, " n"],
    X: Float[AnyArray, "n 3"],
    places: Float[AnyArray, "n 2"],
) -> tuple[Float[Array, "n 2"], Int[Array, " n"]]:
    def of_one(
        row: Int[AnyArray, ""], X: Float[AnyArray, "3"], place: Float[AnyArray, "2"]
    ) -> tuple[Array, Array]:
        block = jax.tree.map(lambda x: x[row], images)
        v = RPC_POINTS.residual(space.prepare(block), tuple(X), tuple(place))
        return jnp.stack(v), domain(block.rpc, *geodetic(WGS84, tuple(X)))

    return jax.vmap(of_one)(image, X, places)


def misclosures(
    images: BiasedRpc,
    image: Int[np.ndarray, " n"],
    X: Float[np.ndarray, "n 3"],
    places: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, " n"]]:
    """v of measured places of points X in the rows `image` of the table of RPC images, and the
    `RpcStatus` of the points."""
    n, images = len(image), jax.tree.map(np.asarray, images)
    padded = fill_up(n)
    space = BiasSpace(images.bias.shape[-1])
    padded_inputs = np.asarray(image)[padded], np.asarray(X)[padded], np.asarray(places)[padded]
    v, status = _misclosures(space, images, *padded_inputs)
    return np.asarray(v)[:n], np.asarray(status)[:n]


@compile_once
def _lines_of_sight(
    rpc: Rpc, image: Int[AnyArray, " n"], places: Float[AnyArray, "n 2"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    images = rpc, jax.vmap(fit_inverse)(rpc)

    def line_of_sight(row: Int[AnyArray, ""], place: Float[AnyArray, "2"]) -> tuple[Array, Array]:
        rpc, inverse = jax.tree.map(lambda x: x[row], images)
        top, d = sight(rpc, place[0], place[1], inverse=inverse)
        return jnp.stack(point_on_ray(top, d, -ABOVE_DOMAIN)), jnp.stack(d)

    return jax.vmap(line_of_sight)(image, places)


def lines_of_sight(
    rpcs: list[Rpc], image: Int[np.ndarray, " n"], places: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """A point on the line of sight of each place in the images `image`, above all terrain, and the
    direction downwards; Earth-fixed, without a bias."""
    padded = fill_up(len(image))
    sights = _lines_of_sight(stack_images(rpcs, 1).rpc, image[padded], places[padded])
    centre, direction = (np.asarray(x)[: len(image)] for x in sights)
    return centre, direction
