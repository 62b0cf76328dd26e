"""Frozen scenes of the replanning tasks.

Scenes are drawn from the training distribution, with other seeds for each set. A scene is kept if the planner, which
knows all changes in advance, solves it in simulation. Where obstacles move, the solution share is the fraction of 512
uniformly random plans that would touch nothing and stay within reach if they were never revised: it is computed, not
simulated.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from tqdm import tqdm

from viapoint.envs.common.types import Float
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.training.planning.replanning_baselines import INSTANTS, ReplanningPlanner
from viapoint.training.rollouts.rollout import EpisodeSimulation
from viapoint.training.scene_sets.scene_set import FrozenScenes
from viapoint.training.planning.planned_movements import plan_movements

SIZES = {"validation": 200, "test": 500}
SEEDS = {"validation": 1_000_000, "test": 2_000_000}
"""Seed of the first scene of each set; training begins with lower seeds."""
PLANS = 512
"""Random plans for the solution share."""
AT_ONCE = 50
"""Scenes that are drawn and solved at once."""


def make_replanning(env_id: str, name: str, size: int) -> FrozenScenes:
    """Return a set of scenes of an environment."""
    simulation, kept = EpisodeSimulation(env_id, AT_ONCE), []
    planner = ReplanningPlanner(simulation)
    number = drawn = 0
    with tqdm(total=size, desc=f"{env_id} {name}", file=sys.stderr) as bar:
        while number < size:
            scenes = simulation.draw(AT_ONCE, SEEDS[name] + drawn)
            found = planner.decide(simulation.observe(scenes), scenes)
            solved = simulation.play(planner, scenes, found).success
            kept.append((scenes.take(solved), found[solved], drawn + np.flatnonzero(solved)))
            drawn += AT_ONCE
            number += int(solved.sum())
            bar.update(min(size, number) - bar.n)
    fields = [np.concatenate(parts)[:size] for parts in zip(*(piece[0] for piece in kept), strict=True)]
    together = ChangingScenes(*fields)
    result = FrozenScenes(
        name=name,
        env_id=env_id,
        scenes=together,
        share=solution_shares(simulation, together),
        solution=np.concatenate([piece[1] for piece in kept])[:size],
        number=np.concatenate([piece[2] for piece in kept])[:size],
    )
    simulation.close()
    return result


def solution_shares(simulation: EpisodeSimulation, scenes: ChangingScenes) -> Float:
    """Return the solution share of each scene, shape (N,); NaN where no scene has an obstacle."""
    number, task = len(scenes.start), simulation.task
    share = np.full(number, np.nan)
    for row in range(number if scenes.present.any() else 0):
        scene, generator = scenes.take([row]), np.random.default_rng(row)
        actions = generator.uniform(-1.0, 1.0, (1, PLANS, task.action.size)).astype(np.float32)
        moves = plan_movements(simulation.observe(scene), actions, task, INSTANTS)
        every = scene.take(np.zeros(PLANS, dtype=np.int64))
        rows = every.places(moves.duration[0, :, None] * INSTANTS)
        least: Any = task.collision_model.clearance_profile(moves.path[0], rows, every.present).min(
            axis=(1, 2)
        )
        reach = np.asarray(task.arm.reach_margin(moves.path[0])).min(axis=-1)
        share[row] = ((least > 0.0) & (reach > 0.0)).mean()
    return share
