"""Carrying out what decisions of different length make of plans, in groups of similar length."""

from __future__ import annotations

from typing import Any

import numpy as np

from viapoint.envs.actions.replanning import MovingPlan, timed
from viapoint.envs.actions.velocity import Motion
from viapoint.envs.arms.serial_arm import CONTROL_STRIDE
from viapoint.envs.common.background_worker import BackgroundWorker
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.sim.executor import GROUP
from viapoint.envs.sim.replanning_episodes import DecisionRollout, jerk_cost_between
from viapoint.envs.sim.simulator import Simulator
from viapoint.envs.sim.time_scaling import LOOK_EVERY, pace_of

PROLONGED, ENOUGH = 6, 1.002
"""How often the time of a plan in motion is prolonged at most, and by which factor it need not be once more."""
SIMILAR, SLACK = 1.15, 4
"""A group's longest decision takes at most that many times the steps of its shortest, and so many more."""


def groups_of(steps: Int) -> list[Int]:
    """Indices of decisions of similar length, at most GROUP each and in increasing order.

    Args:
        steps: Physics steps of each, shape (n,).
    """
    groups: list[list[int]] = []
    for index in np.argsort(steps, kind="stable"):
        shortest = steps[groups[-1][0]] if groups else 0
        if not groups or len(groups[-1]) == GROUP or steps[index] > SIMILAR * shortest + SLACK:
            groups.append([])
        groups[-1].append(int(index))
    return [np.sort(np.array(group)) for group in groups]


class OnlineExecutor:
    """Carries out parts of plans in a simulator.

    Args:
        simulator: Of the arm.
        beside: For the work that need not wait for the physics.
    """

    def __init__(self, simulator: Simulator, beside: BackgroundWorker) -> None:
        self.simulator, self.arm = simulator, simulator.arm
        self._beside = beside

    def paced(self, plan: MovingPlan) -> tuple[MovingPlan, Float, Bool]:
        """Plans made as slow as the arm's limits ask for, by which factor, and which keep within reach, shape (N,).

        One that begins in motion cannot be stretched without a jump of its velocity: its whole time is prolonged, and
        again where that is not enough.
        """
        stretch, within = pace_of(self.arm, plan)
        slower = MovingPlan(plan.waypoints, plan.durations * stretch[:, None], *plan[2:])
        moving = ((plan.velocity != 0.0) | (plan.acceleration != 0.0)).any(axis=-1)
        rows = np.flatnonzero(moving & (stretch > 1.0))
        for _ in range(PROLONGED):
            if not rows.size:
                break
            state = Motion(plan.waypoints[rows, 0], plan.velocity[rows], plan.acceleration[rows])
            slower.put(rows, timed(plan.waypoints[rows], slower.duration[rows], state))
            again = pace_of(self.arm, slower.take(rows)).stretch
            rows, again = rows[again > ENOUGH], again[again > ENOUGH]
            stretch[rows] *= again
            slower.durations[rows] *= again[:, None]
        return slower, stretch, within

    def reachable(self, plan: MovingPlan) -> Bool:
        """Which plans stay within the arm's reach, shape (N,)."""
        every = np.arange(int(np.ceil(plan.duration.max() / LOOK_EVERY)) + 1) * LOOK_EVERY
        return np.asarray((np.asarray(self.arm.reach_margin(plan.trajectory()(every))) >= 0.0).all(axis=-1))

    def __call__(
        self, plan: MovingPlan, began: Int, now: Int, until: Int, scenes: ChangingScenes
    ) -> list[DecisionRollout]:
        """Carry out plans from one physics step of the episode to another, in each of N simulations.

        Those with nothing to do, `until` being `now`, are left alone.

        Args:
            plan: Under way, N of them.
            began: Physics step at which each began, shape (N,).
            now: Physics step at present, shape (N,).
            until: Before which physics step the decision ends, shape (N,).
            scenes: N of them.
        """
        rows = np.flatnonzero(until > now)
        groups = [rows[group] for group in groups_of((until - now)[rows])]
        beside = self._beside.submit if len(groups) > 1 else BackgroundWorker(threaded=False).submit
        referred = [
            beside(
                self._compute_references,
                plan.take(g),
                (now - began)[g],
                now[g],
                (until - now)[g],
                scenes.take(g),
            )
            for g in groups
        ]
        return [self._simulated(g, *each.result()) for g, each in zip(groups, referred, strict=True)]

    def _compute_references(
        self, plan: MovingPlan, since: Int, now: Int, steps: Int, scenes: ChangingScenes
    ) -> tuple[Int, Float, Float, Float, Float, Float]:
        """Steps, positions, controls, places of obstacles, clearance and jerk cost of one group."""
        timestep, number = self.simulator.timestep, int(steps.max())
        # A few steps more than needed, so that the controls of the last ones do not depend on the group's longest.
        index = np.arange(number + CONTROL_STRIDE + 1)
        position, velocity, acceleration = plan.trajectory().sample(timestep * (since[:, None] + index))
        controls = self.arm.controls(position[:, :-1], velocity[:, :-1], acceleration[:, :-1])[:, :number]
        rows = scenes.places(np.asarray(timestep * (now[:, None] + np.arange(number + 1))))
        looks = np.arange(0, number + 1, max(round(LOOK_EVERY / timestep), 1))
        profile = self.simulator.collision_model.clearance_profile(
            position[:, looks], rows[:, looks], scenes.present
        ).min(axis=-1, initial=MAX_CLEARANCE)
        clearance = np.where(looks <= steps[:, None], profile, MAX_CLEARANCE).min(axis=-1)
        cost = jerk_cost_between(plan, np.asarray(timestep * since), np.asarray(timestep * (since + steps)))
        present = scenes.present[:, None, :, None]
        places = np.where(present, rows[:, :number, :, : self.arm.dimension], np.nan)
        return steps, position[:, 1 : number + 1], controls, places, clearance, cost

    def _simulated(
        self,
        sims: Int,
        steps: Int,
        planned: Float,
        controls: Float,
        places: Float,
        clearance: Float,
        cost: Float,
    ) -> DecisionRollout:
        record: Any = self.simulator.rollout_among_moving(sims, controls, places, steps)
        touched = record.contact & (np.arange(planned.shape[1]) < steps[:, None])
        until = np.where(touched.any(axis=-1), touched.argmax(axis=-1) + 1, steps)
        return DecisionRollout(sims, until, planned, clearance, cost, record)
