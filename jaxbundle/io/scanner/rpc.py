"""Files of rational polynomial coefficients (RPC00B): text, RPB, tags of a GeoTIFF, and those of
products (`rpc_vendor_files`).

    LINE_OFF: +003000.50 pixels          text, `…_RPC.TXT`: one value a line, a unit may follow
    LINE_NUM_COEFF_1: -1.2E-03

    lineOffset = 3000.5;                 RPB, as of DigitalGlobe: coefficients in brackets
    lineNumCoef = ( -1.2E-03, …);

In all of them line 0, sample 0 is the centre of the first pixel, degrees and metres, as in `Rpc`.
Scales may be negative, as from some providers. Errors in a file (ERR_BIAS, ERR_RAND) are read by
`read_stated_errors`, and written where they are given; limits (MIN_LONG, …) are left. Keys that are
not known are told, or refused (`io.text.known_keys`); not in keyword lists of OSSIM, which hold the
state of the whole program.
"""

import re
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.rpc_vendor_files import from_geom, from_xml
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import number_in
from jaxbundle.io.writing.replacing import disk_of, replace_file
from jaxbundle.pushbroom.rpc.polynomials import TERMS, Rpc
from jaxbundle.system.foreign_parsers import foreign_parser
from jaxbundle.system.rasters import open_plain, open_raster, rasterio

# Names in text and in RPB.
OFFSETS = {
    "line": ("LINE", "line"),
    "sample": ("SAMP", "samp"),
    "longitude": ("LONG", "long"),
    "latitude": ("LAT", "lat"),
    "height": ("HEIGHT", "height"),
}
UNITS = {
    "line": "pixels",
    "sample": "pixels",
    "longitude": "degrees",
    "latitude": "degrees",
    "height": "meters",
}
UNIT_WORDS = {
    "pixels": {"pixels", "pixel"},
    "degrees": {"degrees", "degree", "deg"},
    "meters": {"meters", "metres", "meter", "metre", "m"},
}
RASTERS = (".tif", ".tiff", ".ntf", ".vrt")
FIELDS = {
    "line_numerator": ("LINE_NUM_COEFF", "lineNumCoef"),
    "line_denominator": ("LINE_DEN_COEFF", "lineDenCoef"),
    "sample_numerator": ("SAMP_NUM_COEFF", "sampNumCoef"),
    "sample_denominator": ("SAMP_DEN_COEFF", "sampDenCoef"),
}
STATED_ERROR = "read as a stated error where it is asked for"
TEXT_KEYS = Keys(
    (
        *(f"{name}_{part}" for name, _ in OFFSETS.values() for part in ("OFF", "SCALE")),
        *(f"{name}_{k}" for name, _ in FIELDS.values() for k in range(1, TERMS + 1)),
    ),
    {
        "ERR_*": STATED_ERROR,
        "MIN_*": "limits of the coefficients: beyond them positions are told to be outside anyway",
        "MAX_*": "the same",
    },
)
RPB_KEYS = Keys(
    (
        "SpecId",
        *(f"{key}{part}" for _, key in OFFSETS.values() for part in ("Offset", "Scale")),
        *(key for _, key in FIELDS.values()),
    ),
    {
        "err*": STATED_ERROR,
        "satId": "the name of the satellite",
        "bandId": "all bands of an image have the same coefficients",
        "BEGIN_GROUP": "the group of the coefficients",
        "END_GROUP": "the same",
    },
)
RPB = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*;?\s*$")
# The errors of RPC00B in XML, RPB, text and keyword lists of OSSIM.
ERRORS = {
    name: re.compile(rf"(?i)(?:<{word}>|\b{word}\s*=|\b{long}\s*:|\b{ossim}\s*:)\s*([-+.\de]+)")
    for name, word, long, ossim in (
        ("bias", "errbias", "err_bias", "bias_error"),
        ("random", "errrand", "err_rand", "rand_error"),
    )
}


class StatedErrors(NamedTuple):
    """Errors that coefficients state of themselves: RMS in metres for each horizontal axis, of what
    is common to all points of an image (ERR_BIAS) and of what is not (ERR_RAND); 0: not stated."""

    bias: float = 0.0
    random: float = 0.0


NOT_STATED = StatedErrors()


