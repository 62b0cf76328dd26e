"""Makes the frozen scenes of the tasks whose plans are revised on the way.

    python -m viapoint.training.scene_sets.generate_replanning [--env ID ...] [--sets test ...] [--write | --out DIR]

They are compared with those shipped. Scenes are drawn from the training distribution, from other seeds for each set;
those are kept that the planner, which knows all courses, solves in simulation. Where obstacles move, the solution share
is the fraction of 512 uniformly random plans that would touch nothing and stay in reach if they were kept to the end:
computed, not simulated.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from viapoint.envs.registration import ONLINE_TASKS
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.training.planners.replanning_baselines import INSTANTS, OnlinePlanner
from viapoint.training.rollouts.rollout import OnlineTrial
from viapoint.training.scene_sets.scene_set import FrozenScenes
from viapoint.training.scene_sets.scene_set_diff import add_arguments, compare_with_shipped
from viapoint.training.search.planned_movements import plan_movements

SIZES = {"validation": 200, "test": 500}
SEEDS = {"validation": 1_000_000, "test": 2_000_000}
"""Of the first scene of each set; training begins with seeds below these."""
PLANS = 512
"""Of which the solution share is a fraction."""
PIECE = 50
"""Scenes at a time."""


def make(env_id: str, name: str, size: int) -> FrozenScenes:
    """A set of scenes of an environment."""
    trial, kept = OnlineTrial(env_id, PIECE), []
    planner = OnlinePlanner(trial)
    number = drawn = 0
    with tqdm(total=size, desc=f"{env_id} {name}", file=sys.stderr) as bar:
        while number < size:
            scenes = trial.draw(PIECE, SEEDS[name] + drawn)
            found = planner.decide(trial.observe(scenes), scenes)
            solved = trial.play(planner, scenes, found).success
            kept.append((scenes.take(solved), found[solved], drawn + np.flatnonzero(solved)))
            drawn += PIECE
            number += int(solved.sum())
            bar.update(min(size, number) - bar.n)
    fields = [np.concatenate(parts)[:size] for parts in zip(*(piece[0] for piece in kept), strict=True)]
    together = ChangingScenes(*fields)
    result = FrozenScenes(
        name=name,
        env_id=env_id,
        scenes=together,
        share=shares(trial, together),
        solution=np.concatenate([piece[1] for piece in kept])[:size],
        number=np.concatenate([piece[2] for piece in kept])[:size],
    )
    trial.close()
    return result


def shares(trial: OnlineTrial, scenes: ChangingScenes) -> NDArray[np.float64]:
    """Solution share of each scene, shape (N,); unknown where nothing is in the way."""
    number, task = len(scenes.start), trial.task
    share = np.full(number, np.nan)
    for row in range(number if scenes.present.any() else 0):
        scene, generator = scenes.take([row]), np.random.default_rng(row)
        actions = generator.uniform(-1.0, 1.0, (1, PLANS, task.action.size)).astype(np.float32)
        moves = plan_movements(trial.observe(scene), actions, task, INSTANTS)
        every = scene.take(np.zeros(PLANS, dtype=np.int64))
        rows = every.places(moves.duration[0, :, None] * INSTANTS)
        least: Any = task.collision_model.clearance_profile(moves.path[0], rows, every.present).min(
            axis=(1, 2)
        )
        reach = np.asarray(task.arm.reach_margin(moves.path[0])).min(axis=-1)
        share[row] = ((least > 0.0) & (reach > 0.0)).mean()
    return share


def main() -> None:
    """Make the sets named on the command line, or all, and say whether they are as shipped."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", nargs="+", default=list(ONLINE_TASKS), choices=list(ONLINE_TASKS))
    parser.add_argument("--sets", nargs="+", default=list(SIZES), choices=list(SIZES))
    add_arguments(parser)
    arguments = parser.parse_args()
    made = (make(env_id, name, SIZES[name]) for env_id in arguments.env for name in arguments.sets)
    raise SystemExit(0 if compare_with_shipped(made, arguments) else 1)


if __name__ == "__main__":
    main()
