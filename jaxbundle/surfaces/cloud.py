"""A point cloud with the covariance, number of rays, and base pixel of each point."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.results import data_frame


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Cloud:
    """Points X [n, 3] with covariance, object unit; `rays`; `image`, index into `images`, and `uv`,
    the pixel of that base image; `colour` red, green, blue. `system`: coordinate system, if it
    is a map system. `shared`: the part of the variance of Z that is of the orientations of the
    images, which points share; None: none, or not known."""

    X: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    rays: Int[np.ndarray, " n"]
    image: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    images: tuple[str, ...]
    colour: UInt8[np.ndarray, "n 3"] | None = None
    system: str | None = None
    shared: Float[np.ndarray, " n"] | None = None

    def __post_init__(self) -> None:
        if np.ma.is_masked(self.X) or np.ma.is_masked(self.covariance):
            raise InputError("cloud: masked coordinates or covariances; leave these points out")
        n = len(self.X)
        shapes = {"X": (n, 3), "covariance": (n, 3, 3), "rays": (n,), "image": (n,), "uv": (n, 2)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise InputError(
                    f"cloud: {name} has the shape {np.shape(getattr(self, name))}, expected {shape}"
                )

    def __len__(self) -> int:
        return len(self.X)

    @property
    def sigma(self) -> Float[np.ndarray, "n 3"]:
        """σX, σY, σZ; NaN if unknown."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.einsum("nii->ni", self.covariance))

    def table(self) -> dict[str, np.ndarray]:
        """Columns X, Y, Z, sX, sY, sZ, rays, image, u, v; one row a point."""
        names = np.array(self.images, dtype=object)
        columns = zip(("X", "Y", "Z", "sX", "sY", "sZ"), (*self.X.T, *self.sigma.T))
        u, v = self.uv.T
        return {**dict(columns), "rays": self.rays, "image": names[self.image], "u": u, "v": v}

    def to_pandas(self) -> Any:
        """The table as a pandas data frame (extra `tables`)."""
        return data_frame(self.table())

    def take(self, rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " k"] | slice) -> "Cloud":
        """Some of the points."""
        fields = ("X", "covariance", "rays", "image", "uv")
        some = {name: getattr(self, name)[rows] for name in fields}
        optional = {
            name: None if (values := getattr(self, name)) is None else values[rows]
            for name in ("colour", "shared")
        }
        return dataclasses.replace(self, **some, **optional)


def empty_cloud(image: str) -> Cloud:
    """No points of a base image."""
    X, number = np.zeros((0, 3)), np.zeros(0, int)
    return Cloud(X, np.zeros((0, 3, 3)), number, number, np.zeros((0, 2)), (image,))


def merge(clouds: Sequence[Cloud]) -> Cloud:
    """All points of several clouds of one system."""
    clouds = [c for c in clouds if len(c)] or list(clouds[:1])
    if not clouds:
        raise InputError("no clouds to merge")
    names = tuple(dict.fromkeys(name for c in clouds for name in c.images))
    number = [np.array([names.index(n) for n in c.images] or [0]) for c in clouds]
    join = lambda field: np.concatenate([getattr(c, field) for c in clouds])
    colours = [c.colour for c in clouds]
    return Cloud(
        join("X"),
        join("covariance"),
        join("rays"),
        np.concatenate([k[c.image] for k, c in zip(number, clouds)]).astype(clouds[0].image.dtype),
        join("uv"),
        names,
        None if any(c is None for c in colours) else join("colour"),
        clouds[0].system,
        None if any(c.shared is None for c in clouds) else join("shared"),
    )
