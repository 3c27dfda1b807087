"""What `jaxbundle batch` computes of its inputs: keys, settings, fingerprints, rows."""

import dataclasses
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.arguments import integer, one_of
from jaxbundle.batches.calibrate import calibrate_batch
from jaxbundle.batches.calibrate_rigs import SECTIONS, rig_settings
from jaxbundle.batches.input import any_model, free_parameters, is_plain
from jaxbundle.batches.photographs import (
    PhotographFolders,
    calibrate_views,
    is_photograph_folder,
    of_photographs,
)
from jaxbundle.batches.rig_photographs import RigFolders, rig_of_views
from jaxbundle.batches.rigs import UNEXPECTED, RigSettings, solve_rigs
from jaxbundle.batches.snooping import TESTS
from jaxbundle.batches.stacks import CameraStack, is_camera_stack, read_camera_stack
from jaxbundle.cameras import CameraModel
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io import read_network
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.io.networks.settings import apply_overrides
from jaxbundle.io.results.result_json import result_dict
from jaxbundle.io.writing.fingerprints import of_input
from jaxbundle.leastsquares.quality.snooping import check_test
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.views import search_alone, searches_at_once
from jaxbundle.photographs.formats import is_photograph
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.system.workers import Workers

# Rigs between two writes: what an interruption loses. A rig is a network of its own, and takes
# longer than a camera of a batch; not critical.
RIGS_A_WRITE = 32
SIGMA_IMAGE = "sigma_image"
# Settings present only in lines computed with them.
WHERE_GIVEN = (
    "snooping",
    "significance",
    "correlated",
    "pixel_size",
    "set",
    "sigma_image",
    *SECTIONS,
)
# Called with the share of the work that is done, 0 to 1.
ShareDone = Callable[[float], None]


@dataclasses.dataclass(frozen=True)
class Work:
    """The work for an input, or for all folders of photographs.

    **Fields:** `keys` of its lines; their `settings`; `data`, the fingerprint of number i; `solve`
    computes the rows of some inputs by number and reports the fraction done; `made_of`: the
    fingerprinted data in words; `portion`: maximum number computed between two writes.
    """

    keys: tuple[str, ...]
    settings: dict
    data: Callable[[int], str]
    solve: Callable[[Sequence[int], ShareDone], Iterable[dict]]
    made_of: str = "the measurements"
    is_network: bool = False
    portion: int = sys.maxsize


@dataclasses.dataclass(frozen=True)
class BatchSettings:
    """The checked settings of a run: those of cameras, of rigs, of networks."""

    model: CameraModel
    model_name: str
    free: Sequence[str] | None
    board: Board | None
    rig: bool
    pixel_size: float | None
    overrides: tuple[str, ...]
    adjusting: Mapping[str, Any]
    brief: bool
    correlated: bool = False

    @classmethod
    def check(
        cls,
        model: str | CameraModel,
        free: Sequence[str] | None,
        board: Board | None,
        rig: bool,
        pixel_size: float | None,
        overrides: Sequence[str],
        max_iterations: int,
        snooping: str | None,
        significance: float,
        brief: bool,
    ) -> "BatchSettings":
        """The settings from the arguments of `run_batch`.

        **Raises:** `InputError`."""
        one_of("snooping", snooping, TESTS, allow_none=True)
        check_test(snooping, significance)
        if board is not None:
            require_board(board)
            need_opencv()
        elif rig:
            raise InputError("rig: give the board that is in the photographs (--board)")
        adjusting = {"max_iterations": integer("max_iterations", max_iterations)}
        if snooping is not None:
            adjusting |= dict(snooping=snooping, significance=significance)
        return cls(
            any_model(model),
            str(model),
            free,
            board,
            rig,
            pixel_size,
            tuple(overrides),
            adjusting,
            brief,
        )

    def sections(self) -> dict[str, Any]:
        """The sections of rigs in the overrides, and `sigma_image`.

        **Raises:** `InputError` for other ones."""
        for override in self.overrides:
            if re.split(r"[.=]", override)[0].strip() not in (*SECTIONS, SIGMA_IMAGE):
                known_settings = ", ".join((SIGMA_IMAGE, *(f"{name}.KEY" for name in SECTIONS)))
                raise InputError(
                    f"--set {override}: of cameras and rigs {known_settings} can be set; "
                    "parameters are estimated by --free"
                )
        document = apply_overrides({"project": {}, "camera": []}, self.overrides)
        document |= document["project"]
        return {name: document[name] for name in (*SECTIONS, SIGMA_IMAGE) if name in document}

    def as_rigs(self) -> RigSettings:
        """The settings of cameras and rigs that are adjusted as networks.

        **Raises:** `InputError` for correlated errors of them."""
        if self.correlated:
            raise InputError(
                "correlated: not for rigs, rolling shutters and models in mm; use calibrate or "
                "calibrate-rig, or leave it out"
            )
        sections = self.sections()
        sigma = sections.pop(SIGMA_IMAGE, None)
        return rig_settings(
            self.model, self.free, sections, self.pixel_size, sigma, **self.adjusting
        )

    def are_plain(self) -> bool:
        """Whether single cameras are calibrated by `calibrate_batch`."""
        return is_plain(self.model) and "rolling_shutter" not in self.sections()

    def of_cameras(self) -> dict:
        """Settings of the lines of cameras and rigs."""
        settings = {"model": self.model_name, "free": list(free_parameters(self.model, self.free))}
        settings |= {
            **self.adjusting,
            **self._correlated_setting,
            "brief": self.brief,
            **self.sections(),
        }
        return settings | ({} if self.pixel_size is None else {"pixel_size": self.pixel_size})

    def of_networks(self) -> dict:
        """Settings of the lines of networks."""
        settings = {**self.adjusting, **self._correlated_setting}
        return settings | ({"set": list(self.overrides)} if self.overrides else {})

    @property
    def _correlated_setting(self) -> dict:
        # Lines of earlier versions do not have it.
        return {"correlated": True} if self.correlated else {}

    @property
    def of_batch(self) -> dict[str, Any]:
        """Options of `calibrate_batch`."""
        return {**self.adjusting, "correlated": "camera" if self.correlated else None}


