"""YAML documents by PyYAML: the types of YAML 1.2, OpenCV's habits, and what is refused with its
line."""

import pytest

from jaxbundle.errors import InputError
from jaxbundle.io.text.yaml_text import parse_yaml

TEXT = """%YAML:1.0
---
# a comment
name: 'a # b'   # not this
word: /cam0/image_raw
none:
flag: True
number: -1.5e-3
whole: 12
tight:517.3
list:[1, 2]
matrix: !!opencv-matrix
   rows: 2
   data: [ 1., 2,
       3.5, -4e1 ]   # two lines
rows:
- [1, 2]
- [[3, a], []]
deep:
  - x: 1
    y: 2
  - - 5
    - 6
  -
    z: "q: w"
"time: [s]": 3
small: 1e-3
on: off
octal: 010
date: 2020-01-01
pair: !!python/tuple [1, 2]
braces: {x: &here [7], y: *here}
0: zero
"""


def test_what_is_read():
    assert parse_yaml("f", TEXT) == {
        "name": "a # b", "word": "/cam0/image_raw", "none": None, "flag": True, "number": -1.5e-3,
        "whole": 12, "tight": 517.3, "list": [1, 2],
        "matrix": {"rows": 2, "data": [1.0, 2, 3.5, -40.0]},
        "rows": [[1, 2], [[3, "a"], []]],
        "deep": [{"x": 1, "y": 2}, [5, 6], {"z": "q: w"}], "time: [s]": 3, "small": 1e-3,
        "on": "off", "octal": 10, "date": "2020-01-01", "pair": [1, 2],
        "braces": {"x": [7], "y": [7]}, "0": "zero",
    }  # fmt: skip


LAUGHS = "a: &a [1, 1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 20)}]\n" for old, new in zip("abcdefgh", "bcdefghi")
)


@pytest.mark.parametrize("text, message", [
    ("a: 1\na: 2", "line 2: .*a occurs twice"), ("a: [1, [2]", "not valid YAML"),
    ("a: [1]]", "not valid YAML"), ("a: 1\n  b: 2", "line 2: "),
    ("a:\n\tb: 1", "line 2: .*not tabs"), ("a: 1\n---\nb: 2", "line 3: a second document"),
    ("", "is empty"), ("- 1", "keys and values"), ("a b", "keys and values"),
    ("\n".join(" " * k + f"a{k}:" for k in range(99)), "line 65: nested too deeply"),
    ("[" * 100_000, "line 1: .*nest"), ("- " * 100_000, "line 1: nested"),
    (LAUGHS, "line 6: more than 10000000 values"), ("a: &a [*a]", "contains itself"),
    (f"a: {'9' * 400}", "too large"), ("? [1]\n: 2", "a key is a list"), ("a: \x01", "not valid"),
])  # fmt: skip
def test_what_is_refused(text, message):
    with pytest.raises(InputError, match=f"f.*{message}"):
        parse_yaml("f", text)


def test_nothing_is_run():
    assert parse_yaml("f", "a: !!python/object/apply:os.getcwd []") == {"a": []}
