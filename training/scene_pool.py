"""Observations to think about: of scenes that are drawn and never simulated, or of those that were visited."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from torch import Tensor

from viapoint.envs.scenes import Scenes
from viapoint.envs.task import Task
from viapoint.training.features import Look
from viapoint.training.sight import Observation


class Pool(ABC):
    """Observations for an actor to learn on; each round replaces the oldest of them.

    What the pool holds in a round depends on seed and round alone, so training that is resumed finds it as it was.

    Args:
        look: What an actor sees of observations; it is asked once for each of them.
        seed: Of the draws.
        rounds: For how many rounds observations stay.
        emphasis: How much more often hard scenes are sampled: as the number of free movements, plus one, to minus
            this power.
    """

    def __init__(
        self, look: Callable[[Observation], Look], seed: int, *, rounds: int = 32, emphasis: float = 0.5
    ) -> None:
        self._look, self._seed, self._rounds, self._emphasis = look, seed, rounds, emphasis
        self._held = [-1] * rounds
        self._free = self._weights = np.zeros(0)
        self._tensors: list[Tensor] = []
        self._names: list[str] = []
        self._generator = np.random.default_rng(seed)

    @abstractmethod
    def _numbers(self, number: int) -> range:
        """Which draws the pool holds in a round, at most as many as there are rounds."""

    @abstractmethod
    def _draw(self, number: int) -> dict[str, NDArray[np.float32]]:
        """The observations of a draw, always as many."""

    def begin(self, number: int) -> None:
        """Be as in round `number`, 0 or more."""
        for each in self._numbers(number):
            slot = each % self._rounds
            if self._held[slot] != each:
                self._fill(slot, each)
                self._held[slot] = each
        self._generator = np.random.default_rng((self._seed, number, 1))
        there = np.repeat(np.array(self._held) >= 0, len(self._free) // self._rounds)
        weights = there / (1.0 + self._free) ** self._emphasis
        self._weights = weights / weights.sum()

    def sample(self, count: int) -> tuple[Observation, Look]:
        """`count` observations, with repetition, and what an actor sees of them."""
        rows = torch.from_numpy(self._generator.choice(len(self._weights), size=count, p=self._weights))
        parts = [tensor[rows] for tensor in self._tensors]
        split = len(self._names)
        return dict(zip(self._names, parts[:split], strict=True)), Look(*parts[split:])

    def _fill(self, slot: int, number: int) -> None:
        observation = {name: torch.from_numpy(part) for name, part in self._draw(number).items()}
        look = self._look(observation)
        parts = [*observation.values(), *look]
        size = len(parts[0])
        if not self._tensors:
            self._names = list(observation)
            self._tensors = [part.new_empty((self._rounds * size, *part.shape[1:])) for part in parts]
            self._free = np.zeros(self._rounds * size)
        for tensor, part in zip(self._tensors, parts, strict=True):
            tensor[slot * size : (slot + 1) * size] = part
        self._free[slot * size : (slot + 1) * size] = look.free.sum(dim=-1).numpy()


class ScenePool(Pool):
    """First observations of many episodes, drawn and never simulated.

    Each drawn scene enters with its companions: mirrored at its straight line, and with start and goal exchanged. A
    mirrored scene may have no solution where the arm's reach ends; the critic knows.

    Args:
        task: Whose scenes are drawn.
        look: See :class:`Pool`.
        seed: Of the draws.
        fresh: Scenes drawn in each round.
        augment: Whether the companions enter.
        **settings: Of :class:`Pool`.
    """

    def __init__(
        self,
        task: Task,
        look: Callable[[Observation], Look],
        seed: int,
        *,
        fresh: int = 64,
        augment: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__(look, seed, **settings)
        self._task, self._fresh, self._augment = task, fresh, augment
        self._sampler = task.sampler()

    def _numbers(self, number: int) -> range:
        return range(number, number + self._rounds)

    def _draw(self, number: int) -> dict[str, NDArray[np.float32]]:
        generator = np.random.default_rng((self._seed, number, 0))
        scenes = self._sampler([generator] * self._fresh)
        every = [scenes, mirrored(scenes), exchanged(scenes)] if self._augment else [scenes]
        together = Scenes(*(np.concatenate(fields) for fields in zip(*every, strict=True)))
        joints = np.asarray(self._task.arm.posture(together.start))
        return self._task.observation.observe(joints, together.start, together)


class VisitedPool(Pool):
    """The last observations that decisions were made on.

    Args:
        buffer: A replay buffer of dictionaries, which keeps them.
        look: See :class:`Pool`.
        seed: Of what is sampled.
        first: How many steps of all environments came before the first round.
        **settings: Of :class:`Pool`.
    """

    def __init__(
        self,
        buffer: ReplayBuffer,
        look: Callable[[Observation], Look],
        seed: int,
        *,
        first: int,
        **settings: Any,
    ) -> None:
        super().__init__(look, seed, **settings)
        self._buffer, self._first = buffer, first

    def _numbers(self, number: int) -> range:
        last = self._first + number
        return range(max(last + 1 - self._rounds, 0), last + 1)

    def _draw(self, number: int) -> dict[str, NDArray[np.float32]]:
        observations: Any = self._buffer.observations
        return {name: part[number % self._buffer.buffer_size] for name, part in observations.items()}


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