def plan_works(
    inputs: Mapping[str, str],
    file: str | os.PathLike,
    settings: BatchSettings,
    open_resources: ExitStack,
) -> list[Work]:
    """The work of all inputs by their names; what it needs open is `open_resources`."""
    works: dict[str, Work] = {}
    folders: dict[str, str] = {}
    for name, path in inputs.items():
        if is_camera_stack(path):
            works[name] = _stack(read_camera_stack(path), name, settings)
        elif settings.board is not None and is_photograph_folder(path):
            folders[name] = path
        else:
            works[name] = _network(path, name, settings)
    if settings.board is not None and folders:
        # Corners are kept beside the results, except where these are no file (/dev/stdout).
        regular = os.path.isfile(file) or not os.path.exists(file)
        kept_corners = open_resources.enter_context(
            KeptCorners(f"{file}.corners" if regular else ":memory:")
        )
        # The photographs of a folder are of one size.
        of_folders = (filter(is_photograph, Path(folder).rglob("*")) for folder in folders.values())
        some_photographs = [
            path for photograph_folders in of_folders for path in islice(photograph_folders, 1)
        ]
        # Bytes of a process that searches boards, before its first photograph (measured).
        at_once = searches_at_once(some_photographs, settings.board, 280e6)
        workers = open_resources.enter_context(Workers(search_alone, at_once))
        if settings.rig:
            rigs = RigFolders(tuple(folders.values()), settings.board, kept_corners, workers)
            works["photographs"] = _photographed_rigs(rigs, tuple(folders), settings)
        else:
            photograph_folders = PhotographFolders(
                tuple(folders.values()), settings.board, kept_corners, workers
            )
            works["photographs"] = _detect(photograph_folders, tuple(folders), settings)
    return [*works.values()]


def _stack(stack: CameraStack, name: str, settings: BatchSettings) -> Work:
    brief = settings.brief
    keys = tuple(f"{name}#{camera}" for camera in stack.ids)

    def cameras(rows: Sequence[int], _: ShareDone) -> list[dict]:
        batch = calibrate_batch(
            **stack.arguments(np.asarray(rows)),
            model=settings.model,
            free=settings.free,
            **settings.of_batch,
        )
        return [batch.row(i, brief) for i in range(len(rows))]

    def rigs(rows: Sequence[int], tell: ShareDone) -> list[dict]:
        return [shorten(row, brief) for row, _ in solve_rigs(stack.rigs(rows), of_rigs, tell)]

    if settings.are_plain() and not stack.of_rigs:
        return Work(keys, settings.of_cameras(), stack.fingerprint, cameras)
    of_rigs = settings.as_rigs()
    return Work(keys, settings.of_cameras(), stack.fingerprint, rigs, portion=RIGS_A_WRITE)


