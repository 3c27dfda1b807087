"""`jaxbundle` and `python -m jaxbundle`: the command line.

One BLAS thread, unless the environment says otherwise: threads fight over small matrices, and the
library reads it when it is imported.
"""

import os
import sys

INTERRUPTED = 130


def main() -> None:
    """Run the command line."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from jaxbundle.configuration import keep_programs

        keep_programs()
        from jaxbundle.cli import main

        main()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
