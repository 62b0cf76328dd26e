"""Settings of the documentation site, which `make docs` builds."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))

import generated  # noqa: E402
import notebooks  # noqa: E402

project, author, project_copyright = "Viapoint", "Viapoint maintainers", "Viapoint maintainers"
version = release = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext", ".ipynb": "notebook"}
exclude_patterns = ["_build", "figures", generated.TASK_PAGE]
suppress_warnings = ["myst.header"]  # the changelog repeats its headings in every version
myst_heading_anchors = 3
default_role = "code"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
nitpick_ignore_regex = [  # annotations with names of other packages, and of modules that are not exported
    (
        "py:.*",
        r"(numpy|np|gymnasium|gym|torch|mujoco|stable_baselines3|collections|pathlib|typing|types)\..*",
    ),
    ("py:exc", ".*Error"),
    ("py:(class|obj)", r"(?!viapoint\.(primitives|envs|training)\.[A-Z]\w*$).*"),
]

html_theme, html_title, html_short_title = "furo", f"Viapoint {version}", "Viapoint"
html_static_path, html_css_files, html_favicon = ["site"], ["site.css"], "site/favicon.svg"
html_copy_source = html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1d4f91", "color-brand-content": "#1d4f91"},
    "dark_css_variables": {"color-brand-primary": "#8ab4f8", "color-brand-content": "#8ab4f8"},
}


class NotebookParser(MystParser):
    """Parser of notebooks: cells become Markdown."""

    supported = ("notebook",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """Parse the text of a notebook."""
        super().parse(notebooks.markdown(inputstring), document)


def complete(app: Any, docname: str, source: list[str]) -> None:
    """Add to a page what is generated: tables of environments, lists of pages, links to pages of the root."""
    text = source[0]
    if docname == "index":
        text = generated.with_contents(text)
    elif docname == "environments":
        text = re.sub(
            rf"\({generated.TASK_PAGE}#(\w+)-v0\)",
            lambda found: f"(environments/{generated.NAMES[found[1]]}-v0.md)",
            text,
        )
        text += "\n" + generated.contents(["environments/*"], glob=True)
    up = "../" * docname.count("/")
    for name, page in generated.ROOT_PAGES.items():
        text = text.replace(f"]({up}../{name}", f"]({up}{page}")
    source[0] = text


def resolve(app: Any, env: Any, node: Any, contnode: Any) -> Any:
    """Resolve a name of an inner module, such as `viapoint.envs.geometry.shapes.Box`, to the exported one."""
    parts = node["reftarget"].split(".")
    for i, part in enumerate(parts):
        if node["refdomain"] == "py" and part in generated.EXPORTS:
            target = ".".join((generated.EXPORTS[part], *parts[i:]))
            domain = env.domains["py"]
            return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", target, node, contnode)
    return None


def escape(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Escape |x| in docstrings."""
    lines[:] = [generated.escaped(line) for line in lines]


def setup(app: Any) -> None:
    """Generate pages and connect the functions of this file."""
    generated.write_pages(Path(app.srcdir))
    app.add_source_parser(NotebookParser)
    app.connect("source-read", complete)
    app.connect("autodoc-process-docstring", escape)
    app.connect("missing-reference", resolve)
