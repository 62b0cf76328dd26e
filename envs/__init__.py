"""Gymnasium environments whose actions are via-points and durations; importing this package registers them.

:data:`ENV_IDS` lists the ids. Other names are imported when they are first used: the import of all would take twice as
long.
"""

from typing import TYPE_CHECKING

from viapoint.envs.common import mujoco_check as mujoco_check
from viapoint.envs.registration import ENV_IDS, TASKS, register_all
from viapoint.primitives._lazy import lazy_imports

if TYPE_CHECKING:
    from viapoint.envs.actions.via_points import Plan
    from viapoint.envs.arm_import.loader import load_arm
    from viapoint.envs.arms import register_arm
    from viapoint.envs.arms.base import Arm
    from viapoint.envs.geometry.box import Box
    from viapoint.envs.geometry.convex_mesh import ConvexMesh
    from viapoint.envs.geometry.cylinder import Cylinder
    from viapoint.envs.geometry.half_space import HalfSpace
    from viapoint.envs.geometry.point_cloud import PointCloud
    from viapoint.envs.geometry.round_shapes import Capsule, Sphere
    from viapoint.envs.geometry.rows import observation_rows, obstacle_rows, obstacles_from_rows
    from viapoint.envs.geometry.shape import Shape
    from viapoint.envs.geometry.shapes import (
        SHAPES,
        add_to_model,
        as_obstacle,
        as_obstacles,
        nearest_distance,
        obstacles_from_json,
        obstacles_to_json,
        register_mesh,
        signed_distances,
    )
    from viapoint.envs.mdp.task import family_sampler
    from viapoint.envs.record_video import RecordMovements
    from viapoint.envs.replanning_env import ReplanningEnv, ReplanningVectorEnv
    from viapoint.envs.scenes.families import register_scene_family
    from viapoint.envs.scenes.options import scene_from_json, scene_to_json
    from viapoint.envs.scenes.scene import TARGETS, rows_of_lights
    from viapoint.envs.vector_env import ReachEnv, ReachVectorEnv
    from viapoint.envs.velocity_env import VelocityEnv, VelocityVectorEnv
else:
    __getattr__, __dir__ = lazy_imports(__name__)

register_all()

__all__ = [
    "ENV_IDS",
    "SHAPES",
    "TARGETS",
    "TASKS",
    "Arm",
    "Box",
    "Capsule",
    "ConvexMesh",
    "Cylinder",
    "HalfSpace",
    "Plan",
    "PointCloud",
    "ReachEnv",
    "ReachVectorEnv",
    "RecordMovements",
    "ReplanningEnv",
    "ReplanningVectorEnv",
    "Shape",
    "Sphere",
    "VelocityEnv",
    "VelocityVectorEnv",
    "add_to_model",
    "as_obstacle",
    "as_obstacles",
    "family_sampler",
    "load_arm",
    "nearest_distance",
    "observation_rows",
    "obstacle_rows",
    "obstacles_from_json",
    "obstacles_from_rows",
    "obstacles_to_json",
    "register_arm",
    "register_mesh",
    "register_scene_family",
    "rows_of_lights",
    "scene_from_json",
    "scene_to_json",
    "signed_distances",
]
