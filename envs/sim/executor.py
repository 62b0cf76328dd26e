"""Stages of whole movements: time scaling, references, physics and metrics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.arrays import norm, squared_length
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.geometry.narrow_phase import nearest_approach
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import (
    GOAL_TOLERANCE,
    REST_SPEED,
    SETTLING,
    Outcome,
    straight_jerk_cost,
    sum_in_order,
    within_joint_range,
)
from viapoint.envs.sim.simulator import SimulationLog, Simulator
from viapoint.envs.sim.time_scaling import CHECK_INTERVAL, required_time_scale

GROUP = 64
"""Movements of one group: few enough for the processor's cache, many enough for the engine's threads."""


class Rollout(NamedTuple):
    """One movement at its T physics steps."""

    time: Float
    """Shape (T,), [s]."""
    planned: Float
    """Planned hand positions, shape (T, D), [m]."""
    joints: Float
    """Joint angles, shape (T, J), [rad]."""
    hand: Float
    """Executed hand positions, shape (T, D), [m]."""
    contact: Bool
    """True where the arm touched an obstacle at the state before the step, shape (T,)."""
    clearance: Float
    """Clearance from the nearest obstacle, shape (T,), [m]."""


class Movements(NamedTuple):
    """Decided movements of N simulations."""

    scenes: Scenes
    """Scenes that they take place in."""
    plan: Plan
    """Via-points and durations as decided."""


class ScaledMovements(NamedTuple):
    """Movements that are slow enough for the arm, N of them or a group."""

    sims: Int
    """Simulations in increasing order, shape (n,)."""
    scenes: Scenes
    """Scenes that they take place in."""
    plan: Plan
    """Via-points and scaled durations."""
    stretch: Float
    """Factor by which each movement was slowed down, shape (n,)."""
    within: Bool
    """False where time scaling found the plan out of reach, shape (n,)."""
    duration: Float
    """Scaled total duration, shape (n,), [s]."""
    steps: Int
    """Physics steps including the settling time, shape (n,)."""

    def groups(self) -> list[ScaledMovements]:
        """Return groups of at most GROUP movements of similar length, so that short movements take fewer steps."""
        if len(self.sims) <= GROUP:
            return [self]
        order = np.argsort(self.steps, kind="stable")
        return [self.take(np.sort(order[first : first + GROUP])) for first in range(0, len(order), GROUP)]

    def take(self, rows: Int) -> ScaledMovements:
        """Return the movements at some rows."""
        found = self.stretch[rows], self.within[rows], self.duration[rows], self.steps[rows]
        return ScaledMovements(self.sims[rows], self.scenes.take(rows), self.plan.take(rows), *found)


class TrackingReferences(NamedTuple):
    """References of one group at the physics rate, and the controls that track them."""

    movements: ScaledMovements
    """Movements of the group."""
    planned: Float
    """Planned hand position after each step, shape (n, T, D), [m]."""
    controls: Float
    """Actuator controls, shape (n, T, U)."""
    reachable: Bool
    """True where the whole plan is within the arm's reach, shape (n,)."""
    jerk_cost: Float
    """Half the integral of the squared jerk of the plan, shape (n,), [m^2/s^5]."""
    clearance: Float
    """Least clearance of the plan, shape (n,), [m]."""


class SimulatedMovements(NamedTuple):
    """Movements of one group after the physics."""

    references: TrackingReferences
    """References that the arm tracked."""
    log: SimulationLog | None
    """Recorded physics of the reachable movements; None if there are none."""


class MeasuredMovements(NamedTuple):
    """Movements of one group with their metrics."""

    simulated: SimulatedMovements
    """Movements after the physics."""
    joints: Float
    """Joint angles at the end, shape (n, J), [rad]."""
    outcome: Outcome
    """Metrics."""


class Execution(NamedTuple):
    """Executed movements of N simulations."""

    scenes: Scenes
    """Scenes that they took place in."""
    plan: Plan
    """Via-points and durations as decided."""
    groups: tuple[MeasuredMovements, ...]
    """Groups that were simulated together."""
    joints: Float
    """Joint angles at the end, shape (N, J), [rad]."""
    outcome: Outcome
    """Metrics."""


def join_groups(movements: Movements, groups: list[MeasuredMovements]) -> Execution:
    """Return the executed movements of all groups, in the order of the simulations."""
    scenes, plan = movements
    if len(groups) == 1:
        return Execution(scenes, plan, tuple(groups), groups[0].joints, groups[0].outcome)
    back = np.argsort(np.concatenate([group.simulated.references.movements.sims for group in groups]))
    outcome = Outcome(
        *(np.concatenate(parts)[back] for parts in zip(*(g.outcome for g in groups), strict=True))
    )
    joints = np.concatenate([group.joints for group in groups])[back]
    return Execution(scenes, plan, tuple(groups), joints, outcome)


