"""Sampling-based motion planner of the library OMPL, the usual method of robotics, as a baseline.

RRT-Connect (Kuffner & LaValle 2000) finds a clear path of straight pieces in joint space, and OMPL's shortcuts simplify
it. The minimum-jerk movement through as few points of the path as stay clear makes it smooth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint import primitives
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.geometry.clearance import configuration_clearances
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import SceneSimulation, SimulationResults

MARGINS = (0.010, 0.004, 0.001, 0.001)
"""Required clearances of a path in each attempt, until one can be made smooth, [m]."""
PATIENCE = 1.0
"""Time limit for each path, [s]."""
CHECK_SPACING = 0.05
"""Spacing of collision checks along a line, [rad]."""
VIA_COUNTS = (1, 2, 3, 4, 6, 8, 12)
"""Numbers of via-points, tried in this order."""
CHECK_INSTANTS = 150
"""Number of instants at which a smooth movement is checked."""


def import_ompl() -> Any:
    """Import the library `ompl`.

    Raises:
        ValueError: The library is not installed.
    """
    try:
        import ompl.base
        import ompl.geometric
        import ompl.util
    except ImportError:
        raise ValueError(
            "the method ompl needs the library of that name: pip install 'viapoint[planning]'"
        ) from None
    ompl.util.setLogLevel(ompl.util.LogLevel.LOG_ERROR)
    return ompl


class MotionPlanner:
    """Motion planner as a method of the tables; its movements have as many via-points as they need.

    A decision is a row: number of via-points, total duration [s], via-points, then zeros. The library has one random
    generator for all its planners.
    """

    name = "motion planner (OMPL)"

    def __init__(self, simulation: SceneSimulation) -> None:
        self._simulation, self._task, self._ompl = simulation, simulation.task, import_ompl()
        self._ompl.util.RNG.setSeed(1)

    def plan(self, scene: Scenes) -> Plan:
        """Return the first smooth plan of one scene that is clear, or else the one with the most clearance; one row."""
        best, merit = self._smooth(np.concatenate((scene.start, scene.goal))), -np.inf
        for margin in MARGINS:
            path = self._path(scene, margin)
            if path is None:
                continue
            for count in VIA_COUNTS:
                plan = self._smooth(points_on(path, count))
                clearance = self._clearance(plan, scene)
                if clearance > merit:
                    best, merit = plan, clearance
                if clearance >= 0.5 * margin:
                    return plan
        return best

    def _smooth(self, configurations: Float) -> Plan:
        """Return the minimum-jerk movement through configurations, shape (P, J), in the duration of the zero action."""
        points = self._task.space.coordinates(configurations)[None]
        duration = self._task.action.zero_duration(points[:, 0], points[:, -1])
        return Plan.at_rest(points, np.asarray(primitives.passage_durations(points, duration)))

    def _clearance(self, plan: Plan, scene: Scenes) -> float:
        """Return the least clearance of a plan, or -1 where it leaves reach or joint ranges, [m]."""
        places = plan.trajectory()(plan.duration[:, None] * np.linspace(0.0, 1.0, CHECK_INSTANTS))[0]
        if not self._task.space.inside(places).all():
            return -1.0
        return self._least(self._task.space.joints(places), scene)

    def _least(self, configurations: Float, scene: Scenes) -> float:
        """Return the least clearance of some configurations, shape (T, J), in one scene, [m]."""
        arm, number = self._task.arm, len(configurations)
        obstacles = scene.obstacles.take(np.zeros(number, np.int64))
        joints = np.ascontiguousarray(configurations)
        found = configuration_clearances(arm.chain, arm.spheres, joints, obstacles, np.zeros(number))
        return float(found.min())

    def _path(self, scene: Scenes, margin: float) -> Float | None:
        """Return corners of a clear path with start and goal, shape (P, J), [rad]; None if none is found in time."""
        ends = np.concatenate((scene.start, scene.goal))

        def is_clear(first: Float, second: Float) -> bool:
            count = max(2, int(np.ceil(np.abs(second - first).max() / CHECK_SPACING)) + 1)
            line = first + np.linspace(0.0, 1.0, count)[:, None] * (second - first)
            return self._least(line, scene) > margin

        corners = _search(self._ompl, ends, self._task.arm.joint_range, is_clear)
        return corners if corners is None else np.concatenate((ends[:1], corners[1:-1], ends[1:]))

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return plans as rows, see :class:`~viapoint.training.planning.baselines.Method`."""
        dimension = self._task.space.dimension
        rows = np.zeros((len(scenes.start), 2 + VIA_COUNTS[-1] * dimension))
        for i, row in enumerate(rows):
            plan = self.plan(scenes.take([i]))
            vias = plan.waypoints[0, 1:-1]
            row[0] = len(vias)
            row[1] = plan.durations.sum()
            row[2 : 2 + vias.size] = vias.ravel()
        return rows

    def execute(self, scenes: Scenes, decisions: Float) -> SimulationResults:
        """Simulate the plans; those with equally many via-points run together."""
        space = self._task.space
        counts = decisions[:, 0].astype(np.int64)
        reward, info = np.zeros(len(decisions)), dict[str, NDArray[Any]]()
        for count in np.unique(counts):
            rows = np.flatnonzero(counts == count)
            some = scenes.take(rows)
            vias = decisions[rows, 2 : 2 + count * space.dimension].reshape(len(rows), count, space.dimension)
            ends = space.coordinates(some.start)[:, None], space.coordinates(some.goal)[:, None]
            waypoints = np.concatenate((ends[0], vias, ends[1]), axis=1)
            durations = np.asarray(primitives.passage_durations(waypoints, decisions[rows, 1]))
            result = self._simulation.execute_plan(some, Plan.at_rest(waypoints, durations))
            reward[rows] = result.reward
            for name, values in result.info.items():
                info.setdefault(name, np.zeros(len(decisions), dtype=values.dtype))[rows] = values
        return SimulationResults(reward, info)


def points_on(path: Float, count: int) -> Float:
    """Return start, `count` points and goal of a path of straight pieces.

    The points are the corners if there are as many, otherwise they are evenly spaced along the path. If there are more
    points than corners, each corner replaces the nearest point.
    """
    if count == len(path) - 2:
        return path
    along = np.concatenate(([0.0], np.cumsum(norm(np.diff(path, axis=0)))))
    places = along[-1] * np.arange(1, count + 1) / (count + 1)
    if count > len(path) - 2:
        for corner in along[1:-1]:
            places[np.abs(places - corner).argmin()] = corner
    places = np.concatenate(([0.0], np.sort(places), along[-1:]))
    return np.stack([np.interp(places, along, path[:, i]) for i in range(path.shape[1])], axis=-1)


def _search(ompl: Any, ends: Float, joint_range: Float, is_clear: Any) -> Float | None:
    """Run RRT-Connect and shortcuts within the joint ranges; return corners, shape (P, J), or None."""
    base, geometric, number = ompl.base, ompl.geometric, ends.shape[-1]

    def place(state: Any) -> Float:
        return np.array([state[i] for i in range(number)])

    class Lines(base.MotionValidator):  # type: ignore[misc, name-defined]
        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
            return bool(is_clear(place(first), place(second)))

    space, bounds = base.RealVectorStateSpace(number), base.RealVectorBounds(number)
    for i in range(number):
        bounds.setLow(i, float(joint_range[i, 0]))
        bounds.setHigh(i, float(joint_range[i, 1]))
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
    if not planner.solve(PATIENCE) or not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    geometric.PathSimplifier(information).simplify(path, PATIENCE)
    return np.stack([place(path.getState(i)) for i in range(path.getStateCount())])
