"""The typer application, its options, and exit statuses."""

import errno
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

import jaxbundle
from jaxbundle.choices import CAMERA_MODELS, FORMATS, MODEL_FAMILIES
from jaxbundle.cli.common_options import Quiet as Quiet
from jaxbundle.cli.common_options import add_common_options
from jaxbundle.cli.small_inputs import is_small
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.system.joined_processes import leave
from jaxbundle.system.memory import free_memory, is_memory_shortage, require_address_space
from jaxbundle.system.terminals import for_output

BAD_INPUT, NOT_SOLVED, NOT_ACCEPTED = 2, 3, 4
# Exit status of a Unix tool ended by SIGPIPE (13): the reader has closed the pipe.
NO_READER = 128 + 13

EXIT_STATUS = (
    "0 done; 2 bad input: one line, nothing written; 3 not solved, with the reason; "
    "4 a criterion of --accept is not met; "
    "130, 143 interrupted; 141 output pipe closed."
)


class Command(TyperCommand):
    """A command that starts JAX after parsing its arguments, so that usage errors and help do
    not wait for that."""

    example: str = ""
    """An example call."""
    computes: bool = True
    once: bool = False
    accepts: Mapping[str, str] | None = None
    """Kinds of its input, and what they look like."""

    def invoke(self, ctx: typer.Context) -> Any:
        if self.computes:
            require_address_space(self.name or "")
            if ctx.obj is not None:
                ctx.obj()
            small = self.once and is_small(ctx.params["input"])
            jaxbundle.enable_x64(compile_quickly=small)
        return super().invoke(ctx)

    def get_help(self, ctx: typer.Context) -> str:
        # For a stream of ASCII, click would write UTF-8.
        return for_output(super().get_help(ctx))

    def get_short_help_str(self, limit: int = 0) -> str:
        """The complete first sentence, for the list of commands."""
        return super().get_short_help_str(max(limit, 1000))  # no sentence is as long

    def format_epilog(self, ctx: typer.Context, formatter: Any) -> None:
        """The end of every help text: the inputs of some, an example and the exit statuses."""
        if self.accepts:
            with formatter.section("Inputs"):
                formatter.write_dl([*self.accepts.items()])
        with formatter.section("Example"):
            formatter.write(f"  {ctx.command_path} {self.example}\n")
        with formatter.section("Exit status"):
            formatter.write_text(EXIT_STATUS)


class CommandGroup(TyperGroup):
    """A group of commands."""

    def get_help(self, ctx: typer.Context) -> str:
        return for_output(super().get_help(ctx))


class Application(typer.Typer):
    """A group of such commands; without a command it lists them. Help is plain text: rich takes as
    long to import as all the rest."""

    def __init__(self, help: str, **options: Any):
        super().__init__(
            cls=CommandGroup,
            help=help,
            short_help=help,
            rich_markup_mode=None,
            callback=_list_commands,
            invoke_without_command=True,
            **options,
        )

    def command(
        self,
        name: str | None = None,
        *,
        example: str,
        computes: bool = True,
        once: bool = False,
        accepts: Mapping[str, str] | None = None,
        **options: Any,
    ) -> Callable[[Callable], Callable]:
        """Like typer's, with --quiet and --verbose. `example`: the arguments of a line that calls
        it, for its help; `computes`: whether it works with JAX; `once`: whether its time depends on
        its input, so that programs of a small input are compiled quickly; `accepts`: kinds of its
        input and what they look like, for its help."""
        fields = {"example": example, "computes": computes, "once": once, "accepts": accepts}
        kind = type("Command", (Command,), fields)
        register = super().command(name, cls=kind, **options)

        def add(function: Callable) -> Callable:
            register(add_common_options(function))
            return function

        return add


def _list_commands(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(BAD_INPUT)


app = Application(
    name="jaxbundle",
    help="Least squares for photogrammetry: self-calibrating bundle adjustment.",
    add_completion=False,
    pretty_exceptions_enable=False,
)

Input = Annotated[Path, typer.Argument(help="project .toml, list of photographs, COLMAP folder, …")]
Settings = Annotated[
    list[str] | None, typer.Option(help="KEY=VALUE overrides a setting; repeatable")
]
Control = Annotated[
    Path | None,
    typer.Option(help="table id,X,Y,Z[,sX,sY,sZ] that replaces the control of the input"),
]
Correlated = Annotated[
    bool,
    typer.Option(
        help="of eight photographs or more: σ under errors that image points share, and halves of "
        "the photographs compared"
    ),
]
Check = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME|'every 3rd'",
        help="control points that are only compared with the result; repeatable",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="replace foreign files in --out")]
Html = Annotated[str, typer.Option(help="write the result as one HTML page")]
Json = Annotated[str, typer.Option(help="write the result as JSON; - prints only JSON")]


