"""Laws of the policy as those of Stable-Baselines3: it is saved, loaded, and says what it cannot decide on."""

import io

import numpy as np
import pytest
import torch

from viapoint.training.baselines import agent_method
from viapoint.training.commands import find_agent
from viapoint.training.policies import ViaPolicy
from viapoint.training.trial import Trial

ID = "viapoint/PlanarObstacles-v0"


@pytest.fixture(scope="module")
def observation():
    trial = Trial(ID, 4)
    scenes = trial.task.sampler()([np.random.default_rng(seed) for seed in range(4)])
    yield trial.observe(scenes)
    trial.close()


@pytest.fixture(scope="module")
def policy():
    torch.set_num_threads(1)
    return find_agent(None, ID).model.policy


@pytest.mark.parametrize("candidates", [0, 8])
def test_a_policy_that_is_saved_alone_decides_the_same(policy, observation, candidates):
    policy.candidates, file = candidates, io.BytesIO()
    policy.save(file)
    file.seek(0)
    loaded = ViaPolicy.load(file)
    assert loaded.candidates == candidates
    np.testing.assert_array_equal(loaded.predict(observation)[0], policy.predict(observation)[0])


def test_what_cannot_be_decided_on_is_named(policy, observation):
    with pytest.raises(ValueError, match="must be a dict of goal, hand, joints, obstacles; got ndarray"):
        policy.predict(observation["hand"])
    for parts in ({"hand": observation["hand"]}, {**observation, "wind": observation["hand"]}):
        with pytest.raises(
            ValueError, match=r"must have the parts goal, hand, joints, obstacles; got .*hand"
        ):
            policy.predict(parts)
    for value in (np.nan, np.inf):
        goal = observation["goal"].copy()
        goal[1, 0] = value
        with pytest.raises(ValueError, match="observation must be finite; goal is"):
            policy.predict({**observation, "goal": goal})
    with pytest.raises(ValueError, match="hand and goal must be apart"):
        policy.predict({**observation, "goal": observation["hand"]})


def test_the_policy_alone_ranks_nothing_even_if_it_was_trained_to(policy, observation):
    model = find_agent(None, ID).model
    alone, ranked = (agent_method("agent", model, n).decide(observation, None) for n in (0, 8))
    model.policy.candidates = 8
    np.testing.assert_array_equal(agent_method("agent", model).decide(observation, None), alone)
    assert not np.array_equal(alone, ranked)
    assert model.policy.candidates == 8
