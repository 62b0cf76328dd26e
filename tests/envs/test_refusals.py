"""Bad input raises one error where it enters: the input, and the type of the error."""

import dataclasses
import functools

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from helpers import CRATE, ENDS, HOME, JUMPS, MOVING, OTHER, PANDA, PANDA_ENDS, PLANE, STEP, post, same_scenes

import viapoint.envs as ve
from viapoint.envs.geometry.obstacles import add_to_model, geom_meshes, pack
from viapoint.envs.scenes.families_registry import scene_families
from viapoint.envs.scenes.layout import Layout
from viapoint.envs.scenes.sampler import room_of

KINDS = (PLANE, STEP, MOVING, PANDA)
ANY_ENVIRONMENT = [
    *(({name: 1.0}, TypeError) for name in ("speed", "workers", "uniform_share", "dimension")),
    ({"render_mode": "rgb"}, ValueError), ({"width": 0}, ValueError), ({"height": -3}, ValueError),
    ({"width": 2.5}, ValueError), ({"height": True}, ValueError), ({"threads": -1}, ValueError),
    ({"max_episode_steps": 0}, ValueError),
    ({"arm": "ur5"}, ValueError), ({"arm": 5}, ValueError), ({"space": "hands"}, ValueError),
    ({"whole_arm": "yes"}, TypeError), ({"moving_obstacles": 1}, TypeError), ({"shapes": 3}, TypeError),
    ({"courses": "walks"}, ValueError), ({"courses": "reaches", "moving_obstacles": False}, ValueError),
    ({"shapes": ()}, ValueError), ({"shapes": "point_cloud"}, ValueError), ({"shapes": ("box", "box")}, ValueError),
    ({"families": 3}, TypeError), ({"families": ()}, ValueError), ({"families": "maze"}, ValueError),
    *(({"n_obstacles": number}, ValueError) for number in (-1, 1.5, True, (3, 2), (40, 50), (0, 257), "many")),
    *(({"n_via": number}, ValueError) for number in (-1, 1.5, 33, 10**9, True)),
    *(({"via_range": factor}, ValueError) for factor in (0.0, 10.0, np.nan, "far", True)),
    ({"timing": "fast"}, ValueError), ({"margin": -0.1}, ValueError), ({"horizon": 0.0}, ValueError),
    ({"horizon": np.nan}, ValueError), ({"n_jumps": 9}, ValueError), ({"n_jumps": (1, 2, 3)}, ValueError),
    *(({"decide_at": events}, ValueError) for events in ("noon", "target", ("noon",), 3, None, {"target"})),
    ({"reward_weights": {"speed": 1.0}}, ValueError), ({"reward_weights": {"success": -1.0}}, ValueError),
    ({"reward_weights": {1: 2.0}}, ValueError), ({"reward_weights": 3.0}, ValueError),
    *(({"duration_range": pair}, ValueError) for pair in (
        ("0.5", "1"), (True, 2), (0.5, None), 3, "ab", (1.0,), (1 + 0j, 2.0), (1.0, 0.5), (0.0, 0.5), (1.0, 100.0),
    )),
    *(({"autoreset_mode": mode}, ValueError) for mode in ("sometimes", None, 3)),
    *(({name: np.array(["end", "box"])}, ValueError) for name in ("arm", "space", "timing", "courses", "decide_at")),
    ({"decide_at": [np.zeros(2)]}, ValueError), ({"families": [np.zeros(2)]}, TypeError),
]  # fmt: skip
ONE_ENVIRONMENT = [
    (PANDA, {"space": "hand"}), (PANDA, {"duration_range": (0.5, 2.0)}),
    (PANDA, {"families": "gate", "n_obstacles": 2}), (PLANE, {"families": "gate", "n_obstacles": 0}),
    (PANDA, {"families": "gate", "shapes": "sphere"}), (PLANE, {"families": "shelf"}), (PLANE, {"n_jumps": 1}),
    (PLANE, {"moving_obstacles": True}), (MOVING, {"timing": "learned"}), (STEP, {"timing": "learned"}),
    *((STEP, {"control_step": step}) for step in (0.0, -0.04, 0.003, 2.0, np.nan, "fast", True)),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*render_mode='rgb' that is not")  # Gymnasium's, before our error
@pytest.mark.parametrize("env_id", KINDS)
@pytest.mark.parametrize(("kwargs", "error"), ANY_ENVIRONMENT)
def test_arguments_of_any_environment(env_id, kwargs, error):
    for make in (gym.make, gym.make_vec):
        with pytest.raises(error) as raised:
            make(env_id, **kwargs)
        assert "ambiguous" not in str(raised.value)  # NumPy's


@pytest.mark.parametrize(("env_id", "kwargs"), ONE_ENVIRONMENT)
def test_arguments_of_one_environment(env_id, kwargs):
    with pytest.raises(ValueError):
        gym.make(env_id, **kwargs)


def test_an_unknown_argument_is_the_error_that_others_raise():
    """TorchRL looks for these words."""
    arguments = gym.make, "speed", "arguments are arm, "
    for make, name, told in (arguments, (gym.make_vec, *arguments[1:]), (gym.make, "num_envs", "make_vec")):
        with pytest.raises(TypeError, match=f"got an unexpected keyword argument '{name}'; .*{told}"):
            make(PLANE, **{name: 3})


def both(env_id):
    """Yield an environment and a batch after a reset."""
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2, threads=1).unwrapped):
        env.reset(seed=0)
        yield env


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
        bad = [{"jumps": [[1], [1, 2]]}, {"jumps": [[[1]], [[1, 2]], [[1]]]}, {"obstacles": np.array("x")}]
        for options in (5, "abc", [1, 2], 0, np.zeros(2), {"speed": 3}, {"jumps": "soon"}, *bad):
            with pytest.raises(ValueError, match="options"):
                env.reset(options=options)
        for seed in (-1, 1.5, "a", np.array(1.5), np.array([[1]]), [1, 2, 3]):
            with pytest.raises(ValueError):
                env.reset(seed=seed)
    for mask in ([True], [True, 1, 0], np.zeros(2, bool), "all", [[1], [1, 2]]):
        with pytest.raises(ValueError, match="reset_mask"):
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
@pytest.mark.parametrize("env_id", [PLANE, MOVING, PANDA])
def test_plans(env_id, change):
    env = gym.make_vec(env_id, num_envs=2, threads=1).unwrapped
    env.reset(seed=0)
    space, scenes = env.task.space, env.scenes
    start, goal = space.coordinates(scenes.start), space.coordinates(scenes.goal)
    waypoints = np.stack((start, 0.5 * (start + goal), goal), axis=1)
    durations = np.full((2, 2), 0.4)
    with pytest.raises(ValueError):
        env.execute_plan(ve.Plan(*change(waypoints, durations)))
    info = env.execute_plan(ve.Plan(waypoints.tolist(), durations.tolist())).info
    assert (info["jerk_ratio"] < 1.0 + 1e-9).all()


