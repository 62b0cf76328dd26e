"""The live page without a browser: files, drawn shapes, decisions and movements."""

import dataclasses
import json
import socket
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("viser", reason="the extra `live` is not installed")
pytest.importorskip("mjviser", reason="the extra `live` is not installed")

import trimesh
from viser import transforms

import viapoint.envs as ve
from viapoint.envs.registration import ENV_IDS
from viapoint.training.agents.agent import SAC
from viapoint.training.agents.viaq import ViaQ
from viapoint.training.cli import main as cli
from viapoint.training.live import drawing, movements, obstacle_editing
from viapoint.training.live.comparison import compare
from viapoint.training.live.decisions import APART, MOTION, describe_plan, plan_by_hand
from viapoint.training.live.page import LivePage
from viapoint.training.live.scene import LiveScene, to_python
from viapoint.training.live.setting import Setting, Shared
from viapoint.training.rollouts.vec_env import ViaVecEnv

PLANAR, PANDA = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
MOVING, STEP = "viapoint/PlanarMovingObstacles-v0", "viapoint/PlanarObstaclesStep-v0"


@pytest.fixture(scope="module")
def shared():
    made = {}

    def of(env_id):
        if env_id not in made:
            made[env_id] = Shared(env_id, seed=0)
        return made[env_id]

    return of


def untrained(env_id):
    return ViaQ("ViaQPolicy", ViaVecEnv(env_id, num_envs=1), seed=0)


def drawn(setting, seed=4):
    """Return a random scene of a setting."""
    return LiveScene.of(setting.sampler([np.random.default_rng(seed)]), setting.task)


def begun(setting, scene):
    """Return an environment with a scene, and the observation."""
    env = setting.make_env()
    observation, _ = env.reset(options=scene.options())
    return env, observation


def assert_same(first, second, atol=0.0):
    """Check that scenes are the same."""
    for name in ("start", "goal", "jumps", "turns"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=0.0, atol=atol)
    for mine, theirs in zip(first.obstacles, second.obstacles, strict=True):
        assert (type(mine), mine.name) == (type(theirs), theirs.name)
        for name in ("packed_size", "position", "rotation", "velocity"):
            np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=0.0, atol=atol)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_environment_has_scenes_decisions_movements_and_a_drawing(env_id, shared):
    """Without an agent the geometry search decides; environments of an own arm have the Panda by default."""
    some = shared(env_id)
    setting, task = some.own, some.own.task
    for draw in some.scene_kinds().values():
        scene, _ = draw()
        assert_same(LiveScene.from_json(scene.to_json(env_id), task), scene)
    scene = drawn(setting)
    env, observation = begun(setting, scene)
    decision = setting.decisions.choose(observation, env.scenes)
    proposals = setting.decisions.proposals(observation, env.scenes, decision)
    chosen = decision.chosen
    np.testing.assert_allclose(chosen.plan.waypoints[[0, -1]], (scene.start, scene.goal), atol=1e-6)
    assert chosen.profile.speed[[0, -1]].max() < 0.02 * chosen.profile.speed.max()
    paths = np.array([each.profile.tool for each in proposals])
    for i, j in np.argwhere(~np.eye(len(paths), dtype=bool)):
        assert np.linalg.norm(paths[i] - paths[j], axis=-1).max() > 0.9 * APART
    ranks = [each.rank for each in proposals]
    assert ranks == sorted(set(ranks))
    if task.replanning:
        goal, decide = scene.goal, setting.decisions.action
        segments = movements.execute_replanning(env, decide, scene, chosen.plan, lambda: goal)
    else:
        segments = movements.execute_whole(env, scene, chosen.plan)
    segments = list(segments)
    assert {each.places.shape[1] for each in segments} == {len(scene.obstacles)}
    np.testing.assert_allclose(segments[0].hand[0], setting.tool(scene.start), atol=1e-6)
    parts = some.drawing()
    assert len(parts.poses(task.space.joints(scene.start))) == len(parts.parts) > 0
    env.close()


