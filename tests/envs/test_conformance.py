"""Laws that every registered environment keeps."""

import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers
from helpers import MOVING, PLANE, SENSED, STEP, play, same
from stable_baselines3.common.env_checker import check_env as sb3_check

from viapoint.envs import ENV_IDS
from viapoint.envs.outcome import Outcome
from viapoint.envs.registration import TASKS
from viapoint.envs.rewards import TERMS

INFO = {*Outcome._fields, *TERMS, "elapsed", "time", "event"}
DIFFERENT = sorted({str(TASKS[env_id]): env_id for env_id in reversed(ENV_IDS)}.values())
"""One id of each task."""
MODES = ("SameStep", "NextStep", "Disabled")
LOOKS = "test/PlanarLooks-v0"
"""Task whose hand looks around on the way."""
gym.register(
    LOOKS,
    "viapoint.envs.env:ReachEnv",
    vector_entry_point="viapoint.envs.vector_env:ReachVectorEnv",
    kwargs={**TASKS[PLANE], "sensor": "hand_rays", "decide_at": ("sight",)},
    disable_env_checker=True,
)


@pytest.fixture(params=[*DIFFERENT, LOOKS])
def env_id(request):
    return request.param


def actions_for(env, number, seed=3):
    shape = getattr(env, "single_action_space", env.action_space).shape
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (number, *shape)).astype(np.float32)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_both_checkers_pass_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(gym.make(env_id).unwrapped, skip_render_check=True)
        sb3_check(gym.make(env_id), warn=True, skip_render_check=True)


def test_info_is_complete_finite_and_scalar_and_its_terms_add_up_to_the_reward(env_id):
    env = gym.make(env_id)
    for seed in range(2 if "Step-v" in env_id else 4):
        env.reset(seed=seed)
        for info in play(env, 1.0, seed):
            reward = info.pop("reward")
            assert set(info) == INFO
            for name, value in info.items():
                assert isinstance(value, bool | float | int), name
                assert np.isfinite(value), name
            terms = sum(value for name, value in info.items() if name.startswith("reward_"))
            assert reward == pytest.approx(terms, abs=1e-12)


def test_an_episode_is_the_same_alone_and_in_a_batch_on_two_threads(env_id):
    single = gym.make(env_id)
    batch = gym.make_vec(env_id, num_envs=9, threads=2, autoreset_mode="Disabled")
    row = 8
    actions = actions_for(batch, 3)
    first, _ = batch.reset(seed=5)
    alone, _ = single.reset(seed=5 + row)
    same(alone, {name: part[row] for name, part in first.items()})
    generator = np.random.default_rng(0)
    for action in actions:
        others = generator.uniform(-1.0, 1.0, batch.action_space.shape)
        others[row] = action
        seen, reward, terminated, truncated, info = batch.unwrapped.execute_actions(others)[:5]
        alone, mine, over, cut, values = single.step(action)
        same(alone, {name: part[row] for name, part in seen.items()})
        same(values, {name: info[name][row] for name in values})
        assert (mine, over, cut) == (reward[row], terminated[row], truncated[row])
        if over or cut or (terminated | truncated).any():
            break


def test_observations_share_no_memory_and_stay_in_their_space(env_id):
    env = gym.make_vec(env_id, num_envs=6)
    before, _ = env.reset(seed=0)
    kept = {name: part.copy() for name, part in before.items()}
    for action in actions_for(env, 6):
        after, *_, info = env.step(np.tile(action, (6, 1)))
        assert env.observation_space.contains(after)
        last = [each for each in info.get("final_obs", ()) if each is not None]
        assert all(env.single_observation_space.contains(each) for each in last)
        assert not any(np.shares_memory(before[name], after[name]) for name in before)
    same(kept, before)


