"""Feature extractor for the standard algorithms: a Deep Sets encoder of the obstacles."""

from __future__ import annotations

import math
from typing import cast

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from viapoint.envs.actions.via_points import frame
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.mdp.observation import is_replanning

POSITION_SCALE = 5.0
"""Scale of positions, [1/m]: obstacles lie within a few decimetres of the line from start to goal."""


class SceneExtractor(BaseFeaturesExtractor):
    """Features of a scene that do not depend on the order or the maximum number of its obstacles.

    Obstacle rows are transformed to the frame of the straight line to the goal, with its middle as origin. One network
    encodes each row; the features are the sum and the maximum over the obstacles that are present (Zaheer et al. 2017,
    Deep Sets, arXiv 1703.06114). The line begins at `start` if the observation has it, otherwise at `hand`. The other
    parts of the observation are scaled to order one; velocities and accelerations are rotated to the frame.

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
        self.dimension = boxes["goal"].shape[0]
        self.turned = tuple(name for name in ("velocity", "acceleration") if name in boxes)
        self.plain = tuple(sorted(set(boxes) - {"start", "hand", "goal", "obstacles", *self.turned}))
        own = 2 * self.dimension + 1 + ("start" in boxes) * self.dimension
        rest = sum(math.prod(boxes[name].shape) for name in (*self.turned, *self.plain))
        super().__init__(observation_space, own + rest + ("obstacles" in boxes) * 2 * width)
        shape = boxes["obstacles"].shape if "obstacles" in boxes else (0,)
        self.row_size = 2 * self.dimension + 2 if len(shape) == 1 else shape[1]
        """Number of values of one obstacle; rows of shapes are not flattened."""
        self.n_rows = math.prod(shape) // self.row_size
        """Greatest number of obstacles."""
        self._scale = {name: float(1.0 / abs(boxes[name].high).max()) for name in (*self.turned, *self.plain)}
        self.each = nn.Sequential(
            nn.Linear(self.row_size - 1 + own, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return features, shape (B, features_dim)."""
        ends, axes, middle, parts = self._ends(observation)
        if "obstacles" in observation:
            parts += self._encoded(*self._obstacles(observation["obstacles"], axes, middle), ends)
        return torch.cat(parts, dim=-1)

    def rows(self, observation: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return other features, shape (B, E), obstacle rows, shape (B, n, F), and presence, shape (B, n, 1)."""
        _, axes, middle, parts = self._ends(observation)
        return torch.cat(parts, dim=-1), *self._obstacles(observation["obstacles"], axes, middle)

    def _ends(self, observation: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return ends, axes and middle of the line, and all features that do not describe obstacles."""
        hand, goal = observation["hand"], observation["goal"]
        start = observation.get("start", hand)
        axes = torch.stack(
            frame(_direction(goal - start, MIN_GOAL_DISTANCE if is_replanning(observation) else 0.0)), dim=-2
        )
        middle = 0.5 * (start + goal)
        distance = (goal - start).norm(dim=-1, keepdim=True)
        own = [2.0 * middle, 2.0 * (goal - middle), 2.0 * distance]
        if "start" in observation:
            own.append(POSITION_SCALE * _turned(axes, hand - middle))
        ends = torch.cat(own, dim=-1)
        parts = [ends]
        parts += [_turned(axes, observation[name]) * self._scale[name] for name in self.turned]
        parts += [observation[name] * self._scale[name] for name in self.plain]
        return ends, axes, middle, parts

    def _obstacles(self, flat: Tensor, axes: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
        """Return obstacles in the frame of the line, shape (B, n, F), and their presence, shape (B, n, 1)."""
        d = self.dimension
        rows = flat.reshape(len(flat), -1, self.row_size)
        if flat.dim() == 3:
            return self._shapes(rows, axes, middle), (rows[..., -1:] > 0.5).to(flat.dtype)
        centre = _turned(axes.unsqueeze(1), rows[..., :d] - middle.unsqueeze(1))
        half = _turned(axes.unsqueeze(1), rows[..., d : 2 * d])
        half = torch.where(half[..., 1:2] < 0.0, -half, half)  # the sign of a half-axis has no meaning
        seen = POSITION_SCALE * torch.cat((centre, half, rows[..., 2 * d : 2 * d + 1]), dim=-1)
        return seen, (rows[..., -1:] > 0.5).to(flat.dtype)

    def _shapes(self, rows: Tensor, axes: Tensor, middle: Tensor) -> Tensor:
        """Return obstacles of any shape in the frame of the line, shape (B, n, F)."""
        d = self.dimension
        frame = torch.eye(3, dtype=rows.dtype, device=rows.device).repeat(len(rows), 1, 1, 1)
        frame[:, 0, :d, :d] = axes
        origin = nn.functional.pad(middle, (0, 3 - d)).unsqueeze(1)
        sizes = [rows.shape[-1] - 13, 3, 3, 3, 3]
        kind, centre, first, second, half = torch.split(rows[..., :-1], sizes, dim=-1)
        place = POSITION_SCALE * _turned(frame, centre - origin)
        turned = (_turned(frame, each) for each in (first, second))
        return torch.cat((kind, place, *turned, POSITION_SCALE * half), dim=-1)

    def _encoded(self, seen: Tensor, present: Tensor, ends: Tensor) -> list[Tensor]:
        """Return sum and maximum over the obstacles that are present, shape (B, width) each."""
        about = ends.unsqueeze(1).expand(-1, seen.shape[1], -1)
        encoded = self.each(torch.cat((seen, about), dim=-1)) * present
        return [0.5 * encoded.sum(dim=1), encoded.amax(dim=1)]


EXTRACTORS: dict[str, type[BaseFeaturesExtractor]] = {"SceneExtractor": SceneExtractor}
"""Feature extractors by the name that model files use."""


def _direction(line: Tensor, shortest: float) -> Tensor:
    """Replace lines that are shorter than `shortest` by the first axis; see ``planned_movements.direction``."""
    square = (line * line).sum(dim=-1, keepdim=True)
    ahead = torch.eye(line.shape[-1], dtype=line.dtype, device=line.device)[0]
    return torch.where((square > 0.0) & (square >= shortest**2), line, ahead)


def _turned(axes: Tensor, vectors: Tensor) -> Tensor:
    """Return vectors of shape (..., D) in a frame of shape (..., D, D)."""
    return (axes * vectors.unsqueeze(-2)).sum(dim=-1)
