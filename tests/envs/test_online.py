"""Targets that jump, obstacles that move, and plans that are revised on the way."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from viapoint import primitives
from viapoint.envs.action import Plan
from viapoint.envs.decision_ends import FORESIGHT, LOOK, SAMPLED, Event
from viapoint.envs.execution import SETTLING
from viapoint.envs.online_episodes import jerk_cost_between
from viapoint.envs.online_execution import SIMILAR, SLACK, groups_of
from viapoint.envs.registration import ONLINE_TASKS

JUMP, MOVING, PANDA = (
    f"viapoint/{name}-v0" for name in ("PlanarTargetJump", "PlanarMovingObstacles", "PandaMovingObstacles")
)
START, GOAL, OTHER = np.array([-0.3, 0.4]), np.array([0.1, 0.4]), np.array([0.0, 0.55])
DT = 0.002
NO_ROWS = {"obstacles": np.zeros((0, 5))}


def make(env_id=JUMP, jumps=(), seed=0, obstacles=None, courses=None, **kwargs):
    """An environment in a given episode, and its first observation."""
    env = gym.make(env_id, **kwargs).unwrapped
    rows = NO_ROWS if obstacles is None else {"obstacles": np.array(obstacles), "courses": np.array(courses)}
    options = {"start": START, "goal": GOAL, "jumps": np.array(jumps).reshape(-1, 3), **rows}
    return env, env.reset(seed=seed, options=options)[0]


def play(env, actions=None, seed=0):
    """To the end, by zero or random actions: all infos."""
    generator, infos, over = np.random.default_rng(seed), [], False
    while not over:
        scale = 0.0 if actions is None else actions
        action = scale * generator.uniform(-1.0, 1.0, env.action_space.shape)
        _, reward, over, _, info = env.step(action.astype(np.float32))
        infos.append({**info, "reward": reward})
    return infos


def events(infos):
    return [Event(info["event"]) for info in infos]


@pytest.mark.parametrize("env_id", ONLINE_TASKS)
def test_position_velocity_and_acceleration_do_not_jump_at_a_revision(env_id):
    env, revisions = gym.make(env_id, horizon=0.1).unwrapped, 0
    for seed in range(12):
        env.reset(seed=seed)
        play(env, actions=0.5, seed=seed)
        for (t0, before), (t1, after) in itertools.pairwise(env.last_plans):
            was, now = before.states(np.array([t1 - t0])), after.states(np.zeros(1))
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
    for name in (
        "is_success",
        "goal_error",
        "duration",
        "jerk_cost",
        "jerk_ratio",
        "path_length",
        "tracking_error",
    ):
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


def test_decisions_end_when_their_horizon_has_passed():
    env, _ = make(decide_at=("horizon",), horizon=0.1)
    infos = play(env)
    assert [info["elapsed"] for info in infos[:-1]] == pytest.approx([0.1] * (len(infos) - 1))
    assert events(infos) == [Event.HORIZON] * (len(infos) - 1) + [Event.ARRIVAL]
    centre = env.action_layout.centre_duration
    assert infos[-1]["time"] == pytest.approx(np.ceil((centre + SETTLING) / DT) * DT)
    assert sum(info["elapsed"] for info in infos) == pytest.approx(infos[-1]["time"])


def test_a_hand_that_arrives_early_rests_until_something_happens():
    env, _ = make(jumps=[[1.5, *OTHER]], decide_at=())
    infos = play(env)
    assert events(infos) == [Event.TARGET, Event.ARRIVAL]
    assert infos[0]["time"] == pytest.approx(1.5)
    rest = env.last_rollout.hand[600:750]
    assert np.ptp(rest, axis=0).max() < 1e-3
    assert infos[-1]["is_success"]


def test_a_resting_hand_may_set_out_again():
    far, turns = [[-0.3, 0.6, 0.0, 0.0, 0.02]], [[0.0, 0.0, 1.2, 0.1, 0.0]]
    env, _ = make(MOVING, obstacles=far, courses=turns, decide_at=())
    *_, info = env.step(np.zeros(3))
    assert (info["event"], info["time"]) == (Event.COURSE, pytest.approx(1.2))
    *_, terminated, _, info = env.step(np.array([0.0, 0.5, 0.4], np.float32))
    assert terminated
    assert info["is_success"]
    least, (low, high) = env.reviser.least_remaining, env.action_layout.duration_range
    assert env.last_plan.durations.sum() == pytest.approx(least * (high / low) ** 0.2)
    assert np.linalg.norm(env.last_rollout.hand[600:] - GOAL, axis=-1).max() > 0.1


def test_a_jump_that_is_no_reason_to_decide_is_noticed_on_arrival():
    env, _ = make(jumps=[[0.2, *OTHER]], decide_at=())
    infos = play(env)
    assert events(infos) == [Event.ARRIVAL, Event.ARRIVAL]
    assert not infos[0]["is_success"]
    assert infos[1]["is_success"]


def test_an_obstacle_that_changes_its_course_ends_the_decision():
    course = [[0.1, 0.0, 0.31, -0.1, 0.05]]
    env, observation = make(
        MOVING, obstacles=[[-0.1, 0.6, 0.0, 0.0, 0.02]], courses=course, decide_at=("course",)
    )
    assert observation["obstacle_velocities"][:2] == pytest.approx([0.1, 0.0])
    after, _, _, _, info = env.step(np.zeros(3))
    assert info["event"] == Event.COURSE
    assert info["time"] == pytest.approx(0.31, abs=DT)
    assert after["obstacle_velocities"][:2] == pytest.approx([-0.1, 0.05])
    assert after["obstacles"][:2] == pytest.approx([-0.1 + 0.1 * 0.31, 0.6], abs=1e-3)
    np.testing.assert_allclose(
        env.batch._simulator.batch.bind("mocap_pos")[0, 0, :2], after["obstacles"][:2], atol=0.1 * DT + 1e-6
    )


def test_a_predicted_collision_ends_the_decision_before_it_happens():
    """An obstacle that crosses the line: noticed as soon as it is foreseen, which is soon enough."""
    row, course = [[0.0, 0.16, 0.0, 0.0, 0.03]], [[0.0, 0.45, 0.0, 0.0, 0.45]]
    env, _ = make(MOVING, obstacles=row, courses=course, decide_at=("clearance",))
    *_, info = env.step(np.zeros(3))
    assert info["event"] == Event.CLEARANCE
    noticed = info["time"]
    assert play(env)[-1]["event"] == Event.CONTACT
    contact = env.last_rollout.time[env.last_rollout.contact.argmax()]
    assert noticed + FORESIGHT - LOOK * SAMPLED - 0.1 < contact < noticed + FORESIGHT + 0.1
    careless, _ = make(MOVING, obstacles=row, courses=course, decide_at=())
    assert events(play(careless)) == [Event.CONTACT]


def test_a_change_of_course_is_foreseen_only_once_it_has_happened():
    """An obstacle stands near the goal, and sets out for it a third of a second before it touches the hand there."""
    turn = 0.6
    env, _ = make(
        MOVING,
        obstacles=[[0.1, 0.6, 0.0, 0.0, 0.03]],
        courses=[[0, 0, turn, 0, -0.5]],
        decide_at=("clearance",),
    )
    *_, info = env.step(np.zeros(3))
    assert info["event"] == Event.CLEARANCE
    assert turn <= info["time"] < turn + 2.0 * LOOK * SAMPLED
    assert play(env)[-1]["first_contact_time"] < turn + FORESIGHT


def test_an_obstacle_that_runs_into_a_resting_arm_is_a_collision_and_no_crash():
    course = [[0.0, -0.2, 0.0, 0.0, -0.2]]
    env, _ = make(
        MOVING, jumps=[[2.2, *OTHER]], obstacles=[[0.1, 0.7, 0.0, 0.0, 0.03]], courses=course, decide_at=()
    )
    infos = play(env)
    assert events(infos) == [Event.CONTACT]
    assert infos[0]["collision"]
    assert not infos[0]["unstable"]
    assert 1.0 < infos[0]["first_contact_time"] < 2.2
    assert infos[0]["elapsed"] == pytest.approx(infos[0]["first_contact_time"] + DT)


def test_the_time_limit_ends_an_episode_as_a_failure():
    env, _ = make(horizon=0.1, decide_at=("horizon",))
    stalling = np.array([0.0, 0.0, 1.0], np.float32)
    for _ in range(200):
        *_, terminated, truncated, info = env.step(stalling)
        if terminated:
            break
    assert (terminated, truncated) == (True, False)
    assert info["event"] == Event.TIME_LIMIT
    assert info["time"] == pytest.approx(env.batch.time_limit)
    assert not info["is_success"]


def test_what_lies_in_the_future_is_hidden():
    (one, first), (other, second) = make(jumps=[[0.5, *OTHER]]), make(jumps=[[0.4, *START + 0.1]])
    for _ in range(2):
        for name, part in first.items():
            np.testing.assert_array_equal(part, second[name])
        (first, *_), (second, *_) = one.step(np.zeros(3)), other.step(np.zeros(3))
    assert not np.array_equal(first["goal"], second["goal"])


@pytest.mark.parametrize("env_id", ONLINE_TASKS)
def test_the_scenes_of_an_episode_are_options_that_make_it_again(env_id):
    drawn, given = gym.make_vec(env_id, num_envs=5), gym.make_vec(env_id, num_envs=5)
    first, _ = drawn.reset(seed=3)
    again, _ = given.reset(options=drawn.unwrapped.scenes.as_options())
    for k in range(4):
        for name, part in first.items():
            np.testing.assert_array_equal(part, again[name])
        actions = np.random.default_rng(k).uniform(-0.3, 0.3, drawn.action_space.shape)
        (first, reward, over, *_), (again, same, *_) = drawn.step(actions), given.step(actions)
        np.testing.assert_array_equal(reward, same)
        if over.any():
            return


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"jumps": [[0.0, *OTHER]]}, "jump 0 at 0 s lies in the past"),
        ({"jumps": [[-0.1, *OTHER]]}, "lies in the past"),
        ({"jumps": [[0.5, *OTHER], [0.4, *GOAL]]}, "jump 1 .*not after the one before"),
        ({"jumps": [[99.0, *OTHER]]}, "not before the time limit"),
        ({"jumps": [[0.2, 3.0, 0.0]]}, "target of jump 0 .* out of the arm's reach"),
        ({"jumps": [[0.2, 3.0]]}, "shape"),
        ({"jumps": [[0.2, np.nan, 0.3]]}, "finite"),
        ({"jumps": [["soon", 0.0, 0.3]]}, "real numbers"),
        ({"courses": [[0.1, 0.0, 0.0, 0.1, 0.0]]}, "course 0 belongs to no obstacle"),
        (
            {"obstacles": [[*START, 0.0, 0.0, 0.03]], "courses": [[0.1, 0.0, 0.0, 0.1, 0.0]]},
            "obstacle 0 .* touches the arm at the start",
        ),
        (
            {"obstacles": [[-0.1, 0.6, 0.0, 0.0, 0.03]], "courses": [[0.1, 0.0, 0.0, 0.2, 0.0]]},
            "change of course 0 at 0 s lies in the past",
        ),
        (
            {"obstacles": [[-0.1, 0.6, 0.0, 0.0, 0.03]], "courses": [[3.0, 0.0, 0.0, 3.0, 0.0]]},
            "faster than",
        ),
        (
            {"obstacles": [[*OTHER, 0.0, 0.0, 0.03]], "jumps": [[0.2, *OTHER]]},
            "touches the arm at the target of jump 0",
        ),
    ],
)
def test_impossible_changes_are_refused_with_the_reason_and_nothing_has_changed(changes, reason):
    env = gym.make(MOVING).unwrapped
    before, _ = env.reset(seed=1)
    with pytest.raises(ValueError, match=reason):
        env.reset(options={"start": START, "goal": GOAL, **NO_ROWS, **changes})
    after, _ = env.reset()
    env.reset(seed=1)
    again, _ = env.reset()
    np.testing.assert_array_equal(after["goal"], again["goal"])
    assert not np.array_equal(before["goal"], after["goal"])


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"horizon": 0.001}, "horizon must be a finite number, 0.002 or more"),
        ({"horizon": np.nan}, "horizon must be a finite number"),
        ({"margin": -0.1}, "margin must be a finite number, 0 or more"),
        ({"decide_at": ("noon",)}, "decide_at must be some of horizon, target, course, clearance"),
        ({"decide_at": "target"}, "decide_at must be some of"),
        ({"timing": "learned"}, "timing must be optimal where plans are revised"),
        ({"n_jumps": 9}, "n_jumps must be"),
        ({"n_jumps": (1, 2, 3)}, "n_jumps must be a whole number or"),
    ],
)
def test_arguments_that_cannot_be_meant_are_refused(arguments, reason):
    with pytest.raises(ValueError, match=reason):
        gym.make(JUMP, **arguments)


def test_jumps_and_courses_are_drawn_as_asked():
    env = gym.make_vec(JUMP, num_envs=100, n_jumps=(0, 3), n_obstacles=2).unwrapped
    env.reset(seed=0)
    times, arm = env.scenes.jump_times, env.arm
    assert set(np.isfinite(times).sum(axis=-1)) == {0, 1, 2, 3}
    assert (np.diff(np.where(np.isfinite(times), times, 99.0 + np.arange(4)), axis=-1) > 0.0).all()
    assert (arm.reach_margin(env.scenes.jumps[np.isfinite(times)][:, 1:]) > 0.0).all()
    moving = gym.make_vec(MOVING, num_envs=200).unwrapped
    moving.reset(seed=0)
    scenes = moving.scenes
    speed = np.linalg.norm(scenes.courses[..., :2], axis=-1)[scenes.present]
    assert (speed > 0.0).mean() > 0.9
    assert 0.3 < scenes.turns[scenes.present].mean() < 0.7


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
    scenes, state = first.scenes.as_options(), first.episodes_state()
    generators = [generator.bit_generator.state for generator in first._generators]
    second.reset(options=scenes)
    second.restore_episodes(state)
    for generator, saved in zip(second._generators, generators, strict=True):
        generator.bit_generator.state = saved
    assert [len(plans) for plans in first.last_plans] == [len(plans) for plans in second.last_plans]
    for action in actions[5:]:
        (a, r, *_, info), (b, s, *_, same) = first.step(action), second.step(action)
        np.testing.assert_array_equal(r, s)
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])
        np.testing.assert_array_equal(info["jerk_cost"], same["jerk_cost"])
    np.testing.assert_array_equal(first.last_rollout[0].hand, second.last_rollout[0].hand)


def test_pictures_show_the_episode_so_far():
    pytest.importorskip("mujoco")
    from viapoint.envs.rendering import GLUnavailableError

    env, _ = make(jumps=[[0.2, *OTHER]], render_mode="rgb_array_list", width=64, height=64)
    try:
        before = env.render()
    except GLUnavailableError as error:
        pytest.skip(str(error))
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
    batch.perform(Plan(waypoints, np.array([[0.3, 0.4]])))
    (_, before), (time, after) = env.last_plans
    np.testing.assert_array_equal(after.waypoints, waypoints)
    np.testing.assert_allclose(before.states(np.array([time])).acceleration, after.acceleration, atol=1e-9)
    with pytest.raises(ValueError, match=r"waypoints of shape \(1, 3, 2\)"):
        batch.perform(Plan(waypoints[:, ::2], np.array([[0.7]])))


def test_any_jumps_and_courses_are_played_or_refused_with_a_reason():
    generator, found = np.random.default_rng(0), {True: 0, False: 0}
    env = gym.make(MOVING).unwrapped
    edges = [0.0, -0.0, 1e-300, 1e-9, 1e-3, 0.3, 2.4, 2.5, 1e9, -1.0]
    for seed in range(150):
        env.reset(seed=seed)
        options = {name: part[0] for name, part in env.batch.scenes.as_options().items()}
        number = int((options["obstacles"][:, -1] > 0.0).sum())
        options["obstacles"], courses = options["obstacles"][:number], options["courses"][:number]
        nasty = generator.random(courses.shape) < 0.05
        courses = np.where(nasty, generator.choice(edges, courses.shape), courses)
        jumps = np.column_stack(
            (np.sort(generator.choice(edges[2:8], 2)), options["goal"] + generator.uniform(-0.1, 0.1, (2, 2)))
        )
        reason = ""
        try:
            env.reset(options={**options, "jumps": jumps[: seed % 3], "courses": courses})
        except ValueError as error:
            reason = str(error)
        assert not reason or reason.startswith("scene 0: ")
        found[not reason] += 1
        for info in () if reason else play(env, actions=0.5, seed=seed):
            assert np.isfinite(list(info.values())).all()
    assert min(found.values()) > 20
