"""The live page without a browser: scenes, decisions, movements, and what is drawn."""

import dataclasses
import itertools
import json
import socket

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("mjviser", reason="the extra `live` is not installed")

from helpers import JUMPS, MOVING, PANDA, PLANE, STEP, UR5E
from viser import transforms

import viapoint.envs as ve
from viapoint.envs import ENV_IDS
from viapoint.training import LivePage, ViaQ, ViaVecEnv
from viapoint.training.agents.agent import SAC
from viapoint.training.configs import LiveConfig
from viapoint.training.live import arena as live_arena
from viapoint.training.live import drawing, page
from viapoint.training.live.arena import AGENT, HAND, MOTION, OMPL, SEARCH, STRAIGHT
from viapoint.training.planning.plan_motion import plan_motion


@pytest.fixture(scope="module")
def arenas():
    made = {}

    def of(env_id):
        if env_id not in made:
            made[env_id] = live_arena.Arena(env_id, None, 4, {})
        return made[env_id]

    yield of
    for each in made.values():
        each.close()


def untrained(env_id):
    return ViaQ("ViaQPolicy", ViaVecEnv(env_id, num_envs=1), seed=0)


def drawn(arena, number=0):
    scenes = arena.scenes()["Random"]
    return [next(scenes) for _ in range(number + 1)][-1]


def decided(arena, scene, method=SEARCH, **changes):
    """Return a state with the plan of a method."""
    state = live_arena.State(scene=scene, drawn=scene, method=method, **changes)
    state.proposals = (live_arena.decide(arena, state),)
    return state


def with_proposals(arena, state):
    state.proposals = live_arena.propose(arena, state)
    return state


def assert_same(first, second, atol=0.0):
    for name in ("start", "goal", "jumps", "turns"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=0.0, atol=atol)
    for mine, theirs in zip(first.obstacles, second.obstacles, strict=True):
        assert (type(mine), mine.name) == (type(theirs), theirs.name)
        for name in ("packed_size", "position", "rotation", "velocity"):
            np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=0.0, atol=atol)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_environment_has_scenes_decisions_movements_and_a_drawing(env_id, arenas):
    """Without an agent the geometry search decides; environments of an own arm have the Panda by default."""
    arena = arenas(env_id)
    for kind in arena.scenes().values():
        scene = next(kind)
        assert_same(arena.read(scene.to_json(env_id)), scene, atol=1e-9)
    scene = drawn(arena)
    state = with_proposals(arena, decided(arena, scene))
    np.testing.assert_allclose(state.plan.waypoints[[0, -1]], (scene.start, scene.goal), atol=1e-6)
    lines = live_arena.profile(arena, scene, state.plan.plan)
    assert lines["speed"][[0, -1]].max() < 0.02 * lines["speed"].max()
    if not np.any([shape.velocity for shape in scene.obstacles]):
        assert min(lines["clearance"].min(), 1.0) >= state.plan.clearance - 1e-6
    paths = np.array([arena.path(each.motion.plan) for each in state.proposals])
    for i, j in np.argwhere(~np.eye(len(paths), dtype=bool)):
        assert np.linalg.norm(paths[i] - paths[j], axis=-1).max() > 0.9 * live_arena.APART
    movements = list(live_arena.execute(arena, state))
    np.testing.assert_allclose(movements[0].rollout.hand[0], arena.tool(scene.start), atol=1e-6)
    if arena.task.whole_movement and state.plan.success:
        assert movements[-1].info["is_success"]
        assert state.proposals[0].reward == pytest.approx(movements[-1].reward, abs=1e-6)
    parts = drawing.ArmDrawing(arena.task.arm)
    assert len(list(parts.posed(arena.task.space.joints(scene.start)))) == len(parts.parts) > 0


