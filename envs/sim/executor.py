"""Carrying plans out: references, controls, physics, outcome."""

from __future__ import annotations

from concurrent.futures import Future
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.background_worker import BackgroundWorker
from viapoint.envs.common.types import Float
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Outcome, add_terminal_metrics, empty_outcome, measure
from viapoint.envs.sim.simulator import SimulationLog, Simulator
from viapoint.envs.sim.time_scaling import LOOK_EVERY, pace_of

SETTLING = 0.1
"""Time after the movement in which the hand must come to rest, [s]."""
GROUP = 64
"""Movements carried out together: few enough for the cache, many enough for the threads."""


class Rollout(NamedTuple):
    """One movement at its T physics steps."""

    time: Float
    """Shape (T,), [s]."""
    planned: Float
    """Hand positions of the plan, shape (T, D), [m]."""
    joints: Float
    """Shape (T, J), [rad]."""
    hand: Float
    """Shape (T, D), [m]."""
    contact: NDArray[np.bool_]
    """Whether the arm touched an obstacle at the state before the step, shape (T,)."""
    clearance: Float
    """From the nearest obstacle, shape (T,), [m]."""


class TrackingReferences(NamedTuple):
    """Plans of one group at the physics rate, ready for the arm."""

    sims: NDArray[np.int64]
    """The simulations in increasing order, shape (n,)."""
    rows: slice | NDArray[np.int64]
    """The same as an index; all of them are a slice, which copies nothing."""
    steps: NDArray[np.int64]
    """Physics steps of each, shape (n,)."""
    planned: Float
    """Hand position after each step, shape (n, T, D), [m]."""
    controls: Float
    """Shape (n, T, U)."""
    reachable: NDArray[np.bool_]
    """Shape (n,)."""
    jerk_cost: Float
    """Shape (n,), [m^2/s^5]."""
    clearance: Float
    """Of the plan, shape (n,), [m]."""


class PendingExecution(NamedTuple):
    """Plans of N movements whose references are being computed."""

    plan: Plan
    """As decided."""
    scenes: Scenes
    """Where they take place."""
    duration: Float
    """Shape (N,), [s]."""
    stretch: Float
    """By which factor each was slowed down, shape (N,)."""
    referred: list[Future[TrackingReferences]]
    """Of the groups."""
    beside: BackgroundWorker
    """Where they are computed, and outcomes measured."""


