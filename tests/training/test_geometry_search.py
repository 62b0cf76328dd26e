"""Laws of planned movements, of their computed checks, and of the search among them."""

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.registration import REPLANNING_TASKS
from viapoint.training.planning import geometry_search
from viapoint.training.planning.baselines import factory
from viapoint.training.planning.plan_checks import (
    MAX_REFINED,
    MIN_REFINED,
    NODES,
    check_plans,
    merit,
    pruned_merit,
)
from viapoint.training.planning.planned_movements import plan_movements
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.rollouts.rollout import new_simulation
from viapoint.training.scene_sets.scene_set import load

PLANE, WHOLE_ARM, PANDA = (
    f"viapoint/{name}-v0" for name in ("PlanarObstacles", "PlanarWholeArm", "PandaObstacles")
)
AMONG_OBSTACLES = (PLANE, WHOLE_ARM, PANDA)
SHARES = np.linspace(0.0, 1.0, 33)
MARGINS = (0.001, 0.001)
SHAPES = ("capsule", "box", "cylinder")


def made(env_id, number=16, **kwargs):
    env = gym.make_vec(env_id, num_envs=number, **kwargs).unwrapped
    observation, _ = env.reset(seed=1)
    return env, observation


def random_actions(task, *shape, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (*shape, task.action.size)).astype(np.float32)


def under_way(env_id, number=24, decisions=2):
    """Environments amid their episodes, what they see, and where actions change the plan."""
    env, observation = made(env_id, number)
    for each in range(decisions):
        observation, *_ = env.step(0.3 * random_actions(env.task, number, seed=each))
    default = env.default
    far = np.linalg.norm(default.goal - default.state.position, axis=-1) > MIN_GOAL_DISTANCE
    free = default.changed | ~default.begun | (default.remaining >= env.decoder.least_remaining)
    return env, observation, far & free


def decoded(env, actions):
    """The plans that the environments make of actions of shape (N, H, m)."""
    ends = (np.repeat(end[:, None], actions.shape[1], axis=1) for end in (env.scenes.start, env.scenes.goal))
    return env.task.action.decode(actions.astype(np.float64), *ends)


@pytest.mark.parametrize("timing", ["optimal", "learned"])
@pytest.mark.parametrize("n_via", [0, 1, 2, 3])
@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_planned_movements_are_those_of_the_environment(env_id, n_via, timing):
    env, observation = made(env_id, 6, n_via=n_via, timing=timing)
    actions = random_actions(env.task, 6, 20)
    actions[:, 0] = 0.0
    plan = decoded(env, actions)
    duration = plan.durations.sum(axis=-1)
    found = plan_movements(observation, actions, env.task, SHARES)
    trajectory = plan.trajectory()
    np.testing.assert_allclose(found.duration, duration, rtol=1e-6)
    np.testing.assert_allclose(found.path, trajectory(duration[..., None] * SHARES), atol=1e-6)
    line = np.linalg.norm(env.scenes.goal - env.scenes.start, axis=-1)[:, None]
    jerk = np.maximum(trajectory.cost() * duration**5 / (360.0 * line**2), 1.0)
    np.testing.assert_allclose(found.log_jerk, np.log(jerk), atol=1e-4)


