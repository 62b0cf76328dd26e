"""Jinja2 templates."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2

from viapoint.training.io.files import BadFileError


def packaged(name: str) -> Path:
    """Return the path of a template of this package, such as `study/templates/page.md.j2`."""
    return Path(str(files("viapoint.training") / name))


def load_template(
    path: Path, *, escape: bool = False, filters: Mapping[str, Any] | None = None, **known: Any
) -> jinja2.Template:
    """Return a template, in which a name without a value is an error.

    Args:
        path: File of the template; others may be beside it.
        escape: True to escape values for HTML.
        filters: Further filters by name.
        **known: Values and functions that the template and its macros see.

    Raises:
        BadFileError: It is missing, or has a syntax error.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent), undefined=jinja2.StrictUndefined, autoescape=escape,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters.update(filters or {})
    environment.globals.update(known)
    try:
        return environment.get_template(path.name)
    except jinja2.TemplateError as error:
        raise BadFileError(path, f"is no template ({error})") from error
