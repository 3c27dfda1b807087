"""The images of a refinement with the joint covariance of their orientations, as files in its
folder.

`refined.csv`: a row for each scanner image.

| column | |
|---|---|
| `id`, `file` | the image; its refined scanner file, or its compensated coefficients |
| `raster` | its pixels, beside the table or relative to it; empty if none was found |
| `sensor`, `knot_spacing` | of a rigorous image: whose sensor it shares; of its jitter, seconds |
| `line_offset` … `sample_scale` | of an image with RPC: of the coefficients given to `refine` |

`precision.csv`: the covariance, in the form of that of photographs (`networks`), with the kinds
`image` and `sensor` and the parameters of the report; radians, metres, pixels. σ are a posteriori.
Unknowns that are not listed are held.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.networks.orientation_covariance import (
    FILE,
    OrientationCovariance,
    Unknown,
    read_orientation_covariance,
    write_orientation_covariance,
)
from jaxbundle.io.scanner.refinement import RefineFile
from jaxbundle.io.scanner.rpc_images import find_raster
from jaxbundle.io.text.csv_tables import read_csv, write_csv
from jaxbundle.network.columns import list_some
from jaxbundle.pushbroom.rpc.bias import BiasDomain, domain_of_bias
from jaxbundle.refinement import Refinement, RpcScannerImage
from jaxbundle.refinement.freedom import UnknownName
from jaxbundle.system.paths import relative_path

TABLE = "refined.csv"
HEAD = ("id", "file", "raster", "sensor", "knot_spacing", *BiasDomain._fields)
KINDS = ("image", "sensor")


@dataclasses.dataclass(frozen=True)
class RefinedFile:
    """An image of a refinement: its file, its raster if it is where it was, the name of that, its
    sensor, and the spacing of the knots of its jitter (s); `domain` of its bias, with RPC."""

    id: str
    file: Path
    raster: Path | None
    raster_name: str
    sensor: str
    knot_spacing: float
    domain: BiasDomain | None = None


@dataclasses.dataclass(frozen=True)
class RefinedBlock:
    """The images of a refinement, and the covariance of their orientations, None: all held."""

    images: tuple[RefinedFile, ...]
    covariance: OrientationCovariance | None

    def image_of(self, file: Path) -> RefinedFile | None:
        """The image of a refined file, if it is one of them."""
        return next((image for image in self.images if image.file.name == file.name), None)


def joint_covariance(result: Refinement) -> OrientationCovariance | None:
    """The covariance of the unknowns of all scanner images and their sensors, a posteriori; None:
    all are held."""
    unknowns = [_unknown_of(name) for name in result.names]
    unknown_rows = [k for k, unknown in enumerate(unknowns) if unknown is not None]
    C: Float[np.ndarray, "m m"] = result.covariance
    if not unknown_rows:
        return None
    return OrientationCovariance(
        tuple(unknown for unknown in unknowns if unknown is not None),
        C[np.ix_(unknown_rows, unknown_rows)],
    )


def _unknown_of(name: UnknownName) -> Unknown | None:
    """An unknown as in the file; None: of a photograph or its camera, which have their project."""
    kind, _, owner = name.owner.partition(" ")
    return (kind, owner, name.parameter) if kind in KINDS else None


def write_refined_orientations(
    folder: Path, final_folder: Path, file: RefineFile, result: Refinement
) -> None:
    """Write table and covariance into a folder, which will be `final_folder`."""
    rows = []
    for image in file.images:
        raster = find_raster(file.sources[image.id])
        # From where the folder will be: now it has a temporary name.
        raster_path = "" if raster is None else relative_path(raster, final_folder)
        if isinstance(image, RpcScannerImage):
            domain = domain_of_bias(image.image.rpc)
            rows.append((image.id, f"{image.id}{file.rpc_ending}", raster_path, "", "", *domain))
        else:
            sensor_fields = image.sensor or image.id, image.freedom.knot_spacing
            rows.append((image.id, f"{image.id}.toml", raster_path, *sensor_fields, "", "", "", ""))
    write_csv(folder / TABLE, HEAD, rows)
    covariance = joint_covariance(result)
    if covariance is not None:
        # 1 radian: angles of scanner images are in radians, whatever angle_unit the refine file has
        write_orientation_covariance(covariance, folder / FILE, 1.0)


def read_refined_orientations(folder: Path) -> RefinedBlock | None:
    """The images of a refinement; None for a folder without.

    **Raises:** `InputError` naming file and line.
    """
    path = folder / TABLE
    if not path.is_file():
        return None
    table = read_csv(path)
    table.check_names(HEAD)
    spacing, images = table.numbers("knot_spacing"), []
    domains = np.stack([table.numbers(name) for name in BiasDomain._fields], 1)
    for k, (id, file, raster, sensor) in enumerate(zip(*(table.values[n] for n in HEAD[:4]))):
        refined = folder / file
        if not file or not refined.is_file():
            raise InputError(f"{table.source(k)}: no such file {refined}; refine again with --out")
        # Images may have been moved since: a raster is needed for matching only, not for change.
        pixels = folder / raster if raster and (folder / raster).is_file() else None
        # Empty with RPC, which has no jitter: the number is not used.
        knots = float(spacing[k]) if spacing[k] == spacing[k] else 1.0
        if not knots > 0:
            raise InputError(f"{table.source(k)}: knot_spacing is {knots:g}; seconds above 0")
        domain = BiasDomain(*domains[k].tolist()) if np.isfinite(domains[k]).all() else None
        if domain is not None and 0.0 in domain[1::2]:
            raise InputError(f"{table.source(k)}: a scale is 0; those of the coefficients are not")
        name = Path(raster).name
        images.append(RefinedFile(id, refined, pixels, name, sensor or id, knots, domain))
    if not images:
        raise InputError(f"{path}: no image")
    covariance = None
    if (folder / FILE).is_file():
        covariance = read_orientation_covariance(folder / FILE, 1.0)
        _check_owners(folder / FILE, images, covariance)
    return RefinedBlock(tuple(images), covariance)


def _check_owners(path: Path, images: list[RefinedFile], covariance: OrientationCovariance) -> None:
    """Refuse unknowns of images that are not there: the σ would be too small."""
    owners = {("image", image.id) for image in images} | {
        ("sensor", image.sensor) for image in images
    }
    covered = {(kind, id) for kind, id, _ in covariance.unknowns}
    foreign_unknowns = sorted(f"{kind} {id}" for kind, id in covered - owners)
    if foreign_unknowns:
        raise InputError(
            f"{path}: has unknowns of {list_some(foreign_unknowns, 3, str)}, which {TABLE} does "
            "not list; both are of one refinement"
        )
