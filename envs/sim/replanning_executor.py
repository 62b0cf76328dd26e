"""Stages of decisions of different length under plans in motion: time scaling, references, physics and metrics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.actions.replanning import MovingPlan, timed
from viapoint.envs.actions.via_points import Motion
from viapoint.envs.arms.serial_arm import CONTROL_STRIDE
from viapoint.envs.common.arrays import put, take
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.sim.episode_state import Segment
from viapoint.envs.sim.executor import GROUP
from viapoint.envs.sim.outcome import sum_in_order
from viapoint.envs.sim.simulator import SimulationLog, Simulator
from viapoint.envs.sim.time_scaling import CHECK_INTERVAL, TimeScale, required_time_scale

PROLONGED, ENOUGH = 6, 1.002
"""Greatest number of times that a plan in motion is prolonged, and the remaining factor that needs no further one."""
SIMILAR, SLACK = 1.15, 4
"""Bounds of a group: its longest decision takes at most SIMILAR times the steps of its shortest, plus SLACK."""


def groups_of(steps: Int) -> list[Int]:
    """Return indices of decisions of similar length (n,), at most GROUP per group and in increasing order."""
    groups: list[list[int]] = []
    for index in np.argsort(steps, kind="stable"):
        shortest = steps[groups[-1][0]] if groups else 0
        if not groups or len(groups[-1]) == GROUP or steps[index] > SIMILAR * shortest + SLACK:
            groups.append([])
        groups[-1].append(int(index))
    return [np.sort(np.array(group)) for group in groups]


class Decisions(NamedTuple):
    """Parts of plans that n simulations execute in one decision."""

    rows: Int
    """Simulations in increasing order, shape (n,)."""
    plan: MovingPlan
    """Plans under way."""
    since: Int
    """Physics steps since each plan began, shape (n,)."""
    now: Int
    """Physics steps since each episode began, shape (n,)."""
    steps: Int
    """Physics steps of the decision, shape (n,)."""
    scenes: ChangingScenes
    """Scenes of the episodes."""

    def groups(self) -> list[Decisions]:
        """Return groups of decisions of similar length; decisions without steps are left out."""
        some = np.flatnonzero(self.steps > 0)
        return [take(self, some[group]) for group in groups_of(self.steps[some])]


class DecisionReferences(NamedTuple):
    """References of one group at the physics rate."""

    decisions: Decisions
    """Decisions of the group."""
    planned: Float
    """Commanded hand position after each step, shape (n, T, D), [m]."""
    controls: Float
    """Actuator controls, shape (n, T, U)."""
    places: Float
    """Centres of the obstacles before each step, NaN for absent ones, shape (n, T, rows, D), [m]."""
    clearance: Float
    """Least clearance of the commanded path, shape (n,), [m]."""
    jerk_cost: Float
    """Jerk cost of the commanded path, shape (n,), [m^2/s^5]."""


class ReplanningExecutor:
    """Stages of decisions, each a batch function from one record to the next."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator, self.arm = simulator, simulator.arm

    def scale_time(self, plan: MovingPlan) -> tuple[MovingPlan, TimeScale]:
        """Return plans that are as slow as the arm's limits require, and their time scaling.

        Scaling the time of a plan that begins in motion would change its initial velocity. Its total duration is
        prolonged instead, which changes its path, and prolonged again where that is not enough.
        """
        stretch, within = required_time_scale(self.arm, plan)
        slower = MovingPlan(plan.waypoints, plan.durations * stretch[:, None], *plan[2:])
        moving = ((plan.velocity != 0.0) | (plan.acceleration != 0.0)).any(axis=-1)
        rows = np.flatnonzero(moving & (stretch > 1.0))
        for _ in range(PROLONGED):
            if not rows.size:
                break
            state = Motion(plan.waypoints[rows, 0], plan.velocity[rows], plan.acceleration[rows])
            put(slower, rows, timed(plan.waypoints[rows], slower.duration[rows], state))
            again = required_time_scale(self.arm, take(slower, rows)).stretch
            rows, again = rows[again > ENOUGH], again[again > ENOUGH]
            stretch[rows] *= again
            slower.durations[rows] *= again[:, None]
        return slower, TimeScale(stretch, within & self._reachable(slower))

    def build_references(self, decisions: Decisions) -> DecisionReferences:
        """Sample one group at the physics rate and compute the controls that track the plans."""
        _, plan, since, now, steps, scenes = decisions
        timestep, number = self.simulator.timestep, int(steps.max())
        # A few steps more than needed, so that the last controls do not depend on the longest decision of the group.
        index = np.arange(number + CONTROL_STRIDE + 1)
        position, velocity, acceleration = plan.trajectory().sample(timestep * (since[:, None] + index))
        controls = self.arm.controls(position[:, :-1], velocity[:, :-1], acceleration[:, :-1])[:, :number]
        rows = scenes.places(np.asarray(timestep * (now[:, None] + np.arange(number + 1))))
        looks = np.arange(0, number + 1, max(round(CHECK_INTERVAL / timestep), 1))
        profile = self.simulator.collision_model.clearance_profile(
            position[:, looks], rows[:, looks], scenes.present
        ).min(axis=-1, initial=MAX_CLEARANCE)
        present = scenes.present[:, None, :, None]
        return DecisionReferences(
            decisions=decisions,
            planned=position[:, 1 : number + 1],
            controls=controls,
            places=np.where(present, rows[:, :number, :, : self.arm.dimension], np.nan),
            clearance=np.where(looks <= steps[:, None], profile, MAX_CLEARANCE).min(axis=-1),
            jerk_cost=jerk_cost_between(
                plan, np.asarray(timestep * since), np.asarray(timestep * (since + steps))
            ),
        )

    def simulate(self, references: DecisionReferences) -> SimulationLog:
        """Run the physics of one group among moving obstacles."""
        decisions = references.decisions
        return self.simulator.rollout_among_moving(
            decisions.rows, references.controls, references.places, decisions.steps
        )

    def measure(self, references: DecisionReferences, log: SimulationLog) -> Segment:
        """Measure one group; a decision ends with the first contact."""
        rows, _, _, now, steps, scenes = references.decisions
        touched = log.contact & (np.arange(log.contact.shape[1]) < steps[:, None])
        steps = np.where(touched.any(axis=-1), touched.argmax(axis=-1) + 1, steps)
        number = int(steps.max())
        joints = log.joints[:, :number]
        hand = np.asarray(self.arm.hand_position(joints))
        return Segment(
            rows=rows,
            steps=steps,
            planned=references.planned[:, :number],
            joints=joints,
            hand=hand,
            contact=log.contact[:, :number],
            unstable=log.unstable,
            min_clearance=self._clearance(scenes, now, steps, hand, joints),
            planned_clearance=references.clearance,
            jerk_cost=references.jerk_cost,
        )

    def _reachable(self, plan: MovingPlan) -> Bool:
        """Return True for plans within the arm's reach, shape (N,)."""
        every = np.arange(int(np.ceil(plan.duration.max() / CHECK_INTERVAL)) + 1) * CHECK_INTERVAL
        return np.asarray((np.asarray(self.arm.reach_margin(plan.trajectory()(every))) >= 0.0).all(axis=-1))

    def _clearance(self, scenes: ChangingScenes, now: Int, steps: Int, hand: Float, joints: Float) -> Float:
        """Return the least clearance of the arm in one decision, shape (n,), [m]."""
        if not scenes.obstacles.shape[1]:
            return np.full(len(now), MAX_CLEARANCE)
        index = np.arange(1, hand.shape[1] + 1)
        time = np.asarray(self.simulator.timestep * (now[:, None] + index))
        profile = self.simulator.collision_model.clearance_profile(
            hand, scenes.places(time), scenes.present, joints
        ).min(axis=-1)
        return np.asarray(np.where(index <= steps[:, None], profile, MAX_CLEARANCE).min(axis=-1))


def jerk_cost_between(plan: MovingPlan, begin: Float, end: Float) -> Float:
    """Return half the integral of the squared jerk between two times, shape (N,), [m^2/s^5].

    On each segment the jerk is a parabola of time, so its square has degree four: three Gauss-Legendre nodes are exact.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3)
    knots = np.concatenate((np.zeros_like(begin)[:, None], np.cumsum(plan.durations, axis=-1)), axis=-1)
    low = np.clip(begin[:, None], knots[:, :-1], knots[:, 1:])
    half = 0.5 * (np.clip(end[:, None], knots[:, :-1], knots[:, 1:]) - low)
    times = low[..., None] + half[..., None] * (1.0 + nodes)
    jerk = plan.trajectory()(times.reshape(len(times), -1), 3)
    square = (jerk * jerk).sum(axis=-1).reshape(times.shape)
    return 0.5 * sum_in_order((square * weights * half[..., None]).reshape(len(times), -1))
