"""Motion planner of the library OMPL, the usual method of robotics, as a baseline.

The minimum-jerk movement through as few points of a path of RRT-Connect as stay clear makes it smooth.
"""

from __future__ import annotations

import numpy as np

from viapoint import primitives
from viapoint.envs.arms.arm import Arm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.envs.plans import Plan, SpaceName
from viapoint.envs.spaces import space_of
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.ompl_paths import VIA_COUNTS, path_around, points_on
from viapoint.training.planning.plan_motion import checked_motion

# Required clearances of a path in each attempt, until one can be made smooth, [m]
MARGINS = (0.010, 0.004, 0.001, 0.001)
PATIENCE = 1.0  # Time limit for each path, [s]


def ompl_motion(
    arm: Arm, start: Float, goal: Float, obstacles: Obstacles, *, space: SpaceName = "joints"
) -> MotionPlan:
    """Return the smooth movement along a path of RRT-Connect, or the one with the most clearance if none is free.

    The library has one random generator for all its planners, so that results depend on those before.

    Args:
        arm: Arm.
        start: Start in coordinates of the space, shape (D,).
        goal: Goal, shape (D,).
        obstacles: Obstacles of one scene, at rest.
        space: Space in which the movement is smooth; the path is one of joints.
    """
    where = space_of(arm, space)
    ends = np.ascontiguousarray(where.joints(np.stack((start, goal))))
    best = _smooth(arm, space, ends, obstacles)
    for margin in MARGINS:
        path = path_around(arm, ends, obstacles, margin, PATIENCE)
        if path is None:
            continue
        for count in VIA_COUNTS:
            plan = _smooth(arm, space, points_on(path, count), obstacles)
            if plan.clearance > best.clearance:
                best = plan
            if plan.success and plan.clearance >= 0.5 * margin:
                return plan
    return best


def _smooth(arm: Arm, space: SpaceName, configurations: Float, obstacles: Obstacles) -> MotionPlan:
    """Return the minimum-jerk movement through configurations, shape (P, J)."""
    points = space_of(arm, space).coordinates(configurations)
    durations = np.asarray(primitives.passage_durations(points, 1.0))
    return checked_motion(arm, space, Plan(points, durations), obstacles, "ompl", shortest=True)
