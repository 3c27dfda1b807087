"""`jaxbundle` and `python -m jaxbundle`: the command line.

What JAX and the linear algebra library read from the environment when they are imported is set
first, unless it is set already: one BLAS thread, since threads fight over small matrices, and a
folder where compiled programs are kept from one call to the next.
"""

import os
from pathlib import Path


def main() -> None:
    """Run the command line."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxbundle"
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    from jaxbundle.cli import main

    main()


if __name__ == "__main__":
    main()
