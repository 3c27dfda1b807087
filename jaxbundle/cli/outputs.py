"""Output of the command line: a JSON file, and a folder of report, JSON, tables, plots and the
adjusted network as a project.

`check_targets` checks before an adjustment that its results can be written.
"""

import dataclasses
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from jaxbundle import report
from jaxbundle.adjustment.error_budget import Budget
from jaxbundle.adjustment.orientation_covariance import orientation_covariance
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cli.acceptance import accept_result, end_unmet
from jaxbundle.cli.certificate_options import JUDGEMENT_FILES
from jaxbundle.commands.origins import network_files as network_files
from jaxbundle.commands.origins import trace_files as trace_files
from jaxbundle.commands.origins import trace_origin as trace_origin
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.networks.orientation_covariance import FILE as PRECISION
from jaxbundle.io.networks.orientation_covariance import write_orientation_covariance
from jaxbundle.io.networks.project import ADJUSTED, fill_project
from jaxbundle.io.networks.project import FILES as NETWORK_FILES
from jaxbundle.io.results.budget_json import budget_dict
from jaxbundle.io.results.result_json import json_text, result_text, unsolved_text
from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.io.text.csv_tables import table_rows, write_bytes, write_csv, write_text
from jaxbundle.io.writing.folders import check_folder, keep_inputs, replace_folder
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Network
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.orientation.swapped_control import CONTRADICTORY_CONTROL
from jaxbundle.plotting.files import FIGURES, draw_figures
from jaxbundle.plotting.style import need_matplotlib
from jaxbundle.report.budget import budget_lines
from jaxbundle.report.page import UNKNOWN, Addition, Origin, compose, compose_failure
from jaxbundle.report.page.adjustment import NO_ADDITION
from jaxbundle.report.page.budget import describe_budget
from jaxbundle.report.verdict import Verdict
from jaxbundle.results import ReportedResult
from jaxbundle.system.terminals import write_json
from jaxbundle.types import Progress

REPORT, PAGE, RESULT = "report.txt", "report.html", "result.json"
TABLES = ("cameras", "images", "points", "residuals", "checks", "far_points")
# The table of an error budget, and its entry in the JSON.
BUDGET = "budget"
# The files of a folder, figures as patterns.
FILES = (
    REPORT,
    PAGE,
    RESULT,
    *(f"{name}.csv" for name in (*TABLES, BUDGET)),
    *JUDGEMENT_FILES,
    *(f"{ADJUSTED}/{name}" for name in NETWORK_FILES),
    f"{ADJUSTED}/{PRECISION}",
    *FIGURES,
)

NOTHING: Mapping = MappingProxyType({})


class Supplement(Protocol):
    """What options add to a result: entries of its JSON, text after its report, findings and
    sections of its page, files of its folder."""

    @property
    def json(self) -> Mapping[str, Any]: ...

    @property
    def text(self) -> str: ...

    @property
    def addition(self) -> Addition: ...

    def fill(self, folder: Path) -> None: ...


@dataclasses.dataclass(frozen=True)
class BudgetSupplement:
    """The error budget of `--budget`, and what follows it."""

    budget: Budget | None = None
    rest: Supplement | None = None

    @property
    def json(self) -> Mapping[str, Any]:
        budget_entry = NOTHING if self.budget is None else {BUDGET: budget_dict(self.budget)}
        return {**budget_entry, **(NOTHING if self.rest is None else self.rest.json)}

    @property
    def text(self) -> str:
        budget_text = "" if self.budget is None else "\n".join([*budget_lines(self.budget), ""])
        return budget_text + ("" if self.rest is None else self.rest.text)

    @property
    def addition(self) -> Addition:
        budget_addition = describe_budget(self.budget)
        return (
            budget_addition
            if self.rest is None
            else budget_addition.followed_by(self.rest.addition)
        )

    def fill(self, folder: Path) -> None:
        if self.budget is not None:
            columns = self.budget.table()
            write_csv(folder / f"{BUDGET}.csv", list(columns), table_rows(columns))
        if self.rest is not None:
            self.rest.fill(folder)


