"""The commands and Python blocks of README and docs, and the commands on cameras of every model, as
a reader runs them: `make test-commands`.

    python tests/processes/run.py [--pages README.md brown …] [--seconds S] [--json FILE]

A fresh clone of the repository, with what is changed and known to git, in a temporary folder, with
an environment that has the clone and the packages of this Python, in which nothing but PATH, HOME
and LANG is set. Each command and each Python block is a process of its own, with an empty home;
after all of a page the clone is made clean, and they run again, each with the home that it left:
the first finds no compiled program, the second those of the first. What a reader has, and what
differs from "exit status 0", stands in `own_files.py` and in the tables below. Reported are the
failures, and seconds on the clock and of the processor of both. README comes first, the other pages
in an order that differs from commit to commit, so that runs of limited time reach all of them.
"""

import argparse
import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from camera_models import MODELS, processes_of_model
from documents import ROOT, Process, pages, processes_of

NOT_RUN = {
    "make test": "the tests themselves",
    "pip install": "installs: `make test-oldest` and `make test-newest` do",
    "srun": "needs SLURM",
    "chromium": "needs a browser",
    "--join host": "needs two machines",
    "--join machine0": "needs 16 machines",
}
"""Beginnings or parts of commands, and why they do not run here."""

STATUS = {"docs/howto/mistakes.md": 2, "--max-iterations 2": 3, "explore": 130}
"""Exit statuses other than 0: of all commands of a page, or of commands with these words."""

LONGEST = 1200
"""Seconds of a process. The longest, clocks of two cameras from every frame of their films, had not
ended after 600 in its first run beside two other jobs on a slow machine; its second took 280."""


@dataclass
class Told:
    """What came of a process."""

    name: str
    warm: bool
    status: int | None
    expected: int
    clock: float
    processor: float
    stdout: str = field(repr=False, default="")
    stderr: str = field(repr=False, default="")

    @property
    def failed(self) -> bool:
        return self.status != self.expected or "Traceback" in self.stderr


class Checkout:
    """A clone and an environment in which it is installed as by `pip install -e`."""

    def __init__(self, folder: Path, until: float = math.inf):
        self.until = until  # of time.monotonic(): what runs longer is ended
        self.path, self.homes = folder / "jaxbundle", folder / "homes"
        git = lambda *words: subprocess.run(
            ["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True
        ).stdout.strip()
        self.commit = git("stash", "create") or git("rev-parse", "HEAD")
        subprocess.run(
            ["git", "clone", "--quiet", "--shared", "--no-checkout", ROOT, self.path], check=True
        )
        self.git("checkout", "--quiet", "--detach", self.commit)
        environment = self.path / ".venv"
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
        (packages,) = environment.glob("lib/python*/site-packages")
        installed = [path for path in sys.path if path.endswith("-packages")]
        (packages / "clone.pth").write_text("\n".join([str(self.path), *installed]) + "\n")
        program = environment / "bin" / "jaxbundle"
        program.write_text(
            # As pip writes it: worker processes import it again.
            f"#!{environment / 'bin' / 'python'}\nimport sys\n"
            "from jaxbundle.__main__ import main\nif __name__ == '__main__':\n"
            "    sys.exit(main())\n"
        )
        program.chmod(0o755)
        (environment / "installed").touch()  # so that `make demo` installs nothing
        self.environment = {
            "PATH": f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}", "LANG": "C.UTF-8",
            "BROWSER": "true",
        }  # fmt: skip

    def git(self, *words: str) -> None:
        subprocess.run(["git", "-C", str(self.path), *words], check=True, capture_output=True)

    def clean(self) -> None:
        self.git("checkout", "--quiet", "--force", self.commit)
        self.git("clean", "--quiet", "-xfd", "--exclude=.venv")

    def run(self, words: list[str], home: Path, serves: bool = False):
        """(status, clock, processor, stdout, stderr); status None: it was stopped."""
        home.mkdir(parents=True, exist_ok=True)
        out, err = (open(home.parent / f"{home.name}.{end}", "w+b") for end in ("out", "err"))
        begin = time.perf_counter()
        process = subprocess.Popen(
            words, cwd=self.path, env=self.environment | {"HOME": str(home)}, stdout=out,
            stderr=err, start_new_session=True,
        )  # fmt: skip
        ended = threading.Event()
        limit = min(time.monotonic() + LONGEST, self.until)
        watching = threading.Thread(
            target=_watch, args=(process.pid, out.name, serves, ended, limit)
        )
        watching.start()
        _, status, usage = os.wait4(process.pid, 0)
        ended.set()
        watching.join()
        process.returncode = os.waitstatus_to_exitcode(status)
        clock = time.perf_counter() - begin
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode("utf-8", "replace"))
            file.close()
        stopped = process.returncode == -signal.SIGKILL
        return (None if stopped else process.returncode, clock,
                usage.ru_utime + usage.ru_stime, *texts)  # fmt: skip


