"""The RPC that belong to a product with a rigorous model, and whether both agree.

| product | RPC |
|---|---|
| DigitalGlobe XML | `RPB` in the same file |
| DigitalGlobe `NAME.IMD` | `NAME.RPB` beside it |
| DIMAP 2 and 3, `DIM_NAME.XML` | `RPC_NAME.XML` beside it |
| DIMAP of the first products of Pléiades | in the same file |

Which corrections the attitudes leave to the reader differs between products of one vendor (a later
processing may contain them). So those usual for the product are used if they agree with the RPC
within half a pixel, or within the random error that the file states (ERRRAND, metres per axis);
else those that do. The difference is reported whenever none agree, or others than usual are used.
"""

import dataclasses
import glob
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.scanner.rpc import read_rpc, read_stated_errors
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc.agreement import (
    CORRECTION_SETS,
    SUBPIXEL,
    Agreement,
    compare_with_rpc,
)
from jaxbundle.pushbroom.rpc.image import heights_of
from jaxbundle.pushbroom.rpc.polynomials import Rpc


def check_against_rpc(
    scanner: ScannerInput, path: Path, choose: bool = True, expected: bool = False
) -> ScannerInput:
    """The image of a product, compared with its RPC if there are any: with corrections that agree
    and a warning if they are not the usual ones (`choose`), and a warning if none agree; also
    without RPC if they are `expected`."""
    file = _find_rpc_file(path)
    if file is None:
        if not expected:
            return scanner
        applied = _describe_corrections(scanner.image.corrections)
        return _warn(
            scanner, f"{path}: has no RPC that could choose corrections: {applied} applied"
        )
    try:
        unknown = UnknownKeys()
        rpc = read_rpc(file, unknown)
        random_error = read_stated_errors(file).random
    except InputError as error:
        return _warn(scanner, f"not compared with its RPC: {error}")
    for message in unknown.messages():
        scanner = _warn(scanner, message)
    image = scanner.image
    usual = _compare(image, rpc, (image.corrections,))[0]
    scanner = dataclasses.replace(scanner, agreement=usual, rpc_heights=heights_of(rpc))
    if _agree(usual, random_error):
        return scanner
    if not np.isfinite(usual.rms):
        return _warn(scanner, f"{path}: no position could be compared with the RPC of {file.name}")
    agreements = _compare(image, rpc, CORRECTION_SETS)
    best = min(range(len(agreements)), key=lambda k: np.nan_to_num(agreements[k].rms, nan=np.inf))
    best_set = CORRECTION_SETS[best]
    if _agree(agreements[best], random_error):
        if choose:
            message = (
                f"{path}: {_describe_corrections(best_set)} applied, with which the rigorous "
                f"model agrees with the RPC of {file.name} ({_describe_size(agreements[best])}); "
                f"with those usual for this product, {_describe_corrections(image.corrections)}, "
                f"it does not ({_describe_size(usual)}). [corrections] in a scanner file sets "
                "others"
            )
            image = dataclasses.replace(image, corrections=best_set)
            corrected_scanner = dataclasses.replace(
                scanner, image=image, agreement=agreements[best]
            )
            return _warn(corrected_scanner, message)
        remedy = (
            f"With {_describe_corrections(best_set)} they agree "
            f"({_describe_size(agreements[best])}): set [corrections] so"
        )
    else:
        comparison = "; others leave more"
        if best_set != image.corrections:
            comparison = (
                f"; the smallest difference, with {_describe_corrections(best_set)}, is "
                f"{_describe_size(agreements[best])}"
            )
        remedy = (
            f"No corrections explain it{comparison}. Check the origin of lines and pixels and "
            "whether the RPC are of this image, or use the RPC"
        )
    return _warn(
        scanner,
        f"{path}: the rigorous model, with {_describe_corrections(image.corrections)}, and the "
        f"RPC of {file.name} differ by more than their accuracy explains: "
        f"{_describe_size(usual)}. {remedy}",
    )


def _find_rpc_file(path: Path) -> Path | None:
    """The file of the RPC of a product; None if there is none."""
    suffix, stem = path.suffix.lower(), path.stem
    if suffix == ".imd":
        return next(
            (
                p
                for p in path.parent.glob(f"{glob.escape(stem)}.*")
                if p.suffix.lower() == ".rpb" and p.stem == stem
            ),
            None,
        )
    if stem.upper().startswith("DIM_"):
        file = path.with_name(f"RPC_{path.name[4:]}")
        if file.is_file():
            return file
    if suffix == ".xml":
        text = read_text(path, fallback="latin-1")
        if "<RPB>" in text or "<Rational_Sensor_Model>" in text:
            return path
    return None


def _compare(image: PushbroomImage, rpc: Rpc, sets: tuple[Corrections, ...]) -> list[Agreement]:
    with np.errstate(invalid="ignore"):
        return compare_with_rpc(image, rpc, sets)


def _agree(agreement: Agreement, random_error: float) -> bool:
    # The random error is per axis, the RMS of the length of both.
    return agreement.rms_pixels <= SUBPIXEL or agreement.rms <= np.sqrt(2) * random_error


def _describe_size(agreement: Agreement) -> str:
    return (
        f"{agreement.rms:.2g} m RMS, {agreement.rms_pixels:.2g} pixel; "
        f"{agreement.largest:.2g} m at most"
    )


def _describe_corrections(corrections: Corrections) -> str:
    applied = [name.replace("_", " ") for name, is_on in corrections._asdict().items() if is_on]
    if not applied:
        return "no correction"
    return applied[0] if len(applied) == 1 else f"{', '.join(applied[:-1])} and {applied[-1]}"


def _warn(scanner: ScannerInput, message: str) -> ScannerInput:
    return dataclasses.replace(scanner, warnings=(*scanner.warnings, message))
