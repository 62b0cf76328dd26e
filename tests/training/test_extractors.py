"""Laws of the features with which the standard algorithms see a scene."""

import numpy as np
import pytest
import torch
from helpers import JUMPS, PANDA, REACH, STEP
from helpers import PLANE as OBSTACLES

from viapoint.envs.geometry.obstacles import POSE_SIZE
from viapoint.training import SceneExtractor, ViaVecEnv

ENDS = 7
"""Features of start and goal: middle and line of both, and their distance."""


def observed(env_id, number=16):
    env = ViaVecEnv(env_id, number, seed=0)
    env.reset()
    observation, *_ = env.step(np.full((number, env.action_space.shape[0]), 0.3))
    env.close()
    torch.manual_seed(0)
    extractor = SceneExtractor(env.observation_space).double()
    return extractor, {name: torch.from_numpy(part).double() for name, part in observation.items()}


def rows_of(extractor, observation):
    return observation["obstacles"].reshape(-1, extractor.n_rows, extractor.row_size).clone()


def turned(vectors, turn):
    """Return vectors of two or three components that are turned about the vertical axis."""
    result = vectors.clone()
    result[..., :2] = vectors[..., :2] @ turn.T
    return result


@pytest.mark.parametrize("env_id", [REACH, OBSTACLES, STEP, PANDA, JUMPS])
def test_features_are_as_many_as_stated_and_of_size_one(env_id):
    """Also where the hand is at the goal, as it may be after the last step of an episode."""
    extractor, observation = observed(env_id)
    for seen in (observation, {**observation, "hand": observation["goal"]}):
        for dtype in (torch.float64, torch.float32):
            features = extractor.to(dtype)({name: part.to(dtype) for name, part in seen.items()})
            assert features.shape == (16, extractor.features_dim)
            assert torch.isfinite(features).all()
            assert features.abs().max() < 10.0


@pytest.mark.parametrize("env_id", [OBSTACLES, STEP])
def test_the_order_of_obstacles_does_not_matter(env_id):
    extractor, observation = observed(env_id)
    changed = rows_of(extractor, observation).flip(1)
    after = extractor({**observation, "obstacles": changed.flatten(1)})
    torch.testing.assert_close(after, extractor(observation))


def test_every_obstacle_that_is_there_matters_and_no_other():
    extractor, observation = observed(OBSTACLES)
    before, present = extractor(observation), rows_of(extractor, observation)[..., -1] > 0.5
    assert present.any()
    assert not present.all()
    centre = extractor.row_size - POSE_SIZE
    for row in range(extractor.n_rows):
        moved = rows_of(extractor, observation)
        moved[:, row, centre : centre + 2] += 0.05
        after = extractor({**observation, "obstacles": moved.flatten(1)})
        different = ((after - before).abs() > 1e-9).any(dim=-1)
        assert (different == present[:, row]).all()


def test_a_turn_about_the_base_changes_only_the_features_of_start_and_goal():
    extractor, observation = observed(STEP)
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    other = dict(observation)
    for name in ("hand", "goal", "velocity", "acceleration"):
        other[name] = turned(observation[name], turn)
    rows = rows_of(extractor, observation)
    first = extractor.row_size - POSE_SIZE
    for offset in (0, 3, 6, 12):  # centre, two axes and velocity
        part = slice(first + offset, first + offset + 3)
        rows[..., part] = turned(rows[..., part], turn)
    other["obstacles"] = rows.flatten(1)
    extractor.each[0].weight.data[:, -ENDS:-1] = 0.0  # each obstacle is told where start and goal are
    before, after = extractor(observation), extractor(other)
    torch.testing.assert_close(after[:, ENDS - 1 :], before[:, ENDS - 1 :])
