"""How hard a scene is: the share of random actions that solve it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.scenes import Scenes
from viapoint.training.screening import screen
from viapoint.training.trial import Trial

Float = NDArray[np.float64]

FEW, MANY, ENOUGH = 512, 4096, 8
"""Draws for each scene; draws where fewer than ENOUGH of the first succeeded."""


def solution_share(trial: Trial, scenes: Scenes, *, seed: int = 0) -> Float:
    """Fraction of uniformly random actions that succeed in simulation, shape (N,).

    From 512 draws, 4,096 where fewer than eight of them succeed. All scenes are tried with the same actions. Those
    that fail or succeed for certain are not simulated (see :mod:`viapoint.training.screening`).
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
