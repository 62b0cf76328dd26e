"""When a decision ends, and an episode."""

import numpy as np
import pytest
from revised import DT, GOAL, MOVING, OTHER, events, make, play

from viapoint.envs.sim.outcome import SETTLING
from viapoint.envs.sim.replan_triggers import FORESIGHT, LOOK, SAMPLED, Event


def test_decisions_end_when_their_horizon_has_passed():
    env, _ = make(decide_at=("horizon",), horizon=0.1)
    infos = play(env)
    assert [info["elapsed"] for info in infos[:-1]] == pytest.approx([0.1] * (len(infos) - 1))
    assert events(infos) == [Event.HORIZON] * (len(infos) - 1) + [Event.ARRIVAL]
    centre = env.action_layout.centre_duration
    assert infos[-1]["time"] == pytest.approx(np.ceil((centre + SETTLING) / DT) * DT)
    assert sum(info["elapsed"] for info in infos) == pytest.approx(infos[-1]["time"])


def test_a_horizon_beyond_the_episode_ends_nothing():
    env, _ = make(decide_at=("horizon",), horizon=1e300)
    assert events(play(env)) == [Event.ARRIVAL]


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
    least, (low, high) = env.decoder.least_remaining, env.action_layout.duration_range
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