@pytest.mark.parametrize("env_id", [PLANAR, PANDA, MOVING])
def test_a_clear_plan_is_worth_what_its_execution_is_worth(env_id, shared):
    """The computed reward is that of the episode, where the obstacles keep their course."""
    setting, compared = shared(env_id).own, 0
    for seed in range(8):
        scene = drawn(setting, seed)
        scene = scene._replace(turns=0.0 * scene.turns)
        env, observation = begun(setting, scene)
        chosen = setting.decisions.choose(observation, env.scenes).chosen
        env.close()
        if setting.task.replanning:
            task = dataclasses.replace(setting.task, decide_at=(), horizon=1e3)
            env, _ = begun(Setting(task), scene)
        else:
            env, _ = begun(setting, scene)
        decision = env.execute_plan(movements.in_batch(chosen.plan))
        if chosen.clear:
            compared += 1
            assert decision.info["is_success"][0]
            assert float(decision.reward[0]) == pytest.approx(chosen.reward, abs=5e-3)
        env.close()
    assert compared


@pytest.mark.parametrize("env_id", [PLANAR, MOVING])
@pytest.mark.parametrize("checks", [0, 16])
def test_the_page_chooses_what_the_agent_chooses(env_id, checks):
    agent = untrained(env_id)
    some = Setting(agent.get_env().get_attr("task")[0], agent)
    env, observation = begun(some, drawn(some))
    decision = some.decisions.choose(observation, env.scenes, checks=checks)
    agent.policy.checks = checks
    expected, _ = agent.predict(observation, deterministic=True)
    np.testing.assert_array_equal(decision.action, expected[0])
    first, *others = some.decisions.proposals(observation, env.scenes, decision)
    np.testing.assert_array_equal(first.plan.waypoints, decision.chosen.plan.waypoints)
    assert all(each.predicted is not None for each in others)
    if not checks:
        assert first.rank == 1
        assert first.predicted is not None


@pytest.mark.parametrize("env_id", [PLANAR, PANDA])
def test_a_plan_of_the_motion_planner_is_free_or_says_why_not(env_id, shared):
    """Goals in contact, out of reach and outside the limits, too; where it is free, the simulation agrees."""
    some = shared(env_id).own
    assert some.methods[0] == MOTION
    last, scene, executed = None, drawn(some), 0
    touched = dataclasses.replace(scene.obstacles[0], position=some.tool(scene.goal))
    cases = [drawn(some, seed) for seed in range(6)]
    cases += [scene.with_obstacle(touched, 0), scene._replace(goal=scene.goal + 9.0)]
    for number, case in enumerate(cases):
        decision = some.decisions.plan(case, 2, None, last)
        last, chosen = decision.motion, decision.chosen
        assert np.isfinite(chosen.plan.waypoints).all()
        assert chosen.clear == (not chosen.reason)
        assert not (number >= 6 and chosen.clear)
        assert ("no free movement" in describe_plan(chosen).lower()) == (not chosen.clear)
        if chosen.clear:
            env, _ = begun(some, case)
            result = env.execute_plan(movements.in_batch(chosen.plan)).info
            env.close()
            executed += bool(result["is_success"][0])
    assert executed >= 3


def test_other_numbers_of_via_points_are_searched(shared):
    some = shared(PLANAR).own
    env, observation = begun(some, drawn(some))
    for number in (0, 2, 3):
        decision = some.decisions.choose(observation, env.scenes, n_via=number)
        assert decision.maker.startswith("search")
        assert len(decision.chosen.plan.durations) == number + 1
        assert some.decisions.proposals(observation, env.scenes, decision)


@pytest.mark.parametrize("env_id", [PLANAR, PANDA])
def test_a_plan_by_hand_is_valued_as_the_same_decision(env_id, shared):
    some = shared(env_id).own
    scene = drawn(some)
    env, observation = begun(some, scene)
    chosen = some.decisions.choose(observation, env.scenes).chosen
    mine = some.decisions.evaluate(
        env.scenes, plan_by_hand(scene, chosen.plan.waypoints[1:-1], chosen.duration)
    )
    assert mine.rank == 0
    assert mine.clearance == pytest.approx(chosen.clearance, abs=1e-6)
    assert mine.reward == pytest.approx(chosen.reward, abs=1e-6)