def choice(
    words: Iterable[str],
    about: str = "",
    *names: str,
    forms: Mapping[str, str] | None = None,
    listing: bool = True,
    argument: bool = False,
) -> Any:
    """An option, or an `argument`, with a fixed set of values, or one of `forms` (patterns by what
    they look like); others are refused with the closest match. `names`: of the option, if not that
    of the argument; `listing`: list the values in the help."""
    forms = dict(forms or {})
    words = (*words, *forms)
    listed = ", ".join(words)

    def check(option: typer.CallbackParam, value: str | None) -> str | None:
        matching = value and any(re.fullmatch(form, value) for form in forms.values())
        if value is None or matching or (value in words and value not in forms):
            return value
        folded = {word.casefold(): word for word in words}
        close = get_close_matches(value.casefold(), folded, 1)
        mean = f"; did you mean {folded[close[0]]!r}?" if close else ""
        raise InputError(f"{option.opts[0]} {value!r}: expected one of {listed}{mean}")

    help_text = (f"{about}: {listed}" if about else listed) if listing else about
    complete = lambda: [word for word in words if word not in forms]
    if argument:
        return typer.Argument(help=help_text, callback=check, autocompletion=complete)
    return typer.Option(*names, help=help_text, callback=check, autocompletion=complete)


Format = Annotated[str | None, choice(FORMATS, "input format, if not recognised")]


def model_choice(about: str) -> Any:
    """An option that is the name of a camera model."""
    return choice(CAMERA_MODELS, about, forms=MODEL_FAMILIES, listing=False)


def _version(is_wanted: bool) -> None:
    if is_wanted:
        print(f"jaxbundle {jaxbundle.__version__}")
        raise typer.Exit


@app.callback()
def _main(
    context: typer.Context,
    version: Annotated[  # noqa: ARG001 - its callback prints it
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    """Every command has its own help: jaxbundle adjust --help."""
    _list_commands(context)


def run(prepare: Callable[[], object] | None = None) -> None:
    """Run the application; errors in the input, the solution, or the machine are printed in one
    line."""
    try:
        status = app(standalone_mode=False, obj=prepare)
        sys.stdout.flush()
    except (InputError, NotSolvedError) as error:
        _end(error, BAD_INPUT if isinstance(error, InputError) else NOT_SOLVED)
    except (BrokenPipeError, SystemExit):  # typer ends a command that meets a broken pipe
        # Nobody reads: what Python flushes at its end must not fail once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        leave(NO_READER)
    except typer.Abort as error:  # typer's word for EOFError
        _end(f"unexpected end of file: {error.__cause__}", BAD_INPUT)
    except OSError as error:
        if is_closed_pipe(error):
            leave(NO_READER)
        _end(_describe_system_error(error), BAD_INPUT)
    except (OverflowError, RecursionError) as error:
        _end(" ".join(str(error).split()), BAD_INPUT)
    except UnicodeEncodeError as error:
        # A name of a file, in a locale without its letters.
        if error.encoding != sys.getfilesystemencoding():
            raise
        _end(
            f"{error.object}: this system writes names of files in {error.encoding}, which has no "
            f"{error.object[error.start]!r}; set PYTHONUTF8=1",
            BAD_INPUT,
        )
    except Exception as error:
        if is_memory_shortage(error):
            _end(_describe_shortage(error), BAD_INPUT)
        # Usage errors of the command line itself (unknown option, missing argument).
        if message := getattr(error, "format_message", None):
            context = getattr(error, "ctx", None)
            sentence = message() if message().endswith((".", "?")) else f"{message()}."
            _end(
                f"{sentence} See {context.command_path} --help." if context else sentence, BAD_INPUT
            )
        traceback.print_exc()
        leave(1)
    sys.exit(status)


def is_closed_pipe(error: OSError) -> bool:
    """Whether a write failed because nobody reads: on Windows an invalid argument of a stream."""
    return sys.platform == "win32" and error.errno == errno.EINVAL and error.filename is None


def _describe_system_error(error: OSError) -> str:
    """What the system refused, with the file."""
    why = error.strerror or " ".join(str(error).split())
    if error.filename is not None:
        return f"{error.filename}: {why}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        # Files are named where they are written, streams are not: does this one take a byte?
        try:
            os.write(sys.stdout.fileno(), b"\n")
        except OSError:
            return f"standard output: cannot be written: {why}"
    return why


def _describe_shortage(error: BaseException) -> str:
    reason = " ".join(str(error).split()).partition(" in function")[0]
    if "not enough memory" in reason:
        return reason
    return (
        "not enough memory"
        + (f" ({reason})" if reason else "")
        + (
            f", {free_memory() / 1e9:.1f} GB are free: raise the limit (ulimit -v, that of the "
            "container), end other programs, or make the input smaller"
        )
    )


def _end(message: object, status: int) -> NoReturn:
    with suppress(OSError):  # of a full disk, or a closed terminal: the status still says it
        print(f"jaxbundle: {message}", file=sys.stderr, flush=True)
    leave(status)