@pytest.mark.parametrize("env_id", [PLANE, MOVING])
@pytest.mark.parametrize("checks", [0, 16])
def test_the_page_chooses_what_the_agent_chooses(env_id, checks):
    agent = untrained(env_id)
    arena = live_arena.Arena(env_id, agent, 4, {})
    scene = drawn(arena)
    state = decided(arena, scene, AGENT, checks=checks)
    observation, _ = arena.env("own").reset(options=scene.options())
    agent.policy.checks = checks
    action, _ = agent.predict(observation, deterministic=True)
    expected = arena.task.action.decode(action, scene.start[None], scene.goal[None])
    np.testing.assert_allclose(state.plan.waypoints, expected.waypoints[0], atol=1e-9)
    plan = state.plan
    first, *others = with_proposals(arena, state).proposals
    assert first.motion is plan
    assert np.isfinite([each.value for each in others]).all()
    if not checks:
        assert np.isfinite(first.value)


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_a_plan_of_the_motion_planner_is_free_or_says_why_not(env_id, arenas):
    """Goals in contact, out of reach and outside the limits, too; where it is free, the simulation agrees."""
    arena = arenas(env_id)
    assert arena.methods[0] == MOTION
    scene, last, executed = drawn(arena), None, 0
    touched = dataclasses.replace(scene.obstacles[0], position=arena.tool(scene.goal))
    cases = [drawn(arena, number) for number in range(6)]
    cases += [scene.with_obstacle(0, touched), scene._replace(goal=scene.goal + 9.0)]
    for number, case in enumerate(cases):
        state = decided(arena, case, MOTION, before=last)
        last = state.plan
        assert np.isfinite(state.plan.waypoints).all()
        assert state.plan.success == (not state.plan.reason)
        assert not (number >= 6 and state.plan.success)
        said = live_arena.describe_plan(state.proposals[0]).lower()
        assert ("no free movement" in said) == (not state.plan.success)
        if state.plan.success:
            *_, movement = live_arena.execute(arena, state)
            executed += bool(movement.info["is_success"])
        for method in (SEARCH, STRAIGHT) if number >= 6 else ():  # impossible scenes
            assert not decided(arena, case, method).plan.success
    assert executed >= 3


@pytest.mark.parametrize("method", [SEARCH, STRAIGHT])
def test_a_scene_that_a_later_change_makes_impossible_has_no_plan_of_another_method(method, arenas):
    arena = arenas(JUMPS)
    scene = live_arena.Scene(np.array([-0.2, 0.3]), np.array([0.1, 0.4]), (), np.array([[0.3, 0.2, 0.3]]))
    assert decided(arena, scene, method).plan.success
    post = ve.Cylinder(0.02, 0.04, position=(0.2, 0.3, 0.0))  # at the goal after the jump
    with pytest.raises(ValueError):
        decided(arena, scene._replace(obstacles=(post,)), method)


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_a_plan_by_hand_is_valued_as_the_same_decision(env_id, arenas):
    arena = arenas(env_id)
    state = with_proposals(arena, decided(arena, drawn(arena)))
    chosen = state.proposals[0]
    mine = decided(arena, state.scene, by_hand=chosen.motion.waypoints[1:-1], proposals=state.proposals)
    first, *_ = live_arena.propose(arena, mine)
    assert (first.maker, first.motion.waypoints.shape) == (HAND, chosen.motion.waypoints.shape)
    assert first.motion.clearance == pytest.approx(chosen.motion.clearance, abs=1e-6)
    assert first.motion.duration == pytest.approx(chosen.motion.duration)
    assert first.reward == pytest.approx(chosen.reward, abs=1e-6)
    for number in (0, 2, 3):
        other = with_proposals(arena, decided(arena, state.scene, n_via=number))
        assert len(other.plan.durations) == number + 1
    longer = decided(arena, state.scene, duration=chosen.motion.duration + 0.3)
    assert longer.plan.duration == pytest.approx(chosen.motion.duration + 0.3)
    np.testing.assert_allclose(longer.plan.waypoints, chosen.motion.waypoints)