def test_a_dragged_goal_is_reached_without_a_jump(shared):
    some = shared(MOVING).own
    scene = drawn(some)
    env, observation = begun(some, scene)
    plan = some.decisions.choose(observation, env.scenes).chosen.plan
    asked, aside = [], scene.goal + (0.02, 0.04) * np.sign(0.3 - scene.goal)

    def goal():
        asked.append(None)
        return aside if len(asked) > 2 else scene.goal

    segments = list(movements.execute_replanning(env, some.decisions.action, scene, plan, goal))
    hand = np.concatenate([each.hand for each in segments])
    time = np.concatenate([each.time for each in segments])
    assert np.linalg.norm(hand[-1, :2] - aside) < 0.01
    assert sum(each.plan is not None for each in segments) >= 1
    velocity = np.diff(hand, axis=0) / np.diff(time)[:, None]
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.1


@pytest.mark.parametrize("env_id", [PLANAR, PANDA])
def test_a_dragged_end_is_where_it_was_dragged_to(env_id, shared):
    some = shared(env_id).own
    scene = drawn(some)
    place = some.tool(scene.goal) * (0.95, 0.95, 1.0)
    moved = some.moved(scene.goal, place, scene.packed)
    np.testing.assert_allclose(some.tool(moved), place, atol=1e-5)
    if not some.planar:
        np.testing.assert_allclose(
            np.abs(some.orientation(moved) @ some.orientation(scene.goal)), 1.0, atol=1e-5
        )
        with pytest.raises(ValueError):
            some.moved(scene.goal, place + 2.0, scene.packed)


def test_methods_are_compared_in_a_scene(shared):
    some = shared(PLANAR)
    scene = drawn(some.own)
    results = {name: result() for name, result in compare(some.own, scene, some.planners)}
    assert not results["straight"].success
    assert results["geometry search"].success
    assert results["straight"].jerk_ratio == pytest.approx(1.0)


@settings(max_examples=30)
@given(st.floats(0.01, 0.1), st.floats(0.01, 0.3), st.floats(-89.0, 89.0), st.floats(-80, 80))
def test_sizes_of_obstacles_are_set_and_read(radius, length, heading, elevation):
    shape = ve.Capsule(0.02, 0.1)
    values = {"radius": radius, "half-length": length, "heading": heading, "elevation": elevation}
    for name, value in values.items():
        shape = obstacle_editing.resized(shape, name, value, planar=False)
    assert obstacle_editing.sizes_of(shape, planar=False) == pytest.approx(values, abs=1e-6)


@pytest.mark.parametrize("env_id", [PLANAR, PANDA])
def test_obstacles_of_every_shape_are_added_resized_drawn_and_kept_in_files(env_id, shared):
    some = shared(env_id)
    setting, scene = some.own, drawn(some.own)
    first, levels = scene, (-0.02, 0.03) if setting.planar else None
    for kind in obstacle_editing.KINDS[setting.planar]:
        before = shape = obstacle_editing.new_obstacle(setting, scene, kind)
        for name in obstacle_editing.sizes_of(shape, setting.planar):
            value = 30.0 if name in obstacle_editing.ANGLES else 0.07
            shape = obstacle_editing.resized(shape, name, value, setting.planar)
            assert obstacle_editing.sizes_of(shape, setting.planar)[name] == pytest.approx(value)
        np.testing.assert_allclose(shape.position, before.position)  # it stays where it is
        around = drawing.obstacle_mesh(shape, levels).vertices + np.asarray(shape.position)
        if levels:
            around[:, 2] = 0.0
        off = shape.distance(around)  # a wall is drawn as a block, of which one face lies on its surface
        some_inside = setting.planar or kind == "wall"
        assert (off.max() if some_inside else np.abs(off).max()) == pytest.approx(0.0, abs=2e-3)
        alone = first.with_obstacle(before)
        begun(some.setting_of(alone), alone)  # the arm is clear of it
        scene = scene.with_obstacle(shape)
    task = some.setting_of(scene).task
    assert_same(LiveScene.from_json(scene.to_json(env_id), task), scene, atol=1e-9)
    assert [each.kind for each in scene.without(0).obstacles] == [each.kind for each in scene.obstacles[1:]]


