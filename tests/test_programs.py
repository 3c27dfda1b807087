"""Programs kept for later processes: traced once, found again only if nothing has changed."""

import dataclasses
import functools
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.cameras import project
from jaxbundle.cameras.catalogue import get_model
from jaxbundle.leastsquares.spaces import PoseValue, Vector
from jaxbundle.leastsquares.spaces import turn_by as rotate
from jaxbundle.system import configuration, programs
from jaxbundle.system.programs import compile_once

RAYS = np.array([[0.1, 0.2, -1.0], [-0.3, 0.1, -1.0]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of kept programs, for this test only."""
    monkeypatch.setattr(configuration, "_folders", [str(tmp_path)])
    return tmp_path


@pytest.fixture
def traces(monkeypatch):
    """The names of the functions traced, in order."""
    found, trace = [], programs._trace

    def count(function, *rest):
        found.append(function.__name__)
        return trace(function, *rest)

    monkeypatch.setattr(programs, "_trace", count)
    return found


def files(folder):
    return sorted(file.name for file in folder.glob("*-traced"))


def test_a_later_process_reads_what_an_earlier_one_traced(folder, traces):
    model, p = get_model("brown"), (2.0, *np.zeros(10))
    expected = np.array([project(model, p, *ray) for ray in RAYS])
    for _ in range(2):  # a new wrapper knows no program, like a new process
        image = compile_once(project, 0)
        found = np.transpose([image(model, p, *ray) for ray in RAYS])
        np.testing.assert_allclose(found.T, expected, rtol=1e-15)
    assert traces == ["project"] and len(files(folder)) == 1


def test_other_shapes_types_and_compiled_in_values_are_other_programs(folder, traces):
    turn = compile_once(rotate, ())
    small = tuple(np.full(3, 0.1))
    turn(small, tuple(RAYS[0]))
    turn(tuple(np.full(3, 0.2)), tuple(RAYS[1]))  # the same program
    turn(tuple(np.full(3, 0.1, np.float32)), tuple(RAYS[0]))
    turn(small, tuple(RAYS.T))
    image = compile_once(project, 0)
    for name, size in ("brown", 11), ("snavely", 3):
        image(get_model(name), tuple(np.ones(size)), *RAYS[0])
    assert traces == ["turn_by"] * 3 + ["project"] * 2


def test_everything_a_key_depends_on_changes_it(monkeypatch):
    def key(function=rotate, *args, static=()):
        return programs._Given(args or (1.0,), {}, static).key_for(function)

    column = Vector(3, (0,))
    others = [
        key(), key(project), key(rotate, np.ones(2)), key(rotate, column, static=(0,)),
        key(rotate, dataclasses.replace(column, columns=(1,)), static=(0,)),
        key(rotate, functools.partial(rotate, 2), static=(0,)),
        key(rotate, functools.partial(rotate, 3), static=(0,)),
        key(rotate, get_model("opencv"), static=(0,)), key(rotate, 2.0, static=(0,)),
        key(rotate, PoseValue(np.ones(3), np.ones(4))), key(rotate, {"a": 1.0}),
        key(rotate, np.ones(3), static=(0,)), key(rotate, np.zeros(3), static=(0,)),
    ]  # fmt: skip
    with jax.numpy_dtype_promotion("strict"):
        others.append(key())
    monkeypatch.setattr(programs, "_state_of_package", lambda: "another version")
    others.append(key())
    assert len(set(others)) == len(others)
    monkeypatch.undo()
    assert key(rotate, 1.0) == key(rotate, 2.0), "a traced number is no part of a key"


def test_functions_from_outside_the_package_are_traced_as_usual(folder, traces):
    own = compile_once(lambda function, x: function(x), 0)
    assert float(own(lambda x: 2 * x, 3.0)) == 6.0
    assert float(own(lambda x: 5 * x, 3.0)) == 15.0
    assert not traces and not files(folder)


def test_derivatives_and_batches_go_through(folder, traces):
    turn = compile_once(rotate, ())
    along = lambda s: turn((s, 0.0, 0.0), (0.0, 1.0, 0.0))[2]
    np.testing.assert_allclose(jax.grad(along)(0.1), np.cos(0.1), rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(along)(jnp.array([0.1, 0.2])), np.sin([0.1, 0.2]))
    assert not traces


def test_results_keep_their_structure(folder):
    make = lambda x: {"pose": PoseValue(x, 2 * x), "word": "kept", "none": None, "number": 3}
    for _ in range(2):
        program = programs._Program(*trace_of(make, folder), {})
        found = program([np.ones(3)])
        assert found["word"] == "kept" and found["none"] is None and found["number"] == 3
        np.testing.assert_array_equal(found["pose"].rotation, [2, 2, 2])


def trace_of(function, folder):
    file = folder / "one-traced"
    return programs._read(file) or programs._trace(
        function, programs._Given((np.ones(3),), {}, None), file
    )


@pytest.mark.parametrize("damage", [b"", b"damaged", None])
def test_damaged_programs_are_traced_again_and_replaced(folder, traces, damage):
    arguments = tuple(np.full(3, 0.1)), tuple(RAYS[0])
    expected = compile_once(rotate, ())(*arguments)
    (file,) = folder.glob("*-traced")
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2] if damage is None else damage)
    assert compile_once(rotate, ())(*arguments) == expected
    assert programs._read(file) is not None and traces == ["turn_by"] * 2


def test_nothing_is_left_where_nothing_can_be_written(folder, traces, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    assert compile_once(rotate, ())(tuple(np.zeros(3)), tuple(RAYS[0])) == tuple(RAYS[0])
    assert traces and not list(folder.iterdir())


ADJUST = """
import sys, jaxbundle
from jaxbundle.system import programs
jaxbundle.enable_x64(compile_quickly=True)
jaxbundle.keep_programs(sys.argv[1])
traced, trace = [], programs._trace
programs._trace = lambda *x: traced.append(x[0].__name__) or trace(*x)
told = []
result = jaxbundle.adjust(jaxbundle.read_network(sys.argv[2]), progress=lambda *x: told.append(x))
result.table("residuals")
print(len(traced), len(told) - result.iterations, repr(result.sigma0))
print(result.cameras)
"""


def test_a_second_process_traces_nothing_and_finds_the_same(tmp_path, convergent4):
    examples = os.path.join(os.path.dirname(os.path.dirname(__file__)), "examples")
    file = os.path.join(examples, "convergent4", "project.toml")
    command = [sys.executable, "-c", ADJUST, str(tmp_path / "programs"), file]
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
        for _ in range(2)
    )
    (traced, told, sigma0), (again, *_) = (x.splitlines()[0].split() for x in (first, second))
    assert int(traced) > 10 and int(again) == 0
    assert int(told) == 1, "progress is called for the start and for every step"
    assert first.split(" ", 1)[1] == second.split(" ", 1)[1]
    np.testing.assert_allclose(float(sigma0), convergent4.sigma0, rtol=1e-9)


def test_classes_from_outside_the_package_are_not_described():
    class Local(eqx.Module):
        x: jax.Array

    given = programs._Given((Local(jnp.ones(2)),), {}, None)
    with pytest.raises(programs._CannotDescribe):
        given.key_for(rotate)
