"""Values as words of a command line, and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from viapoint.training.io.files import parse_yaml

REGISTRY = ConstructorRegistry()  # Ways in which the command line reads numbers and paths
KINDS = {
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
    Path: ("PATH", "a path"),
    str: ("TEXT", ""),
}
"""Name in helps and in errors of the types of values."""


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the form of a number, path or text, or of one that may be left out."""
    kinds = get_args(info.type) if info.type_origin in (Union, UnionType) else (info.type,)
    kind: Any = next((each for each in KINDS if each in kinds), None)  # a path before a text
    if kind is None or not set(kinds) <= {NoneType, *KINDS}:
        return None
    metavar, what = KINDS[kind]

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"must be {what}, got {words[0]!r}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: ["none" if value is None else str(value)],
    )


def from_words(words: list[str]) -> dict[str, Any]:
    """Return NAME=VALUE words as a dictionary; values are YAML, so that lists and settings by name have a form."""
    values: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name:
            raise ValueError(f"must be NAME=VALUE, got {word!r}")
        if name in values:
            raise ValueError(f"{name} is there twice")
        values[name] = parse_yaml(text)
    return values


def to_words(values: Mapping[str, Any]) -> list[str]:
    """Return a dictionary as NAME=VALUE words; :func:`from_words` is the inverse."""
    words = []
    for name, value in values.items():
        plain = isinstance(value, str) and parse_yaml(value) == value
        words.append(f"{name}={value if plain else json.dumps(value)}")
    return words


# tyro reads a dictionary of one type of values only.
NamedValues = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="NAME=VALUE",
        instance_from_str=from_words,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=to_words,
    ),
]
"""Dictionary that the command line writes as NAME=VALUE NAME=VALUE ..."""
