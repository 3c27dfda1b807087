"""Start values that are missing, misspelt or impossible are refused with the remedy."""

import numpy as np
import pytest

from jaxbundle.cameras import MODEL_NAMES, check_parameters, default_parameters, get_model

DEFAULTS = {
    "bingo": {"format_factor": 1.0}, "fov": {"omega": 0.9}, "eucm": {"alpha": 0.5, "beta": 1.0},
    "double-sphere": {"alpha": 0.5}, "mei": {"xi": 1.0}, "scaramuzza": {"c": 1.0},
}  # fmt: skip
"""What a model says where nothing is said, if it is not 0."""


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_defaults_leave_the_principal_distance_open(name):
    model = get_model(name)
    defaults = default_parameters(model)
    assert set(model.parameters) - set(defaults) == set(model.principal_distance)
    assert set(model.never_free) < set(model.parameters)
    assert {k: v for k, v in defaults.items() if v} == DEFAULTS.get(name, {})
    check_parameters(model, {**defaults, **dict.fromkeys(model.principal_distance, 1)})


@pytest.mark.parametrize(
    ("model", "given", "message"),
    [
        ("brown", dict(c=20.0, k1=1e-4), "no parameter 'k1': did you mean 'K1'.*c, x0, y0, K1"),
        ("brown", dict(c=20.0, zoom=2), "no parameter 'zoom'. Its parameters are c, x0"),
        ("brown", dict(c=20.0, K1=np.nan), "K1 must be a finite number, but is nan"),
        ("brown", dict(c=20.0, K1="1e-4"), "K1 must be a finite number, but is '1e-4'"),
        ("brown", dict(c=20.0, K1=True), "K1 must be a finite number, but is True"),
        ("brown", dict(c=np.ma.masked), "c must be a finite number, but is masked"),
        ("brown", dict(K1=1e-4), "c is missing; give the principal distance in mm"),
        ("brown", dict(c=0.0), "c must be positive, but is 0.0"),
        ("opencv", dict(fx=500.0, fy=-500.0), "fy must be positive, but is -500.0"),
        ("bingo", dict(c=125.0, format_factor=0), "format_factor must be positive, but is 0"),
        ("eucm", dict(fx=1, fy=1, alpha=1.0), "alpha must be at least 0 and below 1, but is 1.0"),
        ("mei", dict(fx=1, fy=1, xi=-0.1), "xi must be at least 0, but is -0.1"),
    ],
)
def test_what_is_refused(model, given, message):
    with pytest.raises(ValueError, match=message):
        check_parameters(get_model(model), given)


def test_numbers_of_numpy_are_numbers():
    check_parameters(get_model("brown"), dict(c=np.float32(20), K1=np.float64(1e-4), x0=0))
