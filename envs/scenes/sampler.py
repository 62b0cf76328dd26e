"""Samplers of scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.config import SceneDistribution
from viapoint.envs.scenes.planar_arm import WholeArmObstacles
from viapoint.envs.scenes.planar_draws import ENDS, WITNESSES, Uniforms, draw_ends, draw_witness
from viapoint.envs.scenes.planar_hand import HandObstacles, ObstacleSampler
from viapoint.envs.scenes.scene import Scenes


class Sampler(Protocol):
    """Draws scenes for an arm, each from a generator of its own."""

    arm: Arm
    whole_arm: bool

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
        arm: Whose hand moves.
        distribution: What scenes are like.
        whole_arm: Whether every link must clear.
        placer: Puts the obstacles; by default as the distribution says.
        attempts: After how many nothing is found.
    """

    def __init__(
        self,
        arm: Arm,
        distribution: SceneDistribution,
        *,
        whole_arm: bool,
        placer: ObstacleSampler | None = None,
        attempts: int = ATTEMPTS,
    ) -> None:
        self.arm = arm
        self.distribution = distribution
        self.whole_arm = whole_arm
        self._placer = placer or (WholeArmObstacles if whole_arm else HandObstacles)(arm, distribution)
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
        number, dimension = len(generators), self.arm.dimension
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
        d = self.distribution
        start, goal, good = draw_ends(uniforms, self.arm, d.distance, d.reach_margin, ends)
        witness, reached = draw_witness(
            uniforms, self.arm, (start, goal), d.reach_margin, whole_arm=self.whole_arm
        )
        obstacles, placed = self._placer(uniforms, witness)
        return good & reached & placed, Scenes(start, goal, obstacles)