# The beginning of JSON; a TOML table, `[project]`, does not match.
JSON = re.compile(rb'\s*(\{\s*["}]|\[[\s\[]*([]{"\d-]|true|false|null))')
# The beginning of a saved adjustment, an .npz.
SAVED_ADJUSTMENT = re.compile(rb"PK\x03\x04")
# The beginning of a page.
HTML = re.compile(rb"\s*<(!doctype\s+html|html)\b", re.IGNORECASE)
FORCE_ADVICE = ", or --force to replace it"


def check_writable(
    json: str,
    out: Path | None,
    command: str,
    names: Iterable[str],
    inputs: Iterable[str | Path],
    force: bool = False,
    html: str = "",
) -> None:
    """Refuse a JSON file, a page, or a folder for files of these names, that the command `command`
    cannot or may not write (`io.writing.folders`, `check_json`), or that would replace one of the
    inputs."""
    inputs = tuple(inputs)
    if out is not None:
        check_folder(out, command, names, inputs, force)
    check_file("--json", json, out, inputs)
    if not force:
        check_json(json, FORCE_ADVICE)
    if html and json and os.path.realpath(html) == os.path.realpath(json):
        raise InputError(f"--html {html}: is also the file of --json; give another name")
    check_page(html, out, inputs, force)


def check_page(
    html: str, out: Path | None, inputs: Iterable[str | Path], force: bool = False
) -> None:
    """Refuse a page that cannot be written, or would replace an input or a file that is not a
    page."""
    if html == "-":
        raise InputError("--html -: a page cannot be written to standard output; give a file")
    check_file("--html", html, out, inputs)
    if not force:
        check_content("--html", html, HTML, "HTML", FORCE_ADVICE)


def check_file(option: str, file: str, out: Path | None, inputs: Iterable[str | Path]) -> None:
    """Refuse the file of an option if it cannot be written or would replace an input."""
    if file in ("", "-"):
        return
    path = Path(file)
    real = Path(os.path.realpath(path))
    if path.is_dir():
        raise InputError(f"{option} {file}: is a folder; give the name of a file")
    if out is not None and Path(os.path.realpath(out)).is_relative_to(real):
        raise InputError(f"{option} {file}: is the folder of --out; give the name of a file")
    if name_inside(file, out) is None:
        if not os.path.isdir(path.parent):
            raise InputError(f"{option} {file}: there is no folder {path.parent}")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise InputError(f"{option} {file}: cannot be written: no permission in {path.parent}")
    keep_inputs(f"{option} {file}", path, inputs)


def check_json_target(json: str, inputs: Iterable[str | Path]) -> None:
    """Refuse a file of --json that cannot be written, is not JSON, or would replace an input."""
    check_file("--json", json, None, inputs)
    check_json(json)


def check_tables(inputs: Sequence[str | Path], json: str, **files: Path | None) -> None:
    """Refuse the file of --json, and others by the names of their options, that cannot be written
    or would replace an input."""
    check_json_target(json, inputs)
    for option, file in files.items():
        check_file(f"--{option.replace('_', '-')}", str(file or ""), None, inputs)


def print_result(
    result: ReportedResult, json: str, quiet: bool = False, accept: Sequence[str] | None = None
) -> None:
    """Print the report of a result, or write its JSON (`-`: instead of the report). `quiet`: no
    report beside a file; `accept`: criteria, whose verdict follows.

    **Raises:** `typer.Exit` with status 4 if a criterion is not met."""
    acceptance = accept_result(result, accept)
    if json:
        entries = NOTHING if acceptance is None else {"acceptance": acceptance.to_dict()}
        put_json(json, {**result.to_dict(), **entries})
    if json != "-" and not (quiet and json):
        print(result.report())
        if acceptance is not None:
            print(f"\n{acceptance}")
    end_unmet(acceptance)


