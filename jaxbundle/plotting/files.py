"""All figures of a result as PNG files, without a display and without pyplot."""

import io
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.plotting.cameras import correlation_matrix, correlation_size, distortion_curve
from jaxbundle.plotting.images import residual_histogram, residual_vectors
from jaxbundle.plotting.matches import Pairs, match_graph, overlap_matrix, tracks_in_photograph
from jaxbundle.plotting.style import need_matplotlib
from jaxbundle.plotting.views import network_perspective, network_plan
from jaxbundle.types import Progress

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

# The stage of figures in reports of progress.
DRAWING = "drawing"
# Suffix of an id that is the name of a photograph; removed in names of figures.
PHOTOGRAPH = re.compile(r"\.(jpe?g|png|tiff?|bmp|webp|pgm|ppm|jp2)$", re.IGNORECASE)
# Patterns of the names of the figures of a result.
FIGURES = (
    "plan.png",
    "perspective.png",
    "histogram.png",
    "residuals_*.png",
    "distortion_*.png",
    "correlations_*.png",
)
# Patterns of the figures of pairs of photographs, and of the tracks in them.
PAIRS, TRACKS = ("match_graph.png", "overlap.png"), "tracks_*.png"


def save_figures(
    adjustment: "Adjustment",
    folder: str | Path,
    force: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the figures of a result into a folder, all or none.

    plan.png, perspective.png, histogram.png, residuals_IMAGE.png of at most 12 images (those with
    the largest RMS), distortion_CAMERA.png and correlations_CAMERA.png of at most 6 cameras;
    correlations only if two parameters are free. Ids are made safe for file names.

    **Arguments:** `force`: also replace existing figures not written by this function;
    `progress(stage, done, total)`.

    **Returns:** the paths written.

    **Raises:** `ImportError` without matplotlib, `InputError` if the folder cannot or may not be
    written (`jaxbundle.io.writing.folders`), `NotSolvedError` if there is no result.
    """
    need_matplotlib()
    with replace_folder(folder, "save_figures", FIGURES, force) as new:
        paths_written = draw_figures(adjustment, new, progress)
    return [Path(folder) / path.name for path in paths_written]


def draw_figures(
    adjustment: "Adjustment",
    folder: Path,
    progress: Progress | None = None,
    max_images: int = 12,
    max_cameras: int = 6,
) -> list[Path]:
    """Write the figures of a result into an existing folder; as `save_figures`."""
    table = adjustment.images
    worst = np.argsort(-np.nan_to_num(table["rms"]), kind="stable")[:max_images]
    drawings = {
        "plan": ((7.5, 6.5), None, network_plan, ()),
        "perspective": ((7.5, 6.5), "3d", network_perspective, ()),
        "histogram": ((6.5, 4.2), None, residual_histogram, ()),
    }
    names = FigureNames(drawings)
    for image in table["id"][np.sort(worst)]:
        drawings[names("residuals", image)] = ((7, 6), None, residual_vectors, (image,))
    for camera, entry in list(adjustment.cameras.items())[:max_cameras]:
        drawings[names("distortion", camera)] = ((6.5, 4.2), None, distortion_curve, (camera,))
        n = len(entry["free"])
        if n > 1:
            drawings[names("correlations", camera)] = (
                correlation_size(n),
                None,
                correlation_matrix,
                (camera,),
            )
    return write_figures(
        folder,
        {
            name: (size, projection, partial(draw, adjustment, *arguments))
            for name, (size, projection, draw, arguments) in drawings.items()
        },
        progress,
    )


def draw_pairs(
    names: Sequence[str],
    pairs: Pairs,
    alone: Sequence[str],
    folder: Path,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the match graph and the overlap of photographs; arguments as of `match_graph`."""
    graph, overlap = (Path(name).stem for name in PAIRS)
    return write_figures(
        folder,
        {
            graph: ((7, 7), None, partial(match_graph, names, pairs, alone)),
            overlap: ((7, 6), None, partial(overlap_matrix, names, pairs)),
        },
        progress,
    )


def draw_tracks(
    adjustment: "Adjustment",
    read_photograph: Callable[[str], np.ndarray],
    folder: Path,
    progress: Progress | None = None,
    max_images: int = 12,
) -> list[Path]:
    """Write the tracks of at most `max_images` photographs, evenly chosen.

    **Arguments:** `read_photograph(image)`: its grey values, of any size.
    """
    images = adjustment.network.images.id
    chosen_rows = np.unique(
        np.linspace(0, len(images) - 1, min(len(images), max_images)).astype(int)
    )
    names = FigureNames(())
    return write_figures(
        folder,
        {
            names("tracks", images[k]): (
                (8, 6),
                None,
                lambda ax, id=images[k]: tracks_in_photograph(
                    adjustment, id, read_photograph(id), ax
                ),
            )
            for k in chosen_rows
        },
        progress,
    )


def write_figures(
    folder: str | Path, drawings: Mapping[str, tuple], progress: Progress | None = None
) -> list[Path]:
    """Write figures NAME.png into a folder, each file completely or not at all.

    **Arguments:** `drawings`: by name the size in inches, the projection (None or "3d"), and the
    function that draws on the axes `ax`; `progress(stage, done, total)`.

    **Returns:** the paths written. **Raises:** as `save_figures`.
    """
    need_matplotlib()
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from error
    tell = progress or (lambda *_: None)
    paths_written: list[Path] = []
    for name, (size, projection, draw) in drawings.items():
        tell(DRAWING, len(paths_written), len(drawings))
        path = folder / f"{name}.png"
        write_bytes(path, png(size, projection, draw))
        paths_written.append(path)
    tell(DRAWING, len(paths_written), len(drawings))
    return paths_written


def png(
    size: tuple[float, float],
    projection: str | None,
    draw: Callable[..., object],
    dots_per_inch: int = 150,
    margin: float = 0.15,
) -> bytes:
    """One drawing as a PNG image; size and the margin around it in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    # Margins by the layout, and no savefig: both it and cropping draw once more.
    layout = ConstrainedLayoutEngine(w_pad=margin, h_pad=margin)
    figure = Figure(figsize=size, dpi=dots_per_inch, layout=layout)
    canvas = FigureCanvasAgg(figure)
    data = io.BytesIO()
    with warnings.catch_warnings():
        # Names in a script missing from the font: boxes in the figure, no action required.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        draw(ax=figure.add_subplot(projection=projection))  # some measure their text
        # The least compression: half the time to write, a ninth more bytes.
        canvas.print_png(data, pil_kwargs={"compress_level": 1})
    return data.getvalue()


class FigureNames:
    """File names from ids: letters, digits, dot, dash and underscore; each once, in any case."""

    def __init__(self, names_taken: Iterable[str]):
        self.taken = {name.casefold() for name in names_taken}

    def __call__(self, kind: str, id: str) -> str:
        id = PHOTOGRAPH.sub("", str(id)) or id
        # 60: file systems allow 255 bytes, of which a kind and a number take some
        safe = re.sub(r"[^\w.-]+", "_", str(id), flags=re.ASCII).strip("._")[:60] or "unnamed"
        name, number = f"{kind}_{safe}", 1
        while name.casefold() in self.taken:
            number += 1
            name = f"{kind}_{safe}_{number}"
        self.taken.add(name.casefold())
        return name
