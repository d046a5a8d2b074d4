"""Settings of the documentation: Sphinx with Markdown pages, built by `make docs`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import fingerspice

sys.path.insert(0, str(Path(__file__).parent))
import gallery

project = "fingerspice"
author = "The fingerspice developers"
version = release = fingerspice.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

# Headings are targets of links, as on a code host; $...$ and $$...$$ are formulas.
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath", "amsmath"]

# Docstrings follow numpydoc. Signatures stay plain: the docstring says the types.
napoleon_google_docstring = False
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "groupwise"
autodoc_preserve_defaults = True
autodoc_mock_imports = ["torch", "torchdiffeq"]
default_role = "code"

# Pygments knows no backslash in SPICE, and figures have one name in several classes.
suppress_warnings = ["misc.highlighting_failure", "ref.python"]
show_warning_types = True

html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_sidebars = {"index": [], "start/tutorial": [], "gallery/index": []}
html_title = "fingerspice"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
project_copyright = "The fingerspice developers, MIT licence"


def _files_beside(app: Sphinx, name: str, source: list[str]) -> None:
    """Links out of docs/, which a code host follows, become files to download."""
    source[0] = re.sub(r"(?<!!)(\[[^][]*\]\()(?=(\.\./)+(benchmarks|circuits|tests|src)/)", r"\1path:", source[0])


def _formula(self: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Formulas are MathML, which browsers show by themselves: a page needs nothing from the net."""
    block = isinstance(node, nodes.math_block)
    formula = tex2mathml(node.astext(), as_block=block)
    self.body.append(f'<div style="margin: 1em 0">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register what this file adds to Sphinx."""
    app.connect("builder-inited", lambda _: gallery.main())
    app.connect("source-read", _files_beside)
    app.add_html_math_renderer("mathml", (_formula, None), (_formula, None))
