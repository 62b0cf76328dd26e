"""Which actions need no simulation because their plans already tell what comes of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from viapoint.envs.scenes import Scenes
from viapoint.envs.task import Task
from viapoint.training.features import foresee

Float = NDArray[np.float64]

CERTAIN = 0.002
"""How deep a plan must cut into an obstacle, or leave the reach, to fail for certain, [m].

With the default durations plans are tracked within a fifth of a millimetre; much shorter ones are not. Where plans are
looked at, less often than the physics does, their clearance can only be overestimated.
"""
SURE = 0.01
"""Least clearance and reach margin of a plan in space that succeeds for certain, [m].

There movements are slowed down to what the arm's limits allow, so that plans are tracked within a millimetre, whatever
their duration: of 1,017 random plans with a margin over 2 mm none failed.
"""
CHUNK = 4096


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
    joints = np.asarray(task.arm.posture(scenes.start))
    observation = task.observation.observe(joints, scenes.start, scenes)
    merit = np.empty(len(actions))
    for i in range(0, len(actions), CHUNK):
        rows = slice(i, i + CHUNK)
        tensors = {name: torch.from_numpy(part[rows]) for name, part in observation.items()}
        with torch.no_grad():
            plans = torch.tensor(actions[rows], dtype=torch.float32).unsqueeze(1)
            sight = foresee(tensors, plans, task).seen
        merit[rows] = torch.minimum(sight.clearance.amin(dim=-1), sight.reach_margin)[:, 0].numpy()
    in_space = task.whole_arm and task.arm.dimension == 3
    return Screened(merit < -CERTAIN, merit > (SURE if in_space else np.inf), merit)
