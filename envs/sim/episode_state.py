"""State of episodes: metrics so far, and everything needed to continue a stored episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.arrays import norm, put, squared_length, take
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.sim.outcome import Outcome, sum_in_order, within_joint_range


class Segment(NamedTuple):
    """Measured movements of n episodes during one step, in T recorded physics steps."""

    rows: Int
    """Episodes that moved, shape (n,)."""
    steps: Int
    """Physics steps that belong to each, 1 to T, shape (n,)."""
    planned: Float
    """Commanded hand position after each step, shape (n, T, D), [m]."""
    joints: Float
    """Joint angles after each step, shape (n, T, J), [rad]."""
    hand: Float
    """Hand position after each step, shape (n, T, D), [m]."""
    contact: Bool
    """True where the arm touched an obstacle at the state before the step, shape (n, T)."""
    unstable: Bool
    """True where the physics broke down, shape (n,)."""
    min_clearance: Float
    """Least clearance of the arm, shape (n,), [m]."""
    planned_clearance: Float
    """Least clearance of the commanded path, shape (n,), [m]."""
    jerk_cost: Float
    """Jerk cost of the commanded path, shape (n,), [m^2/s^5]."""


class EpisodeState(NamedTuple):
    """Metrics of N running episodes so far, shape (N, ...) each."""

    joints: Float
    """Present joint angles, [rad]."""
    hand: Float
    """Present hand position, [m]."""
    steps: Int
    """Physics steps so far."""
    first_contact: Int
    """Physics step of the first contact, -1 without contact."""
    min_clearance: Float
    """Least clearance of the arm, [m]."""
    planned_clearance: Float
    """Least clearance of the commanded path, [m]."""
    path_length: Float
    """Length of the hand's path, [m]."""
    peak_speed: Float
    """Greatest hand speed, [m/s]."""
    last_speed: Float
    """Hand speed in the last physics step, [m/s]."""
    deviation: Float
    """Sum of the squared distances between hand and command, [m^2]."""
    jerk_cost: Float
    """Jerk cost of the commanded path, [m^2/s^5]."""
    stretch: Float
    """Greatest factor by which a plan was slowed down."""
    within: Bool
    """True while the joints have kept their limits."""
    reachable: Bool
    """True while the command has stayed within the arm's reach."""
    unstable: Bool
    """True if the physics broke down."""

    @classmethod
    def at_rest(cls, joints: Float, hand: Float, clearance: Float) -> EpisodeState:
        """Return n episodes that begin with joint angles (n, J), hand positions (n, D) and clearances (n,)."""
        n = len(hand)
        return cls(
            joints=joints.copy(), hand=hand.copy(), steps=np.zeros(n, np.int64), first_contact=np.full(n, -1),
            min_clearance=clearance.copy(), planned_clearance=clearance.copy(), path_length=np.zeros(n),
            peak_speed=np.zeros(n), last_speed=np.zeros(n), deviation=np.zeros(n), jerk_cost=np.zeros(n),
            stretch=np.ones(n), within=np.ones(n, bool), reachable=np.ones(n, bool), unstable=np.zeros(n, bool),
        )  # fmt: skip

    @property
    def collision(self) -> Bool:
        """True where the arm has touched an obstacle, shape (N,)."""
        return np.asarray(self.first_contact >= 0)

    @property
    def sound(self) -> Bool:
        """True where nothing rules out success so far, shape (N,)."""
        return np.asarray(~self.collision & self.within & self.reachable & ~self.unstable)

    def advanced(self, segment: Segment, arm: Arm, timestep: float) -> tuple[EpisodeState, Float]:
        """Return n episodes after a segment of theirs, and how far the hand moved per physics step, (n, T), [m]."""
        steps, contact = segment.steps, segment.contact
        last = np.arange(len(steps)), steps - 1
        moved = norm(np.diff(segment.hand, axis=1, prepend=self.hand[:, None]))
        deviation = squared_length(segment.hand - segment.planned)
        kept = within_joint_range(segment.joints, arm).all(axis=-1)
        done = np.arange(segment.hand.shape[1]) < steps[:, None]
        if not done.all():  # steps beyond the end of a shorter movement do not count
            contact, moved, deviation, kept = contact & done, moved * done, deviation * done, kept | ~done
        first_contact = np.where(contact.any(axis=-1), self.steps + contact.argmax(axis=-1), -1)
        after = EpisodeState(
            joints=segment.joints[last],
            hand=segment.hand[last],
            steps=self.steps + steps,
            first_contact=np.where(self.collision, self.first_contact, first_contact),
            min_clearance=np.minimum(self.min_clearance, segment.min_clearance),
            planned_clearance=np.minimum(self.planned_clearance, segment.planned_clearance),
            path_length=self.path_length + sum_in_order(moved),
            peak_speed=np.maximum(self.peak_speed, moved.max(axis=-1) / timestep),
            last_speed=moved[last] / timestep,
            deviation=self.deviation + sum_in_order(deviation),
            jerk_cost=self.jerk_cost + segment.jerk_cost,
            stretch=self.stretch,
            within=self.within & kept.all(axis=-1),
            reachable=self.reachable,
            unstable=self.unstable | segment.unstable,
        )
        return after, moved

    def outcome(
        self, success: Bool, goal_error: Float, duration: Float, straight_cost: Float, timestep: float
    ) -> Outcome:
        """Return the metrics so far, of which the first three are given.

        `straight_cost` is the jerk cost of straight movements of these durations, shape (N,), [m^2/s^5], and `timestep`
        the length of a physics step, [s].
        """
        return Outcome(
            is_success=success,
            collision=self.collision,
            first_contact_time=np.where(self.collision, self.first_contact * timestep, -1.0),
            min_clearance=np.minimum(self.min_clearance, MAX_CLEARANCE),
            planned_clearance=np.minimum(self.planned_clearance, MAX_CLEARANCE),
            goal_error=goal_error,
            duration=duration,
            path_length=self.path_length.copy(),
            jerk_cost=self.jerk_cost.copy(),
            jerk_ratio=np.maximum(self.jerk_cost / straight_cost, 1.0),
            peak_speed=self.peak_speed.copy(),
            tracking_error=np.sqrt(self.deviation / np.maximum(self.steps, 1)),
            reachable=self.reachable.copy(),
            unstable=self.unstable.copy(),
            stretch=self.stretch.copy(),
        )


