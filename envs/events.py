"""Events that end a decision.

Plans and courses are known to the environment, so all events but a contact are known in advance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from viapoint.envs.arms.kinematics import Chain, Spheres
from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.geometry.clearance import memory, obstacle_clearance, place
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import MAX_START_OFFSET, Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sensors import Looks
from viapoint.envs.task import Task

FORESIGHT = 0.4  # Horizon of the predicted clearance, [s]
LOOK = 0.032  # Time from one prediction to the next, [s]
GLANCE = 0.064  # Time from one glance of the sensor to the next, [s]
# Something new is seen where this number of points is farther than this from all that are remembered, [m]
NEW_POINTS, NEW_DISTANCE = 4, 0.04
Goals = Callable[[Float], Float]  # Function of times, shape (N,), that returns the goals, shape (N, D)
NEVER = np.iinfo(np.int64).max // 4  # Physics step of an event that does not happen


class Event(IntEnum):
    """Event that ended a decision, the `event` of `info`; of simultaneous events, the one of highest rank."""

    HORIZON = 0  # The horizon has passed
    TARGET = 1  # The target has jumped
    COURSE = 2  # An obstacle has changed its course
    CLEARANCE = 3  # The predicted clearance has fallen below the margin
    SIGHT = 4  # The sensor sees something new
    ARRIVAL = 5  # The arm has arrived and settled
    CONTACT = 6  # The arm was in contact
    TIME_LIMIT = 7  # The time is up
    REACH = 8  # The plan leaves the arm's reach; the arm does not start on it
    UNSTABLE = 9  # The physics broke down


class EventPredictor:
    """Predictor of the ends of decisions of a task."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.timestep = task.arm.timestep
        self.triggers = frozenset(() if isinstance(task.decide_at, str) else task.decide_at)
        self.limit = int(self.steps(task.time_limit))  # Greatest number of physics steps of an episode

    def steps(self, time: Any) -> Any:
        """Return the first physics step at or after a time [s], NEVER for a time that is very late."""
        time = np.asarray(time)
        number = np.ceil((np.minimum(time, 1e8) - 1e-9) / self.timestep).astype(np.int64)
        return np.where(time < 1e8, number, NEVER)

    def __call__(
        self, plan: Plan, began: Int, now: Int, scenes: Scenes, goal: Goals, looks: Looks | None
    ) -> tuple[Int, Int, Bool]:
        """Return the ends of decisions that begin at physics step `now` under plans that began at step `began`.

        Steps have the shape (N,); `goal` returns the goals at times, shape (N,), in coordinates of the space, (N, D).

        Returns:
            Without contact: steps before which the decisions end; the :class:`Event` of each; True where the arm has
            arrived and no change is left.
        """
        jump = self.steps(scenes.jump_times)
        turn = self.steps(scenes.turn_time)
        moving_until = began + self.steps(plan.duration)
        arrival = np.maximum(began + self.steps(plan.duration + SETTLING), now + 1)
        away = np.abs(plan.waypoints[:, -1] - goal(arrival * self.timestep)).max(axis=-1)
        there = away < MAX_START_OFFSET  # a plan of a user may have rounded its end
        after_jump = next_step(jump, arrival)
        after_turn = next_step(turn, arrival)
        # At rest at the goal, the arm waits for what is still to come before the time is up.
        waits = there & (np.minimum(after_jump, after_turn) < self.limit) & (len(self.triggers) > 0)
        horizon = now + self.steps(min(self.task.horizon, self.task.time_limit))
        interim = ("horizon" in self.triggers) & (horizon < moving_until)
        horizon = np.where(interim, horizon, NEVER)
        arrival = np.where(waits, NEVER, arrival)
        # In the order of their rank: of simultaneous events, the first one counts.
        ends = {Event.TIME_LIMIT: np.maximum(self.limit, now + 1)}
        for event, trigger, steps, later in (
            (Event.TARGET, "target", jump, after_jump),
            (Event.COURSE, "course", turn, after_turn),
        ):
            ends[event] = next_step(steps, now) if trigger in self.triggers else np.where(waits, later, NEVER)
        latest = np.minimum.reduce([*ends.values(), arrival, horizon])
        ends[Event.CLEARANCE] = self._clearance(plan, began, now, scenes, latest)
        ends[Event.SIGHT] = self._sight(plan, began, now, scenes, latest, looks)
        ends[Event.ARRIVAL] = arrival
        ends[Event.HORIZON] = horizon
        steps = np.stack(list(ends.values()))
        event = np.array(list(ends))[steps.argmin(axis=0)]
        return steps.min(axis=0), event, there & (event == Event.ARRIVAL)

    def _clearance(self, plan: Plan, began: Int, now: Int, scenes: Scenes, latest: Int) -> Int:
        """Return the step at which the predicted clearance falls below the margin, NEVER if not before `latest`.

        The prediction assumes that obstacles keep their present velocity, so it is made anew after a change of course.
        """
        found = np.full(len(now), NEVER)
        if "clearance" not in self.triggers or not scenes.obstacles.present.any():
            return found
        every = max(round(LOOK / self.timestep), 1)
        ahead = round(FORESIGHT / LOOK)
        turns = self.steps(scenes.course_times())
        pieces = []  # Pieces of the episodes in which the obstacles keep their velocity
        for row in range(len(now)):
            inside = (turns[row] > now[row]) & (turns[row] < latest[row])
            cuts = [now[row], *np.unique(turns[row][inside]), latest[row]]
            pieces += [(row, begin, end) for begin, end in itertools.pairwise(cuts)]
        rows, begin, end = np.array(pieces, np.int64).T.copy()
        looks = (end - begin) // every + 1
        steps = begin[:, None] + every * np.arange(int(looks.max()) + ahead)
        movement = plan.take(rows).trajectory()
        path = self.task.space.joints(movement(self.timestep * (steps - began[rows][:, None])))
        obstacles = scenes.take(rows).obstacles_at(begin * self.timestep, in_chords=True)
        interval = every * self.timestep
        chain, spheres, margin = self.task.arm.chain, self.task.arm.spheres, self.task.margin
        _first_falls(
            chain, spheres, path, obstacles, rows, steps, looks, ahead, interval, margin, latest, found
        )
        return found

    def _sight(
        self, plan: Plan, began: Int, now: Int, scenes: Scenes, latest: Int, looks: Looks | None
    ) -> Int:
        """Return the step at which the sensor sees something new, NEVER if not before `latest`.

        The sensor glances along the planned movement. The arm follows it within a millimetre.
        """
        found = np.full(len(now), NEVER)
        task, sensor = self.task, self.task.sensor
        if "sight" not in self.triggers or sensor is None or looks is None:
            return found
        number, nothing = len(now), sensor.range
        known = looks.points.reshape(number, -1, 3)
        known_hit = looks.ranges.reshape(number, -1) < nothing
        every = max(round(GLANCE / self.timestep), 1)
        step = now + every
        rows = np.flatnonzero(step < latest)
        while rows.size:
            since = self.timestep * (step - began)[rows]
            joints = task.space.joints(plan.take(rows).trajectory()(since[:, None]))[:, 0]
            obstacles = scenes.take(rows).obstacles_at(np.asarray(self.timestep * step[rows]))
            glance = sensor.read(task.arm, joints, obstacles)
            hit = glance.ranges < nothing
            new = _count_new(glance.points, hit, known[rows], known_hit[rows]) >= NEW_POINTS
            found[rows[new]] = step[rows[new]]
            step = step + every
            rows = rows[~new & (step < latest)[rows]]
        return found


