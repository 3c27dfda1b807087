"""What a writer requires of a network, and what its format cannot hold.

A format declares what it loses (`losing`): names of `QUANTITIES`, each with a count of what a
network has of it. The command tells this before it writes, the table of conversions in the
documentation is made of it, and a test compares it with what is read back.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Int

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.network.columns import count
from jaxbundle.network.kinds import KINDS
from jaxbundle.network.tables import UNIT, Camera, Images, Network, Points
from jaxbundle.network.units import METRES

# Camera models common to formats of computer vision.
PIXEL_MODELS = ("opencv", "kannala-brandt")
CORE = ("fx", "fy", "cx", "cy")


def need_values(network: Network, model: str = "", format: str = "", points: bool = True) -> None:
    """Refuse a network without orientations, coordinates, or the only model of a format.

    **Raises:** `InputError` naming camera, image or point.
    """
    for camera in network.cameras:
        if model and camera.model != model:
            raise InputError(
                f"camera {camera.id!r}: {format} has no model {str(camera.model)!r}; convert it "
                f"with --model {model}"
            )
    for table, missing, name, quantity in _rows_without_values(network)[: 2 if points else 1]:
        for row in missing[:1]:
            raise InputError(
                f"{table.source(row)}: {name} {table.id[row]!r} has no {quantity} to be written: "
                f"{GET_VALUES}"
            )


def describe_missing_values(network: Network) -> tuple[str, ...]:
    """What a table of a network has empty cells for, in one sentence; none if there is nothing."""
    parts = [
        f"{count(len(missing), name)} without {quantity}"
        for _, missing, name, quantity in _rows_without_values(network)
        if len(missing)
    ]
    return (f"{', '.join(parts)}: their cells are empty; {GET_VALUES}",) if parts else ()


GET_VALUES = "convert the result of jaxbundle orient or adjust, which compute what is missing"


def _rows_without_values(
    network: Network,
) -> list[tuple[Images | Points, Int[np.ndarray, " missing"], str, str]]:
    """Images and points with the rows that lack values, and what is lacking in words."""
    images, points = network.images, network.points
    tables = (
        (images, np.concatenate([images.position, images.angles], 1), "image", "orientation"),
        (points, points.position, "point", "coordinates"),
    )
    return [
        (table, np.flatnonzero(~np.isfinite(values).all(1)), name, quantity)
        for table, values, name, quantity in tables
    ]


# Formats whose lengths are metres, with the names of their programs.
METRIC_FORMATS = MappingProxyType({"kalibr": "Kalibr", "mrcal": "mrcal", "ros-stereo": "ROS"})


def mountings_in_metres(network: Network, format: str) -> tuple[Network, list[str]]:
    """A network with the positions of its images in metres, for one of `METRIC_FORMATS`, and what
    has to be said of a unit that is no length."""
    images, unit = network.images, network.object_unit
    if unit in METRES:
        images = dataclasses.replace(images, position=METRES[unit] * images.position)
        return network.replace(images=images, object_unit="m"), []
    known = np.isfinite(images.position) & (images.position != 0)
    remark = (
        f"the unit of lengths: {METRIC_FORMATS[format]} expects metres, and lengths in {unit!r} "
        "are written as they are (object_unit = mm, of convert --set object_unit=mm, converts them)"
    )
    return network, [remark] if known.any() else []


# How many of something a network has.
Count = Callable[[Network], int]
# What a format cannot hold, by name.
Losses = Mapping[str, Count]


def _rows_of(table: str) -> Count:
    def count(network: Network) -> int:
        kinds = [kind for kind in network.further if kind.TABLE == table]
        return sum(len(next(iter(kind.columns(1.0).values()))) for kind in kinds)

    return count


def _stated_sigmas(network: Network) -> int:
    """Image points with a σ other than 1, which is that of a format without σ."""
    rays = network.observations
    units = rays.sigma_origin == UNIT or not len(rays)
    # 1e-12: the conversion between pixels and millimetres rounds 1 to a few eps (2e-16)
    return 0 if units else int((abs(rays.sigma - 1) > 1e-12).any(axis=1).sum())


# What a network may have, and how many. Settings of the adjustment (free and tied parameters,
# datum, units, σ of further kinds) are of a project alone.
QUANTITIES: Losses = MappingProxyType(
    {
        "interior orientations": lambda n: len(n.cameras),
        "names of cameras": lambda n: len(n.cameras),
        # Images beyond the first of each camera.
        "that images share a camera": lambda n: len(n.images) - len(np.unique(n.images.camera)),
        "image sizes of cameras": lambda n: sum(c.image_size is not None for c in n.cameras),
        "pixel sizes of cameras": lambda n: sum(c.pixel_size is not None for c in n.cameras),
        "prior σ of camera parameters": lambda n: sum(len(c.sigma) for c in n.cameras),
        "orientations of images": lambda n: int(np.isfinite(n.images.position).all(1).sum()),
        "names of images": lambda n: len(n.images),
        "prior σ of orientations": lambda n: int(np.isfinite(n.images.sigma).any(1).sum()),
        "points": lambda n: len(n.points),
        "names of points": lambda n: len(n.points),
        "roles of points": lambda n: int((~n.points.has_role("tie")).sum()),
        "σ of control points": lambda n: int((~np.isnan(n.points.sigma)).any(1).sum()),
        "colours of points": lambda n: 0 if n.points.colour is None else len(n.points),
        "datum points": lambda n: len(n.datum_points),
        "image points": lambda n: len(n.observations),
        "σ of image points": _stated_sigmas,
        "distances": lambda n: len(n.distances),
        **{table: _rows_of(table) for table in KINDS},
    }
)
# What is lost together with something, and is not told beside it.
PARTS = {
    "interior orientations": {
        "image sizes of cameras",
        "pixel sizes of cameras",
        "that images share a camera",
        "prior σ of camera parameters",
    },
    "points": {
        "names of points",
        "roles of points",
        "σ of control points",
        "colours of points",
        "datum points",
        "image points",
        "σ of image points",
    },
    "image points": {"σ of image points"},
}
# What formats of computer vision do not have.
STATISTICS = (
    "prior σ of camera parameters",
    "prior σ of orientations",
    "roles of points",
    "σ of control points",
    "datum points",
    "σ of image points",
    "distances",
    *KINDS,
)


def losing(
    *names: str, keeping: Sequence[str] = (), partly: Mapping[str, Count] = MappingProxyType({})
) -> Losses:
    """The losses of a format: `STATISTICS` and the names, without those it keeps; `partly`: counts
    of what is lost only in part."""
    lost_names = ({*STATISTICS} - {*keeping}) | {*names, *partly}
    unknown = {*names, *partly, *keeping} - QUANTITIES.keys()
    if unknown:
        raise ValueError(f"unknown quantities: {', '.join(sorted(unknown))}")
    implied_names = {
        part for name in lost_names if name not in partly for part in PARTS.get(name, ())
    }
    return MappingProxyType(
        {
            name: partly.get(name, QUANTITIES[name])
            for name in QUANTITIES
            if name in lost_names - implied_names
        }
    )


def describe_losses(network: Network, losses: Losses) -> tuple[str, ...]:
    """What of a network a format cannot hold, each with its number."""
    numbers = {name: count(network) for name, count in losses.items()}
    return tuple(f"{name} ({number})" for name, number in numbers.items() if number)


def changed(names: Sequence[str], written_names: Sequence[object]) -> int:
    """How many names are written as something else."""
    return sum(name != str(new) for name, new in zip(names, written_names, strict=True))


def written_numbers(ids: Sequence[str]) -> list[int]:
    """The ids if all are numbers, else 0, 1, 2, …"""
    are_numbers = all(
        id.isascii() and id.isdigit() and len(id) < 10 and str(int(id)) == id for id in ids
    )
    return [int(id) for id in ids] if are_numbers else list(range(len(ids)))


def are_numbered_from_0(ids: Sequence[str]) -> bool:
    """Whether the names are 0, 1, 2, …, as a format counts them."""
    return changed(ids, range(len(ids))) == 0


def check_others_zero(camera: Camera, format: str, coefficients: Sequence[str]) -> dict[str, float]:
    """All parameters of a camera of one of the `PIXEL_MODELS`, for a format with some of the
    coefficients.

    **Raises:** `InputError` for another model, and for a coefficient the format does not have.
    """
    where = f"camera {camera.id!r}: {format} has no"
    if camera.model not in PIXEL_MODELS:
        raise InputError(f"{where} model {str(camera.model)!r}; convert it with --model opencv")
    p = all_parameters(camera)
    superfluous = [
        name for name, value in p.items() if value and name not in (*CORE, *coefficients)
    ]
    if superfluous:
        raise InputError(f"{where} {', '.join(superfluous)}; adjust the camera without")
    return p


def one_focal_length(camera: Camera, format: str) -> float:
    """fx, which must equal fy.

    **Raises:** `InputError`.
    """
    p = all_parameters(camera)
    if p["fx"] != p["fy"]:
        raise InputError(
            f"camera {camera.id!r}: {format} has one focal length, but fx is {p['fx']:.9g} and fy "
            f'{p["fy"]:.9g}; adjust the camera with tie = [["fx", "fy"]] '
            f"(--set camera.{camera.id}.tie=fx+fy)"
        )
    return p["fx"]


def size_of(camera: Camera, format: str) -> tuple[int, int]:
    """The image size of a camera.

    **Raises:** `InputError` without one."""
    if camera.image_size is None:
        raise InputError(f"camera {camera.id!r}: {format} needs the image size; give image_size")
    return camera.image_size
