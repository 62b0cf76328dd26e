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

CERTAIN = 0.002
"""How deep a plan must cut into an obstacle, or leave the reach, to fail for certain, [m].

With the default durations plans are tracked within a fifth of a millimetre; much shorter ones are not. The clearance of
plans is right to half a millimetre.
"""
SURE = 0.01
"""Least clearance and reach margin of a plan in space that succeeds for certain, [m].

There movements are slowed down to what the arm's limits allow, so that plans are tracked within a millimetre, whatever
their duration: of 1,017 random plans with a margin over 2 mm none failed.
"""


class Screened(NamedTuple):
    """What the plans of N actions tell, shape (N,) each."""

    fails: NDArray[np.bool_]
    """Whether the movement fails for certain."""
    succeeds: NDArray[np.bool_]
    """Whether it succeeds for certain; in the plane, where it may be too fast to be tracked, this is not known."""
    merit: Float
    """Clearance or reach margin of the plan, whichever is less, [m]."""


def screen(task: Task, scenes: Scenes, actions: Float) -> Screened:
    """Look at the plans of one action in each of N scenes."""
    joints = np.asarray(task.arm.inverse_kinematics(scenes.start))
    observation = task.observation.observe(joints, scenes.start, scenes)
    checks = check_plans(observation, actions[:, None], task)
    merit = np.minimum(checks.clearance, checks.reach_margin)[:, 0].astype(np.float64)
    in_space = task.whole_arm and task.arm.dimension == 3
    return Screened(merit < -CERTAIN, merit > (SURE if in_space else np.inf), merit)


FEW, MANY, ENOUGH = 512, 4096, 8
"""Draws for each scene; draws where fewer than ENOUGH of the first succeeded."""


def solution_share(trial: Trial, scenes: Scenes, *, seed: int = 0) -> Float:
    """Fraction of uniformly random actions that succeed in simulation, shape (N,).

    From 512 draws, 4,096 where fewer than eight of them succeed. All scenes are tried with the same actions. Those
    that fail or succeed for certain are not simulated (see :mod:`viapoint.training.planners.difficulty`).
    """
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, (MANY, trial.task.action.size))
    solved = _count(trial, scenes, draws[:FEW])
    share = solved / FEW
    rare = np.flatnonzero(solved < ENOUGH)
    if len(rare):
        share[rare] = (solved[rare] + _count(trial, scenes.take(rare), draws[FEW:])) / MANY
    return share


def planned_share(trial: Trial, scenes: Scenes, *, seed: int = 0, draws: int = 256) -> Float:
    """An estimate of the solution share from plans alone, shape (N,): quick, and a little too high."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (draws, trial.task.action.size))
    number = len(scenes.start)
    every = scenes.take(np.repeat(np.arange(number), draws))
    return np.asarray(
        (screen(trial.task, every, np.tile(actions, (number, 1))).merit > 0.0).reshape(number, -1).mean(-1)
    )


def _count(trial: Trial, scenes: Scenes, draws: Float) -> NDArray[np.int64]:
    """How many of the draws solve each scene, shape (N,)."""
    number = len(scenes.start)
    solved = np.zeros(number, dtype=np.int64)
    open_rows, open_actions = [], []
    for some in np.split(draws, range(64, len(draws), 64)):
        rows, actions = np.repeat(np.arange(number), len(some)), np.tile(some, (number, 1))
        screened = screen(trial.task, scenes.take(rows), actions)
        solved += np.bincount(rows[screened.succeeds], minlength=number)
        open_ = ~(screened.fails | screened.succeeds)
        open_rows.append(rows[open_])
        open_actions.append(actions[open_])
    rows, actions = np.concatenate(open_rows), np.concatenate(open_actions)
    if len(rows):
        solved += np.bincount(rows[trial(scenes.take(rows), actions).success], minlength=number)
    return solved
