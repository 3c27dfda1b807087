"""The optics of a line scanner of the Community Sensor Model: focal plane and distortion.

`focal2pixel_lines`, `focal2pixel_samples` lead from millimetres to pixels from `detector_center`;
the camera looks along the line (x, y, f), here along −z, x along the detectors, y forward.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval
from scipy.spatial.transform import Rotation

from jaxbundle.arguments import show
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.io.scanner.sight_frames import sight_frame
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.network.columns import list_some
from jaxbundle.pushbroom.scanner import AngleTable, FocalLine, Optics

DISTORTIONS = ("radial", "transverse", "lrolrocnac", "kplo_shadowcam", "kaguyalism")


def optics_of(
    isd: JsonFields, pixels: int, down: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]
) -> tuple[Optics, Rotation]:
    """The optics, and the rotation from its camera frame into that of the ISD.

    `down` and `forward` are the directions to the planet and of flight in the camera's frame.
    """
    f = isd.number("focal_length_model.focal_length")
    if f == 0:
        raise InputError(f"{isd.path}: focal_length_model.focal_length is 0; expected millimetres")
    x, y = _focal_plane(isd, np.arange(pixels))
    kind, undistorted = _distortion(isd, x, y)
    sights = np.stack([x / f, y / f])
    frame = sight_frame(sights, down, forward)
    X, Y = f * frame.slopes(*sights)
    pitch = (X[-1] - X[0]) / (pixels - 1)
    # 1e-9 of the focal plane are below a thousandth of a pixel, and far above the rounding of Y
    is_straight = np.abs(Y - Y[0]).max() < 1e-9 * max(np.abs(X).max(), abs(f))
    if kind == "radial" and f > 0 and is_straight:
        K = -isd.array("optical_distortion.radial.coefficients", (None,))
        model = get_model("usgs")
        values = {"c": f, **{f"K{k}": value for k, value in enumerate(K)}}
        parameters = jnp.asarray([values.get(name, 0.0) for name in model.parameters])
        pitch, middle, row = (jnp.asarray(v) for v in (pitch, -X[0] / pitch, Y[0]))
        return FocalLine(parameters, pitch, middle, row, "usgs"), frame.rotation
    psi = np.arctan(frame.slopes(*undistorted) / f)
    return AngleTable(*map(jnp.asarray, psi)), frame.rotation


def _focal_plane(isd: JsonFields, u: Float[np.ndarray, " pixels"]) -> Float[np.ndarray, "2 pixels"]:
    """Positions of the pixels in the focal plane, mm, x and y of the ISD."""
    to_line, to_sample = (isd.array(f"focal2pixel_{k}", (3,)) for k in ("lines", "samples"))
    summing = isd.number("detector_sample_summing", 1)
    sample = (u + 0.5) * summing + isd.number("starting_detector_sample", 0)
    line = isd.number("starting_detector_line", 0)
    A = np.stack([to_line[1:], to_sample[1:]])
    # Parallel but for the rounding of numbers of 12 digits.
    if abs(np.linalg.det(A)) < 1e-12 * np.abs(A).max() ** 2 or not A.any():
        raise InputError(f"{isd.path}: focal2pixel_lines and focal2pixel_samples are dependent")
    offset = np.stack(
        [
            np.full(len(u), line - isd.number("detector_center.line") - to_line[0]),
            sample - isd.number("detector_center.sample") - to_sample[0],
        ]
    )
    return np.linalg.solve(A, offset)


def _distortion(
    isd: JsonFields, x: Float[np.ndarray, " pixels"], y: Float[np.ndarray, " pixels"]
) -> tuple[str, tuple[Float[np.ndarray, " pixels"], Float[np.ndarray, " pixels"]]]:
    """The kind of distortion, and the undistorted coordinates, mm."""
    kinds = isd.document.setdefault("optical_distortion", {"radial": {"coefficients": [0.0]}})
    kind = next(iter(kinds), None) if isinstance(kinds, dict) else None
    if isinstance(kinds, dict) and len(kinds) > 1:
        raise InputError(
            f"{isd.path}: optical_distortion has {len(kinds)} kinds ({list_some(kinds)}); "
            "expected one"
        )
    where = f"optical_distortion.{kind}"
    coefficients = lambda n: isd.array(f"{where}.coefficients", (n,))
    match kind:
        case "radial":
            k = np.r_[coefficients(None), 0, 0, 0]
            if len(k) > 6:
                raise InputError(f"{isd.path}: {where}: at most 3 coefficients are known")
            r2 = x * x + y * y
            part = 1 - (k[0] + r2 * (k[1] + r2 * k[2]))
            return kind, (x * part, y * part)
        case "lrolrocnac":
            return kind, (x, y / (1 + coefficients(1)[0] * y * y))
        case "kplo_shadowcam":
            return kind, (x, y * (1 + coefficients(1)[0] * y * y))
        case "kaguyalism":
            r = np.sqrt(x * x + y * y)
            radial = lambda axis: polyval(r, isd.array(f"{where}.{axis}", (None,)))
            shift = lambda axis: radial(axis) + isd.number(f"{where}.boresight_{axis}")
            return kind, (x + shift("x"), y + shift("y"))
        case "transverse":
            a, b = (isd.array(f"{where}.{axis}", (None,)) for axis in "xy")
            a, b = (np.r_[c, np.zeros(10)][:10] for c in (a, b))
            return kind, _transverse(isd, a, b, x, y)
    choices = f"{', '.join(DISTORTIONS[:-1])} or {DISTORTIONS[-1]}"
    raise InputError(
        f"{isd.path}: optical_distortion {show(kind)} is not supported; expected {choices}"
    )


def _transverse(
    isd: JsonFields,
    a: Float[np.ndarray, "10"],
    b: Float[np.ndarray, "10"],
    x: Float[np.ndarray, " pixels"],
    y: Float[np.ndarray, " pixels"],
) -> tuple[Float[np.ndarray, " pixels"], Float[np.ndarray, " pixels"]]:
    """The point that the cubic polynomials a and b distort to (x, y)."""
    u, v = x, y
    # Fixed-point iteration u ← u + (x − a(u, v)): the polynomials are near the identity, so that a
    # step gains some digits; a distortion that needs 100 has no inverse in practice.
    for _ in range(100):
        uu, uv, vv = u * u, u * v, v * v
        terms = np.stack([u**0, u, v, uu, uv, vv, u**3, uu * v, uv * v, v**3])
        du, dv = x - a @ terms, y - b @ terms
        u, v = u + du, v + dv
        # Some 500 eps of the largest coordinate.
        if max(np.abs(du).max(), np.abs(dv).max()) < 1e-13 * (1 + np.abs(x).max()):
            return u, v
    raise InputError(f"{isd.path}: optical_distortion.transverse cannot be inverted; check it")
