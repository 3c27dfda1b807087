"""The command line, a file for each command.

Exit status: 0 solved; 2 bad input (one line, nothing written); 3 not solved (says why); 130, 143,
129 ended by Ctrl-C, SIGTERM, a lost terminal (`system.interrupts`); 141 nobody reads the output.
"""

import importlib
import sys

from jaxbundle.cli.app import run

COMMANDS = (
    "reconstruct", "orient", "adjust", "calibrate", "batch", "plan", "camera", "compare",
    "convert", "surface", "cloud", "pushbroom",
)  # fmt: skip


def main() -> None:
    """Run the command line. Only the command asked for is imported, for help all of them."""
    asked = sys.argv[1:2]
    for command in asked if asked and asked[0] in COMMANDS else COMMANDS:
        importlib.import_module(f"jaxbundle.cli.{command}")
    run()
