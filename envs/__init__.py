"""Gymnasium environments whose actions are via-points and durations; importing this package registers them.

:data:`ENV_IDS` lists the ids. Other names are imported when they are first used: the import of all would take twice as
long.
"""

import os
from typing import TYPE_CHECKING

from viapoint.envs.registration import register_all
from viapoint.primitives._lazy import lazy_imports

try:
    from mujoco import batch as _batch  # noqa: F401 - what is wrong is said before others import it
except AttributeError as error:
    # MuJoCo reads an attribute of None if the OpenGL library of MUJOCO_GL is missing.
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise ImportError(
        f"MUJOCO_GL={os.environ['MUJOCO_GL']} asks MuJoCo for an OpenGL library that is not installed: "
        "unset MUJOCO_GL, or install the library (Debian: apt-get install libegl1 libgl1, or libosmesa6 for osmesa)"
    ) from error
except ImportError as error:
    raise ImportError(
        f"MuJoCo 4 or newer is needed and could not be imported ({error}); where an older version was upgraded in "
        "place, repair it with: pip install --force-reinstall 'mujoco>=4'"
    ) from error

if TYPE_CHECKING:
    from viapoint.envs.arms.arm import Arm as Arm
    from viapoint.envs.arms.inverse_kinematics import inverse_kinematics as inverse_kinematics
    from viapoint.envs.arms.load import load_arm as load_arm
    from viapoint.envs.arms.registry import arm_of as arm_of
    from viapoint.envs.arms.registry import register_arm as register_arm
    from viapoint.envs.arms.stored import write_arm as write_arm
    from viapoint.envs.env import ReachEnv as ReachEnv
    from viapoint.envs.env import RecordMovements as RecordMovements
    from viapoint.envs.geometry.clearance import signed_distances as signed_distances
    from viapoint.envs.geometry.obstacles import Obstacles as Obstacles
    from viapoint.envs.geometry.obstacles import observation_rows as observation_rows
    from viapoint.envs.geometry.obstacles import obstacles_from_rows as obstacles_from_rows
    from viapoint.envs.geometry.shapes import SHAPES as SHAPES
    from viapoint.envs.geometry.shapes import Box as Box
    from viapoint.envs.geometry.shapes import Capsule as Capsule
    from viapoint.envs.geometry.shapes import ConvexMesh as ConvexMesh
    from viapoint.envs.geometry.shapes import Cylinder as Cylinder
    from viapoint.envs.geometry.shapes import HalfSpace as HalfSpace
    from viapoint.envs.geometry.shapes import PointCloud as PointCloud
    from viapoint.envs.geometry.shapes import Shape as Shape
    from viapoint.envs.geometry.shapes import Sphere as Sphere
    from viapoint.envs.geometry.shapes import as_obstacle as as_obstacle
    from viapoint.envs.geometry.shapes import as_obstacles as as_obstacles
    from viapoint.envs.geometry.shapes import obstacles_from_json as obstacles_from_json
    from viapoint.envs.geometry.shapes import obstacles_to_json as obstacles_to_json
    from viapoint.envs.geometry.shapes import register_mesh as register_mesh
    from viapoint.envs.plans import Plan as Plan
    from viapoint.envs.registration import ENV_IDS as ENV_IDS
    from viapoint.envs.registration import TASKS as TASKS
    from viapoint.envs.rewards import RewardWeights as RewardWeights
    from viapoint.envs.scenes.families_registry import register_scene_family as register_scene_family
    from viapoint.envs.scenes.layout import Furniture as Furniture
    from viapoint.envs.scenes.layout import Place as Place
    from viapoint.envs.scenes.layout import Room as Room
    from viapoint.envs.scenes.options import Pose as Pose
    from viapoint.envs.scenes.options import scene_from_json as scene_from_json
    from viapoint.envs.scenes.options import scene_to_json as scene_to_json
    from viapoint.envs.scenes.scene import Scenes as Scenes
    from viapoint.envs.sensors import Sensor as Sensor
    from viapoint.envs.task import Task as Task
    from viapoint.envs.vector_env import ReachVectorEnv as ReachVectorEnv
else:
    __getattr__, __dir__, __all__ = lazy_imports(__name__)

register_all()
