"""The live page without a browser: files, drawn shapes, decisions and movements."""

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
from viapoint.envs.arms import PANDA as PANDA_ARM
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.rows import widened
from viapoint.envs.registration import ENV_IDS
from viapoint.envs.scenes.scene import check_scenes
from viapoint.training import load_agent
from viapoint.training.agents.agent import SAC
from viapoint.training.cli import main as cli
from viapoint.training.live import drawing, movements, obstacle_editing
from viapoint.training.live.decisions import APART, plan_by_hand
from viapoint.training.live.page import LivePage, is_loopback
from viapoint.training.live.scene_draws import benchmark_problems, scene_kinds
from viapoint.training.live.scene_file import LiveScene, from_json, to_json, to_python
from viapoint.training.live.setting import Setting, Shared
from viapoint.training.rollouts.vec_env import ViaVecEnv

PLANAR, PANDA = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
MOVING = "viapoint/PlanarMovingObstacles-v0"


@pytest.fixture(scope="module")
def shared():
    made = {}

    def of(env_id, agent=None):
        if env_id not in made:
            made[env_id] = Shared(env_id, agent, model_file=None, seed=0, env_kwargs={})
        return made[env_id]

    yield of
    for each in made.values():
        each.close()


def drawn(setting):
    """Return a random scene with the rows of a setting."""
    scene, _ = scene_kinds(setting.whole_id, setting.whole_kwargs, setting.task, seed=0)["Random"]()
    return scene.with_shapes(setting.task.scenes.shapes)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_environment_has_scenes_decisions_movements_and_a_drawing(env_id, shared):
    """Without an agent the geometry search decides; environments of an own arm have the Panda by default."""
    some = shared(env_id)
    setting, task = some.own, some.own.task
    env = setting.make_env()
    for draw in some.scene_kinds().values():
        scene, _ = draw()
        again = from_json(to_json(scene, env_id), task.arm.dimension)
        for mine, theirs in zip(*(each.with_shapes(("capsule",)) for each in (scene, again)), strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-6)
    scene, _ = some.scene_kinds()["Random"]()
    scene = scene.with_shapes(task.scenes.shapes)
    observation, _ = env.reset(options=scene.options(changing=task.replanning))
    decision = setting.decisions.choose(observation)
    proposals = setting.decisions.proposals(observation, decision)
    np.testing.assert_allclose(decision.chosen.plan.waypoints[[0, -1]], (scene.start, scene.goal), atol=1e-6)
    assert decision.chosen.clear
    profile = movements.plan_profile(task, scene, decision.chosen.plan)
    assert profile.speed[0] < 1e-6 < profile.speed.max()
    if task.replanning:
        segments = movements.execute_replanning(
            env, setting.decisions, scene, decision.chosen.plan, lambda: scene.goal
        )
    else:
        segments = movements.execute_whole(env, scene, decision.chosen.plan)
    (*_, last) = segments
    assert last.info["is_success"][0]
    paths = np.array([each.path() for each in proposals])
    for i, j in np.argwhere(~np.eye(len(paths), dtype=bool)):
        assert np.linalg.norm(paths[i] - paths[j], axis=-1).max() > 0.9 * APART
    parts = some.drawing()
    assert len(parts.poses(task.arm.inverse_kinematics(scene.start))) == len(parts.parts) > 0
    env.close()


@pytest.mark.parametrize("env_id", [PLANAR, MOVING])
@pytest.mark.parametrize("checks", [0, 16])
def test_the_page_chooses_what_the_agent_chooses(env_id, checks):
    agent = load_agent(env_id)
    some = Setting(env_id, agent, {})
    observation, _ = some.make_env().reset(seed=4)
    decision = some.decisions.choose(observation, checks=checks)
    agent.policy.checks = checks
    expected, _ = agent.predict(observation, deterministic=True)
    np.testing.assert_array_equal(decision.action, expected[0])
    first, *_ = some.decisions.proposals(observation, decision)
    assert first.predicted is not None
    if not checks:
        assert first.rank == 1


