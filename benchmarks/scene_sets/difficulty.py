"""Difficulty of scenes: the share of plans that solve them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.planning.cma_planner import screen
from viapoint.training.rollouts.rollout import SceneSimulation

FEW, MANY, ENOUGH = 512, 4096, 8
"""Draws for each scene; draws where fewer than ENOUGH of the first succeed."""


def solution_share(simulation: SceneSimulation, scenes: Scenes, *, seed: int = 0) -> Float:
    """Return the fraction of uniformly random actions that succeed in simulation, shape (N,).

    The estimate is from FEW draws, or from MANY where fewer than ENOUGH of the first succeed. All scenes have the same
    actions. Actions that certainly fail or succeed are not simulated, see :func:`screen`.
    """
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, (MANY, simulation.task.action.size))
    solved = _count(simulation, scenes, draws[:FEW])
    share = solved / FEW
    rare = np.flatnonzero(solved < ENOUGH)
    if len(rare):
        share[rare] = (solved[rare] + _count(simulation, scenes.take(rare), draws[FEW:])) / MANY
    return share


def planned_share(simulation: SceneSimulation, scenes: Scenes, *, seed: int = 0, draws: int = 256) -> Float:
    """Return an estimate of the solution share from plans alone, shape (N,): fast, and slightly too high."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (draws, simulation.task.action.size))
    number = len(scenes.start)
    every = scenes.take(np.repeat(np.arange(number), draws))
    return np.asarray(
        (screen(simulation.task, every, np.tile(actions, (number, 1))).margin > 0.0)
        .reshape(number, -1)
        .mean(-1)
    )


def _count(simulation: SceneSimulation, scenes: Scenes, draws: Float) -> NDArray[np.int64]:
    """Return the number of draws that solve each scene, shape (N,)."""
    number = len(scenes.start)
    solved = np.zeros(number, dtype=np.int64)
    open_rows, open_actions = [], []
    for some in np.split(draws, range(64, len(draws), 64)):
        rows, actions = np.repeat(np.arange(number), len(some)), np.tile(some, (number, 1))
        screening = screen(simulation.task, scenes.take(rows), actions)
        solved += np.bincount(rows[screening.succeeds], minlength=number)
        open_ = ~(screening.fails | screening.succeeds)
        open_rows.append(rows[open_])
        open_actions.append(actions[open_])
    rows, actions = np.concatenate(open_rows), np.concatenate(open_actions)
    if len(rows):
        solved += np.bincount(rows[simulation(scenes.take(rows), actions).success], minlength=number)
    return solved
