"""Scenes to think about: drawn, never simulated."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from viapoint.envs.scenes import Scenes
from viapoint.envs.task import Task

Observation = dict[str, Tensor]


class ScenePool:
    """First observations of many episodes; each round replaces the oldest of them by newly drawn ones.

    What the pool holds in a round depends on seed and round alone, so training that is resumed finds it as it was.
    Each drawn scene enters with its companions: mirrored at its straight line, and with start and goal exchanged. A
    mirrored scene may have no solution where the arm's reach ends; the critic knows.

    Args:
        task: Whose scenes are drawn.
        seed: Of the draws.
        fresh: Scenes drawn in each round.
        rounds: For how many rounds they stay.
        augment: Whether the companions enter.
    """

    def __init__(
        self, task: Task, seed: int, *, fresh: int = 64, rounds: int = 64, augment: bool = True
    ) -> None:
        self._task, self._seed, self._fresh, self._rounds = task, seed, fresh, rounds
        self._augment = augment
        self._sampler = task.sampler()
        self._slots: list[tuple[int, dict[str, NDArray[np.float32]]]] = []
        self._parts: dict[str, NDArray[np.float32]] = {}
        self._generator = np.random.default_rng(seed)

    def begin(self, number: int) -> None:
        """Be as in round `number`, 0 or more."""
        wanted = range(number, number + self._rounds)
        held = dict(self._slots)
        self._slots = [(i, held[i] if i in held else self._draw(i)) for i in wanted]
        parts = [part for _, part in self._slots]
        self._parts = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        self._generator = np.random.default_rng((self._seed, number, 1))

    def sample(self, count: int) -> Observation:
        """`count` observations, with repetition."""
        rows = self._generator.integers(len(self._parts["hand"]), size=count)
        return {name: torch.from_numpy(part[rows]) for name, part in self._parts.items()}

    def _draw(self, number: int) -> dict[str, NDArray[np.float32]]:
        generator = np.random.default_rng((self._seed, number, 0))
        scenes = self._sampler([generator] * self._fresh)
        every = [scenes, mirrored(scenes), exchanged(scenes)] if self._augment else [scenes]
        together = Scenes(*(np.concatenate(fields) for fields in zip(*every, strict=True)))
        joints = np.asarray(self._task.arm.posture(together.start))
        return self._task.observation.observe(joints, together.start, together)


def exchanged(scenes: Scenes) -> Scenes:
    """The same scenes the other way."""
    return Scenes(scenes.goal, scenes.start, scenes.obstacles)


def mirrored(scenes: Scenes) -> Scenes:
    """The scenes with their obstacles mirrored at the straight line (in space: at the upright plane through it)."""
    d = scenes.start.shape[-1]
    across = (scenes.goal - scenes.start)[:, None, :2]
    across = np.stack((-across[..., 1], across[..., 0]), axis=-1)
    across = across / np.maximum(np.sqrt((across**2).sum(axis=-1, keepdims=True)), 1e-9)
    obstacles = scenes.obstacles.copy()
    for part, origin in ((slice(0, 2), scenes.start[:, None, :2]), (slice(d, d + 2), 0.0)):
        offset = ((obstacles[..., part] - origin) * across).sum(axis=-1, keepdims=True)
        obstacles[..., part] -= 2.0 * offset * across
    return Scenes(scenes.start, scenes.goal, np.where(scenes.present[..., None], obstacles, 0.0))
