"""The adjustment of a reconstruction: what is tried again, and what is said at the end."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle import Camera, grid_of_targets, ring_of_stations, simulate
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.reconstruction import adjusting


@pytest.mark.parametrize("first", ["fails", "does not converge"])
def test_without_points_of_three_rays_the_first_attempt_counts(monkeypatch, first):
    camera = Camera("cam", "brown", {"c": 24.0}, free=("c",))
    targets = grid_of_targets(4, 4, 0.5)
    network = simulate(ring_of_stations(4, 2.5, 6.0), targets, camera, noise=0.002)
    attempts = []
    unfinished = adjusting.Weighted(SimpleNamespace(converged=False), {})

    def without_lost(given, *_):
        attempts.append(len(given.observations))
        if len(attempts) == 2:
            raise InputError("images, row 4: image '4': only 1 point can be used")
        if first == "fails":
            raise NotSolvedError("not solved: the first reason")
        return unfinished

    monkeypatch.setattr(adjusting, "_without_lost", without_lost)
    kinds = np.zeros(len(network.observations), int)
    call = lambda: adjusting.adjust_weighted(network, kinds, {0: "all"}, 0.001, print)
    if first == "fails":
        with pytest.raises(NotSolvedError, match="the first reason"):
            call()
    else:
        assert call() is unfinished
    assert len(attempts) == 2


@pytest.mark.parametrize("removed, confirmed", [(4, True), (40, True), (40, False)])
def test_points_of_three_rays_confirm_a_result_with_many_gross_errors(
    monkeypatch, removed, confirmed
):
    camera = Camera("cam", "brown", {"c": 24.0}, free=("c",))
    targets = grid_of_targets(4, 4, 0.5)
    network = simulate(ring_of_stations(4, 2.5, 6.0), targets, camera, noise=0.002)
    result = lambda converged: adjusting.Weighted(
        SimpleNamespace(converged=converged, removed=range(removed), network=network), {}
    )
    results = [result(True), result(confirmed)]
    attempts = iter(results)
    monkeypatch.setattr(adjusting, "_without_lost", lambda *_: next(attempts))
    kinds = np.zeros(len(network.observations), int)
    call = lambda: adjusting.adjust_weighted(network, kinds, {0: "all"}, 0.001, print)
    if confirmed:
        assert call() is results[removed > 16]
    else:
        with pytest.raises(NotSolvedError, match="40 of 64 measurements are gross errors"):
            call()
