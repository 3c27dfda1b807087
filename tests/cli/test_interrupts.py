"""An interrupt of the command line: one line, its status, nothing half-written, at any moment.

The processes here import no JAX: their work stands for that of JAX at such a moment.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxbundle import cli

BEGIN = """
import gc, hashlib, os, signal, sys, threading
from jaxbundle.system.interrupts import advise, handle_interrupts, set_status
from jaxbundle.system.temporaries import temporary, defer_interrupts, watch_cache
interrupt = lambda number=signal.SIGINT: signal.raise_signal(number)
"""
STARTED = BEGIN + "handle_interrupts()\n"

# What swallows the exception that Python's own handler raises there, and goes on.
SWALLOWED = {
    "a callback of the garbage collector": """
gc.callbacks.append(lambda *_: interrupt())
gc.collect()
""",
    "a destructor": """
class Held:
    def __del__(self):
        interrupt()
Held()
""",
    "an import that something else can stand in for": """
open("numbers_.py", "w").write("import signal; signal.raise_signal(signal.SIGINT)")
sys.path.insert(0, ".")
try:
    import numbers_
except BaseException:
    numbers_ = None
""",
    "the last moments of a program": """
import atexit
atexit.register(print, "it goes on")
atexit.register(interrupt)
sys.exit()
""",
}


def run(code: str, folder: Path, **options):
    return subprocess.run(
        [sys.executable, "-B", "-c", code], cwd=folder, capture_output=True, text=True, timeout=60,
        **options,
    )  # fmt: skip


def check(done, status=130, line="jaxbundle: interrupted\n", said=""):
    assert (done.returncode, done.stderr, done.stdout) == (status, line, said)


@pytest.mark.parametrize("code", SWALLOWED.values(), ids=SWALLOWED)
def test_it_is_not_swallowed(code, tmp_path):
    check(run(STARTED + code + "\nprint('it goes on')", tmp_path))


def test_it_is_handled_before_anything_else_is_imported(tmp_path):
    code = """
import signal, sys
class Interrupting:
    def find_spec(self, name, *_):
        if name.partition(".")[2] not in ("", "__main__", "lazy", "system", "system.interrupts"):
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from jaxbundle.__main__ import main
main()
"""
    check(run(code, tmp_path))


@pytest.mark.parametrize("number, status, word", [
    (signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated"),
    (signal.SIGHUP, 129, "the terminal is gone"),
])  # fmt: skip
def test_each_signal_has_its_status_and_its_word_once(number, status, word, tmp_path):
    code = f"advise('go on')\n[interrupt({int(number)}) for _ in range(3)]"
    check(run(STARTED + code, tmp_path), status, f"jaxbundle: {word}; go on\n")


def test_what_is_half_written_goes_and_what_was_there_stays(tmp_path):
    (tmp_path / "result.json").write_text("old")
    code = """
os.makedirs("out/within")
with temporary("new"), temporary("empty", content=False), temporary(".result.json") as path:
    os.mkdir("empty")
    os.makedirs("new/within")
    open("new/within/table.csv", "w").write("half")
    os.symlink(os.path.abspath("out"), "new/link")
    path.write_text("half")
    assert len(os.listdir()) == 5
    interrupt()
"""
    check(run(STARTED + code, tmp_path))
    assert sorted(os.listdir(tmp_path)) == ["out", "result.json"]
    assert (tmp_path / "result.json").read_text() == "old"
    assert os.listdir(tmp_path / "out") == ["within"]


def test_what_belongs_together_is_done_whole(tmp_path):
    code = """
with defer_interrupts():
    with defer_interrupts():
        open("first", "w").close()
        interrupt()
    open("second", "w").close()
open("third", "w").close()
"""
    check(run(STARTED + code, tmp_path))
    assert sorted(os.listdir(tmp_path)) == ["first", "second"]


def test_what_belongs_together_and_does_not_end_holds_nobody(tmp_path):
    """If a disk does not answer between two renames, the process ends after `LONGEST_DEFERRAL`."""
    code = """