@compiled
def _count_new(points: Float, hit: Bool, known: Float, known_hit: Bool) -> Int:
    """Return how many points, shape (N, R, 3), are NEW_DISTANCE or more from all known ones, (N, M, 3).

    It is at most NEW_POINTS in each scene. Points count where `hit`, shape (N, R) and (N, M).
    """
    found = np.zeros(len(points), np.int64)
    for scene in range(len(points)):
        for i in range(points.shape[1]):
            if not hit[scene, i] or found[scene] >= NEW_POINTS:
                continue
            x, y, z = points[scene, i]
            new = True
            for k in range(known.shape[1]):
                if known_hit[scene, k]:
                    a, b, c = known[scene, k]
                    if (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < NEW_DISTANCE**2:
                        new = False
                        break
            found[scene] += new
    return found


@compiled
def _first_falls(
    chain: Chain,
    spheres: Spheres,
    path: Float,
    obstacles: Obstacles,
    rows: Int,
    steps: Int,
    looks: Int,
    ahead: int,
    interval: float,
    margin: float,
    latest: Int,
    found: Int,
) -> None:
    """Fill in the first step of each of N episodes at which the clearance ahead falls below a margin, [m].

    M pieces of the episodes `rows`, in order, have configurations, shape (M, T, J), at an interval, [s], from the
    beginning on, where the obstacles are. A prediction at each of a number of `looks` sees `ahead` more of them.
    """
    placed = memory(chain, spheres)
    low = np.zeros(path.shape[1], np.bool_)
    below = True
    for piece in range(len(rows)):
        row = rows[piece]
        if piece == 0 or row != rows[piece - 1]:
            below = True  # a clearance that is below the margin already does not fall
        if found[row] < NEVER:
            continue
        for k in range(looks[piece] + ahead):
            place(chain, spheres, path[piece, k], placed)
            time = k * interval
            clearance = obstacle_clearance(spheres, placed, obstacles, piece, time, margin, margin)
            low[k] = clearance < margin
        for look in range(looks[piece]):
            step = steps[piece, look]
            if step >= latest[row]:
                break
            will_be = bool(low[look : look + ahead + 1].any())
            # The first prediction is that of the present step, which no decision can end at.
            if will_be and not below:
                found[row] = step
                break
            below = will_be


def next_step(steps: Int, now: Int) -> Int:
    """Return the first of some steps, shape (N, n), after the present one, NEVER without one, shape (N,)."""
    return np.asarray(np.where(steps > now[:, None], steps, NEVER).min(axis=1, initial=NEVER))
