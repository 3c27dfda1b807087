"""The network of an adjusted block with control: control and check points with their good
measurements, and satellite positions with an offset on the axes that control has."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.network.kinds import Antennas, ExteriorPriors
from jaxbundle.network.subsets import keep_points
from jaxbundle.network.tables import GREY, Distances, LeftOut, Network, Points, Source
from jaxbundle.network.units import from_image_unit
from jaxbundle.reconstruction.control_choice import ControlChoice
from jaxbundle.reconstruction.oriented_block import MeasuredPoint, OrientedBlock


class _NamedPoints(NamedTuple):
    """Named points of the final network, and their measurements, σ in pixels."""

    id: tuple[str, ...]
    role: tuple[str, ...]
    position: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    image: Int[np.ndarray, " rays"]
    point: Int[np.ndarray, " rays"]
    xy: Float[np.ndarray, "rays 2"]
    spread: Float[np.ndarray, "rays 2"]


def network_with_control(block: OrientedBlock, control: Points, choice: ControlChoice) -> Network:
    """The network at the solution with control, its measurements and positions."""
    whole, network = block.network, readjustable_network(block.result)
    named, ids, distances = set(control.id), network.points.id, network.distances
    ends = [(ids[a], ids[b]) for a, b in distances.points]
    network = keep_points(network, np.array([id not in named for id in network.points.id]))
    row = {id: k for k, id in enumerate(network.points.id)}
    # The rows of the points in the new network, −1: named ones, which are added anew.
    new_row = np.array([row.get(id, -1) for id in whole.points.id])
    rays = whole.observations.take(new_row[whole.observations.point] >= 0)
    added = _gather_points(block, control, choice, len(row))
    xy, sigma = from_image_unit(
        block.cameras, whole.images.camera[added.image], added.xy, added.spread, "px"
    )
    images, moved = network.images, [block.row_of_point[id] for id in network.points.id]
    # Check points are no points of the network, and distances to them are left out.
    row |= {id: len(row) + k for k, id in enumerate(added.id) if added.role[k] != "check"}
    here = np.array([a in row and b in row for a, b in ends], bool)
    return network.replace(
        images=dataclasses.replace(images, position=block.X0, angles=block.angles),
        points=Points(
            (*network.points.id, *added.id),
            (*network.points.role, *added.role),
            np.concatenate([block.X[moved], added.position]),
            np.concatenate([network.points.sigma, added.sigma]),
            colour=_colours_with_added(network.points, len(added.id)),
        ),
        observations=dataclasses.replace(
            rays,
            image=np.concatenate([rays.image, added.image]),
            point=np.concatenate([new_row[rays.point], added.point]),
            xy=np.concatenate([rays.xy, xy]),
            sigma=np.concatenate([rays.sigma, sigma]),
            source=Source("observations"),
        ),
        further=(
            # The positions come back as observations of antennas, with an offset.
            *(kind for kind in network.further if not isinstance(kind, ExteriorPriors)),
            *_observe_positions(block, choice),
        ),
        distances=Distances(
            np.array([[row[a], row[b]] for (a, b), keep in zip(ends, here) if keep], int).reshape(
                -1, 2
            ),
            distances.value[here],
            distances.sigma[here],
            distances.source.take(here),
        ),
        datum="control",
        datum_points=(),
        object_unit="m",
        warnings=whole.warnings,
        notes=tuple(note for note in whole.notes if not says_left_out(note, added.id)),
        left_out=without_names(network.left_out, added.id),
    )


def _colours_with_added(points: Points, number: int) -> UInt8[np.ndarray, "n 3"] | None:
    """The colours of points and of a number of grey ones."""
    if points.colour is None:
        return None
    return np.concatenate([points.colour, np.full((number, 3), GREY, np.uint8)])


def says_left_out(note: str, ids: tuple[str, ...]) -> bool:
    """Whether a note says that points were left out that come back: its last words are names."""
    return note.startswith("left out ") and any(f" {id} " in f"{note} " for id in ids)


def without_names(given: Sequence[LeftOut], ids: tuple[str, ...]) -> tuple[LeftOut, ...]:
    """What is left out although these points come back."""
    changed = (
        dataclasses.replace(one, names=tuple(n for n in one.names if n not in ids))
        if "point" in one.thing
        else one
        for one in given
    )
    return tuple(one for one in changed if one.names)


def _gather_points(
    block: OrientedBlock, control: Points, choice: ControlChoice, first: int
) -> _NamedPoints:
    """Control and check points that can be determined, with their good measurements."""
    ids, roles, position, sigma, rows, point = [], [], [], [], [], []
    image, spread = [], []
    for k, id in enumerate(control.id):
        measured = choice.points[id]
        # A point with wrong coordinates is a good tie point: its rays agree.
        role = "check" if control.role[k] == "check" else "tie"
        role = control.role[k] if choice.used[k] else role
        # Known coordinates and one ray leave a residual, a tie point with one ray leaves none.
        if measured.good.sum() < (1 if choice.used[k] else 2):
            continue
        there = np.isfinite(measured.position).all()
        start = measured.position if there else _place_on_ray(block, measured)
        free = np.isinf(choice.sigma[k]) | (role == "tie")
        position.append(np.where(free, start, control.position[k]))
        exact = role in ("fixed", "tie")
        sigma.append(np.full(3, np.nan) if exact else choice.sigma[k])
        rows += measured.rows[measured.good].tolist()
        image += measured.image[measured.good].tolist()
        spread += measured.sigma[measured.good].tolist()
        point += [first + len(ids)] * int(measured.good.sum())
        ids.append(id)
        roles.append(role)
    return _NamedPoints(
        tuple(ids),
        tuple(roles),
        np.reshape(position, (-1, 3)),
        np.reshape(sigma, (-1, 3)),
        np.array(image, int),
        np.array(point, int),
        block.frame.named.xy[np.array(rows, int)],
        np.repeat(np.reshape(spread, (-1, 1)), 2, 1),
    )


def _place_on_ray(block: OrientedBlock, measured: MeasuredPoint) -> Float[np.ndarray, "3"]:
    """A place on the first good ray, at the distance of the points around."""
    first = int(np.flatnonzero(measured.good)[0])
    X0, rays = block.X0[measured.image[first]], block.network.observations
    seen = block.X[rays.point[rays.image == measured.image[first]]]
    depth = np.nanmedian(np.linalg.norm(seen - X0, axis=1))
    return X0 + depth * measured.rays[first]


def _observe_positions(block: OrientedBlock, choice: ControlChoice) -> list[Antennas]:
    """Satellite positions as observations, with an offset on the axes that control has."""
    if block.frame.positions is None:
        return []
    names = {name: k for k, name in enumerate(block.frame.names)}
    rows = np.array([names[id] for id in block.network.images.id])
    X, sigma = (values[rows] for values in block.frame.positions)
    there = np.flatnonzero(np.isfinite(X).all(1) & np.isfinite(sigma).all(1))
    if not len(there):
        return []
    # On an axis without control the offset and the block itself could not be separated.
    axes = [a for k, a in enumerate("XYZ") if np.isfinite(choice.sigma[choice.used, k]).any()]
    prior = dict(zip("XYZ", block.settings.offset_sigma))
    settings = {
        "free": [f"shift_{a}" for a in axes],
        "sigma": {f"shift_{a}": prior[a] for a in axes},
    }
    return [
        Antennas(
            image=tuple(block.network.images.id[k] for k in there),
            position=X[there],
            covariance=np.einsum("ni,ij->nij", sigma[there] ** 2, np.eye(3)),
            strip=("all",) * len(there),
            time=np.full(len(there), np.nan),
            settings=settings,
        )
    ]
