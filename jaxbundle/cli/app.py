"""The application the commands are registered with, and how it ends."""

import os
import sys
import traceback
from pathlib import Path
from typing import Annotated, NoReturn

import typer

import jaxbundle
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.system.configuration import leave

BAD_INPUT, NOT_SOLVED = 2, 3
NO_READER = 128 + 13
"""As of a Unix tool whose reader has gone: ended by SIGPIPE, number 13."""

app = typer.Typer(
    name="jaxbundle",
    help="Least squares for photogrammetry: self-calibrating bundle adjustment.",
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Input = Annotated[Path, typer.Argument(help="project .toml, text list of photographs, …")]
Settings = Annotated[list[str] | None, typer.Option(help="KEY=VALUE replaces a setting")]
Format = Annotated[str | None, typer.Option(help="kind of input, if not recognised")]
Control = Annotated[
    Path | None,
    typer.Option(help="table id,X,Y,Z[,sX,sY,sZ] whose control replaces that of the input"),
]
Force = Annotated[
    bool, typer.Option("--force", help="replace files in the folder of --out of other origin")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="print nothing but errors")]


def _version(asked: bool) -> None:
    if asked:
        print(f"jaxbundle {jaxbundle.__version__}")
        raise typer.Exit


@app.callback()
def _main(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    """Every command has its own help: jaxbundle adjust --help."""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(BAD_INPUT)
    jaxbundle.enable_x64()


def run() -> None:
    """Run the application; errors of the input, the solution, the machine end in one line."""
    try:
        status = app(standalone_mode=False)
        sys.stdout.flush()
    except (InputError, NotSolvedError) as error:
        _end(error, BAD_INPUT if isinstance(error, InputError) else NOT_SOLVED)
    except MemoryError:
        _end("not enough memory for this", NOT_SOLVED)
    except (BrokenPipeError, SystemExit):  # typer ends a command that meets a broken pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        leave(NO_READER)
    except typer.Abort as error:  # typer's word for EOFError
        _end(f"a file ends too early: {error.__cause__}", BAD_INPUT)
    except (OSError, OverflowError, RecursionError) as error:
        _end(" ".join(str(error).split()), BAD_INPUT)
    except Exception as error:
        # Usage errors of the command line itself (unknown option, missing argument).
        if message := getattr(error, "format_message", None):
            _end(message(), BAD_INPUT)
        traceback.print_exc()
        leave(1)
    sys.exit(status)


def _end(message: object, status: int) -> NoReturn:
    print(f"jaxbundle: {message}", file=sys.stderr, flush=True)
    leave(status)
