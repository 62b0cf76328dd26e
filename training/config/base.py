"""Base of all configurations, which are checked when they are made and convert to JSON and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from viapoint.training.config.checks import check_whole


@dataclass(frozen=True, kw_only=True)
class Config:
    """Configuration of a command; paths may be given as strings."""

    least: ClassVar[Mapping[str, int]] = {}
    """Least values of the whole numbers, by name; None is allowed where it is the default."""

    def __post_init__(self) -> None:
        """Check the values."""
        for each in dataclasses.fields(self):
            value = getattr(self, each.name)
            if isinstance(value, str) and "Path" in str(each.type):
                object.__setattr__(self, each.name, Path(value))
            if each.name in self.least and not (value is None and each.default is None):
                object.__setattr__(self, each.name, check_whole(each.name, value, self.least[each.name]))
        self._check()

    def _check(self) -> None:
        """Check what is not a whole number."""

    def as_json(self) -> dict[str, Any]:
        """Return the configuration as plain values; :meth:`from_json` is the inverse."""
        values = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        return {
            name: f"{value}"
            if isinstance(value, Path)
            else list(value)
            if isinstance(value, tuple)
            else value
            for name, value in values.items()
        }

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Self:
        """Return the configuration that plain values describe.

        Raises:
            ValueError: A name is unknown or a value is not allowed.
        """
        names = [each.name for each in dataclasses.fields(cls)]
        unknown = sorted(set(record) - set(names))
        if unknown:
            raise ValueError(f"{cls.__name__} knows {', '.join(names)}, not {unknown[0]!r}")
        return cls(
            **{name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}
        )
