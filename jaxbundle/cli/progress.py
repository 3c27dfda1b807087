"""Progress of long work: bars on a terminal, nothing in a pipe, lines on stderr with --verbose."""

import time
from collections.abc import Callable
from typing import Any

from jax import monitoring
from rich.console import Console
from rich.progress import (
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from jaxbundle.cli.common_options import verbose
from jaxbundle.cli.verbose import Stages, say
from jaxbundle.system.progress import show_progress


class _Staged(Progress):
    """Bars for stages; a new description begins a new stage. With --verbose their times are
    printed."""

    stages: Stages | None = None

    def add_task(self, description: str, *arguments: Any, **options: Any) -> TaskID:
        self._begin(description)
        return super().add_task(description, *arguments, **options)

    def update(self, task_id: TaskID, *, description: str | None = None, **options: Any) -> None:
        self._begin(description)
        super().update(task_id, description=description, **options)

    def stop(self) -> None:
        # Before Rich 14 a bar that is not shown ends with an empty line.
        if not self.disable:
            super().stop()
        if self.stages is not None:
            self.stages.end()

    def _begin(self, description: str | None) -> None:
        if self.stages is not None and description is not None:
            self.stages.begin(description)


def counting(quiet: bool) -> Progress:
    """A bar with the number done out of the total."""
    console = Console(stderr=True)
    # The default columns have a percentage, but not the numbers.
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    bar = _Staged(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    )
    bar.stages = Stages() if verbose.get() else None
    return bar


REQUEST_EVENT = "/jax/compilation_cache/compile_requests_use_cache"
# JAX's monitoring events of a program: looking it up in the cache or compiling it; done.
COMPILED_EVENT = "/jax/core/compile/backend_compile_duration"


class iterating:
    """A line with the iteration and vᵀPv; as a context it yields the callback of the adjustment, or
    None. With --verbose one line per iteration."""

    def __init__(self, silent: bool):
        self.console = Console(stderr=True)
        self.silent = silent or verbose.get() or not self.console.is_terminal

    def __enter__(self) -> Callable[[str, int, int], None] | None:
        if verbose.get():
            self.begun = time.perf_counter()
            return self.tell_line
        if self.silent:
            return None
        self.bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=self.console,
            transient=True,
        )
        self.bar.start()
        self.line = "starting"
        self.task = self.bar.add_task(self.line)
        monitoring.register_event_listener(self._hear)
        monitoring.register_event_duration_secs_listener(self._hear)
        return self.tell

    def tell(self, stage: str, done: int, _: int) -> None:
        """Show the iteration."""
        self.line = f"iteration {done}:{stage.partition(':')[2]}"
        self.bar.update(self.task, description=self.line)

    def tell_line(self, stage: str, done: int, _: int) -> None:
        """Print the iteration and the elapsed time."""
        detail = stage.partition(":")[2]
        say(f"iteration {done}:{detail}, {time.perf_counter() - self.begun:.2f} s")

    def _hear(self, event: str, *_: object, **__: object) -> None:
        if event == REQUEST_EVENT:
            self.bar.update(self.task, description="compiling programs, once per size")
        elif event == COMPILED_EVENT:
            self.bar.update(self.task, description=self.line)

    def __exit__(self, *_: object):
        if not self.silent:
            monitoring.unregister_event_listener(self._hear)
            monitoring.unregister_event_duration_listener(self._hear)
            self.bar.stop()


def staging(silent: bool) -> show_progress:
    """A bar for every stage of long work; as a context it yields `progress(stage, done, total)`."""
    return show_progress(counting(silent))
