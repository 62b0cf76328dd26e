"""Events that end a decision.

Plans and courses are known to the environment, so all events but a contact are known in advance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.clearance import clearance_profile
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import MAX_START_OFFSET, Motion, Plan
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.spaces import Space

Trigger = Literal["horizon", "target", "course", "clearance"]
TRIGGERS: tuple[Trigger, ...] = get_args(Trigger)
"""Events that may end a decision before the goal."""

FORESIGHT = 0.4
"""Horizon of the predicted clearance, [s]."""
LOOK = 0.032
"""Time from one prediction to the next, [s]."""
NEVER = np.iinfo(np.int64).max // 4
"""Physics step of an event that does not happen."""


class Event(IntEnum):
    """Event that ended a decision, the `event` of `info`; of simultaneous events, the one of highest rank."""

    HORIZON = 0
    """The horizon has passed."""
    TARGET = 1
    """The target has jumped."""
    COURSE = 2
    """An obstacle has changed its course."""
    CLEARANCE = 3
    """The predicted clearance has fallen below the margin."""
    ARRIVAL = 4
    """The arm has arrived and settled."""
    CONTACT = 5
    """The arm was in contact."""
    TIME_LIMIT = 6
    """The time is up."""
    REACH = 7
    """The plan leaves the arm's reach; the arm does not start on it."""
    UNSTABLE = 8
    """The physics broke down."""


_RANK = (Event.TIME_LIMIT, Event.TARGET, Event.COURSE, Event.CLEARANCE, Event.ARRIVAL, Event.HORIZON)
"""Rank of simultaneous events, highest first."""


class Ends(NamedTuple):
    """Ends of N decisions without contact."""

    step: Int
    """Physics step of the episode before which each decision ends, shape (N,)."""
    event: Int
    """:class:`Event`, shape (N,)."""
    final: Bool
    """True if the arm has arrived and no change is left, shape (N,)."""


