"""Command-line arguments NAME=VALUE, with values in JSON or words."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from typing import Annotated, Any

import tyro

from viapoint.training.io.files import refuse_constant


def from_words(words: list[str]) -> dict[str, Any]:
    """Return NAME=VALUE words as a dictionary; values are JSON if possible, otherwise words.

    Raises:
        ValueError: A word has no name, a name is there twice, or a value is neither JSON nor a plain word.
    """
    result: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name:
            raise ValueError(f"must be NAME=VALUE, got {word!r}")
        if name in result:
            raise ValueError(f"{name} is there twice, as {json.dumps(result[name])} and as {value}")
        result[name] = _value(name, value)
    return result


def to_words(values: Mapping[str, Any]) -> list[str]:
    """Return a dictionary as NAME=VALUE words; :func:`from_words` is the inverse."""
    return [f"{name}={_text(value)}" for name, value in values.items()]


def _text(value: Any) -> str:
    text = json.dumps(value, separators=(",", ":"))
    try:
        plain = isinstance(value, str) and _value("", value) == value
    except ValueError:
        plain = False
    return value if plain else text


def _value(name: str, text: str) -> Any:
    try:
        return json.loads(text, parse_constant=refuse_constant)
    except ValueError:
        suggestion = _as_json(text)
        if suggestion is None and text[:1] not in tuple("[{(\"'") and not _is_number(text):
            return text
    advice = f"{name}={suggestion}" if suggestion else "numbers, words, true, false, null, [1,8]"
    raise ValueError(f"{name}={text} is no JSON, which values are written in: {advice}")


def _is_number(text: str) -> bool:
    """Return whether Python reads a number, including nan and Infinity, which JSON lacks."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _as_json(text: str) -> str | None:
    """Return JSON for Python values such as True and (1, 8)."""
    try:
        return json.dumps(ast.literal_eval(text), allow_nan=False, separators=(",", ":"))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None


_NAMED_VALUES = tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="NAME=VALUE",
    instance_from_str=from_words,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=to_words,
)
NamedValues = Annotated[dict[str, Any], _NAMED_VALUES]
"""Dictionary that the command line writes as NAME=VALUE NAME=VALUE ..."""
