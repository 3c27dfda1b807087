"""The written network of a result, adjusted again: the same values, σ and σ0."""

import json
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle import Camera, grid_of_targets, ring_of_stations, simulate
from jaxbundle.cli.outputs import write_targets
from jaxbundle.io import read_network

CAMERA = Camera("cam", "brown", {"c": 24.0, "K1": 1e-5}, free=("c", "x0", "K1"),
                sigma={"c": 0.01, "x0": 0.02})  # fmt: skip


@pytest.fixture(scope="module")
def georeferenced():
    """Observed positions and attitudes, priors of the camera, weighted, planimetric and fixed
    control, a check point, a distance."""
    network = simulate(ring_of_stations(4, 2.5, 6.0), grid_of_targets(4, 4, 0.5), CAMERA,
                       noise=0.002, seed=3)  # fmt: skip
    rng = np.random.default_rng(5)
    images, points, rays = network.images, network.points, network.observations
    roles = np.full(len(points), "tie", dtype=object)
    roles[[0, 3, 12, 6, 9]] = "control", "control", "control", "fixed", "check"
    sigma = np.full((len(points), 3), np.nan)
    sigma[[0, 3, 12]] = [[0.01, 0.01, 0.02], [0.01, 0.01, np.inf], [0.02, 0.02, 0.02]]
    X = points.position + 0.01 * rng.standard_normal(points.position.shape)
    exterior = np.full((4, 6), np.nan)
    exterior[1, :3], exterior[2] = 0.02, [0.05] * 3 + [0.01] * 3
    start = images.position + 0.02 * rng.standard_normal((4, 3))
    names = [points.id[k] for k in (1, 5)]
    length = float(np.linalg.norm(points.position[1] - points.position[5]))
    moved = images.position + [0.3, -0.2, 1.5] + 0.05 * rng.standard_normal((4, 3))
    attitudes = {"image": list(images.id)}
    attitudes |= {a: images.angles[:, k] + 0.002 for k, a in enumerate(("omega", "phi", "kappa"))}
    attitudes |= dict.fromkeys(("somega", "sphi", "skappa"), [0.005] * 4)
    antennas = {"image": list(images.id), **dict(zip("XYZ", moved.T)),
                **dict.fromkeys(("sX", "sY", "sZ"), [0.05] * 4)}  # fmt: skip
    return jaxbundle.adjust(jaxbundle.make_network(
        [CAMERA],
        {"id": list(images.id), "camera": ["cam"] * 4, **dict(zip(("X0", "Y0", "Z0"), start.T)),
         **dict(zip(("omega", "phi", "kappa"), images.angles.T)),
         **dict(zip(("sX0", "sY0", "sZ0", "somega", "sphi", "skappa"), exterior.T))},
        {"id": list(points.id), "role": list(roles), **dict(zip("XYZ", X.T)),
         **{f"s{a}": ["free" if np.isinf(s) else s for s in sigma[:, k]]
            for k, a in enumerate("XYZ")}},
        {"image": [images.id[i] for i in rays.image], "point": [points.id[p] for p in rays.point],
         "x": rays.xy[:, 0], "y": rays.xy[:, 1],
         **dict.fromkeys(("sx", "sy"), np.full(len(rays), 0.002))},
        {"from": [names[0]], "to": [names[1]], "value": [length], "sigma": [0.001]},
        antennas=antennas, antenna={"free": ["shift"], "sigma": {"shift": 10.0}},
        attitudes=attitudes,
    ))  # fmt: skip


@pytest.mark.further
def test_another_process_finds_the_same_result(georeferenced, tmp_path):
    first = georeferenced
    assert first.converged
    write_targets(first, "", tmp_path / "out", brief=True, plots=False)
    done = subprocess.run(
        [sys.executable, "-m", "jaxbundle", "adjust", tmp_path / "out" / "network", "--json",
         tmp_path / "again.json", "--quiet"], capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    before = json.loads((tmp_path / "out" / "result.json").read_text())
    after = json.loads((tmp_path / "again.json").read_text())
    for name in ("redundancy", "unknowns", "datum", "defect", "observations"):
        assert after[name] == before[name], name
    assert after["sigma0"] == pytest.approx(before["sigma0"], rel=1e-9)
    pairs = [(before["cameras"]["cam"]["parameters"][n], after["cameras"]["cam"]["parameters"][n])
             for n in CAMERA.free]  # fmt: skip
    for kind in ("images", "points"):
        shared = before[kind].keys() & after[kind].keys()
        assert len(shared) == len(before[kind])
        pairs += [(before[kind][id][n], after[kind][id][n]) for id in shared
                  for n in before[kind][id] if isinstance(before[kind][id][n], dict)]  # fmt: skip
    pairs += [(row[n], after["further_unknowns"][table][id][n])
              for table, rows in before["further_unknowns"].items() for id, row in rows.items()
              for n in row]  # fmt: skip
    assert len(pairs) > 50
    for one, other in pairs:
        assert other["value"] == pytest.approx(one["value"], abs=1e-6, rel=1e-6)
        if one["sigma"] is not None:
            assert other["sigma"] == pytest.approx(one["sigma"], rel=1e-5, abs=1e-12)


@pytest.mark.further
def test_removed_observations_stay_out(georeferenced, tmp_path):
    network = georeferenced.network
    (antennas, *others) = network.further
    position = antennas.position.copy()
    position[2] += [3.0, -2.0, 0.0]
    spoilt = jaxbundle.adjust(
        network.replace(further=(type(antennas)(**{**vars(antennas), "position": position}),
                                 *others)), snooping="pope",
    )  # fmt: skip
    assert any("antenna" in removed.kind for removed in spoilt.removed)
    write_targets(spoilt, "", tmp_path / "out", brief=True, plots=False)
    again = jaxbundle.adjust(read_network(tmp_path / "out"))
    assert network.images.id[2] not in next(
        one for one in again.network.further if one.TABLE == "antennas").image  # fmt: skip
    assert again.redundancy == spoilt.redundancy
    assert_allclose(again.sigma0, spoilt.sigma0, rtol=1e-8)
    assert_allclose(again.image_values, spoilt.image_values, atol=1e-7)


@pytest.mark.further
@pytest.mark.parametrize("table, text, said", [
    ("exterior_priors", "image,X0,Y0,Z0,omega,phi,kappa,sX0,sY0,sZ0,somega,sphi,skappa\n"
     "1,1,,,,,,,,,,,\n", "X0 and sX0: give both or neither"),
])  # fmt: skip
def test_bad_rows_are_named(georeferenced, tmp_path, table, text, said):
    write_targets(georeferenced, "", tmp_path / "out", brief=True, plots=False)
    (tmp_path / "out" / "network" / f"{table}.csv").write_text(text)
    with pytest.raises(jaxbundle.InputError, match=f"{table}.csv.*{said}"):
        jaxbundle.adjust(read_network(tmp_path / "out"))
