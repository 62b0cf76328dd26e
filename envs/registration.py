"""Ids of the environments and their keyword arguments."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium as gym

from viapoint.envs.common.validation import did_you_mean

EVENTS = ("horizon", "target", "course", "clearance")  # Events that end a decision with replanning
# Keyword arguments that turn a task of whole movements into one of control steps
STEPWISE: dict[str, Any] = {"decide_at": "steps", "reward_weights": {"progress": 1.0}}
PANDA_OBSTACLES: dict[str, Any] = {"arm": "panda", "n_obstacles": (1, 16)}

# Names of tasks and the keyword arguments in which they differ from the defaults
NAMED: dict[str, dict[str, Any]] = {
    "PlanarReach": {"n_obstacles": 0},
    "PlanarObstacles": {},
    "PlanarWholeArm": {"whole_arm": True},
    "PandaReach": {"arm": "panda", "n_obstacles": 0},
    "PandaObstacles": PANDA_OBSTACLES,
    "PlanarTargetJump": {"n_obstacles": 0, "n_jumps": (1, 2), "decide_at": EVENTS},
    "PlanarMovingObstacles": {"n_obstacles": (1, 4), "moving_obstacles": True, "decide_at": EVENTS},
    "PandaMovingObstacles": {
        "arm": "panda",
        "n_obstacles": (1, 4),
        "families": "clutter",
        "moving_obstacles": True,
        "decide_at": EVENTS,
        "horizon": 0.5,
    },
    "PlanarSensed": {"sensor": "rays", "n_via": 2, "via_range": 2.0},
    "PandaSensed": {**PANDA_OBSTACLES, "sensor": "camera"},
}
TASKS: dict[str, dict[str, Any]] = {
    **{f"viapoint/{name}-v0": kwargs for name, kwargs in NAMED.items()},
    **{f"viapoint/{name}Step-v0": {**kwargs, **STEPWISE} for name, kwargs in NAMED.items()},
    "viapoint/Reach-v0": {"arm": "panda", "n_obstacles": 0},
    "viapoint/Obstacles-v0": PANDA_OBSTACLES,
}
"""Keyword arguments by id; `Reach` and `Obstacles` are for other arms."""

ENV_IDS = tuple(TASKS)
"""All ids."""


def register_all() -> None:
    """Register every id with Gymnasium; a second call changes nothing."""
    for env_id, kwargs in TASKS.items():
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point="viapoint.envs.env:ReachEnv",
                vector_entry_point="viapoint.envs.vector_env:ReachVectorEnv",
                kwargs=kwargs,
                # Gymnasium's checker fails in `step` after a first `reset` that raised an error.
                disable_env_checker=True,
            )


MODULES: dict[str, str] = {}  # Modules that ids were given with


def full_id(env_id: str) -> str:
    """Return an id as it was given, with the module in front of it, if any."""
    return f"{MODULES[env_id]}:{env_id}" if env_id in MODULES else env_id


def check_registered(env_id: str) -> str:
    """Return an id that Gymnasium knows, without the module in front of it (`my_module:my/Task-v0`), which is imported.

    :func:`full_id` returns it with the module.

    Raises:
        ValueError: It is no id, or there is no such module or environment; the message names the closest id.
    """
    if not isinstance(env_id, str):
        raise ValueError(f"env must be the id of an environment, got {env_id!r}")
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        gym.spec(name)
        if module and name not in ENV_IDS:
            MODULES[name] = module
    except ImportError as error:
        raise ValueError(f"the module of {env_id!r} cannot be imported: {error}") from error
    except gym.error.Error:
        ours = [each for each in gym.registry if each.startswith("viapoint/")]
        hint = did_you_mean(name, ours) or f"; name the module that registers it, as in my_module:{name}"
        raise ValueError(f"there is no environment {name!r}{hint}") from None
    return name