from jaxbundle.system import interrupts
interrupts.LONGEST_DEFERRAL = 0.2
with temporary("half"), defer_interrupts():
    open("half", "w").close()
    interrupt()
    threading.Event().wait(20)
"""
    check(run(STARTED + code, tmp_path))
    assert os.listdir(tmp_path) == []


def test_processes_that_work_for_this_one_end_with_it(tmp_path):
    """Also one that is just starting, and would not look at its closed pipe for a while."""
    (tmp_path / "task.py").write_text("import time\ndef work(n):\n    time.sleep(300)\n")
    code = """
sys.path.insert(0, os.getcwd())
from multiprocessing import active_children
from jaxbundle.system.workers import Workers
import task
def interrupted(tasks):
    yield from tasks
    threading.Timer(0.1, tell).start()
def tell():
    print(*[child.pid for child in active_children()], flush=True)
    interrupt()
if __name__ == "__main__":
    with Workers(task.work, 2) as workers:
        list(workers.run(interrupted([1, 2])))
"""
    (tmp_path / "main.py").write_text(STARTED + code)
    done = subprocess.run([sys.executable, "-B", "main.py"], cwd=tmp_path, capture_output=True,
                          text=True, timeout=60)  # fmt: skip
    assert (done.returncode, done.stderr) == (130, "jaxbundle: interrupted\n")
    numbers = [int(number) for number in done.stdout.split()]
    # its pipes, which `run` read to their end, are closed: they have ended
    assert len(numbers) == 2 and not any(is_running(number) for number in numbers)


def is_running(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{number}/stat")  # one that nobody has waited for
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] not in "ZX"


def test_the_line_is_said_while_a_library_is_silenced(tmp_path):
    check(run(STARTED + "os.dup2(os.open(os.devnull, os.O_WRONLY), 2)\ninterrupt()", tmp_path))


def test_work_in_c_does_not_hold_it_up(tmp_path):
    """A hash that takes minutes and knows no interrupts, as a compilation of XLA."""
    code = """
threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
with temporary("half"):
    open("half", "w").close()
    hashlib.pbkdf2_hmac("sha512", b"", b"", 1_000_000_000)
"""
    check(run(STARTED + code, tmp_path))
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="no /proc/self/fd")
def test_a_program_kept_in_part_is_removed(tmp_path):
    code = """
os.mkdir("cache")
watch_cache("cache")
whole, half, other = (open(name, "w") for name in ("cache/whole", "cache/half", "other"))
whole.close()
interrupt()
"""
    check(run(STARTED + code, tmp_path))
    assert os.listdir(tmp_path / "cache") == ["whole"] and (tmp_path / "other").exists()


def test_in_a_program_it_is_pythons_own(tmp_path):
    code = """
import jaxbundle
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
try:
    with defer_interrupts(), temporary(".result.json") as path:
        path.write_text("half")
        interrupt()
except KeyboardInterrupt:
    assert os.listdir() == []
    print("caught")
"""
    check(run(BEGIN + code, tmp_path), 0, "", "caught\n")


def test_what_is_ignored_stays_ignored(tmp_path):
    code = """
signal.signal(signal.SIGINT, signal.SIG_IGN)
handle_interrupts()
interrupt()
set_status(3)
print("to the end")
"""
    check(run(BEGIN + code, tmp_path), 3, "", "to the end\n")


def test_closed_streams_are_not_taken_for_files(tmp_path):
    code = STARTED + "file = open('result', 'w'); print('said'); file.flush(); interrupt()"
    command = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "-", sys.executable, "-c", code]
    assert subprocess.run(command, cwd=tmp_path, timeout=60).returncode == 130
    assert (tmp_path / "result").read_text() == ""


def test_a_reader_that_has_gone_ends_it_quietly(monkeypatch, capfd):
    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr(sys, "argv", ["jaxbundle", "camera", "--help"])
    with open(writer, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert ended.value.code == 141
    assert capfd.readouterr().err == ""
