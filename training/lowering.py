"""What a compiler is told of a graph beforehand: small sums are written out instead of asked of a library.

A call of a library takes microseconds whatever it computes, and its arguments and results must be in memory. Written
out, a small product is made together with what comes before and after it.
"""

from __future__ import annotations

import itertools
import math
import operator
from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram

TERMS = 24
"""Most of them in one number of a product or a running sum that is written out term by term."""
OUTPUTS = 512
"""Most numbers of a layer's output that are summed up one by one."""
RANKED = 256
"""Most numbers of which the greatest are found by comparing each with each."""
SETTINGS = {
    "cpp.threads": 1,
    "force_pointwise_cat": True,  # parts are computed where they are needed instead of put together in memory
}
"""Of the compiler."""


def lowered(program: ExportedProgram) -> ExportedProgram:
    """The same program with its small sums written out; what it computes differs by rounding."""
    written: ExportedProgram = program.run_decompositions(_WRITTEN_OUT)
    return written


def _linear(inputs: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    rows = math.prod(inputs.shape[:-1])
    if rows * len(weight) <= OUTPUTS:
        outputs = (inputs[..., None, :] * weight).sum(-1)
    else:
        flat = torch.mm(inputs.reshape(rows, -1), weight.t())
        outputs = flat.reshape(*inputs.shape[:-1], -1)
    return outputs if bias is None else outputs + bias


def _matmul(first: Tensor, second: Tensor) -> Any:
    terms = first.shape[-1]
    if min(first.ndim, second.ndim) < 2 or terms > TERMS:
        return NotImplemented
    return sum(first[..., i : i + 1] * second[..., i : i + 1, :] for i in range(terms))


def _cumsum(values: Tensor, dim: int, dtype: torch.dtype | None = None) -> Any:
    if values.shape[dim] > TERMS or dtype not in (None, values.dtype):
        return NotImplemented
    return torch.stack(list(itertools.accumulate(values.unbind(dim), operator.add)), dim)


def _topk(values: Tensor, k: int, dim: int = -1, largest: bool = True, *_: bool) -> Any:
    """The rank of each number is how many are before it; none of them is sorted for that."""
    number = values.shape[dim]
    if number > RANKED or not largest or dim not in (-1, values.ndim - 1):
        return NotImplemented
    places = torch.arange(number, dtype=values.dtype)
    mine, other = values[..., :, None], values[..., None, :]
    before = (other > mine) | ((other == mine) & (places < places[:, None]))
    rank = before.to(values.dtype).sum(-1)
    chosen = rank[..., None, :] == torch.arange(k, dtype=values.dtype)[:, None]
    indices = torch.where(chosen, places, 0.0).sum(-1).long()
    return values.gather(-1, indices), indices


_WRITTEN_OUT: dict[Any, Any] = {
    torch.ops.aten.linear.default: _linear,
    torch.ops.aten.matmul.default: _matmul,
    torch.ops.aten.cumsum.default: _cumsum,
    torch.ops.aten.topk.default: _topk,
}