@pytest.mark.parametrize("method", [MOTION, OMPL, SEARCH])
def test_every_method_keeps_a_duration_that_the_limits_allow(method, arenas):
    """A shorter one becomes the shortest one, which is not a failure."""
    if method == OMPL:
        pytest.importorskip("ompl", reason="the extra `planning` is not installed")
    arena = arenas(PANDA)
    scene = drawn(arena, 1)
    assert decided(arena, scene, method, duration=9.0).plan.duration == pytest.approx(9.0)
    state = decided(arena, scene, method, duration=0.3)
    assert state.plan.success
    assert max(state.plan.limits) == pytest.approx(0.97, abs=0.01)
    assert "the shortest time" in live_arena.describe_plan(state.proposals[0], 0.3)
    assert "the shortest time" not in live_arena.describe_plan(state.proposals[0], state.plan.duration)


@pytest.mark.parametrize("env_id", [MOVING, JUMPS])
def test_a_dragged_goal_is_reached_without_a_jump(env_id, arenas):
    """A goal that is dragged jumps no more; after the arrival, it is reached by a second movement."""
    arena = arenas(env_id)
    scene = drawn(arena)
    aside = scene.goal + (0.02, 0.04) * np.sign(0.3 - scene.goal)
    for late in (False, True):
        seen, state = [], decided(arena, scene)
        for movement in live_arena.execute(arena, state):
            seen.append(movement)
            if movement.info["is_success"] if late else len(seen) > 1:
                state.scene = scene._replace(goal=aside, jumps=())
        rollout = seen[-1].rollout
        assert np.linalg.norm(rollout.hand[-1, :2] - aside) < 0.01
        velocity = np.diff(rollout.hand, axis=0) / np.diff(rollout.time)[:, None]
        assert np.abs(np.diff(velocity, axis=0)).max() < 0.1
        restarts = sum(len(b.rollout.time) < len(a.rollout.time) for a, b in itertools.pairwise(seen))
        assert restarts == int(late)


@pytest.mark.parametrize("env_id", [MOVING, JUMPS])
def test_a_method_is_rewarded_as_in_the_environment(env_id):
    agent = untrained(env_id)
    arena = live_arena.Arena(env_id, agent, 4, {})
    env = gym.make_vec(env_id, num_envs=1)
    for number in range(3):
        scene = drawn(arena, number)
        *_, movement = live_arena.execute(arena, decided(arena, scene, AGENT))
        observation, _ = env.reset(options=scene.options())
        reward, ended = 0.0, False
        while not ended:
            action, _ = agent.predict(observation, deterministic=True)
            observation, rewards, terminated, truncated, _ = env.step(action)
            reward += float(rewards[0])
            ended = bool(terminated[0] or truncated[0])
        assert movement.reward == pytest.approx(reward, abs=1e-6)


