"""The settings of a project: known keys, `--set KEY=VALUE`, and the resulting network.

A *document* is the content of a project file: `{"project": {...}, "camera": [{...}, ...]}`. Every
reader with settings makes one, so that the same overrides work for all.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.cameras import CameraModel
from jaxbundle.cameras.names import closest_name
from jaxbundle.errors import InputError
from jaxbundle.network.build import CAMERA_FIELDS, make_cameras, make_network
from jaxbundle.network.columns import Columns, list_some, refuse_unknown
from jaxbundle.network.kinds import KINDS, SECTIONS
from jaxbundle.network.rules import CHOICES, check_choice, check_sigma_image
from jaxbundle.network.tables import SIGMA_ORIGINS, STATED, Network

REQUIRED_TABLES = ("images", "points", "observations")
TABLES = (*REQUIRED_TABLES, "distances", *KINDS)
TEXT = ("name", "object_unit", "image_unit", "angle_unit", "datum", "residuals")
SETTINGS = (*TEXT, "sigma_image", "sigma_origin", "datum_points")
CAMERA_KEYS = ("camera.ID.PARAMETER", "camera.ID.sigma.PARAMETER") + tuple(
    f"camera.ID.{field}" for field in CAMERA_FIELDS if field not in ("id", "sigma", "observed")
)
# Means all cameras, unless one has this id.
ALL_CAMERAS = "*"

Document = dict[str, Any]


def require_overrides(overrides: Any) -> None:
    """Refuse settings that are not a list of texts, such as one text, which is a list of letters.

    **Raises:** `InputError`."""
    if isinstance(overrides, str) or not (
        isinstance(overrides, Sequence) and all(isinstance(word, str) for word in overrides)
    ):
        raise InputError(
            f"overrides must be a list of texts, such as ['datum=inner'], but is {show(overrides)}"
        )


def choose_datum(overrides: Sequence[str]) -> bool:
    """Whether the settings of the command line choose the datum: then control of a file does not
    become the datum by itself."""
    return any(override.partition("=")[0].strip() == "datum" for override in overrides)


def apply_overrides(
    document: Document, overrides: Sequence[str], keys: Sequence[str] = SETTINGS
) -> Document:
    """The document with `KEY=VALUE` settings of the command line applied.

    Keys are those of `[project]` in `keys`, `camera.ID.…` of a camera, `camera.*.…` of all
    cameras, `free`, which is `camera.*.free`, and `SECTION.…` of a further kind of
    observations.
    """
    # The document of the caller stays as the file has it.
    document = copy.deepcopy(document)
    for override in overrides:
        key, equals, text = (part.strip() for part in override.partition("="))
        if not equals:
            raise InputError(f"--set {override}: expected KEY=VALUE")
        if key == "free":
            _override_cameras(document["camera"], f"camera.{ALL_CAMERAS}.free", text)
        elif key.startswith("camera."):
            _override_cameras(document["camera"], key, text)
        elif key.partition(".")[0] in SECTIONS:
            _override_section(document, key, text)
        elif key in keys:
            value = _words(text) if key == "datum_points" else text
            document["project"][key] = _number(key, text) if key == "sigma_image" else value
        else:
            raise InputError(f"--set {key}: unknown key{_describe_keys(key, keys)}")
    return document


def _describe_keys(key: str, keys: Sequence[str]) -> str:
    """The end of a message about an unknown key: all of them, and the probable one."""
    section, dot, subkey = key.partition(".")
    allowed_keys = (*keys, "free", *CAMERA_KEYS, *(f"{name}.KEY" for name in SECTIONS))
    close = closest_name(section, ("camera", *SECTIONS) if dot else (*keys, "free"))
    suggestion = "" if close is None else f"; did you mean {f'{close}{dot}{subkey}'!r}?"
    return f"; known: {', '.join(allowed_keys)}{suggestion}"


def _override_cameras(cameras: list[dict], key: str, text: str) -> None:
    """Apply a setting to the camera named by the key, or to all cameras."""
    subkey = key.removeprefix("camera.")
    ids = [str(camera.get("id", "")).strip() for camera in cameras]
    # The longest id first: "a.b" may be an id beside "a".
    for c in sorted(range(len(ids)), key=lambda c: -len(ids[c])):
        if subkey.startswith(f"{ids[c]}."):
            _override_camera(cameras[c], key, subkey.removeprefix(f"{ids[c]}."), text)
            return
    if not subkey.startswith(f"{ALL_CAMERAS}."):
        raise InputError(
            f"--set {key}: no such camera; known: "
            f"{list_some((f'camera.{id}.PARAMETER' for id in (*ids, ALL_CAMERAS)), 12, str)}"
        )
    for camera in cameras:
        _override_camera(camera, key, subkey.removeprefix(f"{ALL_CAMERAS}."), text)


def _override_camera(camera: dict, key: str, field: str, text: str) -> None:
    if field == "free":
        camera["free"] = _words(text)
    elif field == "tie":
        camera["tie"] = [[name.strip() for name in word.split("+")] for word in _words(text)]
    elif field in ("image_size", "pixel_size"):
        camera[field] = [_number(key, word) for word in _words(text)]
    elif field == "model":
        camera[field] = text
    elif field.startswith("sigma."):
        sigma = camera.setdefault("sigma", {})
        if not isinstance(sigma, dict):
            raise InputError(
                f"--set {key}: sigma of the camera is {show(sigma)}; expected a table such as "
                "{ c = 0.1 }"
            )
        sigma[field.removeprefix("sigma.")] = _number(key, text)
    elif field in ("id", "sigma", "observed"):
        raise InputError(f"--set {key}: cannot be set; known: {', '.join(CAMERA_KEYS)}")
    else:
        camera[field] = _number(key, text)


def _override_section(document: Document, key: str, text: str) -> None:
    """Apply a setting, words or numbers, to a section: `antenna.free`, `antenna.sigma.ax`."""
    *sections, name = key.split(".")
    settings = document
    for section in sections:
        settings = settings.setdefault(section, {})
        if not isinstance(settings, dict):
            raise InputError(f"--set {key}: {section} is {show(settings)}; expected a table")
    words = _words(text)
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = words
    # A list of one is still a list.
    is_list = name == "free" or text.startswith("[") or len(values) != 1
    settings[name] = values if is_list else values[0]


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.strip("[]").split(",") if word.strip()]


def _number(key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--set {key}={text}: {text!r} is not a number") from None


def network_of(
    document: Document,
    tables: Mapping[str, Columns],
    where: str,
    models: Sequence[CameraModel] = (),
) -> Network:
    """The network of a document and its tables; `where` is the file, for messages; `models`: own
    camera models it may name."""
    project = document["project"]
    check_project_settings(project, f"{where}, [project]: ")
    settings = {key: project[key] for key in SETTINGS if key in project}
    cameras = make_cameras(document["camera"], f"{where}, ", models)
    sections = {name: document[name] for name in SECTIONS if name in document}
    return make_network(cameras, **tables, **sections, **settings)


def check_project_settings(project: Mapping[str, Any], where: str) -> None:
    """Refuse unknown keys and impossible values of `[project]`."""
    for key, value in project.items():
        refuse_unknown(key, (*SETTINGS, *TABLES), where)
        if key in (*TEXT, *TABLES) and not isinstance(value, str):
            raise InputError(f"{where}{key} is {value!r}; expected text in quotes")
        if key in CHOICES:
            check_choice(key, value, CHOICES[key], where)
    check_sigma_image(project.get("sigma_image", 1.0), where)
    check_choice("sigma_origin", project.get("sigma_origin", STATED), SIGMA_ORIGINS, where)
    if not isinstance(project.get("datum_points", []), list):
        raise InputError(f'{where}datum_points must be a list of ids, such as ["1", "2"]')