def test_plans_are_for_the_twin_of_an_environment_with_steps():
    env = gym.make_vec(STEP, num_envs=2).unwrapped
    env.reset(seed=0)
    with pytest.raises(TypeError):
        env.execute_plan(ve.Plan(np.zeros((2, 3, 2)), np.ones((2, 2))))


@pytest.mark.parametrize(
    "goals", [np.full((2, 2), 3.0), np.zeros(2), np.full((2, 2), np.nan), "there", np.zeros((2, 3))]
)
def test_goals_that_are_moved(goals):
    env = gym.make_vec(JUMPS, num_envs=2, threads=1).unwrapped
    env.reset(seed=0)
    before = env.observe()
    with pytest.raises(ValueError):
        env.move_goals(goals)
    np.testing.assert_array_equal(env.observe()["goal"], before["goal"])


def test_goals_are_not_moved_into_contact_with_obstacles_where_they_are_now():
    env = gym.make_vec(MOVING, num_envs=1, decide_at=("horizon",), threads=1).unwrapped
    env.reset(options={**ENDS, "obstacles": [post(-0.1, 0.5, velocity=(0.0, -0.3, 0.0))]})
    before = env.step(np.zeros(env.action_space.shape))[0]  # for 0.3 s
    with pytest.raises(ValueError, match="obstacle 0 touches the arm at the goal"):
        env.move_goals([[-0.1, 0.41]])
    np.testing.assert_array_equal(env.observe()["goal"], before["goal"])
    env.move_goals([[-0.1, 0.5]])


CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) / 10
POINT, BALL = np.ones(3), ve.Sphere(0.1)


