"""Tables of the unknowns that points share, with their priors: corrections of rigorous images and
of their sensors, biases of images with RPC; and the names of all of them."""

import math
from typing import NamedTuple

import numpy as np

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.leastsquares.declarations import ObservationSet, Table
from jaxbundle.network.tables import EXTERIOR, Network
from jaxbundle.refinement import kinds
from jaxbundle.refinement.freedom import ARCSECONDS_PER_RADIAN, UnknownName, names, priors
from jaxbundle.refinement.inputs import IMAGE, SENSOR, RefinementInput, sensor_of
from jaxbundle.refinement.rpc_points import (
    BIAS_PRIORS,
    RPC_IMAGE,
    BiasSpace,
    names_of_terms,
    stack_images,
)
from jaxbundle.refinement.tables import RpcScannerImage


class SharedUnknown(NamedTuple):
    """An unknown that points share: its name, the σ of its prior (inf: none), where it is among
    the changes of the tables, and the change that the prior states."""

    name: UnknownName
    sigma: float
    table: str
    row: int
    direction: int
    prior: float = 0.0


class CorrectionTable(NamedTuple):
    """A table of unknowns of images, and the observations that are their priors (none: all free or
    held)."""

    table: Table
    priors: list[ObservationSet]


def declare_corrections(
    inputs: RefinementInput,
) -> tuple[list[CorrectionTable], list[SharedUnknown]]:
    """The tables of unknowns of scanner images with their priors, and the unknowns."""
    tables, columns = [], []
    if inputs.rigorous:
        tables, columns = _rigorous_corrections(inputs)
    if inputs.rpc:
        table, of_rpc = _biases(inputs.rpc)
        tables, columns = [*tables, table], columns + of_rpc
    return tables, columns


def _biases(images: list[RpcScannerImage]) -> tuple[CorrectionTable, list[SharedUnknown]]:
    """The table of RPC images with the terms of the highest degree, those of others held."""
    terms = max(np.shape(rpc_image.bias_sigma)[1] for rpc_image in images)
    widen = lambda s: np.pad(np.asarray(s, float), ((0, 0), (0, terms - np.shape(s)[1])))
    sigma = np.stack([widen(rpc_image.bias_sigma).ravel() for rpc_image in images])
    free, names = sigma > 0, names_of_terms(terms)
    start = stack_images([rpc_image.image.rpc for rpc_image in images], terms)
    labels = [rpc_image.id for rpc_image in images]
    table = Table(RPC_IMAGE, start, BiasSpace(terms), free, labels, tuple(names))
    columns = [
        SharedUnknown(
            UnknownName(f"image {images[i].id}", names[k], "pixel", 1.0, names[k]),
            float(sigma[i, k]),
            RPC_IMAGE,
            i,
            k,
        )
        for i, k in np.argwhere(free).tolist()
    ]
    prior = np.where(free, sigma, np.inf)
    priors = (
        [BIAS_PRIORS((np.arange(len(images)),), sigma=prior)] if np.isfinite(prior).any() else []
    )
    return CorrectionTable(table, priors), columns


def _rigorous_corrections(
    inputs: RefinementInput,
) -> tuple[list[CorrectionTable], list[SharedUnknown]]:
    """The corrections of rigorous images, and of their sensors."""
    images, number_of_own = inputs.rigorous, inputs.forms[0].image_unknowns
    sigma = np.stack(
        [priors(form, scanner_image.freedom) for form, scanner_image in zip(inputs.forms, images)]
    )
    # The unknowns of a sensor have the σ of its first image, or of the first that states one (NaN:
    # no such unknown).
    first_of_sensor = np.unique(inputs.sensor, return_index=True)[1]
    of_sensor = sigma[first_of_sensor, number_of_own:]
    for i, row in enumerate(inputs.sensor):
        absent = np.isnan(of_sensor[row])
        of_sensor[row, absent] = sigma[i, number_of_own:][absent]
    names_of_unknowns = [
        names(f.sizes, scanner_image.id, sensor_of(scanner_image))
        for f, scanner_image in zip(inputs.forms, images)
    ]
    tables, columns = [], [[] for _ in images]
    # The vector of an image is its own unknowns, then those of its sensor: two tables, so that
    # images of one sensor touch the same row. Columns that are held in all rows leave the space.
    own_part = (IMAGE, sigma[:, :number_of_own], range(len(images)), 0)
    for title, sigma, image_rows, start in (
        own_part,
        (SENSOR, of_sensor, first_of_sensor, number_of_own),
    ):
        sigma = np.nan_to_num(sigma, nan=0.0, posinf=np.inf)
        moving = np.flatnonzero((sigma > 0).any(0)).tolist()
        space, free = kinds.VectorRow(sigma.shape[1], tuple(moving)), sigma[:, moving] > 0
        labels = [images[i].id if title == IMAGE else sensor_of(images[i]) for i in image_rows]
        words = tuple(names_of_unknowns[0][start + k].parameter for k in moving)
        table = Table(title, np.zeros(sigma.shape), space, free, labels, words)
        prior, rows = np.where(sigma > 0, sigma, np.inf), (np.arange(table.rows),)
        prior_sets = [kinds.priors(title)(rows, sigma=prior)] if np.isfinite(prior).any() else []
        tables.append(CorrectionTable(table, prior_sets))
        for row, i in enumerate(image_rows):
            columns[i] += [
                SharedUnknown(names_of_unknowns[i][start + k], float(sigma[row, k]), title, row, d)
                for d, k in enumerate(moving)
                if free[row, d]
            ]
    return tables, [column for of_image in columns for column in of_image]


def columns_of_photographs(
    network: Network, tables: list[Table], of_cameras: dict[str, tuple[str, int]]
) -> list[SharedUnknown]:
    """Their unknowns: of every image, and of its camera for the first image."""
    columns, table_of = [], {t.name: t for t in tables}
    sigma_of_image = np.where(np.isnan(network.images.sigma), np.inf, network.images.sigma)
    # Unknowns are rotations about the axes of the camera, which mix ω, φ and κ.
    sigma_of_image[:, 3:] = sigma_of_image[:, 3:].max(1, keepdims=True)
    for i, id in enumerate(network.images.id):
        for k in np.flatnonzero(table_of["image"].free[i]).tolist():
            word = EXTERIOR[k]
            unit = ("m", 1.0) if k < 3 else ("arcsec", ARCSECONDS_PER_RADIAN)
            name = UnknownName(f"photograph {id}", word, *unit, word)
            columns.append(SharedUnknown(name, float(sigma_of_image[i, k]), "image", i, k))
        c = network.images.camera[i]
        camera, (title, row) = network.cameras[c], of_cameras[network.cameras[c].id]
        if c in network.images.camera[:i]:  # named with its first image
            continue
        start = {**default_parameters(get_model(camera.model)), **camera.parameters}
        for d in np.flatnonzero(table_of[title].free[row]).tolist():
            word = table_of[title].parameters[d]
            name = UnknownName(f"camera {camera.id}", word, "", 1.0, word)
            prior = camera.observed[word] - start[word] if word in camera.observed else 0.0
            sigma = camera.sigma.get(word, math.inf)
            columns.append(SharedUnknown(name, sigma, title, row, d, prior))
    return columns
