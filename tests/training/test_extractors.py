"""What the standard algorithms see of a scene."""

import numpy as np
import pytest
import torch

from viapoint.training.agents.extractors import SceneExtractor
from viapoint.training.rollouts.vec_env import ViaVecEnv

IDS = ("viapoint/PlanarReach-v0", "viapoint/PlanarObstacles-v0", "viapoint/PlanarObstaclesStep-v0")


def observed(env_id, number=16):
    env = ViaVecEnv(env_id, number, seed=0)
    env.reset()
    observation, *_ = env.step(np.full((number, env.action_space.shape[0]), 0.3))
    torch.manual_seed(0)
    extractor = SceneExtractor(env.observation_space).double()
    return extractor, {name: torch.from_numpy(part).double() for name, part in observation.items()}


def rows(observation):
    return observation["obstacles"].reshape(len(observation["obstacles"]), -1, 6)


@pytest.mark.parametrize("env_id", IDS)
def test_features_are_as_many_as_stated_and_of_size_one(env_id):
    extractor, observation = observed(env_id)
    features = extractor(observation)
    assert features.shape == (16, extractor.features_dim)
    assert torch.isfinite(features).all()
    assert features.abs().max() < 10.0
    assert (features.std(dim=0) > 0.0).sum() > 0.5 * features.shape[1]


@pytest.mark.parametrize("env_id", IDS[1:])
def test_the_order_of_obstacles_and_the_sense_of_bars_do_not_matter(env_id):
    extractor, observation = observed(env_id)
    before = extractor(observation)
    changed = rows(observation)[:, torch.tensor([3, 0, 4, 1, 2])]
    changed[..., 2:4] = -changed[..., 2:4]
    after = extractor({**observation, "obstacles": changed.flatten(1)})
    torch.testing.assert_close(after, before)


def test_every_obstacle_that_is_there_matters_and_no_other():
    extractor, observation = observed(IDS[1])
    before, present = extractor(observation), rows(observation)[..., -1] > 0.5
    assert present.any()
    assert not present.all()
    for row in range(present.shape[1]):
        moved = rows(observation).clone()
        moved[:, row, :2] += 0.05
        after = extractor({**observation, "obstacles": moved.flatten(1)})
        different = ((after - before).abs() > 1e-9).any(dim=-1)
        assert (different == present[:, row]).all()


@pytest.mark.parametrize("env_id", [*IDS, "viapoint/PandaObstacles-v0", "viapoint/PlanarTargetJump-v0"])
def test_a_hand_that_ended_in_the_goal_itself_is_seen(env_id):
    """As it may after the last step of an episode, which learning looks at although nothing comes of it."""
    extractor, observation = observed(env_id)
    there = {**observation, "hand": observation["goal"]}
    assert torch.isfinite(extractor(there)).all()
    assert torch.isfinite(extractor.float()({name: part.float() for name, part in there.items()})).all()


def test_velocities_are_seen_along_the_line():
    """Turning everything about the shoulder changes nothing but where start and goal are."""
    extractor, observation = observed(IDS[2])
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    turned = {
        name: part @ turn.T if part.shape[-1] == 2 and name != "joints" else part
        for name, part in observation.items()
    }
    seen = rows(observation).clone()
    seen[..., :2], seen[..., 2:4] = seen[..., :2] @ turn.T, seen[..., 2:4] @ turn.T
    turned["obstacles"] = seen.flatten(1)
    extractor.each[0].weight.data[:, 5:9] = 0.0  # it is told where the ends are
    before, after = extractor(observation), extractor(turned)
    torch.testing.assert_close(after[:, 4:], before[:, 4:])
