"""A scene as a vector, whatever the number and order of its obstacles."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from viapoint.training.features import SceneView


def layers(*sizes: int) -> nn.Sequential:
    """Linear layers with rectifiers between them, and after them where there are two or more (He et al. 2015)."""
    modules: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        linear = nn.Linear(fan_in, fan_out)
        nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
        nn.init.zeros_(linear.bias)
        modules += [linear, nn.ReLU()]
    return nn.Sequential(*modules)


class SetEncoder(nn.Module):
    """A scene as a vector, whatever the number and order of its obstacles.

    Each obstacle passes through the same network; sum and maximum over those present follow (Zaheer et al. 2017, Deep
    Sets, arXiv 1703.06114).
    """

    def __init__(self, ends: int, row: int, width: int) -> None:
        """For scenes whose ends and whose obstacles are told by so many numbers."""
        super().__init__()
        self.each = layers(ends + row, width, width)
        self.size = 2 * width + ends

    def forward(self, scene: SceneView) -> Tensor:
        """Shape (B, size)."""
        rows = scene.rows.shape[1]
        ends = scene.ends.unsqueeze(1).expand(-1, rows, -1)
        encoded = self.each(torch.cat((scene.rows, ends), dim=-1)) * scene.present.unsqueeze(-1)
        return torch.cat((0.5 * encoded.sum(dim=1), encoded.amax(dim=1), scene.ends), dim=-1)