@settings(max_examples=20)
@given(st.floats(0.01, 0.1), st.floats(0.001, 0.2), st.floats(-3.0, 3.0))
def test_obstacles_are_drawn_where_they_are(radius, length, angle):
    """All corners lie on the surface."""
    turn = transforms.SO3.from_rpy_radians(0.0, angle, 2.0 * angle).wxyz
    shape = ve.Capsule(radius, length, position=(0.1, 0.2, 0.3), quaternion=turn)
    corners = drawing.obstacle_mesh(shape).vertices + np.asarray(shape.position)
    np.testing.assert_allclose(shape.distance(corners), 0.0, atol=2e-6)


def test_tubes_are_closed_and_have_their_radius():
    angle = np.linspace(0.0, 2.0, 40)
    points = np.stack((np.cos(angle), np.sin(angle), 0.2 * angle), axis=-1)
    mesh = drawing.tube(points, 0.01)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    length = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum()
    octagon = 2.0 * np.sqrt(2.0) * 0.01**2
    assert solid.volume == pytest.approx(length * octagon, rel=0.02)


def test_an_arm_of_ones_own_is_drawn_from_its_file():
    """The drawn hand is where the arm's hand is, wherever the file puts the arm."""
    names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    home = (0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28)
    file = Path(__file__).parents[2] / "docs" / "ur5e.xml"
    arm = ve.load_arm(file, tool="hand", joints=names, home=home, velocity_limit=np.pi)
    shown = Shared("viapoint/Obstacles-v0", env_kwargs={"arm": str(file)}, seed=0)
    assert len(shown.drawing().parts) == len(drawing.ArmDrawing(arm, arm.compile(0), file).parts)
    drawn = drawing.ArmDrawing(arm, arm.compile(0), file)
    away = []
    for joints in arm.home + np.random.default_rng(0).uniform(-0.4, 0.4, (8, 6)):
        corners = [
            transforms.SO3(turn).as_matrix() @ np.asarray(part.mesh.vertices).T + place[:, None]
            for (turn, place), part in zip(drawn.poses(joints), drawn.parts, strict=True)
        ]
        hand = arm.hand(joints)
        away.append(np.linalg.norm(np.concatenate(corners, axis=1).T - hand, axis=-1).min())
    assert max(away) < 0.08
    np.testing.assert_allclose(away, away[0], atol=1e-6)  # the hand does not move in its link
    with pytest.raises(ValueError):
        drawing.ArmDrawing(arm, arm.compile(0), file.with_name("index.md"))


def test_an_agent_of_control_steps_moves_to_the_end_of_its_episode():
    agent = SAC("MultiInputPolicy", ViaVecEnv(STEP, num_envs=1), buffer_size=2, seed=0)
    some = Shared(STEP, agent).own
    scene, env = drawn(some), some.make_step_env()
    (segment,) = movements.execute_stepwise(env, some.act, scene)
    assert env.terminated[0] or env.truncated[0]
    np.testing.assert_allclose(segment.hand[0], some.tool(scene.start), atol=0.01)
    assert len(segment.time) == len(segment.hand) == len(segment.places)
    whole, observation = begun(some, scene)
    assert some.decisions.choose(observation, whole.scenes).maker.startswith("search")
    names = [name for name, _ in compare(some, scene, {})]
    assert names == ["agent", "straight", "geometry search"]


@pytest.mark.parametrize("env_id", [PLANAR, PANDA, MOVING])
def test_python_code_sets_the_scene_up(env_id, shared):
    some = shared(env_id)
    scene = drawn(some.own)
    names = {}
    exec(to_python(scene, env_id, some.arguments(some.own)), names)
    env = names["env"].unwrapped
    assert_same(LiveScene.of(env.batch.scenes, env.task), scene, atol=1e-5)
    assert isinstance(names["observation"], dict)
    assert isinstance(names["gym"].spec(env_id), gym.envs.registration.EnvSpec)


