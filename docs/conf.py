"""The site: pages of docs/ and of the examples, as they lie in the repository. See ``make docs``.

The source folder is the repository itself, so a link from page to page works on disk as on the
site.
"""

from __future__ import annotations

import os
from pathlib import Path

from fkgen.version import __version__

ROOT = Path(__file__).resolve().parent.parent

project = "fkgen"
author = copyright = "fkgen developers"  # noqa: A001  (Sphinx asks for this name)
release = version = __version__

root_doc = "docs/index"
include_patterns = ["docs/**", "examples/*/*.md", "CONTRIBUTING.md", "CHANGELOG.md"]
exclude_patterns = [
    ".*",
    "bench",
    "build",
    "dist",
    "fkgen",
    "generated",
    "templates",
    "tests",
    "tools",
]

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_click",
]

# Pages are Markdown; those that say so on top are notebooks, run by the build and kept until
# they change.
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_merge_streams = True

# Reference from docstrings. Types are in signatures; what a base class of Python does is its own.
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}  # by its name, not by the thirty types behind it
autodoc_default_options = {"members": True}
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "furo"
html_title = "fkgen"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_root"]  # index.html, which leads to docs/index.html
html_copy_source = False
html_show_copyright = False
html_last_updated_fmt = None

# Links that lead nowhere are warnings, but for types in signatures that have no page: those of
# other packages, and of fkgen below its public names.
nitpick_ignore_regex = [
    ("py:class", r"(collections|numpy|os|pathlib)\..*"),
    ("py:class", r"fkgen\.[a-z_]+\..*"),
    ("py:class", r"[A-Z]\w*"),
]

# External links are looked at by `make docs-links`; `-n -W` looks at those within the site.
linkcheck_timeout = 20
linkcheck_retries = 2

# Notebooks start processes of their own; they find this checkout and compile as the tests do.
os.environ["PYTHONPATH"] = str(ROOT)
os.environ.setdefault("FKGEN_CFLAGS", "-O1")
