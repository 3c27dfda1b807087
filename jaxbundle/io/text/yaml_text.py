"""YAML documents, by PyYAML: dictionaries, lists, numbers and texts.

The types are those of YAML 1.2 (core schema), which calibration files mean: `1e-3` is a number;
`on`, `010` and `2020-01-01` are no Booleans, octal numbers and dates as in YAML 1.1. Tags of
programs (`!!opencv-matrix`, `!!python/tuple`) are dropped, their content is read. OpenCV writes
`%YAML:1.0` for `%YAML 1.0`, and reads `key:1`.

A document is looked through as a stream of events before it is built: levels of nesting, what
aliases unfold to, a second document.

Source: YAML 1.2.2, chapter 10.3 "Core Schema"; OpenCV 4 documentation, XML/YAML/JSON file storages.
"""

import re
from functools import cache
from pathlib import Path
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.system.file_content import DEEPEST_NESTING, LARGEST_INTEGER, TOO_LARGE

# Values of a document with its aliases unfolded: some gigabytes. Without aliases a file of 20 MB
# has as many; nested aliases ("billion laughs") have any number.
MOST_VALUES = 10_000_000
DIRECTIVE = re.compile(r"^\ufeff?%YAML.*$", re.M)
TIGHT_KEY = re.compile(r"^(\s*[\w.]+):(?=[-+.\d\[\"'])", re.M)
# Tag, form, and first letters of the scalars that are not texts.
CORE_SCHEMA = (
    ("null", r"~|null|Null|NULL|", ("~", "n", "N", "")),
    ("bool", r"true|True|TRUE|false|False|FALSE", tuple("tTfF")),
    ("int", r"[-+]?[0-9]+", tuple("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        tuple("-+0123456789."),
    ),
    ("merge", r"<<", ("<",)),
)


def parse_yaml(path: str | Path, text: str) -> dict[str, Any]:
    """The document of a text, which must consist of keys.

    **Raises:** `InputError` naming the line.
    """
    document = parse_document(path, text)
    if document is None:
        raise InputError(f"{path}: the file is empty; expected keys and values")
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected keys and values")
    return document


def parse_document(path: str | Path, text: str) -> Any:
    """The document of a text, of any kind; None if it is empty.

    **Raises:** `InputError` naming the line."""
    import yaml

    # As many lines as before, so that messages name the right one.
    opencv = re.match(r"\s*%YAML:", text) is not None
    text = DIRECTIVE.sub("", text, count=1)
    if opencv:
        text = TIGHT_KEY.sub(r"\1: ", text)
    try:
        _look_through(path, text)
        return yaml.load(text, _loader())  # noqa: S506 - a subclass of the safe loader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        message = error.problem or error.context or "damaged"
        if mark and any("\t" in line for line in text.split("\n")[mark.line : mark.line + 1]):
            message += "; blanks indent, not tabs"
        raise InputError(f"{path}{line}: not valid YAML: {message}") from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not valid YAML: {show(str(error))}") from None


def _look_through(path: str | Path, text: str) -> None:
    """Refuse nesting that would exhaust the stack, aliases that unfold to gigabytes or contain
    themselves, and a second document."""
    import yaml

    def error(message: str) -> InputError:
        return InputError(f"{path}, line {event.start_mark.line + 1}: {message}")

    open_nodes: list[tuple[str | None, int]] = []  # anchor, values so far
    sizes: dict[str, int] = {}
    documents, size = 0, 0
    for event in yaml.parse(text, _base_loader()):
        if isinstance(event, yaml.DocumentStartEvent):
            documents += 1
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, size))
            if len(open_nodes) > DEEPEST_NESTING:
                raise error(f"nested too deeply: more than {DEEPEST_NESTING} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size_before = open_nodes.pop()
            size += 1
            if anchor:
                sizes[anchor] = size - size_before
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor in (anchor for anchor, _ in open_nodes):
                raise error(f"the alias *{event.anchor} contains itself")
            size += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            size += 1
            sizes |= {event.anchor: 1} if event.anchor else {}
            # A message of ROS ends with --- and nothing after it.
            if documents > 1 and event.value:
                raise error("a second document is not expected")
        if documents > 1 and open_nodes:
            raise error("a second document is not expected")
        if size > MOST_VALUES:
            raise error(f"more than {MOST_VALUES} values")


@cache
def _base_loader() -> Any:
    """The loader by libyaml where PyYAML has it: ten times faster."""
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@cache
def _loader() -> Any:
    """A safe loader with the types of the core schema, without repeated keys and foreign tags."""
    import yaml

    tags = [f"tag:yaml.org,2002:{name}" for name in ("null", "bool", "seq", "str", "binary")]

    class Loader(_base_loader()):
        yaml_implicit_resolvers: dict = {}
        # Others, such as dates, stay as they are written.
        yaml_constructors = {tag: yaml.SafeLoader.yaml_constructors[tag] for tag in tags}

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[str, Any]:
            if not isinstance(node, yaml.MappingNode):
                return super().construct_mapping(node, deep)
            keys = [key for key, _ in node.value]
            seen_keys: set[str] = set()
            for key in keys:
                if not isinstance(key, yaml.ScalarNode):
                    raise yaml.MarkedYAMLError(
                        problem="a key is a list or a dictionary", problem_mark=key.start_mark
                    )
                if key.value in seen_keys and key.value != "<<":
                    raise yaml.MarkedYAMLError(
                        problem=f"{key.value} occurs twice", problem_mark=key.start_mark
                    )
                seen_keys.add(key.value)
            self.flatten_mapping(node)
            # The keys as texts, as in JSON: 0 and on are names.
            return {key.value: self.construct_object(value, deep=True) for key, value in node.value}

        def get_single_data(self) -> Any:
            # The second document, if there is one, is empty (_look_through).
            node = self.get_node() if self.check_node() else None
            return None if node is None else self.construct_document(node)

    def parse_integer(_loader: Any, node: Any) -> int:
        digits = node.value.lstrip("+-0")
        if len(digits) > len(str(LARGEST_INTEGER)):
            raise yaml.MarkedYAMLError(problem=TOO_LARGE, problem_mark=node.start_mark)
        return int(node.value)

    def parse_real(_loader: Any, node: Any) -> float:
        text = node.value.lower()
        return float(text.replace(".", "") if text.endswith(("inf", "nan")) else text)

    def content(loader: Any, _suffix: str, node: Any) -> Any:
        """What is under an unknown tag."""
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return loader.construct_sequence(node, deep=True)
        return loader.construct_scalar(node)

    for tag, form, first_characters in CORE_SCHEMA:
        tag = f"tag:yaml.org,2002:{tag}"
        Loader.add_implicit_resolver(tag, re.compile(f"(?:{form})$"), list(first_characters))
    Loader.add_constructor("tag:yaml.org,2002:int", parse_integer)
    Loader.add_constructor("tag:yaml.org,2002:float", parse_real)
    for prefix in ("tag:yaml.org,2002:", "!", ""):
        Loader.add_multi_constructor(prefix, content)
    return Loader
