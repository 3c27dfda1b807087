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
from jaxbundle.system import configuration, program_keys, programs
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
    found, export = [], programs.export.export

    def count(function, **options):
        found.append(function.__name__)
        return export(function, **options)

    monkeypatch.setattr(programs.export, "export", count)
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
        return programs._Given(function, args or (1.0,), {}, static).full_key()

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
    monkeypatch.setattr(program_keys, "state_of_package", lambda: ("another version", {}))
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
    file = folder / "one-traced"
    for _ in range(2):
        found = programs._read(file) or programs._trace(
            make, programs._Given(make, (np.ones(3),), {}, None), file
        )
        result = found[1]
        assert result["word"] == "kept" and result["none"] is None and result["number"] == 3
        assert isinstance(result["pose"], PoseValue)


def test_a_number_traced_is_an_array_of_the_same_type_in_every_process(folder):
    for _ in range(2):
        found = compile_once(rotate, ())((0.1, 0.0, 0.0), (0.0, 1.0, 0.0))
        assert all(isinstance(x, jax.Array) and not x.weak_type for x in found)


@pytest.mark.parametrize("damage", ["empty", "half", "zeros", "others may write"])
def test_damaged_programs_are_traced_again_and_replaced(folder, traces, damage):
    arguments = tuple(np.full(3, 0.1)), tuple(RAYS[0])
    expected = compile_once(rotate, ())(*arguments)
    (file,) = folder.glob("*-traced")
    content = bytearray(file.read_bytes())
    half = len(content) // 2
    content[half : half + 100] = bytes(100)
    damaged = {"empty": b"", "half": content[:half], "zeros": content}.get(damage)
    if damaged is None:
        file.chmod(0o666)
    else:
        file.write_bytes(damaged)
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
traced, export = [], programs.export.export
programs.export.export = lambda f, **x: traced.append(f.__name__) or export(f, **x)
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


def test_nothing_from_outside_the_package_is_described():
    class Local(eqx.Module):
        x: jax.Array

    @functools.wraps(rotate)
    def disguised(*x):
        return SCALE * rotate(*x)[0]

    class Dict(dict):
        pass

    class Partial(functools.partial):
        pass

    for x in Local(jnp.ones(2)), disguised, Dict(a=1.0), Partial(rotate, 1.0), object():
        with pytest.raises(program_keys.CannotDescribe):
            program_keys.describe(x, [], None)


SCALE = 1.0


def test_a_changed_package_keeps_nothing(folder, traces, monkeypatch):
    arguments = tuple(np.full(3, 0.1)), tuple(RAYS[0])

    def is_kept():
        compile_once(rotate, ())(*arguments)
        return bool(files(folder))

    with monkeypatch.context() as patch:
        patch.setattr(programs, "LONGEST_UNUSED", -1.0)
        assert not is_kept(), "a constant"
    with monkeypatch.context() as patch:
        patch.setattr(programs, "_is_own", lambda file: True)
        assert not is_kept(), "a function"
    with monkeypatch.context() as patch:
        patch.setattr(program_keys, "IMPORTED", 0)
        program_keys._are_older_than_import.cache_clear()
        assert not is_kept(), "a source"
    program_keys._are_older_than_import.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(program_keys, "ROOT", folder)
        patch.setattr(program_keys, "_list_sources", program_keys._list_sources.__wrapped__)
        program_keys.state_of_package.cache_clear()
        assert not is_kept(), "sources that are not there, as in an archive"
    program_keys.state_of_package.cache_clear()
    monkeypatch.undo()
    monkeypatch.setattr(configuration, "_folders", [str(folder)])
    assert is_kept()


def test_what_cannot_be_kept_runs_all_the_same(folder, traces):
    told = []
    turn = compile_once(tell_and_rotate, 0)
    for _ in range(2):
        turn(told.append, (0.1, 0.0, 0.0), (0.0, 1.0, 0.0))
    jax.effects_barrier()
    assert len(told) == 2 and not files(folder)
    with pytest.raises(IndexError, match="out of range"):
        compile_once(project, 0)(get_model("kannala-brandt"), (1.0,), *RAYS[0])


def tell_and_rotate(tell, angle, x):
    jax.debug.callback(tell, angle[0])
    return rotate(angle, x)


def test_compiled_in_arguments_may_be_given_by_name(folder):
    p = tuple(np.r_[2.0, np.zeros(10)])
    image = compile_once(project, 0)
    expected = image(get_model("brown"), p, *RAYS[0])
    r, s, q = RAYS[0]
    assert image(model=get_model("brown"), p=p, r=r, s=s, q=q) == expected
    assert len(files(folder)) == 1
