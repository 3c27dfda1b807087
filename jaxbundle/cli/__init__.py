"""The command line, a file for each command.

Help, the version and errors of usage are given without JAX, in 0.3 s: the file of a command imports
at its top only what its arguments and options need, and the rooms it works with in the first lines
of its functions. Where several functions need rooms, they have a file of their own.

Exit status: 0 solved; 2 bad input (one line, nothing written); 3 not solved (says why); 130, 143,
129 ended by Ctrl-C, SIGTERM, a lost terminal (`system.interrupts`); 141 nobody reads the output.
"""

import importlib
import sys
from collections.abc import Callable

from jaxbundle.cli.app import run

COMMANDS = (
    "reconstruct", "orient", "adjust", "calibrate", "batch", "design", "plan", "camera",
    "compare", "stability", "explore", "convert", "surface", "cloud", "pushbroom", "example",
)  # fmt: skip


def main(prepare: Callable[[], object] | None = None) -> None:
    """Run the command line. Only the command asked for is imported, for help all of them.

    `prepare`: called when the arguments are understood, before JAX computes anything.
    """
    asked = sys.argv[1:2]
    for command in asked if asked and asked[0] in COMMANDS else COMMANDS:
        importlib.import_module(f"jaxbundle.cli.{command}")
    run(prepare)
