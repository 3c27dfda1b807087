"""Output of --verbose on standard error: versions, then stages and iterations with their times
(`progress`), finally the total time and the compiled programs."""

import contextlib
import sys
import time
from collections.abc import Iterator

import jax
from jax import monitoring

from jaxbundle.report.page.origin import software_versions

COMPILED_EVENT = "/jax/core/compile/backend_compile_duration"
CACHE_HIT_EVENT = "/jax/compilation_cache/cache_hits"


def say(words: str) -> None:
    """A line."""
    print(words, file=sys.stderr, flush=True)


@contextlib.contextmanager
def report_times() -> Iterator[None]:
    """Print versions, and at the end the elapsed time."""
    say(", ".join(f"{name} {version}" for name, version in software_versions()))
    seconds: list[float] = []
    cache_events: list[str] = []

    def hear_time(event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILED_EVENT:
            seconds.append(duration_secs)

    def hear(event: str, **_: str | int) -> None:
        if event == CACHE_HIT_EVENT:
            cache_events.append(event)

    monitoring.register_event_duration_secs_listener(hear_time)
    monitoring.register_event_listener(hear)
    begun = time.perf_counter()
    try:
        yield
    finally:
        # Of a notebook or a test: the next command must not be heard here.
        monitoring.unregister_event_duration_listener(hear_time)
        monitoring.unregister_event_listener(hear)
        devices = jax.devices()  # only now: the command sets their number
        say(
            f"{time.perf_counter() - begun:.2f} s in all, on {len(devices)} devices of JAX "
            f"({devices[0].platform}); {len(seconds)} programs prepared in {sum(seconds):.2f} s, "
            f"{len(cache_events)} of them from the cache"
        )


class Stages:
    """Prints the time of each stage; a stage ends when the next one begins."""

    def __init__(self):
        self.name, self.begun = "", 0.0

    def begin(self, name: str) -> None:
        """Begin a stage, unless it is already running."""
        if name == self.name:
            return
        self.end()
        self.name, self.begun = name, time.perf_counter()

    def end(self) -> None:
        """End the stage."""
        if self.name:
            say(f"{self.name}: {time.perf_counter() - self.begun:.2f} s")
        self.name = ""
