"""Invalid arguments raise one error that names the argument, its value and the allowed values."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import FlattenObservation, NormalizeObservation

import viapoint.envs
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.validation import reset_options
from viapoint.envs.mdp.rewards import StepRewardWeights
from viapoint.envs.record_video import RecordMovements
from viapoint.envs.registration import REPLANNING_TASKS

PLANAR = (
    "viapoint/PlanarObstacles-v0",
    "viapoint/PlanarObstaclesStep-v0",
    "viapoint/PlanarMovingObstacles-v0",
)
"""One of each kind."""

assert viapoint.envs, "importing it registers the environments"


@pytest.fixture(params=PLANAR)
def env_id(request):
    return request.param


@pytest.mark.parametrize(
    "kind", [lambda a: a.astype(str), lambda a: a.astype(bool), lambda a: a + 0j, lambda a: a.astype(object)]
)
def test_actions_are_real_numbers(env_id, kind):
    single, batch = gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1)
    for env in (single, batch):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action must be real numbers of shape \(\d, ?\d?\), got array"):
            env.step(kind(np.ones(env.action_space.shape)))
        env.step(np.zeros(env.action_space.shape, dtype=np.int8))  # nothing was done by it
        env.close()


def test_actions_of_different_lengths_are_refused_in_our_words(env_id):
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1)):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action must be real numbers of shape \(\d, ?\d?\), got \[\["):
            env.step([[0.0], [0.0, 0.0]])
        env.close()


@pytest.mark.parametrize("options", [5, "abc", [1, 2], 0, np.zeros(2)])
def test_options_are_a_mapping(env_id, options):
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1).unwrapped):
        with pytest.raises(ValueError, match="options must be a mapping from names to values, or None, got"):
            env.reset(options=options)
        env.close()


def test_options_are_copied():
    given = {"start": (0.0, 0.4)}
    reset_options(given).pop("start")
    assert given == {"start": (0.0, 0.4)}
    assert reset_options(None) == {}


def test_an_unknown_option_is_answered_with_those_that_there_are(env_id):
    known = "start, goal, obstacles"
    known += ", jumps, courses" if env_id in REPLANNING_TASKS else ""
    env = gym.make_vec(env_id, num_envs=2, threads=1)
    with pytest.raises(ValueError, match=f"^reset options know {known} and reset_mask, not 'speed'$"):
        env.reset(options={"speed": 3})
    env.close()


def test_via_points_are_bounded_before_anything_is_made():
    with pytest.raises(ValueError, match="n_via must be a whole number, from 0 to 16, got 1000000000"):
        gym.make(PLANAR[0], n_via=10**9)
    env = gym.make(PLANAR[0], n_via=16).unwrapped
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert info["jerk_ratio"] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("pair", [("0.5", "1"), (True, 2), (0.5, None), 3, None, "ab", (1.0,), (1 + 0j, 2.0)])
def test_a_range_of_durations_is_two_numbers(env_id, pair):
    with pytest.raises(ValueError, match="duration_range must be two numbers, got"):
        gym.make(env_id, duration_range=pair)


@pytest.mark.parametrize("pair", [[0.5, 1], np.array([0.5, 1.0], np.float32), (np.int64(1), 2)])
def test_any_two_numbers_are_a_range(env_id, pair):
    assert gym.make(env_id, duration_range=pair).unwrapped.task.action.duration_range == tuple(
        map(float, pair)
    )


def test_weights_of_terms_that_a_task_has_not_are_refused():
    for env_id in (PLANAR[0], PLANAR[2]):
        with pytest.raises(ValueError, match=r"reward_weights knows success, .*, not 'progress'$"):
            gym.make(env_id, reward_weights=StepRewardWeights())
    for env_id in PLANAR:
        with pytest.raises(ValueError, match=r"reward_weights knows success, .*, not 'speed', 1$"):
            gym.make(env_id, reward_weights={1: 2.0, "speed": 1.0})


def test_what_the_number_of_environments_is_called_is_not_offered(env_id):
    for make in (gym.make, lambda name, **given: gym.make_vec(name, num_envs=2, **given)):
        with pytest.raises(
            TypeError, match=r"unknown keyword argument 'speed'; allowed are arm, whole_arm, "
        ):
            make(env_id, speed=1.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda way, time: (way + 0.1, time),
            r"plan 0 must begin where the hand is, at .* m, got .* m, 0\.1414 m from there",
        ),
        (lambda way, time: (way[:1], time), r"waypoints of shape \(2, K \+ 2, 2\), got \(1, 2, 2\)"),
        (lambda way, time: (way[:, :1], time), r"waypoints of shape .*, got \(2, 1, 2\)"),
        (lambda way, time: (way, time[:, [0, 0]]), r"durations of shape \(2, 1\), got \(2, 2\)"),
        (lambda way, time: (way, -time), "durations must not be negative"),
        (lambda way, time: (way * np.nan, time), "finite"),
        (lambda way, time: ("there", time), "plan must be waypoints and durations"),
    ],
)
def test_a_plan_begins_where_the_hand_is(change, reason):
    env = gym.make_vec(PLANAR[0], num_envs=2, threads=1).unwrapped
    env.reset(seed=0)
    scenes = env.scenes
    waypoints, durations = np.stack((scenes.start, scenes.goal), axis=1), np.full((2, 1), 0.8)
    with pytest.raises(ValueError, match=reason):
        env.execute_plan(Plan(*change(waypoints, durations)))
    assert (
        env.execute_plan(Plan(waypoints.tolist(), durations.tolist())).info["jerk_ratio"] < 1.0 + 1e-9
    ).all()
    env.close()


@pytest.mark.parametrize("mode", [None, "human", "rgb_array"])
def test_movements_are_recorded_of_every_frame_or_not_at_all(mode, tmp_path):
    env = gym.Wrapper(gym.Env())
    env.env.render_mode = mode
    with pytest.raises(ValueError, match=f"needs render_mode='rgb_array_list', got {mode!r}"):
        RecordMovements(env, str(tmp_path))


@pytest.mark.parametrize(
    "wrap", [FlattenObservation, lambda env: NormalizeObservation(FlattenObservation(env))]
)
def test_vector_wrappers_of_gymnasium_take_what_the_page_says(wrap):
    env = wrap(gym.make_vec(PLANAR[0], num_envs=2, vectorization_mode="sync"))
    seen, _ = env.reset(seed=0)
    assert seen.shape == (2, 36)
    for _ in range(3):
        seen, *_ = env.step(env.action_space.sample())
        assert np.isfinite(seen).all()
    env.close()
