"""Training loops that people have: Gymnasium's autoreset modes and wrappers, and loops of other libraries."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from episodes import IDS, JUMP, MOVING, OBSTACLES, STEP, same
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers

MODES = ("SameStep", "NextStep", "Disabled")


def zeros(env):
    return np.zeros(env.action_space.shape, np.float32)


def native(env_id=OBSTACLES, mode="NextStep", number=3, **kwargs):
    env = gym.make_vec(env_id, num_envs=number, autoreset_mode=mode, **kwargs)
    assert env.metadata["autoreset_mode"] is AutoresetMode(mode)
    return env


@pytest.mark.parametrize("env_id", [OBSTACLES, STEP, MOVING])
@pytest.mark.parametrize("mode", MODES)
def test_the_native_batch_is_gymnasiums_in_each_mode(env_id, mode):
    """Observations, rewards, ends and infos are those of Gymnasium's own vector environment, step by step."""
    mine = native(env_id, mode)
    theirs = gym.vector.SyncVectorEnv([lambda: gym.make(env_id)] * 3, autoreset_mode=AutoresetMode(mode))
    first, second = mine.reset(seed=1)[0], theirs.reset(seed=1)[0]
    same(first, second)
    rng = np.random.default_rng(0)
    ends = 0
    for _ in range(8 if env_id != STEP else 50):
        actions = rng.uniform(-1.0, 1.0, mine.action_space.shape).astype(np.float32)
        one, other = mine.step(actions), theirs.step(actions)
        same(one[0], other[0])
        for k in (1, 2, 3):
            np.testing.assert_array_equal(one[k], other[k])
        over = one[2] | one[3]
        ends += over.sum()
        same_infos(one[4], other[4])
        if mode == "Disabled" and over.any():
            options = {"reset_mask": over}
            same(mine.reset(options=dict(options))[0], theirs.reset(options=dict(options))[0])
    assert ends >= 2


def same_infos(mine, theirs):
    """Check that the infos of two batches are equal where Gymnasium says that they hold something."""
    for name, mask in theirs.items():
        if not name.startswith("_"):
            continue
        # With same-step autoreset, the metrics of an episode that ended are at the top level, too.
        assert mine.get(name, np.zeros_like(mask))[mask].all(), name
        one, other = mine[name[1:]], theirs[name[1:]]
        if isinstance(other, dict):
            same_infos(one, other)
        elif other.dtype == object:
            for a, b in zip(one[mask], other[mask], strict=True):
                same(a, b)
        else:
            np.testing.assert_array_equal(one[mask], other[mask], err_msg=name)


@pytest.mark.parametrize("env_id", [OBSTACLES, JUMP])
def test_without_autoreset_an_episode_that_is_over_needs_a_reset(env_id):
    env = native(env_id, "Disabled")
    env.reset(seed=0)
    over = np.zeros(3, bool)
    while not over.any():
        _, _, terminated, truncated, _ = env.step(zeros(env))
        over = terminated | truncated
    with pytest.raises(gym.error.ResetNeeded):
        env.step(zeros(env))
    env.reset(options={"reset_mask": over})
    env.step(zeros(env))


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_wrappers_of_observations_take_the_native_batch(mode):
    """In the modes for which Gymnasium defines them."""
    env = wrappers.FlattenObservation(wrappers.RecordEpisodeStatistics(native(mode=mode)))
    if mode == "NextStep":
        env = wrappers.NormalizeObservation(env)
    seen, _ = env.reset(seed=0)
    assert seen.shape == env.observation_space.shape
    returns = 0
    for _ in range(4):
        seen, _, terminated, truncated, info = env.step(zeros(env))
        assert np.isfinite(seen).all()
        returns += "episode" in info
        if mode == "Disabled" and (terminated | truncated).any():
            env.reset(options={"reset_mask": terminated | truncated})
    assert returns >= 2


@pytest.mark.parametrize("mode", MODES)
def test_statistics_of_episodes_are_sums_of_rewards(mode):
    env = wrappers.RecordEpisodeStatistics(native(JUMP, mode))
    env.reset(seed=0)
    total = np.zeros(3)
    for _ in range(20):
        _, reward, terminated, truncated, info = env.step(zeros(env))
        total += reward
        over = terminated | truncated
        if over.any():
            found = info["episode"]["r"] if "episode" in info else info["final_info"]["episode"]["r"]
            np.testing.assert_allclose(found[over], total[over])
            break
    assert over.any()


