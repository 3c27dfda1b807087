"""Conversion of any input to any output: reading, camera models, writing, and the differences.

A network becomes a network, or points and cameras in a drawing or table, or one of its cameras a
camera file; a camera file becomes a camera file. Nothing is written before all checks, and before
it is told what will be lost.
"""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxbundle.arguments import path as given_path
from jaxbundle.cameras import CameraModel, Conversion, key_of
from jaxbundle.display import print_anywhere
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.camera_files import choose_camera, is_camera_file, read_cameras
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.formats import FORMATS, check_own_models, read_network, recognise_format
from jaxbundle.io.networks.assemble import network_of_cameras
from jaxbundle.io.networks.bundler import LIST
from jaxbundle.io.networks.jaicov import COMPANION_SUFFIXES
from jaxbundle.io.networks.losses import describe_losses, describe_missing_values, losing
from jaxbundle.io.networks.project import FILE_NAME
from jaxbundle.io.output_formats import CAMERA_KINDS, TARGETS, has_model, recognise_target
from jaxbundle.io.results.coordinates import images_path
from jaxbundle.io.writing.folders import check_folder, replace_folder
from jaxbundle.network.columns import did_you_mean, list_some
from jaxbundle.network.conversion import convert_cameras, convert_one
from jaxbundle.network.image_bounds import outside_warnings
from jaxbundle.network.rules import check_camera
from jaxbundle.network.tables import Camera, Network

# What a file of cameras loses of a network; its kind says what of the cameras.
FILES_OF_CAMERAS = losing(
    "orientations of images", "points", keeping=("prior σ of camera parameters",)
)


@print_anywhere
@dataclasses.dataclass(frozen=True)
class Converted:
    """The written output: kind and path, camera differences, what is not kept, warnings, notes;
    `parts`: the files or folders of a rig that is written in pairs of cameras."""

    kind: str
    path: Path
    conversions: dict[str, Conversion]
    lost: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    parts: tuple[Path, ...] = ()

    def __str__(self) -> str:
        lines = [f"{', '.join(map(str, self.parts or (self.path,)))}: {self.kind}"]
        conversions = sorted(self.conversions.items(), key=lambda item: -item[1].largest)
        max_lines = 8  # the worst, on one screen; `conversions` has all
        lines += [f"camera {id!r} → {conversion}" for id, conversion in conversions[:max_lines]]
        if len(conversions) > max_lines:
            lines.append(
                f"and {len(conversions) - max_lines} more cameras, with smaller differences"
            )
        lines += describe_lost(self.lost)
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


HOLDS_ALL = "--camera {}: {} holds all cameras; omit it"


def describe_lost(lost: Sequence[str]) -> list[str]:
    """The line about what is not kept; none if nothing is lost."""
    return [f"not kept: {'; '.join(lost)}"] if lost else []


def convert(  # noqa: PLR0913, as the options of the command
    input: str | Path,
    output: str | Path,
    *,
    to: str | None = None,
    model: str | CameraModel | None = None,
    camera: str | None = None,
    format: str | None = None,
    overrides: Sequence[str] = (),
    measured: bool = False,
    image_size: Sequence[float] | None = None,
    pixel_size: Sequence[float] | None = None,
    force: bool = False,
    control: str | Path | None = None,
    models: Sequence[CameraModel] = (),
    tell: Callable[[Sequence[str]], None] = lambda _lost: None,
) -> Converted:
    """Write an input in another format.

    **Arguments:**

    - `to`: kind of output, a name of `TARGETS` or `CAMERA_KINDS`; recognised from the name of
      the output if not given.
    - `model`: camera model to convert to, by name or a `CameraModel`. Without it cameras are
      converted only if the output does not have their model and the conversion is exact.
    - `camera`: which camera, if the output holds one.
    - `format`, `overrides`, `control`, `models`: of the input, as in `read_network`.
    - `measured`: fit over the area of the measurements, not the whole image.
    - `image_size` (pixels), `pixel_size` (mm): of all cameras that have none.
    - `force`: replace existing files, the output and those written beside it. Otherwise only a
      folder written by `convert` is replaced.
    - `tell`: called with what the output will not keep, before it is written.

    **Raises:** `InputError`; nothing is written then.
    """
    input, output = Path(given_path("input", input)), Path(given_path("output", output))
    kind = _choose_kind(output, to)
    _check_path(output, kind)
    model = None if model is None else key_of(model)
    models = check_own_models(models)
    if format in (None, *CAMERA_KINDS) and is_camera_file(input):
        # Real paths: one of them may be a link.
        _refuse_overlap({os.path.realpath(input)}, {os.path.realpath(output)}, output)
        _protect_existing(output, kind, force)
        of_networks = {"--set": overrides, "--control": control, "--measured": measured}
        for option in (option for option, value in of_networks.items() if value):
            raise InputError(f"{option}: is for networks, {input} has cameras alone; omit it")
        cameras = _add_sizes(read_cameras(input, models), image_size, pixel_size)
        if kind in TARGETS and TARGETS[kind].alone:
            if camera is not None:
                raise InputError(HOLDS_ALL.format(camera, kind))
            network = network_of_cameras(cameras, str(input)).warn(*fit_messages(cameras))
            return _convert_network(network, output, kind, model, measured, force, (), tell)
        converted = _convert_cameras(input, cameras, output, kind, model, camera, tell)
        return dataclasses.replace(
            converted, warnings=(*fit_messages(cameras), *outside_warnings(cameras))
        )
    network = read_network(
        input,
        format=format,
        overrides=overrides,
        control=control,
        models=models,
        image_size=image_size,
    )
    unread = FORMATS[format or str(recognise_format(input))].unread
    network = network.replace(cameras=_add_sizes(network.cameras, image_size, pixel_size))
    network = network.warn(*outside_warnings(network.cameras, network))
    _protect_input(input, network, output, kind, control)
    _protect_existing(output, kind, force, network)
    if kind in CAMERA_KINDS:
        conversions = None
        if model is not None and measured:
            # The fit over the measurements needs the network; then there is nothing to convert.
            network, conversions = convert_cameras(network, model, measured=True)
            model = None
        converted = _convert_cameras(
            input, network.cameras, output, kind, model, camera, tell, network, unread
        )
        return dataclasses.replace(
            converted,
            conversions=converted.conversions if conversions is None else conversions,
            warnings=network.warnings,
            notes=network.notes,
        )
    if camera is not None:
        raise InputError(HOLDS_ALL.format(camera, kind))
    return _convert_network(network, output, kind, model, measured, force, unread, tell)


