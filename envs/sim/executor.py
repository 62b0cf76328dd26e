"""Stages of whole movements: time scaling, references, physics and metrics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.arrays import norm, put, take
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.geometry.narrow_phase import nearest_approach
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.episode_state import EpisodeState, Segment
from viapoint.envs.sim.outcome import GOAL_TOLERANCE, REST_SPEED, SETTLING, Outcome, straight_jerk_cost
from viapoint.envs.sim.simulator import SimulationLog, Simulator
from viapoint.envs.sim.time_scaling import CHECK_INTERVAL, TimeScale, required_time_scale

GROUP = 64
"""Movements of one group: few enough for the processor's cache, many enough for the engine's threads."""


class ScaledMovements(NamedTuple):
    """Movements that are slow enough for the arm, N of them or a group."""

    sims: Int
    """Simulations in increasing order, shape (n,)."""
    scenes: Scenes
    """Scenes that they take place in."""
    plan: Plan
    """Via-points and scaled durations."""
    scale: TimeScale
    """Time scaling of each movement."""
    duration: Float
    """Scaled total duration, shape (n,), [s]."""
    steps: Int
    """Physics steps including the settling time, shape (n,)."""

    def groups(self) -> list[ScaledMovements]:
        """Return groups of at most GROUP movements of similar length, so that short movements take fewer steps."""
        if len(self.sims) <= GROUP:
            return [self]
        order = np.argsort(self.steps, kind="stable")
        return [take(self, np.sort(order[first : first + GROUP])) for first in range(0, len(order), GROUP)]


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


class MeasuredMovements(NamedTuple):
    """Movements of one group with their metrics."""

    references: TrackingReferences
    """References that the arm tracked."""
    log: SimulationLog | None
    """Recorded physics of the reachable movements; None if there are none."""
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
    groups: list[MeasuredMovements]
    """Groups that were simulated together."""
    joints: Float
    """Joint angles at the end, shape (N, J), [rad]."""
    outcome: Outcome
    """Metrics."""


def join_groups(scenes: Scenes, plan: Plan, groups: list[MeasuredMovements]) -> Execution:
    """Return the executed movements of all groups, in the order of the simulations."""
    if len(groups) == 1:
        return Execution(scenes, plan, groups, groups[0].joints, groups[0].outcome)
    back = np.argsort(np.concatenate([group.references.movements.sims for group in groups]))
    outcome = Outcome(
        *(np.concatenate(parts)[back] for parts in zip(*(g.outcome for g in groups), strict=True))
    )
    joints = np.concatenate([group.joints for group in groups])[back]
    return Execution(scenes, plan, groups, joints, outcome)


class Executor:
    """Stages of movements of a simulator that is at their starts, each a batch function from one record to the next."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator, self.arm = simulator, simulator.arm
        self._check_steps = round(CHECK_INTERVAL / simulator.timestep)
        self._settling_steps = round(SETTLING / simulator.timestep)

    def scale_time(self, scenes: Scenes, plan: Plan) -> ScaledMovements:
        """Slow movements down where the arm's limits require it."""
        scale = required_time_scale(self.arm, plan)
        scaled = Plan(plan.waypoints, plan.durations * scale.stretch[:, None])
        duration = np.asarray(scaled.durations.sum(axis=-1))
        steps = np.ceil((duration + SETTLING) / self.simulator.timestep - 1e-9).astype(np.int64)
        sims = np.arange(len(steps))
        return ScaledMovements(sims, scenes, scaled, scale, duration, steps)

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
            reachable=(self.arm.reach_margin(seen) >= 0.0).all(axis=-1) & movements.scale.within,
            jerk_cost=np.asarray(trajectory.cost()),
            clearance=self.simulator.collision_model.least_clearance(seen, scenes.obstacles, scenes.present),
        )

    def simulate(self, references: TrackingReferences) -> SimulationLog | None:
        """Run the physics of one group; arms whose plans leave their reach do not start."""
        run, sims, controls = references.reachable, references.movements.sims, references.controls
        if not run.all():
            sims, controls = sims[run], controls[run]
        return self.simulator.rollout(sims, controls) if len(sims) else None

    def measure(self, references: TrackingReferences, log: SimulationLog | None) -> MeasuredMovements:
        """Compute the metrics of one group."""
        movements, run = references.movements, references.reachable
        scenes = movements.scenes
        if log is not None and run.all():
            state = self._measure_log(log, movements.steps, references.planned, scenes)
        else:
            joints = np.asarray(self.arm.inverse_kinematics(scenes.start))
            state = EpisodeState.at_rest(joints, scenes.start, np.full(len(run), MAX_CLEARANCE))
            if log is not None:
                steps, planned = movements.steps[run], references.planned[run]
                put(state, run, self._measure_log(log, steps, planned, scenes.take(run)))
        state = state._replace(
            min_clearance=self._with_terminal_clearance(state, run, scenes),
            planned_clearance=references.clearance,
            jerk_cost=references.jerk_cost,
            stretch=movements.scale.stretch,
            reachable=run,
        )
        goal_error, distance = norm(state.hand - scenes.goal), norm(scenes.goal - scenes.start)
        cost = straight_jerk_cost(distance, movements.duration)
        success = (state.last_speed < REST_SPEED) & (goal_error < GOAL_TOLERANCE) & state.sound
        timestep = self.simulator.timestep
        outcome = state.outcome(success, goal_error, movements.duration, cost, timestep)
        return MeasuredMovements(references, log, state.joints, outcome)

    def recorded(self, execution: Execution, sim: int) -> tuple[Float, Float, Bool]:
        """Return planned positions, joint angles and contacts of one simulation, one for each physics step."""
        references, log, *_ = next(
            group for group in execution.groups if sim in group.references.movements.sims
        )
        movements, run = references.movements, references.reachable
        row = int(np.flatnonzero(movements.sims == sim)[0])
        steps, start = int(movements.steps[row]), execution.scenes.start[[sim]]
        joints = np.repeat(np.asarray(self.arm.inverse_kinematics(start)), steps, axis=0)
        contact = np.zeros(steps, dtype=bool)
        if log is not None and run[row]:
            ran = int(run[:row].sum())
            joints, contact = log.joints[ran, :steps].copy(), log.contact[ran, :steps].copy()
        return references.planned[row, :steps].copy(), joints, contact

    def _measure_log(self, log: SimulationLog, steps: Int, planned: Float, scenes: Scenes) -> EpisodeState:
        """Measure n movements that ran, `steps` of whose T recorded steps belong to each."""
        after = np.arange(log.joints.shape[1]) >= steps[:, None]
        last = np.arange(len(steps)), steps - 1
        joints, none = log.joints, np.zeros(len(steps))
        if after.any():  # past its end, a movement stays where it ended
            joints = np.where(after[..., None], joints[last][:, None], joints)
        hand = self._hand(log, joints, after, last)
        clearance = self._recorded_clearance(log, hand, joints, last[1], scenes)
        start = EpisodeState.at_rest(joints[:, 0], scenes.start, np.full(len(steps), MAX_CLEARANCE))
        segment = Segment(
            rows=last[0], steps=steps, planned=planned, joints=joints, hand=hand, contact=log.contact,
            unstable=log.unstable, min_clearance=clearance, planned_clearance=none, jerk_cost=none,
        )  # fmt: skip
        return start.advanced(segment, self.arm, self.simulator.timestep)[0]

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

    def _with_terminal_clearance(self, state: EpisodeState, run: Bool, scenes: Scenes) -> Float:
        """Return the least clearance including the state at the end, which records before each step lack.

        Arms whose plans leave their reach have their clearance at the start.
        """
        model = self.simulator.collision_model
        rows = np.flatnonzero(~run | (model.whole_arm and len(self.arm.traced) > 0))
        if not rows.size:
            return state.min_clearance
        least, scene = state.min_clearance.copy(), scenes.take(rows)
        end = model.least_clearance(
            scene.start[:, None], scene.obstacles, scene.present, state.joints[rows, None]
        )
        least[rows] = np.minimum(least[rows], end)
        return least
