"""The next photograph of a rig: what it says is what follows when it is taken."""

import dataclasses

import numpy as np
import pytest
import rig_scenes as scenes

import jaxbundle
from jaxbundle.calibration.rig.next_view import NextViewSettings, _sigma_with, next_view

OPTIONS = {
    "cross_validation": False, "correlated": False, "free": scenes.FREE, "snooping": None,
    "sigma_image": 0.05,
}  # fmt: skip


def test_sigma_with_one_more_view_by_dense_algebra():
    """The normal matrix of all, with the pose of the board among the unknowns."""
    random = np.random.default_rng(3)
    J, J_pose, L = random.normal(size=(40, 9)), random.normal(size=(40, 6)), np.eye(9)
    L += 0.3 * random.normal(size=(9, 9))
    C, own = L @ L.T, np.arange(3, 6)
    N = np.block([
        [np.linalg.inv(C) + J.T @ J, J.T @ J_pose], [J_pose.T @ J, J_pose.T @ J_pose]
    ])  # fmt: skip
    whole = np.linalg.inv(N)[np.ix_(own, own)]
    assert np.isclose(_sigma_with(C, J, J_pose, own) ** 2, np.linalg.eigvalsh(whole)[-1])


@pytest.mark.further
def test_the_photograph_that_is_advised_does_what_is_said():
    """Two cameras of the row of cameras; the board is put there, photographed, and all is adjusted
    again: σ is the one that was said, and smaller than with the median of other places."""
    made = scenes.chain(2, epochs=8)
    pair = {name: made[name] for name in ("c0", "c1")}
    rig = jaxbundle.calibrate_rig(pair, **OPTIONS)
    view = rig.next_view("c1")
    assert set(view.seen_by) == {"c0", "c1"} and view.after < 0.95 * view.before
    assert np.isclose(view.before, rig.mountings["c1"].weakest[0])
    assert f"({view.pixel[0]:.0f}, {view.pixel[1]:.0f})" in rig.advice[-1]
    few = next_view(rig, "c1", NextViewSettings(number=12, seed=1))
    assert few.after > view.after * 0.999

    random, more = np.random.default_rng(9), {}
    for name, views in pair.items():
        k = list(scenes.CHAIN).index(name)
        middle = scenes.matrix(np.eye(3), -scenes.BOARD.points.mean(0))
        pose = scenes.CHAIN[name] @ view.pose @ middle
        xy = scenes.image(scenes.LENSES[k], pose, scenes.BOARD, random, 0.05)
        more[name] = dataclasses.replace(
            views,
            names=(*views.names, f"{name}_900.png"),
            xy=np.concatenate([views.xy, xy[None]]),
            photographs=(),
        )
    again = jaxbundle.calibrate_rig(more, **OPTIONS)
    said = again.mountings["c1"].weakest[0] / again.sigma0 * rig.sigma0
    assert abs(said / view.after - 1) < 0.1
