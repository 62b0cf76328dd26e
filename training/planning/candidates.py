"""Candidate actions that cover the action space evenly, the same ones in every scene."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from viapoint.envs.common.arrays import Single
from viapoint.envs.task import Task

MOST_CANDIDATES = 1 << 16  # Greatest number of candidates of one decision; usual are up to 4096
MOST_ROUNDS = 64  # Greatest number of rounds of refinement; usual are up to 4


def candidate_actions(task: Task, number: int, *, replanning: bool) -> Single:
    """Return candidate actions, shape (number, m), of which the first is the zero action.

    From rest, clearance and reach do not depend on the duration, and all others have that of the greatest reward. With
    `replanning`, a movement may be under way; then they differ in their duration, too.
    """
    size, at = task.action.size, task.n_via * task.action.dimension
    if replanning or not at:
        return sobol_actions(number, size)
    return sobol_actions(number, size, at, best_duration(task))


def best_duration(task: Task) -> float:
    """Return the duration component of the greatest reward of a straight movement.

    With T relative to the duration of the zero action, the reward depends on it by

        - w_smoothness log(1 + T^-5) - w_duration T,

    as the jerk cost of a path scales with T^-5.
    """
    component = np.linspace(-1.0, 1.0, 401)
    relative = np.exp(component * task.action.log_half_range)
    weights = task.weights
    reward = -weights.smoothness * np.log1p(relative**-5.0) - weights.duration * relative
    return float(component[reward.argmax()])


@functools.cache
def sobol_actions(number: int, size: int, fixed: int | None = None, value: float = 0.0) -> Single:
    """Return the zero action and points of the Sobol sequence in [-1, 1]^size, shape (number, size).

    With `fixed`, the index of a component, it has the same value in all points.
    """
    import torch

    quasirandom: Any = torch.quasirandom
    engine = quasirandom.SobolEngine(size if fixed is None else size - 1)
    engine.fast_forward(2)  # the first points are a corner of the cube and its middle
    points = 2.0 * engine.draw(max(number - 1, 1)).numpy()[: number - 1] - 1.0
    if fixed is not None:
        points = np.insert(points, fixed, value, axis=1)
    actions = np.concatenate((np.zeros((1, size)), points)).astype(np.float32)
    actions.flags.writeable = False
    return actions


@functools.cache
def normal_steps(number: int, size: int, seed: int) -> Single:
    """Return evenly spread steps of the standard normal distribution, shape (number, size)."""
    import torch

    quasirandom: Any = torch.quasirandom
    uniform = quasirandom.SobolEngine(size, scramble=True, seed=seed).draw(number).clamp(1e-4, 1.0 - 1e-4)
    steps: Single = (2.0**0.5 * torch.erfinv(2.0 * uniform - 1.0)).numpy()
    steps.flags.writeable = False
    return steps
