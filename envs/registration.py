"""The table of environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

TASKS: dict[str, dict[str, Any]] = {
    "viapoint/PlanarReach-v0": {"n_obstacles": 0},
    "viapoint/PlanarObstacles-v0": {},
    "viapoint/PlanarWholeArm-v0": {"whole_arm": True},
    "viapoint/PandaReach-v0": {
        "arm": "panda",
        "whole_arm": True,
        "n_obstacles": 0,
        "duration_range": (1.0, 2.0),
    },
    "viapoint/PandaObstacles-v0": {
        "arm": "panda",
        "whole_arm": True,
        "n_obstacles": (1, 6),
        "duration_range": (1.0, 2.0),
    },
}
"""Every id with what it sets of the keyword arguments of :class:`~viapoint.envs.vector_env.ReachVectorEnv`."""

OWN_ARM_TASKS: dict[str, str] = {
    "viapoint/Reach-v0": "viapoint/PandaReach-v0",
    "viapoint/Obstacles-v0": "viapoint/PandaObstacles-v0",
}
"""Every id that is meant for an arm of one's own, `gym.make(id, arm=...)`, and the task whose arguments it has."""

STEP_TASKS: dict[str, str] = {
    "viapoint/PlanarObstaclesStep-v0": "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArmStep-v0": "viapoint/PlanarWholeArm-v0",
    "viapoint/PandaObstaclesStep-v0": "viapoint/PandaObstacles-v0",
}
"""Every id of a task with an action in every control step, and its twin, whose keyword arguments it sets.

They are :class:`~viapoint.envs.velocity_env.StepReachVectorEnv`.
"""

ONLINE_TASKS: dict[str, dict[str, Any]] = {
    "viapoint/PlanarTargetJump-v0": {"n_jumps": (1, 2)},
    "viapoint/PlanarMovingObstacles-v0": {"n_obstacles": (1, 4), "moving_obstacles": True},
    "viapoint/PandaMovingObstacles-v0": {
        "arm": "panda",
        "whole_arm": True,
        "n_obstacles": (1, 4),
        "moving_obstacles": True,
        "duration_range": (1.0, 2.0),
        "horizon": 0.5,
    },
}
"""Every id of a task whose plans are revised on the way, with what it sets of the keyword arguments.

They are those of :class:`~viapoint.envs.replanning_env.OnlineReachVectorEnv`.
"""

ENV_IDS = (*TASKS, *OWN_ARM_TASKS, *STEP_TASKS, *ONLINE_TASKS)
"""Every id."""


def register_all() -> None:
    """Make every id known to Gymnasium; a second call changes nothing."""
    for name, kwargs in TASKS.items():
        _register(
            name, "viapoint.envs.single_env:ReachEnv", "viapoint.envs.vector_env:ReachVectorEnv", kwargs
        )
    for name, like in OWN_ARM_TASKS.items():
        _register(
            name, "viapoint.envs.single_env:ReachEnv", "viapoint.envs.vector_env:ReachVectorEnv", TASKS[like]
        )
    for name, twin in STEP_TASKS.items():
        module = "viapoint.envs.velocity_env"
        _register(name, f"{module}:StepReachEnv", f"{module}:StepReachVectorEnv", TASKS[twin])
    for name, kwargs in ONLINE_TASKS.items():
        module = "viapoint.envs.replanning_env"
        _register(name, f"{module}:OnlineReachEnv", f"{module}:OnlineReachVectorEnv", kwargs)


def check_registered(env_id: str) -> None:
    """Check that Gymnasium knows an id; otherwise the error lists those of this package.

    Raises:
        ValueError: No such environment is registered.
    """
    try:
        gym.spec(env_id)
    except gym.error.UnregisteredEnv as error:
        raise ValueError(
            f"there is no environment {env_id!r} ({error}); `import viapoint.envs` registers {', '.join(ENV_IDS)}"
        ) from None


def twin_of(env_id: str) -> str:
    """The id of the task in which one action is a whole movement; of most ids themselves."""
    return STEP_TASKS.get(env_id, env_id)


def _register(name: str, entry_point: str, vector_entry_point: str, kwargs: dict[str, Any]) -> None:
    if name not in gym.registry:
        gym.register(name, entry_point=entry_point, vector_entry_point=vector_entry_point, kwargs=kwargs)
