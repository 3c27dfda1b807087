"""The part of YAML that calibration files use, read into dictionaries, lists, numbers and texts.

Blocks of keys and of lists by indentation, lists in brackets (over several lines too), texts with
and without quotes, numbers, true, false, null, comments. Tags (`!!opencv-matrix`), the `%YAML` line
and `---` are skipped. Dictionaries in braces, anchors, texts over several lines, and a second
document are refused by name; or read as None in files with many unused entries.

Source: YAML 1.2, the chapters on block and flow collections.
"""

import re
from pathlib import Path
from typing import Any

from jaxbundle.errors import InputError
from jaxbundle.network.columns import show

MAX_NESTING = 32
"""Levels of blocks and of brackets: calibration files have four; Python's own limit, a thousand
calls, would be reached at some 300 levels and end in a RecursionError."""
KEY = re.compile(r"""("[^"]*"|'[^']*'|[^\s\[\]{},"'#&*!|>%@-][^\s:]*|-[^\s:]+)\s*:(?:\s+(.*))?""")
NUMBER = re.compile(r"[-+]?(\d{1,300}\.?\d*|\.\d+)([eE][-+]?\d{1,4})?")
COMMENT = re.compile(r"""((?:"[^"]*"|'[^']*'|[^"'#]|(?<=\S)#)*)(?:(?:^|(?<=\s))#.*)?""")
TAG = re.compile(r"!\S*\s*")
OPEN_BRACKET, CLOSE_BRACKET = re.compile(r"[\[{]"), re.compile(r"[\]}]")
WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
UNREAD_KINDS = {
    "{": "a dictionary in braces",
    "&": "an anchor",
    "*": "an alias",
    "|": "a block of text",
    ">": "a block of text",
}


class YamlLine:
    """A line with content: its number, its indentation, and the rest."""

    def __init__(self, path: str | Path, number: int, text: str, lenient: bool = False):
        self.path, self.number, self.lenient = path, number, lenient
        self.indent, self.text = len(text) - len(text.lstrip()), text.strip()

    def error(self, message: str) -> InputError:
        """An error about this line, to be raised."""
        return InputError(f"{self.path}, line {self.number}: {message}")


def parse_yaml(path: str | Path, text: str, *, lenient: bool = False) -> dict[str, Any]:
    """The document of a text, which must consist of keys; `lenient`: values of an unsupported kind
    are None.

    **Raises:** `InputError` naming the line.
    """
    lines = _lines(path, text, lenient)
    if not lines:
        raise InputError(f"{path}: the file is empty; keys and values are expected")
    value, rest = _block(lines, lines[0].indent, 0)
    if rest:
        raise rest[0].error(f"{show(rest[0].text)} is indented differently from the lines before")
    if not isinstance(value, dict):
        raise lines[0].error("keys and values are expected")
    return value


def _lines(path: str | Path, text: str, lenient: bool) -> list[YamlLine]:
    """The lines without comments; content in brackets or braces becomes one line."""
    lines: list[YamlLine] = []
    open_brackets, ended = 0, 0
    for number, raw in enumerate(text.splitlines(), 1):
        found = COMMENT.match(raw)
        bare = (found[1] if found else raw).rstrip()
        if not bare or (raw.startswith(("%", "---", "...")) and not open_brackets):
            if raw.startswith("---") and lines:
                ended = ended or number
            continue
        if ended:
            raise InputError(f"{path}, line {ended}: a second document is not expected")
        if "\t" in bare[: len(bare) - len(bare.lstrip())] and not open_brackets:
            raise InputError(f"{path}, line {number}: indentation by tabs; YAML has blanks")
        if open_brackets:
            # a list over several lines is read as one line
            lines[-1].text += " " + bare.strip()
        else:
            lines.append(YamlLine(path, number, bare, lenient))
        # brackets in texts open nothing
        plain = re.sub(r"\"[^\"]*\"|'[^']*'", "", bare)
        open_brackets = max(
            0, open_brackets + len(OPEN_BRACKET.findall(plain)) - len(CLOSE_BRACKET.findall(plain))
        )
    if open_brackets:
        raise lines[-1].error(f"the list {show(lines[-1].text)} has no end")
    return lines


