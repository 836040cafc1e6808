"""The documentation site: python -m sphinx -W docs site (extra docs)."""

import pathlib
import sys

HERE = pathlib.Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import generate  # noqa: E402

import mjx_nero  # noqa: E402

generate.pages(HERE / "generated")

project, version, copyright = "mjx_nero", mjx_nero.__version__, "the authors of mjx_nero, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"mjx_nero {version}"
html_copy_source = False
html_show_sphinx = False

myst_heading_anchors = 3
suppress_warnings = ["myst.header"]  # generated pages begin where their sources do
autodoc_mock_imports = ["stable_baselines3"]  # of an extra
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "undoc-members": False}
napoleon_use_ivar = True  # a field is described once


def setup(app):
    """Docstrings are plain text with ``code``: a lone star is one."""

    def plain(text: str) -> str:
        return "``".join(part if i % 2 else part.replace("*", r"\*") for i, part in enumerate(text.split("``")))

    def process(app, what, name, obj, options, lines):
        lines[:] = map(plain, lines)

    app.connect("autodoc-process-docstring", process, priority=400)  # before napoleon
