"""Masked arrays given to functions of scanners and surfaces: no mask is ignored."""

import numpy as np
import pytest
from pushbroom_scenes import orbit, satellite
from rpc_scenes import made_up, places

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.pushbroom import Height, locate_points, rpc
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.rpc.bias import fit_bias
from jaxbundle.pushbroom.rpc.fitting import RpcTable, fit_rpc
from jaxbundle.pushbroom.terrain import make_terrain
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.height_cells import HeightGrid

RPC = made_up()


def masked(values, *place):
    mask = np.zeros(np.shape(values), bool)
    mask[place] = True
    return np.ma.array(values, mask=mask, fill_value=-9999.0)


def test_masked_heights_are_none():
    heights = make_terrain(masked(np.full((4, 4), 5.0), 1, 2), (0, 0), (1e-4, -1e-4), WGS84).heights
    assert np.isnan(heights[1, 2]) and np.isfinite(heights).sum() == 15
    grid = lambda z: HeightGrid(z, np.full((8, 8), 0.1), 0.0, 8.0, 1.0)
    change = jaxbundle.change(grid(masked(np.ones((8, 8)), 3, 4)), grid(np.ones((8, 8)))).change
    assert not change.known[3, 4] and change.known.sum() == 63


def test_masked_rows_are_refused():
    line, sample = np.full((2, 12), 100.0)
    table = RpcTable(*places(RPC, 12), masked(line, 3), sample)
    for fit in (lambda: fit_bias(RPC, table), lambda: fit_rpc(table)):
        with pytest.raises(InputError, match="row 4: the line is not a finite number"):
            fit()
    t = np.arange(-6.0, 11.0)
    P, V = orbit(t)
    with pytest.raises(InputError, match="row 5: the position is not a finite number"):
        position_table(t, masked(P, 4, 1), V)
    with pytest.raises(InputError, match="row 5: the attitude is not a finite number"):
        attitude_table(t, masked(np.zeros((17, 3)), 4, 1), method="linear")
    image = satellite()
    for call in (
        lambda: rpc.project_points(RPC, *places(RPC, 12)[:2], masked(line, 0)),
        lambda: rpc.locate_points(RPC, masked(line, 0), sample, sample),
        lambda: rpc.locate_points_on(RPC, Height(0.0), masked(line, 0), sample),
        lambda: locate_points(image, Height(0.0), masked(line, 0), sample),
        lambda: Cloud(masked(np.ones((2, 3)), 0, 0), np.zeros((2, 3, 3)), np.ones(2, int),
                      np.zeros(2, int), np.zeros((2, 2)), ("a",)),
    ):  # fmt: skip
        with pytest.raises(InputError, match="masked"):
            call()