@pytest.mark.parametrize("env_id", [MOVING, JUMPS])
def test_the_motion_planner_plans_on_where_plans_are_revised(env_id, arenas, monkeypatch):
    found = []

    def recorded(*args, **kwargs):
        found.append(plan_motion(*args, **kwargs))
        return found[-1]

    monkeypatch.setattr(live_arena, "plan_motion", recorded)
    arena = arenas(env_id)
    reached, followed = 0, 0
    for number in range(8):
        *_, movement = live_arena.execute(arena, decided(arena, drawn(arena, number), MOTION))
        reached += movement.info["is_success"]
        last = found[-1]
        # The last plan in motion is what is followed, to its end.
        in_motion = last.success and last.velocity.any()
        followed += in_motion and np.allclose(movement.plan.duration, last.duration)
    assert reached >= 7
    assert followed >= 2


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_a_dragged_end_is_where_it_was_dragged_to(env_id, arenas):
    arena = arenas(env_id)
    scene = drawn(arena)
    place = arena.tool(scene.goal) * (0.95, 0.95, 1.0)
    moved = arena.moved(scene.goal, place, scene.obstacles)
    np.testing.assert_allclose(arena.tool(moved), place, atol=1e-5)
    if not arena.planar:
        same = np.abs(arena.orientation(moved) @ arena.orientation(scene.goal))
        assert same == pytest.approx(1.0, abs=1e-5)
        with pytest.raises(ValueError):
            arena.moved(scene.goal, place + 2.0)


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_obstacles_of_every_shape_are_added_resized_drawn_and_kept_in_files(env_id, arenas):
    arena = arenas(env_id)
    first = scene = drawn(arena)
    levels = (-0.02, 0.03) if arena.planar else None
    for kind in arena.new_shapes():
        before = shape = arena.new_obstacle(scene, kind)
        for name in arena.sizes_of(shape):
            shape = arena.resized(shape, name, 0.07)
            assert arena.sizes_of(shape)[name] == pytest.approx(0.07)
        np.testing.assert_allclose(shape.position, before.position)  # it stays where it is
        around = drawing.obstacle_mesh(shape, levels).vertices + np.asarray(shape.position)
        if levels:
            around[:, 2] = 0.0
        off = shape.distance(around)  # a wall is drawn as a block, of which one face lies on its surface
        some_inside = arena.planar or kind == "wall"
        assert (off.max() if some_inside else np.abs(off).max()) == pytest.approx(0.0, abs=2e-3)
        alone = first.with_obstacle(len(first.obstacles), before)
        arena.env("any").reset(options=alone.options())  # the arm is clear of it
        scene = scene.with_obstacle(len(scene.obstacles), shape)
        arena.new_obstacle(first._replace(goal=first.start), kind)  # any direction is as good
    arena.env("any").reset(options=first.options())
    record = json.loads(scene.to_json(env_id))
    assert ve.as_obstacles(record["obstacles"]) == list(scene.obstacles)
    assert [each.kind for each in scene.without(0).obstacles] == [each.kind for each in scene.obstacles[1:]]


@pytest.mark.parametrize("asset", ["", '<asset><mesh name="gone" file="gone.obj"/></asset>'])
def test_an_arm_of_ones_own_is_drawn_from_its_file(asset, tmp_path):
    """The drawn hand is where the arm's hand is, wherever the file puts the arm."""
    text = UR5E.read_text()
    file = tmp_path / "ur5e.xml"
    file.write_text(text.replace("<worldbody>", f"{asset}<worldbody>"))
    arm = ve.load_arm(file)
    parts = drawing.ArmDrawing(arm, file)
    away = []
    for joints in arm.home + np.random.default_rng(0).uniform(-0.4, 0.4, (8, 6)):
        corners = [
            transforms.SO3(turn).as_matrix() @ np.asarray(mesh.vertices).T + place[:, None]
            for _, mesh, turn, place in parts.posed(joints)
        ]
        hand = arm.hand(joints)
        away.append(np.linalg.norm(np.concatenate(corners, axis=1).T - hand, axis=-1).min())
    assert max(away) < 0.08
    np.testing.assert_allclose(away, away[0], atol=1e-6)  # the hand does not move in its link
    with pytest.raises(ValueError):
        drawing.ArmDrawing(arm, file.with_name("index.md"))


def test_an_agent_of_control_steps_moves_to_the_end_of_its_episode():
    agent = SAC("MultiInputPolicy", ViaVecEnv(STEP, num_envs=1), buffer_size=2, seed=0)
    arena = live_arena.Arena(STEP, agent, 4, {})
    state = with_proposals(arena, decided(arena, drawn(arena), AGENT))
    assert state.proposals[0].maker == SEARCH
    *_, movement = live_arena.execute(arena, state)
    env = arena.env("own")
    assert env.terminated[0] or env.truncated[0]
    assert movement.plan is None
    np.testing.assert_allclose(movement.rollout.hand[0], arena.tool(state.scene.start), atol=0.01)