def _convert_network(
    network: Network,
    output: Path,
    kind: str,
    model: str | CameraModel | None,
    measured: bool,
    force: bool,
    unread: Sequence[str],
    tell: Callable[[Sequence[str]], None],
) -> Converted:
    network, conversions = _convert_models(network, kind, model, measured)
    if TARGETS[kind].empty_cells:
        network = network.warn(*describe_missing_values(network))
    folder, files = _output_folder(output, kind), TARGETS[kind].files
    format_losses = (*describe_losses(network, TARGETS[kind].losses), *unread)
    tell(format_losses)
    if folder is None:
        losses = TARGETS[kind].write(network, output)
    else:
        with replace_folder(folder, "convert", files, force) as new:
            losses = TARGETS[kind].write(network, new)
    parts = tuple(path for path in _output_paths(network, output, kind) if path.exists())
    parts = () if parts == (output,) else parts
    # A writer may meet more than the format loses by itself.
    losses = (*format_losses, *(loss for loss in losses if loss not in format_losses))
    return Converted(kind, output, conversions, losses, network.warnings, network.notes, parts)


def _output_paths(network: Network, output: Path, kind: str) -> tuple[Path, ...]:
    """The files or folders that are written."""
    target = TARGETS.get(kind)
    return (output,) if target is None or target.parts is None else target.parts(network, output)


def _choose_kind(output: Path, kind: str | None) -> str:
    kinds = {name: target.looks for name, target in (*TARGETS.items(), *CAMERA_KINDS.items())}
    if kind is not None:
        if kind not in kinds:
            raise InputError(f"--to {kind}: cannot be written{did_you_mean(kind, kinds)}")
        return kind
    recognised_kind = recognise_target(output)
    if recognised_kind is None:
        choices = "; ".join(f"{name}: {looks}" for name, looks in kinds.items())
        raise InputError(
            f"{output}: the output format is not recognised; give --to or a name: {choices}"
        )
    return recognised_kind


def _add_sizes(
    cameras: Sequence[Camera],
    image_size: Sequence[float] | None,
    pixel_size: Sequence[float] | None,
) -> tuple[Camera, ...]:
    """The cameras, with sizes added if missing."""
    sizes = {"image_size": image_size, "pixel_size": pixel_size}
    sized_cameras = tuple(
        dataclasses.replace(
            camera,
            **{
                name: tuple(size)
                for name, size in sizes.items()
                if size is not None and getattr(camera, name) is None
            },
        )
        for camera in cameras
    )
    for camera in sized_cameras:
        check_camera(camera)
    return sized_cameras


def _check_path(output: Path, kind: str) -> None:
    """Refuse a path that cannot be written."""
    folder = _output_folder(output, kind)
    if folder is not None and folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; {kind} is written into a folder")
    if folder != output and output.is_dir():
        raise InputError(f"{output}: is a folder; give the name of a file for {kind}")
    if folder is None and not output.absolute().parent.is_dir():
        raise InputError(f"{output}: there is no folder {output.parent}")


