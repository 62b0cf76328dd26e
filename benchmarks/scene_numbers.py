"""Numbers of the pages on environments: training scenes by difficulty, desks, and movements steered along solutions.

    OMP_NUM_THREADS=1 python benchmarks/scene_numbers.py --out docs/scenes.json

`bands` holds the share of training scenes in each band of difficulty. The solution share of a scene is estimated
from the plans of random actions, which is slightly too high. `drawn` holds how many scenes were drawn for the set
`uniform`; those without a known solution were left out. `desk` holds the success of the shipped agent with 0 and 64
checks, and of methods without learning, in random scenes of the family. `steered` holds the success and the median jerk
ratio of hands that are steered along the stored solutions of `validation` scenes, with an action in every control step,
and the jerk ratio of the solutions themselves.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
from scene_sets.difficulty import planned_share

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.mdp.task import family_sampler
from viapoint.envs.registration import STEP_TASKS
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.time_scaling import required_time_scale
from viapoint.training.evaluation.evaluator import evaluate
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes, bands, load

ENVIRONMENTS = ("viapoint/PlanarObstacles-v0", "viapoint/PlanarWholeArm-v0", "viapoint/PandaObstacles-v0")
TRAINING_SCENES, DRAWS = 1024, 256
DESK_SCENES, CHECKS, METHODS = 300, (0, 64), ("search64", "search512")
STEERED_SCENES = 200
CORRECTION = 4.0
"""Gain of the pull to where the hand should be, [1/s]."""


def shares_of_bands(env_id: str, number: int = TRAINING_SCENES, draws: int = DRAWS) -> dict[str, float]:
    """Return the share of training scenes in each band, by an estimate from the plans of random actions."""
    simulation = SceneSimulation(env_id, threads=1)
    scenes = simulation.task.sampler()([np.random.default_rng(1_000 + i) for i in range(number)])
    share = planned_share(simulation, scenes, draws=draws)
    simulation.close()
    found = np.bincount(bands(share), minlength=len(BANDS)) / number
    return dict(zip(BANDS, found.round(4).tolist(), strict=True))


def at_desks(env_id: str, number: int = DESK_SCENES, methods: Sequence[str] = METHODS) -> dict[str, float]:
    """Return the success of the shipped agent and of methods in random scenes of the family `desk`, by method."""
    simulation = SceneSimulation(env_id, threads=1)
    scenes = family_sampler(simulation.task, "desk")(
        [np.random.default_rng(1_000 + i) for i in range(number)]
    )
    solution = np.zeros((number, simulation.task.action.size))
    simulation.close()
    frozen = FrozenScenes(
        name="desk",
        env_id=env_id,
        scenes=scenes,
        share=np.full(number, np.nan),
        solution=solution,
        family="desk",
    )
    found = evaluate(env_id, scenes=frozen, checks=CHECKS, baselines=methods, time_decisions=False)
    return {row["method"]: round(row["success"]["rate"], 4) for row in found.rows}


def steered(env_id: str, number: int = STEERED_SCENES, **env_kwargs: float) -> dict[str, float]:
    """Steer the hand along the stored solutions of the twin's `validation` scenes.

    Args:
        env_id: Environment with an action in every control step.
        number: Number of scenes.
        **env_kwargs: Arguments of the environment.

    Returns:
        Success rate, and the medians of the jerk ratios of the steered movements and of the solutions.
    """
    twin = STEP_TASKS[env_id]
    frozen = load("validation", twin).take(slice(0, number))
    env, plans = gym.make_vec(env_id, num_envs=number, **env_kwargs), gym.make_vec(twin, num_envs=number)
    plan = plans.unwrapped.action_layout.decode(
        frozen.solution.astype(float), frozen.scenes.start, frozen.scenes.goal
    )
    stretch = required_time_scale(env.unwrapped.arm, plan).stretch[:, None]
    success, jerk_ratio = steered_along(env, Plan(plan.waypoints, plan.durations * stretch), frozen.scenes)
    plans.reset(options=frozen.scenes.as_options())
    of_plans = plans.step(frozen.solution)[-1]["jerk_ratio"]
    env.close()
    plans.close()
    medians = (round(float(np.median(each)), 2) for each in (jerk_ratio, of_plans))
    return {
        "success": float(success.mean()),
        **dict(zip(("jerk_ratio", "of_solutions"), medians, strict=True)),
    }


def steered_along(env, plan, scenes: Scenes):  # type: ignore[no-untyped-def]
    """Return success and jerk ratio of episodes in which the reference is steered along plans, shape (N,) each."""
    env.reset(seed=0, options=scenes.as_options())
    steering, trajectory = env.unwrapped.steering, plan.trajectory()
    w, step, hand = steering.bandwidth, steering.control_step, scenes.start
    success, jerk_ratio, over = np.zeros((3, len(hand)))
    for k in range(env.unwrapped.control_steps):
        rest = plan.durations.sum(axis=-1) <= (k + 0.5) * step
        middle = np.full((len(hand), 1), (k + 0.5) * step)
        velocity, rate, jerk = (trajectory(middle, nu)[:, 0] for nu in (1, 2, 3))
        # The filter's equation, solved for the velocity that is wanted, and a pull to where the hand should be now.
        wanted = np.where(rest[:, None], 0.0, velocity + (2.0 / w) * rate + jerk / w**2)
        wanted += CORRECTION * (trajectory(np.full((len(hand), 1), k * step))[:, 0] - hand)
        action = steering.encode(wanted, scenes.start, scenes.goal).astype(np.float32)
        observation, _, terminated, truncated, info = env.step(action)
        ended = (terminated | truncated) & (over == 0.0)
        success[ended], jerk_ratio[ended] = info["is_success"][ended], info["jerk_ratio"][ended]
        over[ended] = 1.0
        hand = observation["hand"]
    assert over.all()
    return success, jerk_ratio


def main() -> None:
    """Print the numbers, and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    planar, panda = "viapoint/PlanarObstaclesStep-v0", "viapoint/PandaObstaclesStep-v0"
    found = {
        "bands": {env_id: shares_of_bands(env_id) for env_id in ENVIRONMENTS},
        "drawn": {env_id: int(load("uniform", env_id).number.max()) + 1 for env_id in ENVIRONMENTS},
        "desk": at_desks(ENVIRONMENTS[-1]),
        "steered": {
            planar: steered(planar),
            f"{planar}, control_step=0.02": steered(planar, control_step=0.02),
            panda: steered(panda),
        },
    }
    text = json.dumps(found, indent=1) + "\n"
    print(text, end="")
    if arguments.out:
        arguments.out.write_text(text)


if __name__ == "__main__":
    main()
