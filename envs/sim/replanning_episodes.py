"""Episodes of many decisions: the plan under way in each, and what has come of it so far."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.replanning import MovingPlan
from viapoint.envs.actions.via_points import MIN_GOAL_DISTANCE
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.sim.executor import Rollout
from viapoint.envs.sim.outcome import GOAL_TOLERANCE, LIMIT_TOLERANCE, REST_SPEED, Outcome, empty_outcome
from viapoint.envs.sim.simulator import SimulationLog


class EpisodeState(NamedTuple):
    """What N episodes have come to, shape (N, ...) each."""

    joints: Float
    """[rad]."""
    hand: Float
    """[m]."""
    steps: Int
    """Physics steps so far."""
    began: Int
    """Physics step at which the plan under way began."""
    begun: Bool
    """Whether there is one."""
    first_contact: Int
    """Physics step of the first contact, -1 without."""
    min_clearance: Float
    """[m]."""
    planned_clearance: Float
    """Of what was commanded, [m]."""
    path_length: Float
    """[m]."""
    peak_speed: Float
    """[m/s]."""
    last_speed: Float
    """[m/s]."""
    deviation: Float
    """Sum of the squared distances of hand and plan, [m^2]."""
    jerk_cost: Float
    """Of what was commanded, [m^2/s^5]."""
    stretch: Float
    """Greatest of any plan."""
    within: Bool
    """Whether the joints have kept their limits."""
    reachable: Bool
    """Whether every plan has been within the arm's reach."""
    unstable: Bool
    """Whether the physics broke down."""


class DecisionRollout(NamedTuple):
    """What n simulations did in one decision, in a record of T physics steps."""

    rows: Int
    """Of the episodes, shape (n,)."""
    steps: Int
    """Physics steps of each, up to the contact where there was one, shape (n,)."""
    planned: Float
    """Hand position commanded after each, shape (n, T, D), [m]."""
    clearance: Float
    """Least, of what was commanded, shape (n,), [m]."""
    jerk_cost: Float
    """Of what was commanded, shape (n,), [m^2/s^5]."""
    record: SimulationLog
    """What the physics made of it."""


