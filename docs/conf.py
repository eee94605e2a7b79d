"""How Sphinx builds the documentation: `python -m sphinx -W docs build/docs`."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "ltsim"
author = "The ltsim developers"
copyright = author  # noqa: A001  # Sphinx asks for this name
release = version = version_of("ltsim")

extensions = ["myst_parser", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "from_code"]
exclude_patterns = ["example-effect"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "amsmath"]
myst_heading_anchors = 3
math_numfig = True
autodoc_typehints = "none"  # shapes and units stand in the docstrings
napoleon_google_docstring = False

html_theme = "furo"
html_title = f"ltsim {release}"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["ltsim.css"]
html_show_sourcelink = False
html_copy_source = False
