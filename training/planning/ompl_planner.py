"""Sampling-based motion planner of the library OMPL, the usual method of robotics, as a baseline.

RRT-Connect (Kuffner & LaValle 2000) finds a clear path of straight pieces, and OMPL's shortcuts simplify it. The
minimum-jerk movement through as few points of the path as stay clear makes it smooth. The planner has the exact scene.

It plans positions of the hand. Every arm here has one posture for each position of its hand, so these positions are a
chart of the configuration space, and planning in joint space would find nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint import primitives
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.arrays import in_space, norm
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.geometry.distance import pair_clearance
from viapoint.envs.geometry.rows import has_shapes
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import SceneSimulation, SimulationResults

Clear = Callable[[Float, Float], bool]
"""Predicate for a straight line between two hand positions that is clear."""

MARGINS = (0.010, 0.004, 0.001, 0.001)
"""Required clearances of a path in each attempt, until one can be made smooth, [m]."""
PATIENCE = 1.0
"""Time limit for each path, [s]."""
BOX_MARGIN = 0.30
"""Margin of the planning box around start and goal, [m]."""
CHECK_SPACING = 0.005
"""Spacing of collision checks of the whole arm along a line, [m]."""
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

    A decision is a row: number of via-points, total duration [s], via-points [m], then zeros. The library has one
    random generator for all its planners.
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

    def _path(self, scene: Scenes, margin: float) -> Float | None:
        """Return the corners of a clear path with start and goal, shape (P, D), [m]; None if none is found in time."""
        ends = np.concatenate((scene.start, scene.goal))
        corners = _search(self._ompl, ends, self._clear(scene, margin), PATIENCE)
        return corners if corners is None else np.concatenate((ends[:1], corners[1:-1], ends[1:]))

    def _smooth(self, waypoints: Float) -> Plan:
        """Return the minimum-jerk movement through waypoints in the centre duration."""
        points = waypoints[None]
        duration = np.array([self._task.action.centre_duration])
        return Plan(points, np.asarray(primitives.passage_durations(points, duration)))

    def _clearance(self, plan: Plan, scene: Scenes) -> float:
        """Return the least clearance of a plan, less the distance by which it leaves the reach, [m]."""
        time = np.linspace(0.0, self._task.action.centre_duration, CHECK_INSTANTS)
        hand = np.asarray(plan.trajectory()(time))
        margin = float(np.asarray(self._task.arm.reach_margin(hand)).min())
        clearance = self._task.collision_model.least_clearance(hand, scene.obstacles, scene.present)
        return min(margin, 0.0) + float(clearance[0])

    def _clear(self, scene: Scenes, margin: float) -> Clear:
        model = self._task.collision_model
        arm, whole_arm = model.arm, model.whole_arm
        rows = scene.obstacles[0][scene.present[0]]
        radii = np.full(len(rows), arm.hand_radius)

        def clear(first: Float, second: Float) -> bool:
            line = np.stack((first, second))
            line = in_space(line) if has_shapes(rows) else line
            p, q = (np.tile(end, (len(rows), 1, 1)) for end in line)
            if (pair_clearance(p, q, rows, radii) < margin).any():
                return False
            count = max(2, int(np.ceil(norm(second - first) / CHECK_SPACING)) + 1) if whole_arm else 4
            points = first + np.linspace(0.0, 1.0, count)[:, None] * (second - first)
            if (np.asarray(arm.reach_margin(points)) < 0.0).any():
                return False
            if not whole_arm:
                return True
            return bool(model.least_clearance(points[None], scene.obstacles, scene.present)[0] > margin)

        return clear

    def decide(self, observation: Observation, scenes: Scenes) -> Float:
        """Return plans as rows, see :class:`~viapoint.training.planning.baselines.Method`."""
        d = scenes.start.shape[-1]
        rows = np.zeros((len(scenes.start), 2 + VIA_COUNTS[-1] * d))
        for i, row in enumerate(rows):
            plan = self.plan(scenes.take([i]))
            vias = plan.waypoints[0, 1:-1]
            row[0], row[1] = len(vias), plan.durations.sum()
            row[2 : 2 + vias.size] = vias.ravel()
        return rows

    def execute(self, scenes: Scenes, decisions: Float) -> SimulationResults:
        """Simulate the plans; those with equally many via-points run together."""
        d, counts = scenes.start.shape[-1], decisions[:, 0].astype(np.int64)
        reward, info = np.zeros(len(decisions)), dict[str, NDArray[Any]]()
        for count in np.unique(counts):
            rows = np.flatnonzero(counts == count)
            some = scenes.take(rows)
            vias = decisions[rows, 2 : 2 + count * d].reshape(len(rows), count, d)
            waypoints = np.concatenate((some.start[:, None], vias, some.goal[:, None]), axis=1)
            durations = np.asarray(primitives.passage_durations(waypoints, decisions[rows, 1]))
            result = self._simulation.execute_plan(some, Plan(waypoints, durations))
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


def _search(ompl: Any, ends: Float, clear: Clear, seconds: float) -> Float | None:
    """Run RRT-Connect and shortcuts in the box around start and goal; return corners, shape (P, D), or None."""
    base, geometric, d = ompl.base, ompl.geometric, ends.shape[-1]

    def place(state: Any) -> Float:
        return np.array([state[i] for i in range(d)])

    class Lines(base.MotionValidator):  # type: ignore[misc, name-defined]
        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
            return clear(place(first), place(second))

    space, bounds = base.RealVectorStateSpace(d), base.RealVectorBounds(d)
    for i in range(d):
        bounds.setLow(i, float(ends[:, i].min()) - BOX_MARGIN)
        bounds.setHigh(i, float(ends[:, i].max()) + BOX_MARGIN)
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: True)  # the motion validator checks whole lines
    information.setMotionValidator(Lines(information))
    information.setup()
    problem = base.ProblemDefinition(information)
    start, goal = space.allocState(), space.allocState()
    for i in range(d):
        start[i], goal[i] = float(ends[0, i]), float(ends[1, i])
    problem.setStartAndGoalStates(start, goal)
    planner = geometric.RRTConnect(information)
    planner.setProblemDefinition(problem)
    planner.setup()
    if not planner.solve(seconds) or not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    geometric.PathSimplifier(information).simplify(path, seconds)
    return np.stack([place(path.getState(i)) for i in range(path.getStateCount())])
