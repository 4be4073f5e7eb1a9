"""Sphinx configuration of the documentation site; `make docs` builds it."""

from __future__ import annotations

import os
from importlib.metadata import version as version_of

project = "sdc-taichi"
author = "sdc-taichi authors"
copyright = author
release = version_of("sdc-taichi")
version = os.environ.get("DOCS_VERSION", release)
"""Name of this build in the list of versions, such as ``dev`` or ``0.2``."""

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
root_doc = "index"
exclude_patterns = ["**/.ipynb_checkpoints"]
highlight_language = "none"
nitpicky = True
# Types of other packages and aliases have no pages here.
nitpick_ignore_regex = [("py:.*", ".*")]
suppress_warnings = ["mystnb.unknown_mime_type"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_merge_streams = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True

autodoc_typehints = "signature"
autodoc_type_aliases = {name: name for name in ("F32", "F64", "I64", "Inputs", "Varied")}
autodoc_member_order = "bysource"
autodoc_mock_imports = ["torch", "ray", "minari", "onnx", "onnxruntime", "tensorboard"]
napoleon_numpy_docstring = False

html_theme = "pydata_sphinx_theme"
html_title = f"sdc-taichi {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "logo": {"text": "sdc-taichi"},
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 4,
    "navbar_center": ["navbar-nav"],
    "navbar_end": ["theme-switcher"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
# Versions can be chosen where the site is served beside others, which is told by the address of
# the list of them.
if switcher := os.environ.get("DOCS_SWITCHER"):
    html_theme_options |= {
        "switcher": {"json_url": switcher, "version_match": version},
        "check_switcher": False,
        "navbar_end": ["version-switcher", "theme-switcher"],
    }