def test_scene_files_are_exact_and_keep_names_and_changes(shared):
    """The page writes what `scene_from_json` reads."""
    task = shared(MOVING).own.task
    ball = {"shape": "sphere", "radius": 0.1 / 3.0, "position": [-0.05, 0.35, 0.0], "name": "ball"}
    ball["velocity"] = [0.1, 0.0, 0.0]
    rest = {"shape": "box", "size": [0.02, 0.03, 0.1], "position": [0.05, 0.45, 0.0]}
    turns = [[0.0] * 4, [0.5, 0.0, 1.0 / 3.0, 0.0]]
    record = {"format": "viapoint-scene", "env": MOVING, "start": [-1.0 / 3.0, 0.3], "goal": [0.1, 0.4]}
    record |= {"obstacles": [rest, ball], "turns": turns}
    scene = LiveScene.from_json(json.dumps(record), task)
    again = LiveScene.from_json(scene.to_json(MOVING), task)
    assert_same(again, scene)
    np.testing.assert_array_equal(again.turns, turns)
    assert [each.name for each in again.obstacles] == ["", "ball"]
    more = again.with_obstacle(again.obstacles[0]).without(0)
    options = ve.scene_from_json(more.to_json(MOVING))
    assert [each.name for each in options["obstacles"]] == ["ball", ""]
    np.testing.assert_array_equal(more.turns, [turns[1], turns[0]])
    assert options["start"] == record["start"]


GOOD_FILE = {"format": "viapoint-scene", "start": [-0.2, 0.3], "goal": [0.1, 0.4]}


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"goal": [0.1]},
        {"goal": [0.1, float("nan")]},
        {"start": [2.0, 2.0]},
        {
            "obstacles": [
                {"shape": "cylinder", "radius": 0.03, "half_length": 0.1, "position": [0.1, 0.4, 0.0]}
            ]
        },
        {"obstacles": 25 * [{"shape": "sphere", "radius": 0.01, "position": [0.5, 0.5, 0.0]}]},
        {"obstacles": [{"shape": "point_cloud", "points": [[0.5, 0.5, 0.0]], "radius": 0.01}]},
        {"turns": [[0.5, 0.1, 0.0, 0.0]]},
        {"jumps": [[0.5, 0.1]]},
    ],
)
def test_impossible_files_are_refused(change, shared):
    some = shared(PLANAR)
    some.read(json.dumps(GOOD_FILE).encode())
    with pytest.raises(ValueError):
        some.read(json.dumps(GOOD_FILE | change).encode())


def test_the_page_is_private():
    with LivePage(env=PLANAR, port=0) as page:
        assert page.url.startswith("http://127.0.0.1:")
        assert page._server.request_share_url() is None


def test_what_cannot_be_served_is_refused(capsys, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        for words, named in (
            (["--port", port], port),
            ([str(tmp_path / "none")], "none"),
            (["--arm", "nowhere.xml", "--port", "0"], "nowhere.xml"),
        ):
            with pytest.raises(SystemExit) as end:
                cli.main(["live", *words])
            assert end.value.code == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert named in line
    for call in (lambda: LivePage(PLANAR, env=PANDA, port=0),):
        with pytest.raises(ValueError):
            call()


def test_scenes_that_exceed_the_environment_of_the_agent_go_to_a_wider_one(shared):
    some = shared(PLANAR)
    scene, own = drawn(some.own), some.own
    assert some.setting_of(scene) is own
    crowded = scene
    while len(crowded.obstacles) <= own.task.n_obstacles[1]:
        crowded = crowded.with_obstacle(obstacle_editing.new_obstacle(own, crowded, "post"))
    walled = scene.without(0)
    walled = walled.with_obstacle(obstacle_editing.new_obstacle(own, walled, "wall"))
    for other in (crowded, walled):
        assert own.limit(other)
        wide = some.setting_of(other)
        assert wide is not own
        env, observation = begun(wide, other)
        assert wide.decisions.choose(observation, env.scenes).maker.startswith("search")
        env.close()
        names = {}
        exec(to_python(other, PLANAR, some.arguments(wide)), names)
        assert_same(LiveScene.of(names["env"].unwrapped.batch.scenes, wide.task), other, atol=1e-5)
    for _ in range(30):
        crowded = crowded.with_obstacle(crowded.obstacles[0])
    with pytest.raises(ValueError):
        some.setting_of(crowded)