def test_scene_files_are_exact_and_keep_names_and_changes(arenas):
    """The page writes what `scene_from_json` reads."""
    arena = arenas(MOVING)
    ball = {"shape": "sphere", "radius": 0.1 / 3.0, "position": [-0.05, 0.35, 0.0], "name": "ball"}
    ball["velocity"] = [0.1, 0.0, 0.0]
    rest = {"shape": "box", "size": [0.02, 0.03, 0.1], "position": [0.05, 0.45, 0.0]}
    turns = [[0.0] * 4, [0.5, 0.0, 1.0 / 3.0, 0.0]]
    record = {"format": "viapoint-scene", "env": MOVING, "start": [-1.0 / 3.0, 0.3], "goal": [0.2, 0.4]}
    record |= {"obstacles": [rest, ball], "turns": turns}
    scene = arena.read(json.dumps(record))
    with pytest.raises(ValueError):
        arena.read(json.dumps(record | {"goal": record["start"]}))
    again = arena.read(scene.to_json(MOVING))
    assert_same(again, scene, atol=1e-9)
    np.testing.assert_array_equal(again.turns, turns)
    more = again.with_obstacle(2, again.obstacles[0]).without(0)
    options = ve.scene_from_json(more.to_json(MOVING))
    assert [each.name for each in options["obstacles"]] == ["ball", ""]
    np.testing.assert_array_equal(more.turns, turns[1:])
    np.testing.assert_array_equal(again.with_obstacle(2, again.obstacles[0]).without(2).turns, turns)
    names = {}
    exec(again.to_python(MOVING, arena.arguments["any"]), names)
    unnamed = tuple(dataclasses.replace(shape, name="") for shape in again.obstacles)
    made = arena.scene_of(names["env"].unwrapped.batch.scenes)
    assert_same(made, again._replace(obstacles=unnamed), 1e-5)


def test_what_cannot_be_served_is_refused(failed, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert port in failed("live", "--port", port)
    assert "none" in failed("live", tmp_path / "none")
    assert "nowhere.xml" in failed("live", "--arm", "nowhere.xml", "--port", 0)
    assert "env_kwargs of" in failed("live", "--env-kwargs", "n_vias=1", "--port", 0)
    with pytest.raises(ValueError):
        LivePage(PLANE, env=PANDA, port=0)


def test_scenes_that_exceed_the_environment_of_the_agent_are_searched():
    agent = untrained(PLANE)
    arena = live_arena.Arena(PLANE, agent, 4, {})
    scene = drawn(arena)
    assert not arena.limit(scene)
    crowded = scene
    while len(crowded.obstacles) <= arena.task.n_obstacles[1]:
        crowded = crowded.with_obstacle(len(crowded.obstacles), arena.new_obstacle(crowded, "post"))
    walled = scene.without(0)
    walled = walled.with_obstacle(len(walled.obstacles), arena.new_obstacle(walled, "wall"))
    for other in (crowded, walled):
        assert arena.limit(other)
        assert decided(arena, other, AGENT).proposals[0].maker == SEARCH


@pytest.mark.parametrize(
    ("named", "first", "n_via"),
    [({"agent": PLANE}, AGENT, 1), ({"env": PLANE, "env_kwargs": {"n_via": 2}}, MOTION, 2)],
)
def test_the_page_is_private_and_serves_what_was_asked_for(named, first, n_via, monkeypatch):
    """An agent that is named decides at first."""

    def check(served):
        assert served.url.startswith("http://127.0.0.1:")
        assert served._server.request_share_url() is None
        arena, _ = served._make()
        assert (arena.methods[0], arena.task.n_via) == (first, n_via)

    monkeypatch.setattr(page.LivePage, "wait", check)
    page.run(LiveConfig(**named, port=0))
