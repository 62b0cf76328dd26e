"""Limits of the memory that model files may request."""

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
"""Greatest size of `model.json`, [bytes]."""
LARGEST_WEIGHTS = 1 << 30
"""Greatest size of `weights.safetensors`, [bytes]."""
LARGEST_ARGUMENTS = {
    "n_via": MOST_VIAS,
    "n_obstacles": MOST_OBSTACLES,
    "width": 8192,
    "height": 8192,
    "threads": 1024,
}
"""Greatest values in a file of those arguments of an environment that memory and time grow with."""

SPARE_PARAMETERS = 100_000
"""Number of parameters beyond its weights up to which a model is built, so that the error names the tensor."""


def check_env_arguments(kwargs: Mapping[str, Any]) -> None:
    """Check that an environment fits into memory."""
    for name, most in LARGEST_ARGUMENTS.items():
        value = kwargs.get(name, 0)
        for each in value if isinstance(value, list | tuple) else (value,):
            if isinstance(each, int | float) and each > most:
                raise ValueError(f"{name} may be at most {most} in a file, got {each}")


@contextmanager
def parameter_budget(arrays: Mapping[str, Any]) -> Iterator[None]:
    """Limit the parameters of new networks to the number in the weights, plus a few.

    Torch reserves memory for a layer before it touches it, and the check comes between the two.

    Raises:
        ValueError: A network with more parameters is built.
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
