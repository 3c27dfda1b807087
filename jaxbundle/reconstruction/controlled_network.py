"""The network of an adjusted block with control: control and check points with their good
measurements, and satellite positions with an offset on the axes that control has."""

import dataclasses
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.network.kinds import Antennas, ExteriorPriors
from jaxbundle.network.subsets import keep_points
from jaxbundle.network.tables import GREY, Distances, LeftOut, Network, Points, Source
from jaxbundle.network.units import from_image_unit
from jaxbundle.orientation.missing import note_missing
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
    block_network, network = block.network, readjustable_network(block.result)
    control_ids, ids, distances = set(control.id), network.points.id, network.distances
    ends = [(ids[a], ids[b]) for a, b in distances.points]
    network = keep_points(network, np.array([id not in control_ids for id in network.points.id]))
    row = {id: k for k, id in enumerate(network.points.id)}
    # The rows of the points in the new network, −1: named ones, which are added anew.
    new_row = np.array([row.get(id, -1) for id in block_network.points.id])
    rays = block_network.observations.take(new_row[block_network.observations.point] >= 0)
    control_points = _gather_points(block, control, choice, len(row))
    xy, sigma = from_image_unit(
        block.cameras,
        block_network.images.camera[control_points.image],
        control_points.xy,
        control_points.spread,
        "px",
    )
    images, rows_in_block = network.images, [block.row_of_point[id] for id in network.points.id]
    # Check points are no points of the network, and distances to them are left out.
    row |= {
        id: len(row) + k
        for k, id in enumerate(control_points.id)
        if control_points.role[k] != "check"
    }
    has_both_ends = np.array([a in row and b in row for a, b in ends], bool)
    controlled = network.replace(
        images=dataclasses.replace(images, position=block.X0, angles=block.angles),
        points=Points(
            (*network.points.id, *control_points.id),
            (*network.points.role, *control_points.role),
            np.concatenate([block.X[rows_in_block], control_points.position]),
            np.concatenate([network.points.sigma, control_points.sigma]),
            colour=_colours_with_added(network.points, len(control_points.id)),
        ),
        observations=dataclasses.replace(
            rays,
            image=np.concatenate([rays.image, control_points.image]),
            point=np.concatenate([new_row[rays.point], control_points.point]),
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
            np.array(
                [[row[a], row[b]] for (a, b), keep in zip(ends, has_both_ends) if keep], int
            ).reshape(-1, 2),
            distances.value[has_both_ends],
            distances.sigma[has_both_ends],
            distances.source.take(has_both_ends),
        ),
        datum="control",
        datum_points=(),
        object_unit="m",
        warnings=block_network.warnings,
        notes=block_network.notes,
    )
    return without_returned(controlled, control_points.id)


def _colours_with_added(points: Points, number: int) -> UInt8[np.ndarray, "n 3"] | None:
    """The colours of points and of a number of grey ones."""
    if points.colour is None:
        return None
    return np.concatenate([points.colour, np.full((number, 3), GREY, np.uint8)])


def without_returned(network: Network, ids: tuple[str, ...]) -> Network:
    """The network with notes of what is left out although these points come back."""
    # Points without start values are a note with the reason of each (`note_missing`), which is
    # written again for the others.
    missing = [one for one in network.left_out if one.thing == "point" and ": " in one.why]
    for clause in {one.why.partition(": ")[0] for one in missing if {*one.names} & {*ids}}:
        of_clause = [one for one in missing if one.why.startswith(f"{clause}: ")]
        reasons = {
            name: one.why.removeprefix(f"{clause}: ")
            for one in of_clause
            for name in one.names
            if name not in ids
        }
        said = re.compile(rf"left out \d+ points? {re.escape(clause)}: ")
        network = network.replace(
            notes=tuple(note for note in network.notes if not said.match(note)),
            left_out=tuple(one for one in network.left_out if one not in of_clause),
        )
        undetermined = {name for one in of_clause if not one.measured for name in one.names}
        network = note_missing(network, "point", reasons, clause, undetermined)
    return network.replace(left_out=without_names(network.left_out, ids))


def without_names(notes: Sequence[LeftOut], ids: tuple[str, ...]) -> tuple[LeftOut, ...]:
    """What is left out although these points come back."""
    changed = (
        dataclasses.replace(note, names=tuple(n for n in note.names if n not in ids))
        if "point" in note.thing
        else note
        for note in notes
    )
    return tuple(note for note in changed if note.names)


def _gather_points(
    block: OrientedBlock, control: Points, choice: ControlChoice, first_row: int
) -> _NamedPoints:
    """Control and check points that can be determined, with their good measurements."""
    ids, roles, position, sigma, rows, point = [], [], [], [], [], []
    image, sigmas = [], []
    for k, id in enumerate(control.id):
        measured = choice.points[id]
        # A point with wrong coordinates is a good tie point: its rays agree.
        role = "check" if control.role[k] == "check" else "tie"
        role = control.role[k] if choice.used[k] else role
        # Known coordinates and one ray leave a residual, a tie point with one ray leaves none.
        if measured.good.sum() < (1 if choice.used[k] else 2):
            continue
        has_position = np.isfinite(measured.position).all()
        start = measured.position if has_position else _place_on_ray(block, measured)
        free = np.isinf(choice.sigma[k]) | (role == "tie")
        position.append(np.where(free, start, control.position[k]))
        exact = role in ("fixed", "tie")
        sigma.append(np.full(3, np.nan) if exact else choice.sigma[k])
        rows += measured.rows[measured.good].tolist()
        image += measured.image[measured.good].tolist()
        sigmas += measured.sigma[measured.good].tolist()
        point += [first_row + len(ids)] * int(measured.good.sum())
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
        np.repeat(np.reshape(sigmas, (-1, 1)), 2, 1),
    )


def _place_on_ray(block: OrientedBlock, measured: MeasuredPoint) -> Float[np.ndarray, "3"]:
    """A place on the first good ray, at the distance of the points around."""
    first_good = int(np.flatnonzero(measured.good)[0])
    X0, rays = block.X0[measured.image[first_good]], block.network.observations
    points_seen = block.X[rays.point[rays.image == measured.image[first_good]]]
    depth = np.nanmedian(np.linalg.norm(points_seen - X0, axis=1))
    return X0 + depth * measured.rays[first_good]


def _observe_positions(block: OrientedBlock, choice: ControlChoice) -> list[Antennas]:
    """Satellite positions as observations, with an offset on the axes that control has."""
    if block.frame.positions is None:
        return []
    names = {name: k for k, name in enumerate(block.frame.names)}
    rows = np.array([names[id] for id in block.network.images.id])
    X, sigma = (values[rows] for values in block.frame.positions)
    positioned_images = np.flatnonzero(np.isfinite(X).all(1) & np.isfinite(sigma).all(1))
    if not len(positioned_images):
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
            image=tuple(block.network.images.id[k] for k in positioned_images),
            position=X[positioned_images],
            covariance=np.einsum("ni,ij->nij", sigma[positioned_images] ** 2, np.eye(3)),
            strip=("all",) * len(positioned_images),
            time=np.full(len(positioned_images), np.nan),
            settings=settings,
        )
    ]
