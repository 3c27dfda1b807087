"""Camera models of mrcal: a `.cameramodel`, or a folder of them, each a camera in space.

    {
        'lensmodel':  'LENSMODEL_OPENCV8',
        'intrinsics': [ fx, fy, cx, cy, … ],
        'extrinsics': [ r1, r2, r3, t1, t2, t3 ],      also called rt_cam_ref
        'imagersize': [ w, h ],
    }

a dictionary of Python, with comments. Other entries (valid_intrinsics_region, …) are not read.

    PINHOLE, OPENCV4, OPENCV5, OPENCV8, OPENCV12    `opencv`, in OpenCV's order
    STEREOGRAPHIC, LONLAT                           `stereographic`, `equirectangular`
    CAHVOR                                          α, β, r0, r1, r2: `opencv` where α = β = 0,
                                                    else fitted
    SPLINED_STEREOGRAPHIC_order=3_Nx=…_Ny=…_fov_x_deg=…    `spline-NXxNY-FOV`, in its order; ours
                                                    ends with the knots' field

x_camera = R·X + t, R of the rotation vector r, x right, y down, z forward; the centre of the first
pixel is (0, 0). CAHVOR moves a point p along its distance from the axis o before the projection,

    o = [sin α·cos β, sin β, cos α·cos β]   λ = p − (p·o)·o   τ = |λ|²/(p·o)²
    p' = p + (r0 + r1·τ + r2·τ²)·λ

so that for o = [0, 0, 1], s = 1 + r0: fx = s·fx, fy = s·fy, k1 = r1/s, k2 = r2/s.

Source: mrcal's documentation, "Camera model file formats", "Lens models"; Gennery (2006),
Generalized camera calibration including fish-eye lenses, IJCV 68(3), for CAHVOR.
"""

import ast
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxbundle.cameras.scalars import Scalar
from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import cv_pose, exterior_from_cv
from jaxbundle.io.cameras.nearest_camera import Foreign, fit_camera, fit_messages
from jaxbundle.io.networks.assemble import (
    all_parameters,
    assemble,
    entry_of,
    foreign_document,
    image_columns,
)
from jaxbundle.io.networks.losses import (
    describe_losses,
    losing,
    mountings_in_metres,
    need_values,
    size_of,
)
from jaxbundle.io.networks.poses import (
    matrices_of,
    matrices_of_rotation_vectors,
    rotation_vectors_of,
)
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.rows import join_numbers
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.rules import model_of
from jaxbundle.network.tables import Camera, Network, Source

SUFFIX = ".cameramodel"
FILES = (f"*{SUFFIX}",)
PREFIX = "LENSMODEL_"
CORE = ("fx", "fy", "cx", "cy")
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
# Our model and the parameters after the core.
MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "PINHOLE": ("opencv", ()),
    **{f"OPENCV{n}": ("opencv", ORDER[:n]) for n in (4, 5, 8, 12)},
    "STEREOGRAPHIC": ("stereographic", ()),
    "LONLAT": ("equirectangular", ()),
}
CAHVOR = ("alpha", "beta", "r0", "r1", "r2")
SPLINE = re.compile(r"SPLINED_STEREOGRAPHIC_order=3_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+(?:\.\d+)?)")
OUR_SPLINE = re.compile(r"spline-(\d+)x(\d+)-(\d+(?:\.\d+)?)")
KEYS = Keys(
    ("lensmodel", "intrinsics", "extrinsics", "rt_cam_ref", "imagersize"),
    {
        **dict.fromkeys(
            ("valid_intrinsics_region", "icam_intrinsics", "icam_intrinsics_exact",
             "icam_extrinsics", "optimization_inputs", "optimization_inputs_hash"),
            "where the calibration is good, and how it was made",
        ),
    },
)  # fmt: skip
OFFERED_MODELS = (*dict.fromkeys(model for model, _ in MODELS.values()), "spline-*")


