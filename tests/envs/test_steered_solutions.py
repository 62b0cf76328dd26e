"""Nothing is lost by an action in every control step: steered along a movement that succeeds, the hand succeeds."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.registration import STEP_TASKS
from viapoint.envs.sim.time_scaling import required_time_scale
from viapoint.training.scene_sets.scene_set import load

SCENES, CORRECTION = 40, 4.0


def steered_along(env, plan, scenes):
    """What came of episodes in which the reference is steered along plans: success and jerk ratio of each."""
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


@pytest.mark.parametrize("name", ["viapoint/PlanarObstaclesStep-v0", "viapoint/PandaObstaclesStep-v0"])
def test_steered_along_solutions_of_the_twin_the_hand_succeeds(name):
    twin = STEP_TASKS[name]
    frozen = load("validation", twin).take(slice(0, SCENES))
    env = gym.make_vec(name, num_envs=SCENES)
    layout = gym.make(twin).unwrapped.action_layout
    plan = layout.decode(frozen.solution.astype(float), frozen.scenes.start, frozen.scenes.goal)
    plan = Plan(
        plan.waypoints, plan.durations * required_time_scale(env.unwrapped.arm, plan).stretch[:, None]
    )
    success, jerk_ratio = steered_along(env, plan, frozen.scenes)
    assert success.all()
    assert np.median(jerk_ratio) < 15.0
