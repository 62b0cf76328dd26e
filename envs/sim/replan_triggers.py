"""Triggers that end a decision.

Plans and courses are known to the environment, so all events but a contact are known in advance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.replanning import MovingPlan
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Int
from viapoint.envs.common.validation import number_of_at_least
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.sim.outcome import SETTLING

Trigger = Literal["horizon", "target", "course", "clearance"]
TRIGGERS: tuple[Trigger, ...] = get_args(Trigger)
"""Events that may end a decision before the goal."""

FORESIGHT = 0.4
"""Horizon of the predicted clearance, [s]."""
SAMPLED = 0.016
"""Time between the samples of a predicted clearance, [s]."""
LOOK = 2
"""Samples from one prediction to the next."""
NEVER = np.iinfo(np.int64).max


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
    """The hand has arrived and settled."""
    CONTACT = 5
    """The arm touched an obstacle."""
    TIME_LIMIT = 6
    """The time is up."""
    REACH = 7
    """The plan leaves the arm's reach; the arm does not start on it."""
    UNSTABLE = 8
    """The physics broke down."""


class Ends(NamedTuple):
    """Ends of N decisions without contact."""

    step: Int
    """Physics step of the episode before which each decision ends, shape (N,)."""
    event: Int
    """:class:`Event`, shape (N,)."""
    final: NDArray[np.bool_]
    """True if the hand has arrived and no change is left, shape (N,)."""


class ReplanTriggers:
    """Predictor of the ends of decisions; see :class:`~viapoint.envs.replanning_env.ReplanningVectorEnv`.

    Raises:
        ValueError: There is no such trigger, or horizon or margin are too small.
    """

    def __init__(
        self,
        collision_model: CollisionModel,
        *,
        timestep: float,
        triggers: Sequence[Trigger],
        horizon: float,
        margin: float,
        time_limit: float,
    ) -> None:
        self.collision_model, self.timestep = collision_model, timestep
        known = not isinstance(triggers, str) and isinstance(triggers, Iterable)
        if not known or any(each not in TRIGGERS for each in triggers):
            raise ValueError(f"decide_at must be some of {', '.join(TRIGGERS)}, got {triggers!r}")
        number_of_at_least("horizon", horizon, timestep)
        self.triggers, self.margin = frozenset(triggers), number_of_at_least("margin", margin, 0.0)
        self.horizon, self.limit = self.steps(min(horizon, time_limit)), self.steps(time_limit)

    def steps(self, time: Any) -> Any:
        """Return the first physics step at or after a time [s], NEVER for an infinite time."""
        finite = np.isfinite(time)
        number = np.ceil((np.where(finite, time, 0.0) - 1e-9) / self.timestep).astype(np.int64)
        return np.where(finite, number, NEVER)[()]

    def __call__(self, plan: MovingPlan, began: Int, now: Int, scenes: ChangingScenes) -> Ends:
        """Return the ends of decisions that begin at physics step `now` under plans that began at step `began`."""
        jump, turn = self.steps(scenes.jump_times), self.steps(scenes.turn_times)
        moving_until = began + self.steps(plan.duration)
        arrival = np.maximum(began + self.steps(plan.duration + SETTLING), now + 1)
        there = (plan.waypoints[:, -1] == scenes.goals(arrival * self.timestep)).all(axis=-1)
        after = _next(jump, arrival), _next(turn, arrival)
        waits = there & (np.minimum(*after) != NEVER)  # at rest, for what is still to come
        ends = {Event.TIME_LIMIT: np.maximum(self.limit, now + 1)}
        for event, trigger, steps, later in (
            (Event.TARGET, "target", jump, after[0]),
            (Event.COURSE, "course", turn, after[1]),
        ):
            ends[event] = _next(steps, now) if trigger in self.triggers else np.where(waits, later, NEVER)
        horizon = now + self.horizon
        ends[Event.HORIZON] = np.where(
            ("horizon" in self.triggers) & (horizon < moving_until), horizon, NEVER
        )
        ends[Event.ARRIVAL] = np.where(waits, NEVER, arrival)
        ends[Event.CLEARANCE] = self._clearance(plan, began, now, scenes, np.minimum.reduce([*ends.values()]))
        order = sorted(ends, key=_RANK.index)
        steps = np.stack([ends[event] for event in order])
        event = np.array([int(each) for each in order])[steps.argmin(axis=0)]
        return Ends(steps.min(axis=0), event, there & (event == Event.ARRIVAL))

    def _clearance(self, plan: MovingPlan, began: Int, now: Int, scenes: ChangingScenes, latest: Int) -> Int:
        """Return the step at which the predicted clearance falls below the margin, NEVER if not before `latest`.

        The prediction assumes that obstacles keep their present velocity. Every course turns once at most, so two
        clearance profiles suffice: without the turn, and with it.
        """
        never = np.full(len(now), NEVER)
        if "clearance" not in self.triggers or not scenes.present.any():
            return never
        every = max(round(SAMPLED / self.timestep), 1)
        ahead = round(FORESIGHT / self.timestep) // every
        looks = int((latest - now).max()) // (every * LOOK) + 1
        times = np.asarray(self.timestep * (now[:, None] + every * np.arange((looks - 1) * LOOK + ahead + 1)))
        hand = plan.trajectory()(times - self.timestep * began[:, None])
        unturned, turned = (
            self.collision_model.clearance_profile(hand, rows, scenes.present)
            for rows in (scenes.places(times, unturned=times[:, 0]), scenes.places(times))
        )
        windows = [
            np.lib.stride_tricks.sliding_window_view(each, ahead + 1, axis=1)[:, ::LOOK].min(axis=-1)
            for each in (unturned, turned)
        ]
        seen = times[:, : looks * LOOK : LOOK, None] + 1e-9 >= scenes.turn_times[:, None]
        below = np.where(seen, windows[1], windows[0]).min(axis=-1) < self.margin
        falls = below[:, 1:] & ~below[:, :-1]
        if not falls.shape[1]:
            return never
        step = now + every * LOOK * (falls.argmax(axis=1) + 1)
        return np.where(falls.any(axis=1), step, NEVER)


_RANK = [Event.TIME_LIMIT, Event.TARGET, Event.COURSE, Event.CLEARANCE, Event.ARRIVAL, Event.HORIZON]
"""Rank of simultaneous events, highest first."""


def _next(steps: Int, now: Int) -> Int:
    """Return the first of some steps, shape (N, n), after the present one, NEVER without one, shape (N,)."""
    return np.asarray(np.where(steps > now[:, None], steps, NEVER).min(axis=1, initial=NEVER))
