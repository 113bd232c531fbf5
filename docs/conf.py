"""Sphinx configuration: MyST pages, API from docstrings. `make docs` builds, rosdoc2 finds it here too."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

project = "dynssm_ros"
author = "dynssm_ros developers"
copyright = "2026, dynssm_ros developers"
release = "0.3.0"
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
exclude_patterns = ["README.md"]