def read_rpc(path: str | Path, unknown: UnknownKeys | None = None) -> Rpc:
    """The coefficients of a text file, an RPB file, a raster with RPC tags, or of a product.

    **Arguments:** `unknown`: notices keys that are not understood (`UnknownKeys.messages`).

    **Raises:** `InputError` naming file and line: missing or repeated entries, invalid numbers,
    another unit, not RPC00B, an unknown key that may change the geometry.
    """
    path, unknown = Path(path), unknown or UnknownKeys()
    if path.suffix.lower() in RASTERS:
        values = _from_raster(path)
    else:
        text = read_text(path, fallback="latin-1")
        if text.lstrip().startswith("<"):
            values = from_xml(path, unknown)
        elif "line_num_coeff_00" in text or path.suffix.lower() == ".geom":
            values = from_geom(path, text)
        else:
            reader = _from_rpb if "lineOffset" in text else _from_text
            values = reader(path, text, unknown)
    for axis in OFFSETS:
        if values[f"{axis}_scale"] == 0:
            raise InputError(f"{path}: the scale of {axis} is 0; expected another number")
    for name in ("line_denominator", "sample_denominator"):
        if values[name][0] == 0:
            raise InputError(
                f"{path}: the {name.replace('_', ' ')} begins with 0; expected 1, as usual"
            )
    return Rpc(**{name: jnp.asarray(value, float) for name, value in values.items()})


def read_stated_errors(path: str | Path) -> StatedErrors:
    """The errors that a file of coefficients states, in any format that `read_rpc` reads.

    **Raises:** `InputError` if it cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() in RASTERS:
        with open_raster(path) as source, foreign_parser(f"{path}: its RPC", "those of a raster"):
            tags = source.rpcs
        texts = {name: getattr(tags, f"err_{name[:4]}", None) for name in ERRORS}
    else:
        text = read_text(path, fallback="latin-1")
        matches = {name: pattern.search(text) for name, pattern in ERRORS.items()}
        texts = {name: match and match[1] for name, match in matches.items()}
    # A negative number stands for an unknown one in RPC00B.
    number = lambda word: max(number_in(str(word), f"{path}: its stated error"), 0.0)
    return StatedErrors(**{name: number(word) for name, word in texts.items() if word is not None})


def write_rpc(path: str | Path, rpc: Rpc, errors: StatedErrors = NOT_STATED) -> None:
    """Write coefficients for `read_rpc`, exact to the last digit (15 in a GeoTIFF).

    `.txt`: text; `.rpb`: RPB; `.tif`: the tags of a GeoTIFF that exists. `errors`: those of the
    coefficients (`read_stated_errors` of the file they are from); none are written for 0.

    **Raises:** `InputError` for another ending, and where the file cannot be written.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".txt":
            write_text(path, _plain_text(rpc, errors))
        case ".rpb":
            write_text(path, _rpb_text(rpc, errors))
        case suffix if suffix in RASTERS:
            _to_raster(path, rpc, errors)
        case _:
            raise InputError(f"{path}: coefficients end in .txt, .rpb or, of a raster, .tif")


def _from_text(path: Path, text: str, unknown: UnknownKeys) -> dict[str, Any]:
    entries = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        name, colon, value = line.partition(":")
        if not colon:
            raise InputError(
                f"{path}, line {number}: {show(line.strip())}; expected NAME: value, such as "
                "LINE_OFF: 3000.5"
            )
        spelling, name = name.strip(), name.strip().upper()
        if name in entries:
            raise InputError(f"{path}, line {number}: {name} occurs twice")
        entries[name] = value.split(), number
        # As it is written: capitals show where the words of an unknown name begin.
        if TEXT_KEYS.unknown((name,)):
            unknown.check((spelling,), TEXT_KEYS, f"{path}, line {number}")

    def number_of(name: str, unit: str | None = None) -> float:
        if name not in entries:
            raise InputError(f"{path}: {name} is missing; expected an RPC00B text file")
        words, line = entries[name]
        value = number_in(words[0] if words else "", f"{path}, line {line}: {name}")
        if unit and len(words) > 1 and words[1].lower() not in UNIT_WORDS[unit]:
            raise InputError(f"{path}, line {line}: {name} is in {words[1]}; expected {unit}")
        return value

    values = {}
    for axis, (name, _) in OFFSETS.items():
        values[f"{axis}_offset"] = number_of(f"{name}_OFF", UNITS[axis])
        values[f"{axis}_scale"] = number_of(f"{name}_SCALE", UNITS[axis])
    for field, (name, _) in FIELDS.items():
        values[field] = [number_of(f"{name}_{k}") for k in range(1, TERMS + 1)]
    return values


