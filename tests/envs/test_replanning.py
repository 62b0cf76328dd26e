"""Plans that are revised while they are under way, and what ends a decision."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from helpers import GOAL, JUMPS, MOVING, OTHER, PANDA, PANDA_MOVING, PLANE, events, given, play, post, same

from viapoint import primitives
from viapoint.envs.arms.kinematics import LIMIT_SHARE, slowdowns
from viapoint.envs.events import FORESIGHT, LOOK, Event
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import Plan, least_remaining

IDS = (JUMPS, MOVING, PANDA_MOVING)
DT = 0.002


def nominal(env):
    """Return the plan of a zero action of an environment or batch on one thread."""
    return getattr(env, "batch", env)._episodes[0].nominal


def states(plan, time):
    """Return position, velocity and acceleration of each plan at one time."""
    return [part[:, 0] for part in plan.trajectory().sample(time[:, None])]


@pytest.mark.parametrize("env_id", [PLANE, PANDA, "viapoint/PlanarWholeArm-v0"])
@pytest.mark.parametrize("number", [1, 5])
def test_one_decision_is_a_whole_movement_bit_for_bit(env_id, number):
    """The execution that goes on until the next decision, without events before the goal."""
    results = []
    for decide_at in ("end", ()):
        env = gym.make_vec(env_id, num_envs=number, decide_at=decide_at, threads=1).unwrapped
        env.reset(seed=3)
        actions = np.random.default_rng(1).uniform(-0.5, 0.5, env.action_space.shape)
        decision = env.execute_actions(actions)
        results.append((decision.info, decision.reward, env.last_rollout, decision.terminated))
    (info, reward, rollouts, over), (other, same_reward, others, ended) = results
    same(info, other)
    np.testing.assert_array_equal(reward, same_reward)
    np.testing.assert_array_equal(over, ended)
    for one, two in zip(rollouts, others, strict=True):
        same(one._asdict(), two._asdict())


@pytest.mark.parametrize("env_id", IDS)
def test_position_velocity_and_acceleration_do_not_jump_at_a_revision(env_id):
    env, revisions = gym.make(env_id, horizon=0.1).unwrapped, 0
    for seed in range(6):
        env.reset(seed=seed)
        play(env, 0.5, seed)
        for (t0, before), (t1, after) in itertools.pairwise(env.last_plans):
            was, now = states(before, np.array([t1 - t0])), states(after, np.zeros(1))
            for a, b in zip(was, now, strict=True):
                np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9)
            revisions += 1
    assert revisions > 10


def test_a_zero_action_keeps_the_plan_bit_for_bit():
    env, _ = given(JUMPS, decide_at=("horizon",), horizon=0.048)
    first = np.array([0.3, 0.6, -0.2], np.float32)
    env.step(first)
    infos = play(env)
    assert len(env.last_plans) == 1
    assert len(infos) > 10
    whole, _ = given("viapoint/PlanarReach-v0")
    *_, info = whole.step(first)
    same(env.last_plan._asdict(), whole.last_plan._asdict())
    np.testing.assert_allclose(env.last_rollout.planned, whole.last_rollout.planned, atol=1e-13)
    np.testing.assert_allclose(env.last_rollout.hand, whole.last_rollout.hand, atol=1e-11)
    for name in ("jerk_cost", "path_length", "goal_error", "peak_speed", "duration", "tracking_error"):
        assert infos[-1][name] == pytest.approx(info[name], rel=1e-8, abs=1e-11), name


@pytest.mark.parametrize("n_via", [0, 1, 2])
def test_nearly_nothing_changes_nearly_nothing(n_via):
    """By the principle of optimality the rest of a plan, made again through the default via-points, is itself."""
    env, _ = given(JUMPS, decide_at=("horizon",), horizon=0.25, n_via=n_via)
    action = np.random.default_rng(1).uniform(-0.6, 0.6, env.action_space.shape)
    for nudge in (action, 1e-7 * action):
        env.step(nudge.astype(np.float32))
    (_, first), (time, second) = env.last_plans
    times = np.linspace(0.0, float(second.duration[0]), 40)
    np.testing.assert_allclose(second.trajectory()(times), first.trajectory()(times + time), atol=1e-6)


def test_after_a_jump_the_default_is_the_smoothest_movement_to_the_new_target():
    env, _ = given(JUMPS, jumps=[[0.2, *OTHER]])
    *_, info = env.step(np.zeros(3))
    assert info["event"] == Event.TARGET
    assert (info["time"], info["elapsed"]) == pytest.approx((0.2, 0.2))
    env.step(np.zeros(3))
    (_, first), (_, second) = env.last_plans
    centre = env.task.action.centre
    wanted = primitives.retarget(first.trajectory(), np.array([0.2]), OTHER[None], np.array([0.2 + centre]))
    times = np.linspace(0.0, centre, 50)
    for nu, unit in ((0, 1.0), (1, 1.0), (2, 10.0)):
        np.testing.assert_allclose(second.trajectory()(times, nu), wanted(times, nu), atol=1e-9 * unit)
    assert play(env)[-1]["is_success"]


def test_offsets_of_a_revision_are_in_the_frame_of_hand_and_goal():
    env, _ = given(JUMPS, jumps=[[0.3, *OTHER]], horizon=5.0)
    env.step(np.zeros(3))
    default = nominal(env)
    line = OTHER - default.state.position[0]
    along = line / np.linalg.norm(line)
    env.step(np.array([0.2, -0.4, 0.5], np.float32))
    wanted = 0.2 * 0.15 * along - 0.4 * 0.25 * np.array([-along[1], along[0]])
    np.testing.assert_allclose(env.last_plan.waypoints[1] - default.vias[0, 0], wanted, atol=1e-8)
    low, high = env.task.duration_range
    duration = env.last_plan.durations.sum()
    assert duration == pytest.approx(default.remaining[0] * (high / low) ** 0.25, rel=1e-6)


@pytest.mark.parametrize("env_id", IDS)
def test_reward_terms_sum_to_those_of_the_whole_episode(env_id):
    env = gym.make(env_id).unwrapped
    for seed in range(4):
        env.reset(seed=seed)
        weights, space, scenes = env.task.weights, env.task.space, env.batch.scenes
        start, goal = space.coordinates(scenes.start)[0], space.coordinates(scenes.goal)[0]
        zero = env.task.action.zero_duration(start, goal)
        infos = play(env, 0.3, seed)
        total = {name: sum(info[name] for info in infos) for name in infos[0] if name.startswith("reward_")}
        last = infos[-1]
        assert sum(info["reward"] for info in infos) == pytest.approx(sum(total.values()))
        assert total["reward_duration"] == pytest.approx(-weights.duration * last["duration"] / zero)
        straight = 360.0 * np.sum((goal - start) ** 2) / zero**5
        rough = np.log1p(last["jerk_cost"] / straight)
        assert total["reward_smoothness"] == pytest.approx(-weights.smoothness * rough)
        clearance = np.clip(last["planned_clearance"], -0.05, 0.01) / 0.05
        assert total["reward_clearance"] == pytest.approx(weights.clearance * clearance)
        assert total["reward_success"] == weights.success * last["is_success"]


def test_a_plan_in_metres_and_seconds_can_be_executed_on_the_way():
    env, _ = given(JUMPS, horizon=0.2, decide_at=("horizon",))
    env.step(np.zeros(3))
    default = nominal(env)
    waypoints = np.stack((default.state.position, default.vias[:, 0] + 0.02, default.goal), axis=1)
    env.batch.execute_plan(Plan(waypoints, np.array([[0.3, 0.4]])))
    (_, before), (time, after) = env.last_plans
    np.testing.assert_array_equal(after.waypoints, waypoints)
    np.testing.assert_allclose(states(before, np.array([time]))[2], after.acceleration, atol=1e-9)


@pytest.mark.parametrize(("env_id", "decide_at"), [(PLANE, "end"), (JUMPS, ("target",))])
def test_no_plan_is_executed_after_the_end(env_id, decide_at):
    env, first = given(env_id, decide_at=decide_at)
    plan = Plan(np.stack((first["hand"][:2], OTHER, GOAL))[None], np.full((1, 2), 0.5))
    assert env.batch.execute_plan(plan).info["is_success"]
    with pytest.raises(gym.error.ResetNeeded):
        env.batch.execute_plan(plan)


@pytest.mark.parametrize("env_id", [JUMPS, PANDA_MOVING])
def test_a_moved_goal_is_reached_without_a_jump(env_id):
    env = gym.make_vec(env_id, num_envs=3, horizon=0.1, threads=1, n_obstacles=0).unwrapped
    env.reset(seed=0)
    zero = np.zeros(env.action_space.shape)
    env.execute_actions(zero)
    env.execute_actions(zero)
    space = env.task.space
    goals = space.coordinates(env.scenes.goal)
    goals = goals + 0.03 * np.eye(space.dimension)[1]
    before = nominal(env).state
    observation = env.move_goals(goals)
    seen = observation["goal"][:, :2] if space.of_hand else observation["goal_joints"]
    np.testing.assert_allclose(seen, goals, atol=1e-6)
    env.execute_actions(zero)
    for row, history in enumerate(env.last_plans):
        after = states(history[-1][1], np.zeros(1))
        for was, now in zip(before, after, strict=True):
            np.testing.assert_allclose(now[0], was[row], rtol=0.0, atol=1e-9)
    active = np.ones(3, bool)
    while active.any():
        info = env.execute_actions(zero, active).info
        done = env.terminated & active
        assert (info["is_success"] | info["collision"])[done].all()
        active &= ~env.terminated
    np.testing.assert_allclose(env.last_plan.waypoints[:, -1], goals)


def test_plans_that_are_revised_in_motion_keep_to_the_limits():
    env = gym.make_vec(PANDA_MOVING, num_envs=24, threads=1, n_obstacles=0).unwrapped
    env.reset(seed=0)
    rng, moving = np.random.default_rng(0), 0
    arm = env.task.arm
    for _ in range(4):
        env.execute_actions(rng.uniform(-1.0, 1.0, env.action_space.shape))
        for history in env.last_plans:
            plan = history[-1][1]
            motion = plan.trajectory().sample(np.linspace(0.0, 1.0, 500) * plan.duration[:, None])
            needed = slowdowns(arm.chain, arm.velocity_limit, arm.torque_limit, *motion)
            assert needed[0] * LIMIT_SHARE < 1.0
            moving += plan.velocity.any()
    assert moving > 10


def test_limits_hold_between_samples_and_no_movement_is_slower_than_they_need():
    env = gym.make_vec("viapoint/PandaReach-v0", num_envs=32, n_via=2, duration_range=(1.0, 1.01)).unwrapped
    env.reset(seed=5)
    actions = np.random.default_rng(5).uniform(-1.0, 1.0, env.action_space.shape)
    info = env.execute_actions(actions).info
    arm, ran = env.task.arm, info["reachable"]
    assert ran.mean() > 0.1
    assert (info["stretch"][ran] > 1.0).all()
    plan = env.last_plan.take(ran)
    motion = plan.trajectory().sample(np.linspace(0.0, 1.0, 1000) * plan.duration[:, None])
    needed = slowdowns(arm.chain, arm.velocity_limit, arm.torque_limit, *motion)
    np.testing.assert_allclose(needed, 1.0, atol=0.02)
    for rollout in itertools.compress(env.last_rollout, ran):
        rates = np.abs(np.diff(rollout.joints, axis=0)) / arm.timestep
        assert (rates < arm.velocity_limit).all()


# Events


def test_decisions_end_when_their_horizon_has_passed():
    env, _ = given(JUMPS, decide_at=("horizon",), horizon=0.1)
    infos = play(env)
    assert [info["elapsed"] for info in infos[:-1]] == pytest.approx([0.1] * (len(infos) - 1))
    assert events(infos) == [Event.HORIZON] * (len(infos) - 1) + [Event.ARRIVAL]
    assert infos[-1]["time"] == pytest.approx(np.ceil((env.task.action.centre + SETTLING) / DT) * DT)
    assert sum(info["elapsed"] for info in infos) == pytest.approx(infos[-1]["time"])


def test_a_resting_hand_may_set_out_again():
    far = [post(-0.3, 0.6, velocity=(0.0, 0.0, 0.0))]
    env, _ = given(MOVING, far, turns=[[1.2, 0.1, 0.0, 0.0]], decide_at=("course",))
    *_, info = env.step(np.zeros(3))
    assert (info["event"], info["time"]) == (Event.COURSE, pytest.approx(1.2))
    *_, terminated, _, info = env.step(np.array([0.0, 0.5, 0.4], np.float32))
    assert terminated
    assert info["is_success"]
    low, high = env.task.duration_range
    least = least_remaining(env.task.action)
    assert env.last_plan.durations.sum() == pytest.approx(least * (high / low) ** 0.2)
    assert np.linalg.norm(env.last_rollout.hand[600:, :2] - GOAL, axis=-1).max() > 0.1


def test_a_jump_that_is_no_reason_to_decide_is_noticed_on_arrival():
    env, _ = given(JUMPS, jumps=[[0.2, *OTHER]], decide_at=())
    infos = play(env)
    assert events(infos) == [Event.ARRIVAL, Event.ARRIVAL]
    assert [info["is_success"] for info in infos] == [False, True]
    env, _ = given(MOVING, jumps=[[0.2, *OTHER]], decide_at=())  # a task that draws no jumps
    assert play(env)[-1]["jerk_ratio"] == pytest.approx(infos[-1]["jerk_ratio"])


@pytest.mark.parametrize("late", [3.0, 30.0])
def test_changes_after_the_time_limit_keep_nobody_waiting(late):
    for changes in ({"jumps": [[late, *OTHER]]}, {"turns": [[late, 0.1, 0.0, 0.0]]}):
        env, _ = given(MOVING, [post(0.3, 0.2)], decide_at=("target", "course"), **changes)
        assert play(env)[-1]["is_success"]


def test_an_obstacle_that_changes_its_course_ends_the_decision():
    moving = [post(-0.1, 0.6, velocity=(0.1, 0.0, 0.0))]
    env, first = given(MOVING, moving, turns=[[0.31, -0.1, 0.05, 0.0]], decide_at=("course",))
    after, _, _, _, info = env.step(np.zeros(3))
    assert info["event"] == Event.COURSE
    assert info["time"] == pytest.approx(0.31, abs=DT)
    rows = env.task.observation.rows
    kinds = len(env.task.shapes)
    for seen, place, velocity in (
        (first, (-0.1, 0.6), (0.1, 0.0)),
        (after, (-0.1 + 0.1 * 0.31, 0.6), (-0.1, 0.05)),
    ):
        row = rows(seen["obstacles"])[0]
        assert row[kinds : kinds + 2] == pytest.approx(place, abs=1e-3)
        assert row[kinds + 12 : kinds + 14] == pytest.approx(velocity)


CROSSING = (post(0.0, 0.16, 0.03, velocity=(0.0, 0.45, 0.0)),)


def test_a_predicted_collision_ends_the_decision_before_it_happens():
    env, _ = given(MOVING, CROSSING, decide_at=("clearance",))
    *_, info = env.step(np.zeros(3))
    assert info["event"] == Event.CLEARANCE
    noticed = info["time"]
    assert play(env)[-1]["event"] == Event.CONTACT
    contact = env.last_rollout.time[env.last_rollout.contact.argmax()]
    assert noticed + FORESIGHT - LOOK - 0.1 < contact < noticed + FORESIGHT + 0.1
    careless, _ = given(MOVING, CROSSING, decide_at=())
    assert events(play(careless)) == [Event.CONTACT]


def test_a_change_of_course_is_foreseen_only_once_it_has_happened():
    turn = 0.6
    waiting = [post(0.1, 0.6, 0.03)]
    env, _ = given(MOVING, waiting, turns=[[turn, 0.0, -0.5, 0.0]], decide_at=("clearance",))
    *_, info = env.step(np.zeros(3))
    assert info["event"] == Event.CLEARANCE
    assert turn <= info["time"] < turn + 2.0 * LOOK
    assert play(env)[-1]["first_contact_time"] < turn + FORESIGHT


def test_an_obstacle_that_runs_into_a_resting_arm_is_a_collision_and_no_crash():
    coming = [post(0.1, 0.7, 0.03, velocity=(0.0, -0.2, 0.0))]
    env, _ = given(MOVING, coming, jumps=[[2.2, *OTHER]], decide_at=("target",))
    infos = play(env)
    assert events(infos) == [Event.CONTACT]
    assert infos[0]["collision"]
    assert not infos[0]["unstable"]
    assert 1.0 < infos[0]["first_contact_time"] < 2.2
    assert infos[0]["elapsed"] == pytest.approx(infos[0]["first_contact_time"] + DT)


def test_the_time_limit_ends_an_episode_as_a_failure():
    env, _ = given(JUMPS, horizon=0.1, decide_at=("horizon",))
    stalling = np.array([0.0, 0.0, 1.0], np.float32)
    terminated = False
    while not terminated:
        *_, terminated, truncated, info = env.step(stalling)
    assert not truncated
    assert info["event"] == Event.TIME_LIMIT
    assert info["time"] == pytest.approx(env.task.time_limit)
    assert not info["is_success"]