def put_json(json: str, document: Mapping) -> None:
    """Write a document to the file of --json; `-`: standard output."""
    text = json_text(document)
    if json == "-":
        write_json(text)
    else:
        write_text(Path(json), text)


def check_json(json: str, alternative: str = "", option: str = "--json") -> None:
    """Refuse to replace a file that is not JSON, unless it is empty: it was probably named by
    mistake. `alternative`: an alternative to another name, for the message.
    """
    check_content(option, json, JSON, "JSON", alternative)


def check_content(
    option: str, file: str, pattern: re.Pattern[bytes], noun: str, alternative: str
) -> None:
    """Refuse to replace a file that is not empty and does not begin like the new one."""
    path = Path(file)
    if file in ("", "-") or not path.is_file():
        return
    try:
        with path.open("rb") as stream:
            # Enough for blanks before the first sign.
            head = stream.read(4096)
    except OSError as error:
        raise InputError(f"{option} {file}: cannot be read: {error.strerror}") from None
    if head and not pattern.match(head):
        raise InputError(
            f"{option} {file}: exists and is not {noun}; give another name{alternative}"
        )


def check_targets(
    input: Path,
    network: Network,
    json: str,
    out: Path | None,
    control: Path | None = None,
    force: bool = False,
    html: str = "",
    save: str = "",
) -> None:
    """Check the output files of `adjust` before computing (`check_writable`)."""
    inputs = network_files(input, network, control)
    check_writable(json, out, "adjust", FILES, inputs, force, html)
    if save == "-":
        raise InputError("--save -: give the name of a file")
    check_file("--save", save, None, inputs)
    if not force:
        check_content("--save", save, SAVED_ADJUSTMENT, "a saved adjustment", FORCE_ADVICE)


def name_inside(file: str, out: Path | None) -> str | None:
    """The name of a file directly in the folder of --out, to which it then belongs."""
    if file in ("", "-") or out is None:
        return None
    path = Path(file)
    return path.name if os.path.realpath(path.parent) == os.path.realpath(out) else None


@contextmanager
def write_result(
    json: str,
    text: str | Iterable[str],
    out: Path | None,
    command: str,
    names: Iterable[str],
    force: bool,
    html: str = "",
    page: Callable[[], Iterable[str]] | None = None,
) -> Iterator[Path | None]:
    """Write the JSON of a result (`-`: standard output) and its `page`, and yield the folder to
    fill, which becomes --out, or None. The folder always contains the page.

    Files of --json and --html are written after the folder is in place; files inside the folder
    belong to it.
    """
    if json == "-":
        write_json(text)
    if out is None:
        yield None
    else:
        with replace_folder(out, command, names, force) as new:
            yield new
            if (name := name_inside(json, out)) is not None:
                write_text(new / name, text)
                json = ""
            if page is not None:
                if not (new / PAGE).exists():
                    write_text(new / PAGE, page())
                if (name := name_inside(html, out)) not in (None, PAGE):
                    write_bytes(new / name, (new / PAGE).read_bytes())
    # Only now: if the folder could not be written, neither is the rest.
    if json not in ("", "-"):
        write_text(Path(json), text)
    if page is not None and html and name_inside(html, out) is None:
        if out is None:
            write_text(Path(html), page())
        else:
            # A copy: the page of a large result takes seconds to make.
            write_bytes(Path(html), (out / PAGE).read_bytes())


