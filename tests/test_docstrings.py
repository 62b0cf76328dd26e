"""Docstrings begin with a sentence that stands alone; `make check` runs this file."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FRAGMENT = re.compile(
    r"(What|Of|How|Whether|That|Where|They|It|As|The same|Who|Whose|Which|Why|By|Those|Both|Also|For|From|With|In|"
    r"Let)\b"
)
"""Beginnings of sentences that depend on something outside the docstring."""
FOLDERS = ("primitives", "envs", "training", "benchmarks", "docs")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def docstrings(tree):
    """Yield line and text of the docstrings of modules, classes, functions, attributes and constants."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for before, statement in zip([None, *node.body], node.body, strict=False):
            value = getattr(statement, "value", None)
            is_text = isinstance(statement, ast.Expr) and isinstance(getattr(value, "value", None), str)
            if is_text and (before is None or isinstance(before, ast.Assign | ast.AnnAssign)):
                yield statement.lineno, value.value.strip()


def fragments(source):
    return [(line, text) for line, text in docstrings(ast.parse(source)) if FRAGMENT.match(text)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_docstrings_begin_with_a_whole_sentence(path):
    assert fragments(path.read_text()) == []
