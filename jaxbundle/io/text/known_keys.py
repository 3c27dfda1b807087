"""The rule of keys: nothing that a file says is dropped in silence.

A reader declares, for every object of its format, the keys it uses and the keys it may leave, with
the reason. Any other key is reported by name and place, as a warning; if its name says that it may
change the geometry, the file is refused: a camera read without its distortion looks right and is
wrong.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.cameras.names import closest_name
from jaxbundle.errors import InputError

# Parts of words that concern geometry, wherever they stand in a name.
STEMS = (
    *("distort", "skew", "binning", "offset", "transform", "undist", "focallength", "principal"),
    *("rectif", "homograph", "lens", "intrinsic", "extrinsic", "calib", "affin", "fisheye"),
)
# Whole words that concern geometry; within other words they mean something else (`roi` in
# `android`, `sign` in `design`).
WORDS = frozenset(
    "scale scales scaling scaled model models unit units sign signs origin roi crop cropped flip "
    "flipped mirror mirrored axis axes aspect tilt shear prism radial tangential decentering "
    "decentring shutter convention coefficient coefficients coeff coeffs coef coefs rotation "
    "rotate rotated translation shift shifted pose projection fov focal dist resize resized "
    "datum crs epsg refraction".split()
)
# Such words at the end of a name without separators, `imagescale`.
ENDINGS = ("scale", "scalefactor", "model", "unit", "units", "origin", "roi", "matrix")
HARMLESS = re.compile(r"gr[ae]y_?scale", re.I)
COEFFICIENT = re.compile(r"(?:[kpbs]|tau|[xy]i)_?\d{1,2}|[fc][xy]|[xy]0", re.I)


def may_change_geometry(name: str) -> bool:
    """Whether a key of this name may say how images and rays are related."""
    name = HARMLESS.sub("grey", name)
    tokens = re.split(r"[\W_]+", name)
    words = {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}
    joined_name = "".join(tokens).lower()
    return (
        re.search(r"(?:^|_)T_[A-Za-z]", name) is not None  # T_cam_imu, body_T_cam0: a pose
        or any(stem in joined_name for stem in STEMS)
        or not WORDS.isdisjoint(words)
        or joined_name.endswith(ENDINGS)
        or any(COEFFICIENT.fullmatch(word) for word in (*tokens, name))
    )


class Keys:
    """The keys of one kind of object: those a reader uses, and those it may ignore.

    **Arguments:**

    - `ignored`: names, or patterns with *, that do not concern the result, and why.
    - `warned`: the same for what would concern it and is not read: each is a warning.
    """

    def __init__(
        self,
        used: Iterable[str],
        ignored: Mapping[str, str] | None = None,
        warned: Mapping[str, str] | None = None,
    ):
        self.used, self.ignored, self.warned = tuple(used), dict(ignored or {}), dict(warned or {})

    @cached_property
    def known_names(self) -> frozenset[str]:
        """All names and patterns."""
        return frozenset((*self.used, *self.ignored, *self.warned))

    @cached_property
    def patterns(self) -> tuple[str, ...]:
        """The names with a *."""
        return tuple(name for name in self.known_names if "*" in name)

    def unknown(self, names: Iterable[str]) -> list[str]:
        """The names that are not known."""
        return [name for name in names if not self._has(name)]

    def uses(self, name: str) -> bool:
        """Whether a name is one of those used."""
        return name in self.used or any(fnmatchcase(name, part) for part in self.used)

    def _has(self, name: str) -> bool:
        return name in self.known_names or any(fnmatchcase(name, part) for part in self.patterns)

    def __or__(self, other: "Keys") -> "Keys":
        return Keys(
            (*self.used, *other.used), self.ignored | other.ignored, self.warned | other.warned
        )


LEAF = Keys((), {"version": "of the dictionary of the value"})
"""Of an element of XML that has text alone."""


class UnknownKeys:
    """The keys met while a file is read that are not understood, or understood and not read; one
    message a key, however often it stands there."""

    def __init__(self):
        self._places: dict[tuple[str, str], list[str]] = {}

    def check(self, names: Iterable[str], keys: Keys, where: object) -> None:
        """Notice the unknown names of an object; `where`: its file and place.

        **Raises:** `InputError` for a name that may change the geometry.
        """
        names = tuple(names)
        if not keys.warned and keys.known_names.issuperset(names):
            return  # millions of points have the same few keys
        for name in keys.warned.keys() & {*names}:
            self._places.setdefault((name, keys.warned[name]), []).append(str(where))
        for name in keys.unknown(names):
            if may_change_geometry(name):
                # A name of the list is near enough to be meant: "Distortion" for "distortion".
                close = closest_name(name, keys.used)
                hint = f" (did you mean {close!r}?)" if close else ""
                raise InputError(
                    f"{where}: unknown key {show(name)}{hint}, which by its name may change the "
                    "geometry; expected a key that is known here. If it does not, delete it from a "
                    "copy of the file"
                )
            self._places.setdefault((name, ""), []).append(str(where))

    def check_element(self, element: ET.Element, keys: Keys, where: object) -> None:
        """The same for the children and attributes of an element of XML; attributes with a
        namespace (the schema) are of XML itself."""
        children = (child.tag for child in element if isinstance(child.tag, str))
        attributes = (name for name in element.attrib if not name.startswith("{"))
        self.check((*dict.fromkeys(children), *attributes), keys, where)

    def check_tree(self, root: ET.Element, keys: Mapping[str, Keys], where: object) -> None:
        """The same for an element of XML and all that is used of it.

        `keys`: those of the elements by their names, or patterns with *; an element without an
        entry has text alone. What may be left is left whole, with all that is in it.
        """
        patterns = [name for name in keys if "*" in name]
        pending = [(root, f"{where}: {root.tag[:60]}")]
        while pending:
            element, location = pending.pop()
            tag = element.tag
            if tag not in keys:
                tag = next((name for name in patterns if fnmatchcase(tag, name)), tag)
            element_keys = keys.get(tag, LEAF)
            self.check_element(element, element_keys, location)
            used_children = [
                c for c in element if isinstance(c.tag, str) and element_keys.uses(c.tag)
            ]
            # From the end of the list: the first of the document is the first to be refused.
            pending += [
                (child, f"{location}/{child.tag[:60]}") for child in reversed(used_children)
            ]

    def check_objects(
        self, document: Mapping[str, Any], keys: Mapping[str, Keys], where: object
    ) -> None:
        """The same for an object of JSON and those in it that have an entry.

        `keys`: of the objects by their path, `""` for the document, `"items.resources"`; of a list,
        of all objects in it.
        """
        pending = [("", document, str(where))]
        while pending:
            path, value, location = pending.pop()
            self.check(value, keys[path], location)
            inner_places = []
            for name, inner in value.items():
                if (inner_path := f"{path}.{name}".lstrip(".")) not in keys:
                    continue
                rows = enumerate(inner) if isinstance(inner, list) else [(None, inner)]
                for k, row in rows:
                    # What is no object is for its reader to refuse.
                    if isinstance(row, Mapping):
                        number = "" if k is None else f"[{k}]"
                        inner_places.append((inner_path, row, f"{location}, {name}{number}"))
            # From the end of the list: the first of the document is the first to be refused.
            pending += reversed(inner_places)

    def messages(self) -> tuple[str, ...]:
        """Warnings about the unknown keys."""
        return tuple(
            f"{places[0]}: "
            + (
                f"{name} is not read: {reason}"
                if reason
                else f"unknown key {show(name)} is not read"
            )
            + (f" (there, and in {len(places) - 1} more places)" if len(places) > 1 else "")
            for (name, reason), places in self._places.items()
        )
