"""Movements along paths of OMPL, the library of sampling-based motion planners: a baseline.

RRT-Connect (Kuffner & LaValle 2000) finds a clear path of straight pieces in joint space, and OMPL's shortcuts simplify
it.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np

from viapoint import primitives
from viapoint.envs.arms.arm import Arm
from viapoint.envs.common.arrays import Float
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.envs.plans import Plan, SpaceName
from viapoint.envs.spaces import space_of
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.movements import Setting, arm_setting
from viapoint.training.planning.plan_motion import checked_motion, clearance_of
from viapoint.training.planning.rrt_connect import VIA_COUNTS, check_of, keeps_margin, points_on

# Required clearances of a path in each attempt, until one can be made smooth, [m]
MARGINS = (0.010, 0.004, 0.001, 0.001)
ROOM = 0.7  # Greatest of these clearances, as a share of that of the ends
PATIENCE = 1.0  # Time limit for each path, [s]
CHECK_SPACING = 0.05  # Spacing of collision checks along a line, [rad]


@functools.cache
def import_ompl() -> Any:
    """Import the library `ompl`, and set its random generator, which it allows only once; ValueError without it."""
    try:
        import ompl.base
        import ompl.geometric
        import ompl.util
    except ImportError:
        raise ValueError(
            "the method ompl needs the library of that name, which has packages for Python 3.11 to 3.13: "
            "pip install '.[planning]' in a clone of the project"
        ) from None
    ompl.util.setLogLevel(ompl.util.LogLevel.LOG_ERROR)
    ompl.util.RNG.setSeed(1)
    return ompl


def ompl_motion(
    arm: Arm, start: Float, goal: Float, obstacles: Obstacles, *, space: SpaceName = "joints"
) -> MotionPlan:
    """Return the smooth movement along a path of RRT-Connect, or the one with the most clearance if none is free.

    It is the minimum-jerk movement through as few points of the path as stay clear. OMPL has one random generator for
    all its planners, so that results depend on those before. Start and goal are coordinates of the space in which the
    movement is smooth; the path is one of joints. Obstacles are at rest.
    """
    where = space_of(arm, space)

    def smooth(configurations: Float) -> MotionPlan:
        points = where.coordinates(configurations)
        plan = Plan(points, np.asarray(primitives.passage_durations(points, 1.0)))
        return checked_motion(arm, space, plan, obstacles, "ompl", shortest=True)

    ends = np.ascontiguousarray(where.joints(np.stack((start, goal))))
    best = smooth(ends)
    setting = arm_setting(arm, where.of_hand, obstacles)
    nearest = clearance_of(setting, ends, obstacles, MARGINS[0])
    for most in MARGINS:
        margin = min(most, ROOM * nearest)
        path = _path(setting, ends, obstacles, margin)
        if path is None:
            continue
        for count in VIA_COUNTS:
            plan = smooth(points_on(path, count))
            if plan.clearance > best.clearance:
                best = plan
            if plan.success and plan.clearance >= 0.5 * margin:
                return plan
    return best


def _path(setting: Setting, ends: Float, obstacles: Obstacles, margin: float) -> Float | None:
    """Return corners of a clear path with start and goal, shape (P, J), [rad]; None if none is found in time.

    `ends` are the joint positions of start and goal, shape (2, J). The path keeps a margin, [m], to obstacles at rest,
    and is found within PATIENCE.
    """
    ompl, number = import_ompl(), ends.shape[-1]
    base, geometric = ompl.base, ompl.geometric

    def joints(state: Any) -> Float:
        return np.array([state[i] for i in range(number)])

    class Lines(base.MotionValidator):  # type: ignore[misc, name-defined]
        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
            one, other = joints(first), joints(second)
            count = max(2, int(np.ceil(np.abs(other - one).max() / CHECK_SPACING)) + 1)
            line = np.ascontiguousarray(np.linspace(one, other, count))
            return bool(_line_is_clear(setting, line, obstacles, margin))

    space = base.RealVectorStateSpace(number)
    bounds = base.RealVectorBounds(number)
    for i, (low, high) in enumerate(setting.joint_range):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: True)  # the motion validator checks whole lines
    information.setMotionValidator(Lines(information))
    information.setup()
    problem = base.ProblemDefinition(information)
    start, goal = space.allocState(), space.allocState()
    for i in range(number):
        start[i], goal[i] = float(ends[0, i]), float(ends[1, i])
    problem.setStartAndGoalStates(start, goal)
    planner = geometric.RRTConnect(information)
    planner.setProblemDefinition(problem)
    planner.setup()
    begin = time.perf_counter()
    if not planner.solve(PATIENCE) or not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    geometric.PathSimplifier(information).simplify(path, max(PATIENCE - time.perf_counter() + begin, 1e-3))
    corners = [joints(path.getState(i)) for i in range(1, path.getStateCount() - 1)]
    return np.stack((ends[0], *corners, ends[1]))


@compiled
def _line_is_clear(setting: Setting, line: Float, obstacles: Obstacles, margin: float) -> bool:
    """Return True if all configurations of shape (T, J) keep a margin in scene 0."""
    check = check_of(setting, obstacles, margin)
    clear = 0
    while clear < len(line) and keeps_margin(check, line[clear]):
        clear += 1
    return clear == len(line)