class OnlineEpisodes:
    """Bookkeeping of N episodes that began at different times."""

    def __init__(
        self, collision_model: CollisionModel, num_envs: int, *, n_via: int, timestep: float, most: int
    ) -> None:
        """Make room for `num_envs` episodes of at most `most` physics steps."""
        self.collision_model, self.arm, self.timestep = collision_model, collision_model.arm, timestep
        arm = self.arm
        n, j, d = num_envs, len(arm.joint_range), arm.dimension
        numbers: dict[str, Any] = {name: np.zeros(n) for name in EpisodeState._fields}
        numbers |= {name: np.zeros(n, dtype=np.int64) for name in ("steps", "began", "first_contact")}
        numbers |= {name: np.zeros(n, dtype=bool) for name in ("begun", "within", "reachable", "unstable")}
        self.running = EpisodeState(**{**numbers, "joints": np.zeros((n, j)), "hand": np.zeros((n, d))})
        self.plan = MovingPlan(
            np.zeros((n, n_via + 2, d)), np.ones((n, n_via + 1)), np.zeros((n, d)), np.zeros((n, d))
        )
        """Under way."""
        self.history: list[list[tuple[float, MovingPlan]]] = [[] for _ in range(n)]
        """Every plan of each episode, one row each, and when it began, [s]."""
        self._past: dict[str, NDArray[Any]] = {
            "joints": np.zeros((n, most, j)),
            "planned": np.zeros((n, most, d)),
            "contact": np.zeros((n, most), dtype=bool),
        }

    @property
    def time(self) -> Float:
        """Since the start of each episode, shape (N,), [s]."""
        return np.asarray(self.running.steps * self.timestep)

    @property
    def plan_time(self) -> Float:
        """Since the beginning of the plan under way, shape (N,), [s]."""
        return np.asarray((self.running.steps - self.running.began) * self.timestep)

    def begin(self, rows: Int, scenes: ChangingScenes, joints: Float) -> None:
        """Start episodes at rest.

        Args:
            rows: Which, shape (n,).
            scenes: n of them.
            joints: Shape (n, J), [rad].
        """
        for part in self.running:
            part[rows] = 0
        now = self.running
        now.joints[rows], now.hand[rows] = joints, scenes.start
        now.within[rows] = now.reachable[rows] = True
        now.stretch[rows], now.first_contact[rows] = 1.0, -1
        rest = np.repeat(scenes.start[:, None], self.plan.waypoints.shape[1], axis=1)
        zero = np.zeros_like(scenes.start)
        self.plan.put(rows, MovingPlan(rest, np.ones((len(rows), rest.shape[1] - 1)), zero, zero))
        clearance = self.collision_model.clearance_profile(
            scenes.start[:, None], scenes.places(np.zeros((len(rows), 1))), scenes.present
        ).min(axis=(1, 2), initial=MAX_CLEARANCE)  # fmt: skip
        now.min_clearance[rows] = now.planned_clearance[rows] = clearance
        for row in rows:
            self.history[row] = []

    def revise(self, plan: MovingPlan, revised: Bool, stretch: Float) -> None:
        """Take up new plans where some were made, shape (N,) each."""
        rows, now = np.flatnonzero(revised), self.running
        self.plan.put(rows, plan.take(rows))
        now.began[rows], now.begun[rows] = now.steps[rows], True
        now.stretch[rows] = np.maximum(now.stretch[rows], stretch[rows])
        for row in rows:
            one = MovingPlan(*(part[row : row + 1].copy() for part in plan))
            self.history[row].append((float(now.steps[row] * self.timestep), one))

    def add(self, scenes: ChangingScenes, carried: DecisionRollout) -> None:
        """Note what some episodes, whose scenes these are, did in one decision."""
        now, record, (rows, steps) = self.running, carried.record, carried[:2]
        number = int(steps.max())
        joints, planned = record.joints[:, :number], carried.planned[:, :number]
        done = np.arange(number) < steps[:, None]
        contact, last = record.contact[:, :number] & done, (np.arange(len(rows)), steps - 1)
        hand = np.asarray(self.arm.hand_position(joints))
        moved = norm(np.diff(hand, axis=1, prepend=now.hand[rows, None])) * done
        for row, count, begin, *parts in zip(
            rows, steps, now.steps[rows], joints, planned, contact, strict=True
        ):
            for past, part in zip(self._past.values(), parts, strict=True):
                past[row, begin : begin + count] = part[:count]
        touched = contact.any(axis=-1) & (now.first_contact[rows] < 0)
        now.first_contact[rows[touched]] = (now.steps[rows] + contact.argmax(axis=-1))[touched]
        now.min_clearance[rows] = np.minimum(
            now.min_clearance[rows], self._clearance(rows, scenes, hand, joints, done)
        )
        now.planned_clearance[rows] = np.minimum(now.planned_clearance[rows], carried.clearance)
        now.path_length[rows] += _sum_in_order(moved)
        now.peak_speed[rows] = np.maximum(now.peak_speed[rows], moved.max(axis=-1) / self.timestep)
        now.last_speed[rows] = moved[last] / self.timestep
        now.deviation[rows] += _sum_in_order(((hand - planned) ** 2).sum(axis=-1) * done)
        now.jerk_cost[rows] += carried.jerk_cost
        low, high = (np.array(side) for side in zip(*self.arm.joint_range, strict=True))
        kept = (joints >= low - LIMIT_TOLERANCE) & (joints <= high + LIMIT_TOLERANCE)
        now.within[rows] &= (kept.all(axis=-1) | ~done).all(axis=-1)
        now.unstable[rows] |= record.unstable
        now.joints[rows], now.hand[rows] = joints[last], hand[last]
        now.steps[rows] += steps

    def _clearance(self, rows: Int, scenes: ChangingScenes, hand: Float, joints: Float, done: Bool) -> Float:
        """Least clearance of the arm in one decision, shape (n,), [m]."""
        if not scenes.obstacles.shape[1]:
            return np.full(len(rows), MAX_CLEARANCE)
        time = np.asarray(self.timestep * (self.running.steps[rows, None] + np.arange(1, hand.shape[1] + 1)))
        profile = self.collision_model.clearance_profile(
            hand, scenes.places(time), scenes.present, joints
        ).min(axis=-1)
        return np.asarray(np.where(done, profile, MAX_CLEARANCE).min(axis=-1))

    def outcome(self, scenes: ChangingScenes, final: Bool) -> Outcome:
        """What has come of each so far, where `final` says that the hand has arrived and nothing is to come."""
        now, goal = self.running, scenes.goals(self.time)
        collision = now.first_contact >= 0
        goal_error = norm(now.hand - goal)
        arrived = final & (goal_error < GOAL_TOLERANCE) & (now.last_speed < REST_SPEED)
        ends = now.began * self.timestep + self.plan.duration
        duration = np.where(now.begun, np.minimum(self.time, ends), 0.0)
        length = np.maximum(self._straight(scenes), MIN_GOAL_DISTANCE)
        straight = 360.0 * length**2 / np.maximum(duration, self.timestep) ** 5  # half of 720 A^2/T^5
        return empty_outcome(len(duration))._replace(
            is_success=arrived & ~collision & now.within & now.reachable & ~now.unstable,
            collision=collision,
            first_contact_time=np.where(collision, now.first_contact * self.timestep, -1.0),
            min_clearance=np.minimum(now.min_clearance, MAX_CLEARANCE),
            planned_clearance=np.minimum(now.planned_clearance, MAX_CLEARANCE),
            goal_error=goal_error,
            duration=duration,
            path_length=now.path_length.copy(),
            jerk_cost=now.jerk_cost.copy(),
            jerk_ratio=np.maximum(now.jerk_cost / straight, 1.0),
            peak_speed=now.peak_speed.copy(),
            tracking_error=np.sqrt(now.deviation / np.maximum(now.steps, 1)),
            reachable=now.reachable.copy(),
            unstable=now.unstable.copy(),
            stretch=now.stretch.copy(),
        )

    def _straight(self, scenes: ChangingScenes) -> Float:
        """Length of the straight lines from the start from target to target, so far, shape (N,), [m]."""
        length, before = norm(scenes.goal - scenes.start), scenes.goal
        for k in range(scenes.jumps.shape[1]):
            jumped = scenes.jump_times[:, k] <= self.time + 1e-9
            length = length + np.where(jumped, norm(scenes.jumps[:, k, 1:] - before), 0.0)
            before = np.where(jumped[:, None], scenes.jumps[:, k, 1:], before)
        return length

    def rollout(self, row: int, scene: ChangingScenes) -> Rollout:
        """The movement of one episode so far, physics step by physics step, in its scene."""
        steps = int(self.running.steps[row])
        number = max(steps, 1)
        joints, planned, contact = (part[row, :number].copy() for part in self._past.values())
        if not steps:  # at rest at the start
            joints[:], planned[:], contact[:] = self.running.joints[row], self.running.hand[row], False
        hand, time = (
            np.asarray(self.arm.hand_position(joints)),
            np.asarray(self.timestep * np.arange(1, number + 1)),
        )
        clearance = self.collision_model.clearance_profile(
            hand[None], scene.places(time[None]), scene.present, joints[None]
        )[0].min(axis=-1, initial=MAX_CLEARANCE)  # fmt: skip
        return Rollout(time, planned, joints, hand, contact, clearance)

    def state(self) -> dict[str, Any]:
        """All of it, in fresh arrays."""
        past = {f"past_{name}": part for name, part in self._past.items()}
        plan = {f"plan_{name}": part for name, part in self.plan._asdict().items()}
        every = [each for episode in self.history for each in episode]
        plans = [np.array([time for time, _ in every])]
        for k, mine in enumerate(self.plan):
            plans.append(np.concatenate([np.empty((0, *mine.shape[1:])), *(one[k] for _, one in every)]))
        names = ("time", *MovingPlan._fields)
        history = {f"history_{name}": part for name, part in zip(names, plans, strict=True)}
        history["history_number"] = np.array([len(episode) for episode in self.history])
        return {
            name: part.copy() for name, part in {**self.running._asdict(), **plan, **past, **history}.items()
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Be as when :meth:`state` was taken."""
        for prefix, record in (
            ("", self.running._asdict()),
            ("plan_", self.plan._asdict()),
            ("past_", self._past),
        ):
            for name, mine in record.items():
                mine[:] = state[f"{prefix}{name}"]
        names = ("time", *MovingPlan._fields)
        first = 0
        for row, number in enumerate(np.asarray(state["history_number"])):
            time, *parts = (np.asarray(state[f"history_{name}"])[first : first + number] for name in names)
            one = (MovingPlan(*(part[k : k + 1].copy() for part in parts)) for k in range(number))
            self.history[row] = [(float(t), each) for t, each in zip(time, one, strict=True)]
            first += int(number)


def jerk_cost_between(plan: MovingPlan, begin: Float, end: Float) -> Float:
    """Half the integral of the squared jerk from one time to another, shape (N,), [m^2/s^5]; exact.

    Jerk is a parabola of time on each segment, its square of degree four, which three nodes integrate exactly.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3)
    knots = np.concatenate((np.zeros_like(begin)[:, None], np.cumsum(plan.durations, axis=-1)), axis=-1)
    low = np.clip(begin[:, None], knots[:, :-1], knots[:, 1:])
    half = 0.5 * (np.clip(end[:, None], knots[:, :-1], knots[:, 1:]) - low)
    times = low[..., None] + half[..., None] * (1.0 + nodes)
    jerk = plan.trajectory()(times.reshape(len(times), -1), 3)
    square = (jerk * jerk).sum(axis=-1).reshape(times.shape)
    return 0.5 * _sum_in_order((square * weights * half[..., None]).reshape(len(times), -1))


def _sum_in_order(values: Float) -> Float:
    """Sum along the last axis, one after the other, so that zeros behind change no bit of it."""
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])