def test_other_numbers_of_via_points_are_searched(shared):
    some = shared(PLANAR).own
    observation, _ = some.make_env().reset(seed=4)
    for number in (0, 2, 3):
        decision = some.decisions.choose(observation, n_via=number)
        assert decision.maker.startswith("search")
        assert len(decision.chosen.plan.durations) == number + 1


def test_a_plan_by_hand_is_valued_as_the_same_decision(shared):
    some = shared(PLANAR).own
    env = some.make_env()
    observation, _ = env.reset(seed=4)
    chosen = some.decisions.choose(observation).chosen
    plan = plan_by_hand(LiveScene.of(env.scenes), chosen.plan.waypoints[1:-1], chosen.duration)
    mine = some.decisions.evaluate(observation, plan)
    assert mine.rank == 0
    assert mine.clearance == pytest.approx(chosen.clearance, abs=1e-4)
    assert mine.reward == pytest.approx(chosen.reward, abs=1e-3)


def test_a_dragged_goal_is_reached_without_a_jump():
    agent = load_agent(MOVING)
    some = Setting(MOVING, agent, {})
    env, scene = some.make_env(), drawn(some)
    observation, _ = env.reset(options=scene.options(changing=True))
    plan = some.decisions.choose(observation).chosen.plan
    asked, aside = [], scene.goal + (0.02, 0.04) * np.sign(0.3 - scene.goal)

    def goal():
        asked.append(None)
        return aside if len(asked) > 2 else scene.goal

    segments = list(movements.execute_replanning(env, some.decisions, scene, plan, goal))
    hand = np.concatenate([each.hand for each in segments])
    time = np.concatenate([each.time for each in segments])
    assert np.linalg.norm(hand[-1] - aside) < 0.01
    assert sum(each.path is not None for each in segments) >= 1
    velocity = np.diff(hand, axis=0) / np.diff(time)[:, None]
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.1


def test_methods_are_compared_in_a_scene(shared):
    some = shared(PLANAR)
    scene, _ = some.scene_kinds()["Hard"]()
    results = {name: result() for name, result in some.own.compare(scene.with_shapes(("capsule",)))}
    assert not results["straight"].success
    assert results["planner"].success
    assert results["straight"].jerk_ratio == pytest.approx(1.0)


@settings(max_examples=30)
@given(
    st.integers(2, 3), st.floats(0.01, 0.1), st.floats(0.01, 0.3), st.floats(-89.0, 89.0), st.floats(-80, 80)
)
def test_sizes_of_obstacles_are_set_and_read(d, radius, length, heading, elevation):
    row = widened(np.array([*np.zeros(2 * d), 0.02]))
    values = {"radius": radius, "half-length": length, "heading": heading}
    values |= {"elevation": elevation} if d == 3 else {}
    for name in ("half-length", *values):
        row = obstacle_editing.resized(row, name, values[name])
    assert obstacle_editing.sizes_of(row) == pytest.approx(values, abs=1e-6)


@pytest.mark.parametrize(
    ("env_id", "shapes"),
    [
        (PLANAR, ("capsule", "box", "cylinder", "half_space")),
        (PANDA, ("capsule", "sphere", "box", "cylinder", "half_space")),
    ],
)
def test_obstacles_of_every_shape_are_added_resized_drawn_and_kept_in_files(env_id, shapes):
    env = gym.make_vec(env_id, num_envs=1, threads=1, shapes=shapes).unwrapped
    env.reset(seed=0)
    scene = LiveScene.of(env.scenes)
    number, d = len(scene.obstacles), len(scene.start)
    for kind in obstacle_editing.KINDS[d]:
        row = obstacle_editing.new_obstacle(scene, kind)
        before = row
        for name in obstacle_editing.sizes_of(row):
            value = 30.0 if name in ("heading", "elevation") else 0.07
            row = obstacle_editing.resized(row, name, value)
            assert obstacle_editing.sizes_of(row)[name] == pytest.approx(value)
        np.testing.assert_allclose(row[:d], before[:d])  # it stays where it is
        mesh = drawing.obstacle_mesh(row, -0.02, 0.03)
        (shape,) = ve.obstacles_from_rows(row[None])
        around = mesh.vertices + np.array([*row[:d], 0.0][:3]) * ([1, 1, 0] if d == 2 else 1)
        around[:, 2] = 0.0 if d == 2 else around[:, 2]
        off = shape.distance(around)  # a wall is drawn as a block, of which one face lies on its surface
        assert (off.max() if kind == "wall" else np.abs(off).max()) == pytest.approx(0.0, abs=2e-3)
        assert shape.distance(np.array([*scene.start, 0.0][:3])) > 0.0
        scene = scene.with_obstacle(row)
    again = from_json(to_json(scene, env_id), d)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)) * ([1, 1, 0] if d == 2 else 1)
    for mine, theirs in zip(*map(ve.obstacles_from_rows, (again.obstacles, scene.obstacles)), strict=True):
        np.testing.assert_allclose(mine.distance(points), theirs.distance(points), atol=1e-9)
    assert len(again.obstacles) > number
    env.close()


