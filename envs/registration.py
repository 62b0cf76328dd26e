"""The table of environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

TASKS: dict[str, dict[str, Any]] = {
    "viapoint/PlanarReach-v0": {"n_obstacles": 0},
    "viapoint/PlanarObstacles-v0": {},
    "viapoint/PlanarWholeArm-v0": {"whole_arm": True},
}
"""Every id with what it sets of the keyword arguments of :class:`~viapoint.envs.reach.ReachVectorEnv`."""


def register_all() -> None:
    """Make every id known to Gymnasium; a second call changes nothing."""
    for name, kwargs in TASKS.items():
        if name not in gym.registry:
            gym.register(
                name,
                entry_point="viapoint.envs.reach:ReachEnv",
                vector_entry_point="viapoint.envs.reach:ReachVectorEnv",
                kwargs=kwargs,
            )
