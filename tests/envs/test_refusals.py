"""Bad input raises one error where it enters: the input, and the type of the error."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from episodes import JUMP, MOVING, OBSTACLES, PANDA, STEP

from viapoint.envs import ReachVectorEnv, Task
from viapoint.envs.env import RecordMovements
from viapoint.envs.plans import ActionLayout, Plan
from viapoint.envs.rewards import RewardWeights

KINDS = (OBSTACLES, STEP, MOVING, PANDA)
ANY_ENVIRONMENT = [
    *(({name: 1.0}, TypeError) for name in ("speed", "workers", "uniform_share", "dimension")),
    ({"render_mode": "rgb"}, ValueError), ({"width": 0}, ValueError), ({"height": -3}, ValueError),
    ({"width": 2.5}, ValueError), ({"height": True}, ValueError), ({"threads": -1}, ValueError),
    ({"max_episode_steps": 0}, ValueError),
    ({"arm": "ur5"}, ValueError), ({"arm": 5}, ValueError), ({"space": "hands"}, ValueError),
    ({"whole_arm": "yes"}, TypeError), ({"moving_obstacles": 1}, TypeError), ({"shapes": 3}, TypeError),
    ({"courses": "walks"}, ValueError),
    ({"shapes": ()}, ValueError), ({"shapes": "pyramid"}, ValueError), ({"shapes": ("box", "box")}, ValueError),
    ({"families": 3}, TypeError), ({"families": ()}, ValueError), ({"families": "maze"}, ValueError),
    *(({"n_obstacles": number}, ValueError) for number in (-1, 1.5, True, (3, 2), (40, 50), (0, 257), "many")),
    *(({"n_via": number}, ValueError) for number in (-1, 1.5, 17, 10**9, True)),
    ({"timing": "fast"}, ValueError), ({"margin": -0.1}, ValueError), ({"horizon": 0.0}, ValueError),
    ({"horizon": np.nan}, ValueError), ({"n_jumps": 9}, ValueError), ({"n_jumps": (1, 2, 3)}, ValueError),
    *(({"decide_at": events}, ValueError) for events in ("noon", "target", ("noon",), 3, None, {"target"})),
    ({"reward_weights": {"speed": 1.0}}, ValueError), ({"reward_weights": {"success": -1.0}}, ValueError),
    ({"reward_weights": {1: 2.0}}, ValueError), ({"reward_weights": 3.0}, ValueError),
    *(({"duration_range": pair}, ValueError) for pair in (
        ("0.5", "1"), (True, 2), (0.5, None), 3, "ab", (1.0,), (1 + 0j, 2.0), (1.0, 0.5), (0.0, 0.5), (1.0, 100.0),
    )),
    *(({"autoreset_mode": mode}, ValueError) for mode in ("sometimes", None, 3)),
]  # fmt: skip
ONE_ENVIRONMENT = [
    (PANDA, {"space": "hand"}), (PANDA, {"duration_range": (0.5, 2.0)}),
    (PANDA, {"families": "gate", "n_obstacles": 2}),
    (PANDA, {"families": "gate", "shapes": "sphere"}), (OBSTACLES, {"families": "shelf"}), (OBSTACLES, {"n_jumps": 1}),
    (OBSTACLES, {"moving_obstacles": True}), (MOVING, {"timing": "learned"}), (STEP, {"timing": "learned"}),
    *((STEP, {"control_step": step}) for step in (0.0, -0.04, 0.003, 2.0, np.nan, "fast", True)),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*render_mode='rgb' that is not")  # Gymnasium's, before our error
@pytest.mark.parametrize("env_id", KINDS)
@pytest.mark.parametrize(("kwargs", "error"), ANY_ENVIRONMENT)
def test_arguments_of_any_environment(env_id, kwargs, error):
    for make in (gym.make, gym.make_vec):
        with pytest.raises(error):
            make(env_id, **kwargs)


@pytest.mark.parametrize(("env_id", "kwargs"), ONE_ENVIRONMENT)
def test_arguments_of_one_environment(env_id, kwargs):
    with pytest.raises(ValueError):
        gym.make(env_id, **kwargs)


def test_an_unknown_argument_is_the_error_that_others_raise():
    """TorchRL looks for these words."""
    for make in (gym.make, gym.make_vec):
        with pytest.raises(TypeError, match="got an unexpected keyword argument 'speed'"):
            make(OBSTACLES, speed=3)


def both(env_id):
    """Yield an environment and a batch after a reset."""
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1).unwrapped):
        env.reset(seed=0)
        yield env
        env.close()


@pytest.mark.parametrize("env_id", KINDS)
def test_actions(env_id):
    for env in both(env_id):
        zero = np.zeros(env.action_space.shape)
        bad = [zero.astype(kind) for kind in (str, bool, complex, object)]
        bad += [zero + np.nan, zero - np.inf, zero[..., :-1], "north", [[0.0], [0.0, 0.0]], None]
        for action in bad:
            with pytest.raises(ValueError):
                env.step(action)
        with pytest.raises(ValueError) as raised:
            env.step(zero[..., :-1])
        assert f"shape {zero.shape}, got" in str(raised.value)
        env.step(zero.astype(np.int8))  # nothing was done by those


@pytest.mark.parametrize("env_id", KINDS)
def test_seeds_options_and_masks(env_id):
    for env in both(env_id):
        for options in (5, "abc", [1, 2], 0, np.zeros(2), {"speed": 3}, {"jumps": "soon"}):
            with pytest.raises(ValueError):
                env.reset(options=options)
        for seed in (-1, 1.5, "a", np.array(1.5), np.array([[1]]), [1, 2, 3]):
            with pytest.raises(ValueError):
                env.reset(seed=seed)
    for mask in ([True], [True, 1, 0], np.zeros(2, bool), "all"):
        with pytest.raises(ValueError):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError):
        gym.make_vec(env_id, num_envs=2).reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize("env_id", KINDS)
def test_steps_before_a_reset(env_id):
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2).unwrapped):
        for call in (lambda env=env: env.step(np.zeros(env.action_space.shape)), env.render):
            with pytest.raises(gym.error.ResetNeeded):
                call()


@pytest.mark.parametrize(
    "change",
    [
        lambda way, time: (way + 0.1, time),
        lambda way, time: (way[:1], time),
        lambda way, time: (way[:, :1], time),
        lambda way, time: (way, time[:, :1]),
        lambda way, time: (way, -time),
        lambda way, time: (way * np.nan, time),
        lambda way, time: ("there", time),
    ],
)
@pytest.mark.parametrize("env_id", [OBSTACLES, MOVING, PANDA])
def test_plans(env_id, change):
    env = gym.make_vec(env_id, num_envs=2, threads=1).unwrapped
    env.reset(seed=0)
    space, scenes = env.task.space, env.scenes
    start, goal = space.coordinates(scenes.start), space.coordinates(scenes.goal)
    waypoints = np.stack((start, 0.5 * (start + goal), goal), axis=1)
    durations = np.full((2, 2), 0.4)
    with pytest.raises(ValueError):
        env.execute_plan(Plan(*change(waypoints, durations)))
    info = env.execute_plan(Plan(waypoints.tolist(), durations.tolist())).info
    assert (info["jerk_ratio"] < 1.0 + 1e-9).all()


def test_plans_are_for_the_twin_of_an_environment_with_steps():
    env = gym.make_vec(STEP, num_envs=2).unwrapped
    env.reset(seed=0)
    with pytest.raises(TypeError):
        env.execute_plan(Plan(np.zeros((2, 3, 2)), np.ones((2, 2))))


@pytest.mark.parametrize(
    "goals", [np.full((2, 2), 3.0), np.zeros(2), np.full((2, 2), np.nan), "there", np.zeros((2, 3))]
)
def test_goals_that_are_moved(goals):
    env = gym.make_vec(JUMP, num_envs=2, threads=1).unwrapped
    env.reset(seed=0)
    before = env.observe()
    with pytest.raises(ValueError):
        env.move_goals(goals)
    np.testing.assert_array_equal(env.observe()["goal"], before["goal"])


HAND = {
    "space": "hand",
    "names_of_axes": ("along", "across"),
    "via_scale": (0.1, 0.2),
    "duration_range": (0.5, 1.0),
}
LAYOUT = ActionLayout(**HAND)


def record(**change):
    return Task.from_dict({**Task.of().as_dict(), **change})


def recorder(mode):
    env = gym.Wrapper(gym.Env())
    env.env.render_mode = mode
    return RecordMovements(env, "nowhere")


def decoded(*shapes):
    return LAYOUT.decode(*map(np.ones, shapes))


def encoded(*shapes):
    return LAYOUT.encode(Plan(*map(np.ones, shapes)))


CALLS = [
    (ReachVectorEnv, [(0,), (-1,), (1.5,), (True,), ("two",)]),
    (lambda change: ActionLayout(**{**HAND, **change}), [
        *(({"n_via": number},) for number in (-1, 1.5, 17)),
        *(({"via_scale": scale},) for scale in ((np.inf, 0.1), (0.1,), ("far", 0.1), 0.1, (0.0, 0.1))),
        ({"timing": "free"},), ({"space": "joints", "rate_limit": (1.0, 1.0)},),
    ]),
    (decoded, [
        ((2,), (2,), (2,)), ((5,), (2,), (2,)), ((4, 2), (4, 2), (4, 2)), ((), (2,), (2,)), ((3,), (3,), (3,)),
        ((3,), (2,), (3,)),
    ]),
    (encoded, [((4, 2), (3,)), ((3, 3), (2,)), ((2,), (1,)), ((3, 2), (3,))]),
    (lambda change: record(**change), [({"arm": "none"},), ({"n_via": 99},)]),
    (lambda weights: RewardWeights(**weights), [
        ({"success": np.nan},), ({"success": "much"},), ({"duration": -0.1},), ({"progress": True},),
    ]),
    (recorder, [(None,), ("human",), ("rgb_array",)]),
]  # fmt: skip


@pytest.mark.parametrize(("call", "arguments"), CALLS)
def test_arguments_of_classes_and_functions(call, arguments):
    for each in arguments:
        with pytest.raises(ValueError):
            call(*each)


def test_a_copy_of_a_task_is_equal():
    task = Task.of(arm="panda")
    assert copy.deepcopy(task) == task


def test_records_of_tasks():
    assert record() == Task.of()
    for change in ({"speed": 1}, {"shapes": 1}):
        with pytest.raises(TypeError):
            record(**change)