def _watch(group: int, output: str, serves: bool, ended: threading.Event, limit: float) -> None:
    """Read the page of a command that serves one, and end it by Ctrl-C; end what takes too long."""
    while serves and not ended.wait(0.2) and time.monotonic() < limit:
        if found := re.search(r"http://\S+", Path(output).read_text("utf-8", "replace")):
            with urllib.request.urlopen(found[0], timeout=60) as answer:
                assert b"<html" in answer.read()
            os.killpg(group, signal.SIGINT)
            break
    if not ended.wait(max(limit - time.monotonic(), 0)):
        with suppress(ProcessLookupError):  # it has just ended
            os.killpg(group, signal.SIGKILL)


def why_not(process: Process) -> str | None:
    """Why a command does not run here."""
    return next((why for words, why in NOT_RUN.items() if words in process.text), None)


def expected_status(process: Process) -> int:
    if process.python:
        return 0
    served = process.text.startswith("jaxbundle explore")
    return next((status for words, status in STATUS.items() if words == process.page
                 or (served if words == "explore" else words in process.text)), 0)  # fmt: skip


def run_page(
    checkout: Checkout, page: str, chosen: list[Process], home: Path | None = None
) -> Iterator[Told]:
    """The chosen processes of a page, cold and then warm; `home`: once, and all of them with this
    one."""
    processes = [one for one in chosen if not why_not(one)]
    own = checkout.homes.parent / "own" / page.replace("/", "-")
    own.mkdir(parents=True)
    names = {}
    if page != "docs/howto/mistakes.md":  # it is about what is not there
        from own_files import OWN_NAMES, write_own_files

        write_own_files(own, page, [one.text for one in processes])
        names = OWN_NAMES
    for warm in (True,) if home else (False, True):
        checkout.clean()
        shutil.copytree(own, checkout.path, dirs_exist_ok=True)
        for one in processes:
            words = ["bash", "-c", one.text]
            if one.python:
                code = one.text
                # An error names the line of the page.
                lines = "\n" * (one.line - 1)
                given = f"exec({names[page]!r}, globals())\n" if page in names else ""
                script = checkout.homes.parent / "block.py"
                script.write_text(
                    f"{given}exec(compile({lines + code!r}, {page!r}, 'exec'), globals())\n",
                    encoding="utf-8",
                )
                words = ["python", "-c", script.read_text(encoding="utf-8")]
            own_home = checkout.homes / page.replace("/", "-") / str(processes.index(one))
            told = checkout.run(words, home or own_home, one.text.startswith("jaxbundle explore"))
            status, clock, processor, out, err = told
            yield Told(one.name, warm, status, expected_status(one), clock, processor, out, err)
    if not home:
        shutil.rmtree(checkout.homes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pages", nargs="+", help="these pages or camera models")
    parser.add_argument("--only", help="commands with these words alone")
    parser.add_argument("--seconds", type=float, help="end after this time")
    parser.add_argument("--home", type=Path, help="run them once, with this home: quicker")
    parser.add_argument("--json", type=Path, help="write what every process said")
    given = parser.parse_args()
    import jaxbundle

    jaxbundle.enable_x64()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background: processes inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    begin, results, missed = time.monotonic(), [], []
    with tempfile.TemporaryDirectory() as folder:
        until = begin + (given.seconds or math.inf)
        checkout = Checkout(Path(folder), until)
        first, *others = given.pages or [*pages(), *MODELS]
        if not given.pages:
            random.Random(checkout.commit).shuffle(others)
        for page in (first, *others):
            found = processes_of_model(page) if page in MODELS else processes_of(page)
            chosen = [one for one in found if (given.only or "") in one.text]
            if not chosen:
                continue
            if time.monotonic() > until:
                missed.append(page)
                continue
            for told in run_page(checkout, page, chosen, given.home and given.home.resolve()):
                if time.monotonic() > until:
                    missed.append(page)
                    break
                results.append(told)
                print(line_of(told), flush=True)
                if given.json:
                    found = [asdict(one) | {"failed": one.failed} for one in results]
                    given.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    failed = [told for told in results if told.failed]
    ran = len({told.name for told in results})
    times = "once" if given.home else "cold and warm"
    print(f"{ran} commands and blocks, each {times}: {len(failed)} failures")
    for page in missed:
        print(f"not reached, or not to its end: {page}")
    for told in failed:
        print(f"\n{line_of(told)}\n{told.stdout[-500:]}\n{told.stderr[-2000:]}")
    sys.exit(bool(failed))


def line_of(told: Told) -> str:
    verdict = f"FAILED, status {told.status}" if told.failed else "ok"
    return (f"{told.clock:7.1f} s {told.processor:7.1f} s {'warm' if told.warm else 'cold'} "
            f"{verdict}: {told.name}")  # fmt: skip


if __name__ == "__main__":
    main()
