"""Sphinx configuration: MyST pages, API from docstrings. `make docs` builds, rosdoc2 finds it here too."""

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

project = "dynssm_ros"
author = "dynssm_ros developers"
copyright = "2026, dynssm_ros developers"
release = "0.4.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_title = "dynssm_ros"
html_theme_options = {"sidebar_hide_name": False}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_type_aliases = {"PathLike": "str | Path", "Log": "Recording | str | Path", "Progress": "Callable"}


def link_repository_files(app: Sphinx, name: str, source: list[str]) -> None:
    """Files of the repository outside docs/, as the measured results, are linked as they are: the site has a copy."""
    source[0] = re.sub(r"\]\(((?:\.\./)+benchmarks/[^)#]+)(?:#[^)]*)?\)", r"](path:\1)", source[0])


def setup(app: Sphinx) -> None:
    app.connect("source-read", link_repository_files)
