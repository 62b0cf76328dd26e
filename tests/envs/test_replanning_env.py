"""Plans that are revised on the way, and what comes of them."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from revised import DT, GOAL, JUMP, MOVING, NO_ROWS, OTHER, START, make, play

from viapoint import primitives
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.registration import REPLANNING_TASKS
from viapoint.envs.sim.replan_triggers import Event
from viapoint.envs.sim.replanning_executor import SIMILAR, SLACK, groups_of, jerk_cost_between


def states(plan, time):
    """Position, velocity and acceleration of each plan at one time."""
    return [part[:, 0] for part in plan.trajectory().sample(time[:, None])]


@pytest.mark.parametrize("env_id", REPLANNING_TASKS)
def test_position_velocity_and_acceleration_do_not_jump_at_a_revision(env_id):
    env, revisions = gym.make(env_id, horizon=0.1).unwrapped, 0
    for seed in range(12):
        env.reset(seed=seed)
        play(env, actions=0.5, seed=seed)
        for (t0, before), (t1, after) in itertools.pairwise(env.last_plans):
            was, now = states(before, np.array([t1 - t0])), states(after, np.zeros(1))
            for a, b in zip(was, now, strict=True):
                np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9)
            revisions += 1
    assert revisions > 10


def test_a_zero_action_keeps_the_plan_bit_for_bit():
    env, _ = make(decide_at=("horizon",), horizon=0.05)
    first = np.array([0.3, 0.6, -0.2], np.float32)
    env.step(first)
    infos = play(env)
    assert len(env.last_plans) == 1
    assert len(infos) > 10
    whole = gym.make("viapoint/PlanarReach-v0").unwrapped
    whole.reset(seed=0, options={"start": START, "goal": GOAL, **NO_ROWS})
    *_, info = whole.step(first)
    np.testing.assert_array_equal(env.last_plan.waypoints, whole.last_plan.waypoints)
    np.testing.assert_array_equal(env.last_plan.durations, whole.last_plan.durations)
    np.testing.assert_allclose(env.last_rollout.planned, whole.last_rollout.planned, atol=1e-14)
    np.testing.assert_allclose(env.last_rollout.hand, whole.last_rollout.hand, atol=1e-12)
    for name in set(info) - {name for name in info if name.startswith("reward_")}:
        assert infos[-1][name] == pytest.approx(info[name], rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize("n_via", [0, 1, 2])
def test_nearly_nothing_changes_nearly_nothing(n_via):
    """By the principle of optimality the rest of a plan, made again through the default via-points, is itself."""
    env, _ = make(decide_at=("horizon",), horizon=0.25, n_via=n_via)
    action = np.random.default_rng(1).uniform(-0.6, 0.6, env.action_space.shape)
    for nudge in (action, 1e-7 * action):
        env.step(nudge.astype(np.float32))
    (_, first), (time, second) = env.last_plans
    times = np.linspace(0.0, float(second.duration[0]), 40)
    np.testing.assert_allclose(second.trajectory()(times), first.trajectory()(times + time), atol=1e-6)


def test_after_a_jump_the_default_is_the_smoothest_movement_to_the_new_target():
    env, _ = make(jumps=[[0.2, *OTHER]])
    *_, info = env.step(np.zeros(3))
    assert (info["event"], info["time"], info["elapsed"]) == (
        Event.TARGET,
        pytest.approx(0.2),
        pytest.approx(0.2),
    )
    env.step(np.zeros(3))
    (_, first), (_, second) = env.last_plans
    centre = env.action_layout.centre_duration
    wanted = primitives.retarget(first.trajectory(), np.array([0.2]), OTHER[None], np.array([0.2 + centre]))
    times = np.linspace(0.0, centre, 50)
    for nu, unit in ((0, 1.0), (1, 1.0), (2, 10.0)):
        np.testing.assert_allclose(second.trajectory()(times, nu), wanted(times, nu), atol=1e-9 * unit)
    assert play(env)[-1]["is_success"]


def test_actions_mean_the_same_to_the_left_and_right_of_any_line():
    """The offset of a revision is measured in the frame of hand and goal, in metres."""
    env, _ = make(jumps=[[0.3, *OTHER]], horizon=5.0)
    env.step(np.zeros(3))
    default = env.batch.default
    line = OTHER - default.state.position[0]
    along = line / np.linalg.norm(line)
    env.step(np.array([0.2, -0.4, 0.5], np.float32))
    via = env.last_plan.waypoints[1]
    wanted = 0.2 * 0.15 * along - 0.4 * 0.25 * np.array([-along[1], along[0]])
    np.testing.assert_allclose(via - default.vias[0, 0], wanted, atol=1e-8)
    low, high = env.action_layout.duration_range
    assert env.last_plan.durations.sum() == pytest.approx(
        default.remaining[0] * (high / low) ** 0.25, rel=1e-6
    )


def test_similar_lengths_are_simulated_together_and_little_is_wasted():
    generator = np.random.default_rng(0)
    for _ in range(20):
        steps = generator.integers(1, 700, generator.integers(1, 300))
        groups = groups_of(steps)
        assert sorted(np.concatenate(groups)) == list(range(len(steps)))
        assert all(steps[g].max() <= SIMILAR * steps[g].min() + SLACK for g in groups)
    env = gym.make_vec(JUMP, num_envs=64, threads=1)
    env.reset(seed=0)
    needed = 0.0
    for _ in range(8):
        *_, info = env.step(generator.uniform(-1.0, 1.0, env.action_space.shape))
        needed += info["elapsed"].sum() / DT
    assert needed <= env.unwrapped.physics_steps <= 1.1 * needed
    most = env.unwrapped.num_envs * 8 * 0.3 / DT
    assert needed < 0.8 * most  # lengths do differ


@pytest.mark.parametrize("env_id", [JUMP, MOVING])
def test_reward_terms_sum_to_what_they_are_of_the_whole_episode(env_id):
    env = gym.make(env_id).unwrapped
    for seed in range(8):
        env.reset(seed=seed)
        weights = env.task.weights
        infos = play(env, actions=0.4, seed=seed)
        total = {name: sum(info[name] for info in infos) for name in infos[0] if name.startswith("reward_")}
        last, centre = infos[-1], env.action_layout.centre_duration
        assert sum(info["reward"] for info in infos) == pytest.approx(sum(total.values()))
        assert total["reward_duration"] == pytest.approx(-weights.duration * last["time"] / centre)
        length = np.linalg.norm(env.batch.scenes.goal[0] - env.batch.scenes.start[0])
        straight = 360.0 * length**2 / centre**5
        assert total["reward_smoothness"] == pytest.approx(
            -weights.smoothness * np.log1p(last["jerk_cost"] / straight)
        )
        clearance = np.clip(last["planned_clearance"], -0.05, 0.01) / 0.05
        assert total["reward_clearance"] == pytest.approx(weights.clearance * clearance)
        assert total["reward_success"] == weights.success * last["is_success"]


def test_jerk_cost_of_the_parts_is_that_of_the_whole():
    env, _ = make(horizon=0.2)
    env.step(np.array([0.3, 0.7, 0.1], np.float32))
    plan = env.last_plans[0][1]
    cuts = np.sort(np.append(np.random.default_rng(0).uniform(0.0, 1.0, 6), [0.0, 2.0]))
    parts = [jerk_cost_between(plan, np.array([a]), np.array([b])) for a, b in itertools.pairwise(cuts)]
    assert sum(parts)[0] == pytest.approx(plan.trajectory().cost()[0], rel=1e-12)


@pytest.mark.parametrize("env_id", [JUMP, MOVING])
def test_going_on_from_a_stored_state_is_the_same(env_id):
    first, second = (gym.make_vec(env_id, num_envs=6, threads=1).unwrapped for _ in range(2))
    first.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.4, 0.4, (12, *first.action_space.shape))
    for action in actions[:5]:
        first.step(action)
    second.restore(first.state())
    assert [len(plans) for plans in first.last_plans] == [len(plans) for plans in second.last_plans]
    for action in actions[5:]:
        (a, r, *_, info), (b, s, *_, same) = first.step(action), second.step(action)
        np.testing.assert_array_equal(r, s)
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])
        np.testing.assert_array_equal(info["jerk_cost"], same["jerk_cost"])
    np.testing.assert_array_equal(first.last_rollout[0].hand, second.last_rollout[0].hand)


@pytest.mark.usefixtures("opengl")
def test_pictures_show_the_episode_so_far():
    env, _ = make(jumps=[[0.2, *OTHER]], render_mode="rgb_array_list", width=64, height=64)
    before = env.render()
    play(env)
    frames = env.render()
    assert len(before) == 1
    assert len(frames) == round(env.last_rollout.time[-1] * env.metadata["render_fps"]) + 1
    assert len({frame.tobytes() for frame in frames}) > 20


def test_a_plan_in_metres_and_seconds_can_be_performed_on_the_way():
    env, _ = make(horizon=0.2, decide_at=("horizon",))
    env.step(np.zeros(3))
    default, batch = env.batch.default, env.batch
    waypoints = np.stack((default.state.position, default.vias[:, 0] + 0.02, default.goal), axis=1)
    batch.execute_plan(Plan(waypoints, np.array([[0.3, 0.4]])))
    (_, before), (time, after) = env.last_plans
    np.testing.assert_array_equal(after.waypoints, waypoints)
    np.testing.assert_allclose(states(before, np.array([time]))[2], after.acceleration, atol=1e-9)
    waypoints[:, 0] = batch.default.state.position
    with pytest.raises(ValueError):
        batch.execute_plan(Plan(waypoints[:, ::2], np.array([[0.7]])))
    with pytest.raises(ValueError):
        batch.execute_plan(Plan(waypoints + 0.1, np.array([[0.3, 0.4]])))


def test_a_moved_goal_is_reached_without_a_jump():
    env = gym.make_vec("viapoint/PlanarTargetJump-v0", num_envs=3, horizon=0.1, threads=1).unwrapped
    env.reset(seed=0)
    zero = np.zeros((3, 3))
    env.execute_actions(zero)
    env.execute_actions(zero)
    goals = env.scenes.goal + np.array([0.0, 0.03])
    before = env.default.state
    observation = env.move_goals(goals)
    np.testing.assert_allclose(observation["goal"], goals, atol=1e-6)
    env.execute_actions(zero)
    for row, history in enumerate(env.last_plans):
        after = states(history[-1][1], np.zeros(1))
        for was, now in zip(before, after, strict=True):
            np.testing.assert_allclose(now[0], was[row], rtol=0.0, atol=1e-9)
    while not env.terminated.any():
        info = env.execute_actions(zero).info
    np.testing.assert_allclose(env.last_plan.waypoints[:, -1], goals)
    assert info["is_success"][env.terminated].all()
