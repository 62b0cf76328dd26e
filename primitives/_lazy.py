"""Imports of names on first use, for packages whose modules take long to import."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazy_imports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package that imports its names on first use.

    The names are those that its `__init__.py` imports under `if TYPE_CHECKING:`, in the form `NAME as NAME`, by which
    type checkers know that they are exported. So there is one list of them.
    """
    module: Any = sys.modules[package]
    places: dict[str, str] = {}
    for node in ast.parse(module.__spec__.loader.get_source(package)).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for line in node.body:
                if isinstance(line, ast.ImportFrom) and line.module is not None:
                    places.update({alias.name: line.module for alias in line.names})

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(places[name]), name)

    def names() -> list[str]:
        return sorted({*vars(module), *places})

    return get, names, sorted(places)
