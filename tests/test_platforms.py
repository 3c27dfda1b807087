"""Windows and macOS as far as Linux imitates them: what they lack is missing, what they have stands
in."""

import ctypes
import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxbundle.cli import app
from jaxbundle.errors import InputError
from jaxbundle.io.writing import locks
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.system import cores, memory, temporaries

ROOT = Path(__file__).parents[1]
POSIX_ONLY = ("fcntl", "resource", "termios", "pwd", "grp", "posix", "tty", "pty")
IMPORTS = """
import importlib, os, pkgutil, signal, sys
for name in {missing!r}:
    sys.modules[name] = None
for name in ("SIGHUP", "SIGPIPE", "SIGALRM", "SIGKILL", "SIGUSR1"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in ("fork", "forkpty", "sched_getaffinity", "getuid", "geteuid", "killpg", "statvfs"):
    delattr(os, name)
import jaxbundle
rooms = [m.name for m in pkgutil.walk_packages(jaxbundle.__path__, "jaxbundle.")
         if not m.name.endswith("__main__")]
for name in rooms:
    importlib.import_module(name)
print(len(rooms), jaxbundle.system.cores.available_cores() == os.cpu_count())
"""


@pytest.mark.further
def test_every_module_imports_without_what_only_posix_has():
    """The machine's own packages (posix of os) stay; those of the package do without."""
    missing = [name for name in POSIX_ONLY if name not in ("posix", "pwd", "grp")]
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS.format(missing=missing)], capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    number, cores_known = done.stdout.split()
    assert int(number) > 500 and cores_known == "True"


def test_posix_modules_are_imported_inside_functions_only():
    """So that importing never needs them; each has its alternative in the same function."""
    for path in (ROOT / "jaxbundle").rglob("*.py"):
        for line in path.read_text(encoding="utf-8").splitlines():
            words = line.split()
            if words[:1] == ["import"] and words[1].rstrip(",") in POSIX_ONLY:
                assert line.startswith(" "), f"{path}: {line}"
            assert "os.fork(" not in line and "os.getuid(" not in line, f"{path}: {line}"
            assert "preexec_fn" not in line and '"/tmp' not in line, f"{path}: {line}"


def test_text_is_read_and_written_in_utf8():
    """The default of Windows is a code page: every text names its encoding. (`memory.py` reads
    /proc, which is ASCII.)"""
    for path in (ROOT / "jaxbundle").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name != "memory.py":
            assert ".read_text()" not in text, path
        for line in text.splitlines():
            if ' open(' in line and ('"r")' in line or '"w")' in line):
                raise AssertionError(f"{path}: {line}")


class WindowsLocks:
    """The locks of msvcrt on Linux: a byte of a file that one opener has; a locked file cannot be
    removed."""

    LK_NBLCK = 2

    def __init__(self):
        self.held: dict[tuple, int] = {}

    def locking(self, descriptor, mode, size):
        assert (mode, size) == (self.LK_NBLCK, 1)
        self.held = {key: fd for key, fd in self.held.items() if is_open(fd, key)}
        status = os.fstat(descriptor)
        key = status.st_dev, status.st_ino
        if self.held.get(key, descriptor) != descriptor:
            raise OSError(errno.EACCES, "Permission denied")
        self.held[key] = descriptor

    def is_held(self, path) -> bool:
        status = os.stat(path)
        key = status.st_dev, status.st_ino
        return key in self.held and is_open(self.held[key], key)


def is_open(descriptor, key) -> bool:
    try:
        status = os.fstat(descriptor)
    except OSError:
        return False
    return (status.st_dev, status.st_ino) == key


@pytest.fixture
def windows(monkeypatch):
    """Locks of Windows, and files that cannot be removed while they are locked."""
    imitated = WindowsLocks()
    monkeypatch.setattr(locks, "USES_MSVCRT", True)
    monkeypatch.setitem(sys.modules, "msvcrt", imitated)
    monkeypatch.setitem(sys.modules, "fcntl", None)
    unlink = os.unlink

    def refuse(path, **options):
        if os.path.exists(path) and imitated.is_held(path):
            raise PermissionError(errno.EACCES, "The process cannot access the file", str(path))
        unlink(path, **options)

    monkeypatch.setattr(os, "unlink", refuse)
    return imitated