@settings(max_examples=20)
@given(st.integers(2, 3), st.floats(0.01, 0.1), st.floats(0.0, 0.2), st.floats(-3.0, 3.0))
def test_obstacles_are_drawn_where_they_are(d, radius, length, angle):
    """All corners lie on the surface: their distance from the axis is the radius."""
    half = length * np.array([np.cos(angle), np.sin(angle), 0.0])[:d]
    mesh = drawing.obstacle_mesh(widened(np.array([*np.zeros(d), *half, radius])), -0.02, 0.03)
    points = np.asarray(mesh.vertices)[:, :d]
    square = float(half @ half)
    along = np.clip(points @ half / square, -1.0, 1.0) if square > 1e-12 else np.zeros(len(points))
    np.testing.assert_allclose(
        np.linalg.norm(points - along[:, None] * half, axis=-1), radius, rtol=1e-6, atol=2e-6
    )


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
    arm = ve.load_arm(file, hand_site="hand", joints=names, home=home, velocity_limit=np.pi)
    drawn = drawing.ArmDrawing(arm, arm.compile(0, True), file)
    away = []
    for hand in np.random.default_rng(0).uniform(*arm.workspace, (8, 3)):
        corners = [
            transforms.SO3(turn).as_matrix() @ np.asarray(part.mesh.vertices).T + place[:, None]
            for (turn, place), part in zip(
                drawn.poses(arm.inverse_kinematics(hand)), drawn.parts, strict=True
            )
        ]
        away.append(np.linalg.norm(np.concatenate(corners, axis=1).T - hand, axis=-1).min())
    assert max(away) < 0.08
    np.testing.assert_allclose(away, away[0], atol=1e-6)  # the hand does not move in its link
    with pytest.raises(ValueError):
        drawing.ArmDrawing(arm, arm.compile(0, True), file.with_name("index.md"))


def test_an_agent_of_control_steps_moves_to_the_end_of_its_episode():
    env_id = "viapoint/PlanarObstaclesStep-v0"
    agent = SAC("MultiInputPolicy", ViaVecEnv(env_id, num_envs=1), buffer_size=2, seed=0)
    some = Setting(env_id, agent, {})
    scene, env = drawn(some), some.make_step_env()
    (segment,) = movements.execute_stepwise(env, agent, scene)
    assert env.terminated[0] or env.truncated[0]
    np.testing.assert_allclose(segment.hand[0], scene.start, atol=0.01)
    assert len(segment.time) == len(segment.hand) == len(segment.path)
    assert some.decisions.choose(some.make_env().reset(seed=0)[0]).maker.startswith("search")


@pytest.mark.parametrize("env_id", [PLANAR, PANDA, MOVING])
def test_python_code_sets_the_scene_up(env_id, shared):
    some = shared(env_id)
    scene = drawn(some.own)
    names = {}
    exec(to_python(scene, env_id, {}, changing=some.own.task.replanning), names)
    env = names["env"].unwrapped
    set_up = LiveScene.of(env.batch.scenes).with_shapes(some.own.task.scenes.shapes)
    np.testing.assert_allclose(set_up.obstacles, scene.obstacles, atol=1e-6)
    np.testing.assert_allclose(env.batch.scenes.goal[0], scene.goal, atol=1e-6)
    assert isinstance(names["observation"], dict)
    assert isinstance(names["gym"].spec(env_id), gym.envs.registration.EnvSpec)


