"""The documentation site: `make docs` builds it into docs/_build, and every warning is an error."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import torchfsid  # noqa: E402 after the path that leads to it

project = "torchfsid"
author = "torchfsid developers"
copyright = author
version = release = torchfsid.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "config_reference", "docstrings", "results_files"]
exclude_patterns = ["_build", "_ext", "_static", "conf.py", "notebooks/data"]

# Links: a name, page or heading that is not there is an error. Names of other libraries are not looked up, so that the
# build needs no network.
nitpicky = True
INTERNAL = (
    "commands",
    "config",
    "identification.safety_parameters",
    "logs.reading",
    "robots.avoidance",
    "robots.unknown_avoidance",
)
nitpick_ignore_regex = [(r"py:.*", r"(?!torchfsid).*"), (r"py:.*", rf"torchfsid\.({'|'.join(INTERNAL)})\..*")]
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]
myst_links_external_new_tab = True

# Notebooks are examples/ in the percent format. A cell that fails ends the build.
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 120
nb_merge_streams = True
NOTEBOOKS = ("log_to_set", "gradient_of_the_area")

default_role = "code"
python_use_unqualified_type_names = True
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"torchfsid {release}"
html_copy_source = False
html_static_path, html_css_files = ["_static"], ["wide.css"]


def _take_notebooks(app: Sphinx) -> None:
    """Copy the examples that are notebooks, and the data that they read, into the source folder."""
    notebooks, examples = HERE / "notebooks", HERE.parent / "examples"
    shutil.rmtree(notebooks, ignore_errors=True)
    shutil.copytree(examples / "data", notebooks / "data")
    for name in NOTEBOOKS:
        shutil.copy(examples / f"{name}.py", notebooks)


def setup(app: Sphinx) -> None:
    app.connect("builder-inited", _take_notebooks)
