"""Difficulty of scenes: the share of plans that solve them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.envs.mdp.task import Task
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import Trial
from viapoint.training.search.plan_checks import check_plans

CERTAIN_FAILURE = 0.002
"""Depth in an obstacle, or beyond the reach, at which a plan certainly fails, [m].

With the default durations plans are tracked within a fifth of a millimetre; much shorter ones are not. The error of
computed clearance is half a millimetre.
"""
CERTAIN_SUCCESS = 0.01
"""Least clearance and reach margin at which a plan in space certainly succeeds, [m].

There movements are slowed down to the arm's limits, so that plans are tracked within a millimetre, whatever their
duration: of 1,017 random plans with a margin over 2 mm none failed.
"""


class Screening(NamedTuple):
    """Outcomes that the plans of N actions determine without simulation, shape (N,) each."""

    fails: NDArray[np.bool_]
    """True where the movement certainly fails."""
    succeeds: NDArray[np.bool_]
    """True where the movement certainly succeeds; never in the plane, where it may be too fast to be tracked."""
    margin: Float
    """Minimum of clearance and reach margin of the plan, [m]."""


def screen(task: Task, scenes: Scenes, actions: Float) -> Screening:
    """Screen one action in each of N scenes by its plan."""
    joints = np.asarray(task.arm.inverse_kinematics(scenes.start))
    observation = task.observation.observe(joints, scenes.start, scenes)
    checks = check_plans(observation, actions[:, None], task)
    margin = np.minimum(checks.clearance, checks.reach_margin)[:, 0].astype(np.float64)
    in_space = task.whole_arm and task.arm.dimension == 3
    return Screening(margin < -CERTAIN_FAILURE, margin > (CERTAIN_SUCCESS if in_space else np.inf), margin)


FEW, MANY, ENOUGH = 512, 4096, 8
"""Draws for each scene; draws where fewer than ENOUGH of the first succeed."""


def solution_share(trial: Trial, scenes: Scenes, *, seed: int = 0) -> Float:
    """Return the fraction of uniformly random actions that succeed in simulation, shape (N,).

    The estimate is from FEW draws, or from MANY where fewer than ENOUGH of the first succeed. All scenes have the same
    actions. Actions that certainly fail or succeed are not simulated, see :func:`screen`.
    """
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, (MANY, trial.task.action.size))
    solved = _count(trial, scenes, draws[:FEW])
    share = solved / FEW
    rare = np.flatnonzero(solved < ENOUGH)
    if len(rare):
        share[rare] = (solved[rare] + _count(trial, scenes.take(rare), draws[FEW:])) / MANY
    return share


def planned_share(trial: Trial, scenes: Scenes, *, seed: int = 0, draws: int = 256) -> Float:
    """Return an estimate of the solution share from plans alone, shape (N,): fast, and slightly too high."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (draws, trial.task.action.size))
    number = len(scenes.start)
    every = scenes.take(np.repeat(np.arange(number), draws))
    return np.asarray(
        (screen(trial.task, every, np.tile(actions, (number, 1))).margin > 0.0).reshape(number, -1).mean(-1)
    )


def _count(trial: Trial, scenes: Scenes, draws: Float) -> NDArray[np.int64]:
    """Return the number of draws that solve each scene, shape (N,)."""
    number = len(scenes.start)
    solved = np.zeros(number, dtype=np.int64)
    open_rows, open_actions = [], []
    for some in np.split(draws, range(64, len(draws), 64)):
        rows, actions = np.repeat(np.arange(number), len(some)), np.tile(some, (number, 1))
        screening = screen(trial.task, scenes.take(rows), actions)
        solved += np.bincount(rows[screening.succeeds], minlength=number)
        open_ = ~(screening.fails | screening.succeeds)
        open_rows.append(rows[open_])
        open_actions.append(actions[open_])
    rows, actions = np.concatenate(open_rows), np.concatenate(open_actions)
    if len(rows):
        solved += np.bincount(rows[trial(scenes.take(rows), actions).success], minlength=number)
    return solved
