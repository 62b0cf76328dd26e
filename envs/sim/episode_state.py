"""State of episodes of several steps: metrics so far, and everything needed to continue a stored episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.sim.executor import Rollout
from viapoint.envs.sim.outcome import Outcome, sum_in_order, within_joint_range


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

    @property
    def collision(self) -> Bool:
        """True where the arm has touched an obstacle, shape (N,)."""
        return np.asarray(self.first_contact >= 0)

    @property
    def sound(self) -> Bool:
        """True where nothing rules out success so far, shape (N,)."""
        return np.asarray(~self.collision & self.within & self.reachable & ~self.unstable)


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


class Episodes:
    """Running episodes of N environments, which began at different times.

    Args:
        arm: Arm that moves.
        num_envs: Number of environments N.
        timestep: Length of a physics step, [s].
        max_steps: Physics steps of an episode at most.
        records: Further named tuples of arrays, shape (N, ...) each, that belong to the state of the episodes.
    """

    def __init__(
        self, arm: Arm, num_envs: int, *, timestep: float, max_steps: int, records: Mapping[str, Any]
    ) -> None:
        self.arm, self.timestep = arm, timestep
        n, j, d = num_envs, len(arm.joint_range), arm.dimension
        numbers: dict[str, Any] = {name: np.zeros(n) for name in EpisodeState._fields}
        numbers |= {name: np.zeros(n, dtype=np.int64) for name in ("steps", "first_contact")}
        numbers |= {name: np.zeros(n, dtype=bool) for name in ("within", "reachable", "unstable")}
        self.now = EpisodeState(**{**numbers, "joints": np.zeros((n, j)), "hand": np.zeros((n, d))})
        """Metrics so far."""
        self._past: dict[str, Any] = {
            "joints": np.zeros((n, max_steps, j)),
            "planned": np.zeros((n, max_steps, d)),
            "contact": np.zeros((n, max_steps), dtype=bool),
        }
        self._stored: dict[str, dict[str, Any]] = {
            "": self.now._asdict(),
            "past_": self._past,
            **{f"{name}_": record._asdict() for name, record in records.items()},
        }

    @property
    def time(self) -> Float:
        """Time since the start of each episode, shape (N,), [s]."""
        return np.asarray(self.now.steps * self.timestep)

    def begin(self, rows: Int, joints: Float, hand: Float, clearance: Float) -> None:
        """Start episodes (n,) at rest with joint angles (n, J), hand positions (n, D) and clearances (n,)."""
        now = self.now
        for part in now:
            part[rows] = 0
        now.joints[rows], now.hand[rows] = joints, hand
        now.within[rows] = now.reachable[rows] = True
        now.stretch[rows], now.first_contact[rows] = 1.0, -1
        now.min_clearance[rows] = now.planned_clearance[rows] = clearance

    def add(self, segment: Segment) -> Float:
        """Add one step of some episodes; return the distances that the hand moved per physics step, (n, T), [m]."""
        now, rows, steps = self.now, segment.rows, segment.steps
        last = np.arange(len(rows)), steps - 1
        self._store(segment)
        contact, moved = segment.contact, norm(np.diff(segment.hand, axis=1, prepend=now.hand[rows, None]))
        deviation = ((segment.hand - segment.planned) ** 2).sum(axis=-1)
        kept = within_joint_range(segment.joints, self.arm).all(axis=-1)
        done = np.arange(segment.hand.shape[1]) < steps[:, None]
        if not done.all():  # steps beyond the end of a shorter movement do not count
            contact, moved, deviation, kept = contact & done, moved * done, deviation * done, kept | ~done
        touched = contact.any(axis=-1) & (now.first_contact[rows] < 0)
        now.first_contact[rows[touched]] = (now.steps[rows] + contact.argmax(axis=-1))[touched]
        now.min_clearance[rows] = np.minimum(now.min_clearance[rows], segment.min_clearance)
        now.planned_clearance[rows] = np.minimum(now.planned_clearance[rows], segment.planned_clearance)
        now.path_length[rows] += sum_in_order(moved)
        now.peak_speed[rows] = np.maximum(now.peak_speed[rows], moved.max(axis=-1) / self.timestep)
        now.last_speed[rows] = moved[last] / self.timestep
        now.deviation[rows] += sum_in_order(deviation)
        now.jerk_cost[rows] += segment.jerk_cost
        now.within[rows] &= kept.all(axis=-1)
        now.unstable[rows] |= segment.unstable
        now.joints[rows], now.hand[rows] = segment.joints[last], segment.hand[last]
        now.steps[rows] += steps
        return moved

    def outcome(self, success: Bool, goal_error: Float, duration: Float, straight_cost: Float) -> Outcome:
        """Return the metrics so far.

        Args:
            success: True where the hand has arrived and the episode is sound, shape (N,).
            goal_error: Distance from the goal, shape (N,), [m].
            duration: Duration of the movements, shape (N,), [s].
            straight_cost: Jerk cost of the straight movement of that duration, shape (N,), [m^2/s^5].
        """
        now = self.now
        contact = now.collision
        return Outcome(
            is_success=success,
            collision=contact,
            first_contact_time=np.where(contact, now.first_contact * self.timestep, -1.0),
            min_clearance=np.minimum(now.min_clearance, MAX_CLEARANCE),
            planned_clearance=np.minimum(now.planned_clearance, MAX_CLEARANCE),
            goal_error=goal_error,
            duration=duration,
            path_length=now.path_length.copy(),
            jerk_cost=now.jerk_cost.copy(),
            jerk_ratio=np.maximum(now.jerk_cost / straight_cost, 1.0),
            peak_speed=now.peak_speed.copy(),
            tracking_error=np.sqrt(now.deviation / np.maximum(now.steps, 1)),
            reachable=now.reachable.copy(),
            unstable=now.unstable.copy(),
            stretch=now.stretch.copy(),
        )

    def rollout(self, row: int, clearance: Callable[[Float, Float, Float], Float]) -> Rollout:
        """Return the movement of one episode so far, physics step by physics step.

        Args:
            row: Episode.
            clearance: Function of hand positions (T, D), joint angles (T, J) and times (T,), which returns the
                clearance at each time, shape (T,), [m].
        """
        steps = int(self.now.steps[row])
        number = max(steps, 1)
        joints, planned, contact = (part[row, :number].copy() for part in self._past.values())
        if not steps:  # at rest at the start
            joints[:], planned[:], contact[:] = self.now.joints[row], self.now.hand[row], False
        hand = np.asarray(self.arm.hand_position(joints))
        time = np.asarray(self.timestep * np.arange(1, number + 1))
        return Rollout(time, planned, joints, hand, contact, clearance(hand, joints, time))

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
        """Keep the physics steps of each episode for :meth:`rollout`."""
        rows, steps, begin = segment.rows, segment.steps, self.now.steps[segment.rows]
        parts, length = (segment.joints, segment.planned, segment.contact), segment.hand.shape[1]
        for past, part in zip(self._past.values(), parts, strict=True):
            if (steps == length).all():
                past[rows[:, None], begin[:, None] + np.arange(length)] = part
                continue
            for row, first, count, mine in zip(rows, begin, steps, part, strict=True):
                past[row, first : first + count] = mine[:count]