def record(**change):
    return ve.Task.of(**{**ve.Task.of().as_dict(), **change})


def recorder(mode):
    env = gym.Wrapper(gym.Env())
    env.env.render_mode = mode
    return ve.RecordMovements(env, "nowhere")


def nothing(rng, room):
    """Build nothing."""


def family(name, build=nothing, **values):
    ve.register_scene_family(name, build, **values)


def built(result):
    """Return the layout of a family of one's own that answers so."""
    ve.register_scene_family("own", lambda rng, room: result)
    room = room_of(ve.arm_of("panda"), ("sphere",), (1, 2), False)
    return scene_families(plane=False)["own"].build(np.random.default_rng(0), room)


def from_rows(shape):
    """Return obstacles of rows of an observation, for a shape that has none."""
    return ve.obstacles_from_rows(ve.observation_rows(pack([[shape]]), (shape.kind,)), (shape.kind,))


CALLS = [
    (ve.ReachVectorEnv, [(0,), (-1,), (1.5,), (True,), ("two",)]),
    (lambda change: record(**change), [({"arm": "none"},), ({"n_via": 99},)]),
    (lambda weights: ve.RewardWeights(**weights), [
        ({"success": np.nan},), ({"success": "much"},), ({"duration": -0.1},), ({"progress": True},),
    ]),
    (recorder, [(None,), ("human",), ("rgb_array",)]),
    (lambda sensor: ve.Task.of(sensor=sensor), [
        ("eyes",), (3,), ({"lens": 1},), ({"columns": 0},), ({"columns": 1.5},), ({"rows": 2, "columns": 40_000},),
        ({"field_of_view": 7.0},), ({"rows": 4, "field_of_view": 3.1},), ({"range": 0.0},), ({"noise": -1.0},),
        ({"dropped": 1.0},), ({"position": (0.0, np.nan, 0.0)},), ({"quaternion": (1.0, 1.0, 0.0, 0.0)},),
        ({"mount": "foot"},), ({"looks": 0},),
        ({"looks": 2},),  # an episode of one decision has one look
        ({"position": (0.0, 0.0, 2.0), "quaternion": (0.5**0.5, 0.0, -(0.5**0.5), 0.0)},),  # it sees the sky alone
        ({"position": (0.0, 0.0, 0.2)},), ({"mount": "hand", "position": (0.0, 0.0, 0.2)},),  # rays above obstacles
        ({"mount": "hand", "position": (9.0, 0.0, 0.0)},), ({"range": 0.01},),
    ]),
    (lambda change: ve.Task.of(**change), [
        ({"sensor": "rays", "n_obstacles": 0},), ({"decide_at": ["sight"]},),
        *(({"sensor": "hand_rays", "decide_at": ["sight", telling]},) for telling in ("clearance", "course")),
    ]),
    (ve.arm_of, [("large",)]),
    (ve.register_arm, [
        (ve.arm_of("panda"),), *((dataclasses.replace(ve.arm_of("panda"), name=name),) for name in ("", "x.xml")),
    ]),
    (family, [("",), ("shelf",)]),
    (lambda values: family("x", **values), [
        ({"kinds": ("ball",)},), ({"kinds": ("convex_mesh",)},), ({"n_obstacles": 0},),
    ]),
    (built, [
        (None,), (Layout([1.0], [], []),), ([BALL],),
        *((([BALL], places),) for places in ([ve.Place((np.nan, 0.0, 0.0))], [ve.Place((0.0, 0.0, 0.0))] * 9)),
        *(((shapes,),) for shapes in (
            [BALL] * 3, [ve.Box((0.1, 0.1, 0.1))], [ve.ConvexMesh.hull(CUBE)], [{"shape": "sphere", "radius": -1.0}],
        )),
    ]),
    (ve.scene_from_json, [
        (None,), (b"\xff",), ("[]",), ("{}",), ("{",), ("[" * 100_000,), ("1" * (2 << 20),),
        ('{"format": "viapoint-scene", "obstacle": []}',), ('{"format": "viapoint-scene", "obstacles": 3}',),
        ('{"format": "viapoint-scene", "obstacles": [{"shape": "cube"}]}',),
    ]),
    (ve.obstacles_from_json, [("[",), ("{}",), ("[" * 100_000,), (None,), ('[{"shape": 1}]',)]),
    (ve.HalfSpace.facing, [((0, 0, 0),), ((0, np.nan, 1),), ((0, 1),)]),
    (lambda end: ve.Capsule.between((0, 0, 1), end, 0.1), [((0, 0, 1),), ((0, 1),), ((0, 0, np.inf),)]),
    (ve.ConvexMesh.hull, [(CUBE[:4],), (CUBE[:3],)]),
    (ve.PointCloud.covering, [(CUBE, -1.0), (CUBE, 0.0), (CUBE, 0.2, -0.1)]),
    (BALL.distance, [
        *((points,) for points in (0.1, (0.1, 0.2), np.zeros((3, 4)), POINT * np.nan, "a")),
        *((POINT, radius) for radius in (np.nan, -0.1, "a", None, 1j, [0.1, np.inf])),
    ]),
    (ve.signed_distances, [
        *((each, POINT) for each in (BALL, None, "box", [{"shape": "boxx"}])), ([], (0, 1)), ([], POINT * np.nan),
    ]),
    (ve.register_mesh, [("box", CUBE), ("a b", CUBE), (3, CUBE), ("", CUBE), ("dent", [*CUBE, (0.05, 0.05, 0.05)])]),
    (add_to_model, [(mujoco.MjSpec(), [ve.Sphere(0.1, name="obstacle_1"), BALL])]),
    (geom_meshes, [(pack([[ve.ConvexMesh(CUBE)]]),), (pack([[ve.PointCloud(CUBE)]]),)]),
    (ve.observation_rows, [(pack([[BALL]]), ("box",)), (pack([[ve.ConvexMesh(CUBE)]]), ("box",))]),
    (from_rows, [(ve.PointCloud(CUBE),), (ve.ConvexMesh(CUBE),)]),
]  # fmt: skip
OF_ANOTHER_TYPE = [
    (lambda change: record(**change), [({"speed": 1},), ({"shapes": 1},)]),
    (ve.register_arm, [("small",)]),
    (family, [(3,), ("x", lambda rng: None), ("x", None)]),
    (lambda flag: family("x", **flag), [({"plane": "yes"},)]),
    (ve.inverse_kinematics, [("panda", (0.5, 0.0, 0.4))]),
]
ROWS = [
    *((call, arguments, ValueError) for call, arguments in CALLS),
    *((call, arguments, TypeError) for call, arguments in OF_ANOTHER_TYPE),
]


