"""The scanner images of a refinement as files: scanner files of rigorous ones, also model states of
the Community Sensor Model; compensated coefficients of those with RPC."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

from jaxbundle.geometry.ellipsoid import geodetic
from jaxbundle.io.scanner.csm_writing import StateFit, write_csm_state
from jaxbundle.io.scanner.refinement import RefineFile
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.io.scanner.writing import names_of, write_scanner_image
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.trajectory import attitude_at
from jaxbundle.refinement import Refinement, RpcScannerImage
from jaxbundle.system.programs import compile_once

# Pixels that compensated coefficients may be off their bias without a warning: half of what good
# tie points are measured to. A bias of a pixel leaves some thousandths.
LARGEST_REFIT = 0.05
# Metres on the ground that a model state may differ without a warning: a hundredth of a pixel of
# the finest satellites.
LARGEST_STATE_ERROR = 3e-3
STATE_ENDING = ".json"


def names_of_images(file: RefineFile) -> list[str]:
    """The possible files of all images of a refine file."""
    return [
        name
        for image in file.images
        for name in (
            [f"{image.id}{file.rpc_ending}"]
            if isinstance(image, RpcScannerImage)
            else [*names_of(image.id), *([f"{image.id}{STATE_ENDING}"] if file.csm_states else [])]
        )
    ]


def write_images(folder: Path, file: RefineFile, result: Refinement) -> dict[str, StateFit]:
    """Write the refined images into a folder; returns how well model states fit, by image."""
    fits = {}
    heights = _mean_height(result)
    for input_image in file.images:
        image = result.image(input_image.id)
        if isinstance(image, RpcImage):
            write_rpc(folder / f"{input_image.id}{file.rpc_ending}", image.rpc)
        else:
            write_scanner_image(folder, input_image.id, image, input_image.earth)
            if file.csm_states:
                path = folder / f"{input_image.id}{STATE_ENDING}"
                fits[input_image.id] = write_csm_state(
                    path, _with_smooth_attitude(image), input_image.earth, heights, input_image.id
                )
    return fits


def describe_states(fits: dict[str, StateFit]) -> Iterator[str]:
    """Model states that differ from their images, as warnings."""
    for id, fit in fits.items():
        if fit.ground > LARGEST_STATE_ERROR:
            yield (
                f"image {id!r}: its model state differs by up to {fit.ground:.2g} m on the ground "
                f"(trajectory {fit.trajectory:.2g}, optics {fit.optics:.2g}, corrections "
                f"{fit.corrections:.2g})"
            )


def _mean_height(result: Refinement) -> float:
    """The mean height of the points, where the corrections of states hold."""
    earth = next((image.earth for image in result.inputs.rigorous if image.earth is not None), None)
    X = np.asarray(result.positions)
    if earth is None or not len(X):
        return 0.0
    return float(np.mean(np.asarray(geodetic(earth, tuple(X.T))[2])))


def _with_smooth_attitude(image: PushbroomImage) -> PushbroomImage:
    """The image with Lagrange's polynomials through the quaternions instead of slerp, where these
    follow it to within twice the 1e-9 rad to which slerp follows the refined attitude: a state,
    of polynomials as well, would have to follow the corners of slerp."""
    attitude = image.trajectory.attitude
    table = dataclasses.replace(attitude.table, method="lagrange", order=7)
    smooth = dataclasses.replace(attitude, table=table, slerp=False)
    times = np.asarray(table.times)
    low, high = (float(image.times.time(line)) for line in (-0.5, image.lines - 0.5))
    middle = (times[1:] + times[:-1]) / 2
    middle = middle[(middle > low) & (middle < high)]
    if len(times) < 8 or not len(middle):
        return image
    slerp_rotations, smooth_rotations = (
        np.asarray(_rotations(a, middle)) for a in (attitude, smooth)
    )
    # Of small rotations.
    rotation_angles = np.linalg.norm(slerp_rotations - smooth_rotations, axis=(1, 2)) / np.sqrt(2)
    if not rotation_angles.max() < 2e-9:
        return image
    return eqx.tree_at(lambda i: i.trajectory.attitude, image, smooth)


_rotations = compile_once(jax.vmap(attitude_at, (None, 0)))


def describe_refits(result: Refinement) -> Iterator[str]:
    """Images whose compensated coefficients do not contain all of their bias, as warnings."""
    for image in result.inputs.rpc:
        refit = result.compensated[image.id][1]
        if refit is not None and refit.largest.max() > LARGEST_REFIT:
            yield (
                f"image {image.id!r}: its compensated coefficients are up to "
                f"{refit.largest.max():.2g} pixels off its bias; give a lower bias_degree"
            )
