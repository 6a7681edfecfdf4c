"""Sphinx configuration of the documentation: `sphinx-build -W notebooks site`."""

import re

from jaxcontact import __version__

project = "jaxcontact"
author = "The jaxcontact developers"
release = version = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"jaxcontact {release}"
exclude_patterns = ["scenes"]

# The notebooks are committed with their outputs; the tests run them.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 2

autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_numpy_docstring = False
# Names in single backticks.
default_role = "code"


def _as_text(app, what, name, obj, options, lines):
    """Keep `*` and `|` of formulas outside of backticks what they are in the source."""
    for number, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)", line)
        parts[::2] = [re.sub(r"([*|]|_\b)", r"\\\1", part) for part in parts[::2]]
        lines[number] = "".join(parts)


def setup(app):
    """Change docstrings before they are read as reStructuredText."""
    app.connect("autodoc-process-docstring", _as_text, priority=1)
