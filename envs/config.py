"""Keyword arguments of the environments, with their defaults and checks.

The classes of the environments document each argument.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from viapoint.envs.actions.via_points import ActionLayout, Timing
from viapoint.envs.arms import ADULT, Arm, arm_of
from viapoint.envs.geometry.rows import CAPSULES, check_shapes
from viapoint.envs.mdp.rewards import ReplanningRewardWeights, RewardWeights, StepRewardWeights
from viapoint.envs.mdp.task import Task, distribution_of
from viapoint.envs.sim.replan_triggers import TRIGGERS, Trigger


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Keyword arguments that all environments share; see :class:`~viapoint.envs.vector_env.ReachVectorEnv`."""

    weights_kind: ClassVar[type[RewardWeights]] = RewardWeights
    """Class of the reward's weights."""
    replanning: ClassVar[bool] = False
    """True if an episode is several plans."""
    stepwise: ClassVar[bool] = False
    """True if an action holds for one control step."""

    arm: Arm | str = ADULT
    whole_arm: bool = False
    n_obstacles: int | tuple[int, int] = (1, 5)
    shapes: str | Sequence[str] = CAPSULES
    duration_range: tuple[float, float] = (0.6, 1.2)
    reward_weights: RewardWeights | Mapping[str, float] | None = None
    render_mode: str | None = None
    width: int = 480
    height: int = 480
    threads: int = 0

    @classmethod
    def of(cls, kwargs: Mapping[str, Any]) -> Self:
        """Return the record of some keyword arguments.

        Raises:
            TypeError: There is no such argument.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        if unknown := sorted(kwargs.keys() - set(known)):
            raise TypeError(
                f"unknown keyword argument {', '.join(map(repr, unknown))}; allowed are {', '.join(known)}"
            )
        return cls(**kwargs)

    @classmethod
    def signature(cls) -> inspect.Signature:
        """Return the signature of a vector environment with these keyword arguments."""
        named = inspect.signature(cls).parameters.values()
        number = inspect.Parameter("num_envs", inspect.Parameter.POSITIONAL_OR_KEYWORD, default=1)
        return inspect.Signature([number, *named])

    def task(self) -> Task:
        """Return the task that these arguments describe.

        Raises:
            TypeError: An argument has another type.
            ValueError: An argument has a value that is not allowed.
        """
        arm = arm_of(self.arm)
        if not isinstance(self.whole_arm, bool | np.bool_):
            raise TypeError(f"whole_arm must be True or False, got {self.whole_arm!r}")
        distribution = distribution_of(arm)
        n_obstacles: Any = self.n_obstacles
        return Task(
            arm=arm,
            whole_arm=bool(self.whole_arm),
            action=self._action_layout(arm.dimension),
            weights=self.weights_kind.of(self.reward_weights),
            scenes=distribution(
                n_obstacles=n_obstacles,
                **distribution.for_shapes(check_shapes(self.shapes)),
            ),
            replanning=self.replanning,
            stepwise=self.stepwise,
        )

    def _action_layout(self, dimension: int) -> ActionLayout:
        return ActionLayout(dimension=dimension, duration_range=self.duration_range)


@dataclass(frozen=True, kw_only=True)
class ViaPointConfig(EnvConfig):
    """Keyword arguments of environments whose actions are via-points and a duration."""

    n_via: int = 1
    timing: Timing = "optimal"

    def _action_layout(self, dimension: int) -> ActionLayout:
        return ActionLayout(
            dimension=dimension, n_via=self.n_via, timing=self.timing, duration_range=self.duration_range
        )


@dataclass(frozen=True, kw_only=True)
class VelocityConfig(EnvConfig):
    """Keyword arguments of :class:`~viapoint.envs.velocity_env.VelocityVectorEnv`."""

    weights_kind = StepRewardWeights
    stepwise = True

    control_step: float = 0.04


@dataclass(frozen=True, kw_only=True)
class ReplanningConfig(ViaPointConfig):
    """Keyword arguments of :class:`~viapoint.envs.replanning_env.ReplanningVectorEnv`."""

    weights_kind = ReplanningRewardWeights
    replanning = True

    n_obstacles: int | tuple[int, int] = 0
    moving_obstacles: bool = False
    n_jumps: int | tuple[int, int] = 0
    decide_at: Sequence[Trigger] = TRIGGERS
    horizon: float = 0.3
    margin: float = 0.02

    def task(self) -> Task:
        """Return the task that these arguments describe; see :meth:`EnvConfig.task`."""
        task = super().task()
        if self.timing != "optimal":
            raise ValueError(f"timing must be optimal where plans are revised, got {self.timing!r}")
        if not isinstance(self.moving_obstacles, bool | np.bool_):
            raise TypeError(f"moving_obstacles must be True or False, got {self.moving_obstacles!r}")
        return task