@pytest.mark.parametrize("env_id", REPLANNING_TASKS)
@pytest.mark.parametrize("decisions", [0, 2])
def test_planned_movements_on_the_way_are_those_that_will_be_commanded(env_id, decisions):
    env, observation, some = under_way(env_id, decisions=decisions)
    actions = random_actions(env.task, len(some))
    plan, _ = env.decoder.revise(env.default, env._plan, actions.astype(np.float64))
    found = plan_movements(observation, actions[:, None], env.task, SHARES)
    commanded = plan.trajectory()(plan.duration[:, None] * SHARES)
    assert some.sum() > 4
    np.testing.assert_allclose(found.duration[some, 0], plan.duration[some], rtol=1e-5)
    np.testing.assert_allclose(found.path[some, 0], commanded[some], atol=2e-4)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "tolerance"),
    [
        (PLANE, {}, 5e-4),
        (WHOLE_ARM, {}, 5e-4),
        (PANDA, {"shapes": "capsule"}, 5e-4),
        *((env_id, {"shapes": SHAPES}, 1.5e-3) for env_id in AMONG_OBSTACLES),
    ],
)
def test_clearance_is_that_of_many_instants(env_id, kwargs, tolerance):
    number, tried = 24, 12
    env, observation = made(env_id, number, **kwargs)
    actions = random_actions(env.task, number, tried)
    plan = decoded(env, actions)
    time = plan.durations.sum(axis=-1)[..., None] * np.linspace(
        0.0, 1.0, 1200 if env.arm.dimension == 2 else 400
    )
    hand = plan.trajectory()(time).reshape(number * tried, -1, env.arm.dimension)
    scenes = env.scenes.take(np.repeat(np.arange(number), tried))
    exact = env.task.collision_model.least_clearance(hand, scenes.obstacles, scenes.present).reshape(
        number, tried
    )
    checks = check_plans(observation, actions, env.task)
    margin = np.asarray(env.arm.reach_margin(hand)).min(axis=-1).reshape(number, tried)
    near = np.abs(margin) < 0.03
    np.testing.assert_allclose(checks.reach_margin[near], margin[near], atol=1e-3)
    some = (exact > -0.05) & (exact < MAX_REFINED) & (margin > 0.0)
    error = np.abs(checks.clearance - exact)[some]
    assert some.sum() > 80
    assert np.quantile(error, 0.98) < tolerance
    assert error.max() < 2e-3
    assert (checks.clearance[exact < MIN_REFINED] < -0.04).all()


def test_clearance_of_obstacles_that_move_is_that_of_constant_velocities():
    env, observation, some = under_way("viapoint/PlanarMovingObstacles-v0", 32, 1)
    actions = random_actions(env.task, 32)
    plan, _ = env.decoder.revise(env.default, env._plan, actions.astype(np.float64))
    ahead, now = plan.duration[:, None] * np.linspace(0.0, 1.0, 800), env._episodes.time
    rows = env.scenes.places(now[:, None] + ahead, unturned=now)
    hand = plan.trajectory()(ahead)
    exact = env.task.collision_model.clearance_profile(hand, rows, env.scenes.present).min(axis=(1, 2))
    found = check_plans(observation, actions[:, None], env.task).clearance[:, 0]
    some &= (exact > -0.05) & (exact < MAX_REFINED)
    assert some.sum() > 8
    np.testing.assert_allclose(found[some], exact[some], atol=1e-3)


def test_clearance_after_a_time_does_not_matter():
    until, number = 0.3, 64
    env, observation = made("viapoint/PlanarMovingObstacles-v0", number)
    actions = random_actions(env.task, number)
    plan = decoded(env, actions[:, None])
    duration = plan.durations.sum(axis=-1)[:, 0]
    step = duration / (NODES - 1)
    every = check_plans(observation, actions[:, None], env.task).clearance[:, 0]
    found = check_plans(observation, actions[:, None], env.task, until=until).clearance[:, 0]
    least = []
    for last in (until - step, until + step):  # no time between two instants is asked for
        time = last[:, None] * np.linspace(0.0, 1.0, 200)
        hand = plan.trajectory()(time[:, None])[:, 0]
        rows = env.scenes.places(time, unturned=np.zeros(number))
        clearance = env.task.collision_model.clearance_profile(hand, rows, env.scenes.present)
        least.append(clearance.min(axis=(1, 2)))
    some = (found > -0.05) & (found < MAX_REFINED)
    assert (found >= every - 1e-4).all()
    assert (found > every + 1e-3).any()
    assert (found <= least[0] + 1e-3)[some].all()
    assert (found >= least[1] - 1e-3)[some].all()


@pytest.mark.parametrize(
    "kwargs", [{}, {"reward_weights": {"smoothness": 0.3, "duration": 0.2, "clearance": 1.0}}]
)
@pytest.mark.parametrize("env_id", AMONG_OBSTACLES)
def test_the_reward_is_that_of_executed_movements(env_id, kwargs):
    env, observation = made(env_id, 64, threads=1, **kwargs)
    task = env.task
    actions = GeometrySearch(task, 128).decide(observation)
    actions[::4] = random_actions(task, 16)  # some that touch or leave the reach
    checks = check_plans(observation, actions[:, None], task)
    _, reward, info = env.execute_actions(actions)
    as_planned = (info["stretch"] == 1.0) & (info["is_success"] | ~info["reachable"])
    assert info["is_success"].sum() > 20
    error = np.abs(checks.reward[:, 0] - reward)
    assert error[as_planned & info["reachable"]].max() < 0.03
    # Out of reach, the posture of an arm in space may change so fast that its clearance is wrong by a centimetre.
    assert error[as_planned & ~info["reachable"]].max(initial=0.0) < (
        0.03 if task.arm.dimension == 2 else 0.2
    )
    np.testing.assert_array_equal(checks.reach_margin[info["is_success"], 0] >= 0.0, True)