def _protect_input(
    input: Path, network: Network, output: Path, kind: str, control: str | Path | None = None
) -> None:
    """Refuse to replace the input: its files, and the folder that holds one of them."""
    tables = (
        network.images,
        network.points,
        network.observations,
        network.distances,
        *network.further,
    )
    # Real paths: an output may be the input by a link, or by a path with `..`.
    input_paths = {os.path.realpath(p) for p in (input, *(table.source.name for table in tables))}
    folders = {os.path.realpath(Path(p).parent) for p in input_paths}
    output_paths = {os.path.realpath(p) for p in (output, output / FILE_NAME)}
    if kind == "csv":
        output_paths.add(os.path.realpath(images_path(output)))
    folder = _output_folder(output, kind)
    if folder is not None and os.path.realpath(folder) in folders:
        output_paths |= input_paths  # who replaces the folder of an input replaces the input
    if control is not None:
        input_paths.add(os.path.realpath(control))
    _refuse_overlap(input_paths, output_paths, output)


def _refuse_overlap(input_paths: set[str], output_paths: set[str], output: Path) -> None:
    if input_paths & output_paths:
        raise InputError(f"{output} is the input and would be overwritten; give another place")


def _output_folder(output: Path, kind: str) -> Path | None:
    """The folder to write; None for a file, with others beside it or not."""
    if kind not in TARGETS or not TARGETS[kind].files:
        return None
    return output.parent if kind == "project" and output.name == FILE_NAME else output


def _protect_existing(output: Path, kind: str, force: bool, network: Network | None = None) -> None:
    """Refuse to replace existing files, and folders not written by `convert`."""
    folder = _output_folder(output, kind)
    if folder is not None:
        names = TARGETS[kind].files
        return check_folder(folder, "convert", names, force=force, option="")
    # Files that a writer adds to the one that is named.
    companions = {
        "csv": [images_path(output)],
        "bundler": [output.parent / LIST],
        "jaicov": [output.with_suffix(suffix) for suffix in COMPANION_SUFFIXES],
    }
    files = (output,) if network is None else _output_paths(network, output, kind)
    existing_files = [path for path in (*files, *companions.get(kind, [])) if os.path.lexists(path)]
    if existing_files and not force:
        raise InputError(
            f"{list_some([str(path) for path in existing_files], 3, str)}: already there and "
            "would be replaced; give another place, or --force"
        )


def _convert_models(
    network: Network, kind: str, model: str | CameraModel | None, measured: bool
) -> tuple[Network, dict[str, Conversion]]:
    """The network with camera models of the output, and the difference of each camera."""
    models = TARGETS[kind].models
    if model is not None:
        if not has_model(models, model):
            raise InputError(f"--model {model}: {kind} has {' and '.join(models)} only")
        return convert_cameras(network, model, measured=measured)
    # Without --model only exact conversions: a fit is a decision of the user.
    foreign = [c.id for c in network.cameras if not has_model(models, c.model)]
    if not foreign:
        return network, {}
    converted, conversions = convert_cameras(network, models[0], only=foreign, measured=measured)
    for id, conversion in conversions.items():
        _refuse_inexact(network.cameras, id, kind, conversion)
    return converted, conversions


def _refuse_inexact(cameras: Sequence[Camera], id: str, kind: str, conversion: Conversion) -> None:
    if not conversion.exact:
        model = next(camera.model for camera in cameras if camera.id == id)
        raise InputError(
            f"camera {id!r}: {kind} has no model {str(model)!r}, and {conversion.model} is not "
            f"the same: {conversion.reason}; fitted over the image the largest difference is "
            f"{conversion.largest:.3g} {conversion.unit}; give --model {conversion.model} to "
            "accept this"
        )


def _convert_cameras(
    input: Path,
    cameras: Sequence[Camera],
    output: Path,
    kind: str,
    model: str | CameraModel | None,
    id: str | None,
    tell: Callable[[Sequence[str]], None],
    network: Network | None = None,
    unread: Sequence[str] = (),
) -> Converted:
    """Write cameras; `network`: where they are from, which is lost."""
    if kind not in CAMERA_KINDS:
        raise InputError(
            f"{input}: contains only cameras; they can be written as "
            f"{', '.join((*CAMERA_KINDS, *(name for name, t in TARGETS.items() if t.alone)))}, not "
            f"as {kind}"
        )
    camera_kind = CAMERA_KINDS[kind]
    if camera_kind.single or id is not None:
        cameras = [choose_camera(cameras, id, str(input))]
    conversions, converted_cameras = {}, []
    for camera in cameras:
        foreign = not has_model(camera_kind.models, camera.model)
        target_model = model or (camera_kind.models[0] if foreign else camera.model)
        if target_model != camera.model:
            converted, conversions[camera.id] = convert_one(camera, target_model)
            if model is None:
                _refuse_inexact(cameras, camera.id, kind, conversions[camera.id])
            camera = converted
        converted_cameras.append(camera)
    if network is None:
        losses = describe_losses(
            network_of_cameras(converted_cameras, str(input)), camera_kind.losses
        )
    else:
        kind_losses = {**FILES_OF_CAMERAS, **camera_kind.losses}
        losses = describe_losses(network.replace(cameras=tuple(converted_cameras)), kind_losses)
    losses = (*losses, *unread)
    tell(losses)
    camera_kind.write(converted_cameras, output)
    return Converted(kind, output, conversions, losses, ())
