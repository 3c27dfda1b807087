"""docs/engine.md, executed."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "engine.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page():
    """The names defined by the page's code."""
    names = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE, re.S):
        assert len(code.strip().splitlines()) <= 30
        exec(code, names)
    return names


def test_an_own_problem(page):
    result = page["result"]
    assert result.counts.datum == 1 and result.counts.redundancy == 3
    height = result["height"].value
    assert abs(height.sum()) < 1e-9  # inner constraint against start values of 0
    v = height[page["j"]] - height[page["i"]] - page["dh"]
    assert result.vtpv == pytest.approx(((v / page["sigma"]) ** 2).sum())


def test_an_own_kind(page):
    level = page["adjusted"].unknowns("level")
    assert abs(level.value[0] - 0.01) < 4 * level.sigma[0] + 0.003
    assert np.isfinite(level.sigma).all()
    assert (page["adjusted"].residuals["kind"] == "height difference").sum() == 6


def test_every_module_has_its_place(page):
    folder = Path(__file__).parents[1] / "jaxbundle" / "leastsquares"
    modules = {(path.parent.name, path.name) for path in folder.rglob("*.py")}
    modules = {found for found in modules if found[1] != "__init__.py"}
    named = set()
    for room, names in re.findall(r"^\| (?:`(\w+)/`: )?(`\w+\.py`.*?) \|", PAGE, re.MULTILINE):
        named |= {(room or folder.name, name) for name in re.findall(r"`(\w+\.py)`", names)}
    assert modules - named == set() and named - modules == set()
