"""The scenes of a generator do not depend on how many attempts are computed at once."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import ADULT, PANDA
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.scenes import sampler as sampling
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.feasible_path import DRAW_ORDER
from viapoint.envs.scenes.sampler import SceneSampler, UniformSampler

SAMPLERS = {
    "space": (SceneSampler, PANDA, SpaceDistribution()),
    "plane": (SceneSampler, ADULT, SceneDistribution()),
    "uniform": (UniformSampler, ADULT, SceneDistribution()),
    "with room for given obstacles": (SceneSampler, ADULT, SceneDistribution(n_obstacles=(1, 40))),
    "without obstacles": (SceneSampler, PANDA, SpaceDistribution(n_obstacles=(0, 0))),
}


@pytest.fixture(params=SAMPLERS, scope="module")
def sampler(request):
    kind, arm, distribution = SAMPLERS[request.param]
    return kind(CollisionModel(arm, True), distribution)


def seeded(number, bits=np.random.PCG64):
    return [np.random.Generator(bits(seed)) for seed in range(number)]


def equal(first, second):
    return all(np.array_equal(mine, theirs) for mine, theirs in zip(first, second, strict=True))


def following(generators):
    """The next number of each generator, which is left where it is."""
    states = [each.bit_generator.state for each in generators]
    found = [each.random() for each in generators]
    for each, state in zip(generators, states, strict=True):
        each.bit_generator.state = state
    return found


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("ahead", [0, 30, 1000])
@pytest.mark.parametrize("together", [5, 10_000])
def test_scenes_do_not_depend_on_how_many_attempts_are_computed_at_once(monkeypatch, shared, ahead, together):
    found = []
    for changed in (False, True):
        order = DRAW_ORDER[3]
        if changed:
            monkeypatch.setattr(sampling, "TOGETHER", together)
            monkeypatch.setattr(sampling, "MOST", 100)
            order = order._replace(ahead=ahead)
        sampler = SceneSampler(CollisionModel(PANDA, True), SpaceDistribution(), order=order)
        generators = seeded(1) * 8 if shared else seeded(8)
        first, second = sampler(generators), sampler(generators)
        found.append((*first, *second, following(generators)))
    assert equal(*found)


@pytest.mark.parametrize("bits", [np.random.PCG64, np.random.MT19937])
def test_scenes_are_those_that_each_generator_gives_alone(sampler, bits):
    mine, theirs = (seeded(6, bits) for _ in range(2))
    for _ in range(3):
        together = sampler(mine)
        alone = [sampler([each]) for each in theirs]
        assert equal(together, [np.concatenate(parts) for parts in zip(*alone, strict=True)])
        assert following(mine) == following(theirs)


def test_scenes_that_cannot_be_found_are_refused():
    order = DRAW_ORDER[3]._replace(groups=(1, 2))
    distribution = SpaceDistribution(families=("tunnel",), n_obstacles=(8, 8))
    sampler = SceneSampler(CollisionModel(PANDA, True), distribution, order=order)
    with pytest.raises(RuntimeError):
        sampler(seeded(20))


@pytest.mark.parametrize(
    ("env_id", "steps"), [("PlanarWholeArm-v0", 9), ("PandaObstacles-v0", 9), ("PlanarWholeArmStep-v0", 250)]
)
def test_episodes_are_those_that_the_sampler_draws_from_the_generators_of_the_seeds(env_id, steps):
    envs = gym.make_vec(f"viapoint/{env_id}", num_envs=5)
    envs.reset(seed=0)
    sampler, generators, ended = envs.unwrapped.task.sampler(), seeded(5), np.zeros(5)
    sampler(generators)
    for _ in range(steps):
        _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
        rows = np.flatnonzero(terminated | truncated)
        assert equal(envs.unwrapped.scenes.take(rows), sampler([generators[row] for row in rows]))
        ended[rows] += 1
    assert (ended >= 2).all()
    envs.close()