class Executor:
    """Carries out plans in a simulator, in groups of similar length so that short movements cost less."""

    def __init__(self, simulator: Simulator, beside: BackgroundWorker) -> None:
        self.simulator = simulator
        self.arm = simulator.arm
        self.collision_model = simulator.collision_model
        self._beside = beside
        self._groups: list[TrackingReferences] = []
        self._records: list[SimulationLog | None] = []
        self.final_joints = np.zeros((0, len(self.arm.joint_range)))
        """Where the arms ended, shape (N, J), [rad]."""

    def __call__(self, plan: Plan, scenes: Scenes) -> Outcome:
        """Carry out one plan in each simulation, which must have been placed at its start."""
        return self.execute(self.prepare(plan, scenes))

    def prepare(self, plan: Plan, scenes: Scenes) -> PendingExecution:
        """Stretch plans for the arm's limits and have their references computed beside what comes next."""
        stretch, within = pace_of(self.arm, plan)
        paced = Plan(plan.waypoints, plan.durations * stretch[:, None])
        duration = np.asarray(paced.durations.sum(axis=-1))
        steps = np.ceil((duration + SETTLING) / self.simulator.timestep - 1e-9).astype(np.int64)
        order = np.argsort(steps, kind="stable")
        groups = [np.sort(order[i : i + GROUP]) for i in range(0, len(order), GROUP)]
        beside = self._beside if len(groups) > 1 else BackgroundWorker(threaded=False)
        referred = [
            beside.submit(self._compute_references, steps, paced, scenes, within, sims) for sims in groups
        ]
        return PendingExecution(plan, scenes, duration, stretch, referred, beside)

    def execute(self, prepared: PendingExecution) -> Outcome:
        """Run the physics, measuring each group of movements beside the next ones."""
        _, scenes, duration, stretch, referred, beside = prepared
        self._groups, self._records, measured = [], [], []
        for reference in referred:
            self._groups.append(reference.result())
            self._records.append(self._simulate(self._groups[-1]))
            measured.append(beside.submit(self._measure, len(self._groups) - 1, scenes))
        outcomes = [outcome.result() for outcome in measured]
        together = outcomes[0] if len(referred) == 1 else empty_outcome(len(duration))
        for group, outcome in zip(self._groups, outcomes, strict=True) if len(referred) > 1 else ():
            for mine, theirs in zip(together, outcome, strict=True):
                mine[group.sims] = theirs
        self.final_joints = self._final_joints(scenes)
        together = add_terminal_metrics(together, self.final_joints, scenes, self.collision_model)
        straight = 360.0 * norm(scenes.goal - scenes.start) ** 2 / duration**5  # half of 720 A^2/T^5
        jerk_ratio = np.maximum(together.jerk_cost / straight, 1.0)
        return together._replace(duration=duration, jerk_ratio=jerk_ratio, stretch=stretch)

    def rollout(self, sim: int, scenes: Scenes) -> Rollout:
        """The last movement of one simulation, step by step; `scenes` are those it took place in."""
        index = next(i for i, group in enumerate(self._groups) if sim in group.sims)
        group, record = self._groups[index], self._records[index]
        row = int(np.flatnonzero(group.sims == sim)[0])
        steps, scene = int(group.steps[row]), scenes.take([sim])
        joints = np.repeat(np.asarray(self.arm.inverse_kinematics(scene.start)), steps, axis=0)
        contact = np.zeros(steps, dtype=bool)
        if record is not None and group.reachable[row]:
            ran = int(group.reachable[:row].sum())
            joints, contact = record.joints[ran, :steps].copy(), record.contact[ran, :steps].copy()
        hand = np.asarray(self.arm.hand_position(joints))
        each = Scenes(*(np.repeat(field, steps, axis=0) for field in scene))
        clearance = self.collision_model.least_clearance(
            hand[:, None], each.obstacles, each.present, joints[:, None]
        )
        time = np.arange(1, steps + 1) * float(self.simulator.timestep)
        return Rollout(np.asarray(time), group.planned[row, :steps].copy(), joints, hand, contact, clearance)

    def _compute_references(
        self,
        steps: NDArray[np.int64],
        plan: Plan,
        scenes: Scenes,
        within: NDArray[np.bool_],
        sims: NDArray[np.int64],
    ) -> TrackingReferences:
        """References at the physics rate, and the controls that follow them, for one group."""
        rows = slice(None) if len(sims) == len(steps) else sims
        trajectory = plan.take(rows).trajectory()
        time = self.simulator.timestep * np.arange(steps[rows].max() + 1)
        position, velocity, acceleration = trajectory.sample(time)
        every, settling = (round(span / self.simulator.timestep) for span in (LOOK_EVERY, SETTLING))
        seen = position[:, : steps[rows].max() - settling + every + 1 : every]  # up to where all have ended
        return TrackingReferences(
            sims=sims,
            rows=rows,
            steps=steps[rows],
            planned=position[:, 1:],
            controls=self.arm.controls(position[:, :-1], velocity[:, :-1], acceleration[:, :-1]),
            reachable=(self.arm.reach_margin(seen) >= 0.0).all(axis=-1) & within[rows],
            jerk_cost=np.asarray(trajectory.cost()),
            clearance=self.collision_model.least_clearance(
                seen, scenes.obstacles[rows], scenes.present[rows]
            ),
        )

    def _final_joints(self, scenes: Scenes) -> Float:
        joints = np.asarray(self.arm.inverse_kinematics(scenes.start))
        for group, record in zip(self._groups, self._records, strict=True):
            if record is not None:
                run = group.reachable
                joints[group.sims[run]] = record.joints[np.arange(run.sum()), group.steps[run] - 1]
        return joints

    def _simulate(self, group: TrackingReferences) -> SimulationLog | None:
        run = group.reachable
        if run.all():
            return self.simulator.rollout(group.sims, group.controls)
        return self.simulator.rollout(group.sims[run], group.controls[run]) if run.any() else None

    def _measure(self, index: int, scenes: Scenes) -> Outcome:
        """The outcome of one group, but for duration, jerk ratio and what :func:`add_terminal_metrics` adds."""
        group, record = self._groups[index], self._records[index]
        run: slice | NDArray[np.bool_] = slice(None) if group.reachable.all() else group.reachable
        outcome = empty_outcome(len(group.sims))
        if record is not None:
            done = measure(
                record,
                group.steps[run],
                group.planned[run],
                scenes.take(group.rows).take(run),
                self.collision_model,
                timestep=self.simulator.timestep,
            )
            for mine, theirs in zip(outcome, done, strict=True):
                mine[run] = theirs
        return outcome._replace(jerk_cost=group.jerk_cost, planned_clearance=group.clearance)
