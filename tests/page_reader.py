"""Pages of HTML as tests read them."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np

VOID = {"meta", "input", "img", "br", "link"}


class Page(HTMLParser):
    """The elements of a page; refuses one that is not closed where it should be."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names))
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)

    def attributes(self, name: str) -> list[str]:
        return [given[name] for _, given in self.tags if name in given]


def data_of(text: str, id: str):
    found = re.search(rf'<script type="application/json" id="{id}">(.*?)</script>', text)
    return None if found is None else json.loads(found[1])


def decode(packed, length: int):
    """The values of a column: numbers, or names."""
    if "same" in packed:
        numbers = np.full(length, packed["same"])
    else:
        numbers = np.frombuffer(base64.b64decode(packed["data"]), "<" + packed["type"])
    assert len(numbers) == length
    return np.array(packed["names"], dtype=object)[numbers] if "names" in packed else numbers


def column(text: str, table: str, name: str):
    found = data_of(text, f"data-{table}")
    return decode(found["columns"][name], found["length"])
