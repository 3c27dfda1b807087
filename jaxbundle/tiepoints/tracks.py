"""Tracks: one point in all its photographs, from matches of pairs.

Matches are joined, the most distinct first (union-find); one that would put two points of a
photograph into a track contradicts better ones and is left out. The kept tracks cover
every photograph evenly, long ones first, and none next to another.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.verification import Pair


@dataclasses.dataclass(frozen=True)
class TrackSettings:
    """Settings of the choice of tracks."""

    cells: int = 10
    """Cells along the longer side of a photograph, each with its share of the points: with 1500
    points in 3:2, 21 in each. Fewer: the points follow the texture; more: the quota of a cell
    is a handful, and long tracks lose against even cover."""
    merging_distance: float = 0.0015
    """Side of the cells of a fine grid, relative to the longer side: 4.5 pixels of 3000. Of tracks
    that share cells in two photographs only the first is kept. Larger: fewer points where there is
    much texture; smaller: points whose windows nearly coincide, with correlated errors."""


def make_tracks(features: Sequence[Features], pairs: Sequence[Pair]) -> list[list[tuple[int, int]]]:
    """Tracks as lists of (photograph, feature), two photographs at least."""
    # Every feature of all photographs has a number; `first_number` is that of the first of a
    # photograph.
    first_number = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(int)
    merged = np.concatenate(
        [_merge_directions(f.xy) + k for f, k in zip(features, first_number)] or [[]]
    )
    rows = [first_number[list(pair.images)] + pair.matches for pair in pairs if len(pair)]
    if not rows:
        return []
    distance_ratio = np.concatenate([pair.distance_ratio for pair in pairs if len(pair)])
    matched = np.concatenate(rows)[np.argsort(distance_ratio, kind="stable")]
    edges = merged[matched]
    # Of several directions at one place the track has that of the most distinct match: least
    # squares matching starts with it.
    places, first_match = np.unique(edges, return_index=True)
    feature_at = np.arange(first_number[-1])
    feature_at[places] = matched.ravel()[first_match]
    members = _join(
        edges, np.searchsorted(first_number, np.arange(first_number[-1]), side="right") - 1
    )
    tracks = []
    for nodes in members:
        nodes = feature_at[nodes]
        images = np.searchsorted(first_number, nodes, side="right") - 1
        tracks.append(sorted(zip(images.tolist(), (nodes - first_number[images]).tolist())))
    return tracks


def _merge_directions(xy: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """For every feature the first one at its position: SIFT may give several directions."""
    # To a hundredth of a pixel, since it interpolates the position for each of them.
    _, first_row, inverse = np.unique(
        np.round(xy, 2), axis=0, return_index=True, return_inverse=True
    )
    return first_row[inverse.ravel()]


def _join(
    edges: Int[np.ndarray, "edges 2"], image: Int[np.ndarray, " nodes"]
) -> list[Int[np.ndarray, " _"]]:
    """The groups of nodes joined by edges, none with two nodes of an image."""
    parent: dict[int, int] = {}
    group: dict[int, dict[int, int]] = {}

    def root(node: int) -> int:
        while parent[node] != node:
            # Path halving (van Leeuwen and van der Weide 1977): nearly constant time a query.
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for a, b in edges.tolist():
        for node in (a, b):
            if node not in parent:
                parent[node], group[node] = node, {int(image[node]): node}
        a, b = root(a), root(b)
        if a == b or not group[a].keys().isdisjoint(group[b]):
            continue
        if len(group[a]) < len(group[b]):
            a, b = b, a  # the smaller joins the larger: every node moves at most log₂ n times
        parent[b] = a
        group[a].update(group.pop(b))
    return [np.array(sorted(g.values())) for g in group.values() if len(g) > 1]


def choose_tracks(
    tracks: Sequence[Sequence[tuple[int, int]]],
    xy: Sequence[Float[np.ndarray, "_ 2"]],
    sizes: Sequence[tuple[int, int]],
    number: int,
    settings: TrackSettings = TrackSettings(),
) -> Bool[np.ndarray, " tracks"]:
    """Which tracks to keep, for about `number` points in every photograph, evenly distributed.

    **Arguments:** `xy`: positions of the features of every photograph; `sizes`: columns, rows.
    """
    cell, fine_cell, shape = _cells(xy, sizes, settings)
    quota = [max(1, round(number / (nx * ny))) for nx, ny in shape]
    filled = [np.zeros(nx * ny, int) for nx, ny in shape]
    taken_cells: list[set] = [set() for _ in xy]
    is_chosen = np.zeros(len(tracks), bool)
    for k in np.argsort([-len(track) for track in tracks], kind="stable").tolist():
        track = tracks[k]
        number_wanted = sum(filled[i][cell[i][f]] < quota[i] for i, f in track)
        number_double = sum(fine_cell[i][f] in taken_cells[i] for i, f in track)
        # A track that fills a quota in one photograph only adds no connection; one that lies on a
        # chosen one in one photograph only is another point behind or in front of it.
        if number_wanted < 2 or number_double >= 2:
            continue
        is_chosen[k] = True
        for i, f in track:
            filled[i][cell[i][f]] += 1
            taken_cells[i].add(fine_cell[i][f])
    return is_chosen


def _cells(
    xy: Sequence[Float[np.ndarray, "_ 2"]],
    sizes: Sequence[tuple[int, int]],
    settings: TrackSettings,
) -> tuple[list[Int[np.ndarray, " _"]], list[list[int]], list[tuple[int, int]]]:
    """For every feature its cell of the grid, and that of a fine grid; shape of the grids."""
    cell, fine_cell, shape = [], [], []
    for places, (columns, rows) in zip(xy, sizes):
        side = max(columns, rows) / settings.cells
        nx, ny = (max(1, int(np.ceil(n / side))) for n in (columns, rows))
        column, row = np.clip(places // side, 0, [nx - 1, ny - 1]).astype(int).T
        cell.append(row * nx + column)
        shape.append((nx, ny))
        fine = np.floor(places / (settings.merging_distance * max(columns, rows))).astype(int)
        # Row and column as one number: there are fewer than 100 000 columns.
        fine_cell.append((fine[:, 1] * 100_000 + fine[:, 0]).tolist())
    return cell, fine_cell, shape


def flatten(
    tracks: Sequence[Sequence[tuple[int, int]]],
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Track, photograph and feature of every measurement."""
    track = np.repeat(np.arange(len(tracks)), [len(t) for t in tracks])
    if not len(track):
        return track, track, track
    image, feature = np.array([m for t in tracks for m in t], int).T
    return track, image, feature
