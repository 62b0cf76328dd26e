"""What every registered environment keeps to."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as sb3_check

from viapoint.envs import TASKS
from viapoint.envs.mdp.rewards import RewardTerms
from viapoint.envs.registration import REPLANNING_TASKS, STEP_TASKS

IDS = sorted({*TASKS, *STEP_TASKS, *REPLANNING_TASKS})
INFO = {
    "is_success", "collision", "first_contact_time", "min_clearance", "goal_error", "duration", "path_length",
    "jerk_cost", "jerk_ratio", "peak_speed", "tracking_error", "reachable", "unstable",
}  # fmt: skip


@pytest.fixture(params=IDS)
def env_id(request):
    return request.param


def play(env, action):
    """The same action until the episode ends: its last step."""
    while True:
        last, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return last, reward, info


def episodes(env_id, seeds, actions, **kwargs):
    """One episode from each seed, environment by environment: first and last observation, last reward and info."""
    env = gym.make(env_id, **kwargs)
    result = []
    for seed, action in zip(seeds, actions, strict=True):
        first, _ = env.reset(seed=int(seed))
        result.append((first, *play(env, action)))
    env.close()
    return result


def actions_for(env_id, number, scale=1.0):
    size = gym.make(env_id).action_space.shape[0]
    return (scale * np.random.default_rng(3).uniform(-1.0, 1.0, (number, size))).astype(np.float32)


def test_both_checkers_pass_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Rows of obstacles of any shape are a matrix, which Stable-Baselines3's extractor and ours take.
        warnings.filterwarnings("ignore", "Your observation obstacles has an unconventional shape")
        gymnasium_check(gym.make(env_id).unwrapped, skip_render_check=True)
        sb3_check(gym.make(env_id), warn=True, skip_render_check=True)


def test_info_is_complete_finite_and_scalar_and_holds_the_terms_of_the_reward(env_id):
    for *_, reward, info in episodes(env_id, range(20), actions_for(env_id, 20)):
        assert set(info) >= INFO
        assert set(info) >= {f"reward_{name}" for name in RewardTerms._fields}
        for name, value in info.items():
            assert isinstance(value, bool | float | (int if env_id in REPLANNING_TASKS else float)), name
            assert np.isfinite(value), name
        assert reward == pytest.approx(sum(v for k, v in info.items() if k.startswith("reward_")), abs=1e-12)


def test_the_next_episodes_are_those_of_a_reset(env_id):
    """Autoreset draws what reset would have drawn."""
    env, single = gym.make_vec(env_id, num_envs=3), gym.make(env_id)
    env.reset(seed=8)
    ended = False
    while not ended:
        following, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
        ended = (terminated | truncated)[2]
    single.reset(seed=10)
    play(single, np.zeros(single.action_space.shape, dtype=np.float32))
    again, _ = single.reset()
    for name, part in again.items():
        np.testing.assert_array_equal(part, following[name][2])


def test_observations_share_no_memory_and_stay_in_their_space(env_id):
    env = gym.make_vec(env_id, num_envs=16)
    before, _ = env.reset(seed=0)
    kept = {name: part.copy() for name, part in before.items()}
    for action in actions_for(env_id, 8):
        after, _, terminated, truncated, info = env.step(np.tile(action, (16, 1)))
        ended = terminated | truncated
        assert (info.get("_final_info", np.zeros(16, dtype=bool)) == ended).all()
        for name, value in info.get("final_info", {}).items():
            np.testing.assert_array_equal(value[ended], info[name][ended])
        assert env.observation_space.contains(after)
        last = [each for each in info.get("final_obs", ()) if each is not None]
        assert all(env.single_observation_space.contains(each) for each in last)
        assert not any(np.shares_memory(before[name], after[name]) for name in before)
    for name, part in kept.items():
        np.testing.assert_array_equal(part, before[name])


def test_no_element_of_the_observation_is_constant(env_id):
    env = gym.make_vec(env_id, num_envs=64)
    seen = [env.reset(seed=0)[0]]
    for action in actions_for(env_id, 2):
        seen.append(env.step(np.tile(action, (64, 1)))[0])
    for name, part in seen[0].items():
        assert part.dtype == np.float32
        assert (np.ptp(np.concatenate([each[name] for each in seen]), axis=0) > 0.0).all(), name


def test_everything_in_the_model_has_a_name(env_id):
    model = gym.make(env_id).unwrapped.model
    counts = {"body": model.nbody, "geom": model.ngeom, "joint": model.njnt, "actuator": model.nu}
    for kind, count in counts.items():
        for index in range(count):
            assert getattr(model, kind)(index).name, f"{kind} {index}"


def test_a_pickled_environment_is_as_it_was_made_whatever_becomes_of_the_arguments(env_id):
    weights = {"smoothness": 0.2}
    made = gym.make(env_id, reward_weights=weights).unwrapped
    several = gym.make_vec(env_id, num_envs=2, reward_weights=weights)
    weights["smoothness"] = 5.0
    for env in (made, several):
        again = pickle.loads(pickle.dumps(env))
        assert again.task.weights == env.task.weights
        wanted = env.reset(seed=4)[0]
        for name, part in again.reset(seed=4)[0].items():
            np.testing.assert_array_equal(part, wanted[name])


def test_what_a_step_returns_may_be_written_to(env_id):
    """As a wrapper may that ends episodes by a limit of its own."""
    env, same = (gym.make_vec(env_id, num_envs=3, threads=1) for _ in range(2))
    env.reset(seed=1)
    same.reset(seed=1)
    for _ in range(4):
        results = [each.step(np.zeros(env.action_space.shape)) for each in (env, same)]
        for mine, theirs in zip(*(result[1:4] for result in results), strict=True):
            np.testing.assert_array_equal(mine, theirs)
            mine[:] = 1


def test_vector_environment_names_its_autoreset_mode_and_counts_physics_steps(env_id):
    env = gym.make_vec(env_id, num_envs=4)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=0)
    assert env.physics_steps == 0
    _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    assert env_id not in TASKS or (terminated.all() and not truncated.any())
    assert env.physics_steps >= info["duration"].sum() / env.model.opt.timestep


def test_a_reset_mask_resets_only_those(env_id):
    env = gym.make_vec(env_id, num_envs=4)
    before, _ = env.reset(seed=0)
    mask = np.array([True, False, True, False])
    after, _ = env.reset(options={"reset_mask": mask})
    for name, part in before.items():
        np.testing.assert_array_equal(part[~mask], after[name][~mask])
    assert not np.array_equal(before["goal"][mask], after["goal"][mask])
