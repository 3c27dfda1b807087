"""Declarations are checked before anything is computed: the message names the error."""

import numpy as np
import pytest

from jaxbundle import InputError
from jaxbundle import leastsquares as ls

START, ENDS, RISE = np.array([100.0, 101.0, 103.5]), ([0, 1, 0], [1, 2, 2]), [1.1, 2.4, 3.5]
LEVELLED = ls.Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))


def adjusted(start=START, rows=ENDS, rise=RISE, free=(False, True, True), labels=None, **given):
    table = ls.Table("height", start, free=free, labels=labels)
    return ls.adjust([table], [LEVELLED(rows, rise, **given)])["height"].value


@pytest.mark.parametrize("given, words", [
    (dict(start=[100.0, np.nan, 103.5]), "height 2: a start value is not a finite number"),
    (dict(start=np.ma.array(START, mask=[0, 0, 1])), "height 3: a start value"),
    (dict(start=["100", "101", "103"]), "the start values must be arrays of numbers"),
    (dict(start=101.0), "the values must be arrays of rows"),
    (dict(start=()), "the values must be arrays of rows"),
    (dict(free="yes"), "`free` must be truth values"),
    (dict(free=[[True, False]] * 3), r"`free` must be \[rows, 1\]"),
    (dict(rows=([0, 1, 0],)), "expected rows of 2 tables .height, height., not of 1"),
    (dict(rows=([0, 1, 0.5], [1, 2, 2])), "row numbers or labels, not 0.5"),
    (dict(rows=([0, 1, 3], [1, 2, 2])), "observation 3 touches row 3 of table 'height'"),
    (dict(rows=(["A", "B", "A"], ["B", "C", "D"]), labels="ABC"), "there is no height 'D'"),
    (dict(rise=[1.1, np.nan, 3.5]), "observation 2, levelled difference of height 2 and height 3"),
    (dict(rise=np.ma.array(RISE, mask=[0, 1, 0])), "a measured value is not a finite number"),
    (dict(rise=[1.1, 2.4]), "expected measured values of 3 observations"),
    (dict(rise=3.0), "expected measured values of 3 observations"),
    (dict(sigma=[0.1, -0.1, 0.1]), "sigma of observation 2 is -0.1"),
    (dict(sigma=np.ma.array([0.1] * 3, mask=[1, 0, 0])), "sigma of observation 1 is nan"),
    (dict(sigma=[0.1, 0.1]), "sigma must be one number"),
    (dict(covariance=np.eye(3)), r"covariance must be \[3, 1, 1\]"),
    (dict(covariance=-np.ones((3, 1, 1))), "observation 1 is not positive definite: .* of -1"),
    (dict(rows=([0, 1, 0], [1, 2, 2]), labels="AB"), "expected 3 labels, got 2"),
    (dict(rows=([0, 1, 0], [1, 2, 2]), labels="ABA"), "two rows have the label 'A'"),
    (dict(covariance=np.full((3, 1, 1), np.nan)), "not symmetric or not finite"),
])  # fmt: skip
def test_refused(given, words):
    with pytest.raises(InputError, match=words):
        adjusted(**given)


def test_an_observation_of_a_table_that_is_not_there():
    between = ls.Kind("difference", lambda a, b, dh: b - a - dh, of=("height", "heights"))
    with pytest.raises(InputError, match="difference: there is no table 'heights'; known: height"):
        ls.adjust([ls.Table("height", START)], [between(ENDS, RISE)])


@pytest.mark.parametrize("rows, words", [
    ([], "no row of table 'height' is given"),
    ([3], "no row 3 of table 'height': it has 3"),
    ([-1], "no row -1"),
    (["C", "D"], "there is no height 'D'"),
])  # fmt: skip
def test_datum_rows_that_are_not_there_are_refused(rows, words):
    table = ls.Table("height", START, labels="ABC")
    with pytest.raises(InputError, match=words):
        ls.adjust([table], [LEVELLED(ENDS, RISE)], datum={"height": rows})


def test_datum_rows_are_numbers_labels_or_a_mask():
    table, mean = ls.Table("height", START, labels="ABC"), START[[0, 2]].mean()
    for rows in ([0, 2], ["A", "C"], np.array([True, False, True])):
        found = ls.adjust([table], [LEVELLED(ENDS, RISE)], datum={"height": rows})["height"].value
        assert found[[0, 2]].mean() == pytest.approx(mean, abs=1e-12)


def test_whole_numbers_of_a_data_frame_are_rows_and_not_labels():
    columns = [np.array(rows, dtype=object) for rows in ENDS]
    np.testing.assert_array_equal(adjusted(rows=columns), adjusted())


def test_lists_labels_and_what_is_left_out():
    """The second difference, masked and of no weight, says nothing: the first and third remain."""
    rise = np.ma.array(RISE, mask=[0, 1, 0])
    labelled = dict(rows=(["A", "B", "A"], ["B", "C", "C"]), labels=list("ABC"))
    found = adjusted(list(START), rise=rise, sigma=[0.1, np.inf, 0.1], **labelled)
    np.testing.assert_allclose(found, [100.0, 101.1, 103.5], atol=1e-12)
    assert adjusted(sigma=[[0.1], [0.2], [0.1]])[0] == 100.0
