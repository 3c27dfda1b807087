"""Settings of XLA's compiler for the CPU, in the environment variable XLA_FLAGS.

XLA ends the process at a flag that it does not know. Which flags the tried versions of jaxlib know
is written here; a later one is asked.

| jaxlib | flags |
|---|---|
| 0.10 | all |
| 0.11, 0.12 | all but `QUICK_LOOPS`: there is one emitter |
"""

import os
import re
import subprocess
import sys
from importlib.metadata import version

# Use the older of two loop emitters: half the compile time and memory, the same speed.
QUICK_LOOPS = "--xla_cpu_use_fusion_emitters=false"
# Disable concurrent operations in XLA's thread pool: a tenth less to compile, the same speed.
# jaxlib 0.10 waits in the pool for the parts of a batched factorisation or triangular solve: as
# many of them at once as there are threads, as under `vmap`, deadlock.
ONE_AFTER_THE_OTHER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
# Half the compile time; programs take three to five times as long.
LITTLE_OPTIMISATION = "--xla_backend_optimization_level=0"
# The newest jaxlib of which the flags are known here.
TRIED = (0, 12)


def set_flags(compile_quickly: bool) -> None:
    """Add the flags above that this jaxlib knows and that the variable does not set."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    set_names = {flag.partition("=")[0] for flag in flags}
    added_flags = [QUICK_LOOPS, ONE_AFTER_THE_OTHER, *[LITTLE_OPTIMISATION] * compile_quickly]
    added_flags = [
        flag for flag in _known_flags(added_flags) if flag.partition("=")[0] not in set_names
    ]
    os.environ["XLA_FLAGS"] = " ".join(flags + added_flags)


def jaxlib_version() -> tuple[int, ...]:
    """Major, minor and patch number of jaxlib."""
    return tuple(map(int, re.findall(r"\d+", version("jaxlib"))[:3]))


def _known_flags(flags: list[str]) -> list[str]:
    """Those of the flags that this jaxlib knows."""
    release = jaxlib_version()[:2]
    if release <= (0, 10):
        return flags
    if release <= TRIED:
        return [flag for flag in flags if flag != QUICK_LOOPS]
    known_names = _list_flags()
    return [flag for flag in flags if f"{flag.partition('=')[0]}=" in known_names]


def _list_flags() -> str:
    """XLA's list of its flags, from a process of its own, which takes 0.2 s; empty if that
    fails."""
    code = "from jaxlib import xla_client; xla_client.CompileOptions()"
    environment = os.environ | {"XLA_FLAGS": "--help"}
    try:
        return subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            timeout=60,
            encoding="utf-8",
            errors="replace",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return ""
