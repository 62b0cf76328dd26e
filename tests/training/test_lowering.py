"""Laws of what a compiler is told: the same is computed, and only what is large is asked of a library."""

import torch
from torch import nn

from viapoint.training.lowering import OUTPUTS, RANKED, TERMS, lowered


class Sums(nn.Module):
    def __init__(self):
        super().__init__()
        self.narrow, self.wide = nn.Linear(5, 3), nn.Linear(5, OUTPUTS, bias=False)

    def forward(self, rows, columns):
        few, many = rows[:, :TERMS], columns[:TERMS]
        layers = self.narrow(rows[..., :5]), self.wide(rows[..., :5])
        return *layers, few @ many, rows @ columns, many.cumsum(0), columns.cumsum(0), rows @ columns[:, 0]


def test_sums_are_the_same_and_only_large_ones_are_left_to_a_library():
    generator = torch.Generator().manual_seed(0)
    rows, columns = (torch.randn(shape, generator=generator) for shape in ((2, TERMS + 9), (TERMS + 9, 4)))
    program = torch.export.export(Sums(), (rows, columns))
    written = lowered(program)
    for mine, theirs in zip(written.module()(rows, columns), program.module()(rows, columns), strict=True):
        torch.testing.assert_close(mine, theirs)
    kinds = [str(node.target).removeprefix("aten.").split(".")[0] for node in written.graph.nodes]
    left = [kind for kind in kinds if kind in ("linear", "matmul", "mm", "mv", "cumsum")]
    assert sorted(left) == ["cumsum", "matmul", "matmul", "mm"]


class Greatest(nn.Module):
    def forward(self, few, many):
        return *few.topk(7, dim=-1), *many.topk(7, dim=-1)


def test_the_greatest_of_few_are_found_in_their_order_without_sorting():
    generator = torch.Generator().manual_seed(0)
    few, many = (torch.randn(3, number, generator=generator) for number in (RANKED, RANKED + 1))
    program = torch.export.export(Greatest(), (few, many))
    written = lowered(program)
    for mine, theirs in zip(written.module()(few, many), program.module()(few, many), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0.0, atol=0.0)
    assert sum(node.target is torch.ops.aten.topk.default for node in written.graph.nodes) == 1
    equal = torch.zeros(3, RANKED)
    chosen = written.module()(equal, many)[1]
    assert all(len(set(row)) == 7 for row in chosen.tolist())
