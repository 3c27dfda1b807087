"""The output folder of `jaxbundle design`."""

from functools import partial
from pathlib import Path

from jaxbundle.io.networks.project import FILES as NETWORK_FILES
from jaxbundle.io.networks.project import fill_project
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.network_design.result import Design
from jaxbundle.types import Progress

REPORT, RESULT = "report.txt", "design.json"
FIGURES = ("before.png", "after.png", "path.png")
FILES = (REPORT, RESULT, *FIGURES, *NETWORK_FILES)


def fill_design(
    folder: Path, designed: Design, report: str, text: str, plots: bool, progress: Progress
) -> None:
    """Write the designed project, report, JSON and figures into a folder."""
    fill_project(designed.network, folder)
    write_text(folder / REPORT, report)
    write_text(folder / RESULT, text)
    if plots:
        from jaxbundle.plotting.designs import aim_path, network_view
        from jaxbundle.plotting.files import write_figures

        views = {
            "before": ((7.5, 6.5), "3d", partial(network_view, designed, after=False)),
            "after": ((7.5, 6.5), "3d", partial(network_view, designed)),
            "path": ((6.5, 4.0), None, partial(aim_path, designed)),
        }
        write_figures(folder, views, progress)