def is_mrcal(path: Path) -> bool:
    """Whether a file has the name of a camera model, or a folder has such files."""
    if path.is_dir():
        return any(path.glob(FILES[0]))
    return path.suffix.lower() == SUFFIX


def read_mrcal(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of a file or a folder, named after the files, each with an image.

    **Raises:** `InputError` naming file and entry.
    """
    path = Path(path)
    files = sorted(path.glob(FILES[0])) if path.is_dir() else [path]
    if not files:
        raise InputError(f"{path}: there is no {FILES[0]} in it")
    models = {file.stem: _fields(file) for file in files}
    unknown = UnknownKeys()
    for fields in models.values():
        unknown.check(fields.document, KEYS, fields.path)
    cameras = [_camera(id, fields) for id, fields in models.items()]
    rt = np.array(
        [
            fields.array(
                "rt_cam_ref" if fields.get("rt_cam_ref") is not None else "extrinsics", (6,)
            )
            for fields in models.values()
        ]
    )
    M, X0 = exterior_from_cv(matrices_of_rotation_vectors(rt[:, :3]), rt[:, 3:])
    return assemble(
        path,
        foreign_document(path.stem, map(entry_of, cameras), object_unit="m"),
        overrides,
        image_columns(Source(str(path), None, "file"), list(models), list(models), M, X0),
        warnings=(*fit_messages(cameras), *unknown.messages()),
    )


def _fields(file: Path) -> JsonFields:
    # A literal of Python is evaluated without executing anything; what it raises for a text that
    # is none is not documented as one class.
    try:
        document = ast.literal_eval(read_text(file).strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        document = None
    if not isinstance(document, dict) or not all(isinstance(key, str) for key in document):
        raise InputError(f"{file}: expected a Python dictionary, {{'lensmodel': …, …}}")
    return JsonFields(
        file,
        {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in document.items()
        },
    )


def _camera(id: str, fields: JsonFields) -> Camera:
    name = fields.text("lensmodel")
    kind = name.removeprefix(PREFIX)
    size = fields.array("imagersize", (2,))
    sizes = JsonFields(f"{fields.path}: imagersize", dict(zip("wh", size.tolist())))
    w, h = sizes.integer("w", minimum=1), sizes.integer("h", minimum=1)
    model, lens_names = MODELS.get(kind, ("", CAHVOR if kind == "CAHVOR" else None))
    if knots := SPLINE.fullmatch(kind):
        model = "spline-{}x{}-{}".format(*knots.groups())
        lens_names = model_of(model, f"{fields.path}: lensmodel {name[:80]}: ").parameters[
            len(CORE) :
        ]
    if lens_names is None:
        raise InputError(
            f"{fields.path}: lensmodel {name} is not offered here; these are: "
            f"{', '.join(MODELS)}, CAHVOR, SPLINED_STEREOGRAPHIC_order=3_…"
        )
    values = fields.array("intrinsics", (len(CORE) + len(lens_names),)).tolist()
    p = dict(zip((*CORE, *lens_names), values))
    if model:
        return Camera(id, model, p, image_size=(w, h))
    s = 1 + p["r0"]
    exact = (
        {
            "fx": p["fx"] * s,
            "fy": p["fy"] * s,
            "cx": p["cx"],
            "cy": p["cy"],
            "k1": p["r1"] / s,
            "k2": p["r2"] / s,
        }
        if s > 0
        else {}
    )
    if not exact:
        raise InputError(f"{fields.path}: r0 of the intrinsics is {p['r0']:g}; 1 + r0 must be > 0")
    # With the axis along z the terms of CAHVOR are those of `opencv` (the module's docstring).
    if p["alpha"] == 0 == p["beta"]:
        return Camera(id, "opencv", exact, image_size=(w, h))
    foreign = Foreign(cahvor, p, exact, (w, h))
    return fit_camera(id, foreign, str(fields.path), "is of CAHVOR with a separate axis")


def cahvor(p: Mapping[str, Scalar], X: Scalar, Y: Scalar, Z: Scalar) -> Float[Array, "2"]:
    """The image of a ray by CAHVOR."""
    a, b = p["alpha"], p["beta"]
    o = jnp.stack([jnp.sin(a) * jnp.cos(b), jnp.sin(b), jnp.cos(a) * jnp.cos(b)])
    ray = jnp.stack([X, Y, Z])
    axial = ray @ o
    lateral = ray - axial * o
    tau = (lateral @ lateral) / axial**2
    x, y, z = ray + (p["r0"] + tau * (p["r1"] + tau * p["r2"])) * lateral
    return jnp.stack([p["fx"] * x / z + p["cx"], p["fy"] * y / z + p["cy"]])


def model_text(camera: Camera, rt: Sequence[float] = (0.0,) * 6) -> str:
    """The text of a `.cameramodel`, of the smallest lens model that holds the camera.

    **Raises:** `InputError` for a camera without a model in mrcal, or without image size.
    """
    p, (w, h) = all_parameters(camera), size_of(camera, "mrcal")
    kinds = {
        kind: lens_names for kind, (model, lens_names) in MODELS.items() if model == camera.model
    }
    if knots := OUR_SPLINE.fullmatch(str(camera.model)):
        kind = "SPLINED_STEREOGRAPHIC_order=3_Nx={}_Ny={}_fov_x_deg={}".format(*knots.groups())
        kinds = {kind: tuple(p)[len(CORE) :]}
    if not kinds:
        raise InputError(
            f"camera {camera.id!r}: mrcal has no model {str(camera.model)!r}; convert it with "
            "--model opencv"
        )
    kind = next(
        kind
        for kind, lens_names in kinds.items()
        if not any(p[name] for name in p if name not in (*CORE, *lens_names))
    )
    numbers = lambda values: f"[ {join_numbers(values, ', ')} ]"
    return (
        f"{{\n    'lensmodel':  '{PREFIX}{kind}',\n"
        f"    'intrinsics': {numbers(p[name] for name in (*CORE, *kinds[kind]))},\n"
        f"    'extrinsics': {numbers(rt)},\n    'imagersize': [ {w}, {h} ],\n}}\n"
    )


def write_mrcal(network: Network, folder: str | Path, force: bool = False) -> tuple[str, ...]:
    """Write the cameras of a network into a folder, a `.cameramodel` for every image, in metres.

    **Arguments:** `force`: also replace a folder not written by this function.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` where the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`).
    """
    with replace_folder(folder, "write_mrcal", FILES, force) as new:
        return fill_mrcal(network, new)


def fill_mrcal(network: Network, folder: Path) -> tuple[str, ...]:
    """Write camera models into an existing folder or a new one; as `write_mrcal`."""
    need_values(network, points=False)
    network, losses = mountings_in_metres(network, "mrcal")
    images = network.images
    R, t = cv_pose(matrices_of(images.angles), images.position)
    rt = np.concatenate([rotation_vectors_of(R), t], 1)
    names = [id.replace("/", "_") for id in images.id]
    ambiguous_name = next(
        (name for name in names if names.count(name) > 1 or not name.strip(".")), None
    )
    if ambiguous_name is not None:
        raise InputError(f"{folder}: image {ambiguous_name!r} does not give a unique file name")
    texts = [model_text(network.cameras[c], pose) for c, pose in zip(images.camera, rt)]
    folder.mkdir(exist_ok=True)
    for name, text in zip(names, texts):
        write_text(folder / f"{name}{SUFFIX}", text)
    return (*describe_losses(network, MRCAL_LOSSES), *losses)


# What it loses; every image is a file with a camera.
MRCAL_LOSSES = losing(
    "that images share a camera",
    "pixel sizes of cameras",
    "points",
    partly={
        "names of cameras": lambda n: len({c.id for c in n.cameras} - {*n.images.id}),
        "names of images": lambda n: sum("/" in id for id in n.images.id),
    },
)


def write_cameramodel(camera: Camera, path: str | Path) -> None:
    """Write one camera, at the origin and not rotated."""
    write_text(Path(path), model_text(camera))
