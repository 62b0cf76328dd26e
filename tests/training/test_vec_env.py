"""SB3's view of the environment is the environment."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from viapoint.envs.scenes.options import scene_from_json, scene_to_json
from viapoint.training.rollouts.vec_env import ViaVecEnv

ENV = "viapoint/PlanarObstacles-v0"


class Countdown(gym.Env):
    """Ends after `length` steps, by itself or cut off; observes how many are left and pays that number."""

    observation_space = gym.spaces.Box(-1.0, 100.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    render_mode = None

    def __init__(self, cut=False):
        self.cut = cut

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, 5))
        return self._observation(), {}

    def step(self, action):
        self.left -= 1
        over = self.left == 0
        ends = over and not self.cut, over and self.cut
        return self._observation(), float(self.left), *ends, {"is_success": over}

    def _observation(self):
        return np.array([self.left], np.float32)


@pytest.fixture(scope="module", autouse=True)
def registered():
    gym.register("test/Countdown-v0", entry_point=Countdown)
    yield
    del gym.registry["test/Countdown-v0"]


@pytest.fixture
def env():
    env = ViaVecEnv(ENV, 6, seed=3, threads=1)
    yield env
    env.close()


def actions(env, seed=0):
    generator = np.random.default_rng(seed)
    return generator.uniform(-0.5, 0.5, (env.num_envs, *env.action_space.shape)).astype(np.float32)


def test_it_is_the_vector_environment(env):
    native = gym.make_vec(ENV, num_envs=6, threads=1)
    expected, _ = native.reset(seed=3)
    observed = env.reset()
    for step in range(3):
        for name in expected:
            np.testing.assert_array_equal(observed[name], expected[name])
        expected, reward, terminated, _, info = native.step(actions(env, step))
        observed, mine, done, infos = env.step(actions(env, step))
        np.testing.assert_array_equal(mine, reward.astype(np.float32))
        np.testing.assert_array_equal(done, terminated)
        for i, each in enumerate(infos):
            assert each["is_success"] is bool(info["is_success"][i])
            assert each["TimeLimit.truncated"] is False
            assert each["episode"] == {"r": reward[i], "l": 1, "t": each["episode"]["t"]}
            for name, part in info["final_obs"][i].items():
                np.testing.assert_array_equal(each["terminal_observation"][name], part)
    assert env.physics_steps == native.unwrapped.physics_steps > 0
    native.close()


def test_observations_keep_their_values(env):
    first = env.reset()
    kept = {name: part.copy() for name, part in first.items()}
    _, _, _, infos = env.step(actions(env))
    ends = [{name: part.copy() for name, part in each["terminal_observation"].items()} for each in infos]
    env.step(actions(env, 1))
    for name, part in first.items():
        np.testing.assert_array_equal(part, kept[name])
    for info, end in zip(infos, ends, strict=True):
        for name, part in end.items():
            np.testing.assert_array_equal(info["terminal_observation"][name], part)


@pytest.mark.parametrize("cut", [False, True])
def test_long_episodes_end_each_in_its_time(cut):
    env = ViaVecEnv("test/Countdown-v0", 5, seed=0, cut=cut)
    left = env.reset()[:, 0]
    began = left.copy()
    lengths = set()
    for _ in range(12):
        after, reward, done, infos = env.step(np.zeros((5, 1), np.float32))
        np.testing.assert_array_equal(done, left == 1)
        for i in range(5):
            if not done[i]:
                assert infos[i] == {}
                assert after[i, 0] == reward[i] == left[i] - 1
                continue
            n = int(began[i])
            assert infos[i]["episode"]["l"] == n
            assert infos[i]["episode"]["r"] == sum(range(n))
            assert infos[i]["terminal_observation"] == [0.0]
            assert infos[i]["TimeLimit.truncated"] is cut
            assert infos[i]["is_success"] is True
            assert after[i, 0] >= 1
            began[i] = after[i, 0]
            lengths.add(n)
        left = after[:, 0]
    assert len(lengths) > 1


def test_seeds_options_and_attributes(env):
    env.seed(5)
    first = env.reset()
    assert any((first[name] != part).any() for name, part in env.reset().items())
    env.seed(5)
    again = env.reset()
    assert all((first[name] == part).all() for name, part in again.items())
    native = env.venv.unwrapped
    scenes = [
        scene_from_json(scene_to_json(native.scenes, native.arm, native.task.space_name, scene=row))
        for row in range(6)
    ]
    env.set_options(scenes[0])
    assert np.ptp(env.reset()["goal"], axis=0).max() == 0.0
    env.set_options(scenes)
    for name, part in env.reset().items():
        np.testing.assert_allclose(part, first[name], atol=1e-6)
    assert env.get_attr("num_envs", [-1, 5]) == [6, 6]
    env.set_attr("mark", 1)
    assert env.get_attr("mark", indices=[2, 3]) == [1, 1]
    assert env.env_method("__str__", indices=1) == [str(env.venv.unwrapped)]


def test_a_restored_state_goes_on_alike(env):
    env.reset()
    env.step(actions(env))
    state = env.state()
    expected = [env.step(actions(env, seed)) for seed in (1, 2)]
    other = ViaVecEnv(ENV, 6, seed=99, threads=1)
    other.reset()
    other.restore(state)
    for seed, (observed, reward, _, _) in zip((1, 2), expected, strict=True):
        mine = other.step(actions(env, seed))
        np.testing.assert_array_equal(mine[1], reward)
        for name, part in observed.items():
            np.testing.assert_array_equal(mine[0][name], part)
    assert other.physics_steps == env.physics_steps
    other.close()


def test_refused_options_are_not_met_again_and_the_seed_still_counts(env):
    expected = env.reset()
    env.seed(3)
    env.set_options({"goal": np.array([5.0, 5.0])})
    with pytest.raises(ValueError):
        env.reset()
    for name, part in env.reset().items():
        np.testing.assert_array_equal(part, expected[name])


def test_episodes_are_told_as_a_monitor_tells_them(env, recwarn):
    """So SB3 takes returns and lengths from the infos, and does not ask for a wrapper."""
    assert env.env_is_wrapped(Monitor) == [True] * 6
    model = SAC("MultiInputPolicy", env, buffer_size=10)
    rewards, lengths = evaluate_policy(model, env, n_eval_episodes=12, return_episode_rewards=True)
    assert not [each for each in recwarn if "Monitor" in str(each.message)]
    assert lengths == [1] * 12
    assert len(set(rewards)) == 12


@pytest.mark.parametrize(
    "line",
    [
        "from viapoint.training.rollouts.vec_env import ViaVecEnv; ViaVecEnv(ID, 2)",
        "from viapoint.training.planning.search import GeometrySearch; GeometrySearch(ID)",
        "from viapoint.training import load_agent; load_agent(ID)",
    ],
)
def test_whoever_is_given_an_id_registers_it(line):
    subprocess.run([sys.executable, "-c", line.replace("ID", f"{ENV!r}")], check=True)
