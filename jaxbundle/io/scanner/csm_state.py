"""Model states of usgscsm, which its `getModelState` and other programs write.

The name of the model, then a JSON object of fields `m_…` in metres, seconds and millimetres:

    USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL
    {"m_nLines": …, "m_positions": […], "m_quaternions": […], …}

Positions and quaternions (scalar last, camera → body) are evenly spaced: a state has the content of
the older form of an ISD, and is read as one. Estimated adjustments, `m_currentParameterValue`, must
be zero.
"""

from typing import Any

import numpy as np

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.json_fields import JsonFields

MODEL = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
FRAME_MODEL = "USGS_ASTRO_FRAME_SENSOR_MODEL"
# By their number, `m_distortionType`.
DISTORTIONS = (
    "radial",
    "transverse",
    "kaguyalism",
    "dawnfc",
    "lrolrocnac",
    "cahvor",
    "lunarorbiter",
    "radtan",
    "kplo_shadowcam",
)
# Degree of the interpolation by `m_platformFlag`.
PLATFORM_ORDERS = {0: 3, 1: 7}


def is_state(document: dict[str, Any]) -> bool:
    """Whether an object is a model state."""
    return "m_modelName" in document or "m_nLines" in document


def support_data_of(state: JsonFields) -> tuple[dict[str, Any], int]:
    """A state as an ISD of the older form, and the degree of its interpolation.

    **Raises:** `InputError` naming file and field.
    """
    _check_unadjusted(state)
    number, array = state.number, state.array
    names = "m_intTimeLines", "m_intTimeStartTimes", "m_intTimes"
    rates = [array(name, (None,)) for name in names]
    if len({len(r) for r in rates}) > 1:
        raise InputError(
            f"{state.path}: {', '.join(names)} have {', '.join(str(len(r)) for r in rates)} "
            "numbers; expected the same number of each"
        )
    flag = number("m_platformFlag", 1)
    if flag not in PLATFORM_ORDERS:
        raise InputError(f"{state.path}: m_platformFlag is {flag:g}; expected 0 or 1")
    isd = {
        "name_sensor": state.get("m_sensorName") or "",
        "name_model": MODEL,
        "image_lines": number("m_nLines"),
        "image_samples": number("m_nSamples"),
        "line_scan_rate": np.stack(rates, 1).tolist(),
        "sensor_position": {"positions": _rows(state, "m_positions", 3), "unit": "m"},
        "t0_ephemeris": number("m_t0Ephem"),
        "dt_ephemeris": number("m_dtEphem"),
        "sensor_orientation": {"quaternions": _rows(state, "m_quaternions", 4)},
        "t0_quaternion": number("m_t0Quat"),
        "dt_quaternion": number("m_dtQuat"),
        # The camera looks along (z·x, z·y, f), which for z = −1 is (x, y, −f) turned round.
        "focal_length_model": {
            "focal_length": number("m_focalLength") * np.sign(number("m_zDirection", 1))
        },
        "focal2pixel_lines": array("m_iTransL", (3,)).tolist(),
        "focal2pixel_samples": array("m_iTransS", (3,)).tolist(),
        "detector_center": {
            "line": number("m_detectorLineOrigin"),
            "sample": number("m_detectorSampleOrigin"),
        },
        "detector_sample_summing": number("m_detectorSampleSumming", 1),
        "starting_detector_line": number("m_startingDetectorLine", 0),
        "starting_detector_sample": number("m_startingDetectorSample", 0),
        "optical_distortion": distortion_of(state),
        "radii": {
            "semimajor": number("m_majorAxis"),
            "semiminor": number("m_minorAxis"),
            "unit": "m",
        },
    }
    return isd, PLATFORM_ORDERS[int(flag)]


def frame_support_data_of(state: JsonFields) -> dict[str, Any]:
    """The state of a frame camera as an ISD of the older form: the seven parameters of its pose are
    the projection centre, metres, and the quaternion camera → body, scalar last.

    **Raises:** `InputError` naming file and field.
    """
    number, array = state.number, state.array
    if len(array("m_lineTimes", (None,), [])):
        raise InputError(f"{state.path}: jitter, of a rolling shutter, is not supported")
    pose, centre = array("m_currentParameterValue", (7,)), array("m_ccdCenter", (2,))
    return {
        "name_model": FRAME_MODEL,
        "name_sensor": state.get("m_sensorName") or "",
        "image_lines": number("m_nLines"),
        "image_samples": number("m_nSamples"),
        "sensor_position": {"positions": [pose[:3].tolist()], "unit": "m"},
        "sensor_orientation": {"quaternions": [pose[3:].tolist()]},
        "focal_length_model": {"focal_length": number("m_focalLength")},
        "focal2pixel_lines": array("m_iTransL", (3,)).tolist(),
        "focal2pixel_samples": array("m_iTransS", (3,)).tolist(),
        "detector_center": {"line": float(centre[0]), "sample": float(centre[1])},
        "detector_sample_summing": number("m_detectorSampleSumming", 1),
        "detector_line_summing": number("m_detectorLineSumming", 1),
        "starting_detector_line": number("m_startingDetectorLine", 0),
        "starting_detector_sample": number("m_startingDetectorSample", 0),
        "optical_distortion": distortion_of(state),
    }


def _check_unadjusted(state: JsonFields) -> None:
    name = state.get("m_modelName", MODEL)
    if name != MODEL:
        raise InputError(f"{state.path}: m_modelName is {show(name)}; expected {MODEL}")
    adjusted = state.array("m_currentParameterValue", (None,), [])
    if adjusted.any():
        raise InputError(
            f"{state.path}: m_currentParameterValue has {np.count_nonzero(adjusted)} adjusted "
            "parameters, which are not applied here; write them into positions and quaternions"
        )


def _rows(state: JsonFields, key: str, n: int) -> list[list[float]]:
    values = state.array(key, (None,))
    if not len(values) or len(values) % n:
        raise InputError(f"{state.path}: {key} has {len(values)} numbers; expected {n} a row")
    return values.reshape(-1, n).tolist()


def distortion_of(state: JsonFields) -> dict[str, dict[str, Any]]:
    """The distortion of a state in the form of an ISD."""
    kind = state.number("m_distortionType")
    if kind not in range(len(DISTORTIONS)):
        raise InputError(
            f"{state.path}: m_distortionType {kind:g} is not known; 0 to {len(DISTORTIONS) - 1}"
        )
    name = DISTORTIONS[int(kind)]
    c = state.array("m_opticalDistCoeffs", (None,)).tolist()
    match name:
        case "transverse":
            return {name: {"x": c[: len(c) // 2], "y": c[len(c) // 2 :]}}
        case "kaguyalism":
            if len(c) != 10:
                raise InputError(
                    f"{state.path}: m_opticalDistCoeffs has {len(c)} numbers; 10 of kaguyalism"
                )
            return {name: {"boresight_x": c[0], "x": c[1:5], "boresight_y": c[5], "y": c[6:]}}
    return {name: {"coefficients": c}}
