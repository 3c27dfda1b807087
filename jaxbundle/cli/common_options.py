"""Options of every command, --quiet and --verbose, added when it is registered."""

import contextlib
import functools
import inspect
import os
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Annotated, Any

import typer

from jaxbundle.errors import InputError

Quiet = Annotated[
    bool, typer.Option("--quiet", help="print errors, and the result if no file is asked for")
]
Verbose = Annotated[
    bool, typer.Option("--verbose", help="print versions, iterations, and times of stages")
]
# Whether the running command was called with --verbose.
verbose: ContextVar[bool] = ContextVar("verbose", default=False)


def add_common_options(function: Callable) -> Callable:
    """The function of a command with the options `quiet` and `verbose`. A function without a
    `quiet` parameter is silenced as a whole: standard error, and standard output if its result is
    in a file (`RESULT_FILES`)."""
    signature = inspect.signature(function)
    has_quiet = "quiet" in signature.parameters
    options = {"verbose": Verbose} if has_quiet else {"quiet": Quiet, "verbose": Verbose}

    @functools.wraps(function)
    def command(**values: Any) -> Any:
        talk, quiet = values.pop("verbose"), values["quiet"] if has_quiet else values.pop("quiet")
        if talk and quiet:
            raise InputError("--quiet and --verbose: give one of them")
        with _silent(values) if quiet and not has_quiet else _talking() if talk else _nothing():
            return function(**values)

    command.__annotations__ = {**function.__annotations__, **options}
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
        for name, kind in options.items()
    ]
    extended = signature.replace(parameters=[*signature.parameters.values(), *parameters])
    # Typer reads options from here, not from **values.
    command.__dict__["__signature__"] = extended
    return command


_nothing = contextlib.nullcontext


# Parameters of commands for a file or folder of the result.
RESULT_FILES = ("out", "json", "html", "save", "folder")


def is_in_file(*files: object) -> bool:
    """Whether a command was asked for a file of its result, by one of these options; `-` is
    standard output."""
    return any(file not in (None, "") and str(file) != "-" for file in files)


@contextlib.contextmanager
def _silent(values: dict) -> Iterator[None]:
    """Discard what is not the result; errors are printed afterwards."""
    has_file = is_in_file(*(values.get(name) for name in RESULT_FILES))
    prints_result = any(str(values.get(name)) == "-" for name in ("json", "csv"))
    with open(os.devnull, "w", encoding="utf-8", errors="replace") as nowhere:
        silent = (
            contextlib.redirect_stdout(nowhere) if has_file and not prints_result else _nothing()
        )
        with contextlib.redirect_stderr(nowhere), silent:
            yield


@contextlib.contextmanager
def _talking() -> Iterator[None]:
    from jaxbundle.cli.verbose import report_times

    token = verbose.set(True)
    try:
        with report_times():
            yield
    finally:
        verbose.reset(token)