def test_the_best_plan_is_within_the_margins_or_else_comes_nearest():
    env, observation = made(PLANE)
    checks = check_plans(observation, random_actions(env.task, 16, 64), env.task)
    for margins in ((0.001, 0.001), (0.05, 0.001), (2.0, 0.0)):
        best, rows = merit(checks, *margins).argmax(axis=-1), np.arange(16)
        within = (checks.clearance > margins[0]) & (checks.reach_margin > margins[1])
        wanted = np.where(within, checks.reward, -np.inf)
        least = np.minimum(checks.clearance, checks.reach_margin)
        solved = within.any(axis=-1)
        np.testing.assert_array_equal(wanted[rows, best][solved], wanted.max(axis=-1)[solved])
        np.testing.assert_allclose(least[rows, best][~solved], least.max(axis=-1)[~solved], atol=1e-6)


@pytest.mark.parametrize(
    "env_id", [*AMONG_OBSTACLES, "viapoint/PlanarMovingObstacles-v0", "viapoint/PlanarReach-v0"]
)
def test_looking_at_the_most_promising_plans_first_finds_the_same(env_id):
    env, observation = made(env_id)
    actions = random_actions(env.task, 16, 200)
    checked = merit(check_plans(observation, actions, env.task), *MARGINS)
    merits = pruned_merit(observation, actions, env.task, MARGINS)
    known = np.isfinite(merits)
    solved = known.any(axis=-1)
    np.testing.assert_allclose(merits[known], checked[known], atol=1e-4)
    np.testing.assert_array_equal(solved, checked.max(axis=-1) > -1e3)
    np.testing.assert_array_equal(merits.argmax(axis=-1)[solved], checked.argmax(axis=-1)[solved])
    assert solved.any()
    clear = checked > -1e3
    assert (clear & ~known).sum() > 0.2 * clear.sum()  # most plans are not looked at


@pytest.mark.parametrize("env_id", AMONG_OBSTACLES)
def test_more_checks_never_give_a_worse_computed_reward(env_id):
    env, observation = made(env_id)
    before = np.full(16, -np.inf)
    for more in ({"n_checks": 1}, {"n_checks": 16}, {"n_checks": 64}, {"n_checks": 64, "refinements": 3}):
        actions = GeometrySearch(env.task, **more).decide(observation).astype(np.float32)
        merits = merit(check_plans(observation, actions[:, None], env.task), *MARGINS)[:, 0]
        assert (merits >= before - 2e-3).all()
        before = merits
    assert (before > -1e3).mean() > 0.5


@pytest.mark.parametrize("env_id", [*AMONG_OBSTACLES, "viapoint/PlanarMovingObstacles-v0"])
def test_a_decision_depends_on_its_scene_alone(env_id):
    env, observation = made(env_id, 40)
    search = GeometrySearch(env.task, 64, refinements=2, per_round=16)
    together = search.decide(observation)
    for row in (0, 17, 39):
        alone = {name: values[row] for name, values in observation.items()}
        action, state = search.predict(alone)
        assert state is None
        np.testing.assert_array_equal(action, together[row].astype(np.float32))
    batch, _ = search.predict(observation, deterministic=True)
    np.testing.assert_array_equal(batch, together.astype(np.float32))
    assert (np.abs(together) <= 1.0).all()


@pytest.mark.parametrize("env_id", [PLANE, PANDA])
def test_the_order_of_obstacles_does_not_matter(env_id):
    env, observation = made(env_id)
    actions = random_actions(env.task, 16, 20)
    rows = observation["obstacles"].reshape(16, env.task.scenes.n_obstacles[1], -1)
    mixed = {**observation, "obstacles": rows[:, ::-1].reshape(observation["obstacles"].shape)}
    for mine, theirs in zip(
        check_plans(observation, actions, env.task), check_plans(mixed, actions, env.task), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, atol=1e-6)


