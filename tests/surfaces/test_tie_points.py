"""Tie points by matching along epipolar curves: places with σ, and blunders."""

import json

import numpy as np
import pytest
from test_surface_of_strips import ground, strip, view_of, write_strips

from jaxbundle.errors import InputError
from jaxbundle.io.scanner.refinement_points import _join_tables, _without_repeated
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom import tie
from jaxbundle.surfaces.tie_points import (
    TiePoints,
    TiePointSettings,
    _as_high_as_neighbours,
    _near_the_curve,
)

SETTINGS = TiePointSettings()
TOML = """[refine]
[images]
A = "ahead.toml"
B = "back.toml"
[unknowns]
attitude = "free"
"""


@pytest.mark.further
def test_tie_points_are_where_the_ground_is_seen(tmp_path, command):
    write_strips(tmp_path, ("ahead", "back"))
    (tmp_path / "refine.toml").write_text(TOML)
    out = tmp_path / "ties.csv"
    told = command("pushbroom", "tie", tmp_path / "refine.toml", "--out", out, "--spacing", 7,
                   "--zmin", -9, "--zmax", 9, "--json", "-")  # fmt: skip
    assert told.status == 0, told.err
    found, table = json.loads(told.out), read_csv(out)
    n = len(table) // 2
    assert found["points"] == n > 60 and found["rays"] == {"2": n}
    numbers = {name: table.numbers(name) for name in ("pixel", "line", "spixel", "sline")}
    rows = {
        id: np.array([i == id for i in table.values["image"]]) for id in ("A", "B")
    }
    points = np.array(table.values["point"])
    order = [np.flatnonzero(rows[id])[np.argsort(points[rows[id]])] for id in ("A", "B")]
    place = [np.stack([numbers["pixel"][k], numbers["line"][k]], 1) for k in order]
    sigma = [np.stack([numbers["spixel"][k], numbers["sline"][k]], 1) for k in order]
    views = [view_of(strip(0.2 * sign, sign * 1000 * np.tan(0.2))) for sign in (1, -1)]
    h = np.zeros(n)
    for _ in range(20):
        X = views[0].points(place[0], h)
        h = ground(X[:, 0], X[:, 1])
    off = (place[1] - views[1].project(X)) / np.hypot(*sigma)
    # some hundredths of a pixel; σ are those of the scatter beside the epipolar curves
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.8 and np.abs(off).max() < 8
    with pytest.raises(InputError, match="line scanner images need --zmin and --zmax"):
        tie(tmp_path / "refine.toml")
    with pytest.raises(InputError, match="the lower height first"):
        tie(tmp_path / "refine.toml", zmin=3.0, zmax=1.0)
    (tmp_path / "back.tif").unlink()
    with pytest.raises(InputError, match="no raster back.tif"):
        tie(tmp_path / "refine.toml", zmin=0.0, zmax=1.0)


def scattered(n=200):
    rng = np.random.default_rng(2)
    return rng.uniform(0, 5000, (n, 2)), rng


def test_matches_beside_the_curve_are_blunders():
    """About a linear function, which the orientation leaves."""
    uv, rng = scattered()
    off = 1.5 + 2e-4 * uv[:, 0] - 1e-4 * uv[:, 1] + 0.05 * rng.normal(size=200)
    wrong = np.arange(200) % 20 == 3
    off[wrong] += rng.choice([-1, 1], wrong.sum()) * rng.uniform(0.4, 4, wrong.sum())
    good = np.arange(200) % 7 > 0
    kept, rest = _near_the_curve(uv, off, good, SETTINGS)
    assert not kept[wrong].any() and not kept[~good].any()
    assert kept[good & ~wrong].mean() > 0.98
    assert np.isnan(rest[~good]).all() and np.std(rest[kept]) == pytest.approx(0.05, rel=0.15)
    few = np.arange(200) < 5
    assert not _near_the_curve(uv, off, few, SETTINGS)[0].any()


def test_heights_unlike_their_neighbours_are_blunders():
    uv, rng = scattered()
    q = 100 + 30 * np.sin(uv[:, 0] / 900) + rng.normal(size=200)
    wrong = np.arange(200) % 25 == 4
    q[wrong] += 300
    kept = _as_high_as_neighbours(uv, q, np.ones(200, bool), SETTINGS)
    assert not kept[wrong].any() and kept[~wrong].mean() > 0.97


def test_tie_points_as_a_table():
    found = TiePoints(("A", "B", "C"), np.array([0, 1, 0, 2, 1]), np.array([0, 0, 1, 1, 1]),
                      np.arange(10.0).reshape(5, 2), np.full((5, 2), 0.1), np.array([0, 1]),
                      {"why": 3})  # fmt: skip
    table = found.table()
    assert table["image"].tolist() == ["A", "B", "A", "C", "B"]
    # after the corner in the image that it was chosen in
    assert table["point"].tolist() == 2 * ["T:A:0:1"] + 3 * ["T:B:8:9"]
    assert table["line"].tolist() == [0, 2, 4, 6, 8] and table["spixel"][0] == 0.1
    assert found.to_dict()["rays"] == {"2": 1, "3": 1}
    assert "2 tie points, by rays: 1 with 2, 1 with 3" in str(found)


def test_tables_of_several_pairs_are_joined_without_merging_other_points():
    """A corner of A matched in B and, by another call, in C is one point, measured once in A; all
    others are points of their own."""
    sigma = lambda n: np.full((n, 2), 0.1)
    make = lambda names, image, point, xy, base: TiePoints(
        names, np.array(image), np.array(point), np.array(xy, float), sigma(len(image)),
        np.array(base), {},
    )  # fmt: skip
    first = make(("A", "B"), [0, 1, 0, 1], [0, 0, 1, 1], [[8, 9], [7, 9], [3, 4], [2, 4]], [0, 0])
    second = make(("A", "C"), [0, 1, 0, 1], [0, 0, 1, 1], [[8, 9], [6, 5], [5, 5], [4, 1]], [0, 1])
    tables, known = [], set()
    for k, one in enumerate((first, second)):
        columns = {name: list(map(str, values)) for name, values in one.table().items()}
        tables.append(_without_repeated(Columns(columns, Source(f"{k}.csv")), known))
    joined = _join_tables(tables)
    rays = {}
    for image, point in zip(joined.values["image"], joined.values["point"]):
        rays.setdefault(point, []).append(image)
    assert sorted(map(tuple, rays.values())) == [("A", "B"), ("A", "B", "C"), ("A", "C")]
    # rows keep their numbers in messages
    assert joined.source(4) == "observations, row 2 of 1.csv"
