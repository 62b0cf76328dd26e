"""What a task is, apart from any episode of it: all that an agent may compute with before it has moved."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from viapoint.envs.action import ActionLayout
from viapoint.envs.arms import OF_ONES_OWN
from viapoint.envs.arms.arm import Arm
from viapoint.envs.observation import ObservationLayout
from viapoint.envs.reward import RewardWeights
from viapoint.envs.sampler import Sampler
from viapoint.envs.scene_distribution import SceneDistribution
from viapoint.envs.scene_sampling import SceneSampler
from viapoint.envs.space_distribution import SpaceDistribution
from viapoint.envs.space_sampling import SpaceSampler

AnyDistribution = SceneDistribution | SpaceDistribution


@dataclass(frozen=True, kw_only=True)
class Task:
    """Arm, layouts, weights and scenes of an environment."""

    arm: Arm
    whole_arm: bool
    action: ActionLayout
    weights: RewardWeights
    scenes: AnyDistribution

    @property
    def observation(self) -> ObservationLayout:
        """The layout of the observation."""
        return ObservationLayout.of(self.arm, self.scenes.n_obstacles[1])

    def sampler(self) -> Sampler:
        """Draws scenes of the task."""
        if isinstance(self.scenes, SpaceDistribution):
            return SpaceSampler(self.arm, self.scenes, whole_arm=self.whole_arm)
        return SceneSampler(self.arm, self.scenes, whole_arm=self.whole_arm)

    def as_dict(self) -> dict[str, Any]:
        """The task as plain values, fit for JSON."""
        record = {name: dataclasses.asdict(getattr(self, name)) for name in ("action", "weights", "scenes")}
        return {"arm": self.arm.name, "whole_arm": self.whole_arm, **record}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any], arms: Mapping[str, Arm]) -> Task:
        """The task that :meth:`as_dict` wrote down; its arm is one of `arms`.

        Raises:
            ValueError: The arm is not among them, or a value is not allowed.
        """
        arm = arms.get(record["arm"])
        if arm is None:
            raise ValueError(f"arm must be one of {', '.join(arms)}, got {record['arm']!r}; {OF_ONES_OWN}")
        return cls(
            arm=arm,
            whole_arm=bool(record["whole_arm"]),
            action=ActionLayout(**_tuples(record["action"])),
            weights=RewardWeights(**record["weights"]),
            scenes=distribution_of(arm)(**_tuples(record["scenes"])),
        )


def distribution_of(arm: Arm) -> type[SceneDistribution] | type[SpaceDistribution]:
    """What describes the scenes of an arm: of the plane, or of space."""
    return SceneDistribution if arm.dimension == 2 else SpaceDistribution


def _tuples(record: Mapping[str, Any]) -> dict[str, Any]:
    """JSON knows lists only; the records hold tuples."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}
