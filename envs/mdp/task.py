"""Task of an environment: everything that an agent may compute with before it moves."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms import REGISTER_HINT
from viapoint.envs.arms.base import Arm, CollisionModel
from viapoint.envs.geometry.rows import CAPSULES
from viapoint.envs.mdp.observation import ObservationLayout
from viapoint.envs.mdp.rewards import RewardWeights
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.families import scene_families
from viapoint.envs.scenes.feasible_path import DRAW_ORDER
from viapoint.envs.scenes.planar_families import FAMILY_ROWS
from viapoint.envs.scenes.planar_obstacles import FamilyObstacles
from viapoint.envs.scenes.sampler import SceneSampler

AnyDistribution = SceneDistribution | SpaceDistribution

FAMILY_ATTEMPTS = 2000
"""Attempts at a scene of a family in the plane; few of them succeed."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Arm, layouts, weights and scenes of an environment."""

    arm: Arm
    whole_arm: bool
    action: ActionLayout
    weights: RewardWeights
    scenes: AnyDistribution
    replanning: bool = False
    """True if an episode is several plans, each made while the one before is under way."""
    stepwise: bool = False
    """True if an action holds for one control step."""

    @property
    def spatial(self) -> bool:
        """True if the hand moves in space, False if it moves in the plane."""
        return self.arm.dimension == 3

    @functools.cached_property
    def collision_model(self) -> CollisionModel:
        """Bodies of the arm that must not touch obstacles."""
        return CollisionModel(self.arm, self.whole_arm)

    @property
    def observation(self) -> ObservationLayout:
        """Layout of the observation."""
        return ObservationLayout.of(self.arm, self.scenes.n_obstacles[1], self.scenes.shapes)

    def sampler(self) -> SceneSampler:
        """Return a sampler of scenes of the task."""
        return SceneSampler(self.collision_model, self.scenes)

    def as_dict(self) -> dict[str, Any]:
        """Return the task as plain values for JSON."""
        record = {name: dataclasses.asdict(getattr(self, name)) for name in ("action", "weights", "scenes")}
        kind = {name: True for name in ("replanning", "stepwise") if getattr(self, name)}
        return {"arm": self.arm.name, "whole_arm": self.whole_arm, **record, **kind}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any], arms: Mapping[str, Arm]) -> Task:
        """Return the task of a record of :meth:`as_dict`; its arm is one of `arms`.

        Raises:
            ValueError: The arm is not among them, or a value is not allowed.
        """
        arm = arms.get(record["arm"])
        if arm is None:
            raise ValueError(f"arm must be one of {', '.join(arms)}, got {record['arm']!r}; {REGISTER_HINT}")
        return cls(
            arm=arm,
            whole_arm=bool(record["whole_arm"]),
            action=ActionLayout(**_tuples(record["action"])),
            weights=RewardWeights(**record["weights"]),
            scenes=distribution_of(arm)(**_tuples(record["scenes"])),
            replanning=bool(record.get("replanning", False)),
            stepwise=bool(record.get("stepwise", False)),
        )


def distribution_of(arm: Arm) -> type[SceneDistribution] | type[SpaceDistribution]:
    """Return the class of an arm's scene distribution, planar or spatial."""
    return SceneDistribution if arm.dimension == 2 else SpaceDistribution


def _tuples(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with tuples instead of JSON's lists."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}


def family_sampler(task: Task, family: str) -> SceneSampler:
    """Return a sampler of one family of scenes for a task.

    Args:
        task: Task of an environment, `env.unwrapped.task`.
        family: Name of the family.

    Raises:
        ValueError: There is no such family, or it needs more obstacles than the task has.

    Example:
        >>> import gymnasium as gym, numpy as np
        >>> from viapoint.envs import family_sampler
        >>> env = gym.make("viapoint.envs:viapoint/PandaObstacles-v0")
        >>> scenes = family_sampler(env.unwrapped.task, "shelf")([np.random.default_rng(0)])
        >>> observation, _ = env.reset(options=scenes.as_options())
    """
    model, scenes = task.collision_model, task.scenes
    families, most = scene_families(scenes.dimension), scenes.n_obstacles[1]
    if family not in families:
        raise ValueError(f"family must be one of {', '.join(families)}, got {family!r}")
    record = families[family]
    if most < record.n_obstacles or not set(record.shapes) <= {*scenes.shapes, *CAPSULES}:
        raise ValueError(
            f"{family} needs a task with up to {record.n_obstacles} obstacles and the shapes {record.shapes}, this one "
            f"has {most} obstacles and the shapes {scenes.shapes}"
        )
    if isinstance(scenes, SpaceDistribution):
        return SceneSampler(model, dataclasses.replace(scenes, families=(family,)))
    planar = dataclasses.replace(scenes, n_obstacles=(1, min(FAMILY_ROWS, most)))
    obstacles = FamilyObstacles(model, planar, record.build)
    order = DRAW_ORDER[2]._replace(groups=(1,) * FAMILY_ATTEMPTS)
    return SceneSampler(model, planar, obstacles=obstacles, order=order)
