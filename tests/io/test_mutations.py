"""Whatever is done to a file, reading it ends in a result or in one line that names the file.

20 damaged copies of the input of every reader here, 300 in `make test-all`; more, in processes that
may be killed: `make mutations` (`tests/mutate_inputs.py`). Seeded: a case is (reader, number).
"""

import resource
import signal
import zlib
from functools import cache

import numpy as np
import pytest
from mutations import mutate_folder
from readers import READERS

from jaxbundle.errors import InputError

SEED = 37
SECONDS, MEMORY = 20.0, 1.5e9
"""Of a case: a sample has kilobytes, and is read in milliseconds."""


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """The function that gives a folder with the valid input of a reader."""

    @cache
    def made(name):
        folder = tmp_path_factory.mktemp("valid")
        READERS[name].make(folder)
        return folder

    return made


@pytest.fixture
def bounded():
    """Limits of time and memory; a test that allocates more gets a MemoryError."""
    pages = int(open("/proc/self/statm").read().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = int(pages * resource.getpagesize() + MEMORY)

    def late(*_):
        raise TimeoutError(f"more than {SECONDS} s")

    handler = signal.signal(signal.SIGALRM, late)
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, handler)


def rng_of(name: str, number: int, seed: int = SEED) -> np.random.Generator:
    """The random numbers of a case."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), number])


def check_case(name: str, folder, valid, number: int, seed: int = SEED) -> str:
    """Damage and read; returns what was done and how it ended."""
    done = mutate_folder(valid, folder, rng_of(name, number, seed))
    try:
        READERS[name].read(folder)
    except InputError as error:
        said = str(error)
        assert len(said.splitlines()) == 1 and len(said) < 1500, said
        assert str(folder) in said, f"no file is named: {said}"
        assert "too large for the memory" not in said, said
        return f"{done}: refused: {said}"
    return f"{done}: read"


def check_some(name, valid, folder, numbers):
    for number in numbers:
        copy = folder / str(number)
        copy.mkdir()
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            check_case(name, copy, valid(name), number)
        except Exception as error:
            done = mutate_folder(valid(name), folder / "again", rng_of(name, number))
            raise AssertionError(f"reader {name!r}, case {number}: {done}") from error
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)


@pytest.mark.parametrize("name", READERS)
def test_a_valid_input_is_read(name, valid):
    READERS[name].read(valid(name))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_input_is_read_or_refused(name, valid, tmp_path, bounded):
    check_some(name, valid, tmp_path, range(20))


@pytest.mark.further
@pytest.mark.parametrize("name", READERS)
@pytest.mark.filterwarnings("ignore")
def test_many_damaged_inputs_are_read_or_refused(name, valid, tmp_path, bounded):
    check_some(name, valid, tmp_path, range(20, 300))
