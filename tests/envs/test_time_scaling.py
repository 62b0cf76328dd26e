"""Laws of slowing down: limits hold between the looks, too, and no plan leaves the reach unseen."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms import ADULT
from viapoint.envs.arms.panda import PANDA
from viapoint.envs.common.arrays import take
from viapoint.envs.sim import replanning_executor
from viapoint.envs.sim.replan_triggers import Event
from viapoint.envs.sim.time_scaling import required_time_scale

REACH = "viapoint.envs:viapoint/PandaReach-v0"
SPACE = {"dimension": 3, "duration_range": (0.6, 1.2)}


def plans(layout, number, size, seed=0):
    rng = np.random.default_rng(seed)
    low, high = np.array(PANDA.workspace)
    start, goal = rng.uniform(low, high, (2, number, 3))
    action = rng.uniform(-size, size, (number, layout.size))
    splits = len([name for name in layout.names if name.startswith("split")])
    if splits:
        action[:, -splits:] = rng.choice([-1.0, 1.0], (number, splits))
    return layout.decode(action, start, goal)


def everywhere(plan, looks=1000):
    return plan.trajectory().sample(plan.durations.sum(axis=-1)[:, None] * np.linspace(0.0, 1.0, looks))


@pytest.mark.parametrize(
    ("n_via", "timing"), [(1, "optimal"), (3, "optimal"), (3, "learned"), (8, "optimal")]
)
def test_limits_hold_between_the_looks_and_no_movement_is_slower_than_that_takes(n_via, timing):
    plan = plans(ActionLayout(n_via=n_via, timing=timing, **SPACE), 300, 0.4)
    stretch, within = required_time_scale(PANDA, plan)
    some = np.flatnonzero(within)
    needed = PANDA.required_time_scale(*everywhere(plan.take(some)))
    assert (needed > 1.0).mean() > 0.1
    np.testing.assert_allclose(stretch[some], needed, rtol=5e-3)


def test_a_movement_that_is_too_fast_between_the_looks_alone_is_slowed_down():
    plan = plans(ActionLayout(**SPACE), 150, 0.4)
    plan = plan.take(np.flatnonzero(required_time_scale(PANDA, plan).within))
    faster = plan._replace(durations=plan.durations / 4.0)
    needed = PANDA.required_time_scale(*everywhere(faster)) / 1.002
    just_above = faster._replace(durations=faster.durations * needed[:, None])
    assert (required_time_scale(PANDA, just_above).stretch > 1.0).all()


def test_a_peak_between_two_looks_does_not_make_the_arm_sag():
    env = gym.make(REACH, n_via=3)
    env.reset(options={"start": [0.5796, 0.1228, 0.3675], "goal": [0.4689, -0.1916, 0.2983]})
    action = [-0.1935, 0.1962, 0.5793, 0.0299, 0.6263, -0.6440, 0.2107, 0.1768, 0.5553, 0.0]
    *_, info = env.step(np.array(action, np.float32))
    rollout = env.unwrapped.last_rollout
    assert info["stretch"] > 1.0
    assert np.linalg.norm(rollout.hand - rollout.planned, axis=-1).max() < 5e-3
    rates = np.abs(np.diff(rollout.joints, axis=0)) / 0.004
    assert (rates < np.array(PANDA.velocity_limit)).all()


def test_a_short_plan_that_leaves_the_reach_is_seen_and_the_others_are_slowed_down():
    env = gym.make_vec(REACH, num_envs=200, duration_range=(0.05, 0.06)).unwrapped
    env.reset(seed=5)
    actions = np.random.default_rng(5).uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
    info = env.execute_actions(actions).info
    ran = info["reachable"]
    assert 0.3 < ran.mean() < 1.0
    assert (info["stretch"][ran] > 1.0).all()
    assert (info["tracking_error"][ran] < 5e-3).all()
    for rollout, moved in zip(env.last_rollout, ran, strict=True):
        rates = np.abs(np.diff(rollout.joints, axis=0)) / 0.004
        assert not moved or (rates < np.array(PANDA.velocity_limit)).all()


def test_plans_that_are_revised_in_motion_keep_to_the_limits_too():
    env = gym.make_vec("viapoint.envs:viapoint/PandaMovingObstacles-v0", num_envs=64).unwrapped
    env.reset(seed=0)
    rng, paced, moving = np.random.default_rng(0), [], 0
    real = env._stages.scale_time
    env._stages.scale_time = lambda plan: paced.append(real(plan)) or paced[-1]
    for _ in range(5):
        env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
    for plan, (stretch, within) in paced:
        some = np.flatnonzero(within & (stretch > 1.0) & (plan.velocity != 0.0).any(axis=-1))
        moving += len(some)
        assert (required_time_scale(PANDA, take(plan, some)).stretch < 1.005).all()
    assert moving > 10


@pytest.mark.parametrize("duration", [0.05, 0.2, 1.0])
def test_of_an_arm_without_limits_only_short_plans_are_looked_at(duration):
    layout = ActionLayout(duration_range=(duration, 1.01 * duration))
    start = np.array([[-0.1, 0.3], [0.3, 0.5]])
    action = np.zeros((2, layout.size))
    action[1, :2] = 1.0, -1.0  # outwards, beyond the arm's length
    plan = layout.decode(action, start, start + np.array([0.0, 0.3]))
    stretch, within = required_time_scale(ADULT, plan)
    outside = (np.asarray(ADULT.reach_margin(everywhere(plan)[0])) < 0.0).any(axis=-1)
    assert outside.tolist() == [False, True]
    assert stretch.tolist() == [1.0, 1.0]
    assert within.tolist() == [True, duration > 0.25]


def test_plans_that_leave_the_reach_between_looks_end_episodes(monkeypatch):
    env = gym.make_vec("viapoint.envs:viapoint/PandaMovingObstacles-v0", num_envs=3).unwrapped
    env.reset(seed=0)
    within = np.array([True, False, True])
    monkeypatch.setattr(env._stages, "_reachable", lambda plan: np.ones(len(plan.durations), bool))
    monkeypatch.setattr(
        replanning_executor,
        "required_time_scale",
        lambda *arguments: required_time_scale(*arguments)._replace(within=within),
    )
    action = np.zeros(env.action_space.shape, np.float32)
    *_, info = env.step(action)
    assert (info["event"] == Event.REACH).tolist() == [False, True, False]
