"""What long work shows on a terminal; nothing in a pipe."""

from jax import monitoring
from rich.console import Console
from rich.progress import (
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)


def counting(quiet: bool) -> Progress:
    """A bar with the number done of the number there is."""
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    return Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    )


BEGUN = "/jax/compilation_cache/compile_requests_use_cache"
MADE = "/jax/core/compile/backend_compile_duration"
"""What JAX tells of a program: it begins to read a kept one, or to compile it, as it then finds; it
has it."""


class iterating:
    """A line with the iteration and vᵀPv; as a context gives what adjustment tells, or None."""

    def __init__(self, silent: bool):
        self.console = Console(stderr=True)
        self.silent = silent or not self.console.is_terminal

    def __enter__(self):
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

    def _hear(self, event: str, *_, **__) -> None:
        if event == BEGUN:
            self.bar.update(self.task, description="preparing programs, compiled once for a size")
        elif event == MADE:
            self.bar.update(self.task, description=self.line)

    def __exit__(self, *_):
        if not self.silent:
            monitoring.unregister_event_listener(self._hear)
            monitoring.unregister_event_duration_listener(self._hear)
            self.bar.stop()


class staging:
    """A bar for every stage of long work; as a context gives `tell(stage, done, total)`."""

    def __init__(self, silent: bool):
        self.bar = counting(silent)
        self.tasks: dict = {}

    def __enter__(self):
        self.bar.start()
        return self.tell

    def tell(self, stage: str, done: int, total: int) -> None:
        """Move the bar of a stage."""
        if stage not in self.tasks:
            self.tasks[stage] = self.bar.add_task(stage, total=total)
        self.bar.update(self.tasks[stage], completed=done, total=total)

    def __exit__(self, *_):
        self.bar.stop()
