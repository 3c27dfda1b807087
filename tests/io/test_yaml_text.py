"""The part of YAML that is read, and what is refused with its line."""

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
"""


def test_what_is_read():
    assert parse_yaml("f", TEXT) == {
        "name": "a # b", "word": "/cam0/image_raw", "none": None, "flag": True, "number": -1.5e-3,
        "whole": 12, "matrix": {"rows": 2, "data": [1.0, 2, 3.5, -40.0]},
        "rows": [[1, 2], [[3, "a"], []]],
        "deep": [{"x": 1, "y": 2}, [5, 6], {"z": "q: w"}], "time: [s]": 3,
    }  # fmt: skip


@pytest.mark.parametrize("text, message", [
    ("a: 1\na: 2", "line 2: a occurs twice"), ("a: {b: 1}", "line 1: .*braces"),
    ("a: &b 1", "an anchor"), ("a: |\n  b", "a block of text"), ("a: [1, [2]", "has no end"),
    ("a: [1]]", "brackets"), ("a: 1\n  b: 2", "line 2: .* indented differently"),
    ("a:\n\tb: 1", "line 2: indentation by tabs"), ("a: 1\n---\nb: 2", "a second document"),
    ("", "is empty"), ("- 1", "keys and values"), ("a b", "line 1: 'a b': a key"),
    ("\n".join(" " * k + f"a{k}:" for k in range(99)), "nested too deeply"),
])  # fmt: skip
def test_what_is_refused(text, message):
    with pytest.raises(InputError, match=f"f.*{message}"):
        parse_yaml("f", text)


def test_what_nobody_asks_for_is_none():
    text = "---\na: {b: 1,\n  c: [2, 3]}\nd: &e 1\nf: [4]\n---\n"
    assert parse_yaml("f", text, lenient=True) == {"a": None, "d": None, "f": [4]}
    with pytest.raises(InputError, match="line 2: .*braces"):
        parse_yaml("f", text)
