"""The command line, one file per command.

Help, version and usage errors take 0.3 s because they do not import JAX: a command's file imports
at the top only what its arguments and options need, and the other subpackages in the first lines of
its functions. Functions that share such imports are in a separate file.

Exit status: 0 solved; 2 bad input (one line, nothing written); 3 not solved (with the reason); 4 a
criterion of `--accept` is not met; 130,
143, 129 ended by Ctrl-C, SIGTERM, a lost terminal (`system.interrupts`); 141 closed pipe.
"""

import importlib
import sys
from collections.abc import Callable

from jaxbundle.cli.app import run

# Of the shell: `jaxbundle.commands` has what Python calls.
__all__: list[str] = []

COMMANDS = (
    "reconstruct",
    "orient",
    "adjust",
    "frames",
    "calibrate",
    "calibrate-rig",
    "calibrate-wand",
    "hand-eye",
    "batch",
    "design",
    "plan",
    "camera",
    "compare",
    "stability",
    "replicate",
    "explore",
    "convert",
    "surface",
    "cloud",
    "change",
    "pushbroom",
    "example",
    "completion",
)


def import_command(command: str) -> None:
    """Import the file of a command, with which it registers."""
    importlib.import_module(f"jaxbundle.cli.{command.replace('-', '_')}")


def main(prepare: Callable[[], object] | None = None) -> None:
    """Run the command line. Only the requested command is imported; all of them for the help.

    `prepare`: called after parsing the arguments, before JAX computes anything.
    """
    typed = sys.argv[1:2]
    for command in typed if typed and typed[0] in COMMANDS else COMMANDS:
        import_command(command)
    run(prepare)
