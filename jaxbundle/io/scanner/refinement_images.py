"""The images of a refine file with their unknowns: sections [images], [models], [sensors],
[unknowns]."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.rpc import read_stated_errors
from jaxbundle.io.scanner.rpc_images import find_coefficients, has_rpc_only, read_rpc_image
from jaxbundle.io.text.sections import TomlFile, TomlSection
from jaxbundle.network.columns import did_you_mean
from jaxbundle.refinement.freedom import Freedom
from jaxbundle.refinement.rpc_points import BIAS_TERMS, prior_of_bias, prior_of_errors
from jaxbundle.refinement.tables import (
    AnyScannerImage,
    RpcScannerImage,
    ScannerImage,
    is_same_earth,
)

MODELS = ("rigorous", "rpc")
# Unknowns of images with RPC; those of rigorous images are the fields of `Freedom`.
OF_RPC = ("bias_degree", "bias")
STATED_BIAS = "stated"
WORDS = {"free": math.inf, "held": 0.0}
ANGULAR_UNKNOWNS = ("attitude", "attitude_rate", "jitter", "mounting")
LISTED_UNKNOWNS = ("look_across", "look_along")


def read_images(file: TomlFile, radians: float) -> tuple[list[AnyScannerImage], list[str]]:
    """The images with their unknowns, and warnings of their readers."""
    path, scanners = file.path, file.section("images")
    if not scanners.values:
        raise InputError(f'{path}, [images]: no image; give id = "scanner.toml"')
    sensors, unknowns, models = (file.section(n) for n in ("sensors", "unknowns", "models"))
    sensors.check_keys(tuple(scanners.values))
    models.check_keys(tuple(scanners.values))
    own_unknowns = {k: v for k, v in unknowns.values.items() if isinstance(v, dict)}
    common_unknowns = {k: v for k, v in unknowns.values.items() if k not in own_unknowns}
    for id in own_unknowns:
        if id not in scanners.values:
            raise InputError(
                f"{path}, [unknowns.{id}]: no such image{did_you_mean(id, scanners.values)}"
            )
    images, warnings = [], []
    section = lambda name, values: TomlSection(file, f"{path}, [{name}]: ", values)
    fields = tuple(sorted(f.name for f in dataclasses.fields(Freedom)))
    section("unknowns", common_unknowns).check_keys((*fields, *OF_RPC))
    for id in scanners.values:
        source = scanners.path(id, "a scanner file, the file of a product, or an image with RPC")
        own_entries, name = (
            own_unknowns.get(id, {}),
            f"unknowns.{id}" if id in own_unknowns else "unknowns",
        )
        is_rpc = _is_rpc(source, models, id)
        allowed_keys = OF_RPC if is_rpc else fields
        # What is common to all images is for those that have it.
        entries = {k: v for k, v in common_unknowns.items() if k in allowed_keys} | own_entries
        unknowns_of_image = section(name, entries)
        _check_own_keys(unknowns_of_image, own_entries, allowed_keys, is_rpc)
        if is_rpc:
            image, reader_warnings = _read_rpc_image(id, source, unknowns_of_image)
            images.append(image)
            warnings += reader_warnings
            continue
        scanner = read_scanner(source)
        warnings += scanner.warnings
        freedom = _read_freedom(unknowns_of_image, radians)
        # Without an entry an image is a sensor of its own.
        images.append(ScannerImage(id, scanner.image, scanner.earth, freedom, sensors.text(id, id)))
    if all(isinstance(image, ScannerImage) for image in images):
        file.require(("unknowns",))
    for image in images:
        if not is_same_earth(image.earth, images[0].earth):
            raise InputError(
                f"{path}, [images]: {images[0].id!r} and {image.id!r} have different ellipsoids or "
                "frames; points can be in one only (images with RPC are in WGS84)"
            )
    return images, warnings


def _is_rpc(source: Path, models: TomlSection, id: str) -> bool:
    """Whether an image is taken by its RPC: where it has nothing else, or [models] says so."""
    model = models.text(id, "")
    if model not in ("", *MODELS):
        raise InputError(f"{models.where}{id} = {model!r}{did_you_mean(model, MODELS)}")
    is_rpc_only = has_rpc_only(source)
    if is_rpc_only and model == "rigorous":
        raise InputError(
            f'{models.where}{id} = "rigorous": {source} has rational polynomials (RPC) only; give '
            '"rpc", or a scanner file'
        )
    return is_rpc_only or model == "rpc"


def _check_own_keys(
    section: TomlSection, own_entries: Mapping[str, Any], allowed_keys: Sequence[str], is_rpc: bool
) -> None:
    """Refuse unknowns of an image that only images with the other model have."""
    for key in own_entries:
        if key not in allowed_keys and (key in OF_RPC) != is_rpc:
            kind = "an image with RPC" if is_rpc else "a rigorous image"
            raise InputError(
                f"{section.where}{key} is no unknown of {kind}, which has {', '.join(allowed_keys)}"
            )
    section.check_keys(allowed_keys)


def _read_rpc_image(
    id: str, path: Path, section: TomlSection
) -> tuple[RpcScannerImage, tuple[str, ...]]:
    """An image with RPC, its bias with priors, and warnings."""
    rpc_image = read_rpc_image(path)
    degree = section.values.get("bias_degree", 0)
    if type(degree) is not int or degree not in range(len(BIAS_TERMS)):
        raise InputError(f"{section.where}bias_degree is {show(degree)}; expected 0, 1 or 2")
    bias, warnings = section.values.get("bias"), rpc_image.warnings
    if bias in (None, STATED_BIAS):
        source = find_coefficients(path)
        errors = read_stated_errors(source)
        if errors.bias > 0 and (errors.random > 0 or degree == 0):
            sigma = prior_of_errors(rpc_image.image.rpc, degree, errors.bias, errors.random)
            return RpcScannerImage(id, rpc_image.image, sigma), warnings
        missing_field = "ERR_BIAS" if errors.bias == 0 else "ERR_RAND"
        problem = f"{source} states no error of its coefficients ({missing_field})"
        if bias is not None:
            raise InputError(
                f'{section.where}bias = "stated", but {problem}; give σ in pixels, or "free"'
            )
        warnings += (
            f"{problem}: the bias of image {id!r} is free; give bias in [unknowns] a prior σ",
        )
        return RpcScannerImage(id, rpc_image.image, prior_of_bias(degree)), warnings
    values = bias if isinstance(bias, list) else [bias, bias]
    if len(values) != 2:
        raise InputError(
            f"{section.where}bias is {show(bias)}; expected one σ, or two, of the shift and of "
            "the other terms, in pixels"
        )
    shift, variation = (_sigma(section, "bias", value) for value in values)
    return RpcScannerImage(id, rpc_image.image, prior_of_bias(degree, shift, variation)), warnings


def _read_freedom(section: TomlSection, radians: float) -> Freedom:
    values_read: dict[str, Any] = {}
    for key, value in section.values.items():
        factor = radians if key in ANGULAR_UNKNOWNS else 1.0
        if key == "knot_spacing":
            values_read[key] = section.number(key)
            if values_read[key] <= 0:
                raise InputError(f"{section.where}{key} must be positive, in seconds")
        elif key == "focal_length":
            values_read[key] = _sigma(section, key, value)
        elif key in LISTED_UNKNOWNS:
            values = value if isinstance(value, list) else [value]
            values_read[key] = tuple(_sigma(section, key, v) for v in values)
        else:
            values = value if isinstance(value, list) else [value] * 3
            if len(values) != 3:
                raise InputError(f"{section.where}{key} is {show(value)}; one value or three")
            values_read[key] = tuple(factor * _sigma(section, key, v) for v in values)
    return Freedom(**values_read)


def _sigma(section: TomlSection, key: str, value: Any) -> float:
    if isinstance(value, str) and value in WORDS:
        return WORDS[value]
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf:
        return float(value)
    raise InputError(f'{section.where}{key} is {show(value)}; expected "free", "held" or a prior σ')
