"""YAML files: mappings without repeated names, with numbers as JSON and Python write them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from viapoint.training.io.files import BadFileError, read_bytes

LARGEST_YAML = 1 << 20
"""Greatest size of a YAML file, [bytes]."""
_NUMBER = re.compile(r"[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)[eE][-+]?\d+")
"""Numbers such as 1e-3, which YAML 1.1 reads as words because they lack a point or a sign."""


class _Loader(yaml.SafeLoader):
    """Loader of plain values that refuses repeated names."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping; a repeated name raises an error."""
        names = [key.value for key, _ in node.value]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise yaml.constructor.ConstructorError(None, None, f"{repeated} is there twice", node.start_mark)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789"))


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds values by name.

    Raises:
        BadFileError: It is missing, too large, no YAML, or holds something else.
    """
    content = read_bytes(path, LARGEST_YAML)
    try:
        value = yaml.load(content, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadFileError(path, f"cannot be read as YAML ({' '.join(str(error).split())})") from None
    if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
        raise BadFileError(path, "must hold values by name, such as env: viapoint/PlanarObstacles-v0")
    return value
