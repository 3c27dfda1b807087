"""`jaxbundle` and `python -m jaxbundle`: the command line.

One BLAS thread, unless the environment says otherwise: threads are slow on small matrices. OpenCV
logs fatal errors only. The libraries read these variables on import.
"""

import gc
import os
import sys

from jaxbundle.system.interrupts import handle_interrupts, set_status

# Thresholds of Python's garbage collector. Tracing makes millions of objects, nearly all of them
# permanent: with the default thresholds the collector takes a sixth of the tracing time.
GC_THRESHOLDS = 50_000, 20, 100


def main() -> None:
    """Run the command line, as the whole of this process."""
    handle_interrupts()
    from jaxbundle.system.terminals import write_everywhere

    write_everywhere()
    gc.set_threshold(*GC_THRESHOLDS)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Warnings about unknown tags of TIFF; errors come to the caller, and are said in one line.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "FATAL")
    if "reconstruct" in sys.argv[1:2]:
        from jaxbundle.system.cores import allow_programs_at_once

        allow_programs_at_once()
    from jaxbundle.cli import main

    try:
        main(_keep_programs)
    except SystemExit as ended:
        set_status(ended.code if isinstance(ended.code, int) else int(bool(ended.code)))
        raise
    set_status(0)


def _keep_programs() -> None:
    from jaxbundle.system.kept_programs import keep_programs

    keep_programs()


if __name__ == "__main__":
    main()
