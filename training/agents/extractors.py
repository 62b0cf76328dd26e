"""Feature extractor for the standard algorithms: a Deep Sets encoder of the obstacles."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from viapoint.envs.geometry.obstacles import POSE_SIZE

# Scale of positions, [1/m]: obstacles lie within a few decimetres of the line from start to goal
POSITION_SCALE = 5.0
MOST_POINTS = 256  # Greatest number of points of a sensor that are encoded
SHORTEST = 1e-6  # Length below which the line from hand to goal has no direction, [m]


class SceneExtractor(BaseFeaturesExtractor):
    """Features of a scene that do not depend on the order or the maximum number of its obstacles.

    Where plans are of the hand, obstacles are seen from the middle of the line from hand to goal, in a frame along
    it; in joint space, from the base. One network encodes each row; the features are the sum and the maximum over the
    obstacles that are present, or over the points that a sensor sees (Zaheer et al. 2017, Deep Sets, arXiv 1703.06114).
    The other parts of the observation are scaled to order one.

    Args:
        observation_space: Observation space of an environment of this package.
        width: Width of the layers of the obstacle network.

    Example:
        >>> from stable_baselines3 import SAC
        >>> from viapoint.training import SceneExtractor, ViaVecEnv
        >>> settings = {"features_extractor_class": SceneExtractor, "net_arch": [256, 256]}
        >>> env = ViaVecEnv("viapoint/PlanarObstacles-v0", 16, seed=0)
        >>> agent = SAC("MultiInputPolicy", env, learning_starts=16, buffer_size=100, policy_kwargs=settings).learn(32)
    """

    def __init__(self, observation_space: spaces.Dict, width: int = 64) -> None:
        boxes = cast("dict[str, spaces.Box]", dict(observation_space.items()))
        self.turns = "goal_joints" not in boxes
        """True if obstacles are seen in the frame of the line from hand to goal."""
        self.turned = tuple(name for name in ("velocity", "acceleration") if name in boxes and self.turns)
        seen = {"obstacles", "ranges", "points"}
        self.plain = tuple(sorted(set(boxes) - {"hand", "goal", *seen, *self.turned}))
        rest = sum(math.prod(boxes[name].shape) for name in (*self.turned, *self.plain))
        self.most = float(boxes["ranges"].high.max()) if "ranges" in boxes else 0.0
        """Greatest range of the sensor, [m]; 0 where the obstacles themselves are observed."""
        super().__init__(observation_space, 7 + rest + (not seen.isdisjoint(boxes)) * 2 * width)
        self._scale = {name: float(1.0 / abs(boxes[name].high).max()) for name in (*self.turned, *self.plain)}
        size = math.prod(boxes["obstacles"].shape) if "obstacles" in boxes else 0
        self.n_rows = _rows_of(boxes["obstacles"]) if size else 0
        """Greatest number of obstacles."""
        self.row_size = size // max(self.n_rows, 1)
        """Number of values of one obstacle."""
        values = 3 if self.most else max(self.row_size - 1, 0)
        self.each = nn.Sequential(nn.Linear(values + 7, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return features, shape (B, features_dim)."""
        hand, goal = observation["hand"], observation["goal"]
        line, middle = goal - hand, 0.5 * (hand + goal)
        axes = self._axes(line)
        ends = torch.cat((2.0 * middle, 2.0 * line, 2.0 * line.norm(dim=-1, keepdim=True)), dim=-1)
        parts = [ends]
        for name in self.turned:
            flat = observation[name].shape[-1]
            parts.append(_turned(axes[:, :flat, :flat], observation[name]) * self._scale[name])
        parts += [observation[name] * self._scale[name] for name in self.plain]
        origin = middle if self.turns else torch.zeros_like(middle)
        if self.most:
            parts += self._of_points(observation, axes, origin, ends)
        elif self.n_rows:
            rows = observation["obstacles"].reshape(len(hand), self.n_rows, self.row_size)
            parts += self._encoded(rows, axes, origin, ends)
        return torch.cat(parts, dim=-1)

    def _axes(self, line: Tensor) -> Tensor:
        """Return the axes of the frame in which obstacles are seen, shape (B, 3, 3), row by row."""
        axes = torch.eye(3, dtype=line.dtype, device=line.device).repeat(len(line), 1, 1)
        if not self.turns:
            return axes
        length = line[:, :2].norm(dim=-1)
        ahead = torch.where(length > SHORTEST, length, torch.ones_like(length))
        cosine = torch.where(length > SHORTEST, line[:, 0] / ahead, torch.ones_like(length))
        sine = torch.where(length > SHORTEST, line[:, 1] / ahead, torch.zeros_like(length))
        axes[:, 0, 0], axes[:, 0, 1] = cosine, sine
        axes[:, 1, 0], axes[:, 1, 1] = -sine, cosine
        return axes

    def _of_points(
        self, observation: dict[str, Tensor], axes: Tensor, origin: Tensor, ends: Tensor
    ) -> list[Tensor]:
        """Return sum and maximum over the points that a sensor sees, shape (B, width) each."""
        ranges = observation["ranges"]
        points = observation["points"].reshape(len(ranges), -1, 3)
        step = -(-points.shape[1] // MOST_POINTS)  # of a large image, evenly spaced points
        points = points[:, ::step]
        hit = (ranges[:, ::step] < self.most - 1e-4).to(ranges.dtype)
        place = POSITION_SCALE * _turned(axes[:, None], points - origin[:, None])
        about = ends[:, None].expand(-1, points.shape[1], -1)
        encoded = self.each(torch.cat((place, about), dim=-1)) * hit[..., None]
        return [encoded.mean(dim=1), encoded.amax(dim=1)]

    def _encoded(self, rows: Tensor, axes: Tensor, origin: Tensor, ends: Tensor) -> list[Tensor]:
        """Return sum and maximum over the obstacles that are present, shape (B, width) each."""
        sizes = [self.row_size - POSE_SIZE, 3, 3, 3, 3, 3, 1]
        kind, centre, first, second, half, velocity, present = torch.split(rows, sizes, dim=-1)
        frame = axes[:, None]
        place = POSITION_SCALE * _turned(frame, centre - origin[:, None])
        turned = [_turned(frame, each) for each in (first, second, velocity)]
        about = ends[:, None].expand(-1, self.n_rows, -1)
        seen = torch.cat((kind, place, *turned, POSITION_SCALE * half, about), dim=-1)
        there = (present > 0.5).to(rows.dtype)
        encoded = self.each(seen) * there
        return [0.5 * encoded.sum(dim=1), encoded.amax(dim=1)]


def _rows_of(box: spaces.Box) -> int:
    """Return the number of obstacles of the part `obstacles`, which repeats the bounds of one row."""
    low, high = box.low, box.high
    for size in range(POSE_SIZE + 1, len(high) + 1):
        rows, rest = divmod(len(high), size)
        if not rest and all((np.tile(each[:size], rows) == each).all() for each in (low, high)):
            return rows
    raise ValueError(f"the observation's obstacles have no rows: {box}")


def _turned(axes: Tensor, vectors: Tensor) -> Tensor:
    """Return vectors of shape (..., D) in a frame of shape (..., D, D)."""
    return (axes * vectors.unsqueeze(-2)).sum(dim=-1)