def write_targets(
    result: Adjustment | NotSolvedError,
    json: str,
    out: Path | None,
    brief: bool,
    plots: bool,
    force: bool = False,
    html: str = "",
    origin: Origin = UNKNOWN,
    supplement: Supplement | None = None,
    progress: Progress | None = None,
) -> None:
    """Write JSON (`-`: standard output), page and folder of a result with what options add
    (`supplement`), or the reason for a failure."""
    solved = isinstance(result, Adjustment)
    entries = NOTHING if supplement is None else supplement.json

    def text(brief: bool) -> str | Iterable[str]:
        if isinstance(result, Adjustment):
            return result_text(result, brief, entries)
        return unsolved_text(result)

    def page() -> Iterable[str]:
        if isinstance(result, Adjustment):
            return compose(
                result, origin, also=NO_ADDITION if supplement is None else supplement.addition
            )
        return compose_failure(result, origin)

    plots = plots and out is not None and solved and result.converged and can_plot()
    with write_result(json, text(brief), out, "adjust", FILES, force, html, page) as new:
        if new is not None:
            if isinstance(result, Adjustment):
                fill_results(result, new, plots, "", entries, supplement, progress, origin.computed)
            else:
                write_text(new / REPORT, f"{result}\n")
                write_text(new / RESULT, text(False))


def fill_results(
    result: Adjustment,
    folder: Path,
    plots: bool,
    note: str = "",
    entries: Mapping = NOTHING,
    supplement: Supplement | None = None,
    progress: Progress | None = None,
    date: str = "",
    verdict: Verdict | None = None,
) -> None:
    """Write report, JSON, tables, the adjusted network and plots of a result into a folder.

    `note`: text before the report; `entries`: further JSON entries; `supplement`: what options add;
    `date` of the computation, for the report; `verdict`: that of the command, if it has further
    tests."""
    tell = progress or (lambda *_: None)
    tell("writing the report", 0, 2)
    report_text = report_with(result, supplement, date, verdict)
    write_text(folder / REPORT, note + report_text)
    write_text(folder / RESULT, result_text(result, False, entries))
    tell("writing the report", 1, 2)
    if result.converged:
        _write_tables(result, folder)
        if supplement is not None:
            supplement.fill(folder)
        fill_project(readjustable_network(result), folder / ADJUSTED)
        if (covariance := orientation_covariance(result)) is not None:
            unit = ANGLE_UNITS[result.network.angle_unit]
            write_orientation_covariance(covariance, folder / ADJUSTED / PRECISION, unit)
    tell("writing the report", 2, 2)
    if plots:
        draw_figures(result, folder, progress)


def report_with(
    result: Adjustment,
    supplement: Supplement | None,
    date: str = "",
    verdict: Verdict | None = None,
) -> str:
    """The report of a result, with what options add: findings in its verdict, text after it."""
    if (
        supplement is not None
        and result.converged
        and verdict is None
        and supplement.addition.findings
    ):
        verdict = supplement.addition.conclude(result)
    report_text = report.text(result, date=date, verdict=verdict)
    return (
        report_text if supplement is None or not result.converged else report_text + supplement.text
    )


def why_not(result: Adjustment) -> str:
    """Why an adjustment did not converge, and the remedy."""
    parts = [f"not solved: {result.termination}"]
    # Wrong control bends the network, and whatever is then weak is no remedy.
    warnings = result.problem.network.warnings
    if contradictions := [line for line in warnings if CONTRADICTORY_CONTROL in line]:
        parts += contradictions
    elif result.undetermined:
        parts.append(f"not determined: {list_some(result.undetermined, 12, str)}")
        parts.append("fix them, give them a prior σ, or add measurements that determine them")
        parts += result.findings
    elif result.findings or result.weakness.lines:
        parts += [*result.findings, *result.weakness.lines]
    elif "limit" in result.termination:
        parts.append("raise --max-iterations or give better start values")
    else:
        parts.append("give better start values and look for gross errors")
    return "; ".join(parts)


def can_plot() -> bool:
    """Whether matplotlib is installed; if not, print a note on standard error."""
    try:
        need_matplotlib()
    except ImportError as error:
        print(f"no plots: {error}", file=sys.stderr)
        return False
    return True


def _write_tables(result: Adjustment, folder: Path) -> None:
    for name in TABLES:
        table = result.table(name)
        if table:
            write_csv(folder / f"{name}.csv", list(table), table_rows(table))
