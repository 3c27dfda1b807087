"""What the commands for calibrations check before they compute, and write after it."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from jaxbundle.calibration import Calibrations, ModelComparison
from jaxbundle.calibration.files import (
    COMPARED,
    PAGE,
    REPORT,
    RESULT,
    calibrations_dict,
    check_names,
    files_of,
    fill_calibrations,
    fill_comparison,
    json_text,
)
from jaxbundle.calibration.page import KIND, compose_calibrations
from jaxbundle.cli.certificate_options import (
    JUDGEMENT_FILES,
    NOT_JUDGED,
    CertificateOptions,
)
from jaxbundle.cli.common_options import is_in_file
from jaxbundle.cli.judging import judge_of
from jaxbundle.cli.outputs import can_plot, check_writable, name_inside, trace_files, write_result
from jaxbundle.cli.progress import counting
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.results.result_json import unsolved_text
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.network.columns import count
from jaxbundle.report.page import UNKNOWN, Origin, compose_failure, head_line
from jaxbundle.report.page.adjustment import NO_ADDITION


@dataclasses.dataclass(frozen=True)
class CalibrationOutputs:
    """Where a command writes its calibration.

    **Fields:** `command` whose folder it is; `names` of the cameras; `photographs` searched;
    `settings`: options and their values, for the page; the options of the command; `judged`: those
    of criteria and certificate, about cameras of these `models`.
    """

    command: str
    names: Sequence[str]
    photographs: Sequence[Path]
    settings: Mapping[str, Any]
    json: str = ""
    out: Path | None = None
    html: str = ""
    force: bool = False
    brief: bool = False
    quiet: bool = False
    plots: bool = True
    compared: bool = False
    judged: CertificateOptions = NOT_JUDGED
    models: Sequence[str] = ()

    def check(self) -> Origin:
        """Check the files; what the result is from, for its page."""
        for path in self.photographs:
            if not path.exists():
                raise InputError(f"{path}: no such file or folder")
        check_names(self.names)
        inputs = self.photographs
        check_writable(self.json, self.out, self.command, self.files, inputs, self.force, self.html)
        if self.html or self.judged.certificate or self.out is not None:
            files = [*inputs, *self.judged.files]
            return trace_files(files, {**self.settings, **self.judged.settings})
        return UNKNOWN

    @property
    def judge(self) -> Any:
        """The judge of the result."""
        outputs = {"--json": self.json, "--html": self.html}
        return judge_of(
            self.command,
            self.judged,
            outputs,
            self.out,
            self.photographs,
            models=self.models,
            camera_names=self.names,
            force=self.force,
        )

    @property
    def files(self) -> list[str]:
        """The files that may be in the folder."""
        judged = list(JUDGEMENT_FILES) if any(self.judged) else []
        return files_of([*self.names]) + (COMPARED if self.compared else []) + judged

    def compute(
        self, calibrate: Callable[[Callable], tuple[Calibrations, ModelComparison | None]]
    ) -> None:
        """Calibrate, write, and print the report; `calibrate(progress)` gives the result and the
        comparison of models, if any.

        **Raises:** `NotSolvedError` for cameras without a solution, after all is written.
        """
        judge, origin = self.judge, self.check()
        with counting(self.quiet or self.json == "-") as bar:
            task = bar.add_task("searching the board", total=len(self.photographs))

            def tell(*_: object) -> None:
                bar.advance(task)
                if bar.tasks[task].finished:
                    bar.update(task, description="adjusting")

            with self._written_if_unsolved(origin):
                calibrations, compared = calibrate(tell)
            bar.update(task, description="assessing accuracy")
            judgement = judge.judge(calibrations, origin)
            report = self._write(
                calibrations,
                compared,
                origin,
                judgement,
                lambda stage, done, total: bar.update(
                    task, description=stage, completed=done, total=total
                ),
            )
            judge.write(judgement)
        if report:
            print(report)
        require_solved(calibrations)
        judge.end(judgement)

    @contextmanager
    def _written_if_unsolved(self, origin: Origin) -> Iterator[None]:
        """Write the failure of what raises `NotSolvedError`."""
        try:
            yield
        except NotSolvedError as error:
            # A failure makes no folder, unless a file that was asked for belongs in it.
            is_in_folder = name_inside(self.json, self.out) or name_inside(self.html, self.out)
            place = self.out if is_in_folder else None
            page = partial(compose_failure, error, origin, KIND)
            with write_result(
                self.json, unsolved_text(error), place, self.command, self.files, self.force,
                self.html, page,
            ):  # fmt: skip
                pass
            raise

    def _write(
        self,
        calibrations: Calibrations,
        compared: ModelComparison | None,
        origin: Origin,
        judgement: Any,
        show: Callable[[str, int, int], object],
    ) -> str:
        """Write the result; the report, unless nobody is to see it."""
        document = calibrations_dict(calibrations, self.brief) if self.json else {}
        if compared is not None and self.json:
            document["models"] = compared.to_dict()
        if judgement is not None and self.json:
            document |= judgement.json
        text = json_text(document) if self.json else ""
        has_file = is_in_file(self.json, self.out, self.html, self.judged.certificate)
        is_silent = self.json == "-" or (self.quiet and has_file)
        # With a folder, the whole report is there: hundreds of lines.
        prints_report = self.out is None or compared is not None
        report = (
            ""
            if is_silent
            else (compared or calibrations).report()
            if prints_report
            else calibrations.summary()
        )
        if report:
            report = head_line(origin) + report + ("" if judgement is None else judgement.text)
        if report and self.out is not None:
            report += f"\nReport: {self.out / REPORT}, as a page: {self.out / PAGE}"
        show("writing", 0, 1)
        addition = NO_ADDITION if judgement is None else judgement.addition
        page = partial(compose_calibrations, calibrations, origin, compared, addition)
        plots = self.plots and self.out is not None and can_plot()
        with write_result(
            self.json, text, self.out, self.command, self.files, self.force, self.html, page
        ) as new:
            if new is not None:
                fill_calibrations(calibrations, new, plots, origin, compared, show)
                if compared is not None:
                    fill_comparison(compared, new, plots, show)
                if judgement is not None:
                    judgement.fill(new)
                    _add_judgement(calibrations, judgement, new, page())
        return report


def _add_judgement(
    calibrations: Calibrations, judgement: Any, folder: Path, page: Iterable[str]
) -> None:
    """The page, the numbers and the report of a folder with the judgement of the result."""
    write_text(folder / PAGE, page)
    numbers = calibrations_dict(calibrations) | judgement.json
    write_text(folder / RESULT, json_text(numbers))
    report = (folder / REPORT).read_text(encoding="utf-8")
    write_text(folder / REPORT, report + judgement.text)


def require_solved(calibrations: Calibrations) -> None:
    """Refuse calibrations of which one has no solution.

    **Raises:** `NotSolvedError`."""
    failed = [
        name for name, calibration in calibrations.cameras.items() if not calibration.converged
    ]
    if failed:
        names = calibrations.cameras[failed[0]].adjustment.undetermined
        undetermined = f"; not determined: {', '.join(names[:12])}" if names else ""
        number_of_others = count(len(failed) - 1, "other camera")
        others_in_words = f"; {number_of_others} not solved either: {', '.join(failed[1:])}"
        raise NotSolvedError(
            f"not solved: camera {failed[0]}: "
            f"{calibrations.cameras[failed[0]].adjustment.termination}{undetermined}; free fewer "
            "parameters (--free), or take photographs from more "
            f"directions{others_in_words if len(failed) > 1 else ''}"
        )


def words(text: str) -> list[str]:
    """Words separated by commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def values(assignments: Sequence[str] | None) -> dict[str, float]:
    """Values by name, of NAME=VALUE."""
    numbers = {}
    for item in assignments or ():
        name, equals, text = (part.strip() for part in item.partition("="))
        try:
            numbers[name] = float(text)
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(f"--given {item}: expected NAME=VALUE, such as fx=1200")
    return numbers