def test_a_pickled_environment_goes_on_as_the_original(env_id):
    """Whatever becomes of the arguments."""
    weights = {"smoothness": 0.2}
    env = gym.make_vec(env_id, num_envs=2, reward_weights=weights)
    weights["smoothness"] = 5.0
    env.reset(seed=4)
    actions = actions_for(env, 4)
    env.step(np.tile(actions[0], (2, 1)))
    again = pickle.loads(pickle.dumps(env))
    assert again.unwrapped.task.weights.smoothness == 0.2
    assert again.unwrapped.task == env.unwrapped.task
    assert again.unwrapped.terminated.tolist() == env.unwrapped.terminated.tolist()
    for action in actions[1:]:
        first, second = (each.step(np.tile(action, (2, 1))) for each in (env, again))
        same(first[0], second[0])
        np.testing.assert_array_equal(first[1], second[1])
        for whole, rest in zip(env.unwrapped.last_rollout, again.unwrapped.last_rollout, strict=True):
            for part, last in zip(whole, rest, strict=True):  # records of the copy begin where it was made
                np.testing.assert_allclose(part[len(part) - len(last) + 1 :], last[1:], atol=1e-9)


@pytest.mark.parametrize("env_id", ["viapoint/PandaMovingObstacles-v0", SENSED, LOOKS])
def test_episodes_go_on_with_another_number_of_threads(env_id):
    first, second = (gym.make_vec(env_id, num_envs=9, threads=threads) for threads in (1, 2))
    first.reset(seed=4)
    action = np.tile(actions_for(first, 1)[0], (9, 1))
    first.step(action)
    with pytest.raises(ValueError, match="n_via"):
        gym.make_vec(env_id, num_envs=9, n_via=3).unwrapped.restore(first.unwrapped.state())
    for source, target in ((first, second), (second, first)):
        target.unwrapped.restore(source.unwrapped.state())
        with pytest.raises(ValueError, match="9 environments"):
            gym.make_vec(env_id, num_envs=3).unwrapped.restore(source.unwrapped.state())
        assert target.unwrapped.physics_steps == source.unwrapped.physics_steps
    expected, found = (each.step(action) for each in (first, second))
    same(expected[0], found[0])
    np.testing.assert_array_equal(expected[1], found[1])


@pytest.mark.parametrize("env_id", [PLANE, STEP, MOVING])
@pytest.mark.parametrize("mode", MODES)
def test_a_limit_of_decisions_is_that_of_gymnasium(env_id, mode):
    limit = 2 if "decide_at" in TASKS[env_id] else 1
    alone = gym.make(env_id, max_episode_steps=limit)
    batch = gym.make_vec(env_id, num_envs=2, max_episode_steps=limit, autoreset_mode=mode)
    alone.reset(seed=3)
    batch.reset(seed=[3, 3])
    for action in actions_for(batch, 2 * limit):
        *_, terminated, truncated, _ = alone.step(action)
        batch = pickle.loads(pickle.dumps(batch))
        *_, over, cut, _ = batch.step(np.stack((action, action)))
        assert (over.tolist(), cut.tolist()) == ([terminated] * 2, [truncated] * 2)
        if terminated or truncated:  # the next episode has as many decisions
            alone.reset(seed=3)
            batch.reset(seed=[3, 3])
    assert truncated or TASKS[env_id]["decide_at"] != "steps"


@pytest.mark.parametrize("begun", [False, True])
def test_a_failed_reset_changes_nothing(env_id, begun):
    usual, refused = gym.make(env_id), gym.make(env_id)
    seed = None if begun else 7
    for env in (usual, refused):
        if begun:
            env.reset(seed=0)
    for options in ({"start": "here"}, {"speed": 1.0}, {"goal": np.full(99, np.nan)}):
        with pytest.raises(ValueError):
            refused.reset(seed=9, options=options)
    zero = np.zeros(usual.action_space.shape, np.float32)
    if begun:
        same(usual.step(zero)[0], refused.step(zero)[0])
    same(usual.reset(seed=seed)[0], refused.reset(seed=seed)[0])
    same(usual.step(zero)[4], refused.step(zero)[4])


