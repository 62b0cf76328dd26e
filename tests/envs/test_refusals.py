"""Bad input raises one error where it enters: the input, and the type of the error."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from revised import GOAL, JUMP, MOVING, NO_ROWS, OTHER, START

from viapoint.envs.actions.via_points import ActionLayout, Plan
from viapoint.envs.mdp.rewards import RewardWeights, StepRewardWeights
from viapoint.envs.mdp.task import family_sampler
from viapoint.envs.record_video import RecordMovements
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.families import register_scene_family

PLANAR, STEP, SPACE = (
    f"viapoint/{name}-v0" for name in ("PlanarObstacles", "PlanarObstaclesStep", "PandaObstacles")
)
KINDS = (PLANAR, STEP, MOVING)
ANY_ENVIRONMENT = [
    ({"speed": 1.0}, TypeError),
    ({"workers": 2}, TypeError),
    ({"uniform_share": 0.5}, TypeError),
    ({"render_mode": "rgb"}, ValueError),
    ({"width": 0}, ValueError),
    ({"height": -3}, ValueError),
    ({"width": 2.5}, ValueError),
    ({"height": True}, ValueError),
    ({"arm": "ur5"}, ValueError),
    ({"whole_arm": "yes"}, TypeError),
    ({"n_obstacles": -1}, ValueError),
    ({"n_obstacles": (9, 24)}, ValueError),
    ({"threads": -1}, ValueError),
    ({"reward_weights": {"speed": 1.0}}, ValueError),
    ({"reward_weights": {"success": -1.0}}, ValueError),
    ({"reward_weights": {1: 2.0, "speed": 1.0}}, ValueError),
    *(({"duration_range": pair}, ValueError) for pair in (("0.5", "1"), (True, 2), (0.5, None), 3, "ab")),
    *(({"duration_range": pair}, ValueError) for pair in ((1.0,), (1 + 0j, 2.0), (1.0, 0.5), (0.0, 0.5))),
]
ONE_ENVIRONMENT = [
    (PLANAR, {"n_via": 10**9}),
    (PLANAR, {"timing": "fast"}),
    (PLANAR, {"reward_weights": StepRewardWeights()}),
    (MOVING, {"reward_weights": StepRewardWeights()}),
    (STEP, {"reward_weights": RewardWeights()}),
    *((STEP, {"control_step": step}) for step in (0.0, -0.04, 0.003, 2.0, np.nan, "fast", True)),
    (JUMP, {"horizon": 0.001}),
    (JUMP, {"horizon": np.nan}),
    (JUMP, {"margin": -0.1}),
    (JUMP, {"decide_at": ("noon",)}),
    (JUMP, {"decide_at": "target"}),
    (JUMP, {"timing": "learned"}),
    (JUMP, {"n_jumps": 9}),
    (JUMP, {"n_jumps": (1, 2, 3)}),
]
ENDS = {"start": START, "goal": GOAL}
POST = [-0.1, 0.6, 0.0, 0.0, 0.03]
PARTS_OF_SCENES = [{"goal": [2.0, 0.0]}, {"start": [0.0, 0.05]}, {"start": START, "goal": START}]
SCENES = [
    {"goal": [2.0, 0.0]},
    {"start": [0.0, 0.05]},
    {"goal": START, "obstacles": [[-0.1, 0.4, 0.0, 0.1, 0.01]]},
    {"obstacles": [[-0.3, 0.41, 0.0, 0.0, 0.02]]},
    {"obstacles": [[-0.1, 0.4, 0.0, 0.1]]},
    {"obstacles": np.zeros((6, 5))},
    {"obstacles": [[-0.1, 0.4, 0.0, 0.1, -0.01]]},
    {"obstacles": [[-0.1, 0.4, 0.0, 0.1, 0.0]]},
    {"obstacles": [[-0.1, 0.4, 0.0, 0.9, 0.01]]},
    {"start": [np.nan, 0.4]},
    {"start": [0.1, 0.2, 0.3]},
    {"start": [-0.3 + 0.1j, 0.4]},
    {"target": [0.1, 0.2]},
]
CHANGES = [
    {"jumps": [[0.0, *OTHER]]},
    {"jumps": [[-0.1, *OTHER]]},
    {"jumps": [[0.5, *OTHER], [0.4, *GOAL]]},
    {"jumps": [[99.0, *OTHER]]},
    {"jumps": [[0.2, 3.0, 0.0]]},
    {"jumps": [[0.2, 3.0]]},
    {"jumps": [[0.2, np.nan, 0.3]]},
    {"jumps": [["soon", 0.0, 0.3]]},
    {"courses": [[0.1, 0.0, 0.0, 0.1, 0.0]]},
    {"obstacles": [[*START, 0.0, 0.0, 0.03]], "courses": [[0.1, 0.0, 0.0, 0.1, 0.0]]},
    {"obstacles": [POST], "courses": [[0.1, 0.0, 0.0, 0.2, 0.0]]},
    {"obstacles": [POST], "courses": [[3.0, 0.0, 0.0, 3.0, 0.0]]},
    {"obstacles": [[*OTHER, 0.0, 0.0, 0.03]], "jumps": [[0.2, *OTHER]]},
]


def both(env_id):
    """An environment and a batch after a reset."""
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1)):
        env.reset(seed=0)
        yield env
        env.close()


@pytest.mark.filterwarnings("ignore:.*render_mode='rgb' that is not")  # Gymnasium's, before our error
@pytest.mark.parametrize("env_id", KINDS)
@pytest.mark.parametrize(("kwargs", "error"), ANY_ENVIRONMENT)
def test_arguments_of_any_environment(env_id, kwargs, error):
    with pytest.raises(error):
        gym.make(env_id, **kwargs)
    with pytest.raises(error):
        gym.make_vec(env_id, num_envs=2, **kwargs)


@pytest.mark.parametrize(("env_id", "kwargs"), ONE_ENVIRONMENT)
def test_arguments_of_one_environment(env_id, kwargs):
    with pytest.raises(ValueError):
        gym.make(env_id, **kwargs)


def test_an_unknown_argument_is_answered_with_those_that_there_are():
    with pytest.raises(TypeError, match=r"'speed'; allowed are arm, .*n_obstacles"):
        gym.make(PLANAR, speed=3)


@pytest.mark.parametrize("env_id", KINDS)
def test_actions(env_id):
    for env in both(env_id):
        zero = np.zeros(env.action_space.shape)
        bad = [zero.astype(kind) for kind in (str, bool, complex, object)]
        bad += [zero + np.nan, zero - np.inf, zero[..., :-1], "north", [[0.0], [0.0, 0.0]]]
        for action in bad:
            with pytest.raises(ValueError):
                env.step(action)
        env.step(zero.astype(np.int8))  # nothing was done by those


@pytest.mark.parametrize("env_id", KINDS)
def test_seeds_options_and_masks(env_id):
    for env in both(env_id):
        for options in (5, "abc", [1, 2], 0, np.zeros(2), {"speed": 3}, {"jumps": "soon"}):
            with pytest.raises(ValueError):
                env.reset(options=options)
        for seed in (-1, 1.5, "a", np.array(1.5), np.array([[1]])):
            with pytest.raises(ValueError):
                env.reset(seed=seed)
    for mask in ([True], [True, 1, 0], np.zeros(2, bool), "all"):
        with pytest.raises(ValueError):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError):
        gym.make_vec(env_id, num_envs=2).reset(options={"reset_mask": np.array([True, False])})


def test_plans_are_for_the_twin_of_an_environment_with_steps():
    env = gym.make_vec(STEP, num_envs=2).unwrapped
    env.reset(seed=0)
    with pytest.raises(TypeError):
        env.execute_plan(env.last_plan)


@pytest.mark.parametrize("env_id", KINDS)
def test_steps_before_a_reset(env_id):
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2).unwrapped):
        with pytest.raises(gym.error.ResetNeeded):
            env.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        *((PLANAR, each) for each in PARTS_OF_SCENES),
        *((PLANAR, {**ENDS, **NO_ROWS, **each}) for each in SCENES),
        *((MOVING, {**ENDS, **NO_ROWS, **each}) for each in CHANGES),
    ],
)
def test_impossible_scenes_change_nothing(env_id, options):
    usual, refused = (gym.make(env_id).unwrapped for _ in range(2))
    for env in (usual, refused):
        env.reset(seed=0)
    for seed in (9, None):
        with pytest.raises(ValueError):
            refused.reset(seed=seed, options=options)
    for now, then in zip(refused.batch.scenes, usual.batch.scenes, strict=True):
        np.testing.assert_array_equal(now, then)
    expected, found = (env.reset()[0] for env in (usual, refused))
    for name, part in expected.items():
        np.testing.assert_array_equal(found[name], part)


def test_the_reason_names_what_is_in_the_way():
    rows = [[0.4, 0.4, 0.0, 0.0, 0.02], [0.1, 0.41, 0.0, 0.0, 0.02]]
    with pytest.raises(ValueError, match=r"obstacle 1 .* touches the arm at the goal"):
        gym.make(PLANAR).reset(options={**ENDS, "obstacles": rows})


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
@pytest.mark.parametrize("env_id", [PLANAR, MOVING])
def test_plans(env_id, change):
    env = gym.make_vec(env_id, num_envs=2, threads=1).unwrapped
    env.reset(seed=0)
    scenes = env.scenes
    waypoints = np.stack((scenes.start, 0.5 * (scenes.start + scenes.goal), scenes.goal), axis=1)
    durations = np.full((2, 2), 0.4)
    with pytest.raises(ValueError):
        env.execute_plan(Plan(*change(waypoints, durations)))
    info = env.execute_plan(Plan(waypoints.tolist(), durations.tolist())).info
    assert (info["jerk_ratio"] < 1.0 + 1e-9).all()
    env.close()


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        *((ActionLayout, {"n_via": number}) for number in (-1, 1.5, 17)),
        *((ActionLayout, {"via_scale": scale}) for scale in ((np.inf, 0.1), (0.1,), ("far", 0.1), 0.1)),
        (ActionLayout, {"dimension": 4}),
        (ActionLayout, {"timing": "free"}),
        (SceneDistribution, {"n_obstacles": (3, 2)}),
        (SceneDistribution, {"n_obstacles": (-1, 2)}),
        (SceneDistribution, {"distance": (0.4, 0.2)}),
        (SpaceDistribution, {"n_obstacles": (3, 2)}),
        (SpaceDistribution, {"n_obstacles": (0, 257)}),
        (SpaceDistribution, {"distance": (0.4, 0.2)}),
        (SpaceDistribution, {"families": ("wall",)}),
        (SpaceDistribution, {"families": ("gate",), "n_obstacles": (1, 2)}),
    ],
)
def test_records(kind, arguments):
    with pytest.raises(ValueError):
        kind(**arguments)


ACTIONS = [((size,), (2,), (2,)) for size in (2, 5)]
ACTIONS += [((4, 2), (4, 2), (4, 2)), ((), (2,), (2,)), ((3,), (3,), (3,)), ((3,), (2,), (3,))]
ACTIONS += [((4, 3), (4, 2), (2,)), ((4, 3), (5, 2), (5, 2)), ((4, 3), (2,), (2,))]
PLANS = [((4, 2), (3,)), ((3, 3), (2,)), ((2,), (1,)), ((3, 2), (3,)), ((7, 3, 2), (2,))]


@pytest.mark.parametrize("kind", [np.ones, torch.ones])
@pytest.mark.parametrize("shapes", [*ACTIONS, *PLANS])
def test_shapes_of_actions_and_plans(kind, shapes):
    layout, arrays = ActionLayout(), [kind(shape) for shape in shapes]
    with pytest.raises(ValueError):
        layout.decode(*arrays) if len(shapes) == 3 else layout.encode(Plan(*arrays))


@pytest.mark.parametrize(
    ("env_id", "kwargs", "family"),
    [
        (PLANAR, {}, "maze"),
        (PLANAR, {"n_obstacles": 2}, "gate"),
        (SPACE, {}, "ring"),
        (SPACE, {"n_obstacles": 5, "shapes": "capsule"}, "tunnel"),
        (SPACE, {"shapes": "capsule"}, "bin"),
    ],
)
def test_families_of_a_task(env_id, kwargs, family):
    with pytest.raises(ValueError):
        family_sampler(gym.make(env_id, **kwargs).unwrapped.task, family)


def post(uniforms, site):
    radius = 0.02 + 0.0 * uniforms.take(1)
    return np.concatenate((0.5 * (site.start + site.goal), 0.0 * site.start, radius), axis=-1)[:, None]


@pytest.mark.parametrize(
    ("name", "build", "numbers", "error"),
    [
        ("gate", post, {}, ValueError),
        ("", post, {}, ValueError),
        (3, post, {}, TypeError),
        ("ball", lambda site: None, {}, TypeError),
        ("ball", 3, {}, TypeError),
        ("ball", post, {"dimension": 4}, ValueError),
        ("ball", post, {"n_obstacles": 0}, ValueError),
        ("ball", post, {"n_obstacles": 9, "dimension": 3}, ValueError),
        ("ball", post, {"n_obstacles": 1.5}, ValueError),
    ],
)
@pytest.mark.usefixtures("registry")
def test_families_to_register(name, build, numbers, error):
    with pytest.raises(error):
        register_scene_family(name, build, **numbers)


@pytest.mark.parametrize(
    "build",
    [
        lambda uniforms, site: np.zeros((3, 1, 5)),
        lambda uniforms, site: np.repeat(post(uniforms, site), 2, axis=1),
        lambda uniforms, site: np.nan * post(uniforms, site),
        lambda uniforms, site: None,
        lambda uniforms, site: uniforms.take(15),
    ],
)
@pytest.mark.usefixtures("registry")
def test_obstacles_of_families(build):
    register_scene_family("wrong", build, n_obstacles=1)
    sampler = family_sampler(gym.make(PLANAR).unwrapped.task, "wrong")
    with pytest.raises(ValueError):
        sampler([np.random.default_rng(seed) for seed in range(8)])


@pytest.mark.parametrize("mode", [None, "human", "rgb_array"])
def test_modes_of_which_no_movement_can_be_recorded(mode, tmp_path):
    env = gym.Wrapper(gym.Env())
    env.env.render_mode = mode
    with pytest.raises(ValueError):
        RecordMovements(env, str(tmp_path))
