"""Episodes of many control steps: what has come of each so far."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.velocity import Motion
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import SETTLING, Rollout
from viapoint.envs.sim.outcome import (
    GOAL_TOLERANCE,
    LIMIT_TOLERANCE,
    REST_SPEED,
    Outcome,
    empty_outcome,
)
from viapoint.envs.sim.simulator import SimulationLog


class EpisodeState(NamedTuple):
    """What N episodes have come to, shape (N, ...) each."""

    joints: Float
    """[rad]."""
    hand: Float
    """[m]."""
    steps: NDArray[np.int64]
    """Physics steps so far."""
    still: NDArray[np.int64]
    """The last of them in which the hand was at rest at the goal."""
    first_contact: NDArray[np.int64]
    """Physics step of the first contact, -1 without."""
    min_clearance: Float
    """[m]."""
    planned_clearance: Float
    """Of the reference, [m]."""
    path_length: Float
    """[m]."""
    peak_speed: Float
    """[m/s]."""
    deviation: Float
    """Sum of the squared distances of hand and reference, [m^2]."""
    jerk_cost: Float
    """Of the reference, [m^2/s^5]."""
    within: NDArray[np.bool_]
    """Whether the joints have kept their limits."""
    reachable: NDArray[np.bool_]
    """Whether the reference has stayed within the arm's reach."""
    unstable: NDArray[np.bool_]
    """Whether the physics broke down."""


