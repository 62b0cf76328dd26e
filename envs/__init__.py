"""Gymnasium environments whose actions are via-points and durations; importing this package registers them.

:data:`ENV_IDS` lists the ids. Other names are imported when they are first used: the import of all would take twice as
long.
"""

from typing import TYPE_CHECKING

from viapoint.envs.common import mujoco_check as mujoco_check
from viapoint.envs.registration import ENV_IDS, TASKS, register_all
from viapoint.primitives._lazy import lazy_imports

if TYPE_CHECKING:
    from viapoint.envs.arms.arm import Arm
    from viapoint.envs.arms.inverse_kinematics import inverse_kinematics
    from viapoint.envs.arms.load import load_arm
    from viapoint.envs.arms.registry import arm_of, register_arm
    from viapoint.envs.arms.stored import write_arm
    from viapoint.envs.env import ReachEnv
    from viapoint.envs.geometry.clearance import signed_distances
    from viapoint.envs.geometry.obstacles import Obstacles, observation_rows, obstacles_from_rows
    from viapoint.envs.geometry.shapes import (
        SHAPES,
        Box,
        Capsule,
        ConvexMesh,
        Cylinder,
        HalfSpace,
        PointCloud,
        Shape,
        Sphere,
        as_obstacle,
        as_obstacles,
        obstacles_from_json,
        obstacles_to_json,
        register_mesh,
    )
    from viapoint.envs.plans import Plan
    from viapoint.envs.rewards import RewardWeights
    from viapoint.envs.scenes.families_registry import register_scene_family
    from viapoint.envs.scenes.layout import Furniture, Place, Room
    from viapoint.envs.scenes.options import Pose, scene_from_json, scene_to_json
    from viapoint.envs.scenes.scene import Scenes
    from viapoint.envs.sensors import Sensor
    from viapoint.envs.task import Task
    from viapoint.envs.vector_env import ReachVectorEnv
else:
    __getattr__, __dir__ = lazy_imports(__name__)

register_all()

__all__ = [
    "ENV_IDS",
    "SHAPES",
    "TASKS",
    "Arm",
    "Box",
    "Capsule",
    "ConvexMesh",
    "Cylinder",
    "Furniture",
    "HalfSpace",
    "Obstacles",
    "Place",
    "Plan",
    "PointCloud",
    "Pose",
    "ReachEnv",
    "ReachVectorEnv",
    "RewardWeights",
    "Room",
    "Scenes",
    "Sensor",
    "Shape",
    "Sphere",
    "Task",
    "arm_of",
    "as_obstacle",
    "as_obstacles",
    "inverse_kinematics",
    "load_arm",
    "observation_rows",
    "obstacles_from_json",
    "obstacles_from_rows",
    "obstacles_to_json",
    "register_arm",
    "register_mesh",
    "register_scene_family",
    "scene_from_json",
    "scene_to_json",
    "signed_distances",
    "write_arm",
]