def _from_rpb(path: Path, text: str, unknown: UnknownKeys) -> dict[str, Any]:
    entries, name = {}, None
    for number, line in enumerate(text.splitlines(), 1):
        if name is None:
            match = RPB.match(line)
            if match is None:
                continue
            key, value = match.groups()
            if key in entries:
                raise InputError(f"{path}, line {number}: {key} occurs twice")
            entries[key] = [value, number]
            name = key if "(" in value and ")" not in value else None
        else:  # a list goes on to its closing bracket
            entries[name][0] += " " + line.strip().rstrip(";")
            name = None if ")" in line else name
    kind = entries.get("SpecId", ['"RPC00B"', 0])
    if kind[0].strip('"') != "RPC00B":
        raise InputError(
            f"{path}, line {kind[1]}: SpecId is {kind[0]}; only RPC00B is read, whose terms are "
            "in another order"
        )
    for key, (_, line) in entries.items():
        unknown.check((key,), RPB_KEYS, f"{path}, line {line}")

    def value_of(key: str) -> tuple[str, str]:
        if key not in entries:
            raise InputError(f"{path}: {key} is missing; expected an RPB file of RPC00B")
        return entries[key][0], f"{path}, line {entries[key][1]}: {key}"

    values = {}
    for axis, (_, key) in OFFSETS.items():
        values[f"{axis}_offset"] = number_in(*value_of(f"{key}Offset"))
        values[f"{axis}_scale"] = number_in(*value_of(f"{key}Scale"))
    for field, (_, key) in FIELDS.items():
        value, where = value_of(key)
        numbers = [part for part in value.strip("() \t").split(",") if part.strip()]
        # A bracket that was cut off gives fewer.
        if len(numbers) != TERMS:
            raise InputError(f"{where} has {len(numbers)} coefficients; expected {TERMS}")
        values[field] = [number_in(part, where) for part in numbers]
    return values


def _from_raster(path: Path) -> dict[str, Any]:
    with open_raster(path) as source, foreign_parser(f"{path}: its RPC", "those of a raster"):
        tags = source.rpcs
    if tags is None:
        raise InputError(f"{path}: the raster has no RPC tags; give a file of coefficients")
    values = {}
    for axis, (_, key) in OFFSETS.items():
        values[f"{axis}_offset"] = getattr(tags, f"{key}_off")
        values[f"{axis}_scale"] = getattr(tags, f"{key}_scale")
    for field, (name, _) in FIELDS.items():
        values[field] = getattr(tags, name.lower())
        if len(values[field]) != TERMS or not np.isfinite(values[field]).all():
            raise InputError(f"{path}: {name} of the RPC tags: expected {TERMS} finite numbers")
    return values


def _to_raster(path: Path, rpc: Rpc, errors: StatedErrors) -> None:
    package = rasterio()
    from rasterio.rpc import RPC

    tags = {}
    for axis, (_, key) in OFFSETS.items():
        tags[f"{key}_off"] = float(getattr(rpc, f"{axis}_offset"))
        tags[f"{key}_scale"] = float(getattr(rpc, f"{axis}_scale"))
    for field, (name, _) in FIELDS.items():
        tags[name.lower()] = np.asarray(getattr(rpc, field)).tolist()
    # None: GDAL writes −1, an unknown error of RPC00B.
    tags |= {"err_bias": errors.bias or None, "err_rand": errors.random or None}
    if not path.is_file():
        raise InputError(f"{path}: no such file; RPC tags are written into a raster that exists")
    try:
        with replace_file(path) as temporary:
            # The tags of the copy change: after a failure the raster is as it was.
            shutil.copyfile(path, temporary)
            with open_plain(temporary, "r+") as target:
                target.rpcs = RPC(**tags)
            with package.open(temporary) as target:  # errors at closing are not reported
                if target.rpcs is None:
                    raise InputError(f"{path}: cannot be written: no tags arrived{disk_of(path)}")
    except (OSError, package.errors.RasterioError) as error:
        raise InputError(f"{path}: cannot be written: {' '.join(str(error).split())}") from None


def _plain_text(rpc: Rpc, errors: StatedErrors) -> str:
    named = {"ERR_BIAS": errors.bias, "ERR_RAND": errors.random}
    lines = [f"{name}: {value!r} meters" for name, value in named.items() if value]
    for part in ("OFF", "SCALE"):
        for axis, (name, _) in OFFSETS.items():
            value = float(getattr(rpc, f"{axis}_{'offset' if part == 'OFF' else 'scale'}"))
            lines.append(f"{name}_{part}: {value!r} {UNITS[axis]}")
    for field, (name, _) in FIELDS.items():
        for k, value in enumerate(np.asarray(getattr(rpc, field)).tolist(), 1):
            lines.append(f"{name}_{k}: {value!r}")
    return "\n".join(lines) + "\n"


def _rpb_text(rpc: Rpc, errors: StatedErrors) -> str:
    lines = ['satId = "";', 'bandId = "";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    named = {"errBias": errors.bias, "errRand": errors.random}
    lines += [f"\t{name} = {value!r};" for name, value in named.items() if value]
    for part in ("Offset", "Scale"):
        for axis, (_, key) in OFFSETS.items():
            lines.append(f"\t{key}{part} = {float(getattr(rpc, f'{axis}_{part.lower()}'))!r};")
    for field, (_, key) in FIELDS.items():
        numbers = ",\n\t\t\t".join(map(repr, np.asarray(getattr(rpc, field)).tolist()))
        lines.append(f"\t{key} = (\n\t\t\t{numbers});")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;"]) + "\n"
