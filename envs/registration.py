"""Ids of the environments and their keyword arguments."""

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
        "n_obstacles": (1, 8),
        "shapes": ("capsule", "box"),
        "duration_range": (1.0, 2.0),
    },
}
"""Tasks with one action per movement: ids and keyword arguments.

Their class is :class:`~viapoint.envs.vector_env.ReachVectorEnv`.
"""

OWN_ARM_TASKS: dict[str, str] = {
    "viapoint/Reach-v0": "viapoint/PandaReach-v0",
    "viapoint/Obstacles-v0": "viapoint/PandaObstacles-v0",
}
"""Tasks for an arm of your own, `gym.make(id, arm=...)`: ids and the ids whose keyword arguments they share."""

STEP_TASKS: dict[str, str] = {
    "viapoint/PlanarObstaclesStep-v0": "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarWholeArmStep-v0": "viapoint/PlanarWholeArm-v0",
    "viapoint/PandaObstaclesStep-v0": "viapoint/PandaObstacles-v0",
}
"""Tasks with one action per control step: ids and the ids whose keyword arguments they share.

Their class is :class:`~viapoint.envs.velocity_env.VelocityVectorEnv`.
"""

REPLANNING_TASKS: dict[str, dict[str, Any]] = {
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
"""Replanning tasks: ids and keyword arguments.

Their class is :class:`~viapoint.envs.replanning_env.ReplanningVectorEnv`.
"""

ENV_IDS = (*TASKS, *OWN_ARM_TASKS, *STEP_TASKS, *REPLANNING_TASKS)
"""All ids."""


def register_all() -> None:
    """Register every id with Gymnasium; a second call changes nothing."""
    own_arm, step = ({a: TASKS[b] for a, b in shared.items()} for shared in (OWN_ARM_TASKS, STEP_TASKS))
    tables = (
        ("vector_env:ReachEnv", "vector_env:ReachVectorEnv", TASKS | own_arm),
        ("velocity_env:VelocityEnv", "velocity_env:VelocityVectorEnv", step),
        ("replanning_env:ReplanningEnv", "replanning_env:ReplanningVectorEnv", REPLANNING_TASKS),
    )
    for single, batch, table in tables:
        for env_id, kwargs in table.items():
            if env_id not in gym.registry:
                gym.register(
                    env_id,
                    entry_point=f"viapoint.envs.{single}",
                    vector_entry_point=f"viapoint.envs.{batch}",
                    kwargs=kwargs,
                )


def check_registered(env_id: str) -> None:
    """Check that Gymnasium knows an id.

    Raises:
        ValueError: No such environment is registered; the message lists the ids of this package.
    """
    try:
        gym.spec(env_id)
    except gym.error.UnregisteredEnv as error:
        raise ValueError(
            f"there is no environment {env_id!r} ({error}); `import viapoint.envs` registers {', '.join(ENV_IDS)}"
        ) from None


def twin_of(env_id: str) -> str:
    """Return the id of the same task with one action per movement; for most ids, the id itself.

    Example:
        >>> twin_of("viapoint/PlanarObstaclesStep-v0")
        'viapoint/PlanarObstacles-v0'
    """
    return STEP_TASKS.get(env_id, env_id)