class Executor:
    """Stages of movements of a simulator that is at their starts, each a batch function from one record to the next."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator, self.arm = simulator, simulator.arm
        self._check_steps = round(CHECK_INTERVAL / simulator.timestep)
        self._settling_steps = round(SETTLING / simulator.timestep)

    def scale_time(self, movements: Movements) -> ScaledMovements:
        """Slow movements down where the arm's limits require it."""
        plan = movements.plan
        stretch, within = required_time_scale(self.arm, plan)
        scaled = Plan(plan.waypoints, plan.durations * stretch[:, None])
        duration = np.asarray(scaled.durations.sum(axis=-1))
        steps = np.ceil((duration + SETTLING) / self.simulator.timestep - 1e-9).astype(np.int64)
        sims = np.arange(len(steps))
        return ScaledMovements(sims, movements.scenes, scaled, stretch, within, duration, steps)

    def build_references(self, movements: ScaledMovements) -> TrackingReferences:
        """Sample one group of movements at the physics rate and compute the controls that track them."""
        trajectory, number = movements.plan.trajectory(), int(movements.steps.max())
        time = self.simulator.timestep * np.arange(number + 1)
        position, velocity, acceleration = trajectory.sample(time)
        # Reach and clearance are checked every few millimetres, up to where all movements have ended.
        every, scenes = self._check_steps, movements.scenes
        seen = position[:, : number - self._settling_steps + every + 1 : every]
        return TrackingReferences(
            movements=movements,
            planned=position[:, 1:],
            controls=self.arm.controls(position[:, :-1], velocity[:, :-1], acceleration[:, :-1]),
            reachable=(self.arm.reach_margin(seen) >= 0.0).all(axis=-1) & movements.within,
            jerk_cost=np.asarray(trajectory.cost()),
            clearance=self.simulator.collision_model.least_clearance(seen, scenes.obstacles, scenes.present),
        )

    def simulate(self, references: TrackingReferences) -> SimulatedMovements:
        """Run the physics of one group; arms whose plans leave their reach do not start."""
        run, sims, controls = references.reachable, references.movements.sims, references.controls
        if not run.all():
            sims, controls = sims[run], controls[run]
        return SimulatedMovements(references, self.simulator.rollout(sims, controls) if len(sims) else None)

    def measure(self, simulated: SimulatedMovements) -> MeasuredMovements:
        """Compute the metrics of one group."""
        references, log = simulated
        movements, run = references.movements, references.reachable
        scenes = movements.scenes
        if log is not None and run.all():
            done = self._measure_log(log, movements.steps, references.planned, scenes)
        else:
            done = self._at_rest(scenes)
            if log is not None:
                some = self._measure_log(log, movements.steps[run], references.planned[run], scenes.take(run))
                for mine, theirs in zip(done, some, strict=True):
                    mine[run] = theirs
        minimum_jerk_cost = straight_jerk_cost(norm(scenes.goal - scenes.start), movements.duration)
        outcome = Outcome(
            is_success=done.is_success,
            collision=done.collision,
            first_contact_time=done.first_contact_time,
            min_clearance=self._with_terminal_clearance(done, run, scenes),
            planned_clearance=references.clearance,
            goal_error=done.goal_error,
            duration=movements.duration,
            path_length=done.path_length,
            jerk_cost=references.jerk_cost,
            jerk_ratio=np.maximum(references.jerk_cost / minimum_jerk_cost, 1.0),
            peak_speed=done.peak_speed,
            tracking_error=done.tracking_error,
            reachable=run,
            unstable=done.unstable,
            stretch=movements.stretch,
        )
        return MeasuredMovements(simulated, done.joints, outcome)

    def rollout(self, execution: Execution, sim: int) -> Rollout:
        """Return the movement of one simulation, physics step by physics step."""
        references, log = next(
            group.simulated for group in execution.groups if sim in group.simulated.references.movements.sims
        )
        movements, run = references.movements, references.reachable
        row = int(np.flatnonzero(movements.sims == sim)[0])
        steps, scene = int(movements.steps[row]), execution.scenes.take([sim])
        joints = np.repeat(np.asarray(self.arm.inverse_kinematics(scene.start)), steps, axis=0)
        contact = np.zeros(steps, dtype=bool)
        if log is not None and run[row]:
            ran = int(run[:row].sum())
            joints, contact = log.joints[ran, :steps].copy(), log.contact[ran, :steps].copy()
        hand = np.asarray(self.arm.hand_position(joints))
        obstacles = np.repeat(scene.obstacles, steps, axis=0)
        present = np.repeat(scene.present, steps, axis=0)
        clearance = self.simulator.collision_model.least_clearance(
            hand[:, None], obstacles, present, joints[:, None]
        )
        time = np.asarray(np.arange(1, steps + 1) * self.simulator.timestep)
        return Rollout(time, references.planned[row, :steps].copy(), joints, hand, contact, clearance)

    def _measure_log(self, log: SimulationLog, steps: Int, planned: Float, scenes: Scenes) -> _Executed:
        """Measure n movements that ran, `steps` of whose T recorded steps belong to each."""
        after = np.arange(log.joints.shape[1]) >= steps[:, None]
        last = np.arange(len(steps)), steps - 1
        joints, contact = log.joints, log.contact
        if after.any():  # past its end, a movement stays where it ended
            joints, contact = np.where(after[..., None], joints[last][:, None], joints), contact & ~after
        hand = self._hand(log, joints, after, last)
        moved = norm(np.diff(hand, axis=1, prepend=scenes.start[:, None]))
        deviation = np.where(after, 0.0, squared_length(hand - planned))
        goal_error = norm(hand[last] - scenes.goal)
        collision = np.asarray(contact.any(axis=-1))
        at_rest = moved[last] < REST_SPEED * self.simulator.timestep
        kept = within_joint_range(joints, self.arm).all(axis=(1, 2))
        return _Executed(
            joints=joints[last],
            is_success=at_rest & (goal_error < GOAL_TOLERANCE) & ~collision & ~log.unstable & kept,
            collision=collision,
            first_contact_time=np.where(collision, contact.argmax(axis=-1) * self.simulator.timestep, -1.0),
            goal_error=goal_error,
            path_length=sum_in_order(moved),
            peak_speed=moved.max(axis=-1) / self.simulator.timestep,
            tracking_error=np.sqrt(sum_in_order(deviation) / steps),
            min_clearance=self._recorded_clearance(log, hand, joints, last[1], scenes),
            unstable=log.unstable,
        )

    def _at_rest(self, scenes: Scenes) -> _Executed:
        """Return the metrics of n arms that have stayed at rest at the start."""
        number = len(scenes.start)
        no, zero = np.zeros((3, number), dtype=bool), np.zeros((3, number))
        return _Executed(
            joints=np.asarray(self.arm.inverse_kinematics(scenes.start)),
            is_success=no[0],
            collision=no[1],
            first_contact_time=np.full(number, -1.0),
            min_clearance=np.full(number, MAX_CLEARANCE),
            goal_error=norm(scenes.goal - scenes.start),
            path_length=zero[0],
            peak_speed=zero[1],
            tracking_error=zero[2],
            unstable=no[2],
        )

    def _hand(self, log: SimulationLog, joints: Float, after: Bool, last: tuple[Int, Int]) -> Float:
        """Return the hand positions after each step, computed or as recorded.

        The physics records positions before each step, so the last one of each movement is computed.
        """
        if log.traced is None:
            return np.asarray(self.arm.hand_position(joints))
        hand = np.empty((*joints.shape[:2], 3))
        hand[:, :-1] = log.traced.places[:, 1:, log.traced.hand]
        hand[last] = self.arm.hand_position(joints[last])
        return np.where(after[..., None], hand[last][:, None], hand) if after.any() else hand

    def _recorded_clearance(
        self, log: SimulationLog, hand: Float, joints: Float, last: Int, scenes: Scenes
    ) -> Float:
        """Return the least clearance over all steps; of recorded links, over the states before each step."""
        model = self.simulator.collision_model
        if log.traced is None or not model.whole_arm:
            return model.least_clearance(hand, scenes.obstacles, scenes.present, joints)
        return nearest_approach(log.traced, self.arm.link_radii, scenes.obstacles, scenes.present, last)

    def _with_terminal_clearance(self, done: _Executed, run: Bool, scenes: Scenes) -> Float:
        """Return the least clearance including the state at the end, which records before each step lack.

        Arms whose plans leave their reach have their clearance at the start.
        """
        model = self.simulator.collision_model
        rows = np.flatnonzero(~run | (model.whole_arm and len(self.arm.traced) > 0))
        if not rows.size:
            return done.min_clearance
        least, scene = done.min_clearance.copy(), scenes.take(rows)
        end = model.least_clearance(
            scene.start[:, None], scene.obstacles, scene.present, done.joints[rows, None]
        )
        least[rows] = np.minimum(least[rows], end)
        return least


class _Executed(NamedTuple):
    """Metrics of n movements that only the physics decides, shape (n,) each, and their last joint angles (n, J)."""

    joints: Float
    is_success: Bool
    collision: Bool
    first_contact_time: Float
    min_clearance: Float
    goal_error: Float
    path_length: Float
    peak_speed: Float
    tracking_error: Float
    unstable: Bool