def test_locks_of_windows_exclude_each_other_and_leave_no_file(windows, tmp_path):
    file = tmp_path / "results.jsonl"
    with locks.hold_lock(file):
        assert windows.is_held(tmp_path / ".results.jsonl.lock")
        with pytest.raises(InputError, match="another run is writing it"), locks.hold_lock(file):
            pass
        with locks.hold_lock(tmp_path / "other.jsonl"):
            pass
    assert [*tmp_path.iterdir()] == []
    with locks.hold_lock(file):  # again
        pass


def test_a_folder_is_replaced_with_locks_of_windows(windows, tmp_path):
    """And its work folder goes, in which the lock was."""
    out = tmp_path / "out"
    for text in ("first", "second"):
        with replace_folder(out, "adjust", ("a.txt",)) as new:
            (new / "a.txt").write_text(text)
        assert (out / "a.txt").read_text() == text
        assert [p.name for p in tmp_path.iterdir()] == ["out"]


CHANNEL = """
import os, signal, sys, threading, time
from jaxbundle.system import interrupts
interrupts.SOCKETS = True
interrupts.handle_interrupts()
threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
while True:       # the main thread in C, as in XLA: it runs no Python for long
    pow(3, 3 ** 16, 10 ** 400000) if len(sys.argv) > 1 else time.sleep(0.01)
"""


@pytest.mark.parametrize("busy", [[], pytest.param(["busy"], marks=pytest.mark.further)])
def test_signals_come_through_sockets_as_on_windows(tmp_path, busy):
    done = subprocess.run(
        [sys.executable, "-c", CHANNEL, *busy], capture_output=True, text=True, timeout=60,
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 130 and done.stderr == "jaxbundle: interrupted\n"


def test_cores_without_affinity(monkeypatch):
    """macOS and Windows do not have it."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert cores.available_cores() == os.cpu_count()
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert cores.available_cores() == 1


def test_memory_of_windows_and_of_macos(monkeypatch):
    def answer(pointer):
        status = ctypes.cast(pointer, ctypes.POINTER(memory.MemoryStatus)).contents
        assert status.length == ctypes.sizeof(memory.MemoryStatus) == 64
        status.available = 5 * 2**30
        return 1

    kernel = SimpleNamespace(GlobalMemoryStatusEx=answer)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "platform", "win32")
        patch.setattr(memory.ctypes, "windll", SimpleNamespace(kernel32=kernel), raising=False)
        patch.setattr(memory.ctypes, "byref", ctypes.pointer)
        patch.setattr(memory, "_read_text", lambda _: "")
        patch.setitem(sys.modules, "resource", None)
        assert memory.free_memory() == 5 * 2**30
        kernel.GlobalMemoryStatusEx = lambda _: 0
        assert memory.free_memory() == float("inf")
    with monkeypatch.context() as patch:  # macOS: no /proc, pages of the whole machine
        patch.setattr(memory, "_read_text", lambda _: "")
        pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        assert memory.free_memory() == pages / 2


def test_a_closed_pipe_of_windows_is_no_error_of_the_input(monkeypatch):
    error = OSError(errno.EINVAL, "Invalid argument")
    assert not app.is_closed_pipe(error)
    monkeypatch.setattr(sys, "platform", "win32")
    assert app.is_closed_pipe(error)
    assert not app.is_closed_pipe(OSError(errno.EINVAL, "Invalid argument", "a.txt"))


def test_compiled_programs_are_kept_in_the_folder_of_the_system(monkeypatch, tmp_path):
    import jax

    from jaxbundle.system import kept_programs

    kept = {}
    monkeypatch.setattr(jax.config, "update", lambda name, value: kept.update({name: value}))
    monkeypatch.setattr(kept_programs, "watch_cache", lambda _: None)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "AppData"))
    kept_programs.keep_programs()
    assert kept["jax_compilation_cache_dir"] == str(tmp_path / "AppData" / "jaxbundle")


def test_open_files_of_a_cache_are_known_on_linux_only(monkeypatch, tmp_path):
    monkeypatch.setattr(os.path, "isdir", lambda _: False)
    temporaries._remove_open_files({str(tmp_path)})  # no /proc: nothing is removed, nothing fails