def _detect(
    photograph_folders: PhotographFolders, keys: tuple[str, ...], settings: BatchSettings
) -> Work:
    brief, plain = settings.brief, settings.are_plain()
    of_rigs = None if plain else settings.as_rigs()
    options = {"model": settings.model, "free": settings.free, **settings.of_batch}

    def solve(folder_rows: Sequence[int], tell: ShareDone) -> list[dict]:
        measured = photograph_folders.measure(folder_rows, tell)
        rows = {
            i: {"status": "bad input", "error": why}
            for i, why in measured.items()
            if isinstance(why, str)
        }
        views = {
            i: views_of_camera
            for i, views_of_camera in measured.items()
            if not isinstance(views_of_camera, str)
        }
        if of_rigs is None:
            for i, batch, place in calibrate_views(views, options):
                rows[i] = batch.row(place, brief, len(views[i]))
        else:
            rigs = [rig_of_views({"cam": views_of_camera}) for views_of_camera in views.values()]
            solved = solve_rigs(rigs, of_rigs)
            rows |= {i: shorten(row, brief) for i, (row, _) in zip(views, solved)}
        for i in views:
            rows[i] |= of_photographs(views[i], brief)
        return [rows[i] for i in folder_rows]

    # The board is a setting of the lines: other corners are found with another one.
    lines = settings.of_cameras() | {"board": repr(photograph_folders.board)}
    portion = sys.maxsize if plain else RIGS_A_WRITE
    return Work(
        keys, lines, photograph_folders.fingerprint, solve, "its photographs", portion=portion
    )


def _photographed_rigs(
    rig_folders: RigFolders, keys: tuple[str, ...], settings: BatchSettings
) -> Work:
    of_rigs = settings.as_rigs()

    def solve(folder_rows: Sequence[int], tell: ShareDone) -> list[dict]:
        measured = rig_folders.measure(folder_rows, tell)
        rows = {
            i: {"status": "bad input", "error": why}
            for i, why in measured.items()
            if isinstance(why, str)
        }
        rigs = {
            i: rig_and_entries
            for i, rig_and_entries in measured.items()
            if not isinstance(rig_and_entries, str)
        }
        solved = solve_rigs([rig for rig, _ in rigs.values()], of_rigs)
        for (i, (_, entries)), (row, _) in zip(rigs.items(), solved):
            rows[i] = shorten(row, settings.brief) | entries
        return [rows[i] for i in folder_rows]

    lines = settings.of_cameras() | {"board": repr(rig_folders.board)}
    return Work(
        keys, lines, rig_folders.fingerprint, solve, "its photographs", portion=RIGS_A_WRITE
    )


def shorten(row: dict, brief: bool) -> dict:
    """The row of a rig; `brief`: without images, their velocities, correlations."""
    if not brief or "images" not in row:
        return row
    cameras = {
        id: {k: v for k, v in camera.items() if k != "correlations"}
        for id, camera in row["cameras"].items()
    }
    further_unknowns = {
        name: estimates for name, estimates in row["further_unknowns"].items() if name != "velocity"
    }
    row = row | {
        "cameras": cameras,
        "further_unknowns": further_unknowns,
        "removed": len(row["removed"]),
    }
    return {key: value for key, value in row.items() if key != "images"}


def _network(path: str, name: str, settings: BatchSettings) -> Work:
    solve = lambda numbers, _: [
        network_row(path, settings.overrides, correlated=settings.correlated, **settings.adjusting)
        for _ in numbers
    ]
    return Work((name,), settings.of_networks(), lambda _: of_input(path), solve, "its files", True)


def network_row(path: str, overrides: Sequence[str] = (), **options: Any) -> dict:
    """The status and brief result of one network (`options` of `adjust`), or the reason for a
    failure."""
    try:
        result = adjust(read_network(path, overrides=tuple(overrides)), **options)
        status = "converged" if result.converged else result.termination
        return {"status": status} | result_dict(result, brief=True)
    except (InputError, NotSolvedError) as error:
        status = "bad input" if isinstance(error, InputError) else "not solved"
        return {"status": status, "error": str(error)}
    # One broken network must not end a night of others.
    except UNEXPECTED as error:
        return {"status": "failed", "error": f"{type(error).__name__}: {error}"}