@pytest.mark.parametrize(("call", "arguments", "error"), ROWS)
def test_arguments_of_classes_and_functions(call, arguments, error):
    for each in arguments:
        with pytest.raises(error):
            call(*each)


HOUSE = ve.Box((0.3, 0.3, 0.3), position=(0.3, 0.0, 0.5))
POST = {"obstacles": [post(-0.1, 0.6, 0.03)]}
OTHER_SHAPES = {"shapes": ("box", "sphere"), "families": "clutter"}
IN_SPACE = [
    *({"obstacles": given} for given in (
        [HOUSE], [[CRATE, HOUSE.to_dict()]], [ve.HalfSpace(position=(0, 0, 0.6))],
        [ve.Box((2.5, 0.1, 0.1))], [ve.Box((0.1, 0.1, 0.1), position=(3.0, 0.0, 0.0))],
        [ve.Box((1.0, 1.0, 1.0))],  # contains the base
        [ve.Sphere(0.05, position=(0.2, 0.7, 0.4), velocity=(3.0, 0.0, 0.0))],
        [ve.ConvexMesh.hull(CUBE)], [ve.PointCloud(CUBE)], [{"shape": "pyramid"}],
        [CRATE] * 17, CRATE, CRATE.to_dict(), None, "[]]", np.zeros((1, 9, 15)), [[], []], [[CRATE], 3, []],
        [{"shape": "sphere", "radius": np.nan}], [{"shape": "sphere", "size": 0.1}],
    )),
    *({"start": start} for start in (np.full(7, 9.0), HOME[:6], np.full(7, np.nan), "home")),
    {"start": HOME, "goal": HOME},
    *({"goal": goal} for goal in (
        ve.Pose((3.0, 0.0, 0.0)), {"quaternion": (1, 0, 0, 0)}, [ve.Pose((0.5, 0.0, 0.4))] * 3,
        ve.Pose((0.5, 0.0, 0.4), (0.5, 0.0, 0.0, 0.0)), ve.Pose((0.5, np.nan, 0.4)),
        {"position": (0.5, 0.0, 0.4), "angle": 3.0}, np.array([0, 1.7, 0, -3.0, 0, 0.1, 0.0]),
    )),
    {"jumps": [[0.3, *HOME]]}, {"turns": [[0.3, 0.1, 0.0, 0.0]]}, {"begin": HOME}, {1: HOME},
]  # fmt: skip
IN_THE_PLANE = [
    *({**ENDS, "jumps": jumps} for jumps in (
        [[0.0, *OTHER]], [[-0.1, *OTHER]], [[0.5, *OTHER], [0.4, 0.1, 0.4]], [[0.2, 3.0, 0.0]], [[0.2, 3.0]],
        [[0.2, np.nan, 0.3]], [["soon", 0.0, 0.3]], [[0.1 * k, *OTHER] for k in range(1, 7)],
    )),
    {**ENDS, "obstacles": [post(*OTHER, 0.03)], "jumps": [[0.2, *OTHER]]},
    {"turns": [[0.1, 0.0, 0.1, 0.0]]},  # of obstacles that are drawn
    *({**ENDS, **POST, "turns": turns} for turns in (
        [[0.1, 0.0]], [[-0.2, 0.1, 0.0, 0.0]], [[0.3, 3.0, 0.0, 0.0]], [[0.2, 0.1, 0.0, 0.0]] * 2,
    )), {"obstacles": [ve.Box((0.75, 0.75, 0.1), position=(0.0, 0.4, 0.0))]},  # no free ends
    *({**ENDS, "goal": goal} for goal in (
        (0.1, 0.4, 0.3), (2.0, 0.0), ENDS["start"], ve.Pose((2.0, 0.0, 0.0)), ve.Pose((0.1, 0.4, 0.0), (1, 0, 0, 0)),
    )),
    {**ENDS, "start": (0.0, 0.02)},
]  # fmt: skip
SWIFT = {"obstacles": [ve.Cylinder(0.03, 0.04, position=(0.3, 0.35, 0.0), velocity=(0.9, 0.0, 0.0))]}
REACHES = [  # too short or long, too fast, not finite, of an obstacle that is not there, of another shape
    [[0.0, 0.0, 0.1, 0.0, 0.0]], [[0.0, 1e-9, 0.0, 0.0, 0.0]], [[0.0, -1.0, 0.1, 0.0, 0.0]],
    [[0.0, 0.1, 0.4, 0.0, 0.0]], [[0.0, 1e9, 0.1, 0.0, 0.0]], [[np.nan, 1.0, 0.1, 0.0, 0.0]],
    [[0.0] * 5, [0.0, 1.0, 0.1, 0.0, 0.0]], [[0.0, 1.0, 0.1, 0.0]], [[0.0, 0.02, 0.01, 0.0, 0.0]],
]  # fmt: skip
SCENES = [
    *((PANDA, {}, {**ends, **options}) for options in IN_SPACE for ends in ({}, PANDA_ENDS)),
    *((MOVING, {}, options) for options in IN_THE_PLANE),
    *((MOVING, {"courses": "reaches"}, {**ENDS, **POST, "reaches": reaches}) for reaches in REACHES),
    (MOVING, {"courses": "reaches"}, {**ENDS, **SWIFT, "reaches": [[0.0, 0.8, 0.35, 0.0, 0.0]]}),
    (PANDA, OTHER_SHAPES, {**PANDA_ENDS, "obstacles": [ve.PointCloud(CUBE, 0.02, position=(0.2, 0.7, 0.4))]}),
    (PANDA, OTHER_SHAPES, {**PANDA_ENDS, "obstacles": [ve.ConvexMesh.hull(CUBE)]}),
    ("viapoint/PlanarSensed-v0", {}, {"obstacles": [post(0.03, 0.0, 0.05)]}),  # contains the sensor
]


@functools.cache
def kept(env_id, **kwargs):
    return gym.make(env_id, **kwargs).unwrapped


@pytest.mark.parametrize(("env_id", "kwargs", "options"), SCENES)
def test_impossible_scenes_change_nothing(env_id, kwargs, options):
    env = kept(env_id, **kwargs)
    env.reset(seed=0)
    scenes = env.batch.scenes
    with pytest.raises(ValueError):
        env.reset(seed=1, options=options)
    same_scenes(env.batch.scenes, scenes)
