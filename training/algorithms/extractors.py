"""Observations as vectors for the standard algorithms: a set of obstacles, seen along the line to the goal."""

from __future__ import annotations

import math
from typing import cast

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from viapoint.envs.actions.via_points import MIN_GOAL_DISTANCE, frame
from viapoint.training.search.planned_movements import is_replanning

PLACES = 5.0
"""Metres times this are of size one: obstacles lie within a few decimetres of the line."""


class SceneExtractor(BaseFeaturesExtractor):
    """Features of a scene that depend neither on the order of its obstacles nor on how many there might be.

    Obstacles are seen in the frame of the straight line, from its middle; each passes through the same network, of
    which sum and maximum over those present remain (Zaheer et al. 2017, Deep Sets, arXiv 1703.06114). The line runs
    from `start` where the observation has one, otherwise from `hand`. What else is observed follows, made of size one;
    vectors of the plane or of space other than the ends are turned into the frame.

    Args:
        observation_space: Of an environment of this package.
        width: Of the network that sees one obstacle.
    """

    def __init__(self, observation_space: spaces.Dict, width: int = 64) -> None:
        boxes = cast("dict[str, spaces.Box]", dict(observation_space.items()))
        self.dimension = boxes["goal"].shape[0]
        self.turned = tuple(name for name in ("velocity", "acceleration") if name in boxes)
        self.plain = tuple(sorted(set(boxes) - {"start", "hand", "goal", "obstacles", *self.turned}))
        own = 2 * self.dimension + 1 + ("start" in boxes) * self.dimension
        rest = sum(math.prod(boxes[name].shape) for name in (*self.turned, *self.plain))
        super().__init__(observation_space, own + rest + ("obstacles" in boxes) * 2 * width)
        self._scale = {name: float(1.0 / abs(boxes[name].high).max()) for name in (*self.turned, *self.plain)}
        self.each = nn.Sequential(
            nn.Linear(2 * self.dimension + 1 + own, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return features, shape (B, features_dim)."""
        ends, axes, middle, parts = self._ends(observation)
        if "obstacles" in observation:
            parts += self._encoded(*self._obstacles(observation["obstacles"], axes, middle), ends)
        return torch.cat(parts, dim=-1)

    def rows(self, observation: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return what is no obstacle, shape (B, E), obstacles (B, n, F), and their presence (B, n, 1)."""
        _, axes, middle, parts = self._ends(observation)
        return torch.cat(parts, dim=-1), *self._obstacles(observation["obstacles"], axes, middle)

    def _ends(self, observation: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return ends, axes and middle of the line, and all features that are no obstacles."""
        hand, goal = observation["hand"], observation["goal"]
        start = observation.get("start", hand)
        axes = torch.stack(
            frame(_direction(goal - start, MIN_GOAL_DISTANCE if is_replanning(observation) else 0.0)), dim=-2
        )
        middle = 0.5 * (start + goal)
        distance = (goal - start).norm(dim=-1, keepdim=True)
        own = [2.0 * middle, 2.0 * (goal - middle), 2.0 * distance]
        if "start" in observation:
            own.append(PLACES * _turned(axes, hand - middle))
        ends = torch.cat(own, dim=-1)
        parts = [ends]
        parts += [_turned(axes, observation[name]) * self._scale[name] for name in self.turned]
        parts += [observation[name] * self._scale[name] for name in self.plain]
        return ends, axes, middle, parts

    def _obstacles(self, flat: Tensor, axes: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
        """Return obstacles in the frame of the line, shape (B, n, F), and their presence, shape (B, n, 1)."""
        d = self.dimension
        rows = flat.reshape(len(flat), -1, 2 * d + 2)
        centre = _turned(axes.unsqueeze(1), rows[..., :d] - middle.unsqueeze(1))
        half = _turned(axes.unsqueeze(1), rows[..., d : 2 * d])
        half = torch.where(half[..., 1:2] < 0.0, -half, half)  # a bar has no sense of direction
        seen = PLACES * torch.cat((centre, half, rows[..., 2 * d : 2 * d + 1]), dim=-1)
        return seen, (rows[..., -1:] > 0.5).to(flat.dtype)

    def _encoded(self, seen: Tensor, present: Tensor, ends: Tensor) -> list[Tensor]:
        """Return sum and maximum over the obstacles that are there, shape (B, width) each."""
        about = ends.unsqueeze(1).expand(-1, seen.shape[1], -1)
        encoded = self.each(torch.cat((seen, about), dim=-1)) * present
        return [0.5 * encoded.sum(dim=1), encoded.amax(dim=1)]


EXTRACTORS: dict[str, type[BaseFeaturesExtractor]] = {"SceneExtractor": SceneExtractor}
"""By the name that a model's file knows them by."""


def _direction(line: Tensor, shortest: float) -> Tensor:
    """Replace lines that are shorter, or of no length, by the first axis; see ``planned_movements.direction``."""
    square = (line * line).sum(dim=-1, keepdim=True)
    ahead = torch.eye(line.shape[-1], dtype=line.dtype, device=line.device)[0]
    return torch.where((square > 0.0) & (square >= shortest**2), line, ahead)


def _turned(axes: Tensor, vectors: Tensor) -> Tensor:
    """Vectors, shape (..., D), in a frame of shape (..., D, D)."""
    return (axes * vectors.unsqueeze(-2)).sum(dim=-1)
