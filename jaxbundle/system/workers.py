"""Tasks in separate processes: a crash affects only its own task.

A process is a fresh interpreter that is handed a task at a time through a pipe. It ends when the
pipe is closed, and hence with the process that started it, however that ends.
"""

import dataclasses
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from jaxbundle.system.temporaries import watch_process


@dataclasses.dataclass(frozen=True)
class Failed:
    """In place of a result: what went wrong, in words."""

    why: str


class Workers:
    """At most this many processes, started on demand, that call one function; a context.

    `function` is importable; it, its tasks and results are pickled.
    """

    def __init__(self, function: Callable[[Any], Any], number: int):
        self._function, self._number = function, number
        self._idle: list[tuple[Connection, Any]] = []
        self._busy: dict[Connection, tuple[Any, Any]] = {}

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        for connection, process in (*self._idle, *((c, p) for c, (p, _) in self._busy.items())):
            connection.close()
            if connection in self._busy:
                process.terminate()
            # An idle process ends when its pipe closes, in milliseconds; one that computes in C++
            # has been terminated. After 5 s it is left to the system.
            process.join(5.0)
            watch_process(process, running=False)
        self._idle, self._busy = [], {}

    def run(self, tasks: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Every task with its result or `Failed`, in the order of completion."""
        pending = list(tasks)[::-1]
        while pending or self._busy:
            while pending and len(self._busy) < self._number:
                connection, process = self._idle.pop() if self._idle else self._start()
                try:
                    connection.send(pending[-1])
                except OSError:  # it died without work
                    continue
                self._busy[connection] = process, pending.pop()
            ready = wait([*self._busy])
            for connection in [candidate for candidate in self._busy if candidate in ready]:
                process, task = self._busy.pop(connection)
                try:
                    result = connection.recv()
                except (EOFError, OSError):
                    process.join()
                    watch_process(process, running=False)
                    yield task, Failed(f"its worker process died ({_describe_end(process)})")
                    continue
                self._idle.append((connection, process))
                yield task, result

    def _start(self) -> tuple[Any, Any]:
        context = multiprocessing.get_context("spawn")
        parent_end, child_end = context.Pipe()
        process = context.Process(target=_serve, args=(child_end, self._function), daemon=True)
        process.start()
        watch_process(process)
        child_end.close()
        return parent_end, process


def _describe_end(process: BaseProcess) -> str:
    code = process.exitcode
    return f"signal {-code}" if code is not None and code < 0 else f"status {code}"


def _serve(connection: Connection, function: Callable[[Any], Any]) -> None:
    """The loop of a process; Ctrl-C is handled by the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            task = connection.recv()
            try:
                result = function(task)
            except Exception as error:
                message = isinstance(error, MemoryError) and str(error)
                result = Failed(message or f"{type(error).__name__}: {error}")
            connection.send(result)
    except (EOFError, OSError):
        os._exit(0)  # the parent process is gone
