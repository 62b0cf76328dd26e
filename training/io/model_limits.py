"""What a model file may ask for: no more memory than its own weights account for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch.nn.modules.module import register_module_parameter_registration_hook

from viapoint.envs.actions.via_points import MOST_VIAS
from viapoint.envs.scenes.families import MOST_OBSTACLES

LARGEST_MODEL_JSON = 1 << 20
"""Size of `model.json` at most, [bytes]."""
LARGEST_WEIGHTS = 1 << 30
"""Size of `weights.safetensors` at most, [bytes]."""
LARGEST_ARGUMENTS = {
    "n_via": MOST_VIAS,
    "n_obstacles": MOST_OBSTACLES,
    "width": 8192,
    "height": 8192,
    "threads": 1024,
}
"""Arguments of an environment that memory and time grow with, and how large a file may make them."""

SPARE_PARAMETERS = 100_000
"""How many parameters more than its weights a model may describe before the difference is named tensor by tensor."""


def check_env_arguments(kwargs: Mapping[str, Any]) -> None:
    """Refuse an environment that would not fit into memory.

    Raises:
        ValueError: An argument is over its limit.
    """
    for name, most in LARGEST_ARGUMENTS.items():
        value = kwargs.get(name, 0)
        for each in value if isinstance(value, list | tuple) else (value,):
            if isinstance(each, int | float) and each > most:
                raise ValueError(f"{name} may be at most {most} in a file, got {each}")


@contextmanager
def parameter_budget(arrays: Mapping[str, Any]) -> Iterator[None]:
    """Inside, networks may have no more parameters than these weights can fill, but for a few.

    Torch reserves memory for a layer before it touches it, and the check comes between the two.

    Raises:
        ValueError: Somebody builds more.
    """
    there = sum(int(np.prod(array.shape)) for array in arrays.values())
    left = there + SPARE_PARAMETERS

    def count(module: torch.nn.Module, name: str, parameter: torch.nn.Parameter | None) -> None:
        nonlocal left
        left -= parameter.numel() if parameter is not None else 0
        if left < 0:
            raise ValueError(
                f"it describes larger networks than the {there} parameters in the weights can fill"
            )

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()