class StepEpisodes:
    """Bookkeeping of N episodes that began at different times."""

    def __init__(self, collision_model: CollisionModel, num_envs: int, *, timestep: float, most: int) -> None:
        """Make room for `num_envs` episodes of at most `most` physics steps."""
        self.collision_model, self.arm, self.timestep = collision_model, collision_model.arm, timestep
        arm = self.arm
        n, j, d = num_envs, len(arm.joint_range), arm.dimension
        self.motion = Motion.at_rest(np.zeros((n, d)))
        """Where the references are."""
        numbers: dict[str, Any] = {name: np.zeros(n) for name in EpisodeState._fields}
        numbers |= {name: np.zeros(n, dtype=np.int64) for name in ("steps", "still", "first_contact")}
        numbers |= {name: np.zeros(n, dtype=bool) for name in ("within", "reachable", "unstable")}
        self.running = EpisodeState(**{**numbers, "joints": np.zeros((n, j)), "hand": np.zeros((n, d))})
        self._past: dict[str, NDArray[Any]] = {
            "joints": np.zeros((n, most, j)),
            "planned": np.zeros((n, most, d)),
            "contact": np.zeros((n, most), dtype=bool),
        }

    def begin(self, rows: NDArray[np.int64], scenes: Scenes, joints: Float) -> None:
        """Start episodes at rest.

        Args:
            rows: Which, shape (n,).
            scenes: n of them.
            joints: Shape (n, J), [rad].
        """
        self.motion.put(rows, Motion.at_rest(scenes.start))
        self.running.joints[rows], self.running.hand[rows] = joints, scenes.start
        for name in EpisodeState._fields[2:]:
            getattr(self.running, name)[rows] = 0
        for name in ("within", "reachable"):
            getattr(self.running, name)[rows] = True
        self.running.first_contact[rows] = -1
        clearance = self.collision_model.least_clearance(
            scenes.start[:, None], scenes.obstacles, scenes.present
        )
        self.running.min_clearance[rows] = self.running.planned_clearance[rows] = clearance

    def add(
        self, rows: NDArray[np.int64], scenes: Scenes, motion: Motion, jerk_cost: Float, record: SimulationLog
    ) -> None:
        """Note one control step of S physics steps.

        Args:
            rows: Of the n episodes that moved.
            scenes: Theirs.
            motion: Their references, shape (n, S + 1, D).
            jerk_cost: Of these, shape (n,), [m^2/s^5].
            record: What the physics made of them.
        """
        now, timestep, number = self.running, self.timestep, record.joints.shape[1]
        hand = np.asarray(self.arm.hand_position(record.joints))
        moved = norm(np.diff(hand, axis=1, prepend=now.hand[rows, None]))
        planned = motion.position[:, 1:]
        for name, part in (("joints", record.joints), ("planned", planned), ("contact", record.contact)):
            self._past[name][rows[:, None], now.steps[rows, None] + np.arange(number)] = part
        touched = record.contact.any(axis=-1) & (now.first_contact[rows] < 0)
        now.first_contact[rows[touched]] = (now.steps[rows] + record.contact.argmax(axis=-1))[touched]
        at_goal = (moved < REST_SPEED * timestep) & (norm(hand - scenes.goal[:, None]) < GOAL_TOLERANCE)
        trailing = np.where(at_goal.all(axis=-1), number, np.argmin(at_goal[:, ::-1], axis=-1))
        now.still[rows] = trailing + np.where(trailing == number, now.still[rows], 0)
        for mine, path, joints in (
            (now.min_clearance, hand, record.joints),
            (now.planned_clearance, planned, None),
        ):
            least = self.collision_model.least_clearance(path, scenes.obstacles, scenes.present, joints)
            mine[rows] = np.minimum(mine[rows], least)
        now.path_length[rows] += _sum_in_order(moved)
        now.peak_speed[rows] = np.maximum(now.peak_speed[rows], moved.max(axis=-1) / timestep)
        now.deviation[rows] += _sum_in_order(((hand - planned) ** 2).sum(axis=-1))
        now.jerk_cost[rows] += jerk_cost
        low, high = (np.array(side) for side in zip(*self.arm.joint_range, strict=True))
        kept = (record.joints >= low - LIMIT_TOLERANCE) & (record.joints <= high + LIMIT_TOLERANCE)
        now.within[rows] &= kept.all(axis=(1, 2))
        now.unstable[rows] |= record.unstable
        now.joints[rows], now.hand[rows] = record.joints[:, -1], hand[:, -1]
        now.steps[rows] += number
        self.motion.put(rows, Motion(*(part[:, -1] for part in motion)))

    def outcome(self, scenes: Scenes) -> Outcome:
        """What has come of each so far; the duration of a success is the time until it came to rest."""
        now = self.running
        collision = now.first_contact >= 0
        arrived = now.still * self.timestep >= SETTLING - 1e-9
        success = arrived & ~collision & now.within & now.reachable & ~now.unstable
        steps = np.maximum(now.steps, 1)
        duration = self.timestep * np.where(success, np.maximum(now.steps - now.still, 1), steps)
        straight = 360.0 * norm(scenes.goal - scenes.start) ** 2 / duration**5  # half of 720 A^2/T^5
        return empty_outcome(len(steps))._replace(
            is_success=success,
            collision=collision,
            first_contact_time=np.where(collision, now.first_contact * self.timestep, -1.0),
            min_clearance=np.minimum(now.min_clearance, MAX_CLEARANCE),
            planned_clearance=np.minimum(now.planned_clearance, MAX_CLEARANCE),
            goal_error=norm(now.hand - scenes.goal),
            duration=duration,
            path_length=now.path_length.copy(),
            jerk_cost=now.jerk_cost.copy(),
            jerk_ratio=np.maximum(now.jerk_cost / straight, 1.0),
            peak_speed=now.peak_speed.copy(),
            tracking_error=np.sqrt(now.deviation / steps),
            reachable=now.reachable.copy(),
            unstable=now.unstable.copy(),
        )

    def rollout(self, row: int, scene: Scenes) -> Rollout:
        """The movement of one episode so far, physics step by physics step, in its scene."""
        steps = int(self.running.steps[row])
        number = max(steps, 1)
        joints, planned, contact = (part[row, :number].copy() for part in self._past.values())
        if not steps:  # at rest at the start
            joints[:], planned[:], contact[:] = self.running.joints[row], self.running.hand[row], False
        hand = np.asarray(self.arm.hand_position(joints))
        each = Scenes(*(np.repeat(field, number, axis=0) for field in scene))
        clearance = self.collision_model.least_clearance(
            hand[:, None], each.obstacles, each.present, joints[:, None]
        )
        time = np.asarray(self.timestep * np.arange(1, number + 1))
        return Rollout(time, planned, joints, hand, contact, clearance)

    def state(self) -> dict[str, Any]:
        """All of it, in fresh arrays."""
        past = {f"past_{name}": part for name, part in self._past.items()}
        parts = {**self.motion._asdict(), **self.running._asdict(), **past}
        return {name: part.copy() for name, part in parts.items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Be as when :meth:`state` was taken."""
        for record in (self.motion, self.running):
            for name, mine in record._asdict().items():
                mine[:] = state[name]
        for name, mine in self._past.items():
            mine[:] = state[f"past_{name}"]


def _sum_in_order(values: Float) -> Float:
    """Sum along the last axis, one after the other, so that the batch changes no bit of it."""
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])
