# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How Sphinx makes the documentation; `make docs` builds it, and no warning is let pass."""

import sys
import xml.etree.ElementTree as Xml
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

project = 'mapmerge_ros'
author = 'mapmerge_ros contributors'
copyright = f'2026 {author}'  # noqa: A001 - the name that Sphinx reads
release = version = Xml.parse(ROOT / 'package.xml').findtext('version')

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
exclude_patterns = ['experiments', 'figures']
myst_heading_anchors = 3
html_theme = 'alabaster'
html_theme_options = {'page_width': '1100px', 'sidebar_width': '230px', 'fixed_sidebar': True}

autodoc_default_options = {'members': True, 'member-order': 'bysource'}
autodoc_typehints = 'signature'
napoleon_google_docstring = False


def setup(app):
    """Let |c|² in a docstring be what it is, not a substitution."""

    def escape(app, what, name, obj, options, lines):
        lines[:] = [line.replace('|', r'\|') for line in lines]

    app.connect('autodoc-process-docstring', escape)