@pytest.mark.parametrize(
    ("env_id", "name", "number", "least"),
    [
        ("viapoint/PlanarReach-v0", "search16", 100, 1.0),
        (PLANE, "search512", 100, 0.97),
        (WHOLE_ARM, "search512", 100, 0.96),
        ("viapoint/PandaReach-v0", "search16", 100, 1.0),
        (PANDA, "search512", 100, 0.95),
        ("viapoint/PlanarTargetJump-v0", "search64", 30, 0.95),
        ("viapoint/PlanarMovingObstacles-v0", "search512", 40, 0.95),
        ("viapoint/PandaMovingObstacles-v0", "search64", 16, 0.8),
    ],
)
def test_the_search_succeeds(env_id, name, number, least):
    every = load("validation", env_id).scenes
    scenes = every.take(np.linspace(0, len(every.start) - 1, number).astype(int))
    simulation = new_simulation(env_id, number, threads=1)
    method = factory(name, env_id)(simulation)
    done = simulation.play(method, scenes, method.decide(simulation.observe(scenes), scenes))
    assert done.success.mean() >= least
    simulation.close()


@pytest.mark.parametrize("timing", ["optimal", "learned"])
@pytest.mark.parametrize("n_via", [0, 2, 3])
def test_any_number_of_via_points_is_searched(n_via, timing):
    env, observation = made(PLANE, 8, n_via=n_via, timing=timing)
    search = GeometrySearch(env.task, 64, refinements=1, per_round=16)
    actions = search.decide(observation).astype(np.float32)
    merits = merit(check_plans(observation, actions[:, None], env.task), *MARGINS)[:, 0]
    straight = np.zeros_like(actions[:, None])
    assert (merits >= merit(check_plans(observation, straight, env.task), *MARGINS)[:, 0] - 1e-4).all()


@pytest.mark.parametrize(("duration", "component"), [(0.1, 1.0), (0.5, 0.0), (2.0, -1.0)])
def test_movements_take_the_time_of_the_greatest_reward(duration, component):
    env, observation = made("viapoint/PlanarReach-v0", 4, reward_weights={"duration": duration})
    actions = GeometrySearch(env.task, 16).decide(observation)
    np.testing.assert_allclose(actions[:, 2], component, atol=1e-6)
    assert (GeometrySearch(env.task, 1).decide(observation) == 0.0).all()


def test_exactly_the_stated_number_of_plans_is_checked(monkeypatch):
    env, observation = made(PLANE, 4)
    counted = []

    def counting(observation, actions, *args, **kwargs):
        counted.append(actions.shape[1])
        return pruned_merit(observation, actions, *args, **kwargs)

    monkeypatch.setattr(geometry_search, "pruned_merit", counting)
    search = GeometrySearch(env.task, 50, refinements=3, per_round=10)
    search.decide(observation)
    assert sum(counted) == search.total_checks == 80
    assert search.name == "search, 80 checks"


def test_a_plan_that_stays_clear_is_kept():
    env, observation, some = under_way("viapoint/PlanarMovingObstacles-v0", 64, 1)
    actions = GeometrySearch(env.task, 64).decide(observation)
    zero = check_plans(observation, np.zeros((64, 1, env.task.action.size), np.float32), env.task)
    in_time = observation["time_left"][:, 0] > 1.0
    clear = some & in_time & (zero.clearance[:, 0] > 0.003) & (zero.reach_margin[:, 0] > 0.003)
    blocked = some & (zero.clearance[:, 0] < -0.003)
    assert clear.sum() > 5
    assert (actions[clear] == 0.0).all()
    assert (actions[blocked] != 0.0).any(axis=-1).all()


def test_a_plan_may_have_no_obstacles_or_more_than_the_task():
    search = GeometrySearch("viapoint/PlanarReach-v0", 32)
    for nothing in (None, [], np.zeros((0, 5))):
        plan = search.plan((-0.2, 0.3), (0.1, 0.4), nothing)
        np.testing.assert_allclose(plan.waypoints[1], np.mean([(-0.2, 0.3), (0.1, 0.4)], axis=0))
    many = [(-0.05, 0.35, 0.0, 0.0, 0.03)] + [(0.5, 0.1 * i, 0.0, 0.0, 0.01) for i in range(9)]
    assert abs(search.plan((-0.2, 0.3), (0.1, 0.4), many).waypoints[1] - (-0.05, 0.35)).max() > 0.03
