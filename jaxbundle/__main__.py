"""`jaxbundle` and `python -m jaxbundle`: the command line.

What JAX and the linear algebra library read from the environment when they are imported is set
first, unless it is set already: one BLAS thread, since threads fight over small matrices, and a
folder where compiled programs are kept from one call to the next, where one can be written.
"""

import os


def main() -> None:
    """Run the command line."""
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(os.path.join("~", ".cache"))
    cache = os.path.join(caches, "jaxbundle")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if is_writable(cache):
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.02")
    from jaxbundle.cli import main

    main()


def is_writable(folder: str) -> bool:
    """Whether a folder is there, or could be made, and takes files."""
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


if __name__ == "__main__":
    main()
