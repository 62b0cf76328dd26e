"""Paths of OMPL, the library of sampling-based motion planners.

RRT-Connect (Kuffner & LaValle 2000) finds a clear path of straight pieces in joint space, and OMPL's shortcuts simplify
it.
"""

from __future__ import annotations

import functools
import threading
import time
from typing import Any

import numpy as np

from viapoint.envs.common.arrays import Float
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.training.planning.movements import Setting
from viapoint.training.planning.rrt_connect import check_of, keeps_margin

CHECK_SPACING = 0.05  # Spacing of collision checks along a line, [rad]
FIRST = threading.Lock()  # of the import, which several threads may ask for


def import_ompl() -> Any:
    """Import the library `ompl`; ValueError if it is not installed."""
    with FIRST:
        return _ompl()


@functools.cache
def _ompl() -> Any:
    """Return the library with its random generator set, which it allows only once."""
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


def path_around(
    setting: Setting, ends: Float, obstacles: Obstacles, margin: float, patience: float
) -> Float | None:
    """Return corners of a clear path with start and goal, shape (P, J), [rad]; None if none is found in time.

    `ends` are the joint positions of start and goal, shape (2, J). The path keeps a margin, [m], to obstacles at rest,
    and is found within `patience`, [s].
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
    if not planner.solve(patience) or not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    geometric.PathSimplifier(information).simplify(path, max(patience - time.perf_counter() + begin, 1e-3))
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