class EventPredictor:
    """Predictor of the ends of decisions.

    Args:
        arm: Arm.
        space: Space of the plans.
        timestep: Length of a physics step, [s].
        triggers: Events that end a decision before the goal; none for whole movements.
        horizon: Time after which a decision ends, [s].
        margin: Predicted clearance below which a decision ends, [m].
        time_limit: Time limit of an episode, [s].

    Raises:
        ValueError: There is no such trigger.
    """

    def __init__(
        self,
        arm: Arm,
        space: Space,
        *,
        timestep: float,
        triggers: Sequence[Trigger],
        horizon: float,
        margin: float,
        time_limit: float,
    ) -> None:
        known = not isinstance(triggers, str) and isinstance(triggers, Iterable)
        if not known or any(each not in TRIGGERS for each in triggers):
            raise ValueError(f"decide_at must be some of {', '.join(TRIGGERS)}, got {triggers!r}")
        self.arm, self.space, self.timestep, self.margin = arm, space, timestep, margin
        self.triggers = frozenset(triggers)
        self.horizon = int(self.steps(min(horizon, time_limit)))
        self.limit = int(self.steps(time_limit))
        """Greatest number of physics steps of an episode."""

    def steps(self, time: Any) -> Any:
        """Return the first physics step at or after a time [s], NEVER for a time that is very late."""
        time = np.asarray(time)
        number = np.ceil((np.minimum(time, 1e8) - 1e-9) / self.timestep).astype(np.int64)
        return np.where(time < 1e8, number, NEVER)

    def __call__(
        self, plan: Plan, began: Int, now: Int, scenes: Scenes, goal: Callable[[Float], Float]
    ) -> Ends:
        """Return the ends of decisions that begin at physics step `now` under plans that began at step `began`.

        Args:
            plan: Plans of N episodes.
            began: Steps at which they began, shape (N,).
            now: Present steps, shape (N,).
            scenes: Scenes.
            goal: Goals at the time of arrival in coordinates of the space, as a function of times (N,) -> (N, D).
        """
        jump, turn = self.steps(scenes.jump_times), self.steps(scenes.turn_time)
        moving_until = began + self.steps(plan.duration)
        arrival = np.maximum(began + self.steps(plan.duration + SETTLING), now + 1)
        away = np.abs(plan.waypoints[:, -1] - goal(arrival * self.timestep)).max(axis=-1)
        there = away < MAX_START_OFFSET  # a plan of a user may have rounded its end
        after_jump, after_turn = _next(jump, arrival), _next(turn, arrival)
        # At rest at the goal, the arm waits for what is still to come.
        waits = there & (np.minimum(after_jump, after_turn) < NEVER) & (len(self.triggers) > 0)
        ends = {Event.TIME_LIMIT: np.maximum(np.full(len(now), self.limit), now + 1)}
        for event, trigger, steps, later in (
            (Event.TARGET, "target", jump, after_jump),
            (Event.COURSE, "course", turn, after_turn),
        ):
            ends[event] = _next(steps, now) if trigger in self.triggers else np.where(waits, later, NEVER)
        horizon = now + self.horizon
        ends[Event.HORIZON] = np.where(
            ("horizon" in self.triggers) & (horizon < moving_until), horizon, NEVER
        )
        ends[Event.ARRIVAL] = np.where(waits, NEVER, arrival)
        latest = np.minimum.reduce([*ends.values()])
        ends[Event.CLEARANCE] = self._clearance(plan, began, now, scenes, latest)
        steps = np.stack([ends[event] for event in _RANK])
        event = np.array([int(each) for each in _RANK])[steps.argmin(axis=0)]
        return Ends(steps.min(axis=0), event, there & (event == Event.ARRIVAL))

    def _clearance(self, plan: Plan, began: Int, now: Int, scenes: Scenes, latest: Int) -> Int:
        """Return the step at which the predicted clearance falls below the margin, NEVER if not before `latest`.

        The prediction assumes that obstacles keep their present velocity, so it is made anew after a change of course.
        """
        found = np.full(len(now), NEVER)
        if "clearance" not in self.triggers or not scenes.obstacles.present.any():
            return found
        every = max(round(LOOK / self.timestep), 1)
        ahead = round(FORESIGHT / LOOK)
        for row in range(len(now)):
            found[row] = self._falls(plan, began[row], now[row], scenes, row, int(latest[row]), every, ahead)
        return found

    def _falls(
        self, plan: Plan, began: int, now: int, scenes: Scenes, row: int, latest: int, every: int, ahead: int
    ) -> int:
        """Return the step at which the predicted clearance of one episode falls below the margin."""
        turns = np.unique(self.steps(scenes.turn_time[row]))
        pieces = [now, *(int(turn) for turn in turns if now < turn < latest), latest]
        trajectory = plan.take([row]).trajectory()
        below = True  # a clearance that is below the margin already does not fall
        for begin, end in itertools.pairwise(pieces):
            looks = (end - begin) // every + 1
            steps = begin + every * np.arange(looks + ahead)
            position, velocity, acceleration = trajectory.sample(self.timestep * (steps - began)[None])
            path = self.space.joint_motion(Motion(position, velocity, acceleration)).position[0]
            obstacles = scenes.take([row]).obstacles_at(np.array([begin * self.timestep]))
            profile = clearance_profile(
                self.arm.chain, self.arm.spheres, path, obstacles, 0, every * self.timestep, self.margin
            )
            window = np.lib.stride_tricks.sliding_window_view(profile, ahead + 1).min(axis=-1) < self.margin
            for look in range(looks):
                step = begin + every * look
                if step >= latest:
                    break
                if window[look] and not below and step > now:
                    return int(step)
                below = bool(window[look])
        return NEVER


def _next(steps: Int, now: Int) -> Int:
    """Return the first of some steps, shape (N, n), after the present one, NEVER without one, shape (N,)."""
    return np.asarray(np.where(steps > now[:, None], steps, NEVER).min(axis=1, initial=NEVER))
