"""Samplers of scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.planar_arm import WholeArmObstacles
from viapoint.envs.scenes.planar_draws import ENDS, WITNESSES, Uniforms, draw_ends, draw_witness
from viapoint.envs.scenes.planar_hand import HandObstacles, ObstacleSampler
from viapoint.envs.scenes.scene import Scenes


class Sampler(Protocol):
    """Draws scenes for an arm, each from a generator of its own."""

    collision_model: CollisionModel

    def __call__(
        self, generators: Sequence[np.random.Generator], ends: tuple[Float, Float] | None = None
    ) -> Scenes:
        """One scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, D) each, NaN where they are to be drawn, [m].

        Raises:
            RuntimeError: No scene was found in many attempts.
        """


ATTEMPTS = 200


class SceneSampler:
    """Draws scenes for an arm, each from a generator of its own.

    Args:
        collision_model: Arm that moves, and which of its bodies must clear.
        distribution: What scenes are like.
        placer: Puts the obstacles; by default as the distribution says.
        attempts: After how many nothing is found.
    """

    def __init__(
        self,
        collision_model: CollisionModel,
        distribution: SceneDistribution,
        *,
        placer: ObstacleSampler | None = None,
        attempts: int = ATTEMPTS,
    ) -> None:
        self.collision_model, self.distribution = collision_model, distribution
        kind = WholeArmObstacles if collision_model.whole_arm else HandObstacles
        self._placer = placer or kind(collision_model.arm, distribution)
        self._attempts = attempts

    def __call__(
        self, generators: Sequence[np.random.Generator], ends: tuple[Float, Float] | None = None
    ) -> Scenes:
        """One scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, D) each, NaN where they are to be drawn, [m].

        Raises:
            RuntimeError: No scene was found in many attempts, as with given ends in a corner of the reach.
        """
        number, dimension = len(generators), self.collision_model.arm.dimension
        scenes = Scenes(
            np.zeros((number, dimension)),
            np.zeros((number, dimension)),
            np.zeros((number, self._placer.rows, 2 * dimension + 1)),
        )
        pending = np.arange(number)
        for _ in range(self._attempts):
            if not len(pending):
                return scenes
            drawn = Uniforms(np.stack([generators[int(i)].random(self._size) for i in pending]))
            given = None if ends is None else (ends[0][pending], ends[1][pending])
            found, attempt = self._attempt(drawn, given)
            scenes.put(pending[found], attempt.take(found))
            pending = pending[~found]
        if not len(pending):
            return scenes
        raise RuntimeError(
            f"no scene with {self.distribution.n_obstacles} obstacles was found in {self._attempts} attempts"
            + ("" if ends is None else f" between start {ends[0][pending[0]]} and goal {ends[1][pending[0]]}")
        )

    @property
    def _size(self) -> int:
        """Uniform numbers of one attempt."""
        return 4 * ENDS + 3 * WITNESSES + self._placer.size

    def _attempt(
        self, uniforms: Uniforms, ends: tuple[Float, Float] | None
    ) -> tuple[NDArray[np.bool_], Scenes]:
        """Scenes, and which of them are good."""
        d, arm = self.distribution, self.collision_model.arm
        start, goal, good = draw_ends(uniforms, arm, d.distance, d.reach_margin, ends)
        witness, reached = draw_witness(uniforms, self.collision_model, (start, goal), d.reach_margin)
        obstacles, placed = self._placer(uniforms, witness)
        return good & reached & placed, Scenes(start, goal, obstacles)