def test_scene_files_are_exact_and_keep_names_and_courses():
    """The page writes what `scene_from_json` reads, and reads the files of earlier versions."""
    ball = {"shape": "sphere", "radius": 0.1 / 3.0, "position": [-0.05, 0.35, 0.0], "name": "ball"}
    rest = {"shape": "sphere", "radius": 0.02, "position": [0.05, 0.45, 0.0]}
    course = [0.1, 0.0, 0.5, 0.0, 1.0 / 3.0]
    old = {"format": "viapoint-scene", "env": MOVING, "start": [-1.0 / 3.0, 0.3], "goal": [0.1, 0.4]}
    scene = from_json(json.dumps({**old, "obstacles": [rest, ball | {"course": course}]}), dimension=2)
    again = from_json(to_json(scene, MOVING), dimension=2)
    for mine, theirs in zip(again, scene, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(again.courses, [[0.0] * 5, course])
    assert again.names == ("", "ball")
    more = again.with_obstacle(again.obstacles[0]).without(0)
    options = ve.scene_from_json(to_json(more, MOVING))
    assert [each.name for each in options["obstacles"]] == ["ball", ""]
    assert options["start"] == old["start"]
    as_rows = {**old, "obstacles": [[-0.05, 0.35, 0.0, 0.1, 0.02]]}
    np.testing.assert_allclose(
        from_json(json.dumps(as_rows), 2).obstacles[0, :4], as_rows["obstacles"][0][:4]
    )
    env = gym.make(MOVING).unwrapped
    env.reset(seed=0)
    of_env = LiveScene.of(env.batch.scenes)
    for mine, theirs in zip(
        from_json(ve.scene_to_json(env.batch.scenes.as_options()), 2), of_env, strict=True
    ):
        np.testing.assert_array_equal(mine, theirs)


def test_the_page_is_private_unless_one_says_otherwise():
    assert all(map(is_loopback, ("127.0.0.1", "127.8.8.8", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.0.1", "example.org")))
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
            (["--host", "203.0.113.7", "--port", "0"], "203.0.113.7"),
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
    scene = LiveScene.of(some.own.task.sampler()([np.random.default_rng(0)]))
    assert some.setting_of(scene) is some.own
    crowded = scene
    while len(crowded.obstacles) <= some.own.task.observation.n_rows:
        crowded = crowded.with_obstacle(obstacle_editing.new_obstacle(crowded, "post"))
    boxed = scene.with_obstacle(obstacle_editing.new_obstacle(scene, "box"))
    for other in (crowded, boxed):
        assert some.own.limit(other)
        wide = some.setting_of(other)
        assert wide is not some.own
        fitted = other.with_shapes(wide.task.scenes.shapes)
        env = wide.make_env()
        observation, _ = env.reset(options=fitted.options(changing=False))
        assert wide.decisions.choose(observation).maker.startswith("search")
        env.close()
    for _ in range(30):
        crowded = crowded.with_obstacle(crowded.obstacles[0])
    with pytest.raises(ValueError):
        some.setting_of(crowded)


def test_problems_of_the_benchmark_are_possible_near_its_ends():
    draw = scene_kinds(PANDA, {}, Setting(PANDA, None, {}).task)["Benchmark"]
    problems = benchmark_problems()
    assert len({(each["set"], each["number"]) for each in problems}) == len(problems) == 20
    for record in problems:
        scene, origin = draw()
        assert record["set"] in origin
        assert {each["shape"] for each in record["obstacles"]} == set(scene.shapes)
        check_scenes(scene.batch(), CollisionModel(PANDA_ARM, True))
        for name, end in (("start", scene.start), ("goal", scene.goal)):
            moved = np.linalg.norm(PANDA_ARM.hand_position(np.array(record[f"{name}_joints"])) - end)
            assert moved <= 0.2001
            assert f" {100 * moved:.0f} " in origin