def test_scenes_are_those_of_the_twin(env_id):
    twin = env_id.replace("Step-v", "-v")
    mine, theirs = (gym.make_vec(each, num_envs=3).reset(seed=3)[0] for each in (env_id, twin))
    same({name: mine[name] for name in theirs if name in mine}, {n: theirs[n] for n in theirs if n in mine})


@pytest.mark.parametrize("broken", [1e9, np.nan])
def test_broken_physics_ends_its_episode_alone(env_id, broken, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file in the present folder
    env = gym.make_vec(env_id, num_envs=3, threads=1)
    actions = np.zeros(env.action_space.shape)
    results = []
    for spoilt in (False, True):
        env.reset(seed=4)
        if spoilt:
            env.unwrapped._episodes[0].simulator.batch.bind("qvel")[1] = broken
        results.append(env.step(actions))
        assert env.observation_space.contains(results[-1][0])
        assert np.isfinite(results[-1][1]).all()
    (_, whole, *_, before), (_, reward, terminated, _, info) = results
    assert list(info["unstable"]) == [False, True, False]
    assert not before["unstable"].any()
    assert terminated[1]
    assert not info["is_success"][1]
    np.testing.assert_array_equal(reward[[0, 2]], whole[[0, 2]])
    *_, after = env.step(actions)
    assert not after["unstable"].any()  # the next episode is sound


@pytest.mark.parametrize("env_id", [PLANE, STEP, MOVING])
@pytest.mark.parametrize("mode", MODES)
def test_the_native_batch_is_gymnasiums_in_each_mode(env_id, mode):
    mine = gym.make_vec(env_id, num_envs=3, autoreset_mode=mode)
    assert mine.metadata["autoreset_mode"] is AutoresetMode(mode)
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
            with pytest.raises(gym.error.ResetNeeded):
                mine.step(actions)
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


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_wrappers_of_observations_take_the_native_batch(mode):
    """In the modes for which Gymnasium defines them."""
    native = gym.make_vec(PLANE, num_envs=3, autoreset_mode=mode)
    env = wrappers.FlattenObservation(wrappers.RecordEpisodeStatistics(native))
    if mode == "NextStep":
        env = wrappers.NormalizeObservation(env)
    seen, _ = env.reset(seed=0)
    assert seen.shape == env.observation_space.shape
    returns = 0
    for _ in range(4):
        seen, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert np.isfinite(seen).all()
        returns += "episode" in info
        if mode == "Disabled" and (terminated | truncated).any():
            env.reset(options={"reset_mask": terminated | truncated})
    assert returns >= 2


def test_a_loop_as_in_cleanrl_learns():
    """PPO's loop in one file: a batch, a flat observation, a buffer and a few updates."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    number, steps = 32, 4
    envs = gym.make_vec("viapoint/PlanarReach-v0", num_envs=number, autoreset_mode="NextStep")
    envs = wrappers.FlattenObservation(envs)
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
    for env_id in ENV_IDS:
        for env in (envs.GymEnv(env_id), envs.GymWrapper(gym.make(env_id))):
            assert env.rollout(2).batch_size[0] >= 1


def test_rllib():
    pytest.importorskip("ray.rllib")
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
    from ray.tune.registry import register_env

    register_env("reach", lambda config: gym.wrappers.FlattenObservation(gym.make(PLANE, **config)))
    config = PPOConfig().environment("reach", env_config={"n_obstacles": 2}).env_runners(num_env_runners=0)
    episodes = SingleAgentEnvRunner(config=config).sample(num_episodes=3)
    assert [len(episode) for episode in episodes] == [1, 1, 1]


def test_tianshou():
    tianshou = pytest.importorskip("tianshou.env")
    envs = tianshou.DummyVectorEnv([lambda: gym.make(PLANE)] * 2)
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
