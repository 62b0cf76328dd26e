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
FILES = sorted(
    path
    for folder in ("primitives", "envs", "training", "benchmarks", "docs")
    for path in (ROOT / folder).rglob("*.py")
)


def docstrings(tree):
    """Yield line and text of the docstrings of modules, classes, functions, attributes and constants."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for before, statement in zip([None, *body], body, strict=False):
            documented = isinstance(before, ast.Assign | ast.AnnAssign) or (
                before is None and not isinstance(statement, ast.Assign)
            )
            value = getattr(statement, "value", None)
            if documented and isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield statement.lineno, value.value.strip()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_docstrings_begin_with_a_whole_sentence(path):
    fragments = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for line, text in docstrings(ast.parse(path.read_text()))
        if FRAGMENT.match(text)
    ]
    assert not fragments, "\n".join(fragments)


@pytest.mark.parametrize("text", ["Of the scene.", "What came of it.", "The same for others.", "As SB3."])
def test_fragments_are_recognised(text):
    source = f'def function():\n    """{text}"""\n\nNUMBER = 1\n"""{text}"""\n'
    found = [each for _, each in docstrings(ast.parse(source)) if FRAGMENT.match(each)]
    assert found == [text, text]