def _block(lines: list[YamlLine], indent: int, depth: int) -> tuple[Any, list[YamlLine]]:
    """The value of the lines of one indentation, and the lines after it."""
    if depth > MAX_NESTING:
        raise lines[0].error(f"nested too deeply: more than {MAX_NESTING} levels")
    read = _items if _is_item(lines[0]) else _keys
    return read(lines, indent, depth)


def _is_item(line: YamlLine) -> bool:
    return line.text == "-" or line.text.startswith("- ")


def _items(lines: list[YamlLine], indent: int, depth: int) -> tuple[list[Any], list[YamlLine]]:
    values = []
    while lines and lines[0].indent == indent and _is_item(lines[0]):
        line, lines = lines[0], lines[1:]
        # "- key: value" is a block whose indentation is that of the key
        inner = YamlLine(line.path, line.number, " " * (indent + 1) + line.text[1:], line.lenient)
        if inner.text and not _is_item(inner) and not KEY.fullmatch(inner.text):
            values.append(_value(inner, inner.text))
        elif inner.text:
            value, lines = _block([inner, *lines], inner.indent, depth + 1)
            values.append(value)
        else:
            value, lines = _parse_nested(lines, indent, depth)
            values.append(value)
    return values, lines


def _keys(lines: list[YamlLine], indent: int, depth: int) -> tuple[dict[str, Any], list[YamlLine]]:
    values: dict[str, Any] = {}
    while lines and lines[0].indent == indent and not _is_item(lines[0]):
        line, lines = lines[0], lines[1:]
        found = KEY.fullmatch(line.text)
        if not found:
            raise line.error(f"{show(line.text)}: a key and a value, KEY: VALUE, are expected")
        key, text = found[1].strip("\"'"), TAG.sub("", found[2] or "", count=1)
        if key in values:
            raise line.error(f"{key} occurs twice")
        if text:
            values[key] = _value(line, text)
        else:
            values[key], lines = _parse_nested(lines, indent, depth)
    return values, lines


def _parse_nested(lines: list[YamlLine], indent: int, depth: int) -> tuple[Any, list[YamlLine]]:
    """The value below a key or the dash of a list; a list may have the indentation of its key."""
    if not lines or lines[0].indent < indent:
        return None, lines
    if lines[0].indent == indent and not _is_item(lines[0]):
        return None, lines
    return _block(lines, lines[0].indent, depth + 1)


def _value(line: YamlLine, text: str) -> Any:
    """A scalar, or a list in brackets."""
    text = text.strip()
    if text[:1] in UNREAD_KINDS and line.lenient:
        return None
    if text[:1] in UNREAD_KINDS:
        raise line.error(f"{show(text)}: {UNREAD_KINDS[text[0]]} is not read here")
    if not text.startswith("["):
        return _scalar(text)
    stack: list[list[Any]] = [[]]  # the lists that are open, the outermost a holder of one list
    for part in re.findall(r"\[|\]|\"[^\"]*\"|'[^']*'|[^][,\"']+", text):
        if part == "[":
            stack.append([])
            stack[-2].append(stack[-1])
        elif part == "]":
            stack.pop()
        elif part.strip():
            stack[-1].append(_scalar(part.strip()))
        if not stack or len(stack) > MAX_NESTING or (len(stack) == 1 and len(stack[0]) > 1):
            raise line.error(f"{show(text)}: brackets that do not match")
    return stack[0][0]


def _scalar(text: str) -> Any:
    if text[:1] in ("'", '"'):
        return text.strip(text[0])
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    if not NUMBER.fullmatch(text):
        return text
    return int(text) if text.lstrip("+-").isdigit() and len(text) < 16 else float(text)
