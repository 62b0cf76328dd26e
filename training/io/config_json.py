"""Configurations as JSON, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

C = TypeVar("C")


def as_json(config: Any) -> dict[str, Any]:
    """A configuration as plain values; :func:`from_json` is the inverse."""
    return {each.name: _plain(getattr(config, each.name)) for each in dataclasses.fields(config)}


def from_json(kind: type[C], record: Mapping[str, Any]) -> C:
    """A configuration from plain values.

    Raises:
        ValueError: A name is unknown or a value is not allowed.
    """
    fields = {each.name: str(each.type) for each in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(record) - set(fields))
    if unknown:
        raise ValueError(f"{kind.__name__} knows {', '.join(fields)}, not {unknown[0]!r}")
    values = {}
    for name, value in record.items():
        if "Path" in fields[name] and isinstance(value, str):
            value = Path(value)
        values[name] = tuple(value) if isinstance(value, list) else value
    return kind(**values)


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    return list(value) if isinstance(value, tuple) else value
