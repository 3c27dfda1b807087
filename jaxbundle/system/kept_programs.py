"""Compiled programs kept between processes, by JAX's persistent cache."""

import os
import re
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxbundle.system.temporaries import watch_cache
from jaxbundle.system.xla_flags import jaxlib_version


def keep_programs(folder: str | os.PathLike | None = None) -> bool:
    """Keep compiled programs in a folder by JAX's persistent cache, so that later processes start
    without compiling; call it before the first JAX computation.

    `folder`: default that of the environment variable JAX_COMPILATION_CACHE_DIR, else
    `jaxbundle` in the user's cache folder.

    **Returns:** whether the folder is writable, and jaxlib 0.10.2 or later; if not, nothing is
    kept. For every kept program earlier ones print two errors, about features of the processor
    that are none.
    """
    import jax

    from jaxbundle.arguments import path

    folder = None if folder is None else path("folder", folder)
    variable = "JAX_COMPILATION_CACHE_DIR"
    if folder is None:
        home = os.path.join(os.path.expanduser("~"), ".cache")
        # LOCALAPPDATA: of Windows
        caches = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or home
        folder = os.environ.get(variable) or os.path.join(caches, "jaxbundle")
    try:
        os.makedirs(folder, exist_ok=True)
        usable = os.access(folder, os.W_OK | os.X_OK)
    except OSError:
        usable = False
    usable = usable and jaxlib_version() >= (0, 10, 2)
    # JAX has already read the variable, and would warn of a bad folder for every program.
    jax.config.update("jax_compilation_cache_dir", os.fspath(folder) if usable else None)
    if not usable:
        return False
    watch_cache(folder)
    _remove_damaged_programs(Path(os.path.abspath(folder)))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Seconds. JAX's 1 s keeps none of the dozen programs of a small network; reading a file
        # takes some milliseconds, so that below 0.02 keeping saves nothing.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.02)
    return True


def _remove_damaged_programs(folder: Path) -> None:
    """Remove the files of programs that JAX cannot read, instead of showing its warnings.

    JAX compiles them again, in every process, since it does not replace a file. A damaged one is
    left by a full disk; one that is just being written by another process is not touched."""
    show_warning, pattern = (
        warnings.showwarning,
        "Error (reading|writing) persistent compilation cache entry",
    )

    def handle(message: Warning | str, *where: Any, **options: Any) -> None:
        if not re.match(pattern, str(message)):
            return show_warning(message, *where, **options)
        # Within a minute another process has written the file of a program, some megabytes.
        name, latest = re.search(r"'(\w+)", str(message)), time.time() - 60.0
        for file in folder.glob(f"{name[1]}-*-cache") if name else ():
            with suppress(OSError):
                if file.stat().st_mtime < latest:
                    file.unlink()

    # "always": as an error, by -W error, it would end the computation.
    warnings.filterwarnings("always", pattern)
    warnings.showwarning = handle
