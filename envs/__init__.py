"""Gymnasium environments whose actions are via-points and durations; importing this package registers them.

:data:`ENV_IDS` lists the ids. Other names are imported when they are first used.
"""

import importlib
from typing import TYPE_CHECKING

from viapoint.envs.common import mujoco_check as mujoco_check
from viapoint.envs.registration import ENV_IDS, TASKS, register_all

if TYPE_CHECKING:
    from viapoint.envs.actions.via_points import Plan
    from viapoint.envs.arm_import.loader import load_arm
    from viapoint.envs.arms import register_arm
    from viapoint.envs.arms.base import Arm
    from viapoint.envs.mdp.task import family_sampler
    from viapoint.envs.record_video import RecordMovements
    from viapoint.envs.replanning_env import ReplanningEnv, ReplanningVectorEnv
    from viapoint.envs.scenes.families import register_scene_family
    from viapoint.envs.scenes.scene import TARGETS, rows_of_lights
    from viapoint.envs.single_env import ReachEnv
    from viapoint.envs.vector_env import ReachVectorEnv
    from viapoint.envs.velocity_env import VelocityEnv, VelocityVectorEnv
else:
    _MODULES = {
        "Arm": "viapoint.envs.arms.base",
        "ReplanningEnv": "viapoint.envs.replanning_env",
        "ReplanningVectorEnv": "viapoint.envs.replanning_env",
        "Plan": "viapoint.envs.actions.via_points",
        "ReachEnv": "viapoint.envs.single_env",
        "ReachVectorEnv": "viapoint.envs.vector_env",
        "RecordMovements": "viapoint.envs.record_video",
        "VelocityEnv": "viapoint.envs.velocity_env",
        "VelocityVectorEnv": "viapoint.envs.velocity_env",
        "TARGETS": "viapoint.envs.scenes.scene",
        "family_sampler": "viapoint.envs.mdp.task",
        "load_arm": "viapoint.envs.arm_import.loader",
        "register_arm": "viapoint.envs.arms",
        "register_scene_family": "viapoint.envs.scenes.families",
        "rows_of_lights": "viapoint.envs.scenes.scene",
    }

    def __getattr__(name):
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(_MODULES[name]), name)

    def __dir__():
        return sorted({*globals(), *_MODULES})


register_all()

__all__ = [
    "ENV_IDS",
    "TARGETS",
    "TASKS",
    "Arm",
    "Plan",
    "ReachEnv",
    "ReachVectorEnv",
    "RecordMovements",
    "ReplanningEnv",
    "ReplanningVectorEnv",
    "VelocityEnv",
    "VelocityVectorEnv",
    "family_sampler",
    "load_arm",
    "register_arm",
    "register_scene_family",
    "rows_of_lights",
]
