"""The documentation site: `make docs`.

Sphinx reads the repository itself, so that pages, notebooks and the README files of `benchmarks`
and `examples` keep their places and their relative links, which work on GitHub too. Notebooks are
shown as they were run (`tests/test_notebooks.py` runs them). Nothing of a page comes from another
host: MathJax is copied into the site, fonts are those of the reader's system.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

import jaxbundle  # noqa: E402

project = "jaxbundle"
author = "The jaxbundle authors"
copyright = author
release = version = jaxbundle.__version__

extensions = [
    "myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx-mathjax-offline",
    "generated", "markdown_docstrings",
]  # fmt: skip
root_doc = "docs/index"
include_patterns = [
    "docs/**.md", "notebooks/*.ipynb", "benchmarks/README.md", "examples/*/README.md",
    "CONTRIBUTING.md", "CHANGELOG.md",
]  # fmt: skip
exclude_patterns = [".*", "out", "tests", "jaxbundle"]

nb_execution_mode = "off"
nb_ipywidgets_js = {}
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
smartquotes = False  # "dense" is a word of the code

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88

# Links between pages and files must resolve. Annotations name types of other packages, whose pages
# are on other hosts.
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]

html_theme = "furo"
html_title = f"jaxbundle {release}"
html_static_path = ["images"]
html_additional_pages = {"index": "first.html"}
templates_path = ["extensions"]
html_copy_source = False
