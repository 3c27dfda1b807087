"""Progress of long work: bars on a terminal, nothing in a pipe, lines on stderr with --verbose."""

import time

from jax import monitoring
from rich.console import Console
from rich.progress import (
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from jaxbundle.cli.habits import verbose
from jaxbundle.cli.verbose import Stages, say


class _Staged(Progress):
    """Bars for stages; a new description begins a new stage. With --verbose their times are
    printed."""

    stages: Stages | None = None

    def add_task(self, description: str, *arguments, **options):
        self._begin(description)
        return super().add_task(description, *arguments, **options)

    def update(self, task_id, *, description: str | None = None, **options) -> None:
        self._begin(description)
        super().update(task_id, description=description, **options)

    def stop(self) -> None:
        super().stop()
        if self.stages is not None:
            self.stages.end()

    def _begin(self, description: str | None) -> None:
        if self.stages is not None and description is not None:
            self.stages.begin(description)


def counting(quiet: bool) -> Progress:
    """A bar with the number done out of the total."""
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    bar = _Staged(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    )
    bar.stages = Stages() if verbose.get() else None
    return bar


REQUEST_EVENT = "/jax/compilation_cache/compile_requests_use_cache"
COMPILED_EVENT = "/jax/core/compile/backend_compile_duration"
"""JAX's monitoring events of a program: looking it up in the cache or compiling it; done."""


class iterating:
    """A line with the iteration and vᵀPv; as a context it yields the callback of the adjustment, or
    None. With --verbose one line per iteration."""

    def __init__(self, silent: bool):
        self.console = Console(stderr=True)
        self.silent = silent or verbose.get() or not self.console.is_terminal

    def __enter__(self):
        if verbose.get():
            self.begun = time.perf_counter()
            return self.tell_line
        if self.silent:
            return None
        self.bar = Progress(
            SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(),
            console=self.console, transient=True,
        )  # fmt: skip
        self.bar.start()
        self.line = "starting"
        self.task = self.bar.add_task(self.line)
        monitoring.register_event_listener(self._hear)
        monitoring.register_event_duration_secs_listener(self._hear)
        return self.tell

    def tell(self, step, cost, damping) -> None:
        """Show the iteration."""
        self.line = f"iteration {int(step)}: vᵀPv {2 * float(cost):.6g}"
        self.bar.update(self.task, description=self.line)

    def tell_line(self, step, cost, damping) -> None:
        """Print the iteration and the elapsed time."""
        say(
            f"iteration {int(step)}: vᵀPv {2 * float(cost):.8g}, λ {float(damping):.2g}, "
            f"{time.perf_counter() - self.begun:.2f} s"
        )

    def _hear(self, event: str, *_, **__) -> None:
        if event == REQUEST_EVENT:
            self.bar.update(self.task, description="compiling programs, once per size")
        elif event == COMPILED_EVENT:
            self.bar.update(self.task, description=self.line)

    def __exit__(self, *_):
        if not self.silent:
            monitoring.unregister_event_listener(self._hear)
            monitoring.unregister_event_duration_listener(self._hear)
            self.bar.stop()


class staging:
    """A bar for every stage of long work; as a context it yields `tell(stage, done, total)`."""

    def __init__(self, silent: bool):
        self.bar = counting(silent)
        self.tasks: dict = {}

    def __enter__(self):
        self.bar.start()
        return self.tell

    def tell(self, stage: str, done: int, total: int) -> None:
        """Advance the bar of a stage."""
        if stage not in self.tasks:
            self.tasks[stage] = self.bar.add_task(stage, total=total)
        self.bar.update(self.tasks[stage], completed=done, total=total)

    def __exit__(self, *_):
        self.bar.stop()