class Episodes:
    """Running episodes of N environments, which began at different times, of `max_steps` physics steps at most.

    `records` are further arrays by name, shape (N, ...) each, that belong to the state of the episodes.
    """

    def __init__(
        self, arm: Arm, num_envs: int, *, timestep: float, max_steps: int, records: Mapping[str, Any]
    ) -> None:
        self.arm, self.timestep = arm, timestep
        n, j, d = num_envs, len(arm.joint_range), arm.dimension
        self.now = EpisodeState.at_rest(np.zeros((n, j)), np.zeros((n, d)), np.zeros(n))
        """Metrics so far."""
        self._past: dict[str, Any] = {
            "joints": np.zeros((n, max_steps, j)),
            "planned": np.zeros((n, max_steps, d)),
            "contact": np.zeros((n, max_steps), dtype=bool),
        }
        self._stored: dict[str, dict[str, Any]] = {
            "": self.now._asdict(),
            "past_": self._past,
            **{f"{name}_": dict(record) for name, record in records.items()},
        }

    @property
    def time(self) -> Float:
        """Time since the start of each episode, shape (N,), [s]."""
        return np.asarray(self.now.steps * self.timestep)

    def begin(self, rows: Int, joints: Float, hand: Float, clearance: Float) -> None:
        """Start episodes (n,) at rest with joint angles (n, J), hand positions (n, D) and clearances (n,)."""
        put(self.now, rows, EpisodeState.at_rest(joints, hand, clearance))

    def add(self, segment: Segment) -> Float:
        """Add one step of some episodes; return the distances that the hand moved per physics step, (n, T), [m]."""
        self._store(segment)
        after, moved = take(self.now, segment.rows).advanced(segment, self.arm, self.timestep)
        put(self.now, segment.rows, after)
        return moved

    def recorded(self, row: int) -> tuple[Float, Float, Bool]:
        """Return commanded positions, joint angles and contacts of one episode so far, one for each physics step."""
        steps = int(self.now.steps[row])
        joints, planned, contact = (part[row, : max(steps, 1)].copy() for part in self._past.values())
        if not steps:  # at rest at the start
            joints[:], planned[:], contact[:] = self.now.joints[row], self.now.hand[row], False
        return planned, joints, contact

    def state(self) -> dict[str, Any]:
        """Return the state of all episodes as fresh arrays."""
        return {
            f"{prefix}{name}": part.copy()
            for prefix, record in self._stored.items()
            for name, part in record.items()
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state` returned."""
        for prefix, record in self._stored.items():
            for name, mine in record.items():
                mine[:] = state[f"{prefix}{name}"]

    def _store(self, segment: Segment) -> None:
        """Keep the physics steps of each episode for :meth:`recorded`."""
        rows, steps, begin = segment.rows, segment.steps, self.now.steps[segment.rows]
        parts, length = (segment.joints, segment.planned, segment.contact), segment.hand.shape[1]
        for past, part in zip(self._past.values(), parts, strict=True):
            if (steps == length).all():
                past[rows[:, None], begin[:, None] + np.arange(length)] = part
                continue
            for row, first, count, mine in zip(rows, begin, steps, part, strict=True):
                past[row, first : first + count] = mine[:count]
