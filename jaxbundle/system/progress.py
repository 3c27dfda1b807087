"""Progress of long work as bars on a terminal, in Python as on the command line.

Long functions take `progress`, a function of (stage, done, total), called when a stage begins and
as it advances. What follows a colon in the name of a stage is a detail that changes.
"""

import sys
from collections.abc import Callable
from typing import Any


class show_progress:
    """Bars on a terminal, nothing in a pipe; as a context it yields the function to give as
    `progress`:

        with jaxbundle.show_progress() as progress:
            result = jaxbundle.calibrate(photographs, board, progress=progress)

    **Arguments:** `bars`: a `rich.progress.Progress` to use; by default one on standard error."""

    def __init__(self, bars: Any = None):
        self.bars = bars
        self.tasks: dict[str, Any] = {}

    def __enter__(self) -> Callable[[str, int, int], None]:
        if self.bars is None:
            from rich.console import Console
            from rich.progress import MofNCompleteColumn, Progress

            console = Console(file=sys.stderr)
            self.bars = Progress(
                *Progress.get_default_columns(),
                MofNCompleteColumn(),
                console=console,
                transient=True,
                disable=not console.is_terminal,
            )
        self.bars.start()
        return self.tell

    def tell(self, stage: str, done: int, total: int) -> None:
        """Show the state of a stage."""
        name = stage.partition(":")[0]
        if name not in self.tasks:
            self.tasks[name] = self.bars.add_task(stage, total=total)
        self.bars.update(self.tasks[name], description=stage, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        self.bars.stop()
