"""Checks of the plain values that describe a study, and grids of them."""

from __future__ import annotations

import difflib
import itertools
import string
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from viapoint.training.config.checks import check_whole

Values = Mapping[str, Any]


def unknown(what: str, value: object, allowed: Collection[str]) -> str:
    """Return the message about an unknown name, with the closest allowed one."""
    close = difflib.get_close_matches(str(value), list(allowed), n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"{what} must be one of {', '.join(allowed)}, got {value!r}{hint}"


def expanded(what: str, given: Any, allowed: Sequence[str]) -> Iterator[tuple[str, str, str, Values]]:
    """Yield place, name, label and fields of each entry, with one entry for each point of a grid."""
    for pattern, fields in named(what, given):
        where = f"{what}.{pattern}"
        check_fields(where, fields, allowed)
        grid = mapping(f"{where}.grid", fields.get("grid", {}))
        for name in grid:
            if name.partition(".")[0] not in allowed or name == "grid":
                raise ValueError(unknown(f"{where}.grid", name.partition(".")[0], allowed))
        short = {name: name.rpartition(".")[2] for name in grid}
        for values in itertools.product(
            *(listed(f"{where}.grid.{name}", each) for name, each in grid.items())
        ):
            point = dict(zip(grid, values, strict=True))
            shown = {short[name]: value for name, value in point.items()}
            one = {name: value for name, value in fields.items() if name != "grid"}
            for name, value in point.items():
                one = _with(one, name.split("."), value)
            name = _filled(f"{where}: the name", pattern, shown)
            label = _filled(f"{where}.label", str(fields.get("label", pattern)), shown)
            if "{" in str(one.get("time_of")):
                one["time_of"] = _filled(f"{where}.time_of", str(one["time_of"]), shown)
            yield where, name, label, one


def _with(fields: Values, path: Sequence[str], value: Any) -> dict[str, Any]:
    """Return fields in which the one at a path has another value."""
    first, *rest = path
    return {**fields, first: _with(fields.get(first, {}), rest, value) if rest else value}


def _filled(where: str, pattern: str, point: Values) -> str:
    """Return a pattern with the values of a grid's point: in its {fields}, or after it if it has none."""
    fields = [name for _, name, _, _ in string.Formatter().parse(pattern) if name is not None]
    for name in fields:
        if name not in point:
            raise ValueError(unknown(f"{where}: {{}}", name, list(point)))
    if fields:
        return pattern.format(**point)
    return "-".join([pattern, *(f"{name}={value}" for name, value in point.items())])


def named(where: str, given: Any) -> Iterator[tuple[str, Values]]:
    """Yield names and fields from a mapping or from a list of names."""
    if isinstance(given, list):
        given = dict.fromkeys(given)
    if not isinstance(given, Mapping) or (where == "environments" and not given):
        raise ValueError(f"{where} must be a list of names, or values by name, got {given!r}")
    for name, fields in given.items():
        if not isinstance(name, str) or not name.strip("/. ") or ".." in name:
            raise ValueError(f"{where} must have names that are words, got {name!r}")
        yield name, mapping(f"{where}.{name}", {} if fields is None else fields)


def mapping(where: str, given: Any) -> Values:
    """Return values by name, or raise ValueError."""
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} must be values by name, got {given!r}")
    return given


def listed(where: str, given: Any) -> list[Any]:
    """Return a list, or raise ValueError."""
    if not isinstance(given, list | tuple):
        raise ValueError(f"{where} must be a list, got {given!r}")
    return list(given)


def seeds_of(where: str, given: Any) -> tuple[int, ...]:
    """Return seeds that differ, or raise ValueError."""
    seeds = tuple(listed(where, given))
    for seed in seeds:
        check_whole(where, seed, 0)
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"{where} must hold at least one number and none twice, got {list(seeds)}")
    return seeds


def check_number(where: str, value: Any, least: int = 1) -> None:
    """Check that a value is None or a whole number."""
    if value is not None:
        check_whole(where, value, least)


def check_fields(where: str, given: Values, allowed: Sequence[str]) -> None:
    """Check that all fields are allowed."""
    for name in given:
        if name not in allowed:
            raise ValueError(unknown(f"{where}: fields", name, allowed))
