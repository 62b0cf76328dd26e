"""Machine code of a function of tensors, made by torch's compiler, and kept for the next process that needs it."""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch._inductor import aoti_compile_and_package, aoti_load_package

import viapoint.envs
import viapoint.primitives
from viapoint.training import graphs
from viapoint.training.lowering import SETTINGS, lowered

Run = Callable[[list[Tensor]], list[Tensor]]
"""Machine code, from a list of arguments to a list of results."""


def machine_code(module: nn.Module, example: tuple[Tensor, ...], kept: Path | None) -> Run:
    """Machine code on one thread, for arguments of the shapes of an example.

    Args:
        module: What is to be computed.
        example: Arguments.
        kept: The file that it is loaded from or, where there is none, written to; None keeps nothing.

    Raises:
        ValueError: The file cannot be loaded.
    """
    if kept is not None and kept.is_file():
        try:
            return _loaded(kept)
        except RuntimeError as error:
            raise ValueError(f"{kept} is no machine code that can be loaded; delete it: {error}") from None
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
    where = None if kept is None else kept.parent
    with tempfile.TemporaryDirectory(prefix="viapoint-", dir=where) as folder:
        made = _translated(module, example, Path(folder) / "code.pt2")
        if kept is not None:
            os.replace(made, kept)
        return _loaded(kept or made)


def digest(settings: str, weights: Mapping[str, Tensor]) -> str:
    """What machine code depends on as one word: settings, weights, this program, torch and the processor."""
    parts = hashlib.sha256(_program())
    parts.update(repr((settings, torch.__version__, torch.cpu.get_capabilities())).encode())
    for name, tensor in weights.items():
        parts.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        parts.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return parts.hexdigest()


@functools.cache
def _program() -> bytes:
    """Hash of every source file of the package."""
    parts = hashlib.sha256()
    for package in (viapoint.primitives, viapoint.envs, viapoint.training):
        folder = Path(str(package.__file__)).parent
        for file in sorted(folder.rglob("*.py")):
            parts.update(f"{package.__name__} {file.relative_to(folder)}".encode())
            parts.update(file.read_bytes())
    return parts.digest()


def _translated(module: nn.Module, example: tuple[Tensor, ...], file: Path) -> Path:
    with torch.no_grad(), graphs.drawn(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's own parts about each other
        module(*example)  # constants must be there before a graph is drawn: within one they are no numbers
        graph = lowered(torch.export.export(module, example))
        return Path(aoti_compile_and_package(graph, package_path=str(file), inductor_configs=SETTINGS))


def _loaded(file: Path) -> Run:
    run: Run = aoti_load_package(str(file)).loader.boxed_run
    return run
