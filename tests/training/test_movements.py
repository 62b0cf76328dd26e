"""Laws of what is foreseen on the way: it is what the environment will command, and how near it will come."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from viapoint.envs.courses import clearance_over_time
from viapoint.envs.scenes import SHORTEST
from viapoint.training.features import foresee
from viapoint.training.movements import movements
from viapoint.training.sight import INSTANTS

IDS = (
    "viapoint/PlanarMovingObstacles-v0",
    "viapoint/PlanarTargetJump-v0",
    "viapoint/PandaMovingObstacles-v0",
)


def under_way(env_id, number=24, decisions=1, **kwargs):
    """Environments amid their episodes, and what they see."""
    env = gym.make_vec(env_id, num_envs=number, **kwargs).unwrapped
    observation, _ = env.reset(seed=3)
    generator = np.random.default_rng(3)
    for _ in range(decisions):
        observation, *_ = env.step(generator.uniform(-0.3, 0.3, env.action_space.shape))
    return env, observation, generator


def free_to_revise(env):
    """Where actions change the plan, and the line to the goal has a direction."""
    default = env.default
    far = np.linalg.norm(default.goal - default.state.position, axis=-1) > SHORTEST
    return far & (default.changed | ~default.begun | (default.remaining >= env.reviser.least_remaining))


@pytest.mark.parametrize("decisions", [0, 1, 2])
@pytest.mark.parametrize("env_id", IDS)
def test_foreseen_movements_are_the_ones_that_will_be_commanded(env_id, decisions):
    env, observation, generator = under_way(env_id, decisions=decisions)
    actions = generator.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
    plan, _ = env.reviser.revise(env.default, env._episodes.plan, actions.astype(np.float64))
    foreseen = movements(observation, actions[:, None], env.task)
    some = free_to_revise(env)
    assert some.sum() > 4
    commanded = plan.trajectory()(plan.duration[:, None] * INSTANTS)
    np.testing.assert_allclose(foreseen.duration[some, 0], plan.duration[some], rtol=1e-5)
    np.testing.assert_allclose(foreseen.path[some, 0], commanded[some], atol=2e-4)


def test_foreseen_clearance_is_that_from_obstacles_that_go_on_as_they_do():
    env, observation, generator = under_way(IDS[0], horizon=0.1)
    actions = generator.uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32)
    seen = foresee(observation, actions[:, None], env.task).seen.clearance.min(axis=-1)[:, 0]
    plan, _ = env.reviser.revise(env.default, env._episodes.plan, actions.astype(np.float64))
    ahead = plan.duration[:, None] * np.linspace(0.02, 1.0, 800)
    now = env._episodes.time
    rows = env.scenes.places(now[:, None] + ahead, unturned=now)
    hand = plan.trajectory()(ahead)
    exact = clearance_over_time(env.arm, hand, rows, env.scenes.present, whole_arm=False).min(axis=(1, 2))
    some = free_to_revise(env) & (exact > -0.005)  # deep inside an obstacle a look now and then is coarse
    assert some.sum() > 6
    np.testing.assert_allclose(seen[some], exact[some], atol=3e-4)
    assert (seen[exact < -0.005] < 0.0).all()


def test_torch_foresees_the_same_and_differentiates_through_time_and_place():
    env, observation, generator = under_way(IDS[0])
    actions = generator.uniform(-0.5, 0.5, (env.num_envs, 3, env.single_action_space.shape[0])).astype(
        np.float32
    )
    numbers = foresee(observation, actions, env.task)
    asked = torch.tensor(actions, requires_grad=True)
    tensors = foresee({name: torch.as_tensor(part) for name, part in observation.items()}, asked, env.task)
    np.testing.assert_allclose(tensors.vector().detach(), numbers.vector(), atol=5e-3)
    tensors.seen.clearance.sum().backward()
    assert torch.isfinite(asked.grad).all()
    assert (asked.grad.abs().sum(dim=(0, 1)) > 0.0).all()
