"""The scanner images of a refinement as files: scanner files of rigorous ones, compensated
coefficients of those with RPC."""

from collections.abc import Iterator
from pathlib import Path

from jaxbundle.io.scanner.refinement import RefineFile
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.io.scanner.writing import names_of, write_scanner_image
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.refinement import Refinement, RpcScannerImage

# Pixels that compensated coefficients may be off their bias without a warning: half of what good
# tie points are measured to. A bias of a pixel leaves some thousandths.
LARGEST_REFIT = 0.05


def names_of_images(file: RefineFile) -> list[str]:
    """The possible files of all images of a refine file."""
    return [
        name
        for one in file.images
        for name in (
            [f"{one.id}{file.rpc_ending}"] if isinstance(one, RpcScannerImage) else names_of(one.id)
        )
    ]


def write_images(folder: Path, file: RefineFile, result: Refinement) -> None:
    """Write the refined images into a folder."""
    for one in file.images:
        image = result.image(one.id)
        if isinstance(image, RpcImage):
            write_rpc(folder / f"{one.id}{file.rpc_ending}", image.rpc)
        else:
            write_scanner_image(folder, one.id, image, one.earth)


def describe_refits(result: Refinement) -> Iterator[str]:
    """Images whose compensated coefficients do not contain all of their bias, as warnings."""
    for one in result.inputs.rpc:
        check = result.compensated[one.id][1]
        if check is not None and check.largest.max() > LARGEST_REFIT:
            yield (
                f"image {one.id!r}: its compensated coefficients are up to "
                f"{check.largest.max():.2g} pixels off its bias; give a lower bias_degree"
            )