@pytest.mark.parametrize("env_id", [OBSTACLES, MOVING])
def test_vectorised_processes_of_gymnasium(env_id):
    envs = gym.make_vec(env_id, num_envs=2, vectorization_mode="sync")
    seen, _ = envs.reset(seed=0)
    same(seen, gym.make_vec(env_id, num_envs=2).reset(seed=0)[0])
    envs.step(zeros(envs))
    envs.close()


def test_a_loop_as_in_cleanrl_learns():
    """PPO's loop in one file: a batch, a flat observation, a buffer and a few updates."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    number, steps = 32, 4
    envs = wrappers.FlattenObservation(native("viapoint/PlanarReach-v0", number=number))
    envs = wrappers.RecordEpisodeStatistics(envs)
    size, actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    actor = torch.nn.Sequential(torch.nn.Linear(size, 32), torch.nn.Tanh(), torch.nn.Linear(32, actions))
    critic = torch.nn.Sequential(torch.nn.Linear(size, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1))
    spread = torch.nn.Parameter(torch.full((actions,), -1.0))
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), spread], lr=1e-2)
    seen, _ = envs.reset(seed=1)
    means = []
    over = np.zeros(number, bool)
    for _ in range(8):
        batch = []
        for _ in range(steps):
            x = torch.as_tensor(seen, dtype=torch.float32)
            with torch.no_grad():
                chosen = torch.distributions.Normal(actor(x), spread.exp()).sample()
            seen, reward, terminated, truncated, _ = envs.step(chosen.numpy())
            # With next-step autoreset, the step after the end of an episode only resets it.
            valid = torch.as_tensor(~over)
            batch.append((x[valid], chosen[valid], torch.as_tensor(reward, dtype=torch.float32)[valid]))
            over = terminated | truncated
        x, chosen, reward = (torch.cat(parts) for parts in zip(*batch, strict=True))
        means.append(float(reward.mean()))
        before = torch.distributions.Normal(actor(x), spread.exp()).log_prob(chosen).sum(-1).detach()
        for _ in range(4):
            value = critic(x).squeeze(-1)
            now = torch.distributions.Normal(actor(x), spread.exp()).log_prob(chosen).sum(-1)
            ratio = (now - before).exp()
            gain = reward - value.detach()
            policy = torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
            loss = ((reward - value) ** 2).mean() - policy
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    assert np.mean(means[-3:]) > np.mean(means[:3]) + 0.02


def test_torchrl():
    envs = pytest.importorskip("torchrl.envs")
    for env_id in IDS:
        for env in (envs.GymEnv(env_id), envs.GymWrapper(gym.make(env_id))):
            assert env.rollout(2).batch_size[0] >= 1


def test_rllib():
    pytest.importorskip("ray.rllib")
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
    from ray.tune.registry import register_env

    register_env("reach", lambda config: gym.wrappers.FlattenObservation(gym.make(OBSTACLES, **config)))
    config = PPOConfig().environment("reach", env_config={"n_obstacles": 2}).env_runners(num_env_runners=0)
    episodes = SingleAgentEnvRunner(config=config).sample(num_episodes=3)
    assert [len(episode) for episode in episodes] == [1, 1, 1]


def test_tianshou():
    tianshou = pytest.importorskip("tianshou.env")
    envs = tianshou.DummyVectorEnv([lambda: gym.make(OBSTACLES)] * 2)
    envs.reset()
    envs.step(np.zeros((2, 3), np.float32))


FORKED = """
import os, signal
import gymnasium as gym
envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=16, threads=2)
envs.reset(seed=0)
envs.step(envs.action_space.sample())
child = os.fork()
if not child:
    signal.alarm(60)  # ends the child where it waits for threads that it does not have
    envs.step(envs.action_space.sample())
    os._exit(0)
raise SystemExit(os.waitpid(child, 0)[1])
"""


def test_a_forked_process_goes_on_with_the_environments_of_its_parent():
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], check=True)
