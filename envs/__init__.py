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
        signed_distances,
    )
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
        "Box": "viapoint.envs.geometry.box",
        "Capsule": "viapoint.envs.geometry.round_shapes",
        "ConvexMesh": "viapoint.envs.geometry.convex_mesh",
        "Cylinder": "viapoint.envs.geometry.cylinder",
        "HalfSpace": "viapoint.envs.geometry.half_space",
        "Plan": "viapoint.envs.actions.via_points",
        "PointCloud": "viapoint.envs.geometry.point_cloud",
        "ReachEnv": "viapoint.envs.single_env",
        "ReachVectorEnv": "viapoint.envs.vector_env",
        "RecordMovements": "viapoint.envs.record_video",
        "ReplanningEnv": "viapoint.envs.replanning_env",
        "ReplanningVectorEnv": "viapoint.envs.replanning_env",
        "SHAPES": "viapoint.envs.geometry.shapes",
        "Shape": "viapoint.envs.geometry.shape",
        "Sphere": "viapoint.envs.geometry.round_shapes",
        "TARGETS": "viapoint.envs.scenes.scene",
        "VelocityEnv": "viapoint.envs.velocity_env",
        "VelocityVectorEnv": "viapoint.envs.velocity_env",
        "add_to_model": "viapoint.envs.geometry.shapes",
        "as_obstacle": "viapoint.envs.geometry.shapes",
        "as_obstacles": "viapoint.envs.geometry.shapes",
        "family_sampler": "viapoint.envs.mdp.task",
        "load_arm": "viapoint.envs.arm_import.loader",
        "nearest_distance": "viapoint.envs.geometry.shapes",
        "observation_rows": "viapoint.envs.geometry.rows",
        "obstacle_rows": "viapoint.envs.geometry.rows",
        "obstacles_from_json": "viapoint.envs.geometry.shapes",
        "obstacles_from_rows": "viapoint.envs.geometry.rows",
        "obstacles_to_json": "viapoint.envs.geometry.shapes",
        "register_arm": "viapoint.envs.arms",
        "register_scene_family": "viapoint.envs.scenes.families",
        "rows_of_lights": "viapoint.envs.scenes.scene",
        "signed_distances": "viapoint.envs.geometry.shapes",
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
    "register_scene_family",
    "rows_of_lights",
    "signed_distances",
]
