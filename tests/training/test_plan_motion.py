"""Laws of planning around known obstacles, also with the library OMPL."""

import dataclasses
import functools
import itertools
import json
import re
import sys

import gymnasium as gym
import numpy as np
import pytest
from helpers import PANDA as PANDA_TASK
from helpers import PLANE, UR5E, WHOLE, scenes_of

import viapoint.envs as ve
from viapoint.envs.arms.kinematics import link_poses, torques
from viapoint.envs.geometry.clearance import memory, row_clearances
from viapoint.envs.geometry.obstacles import pack, unpack
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.spaces import space_of
from viapoint.training import UnsafePlanError, plan_motion, plan_motions, read_motion, write_motion
from viapoint.training.cli.entry import main
from viapoint.training.evaluation import evaluate_methods
from viapoint.training.planning import benchmark, movements, ompl_paths, refine
from viapoint.training.planning import plan_motion as module
from viapoint.training.planning.baselines import make_method
from viapoint.training.planning.benchmark import DATA, benchmark_panda, benchmark_problems, read_problems
from viapoint.training.planning.motion_plan import execute_plans
from viapoint.training.planning.rrt_connect import _shift, clear_path, points_on
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import BANDS, load, scenes_for, shipped_path

PANDA = ve.arm_of("panda")
GOAL = PANDA.home + np.array([0.8, 0.5, 0.0, 0.6, 0.0, 0.3, 0.0])
POST = ve.Box((0.05, 0.05, 0.4), position=(0.5, 0.15, 0.4))
"""Obstacle in the way from home to GOAL."""
BAR = ve.Box((0.01, 0.05, 0.04), position=(-0.05, 0.35, 0.0))
"""Obstacle in the way of the hand of the arm in the plane."""
WALL = [ve.Box((0.02, 2.0, 2.0), position=(0.45, 0.2, 0.0), quaternion=(0.924, 0.0, 0.0, 0.383))]
"""Obstacle that nothing leads around; the goal is inside it."""


def drawn(n: int, **kwargs):
    """Problems of drawn scenes: task, starts, goals and obstacles."""
    task = ve.Task.of(**kwargs)
    scenes = scenes_of(task, n, 3)
    ends = task.space.coordinates(scenes.start), task.space.coordinates(scenes.goal)
    return task, *ends, [scenes.obstacles.take([i]) for i in range(n)]


@pytest.mark.parametrize(
    "kwargs", [{"arm": "panda"}, {"arm": "planar"}, {"arm": "planar", "space": "joints"}], ids=str
)
def test_successful_plans_succeed_in_physics(kwargs) -> None:
    task, starts, goals, obstacles = drawn(40, **kwargs)
    plans = plan_motions(task.arm, starts, goals, obstacles, space=task.space_name)
    good = [plan for plan in plans if plan.success and len(plan.durations) == 3]
    assert len(good) >= 30
    outcome, _ = execute_plans(good)
    assert outcome.is_success.all()
    assert (outcome.stretch < 1.001).all()
    assert np.abs(outcome.planned_clearance - [plan.clearance for plan in good]).max() < 2e-3


def test_straight_movements_use_their_limits_and_keep_them() -> None:
    # Also at the very end, where the torque of a quick movement changes most.
    arm, rng = ve.load_arm(UR5E), np.random.default_rng(0)
    for _ in range(60):
        start, goal = rng.uniform(-2.0, 2.0, (2, 6))
        plan = plan_motion(arm, start, goal, time_limit=0.0)
        assert (plan.source, len(plan.durations)) == ("straight", 1)
        assert plan.jerk == pytest.approx(1.0)
        motion = plan.joints(2000, force=True)
        assert np.allclose(motion.position[[0, -1]], [start, goal])
        assert np.allclose(motion.velocity[[0, -1]], 0.0, atol=1e-9)
        rates = np.gradient(motion.position, motion.time, axis=0)
        assert np.allclose(rates[5:-5], motion.velocity[5:-5], atol=1e-3)
        velocity = (np.abs(motion.velocity) / arm.velocity_limit).max()
        torque = (np.abs(motion.torque) / arm.torque_limit).max()
        assert np.allclose(plan.limits, (velocity, torque), atol=3e-3)
        assert 0.9 < max(velocity, torque) <= 1.0


@pytest.mark.parametrize(
    ("obstacles", "arguments"),
    [(WALL, {"time_limit": 0.0}), (WALL, {"seeds": 4}), ([POST], {"time_limit": 0.0})],
    ids=["end in contact, no time", "end in contact", "free ends, no time"],
)
def test_plans_never_lie(obstacles, arguments) -> None:
    plan = plan_motion(PANDA, PANDA.home, GOAL, obstacles, **arguments)
    assert not plan.success
    assert plan.clearance < 0.0
    assert "clearance" in plan.reason
    for use in (plan.joints, plan.execute):
        with pytest.raises(UnsafePlanError, match="force=True"):
            use()
    assert plan.joints(force=True).time[-1] == plan.duration
    assert plan.execute(force=True).collision.all()


WEAK = dataclasses.replace(PANDA, torque_limit=0.1 * PANDA.torque_limit)
SIDES = [(0.08, 0.01, 0.2, 0.22), (0.08, 0.01, 0.2, 0.38), (0.01, 0.08, 0.12, 0.3), (0.01, 0.08, 0.28, 0.3)]
ENCLOSED = {
    "arm": "planar",
    "start": (-0.2, 0.3),
    "goal": (0.2, 0.3),
    "obstacles": [ve.Box((a, b, 0.04), position=(x, y, 0.0)) for a, b, x, y in SIDES],
    "ompl": False,
    "time_limit": 2.0,
}
REASONS = [
    ({**ENCLOSED, "seeds": 0}, "from 1 seed"),
    ({**ENCLOSED, "seeds": 1}, "from 2 seeds"),
    ({"obstacles": [POST, ve.Sphere(0.1, position=PANDA.hand(GOAL))]}, "goal is in contact with obstacle 1"),
    (
        {"margin": 0.1, "obstacles": [POST, ve.Sphere(0.1, position=PANDA.hand(PANDA.home), name="ball")]},
        "obstacle 1 'ball'",
    ),
    ({"goal": GOAL + 9.0 * np.eye(7)[2]}, "joint 'joint3' must be from -2.8973 to 2.8973"),
    ({"arm": "planar", "start": (0.0, 0.3), "goal": (0.0, 0.9)}, "out of reach"),
    ({"obstacles": [POST], "duration": 0.3}, "limit"),
    ({"obstacles": [POST], "time_limit": 0.0}, "no time for another one"),
    ({"arm": WEAK, "time_limit": 0.0}, "weight of the arm"),
    ({"goal": [0.0, -1.7, 0.0, -3.0, 0.0, 0.0, 0.8]}, "touches itself at the goal (link5 and gripper)"),
    ({"velocity": 300.0 * np.eye(7)[0]}, "velocity limit of joint 'joint1'"),
    ({"acceleration": 300.0 * np.eye(7)[0]}, "torque limit of joint 'joint1'"),
]


@pytest.mark.parametrize(("arguments", "reason"), REASONS)
def test_the_reason_of_a_plan_without_success_is_told(arguments, reason) -> None:
    plan = plan_motion(**{"arm": PANDA, "start": PANDA.home, "goal": GOAL, **arguments})
    assert not plan.success
    assert reason in plan.reason


def test_the_shortest_duration_of_a_pose_is_that_of_its_best_configuration() -> None:
    given = PANDA, PANDA.home, ve.Pose((0.5, 0.3, 0.4))
    best = plan_motion(*given).duration
    told = re.search(r"takes ([0-9.]+) s or more", plan_motion(*given, duration=0.5 * best).reason)
    assert float(told[1]) <= best + 0.01


def test_a_duration_is_kept_and_a_margin_from_obstacles_but_not_from_the_arm_itself() -> None:
    """At home the arm has 36 mm from itself. A seed, random ones and a path keep the margin from a post alone."""
    for arguments in ({}, {"seeds": np.zeros((1, 2, 7)), "enough": 3}, {"seeds": 0, "n_via": 1}):
        plan = plan_motion(PANDA, PANDA.home, GOAL, [POST], margin=0.045, duration=4.0, **arguments)
        assert (plan.success, plan.duration) == (True, pytest.approx(4.0))
        joints = plan.trajectory()(np.linspace(0.0, plan.duration, 500))
        apart, own = row_clearances(PANDA.chain, PANDA.spheres, joints, pack([[POST]] * 500), 1.0)
        assert apart.min() >= 0.045 > own.min() > 0.0
        assert plan.clearance == pytest.approx(own.min(), abs=1e-3)


@pytest.mark.parametrize("name", ["panda", "planar"])
def test_movements_that_begin_in_motion_are_executed_as_planned(name: str) -> None:
    ends, bar = ((PANDA.home, GOAL), POST) if name == "panda" else (((-0.2, 0.3), (0.1, 0.4)), BAR)
    rng = np.random.default_rng(0)
    for _ in range(6):
        velocity, acceleration = rng.uniform(-0.3, 0.3, (2, len(ends[0])))
        given = {"velocity": velocity, "acceleration": acceleration, "ompl": False}
        plan = plan_motion(name, *ends, [bar], **given)
        done = plan.execute()
        assert plan.success
        assert plan.source != "given"
        assert np.allclose(plan.trajectory().sample([0.0], (1, 2)), [[velocity], [acceleration]])
        assert done.is_success[0]
        assert done.stretch[0] == 1.0
        assert done.tracking_error[0] < 1e-4
        assert done.planned_clearance[0] == pytest.approx(plan.clearance, abs=1e-3)
        blocked = plan_motion(name, *ends, [bar], **given, time_limit=0.0)
        assert blocked.success or blocked.execute(force=True).collision[0]


def test_movements_in_motion_use_all_of_their_limits_and_nothing_more() -> None:
    # From rest, limits are kept by slowing down; in motion, that would be another movement.
    fast = 0.99 * PANDA.velocity_limit[0] * np.eye(7)[0]
    goal = PANDA.home + 1.2 * np.eye(7)[0]
    for share in (1.0, 1.05):
        plan = plan_motion(PANDA, PANDA.home, goal, velocity=share * fast, duration=1.0)
        done = plan.execute(force=True)
        assert plan.success == done.is_success[0] == (share == 1.0)
        assert done.duration[0] == pytest.approx(plan.duration)


def test_the_shortest_duration_that_is_allowed_keeps_the_limits_between_all_instants() -> None:
    rng = np.random.default_rng(0)
    for goal in PANDA.home + rng.uniform(-0.6, 0.6, (20, 7)):
        usual = plan_motion(PANDA, PANDA.home, goal)
        plan = plan_motion(PANDA, PANDA.home, goal, duration=usual.duration * max(usual.limits))
        motion = plan.joints(5e4, force=True)
        if plan.success:
            assert (np.abs(motion.velocity) <= PANDA.velocity_limit).all()
            assert (np.abs(motion.torque) <= PANDA.torque_limit).all()


def test_a_plan_that_leaves_the_joint_limits_has_no_success() -> None:
    beyond = np.stack((PANDA.home, PANDA.joint_range[:, 1] + 0.1, GOAL))
    plan = ve.Plan.at_rest(beyond, np.array([2.0, 2.0]))
    known = module.checked_motion(PANDA, "joints", plan, pack([[]]), "given")
    assert (known.success, known.clearance) == (False, movements.OUTSIDE)


def objective(setting, table, row, start, offsets, scene, aim, gradient):
    """Compute the objective of the refinement, and its gradient by as many coordinates as there is room for."""
    work = refine._work(setting, len(offsets), len(start), scene)
    movement = movements.Movement(table, row, np.ascontiguousarray(start), offsets, 1.0)
    hessian = np.empty((len(gradient), len(gradient)))
    return refine._assemble(movement, aim, 360.0, np.inf, hessian, gradient, work)[0]


def test_nothing_is_refined_further_after_the_time_limit() -> None:
    still, tables = np.zeros(7), (movements.movement_table(2), movements.fine_table(2))
    ends = PANDA.home, still, still, GOAL
    problem = module._Problem(PANDA, space_of(PANDA, "joints"), *ends, pack([[POST]]))
    seeds = np.tile(np.linspace(0.0, GOAL - PANDA.home, 4)[1:-1], (4, 1, 1))
    given = problem, problem.setting(), 0.001, tables, seeds, 2.0
    tried, found = module._refined(*given, np.inf, enough=4)
    few, first = module._refined(*given, 0.0, enough=4)
    assert (tried, few) == (4, 1)
    assert found.cost[0] < first.cost[0] < np.inf  # it is free, and not polished


def test_parts_of_the_arm_that_nothing_comes_near_change_no_plan(monkeypatch) -> None:
    task, starts, goals, obstacles = drawn(8, arm="planar")
    # A bar at the height of the links, which pass above the others
    high = ve.Box((0.03, 0.03, 0.02), position=(0.0, 0.15, 0.15))
    scenes = [pack([[*unpack(each, 0), high]]) for each in obstacles[:4]] + obstacles[4:]
    planned = functools.partial(plan_motions, task.arm, starts, goals, scenes, time_limit=30.0, ompl=False)
    plans = planned()
    whole = module._Problem.setting
    monkeypatch.setattr(module._Problem, "setting", lambda problem, near=0.0: whole(problem))
    for plan, other in zip(plans, planned(), strict=True):
        assert np.allclose(plan.waypoints, other.waypoints, atol=1e-4)
        assert plan.clearance == pytest.approx(other.clearance, abs=1e-5)


def test_of_several_goals_the_cheapest_is_taken() -> None:
    far = GOAL + 1.5 * np.eye(7)[4]
    several = plan_motion(PANDA, PANDA.home, [far, GOAL], [POST])
    assert np.array_equal(several.waypoints[-1], GOAL)


def test_goals_of_continuous_joints_are_taken_modulo_a_turn() -> None:
    text = UR5E.read_text().replace(' range="-6.2832 6.2832"', ' limited="false"')
    arm = ve.load_arm(text, velocity_limit=3.0)
    assert arm.continuous == arm.joint_names
    goal = arm.home + 0.5
    plan = plan_motion(arm, arm.home, goal + 2.0 * np.pi * np.array([1, -1, 0, 2, 0, 0]))
    assert np.allclose(plan.waypoints[-1], goal)
    turned = arm.home + 2.0 * np.pi * np.array([1, 0, 0, -1, 0, 0])  # as encoders may read it
    assert np.array_equal(plan_motion(arm, turned, goal).waypoints.round(9), plan.waypoints.round(9))
    wide = ve.load_arm(text, velocity_limit=3.0, home=arm.home, joint_range=[(-6.0, 6.0)] * 6)
    assert wide.continuous == arm.joint_names
    start = arm.home + 3.0 * np.eye(6)[0]
    here = arm.home + 5.0 * np.eye(6)[0]  # within its range, where the arm is
    assert np.array_equal(plan_motion(wide, here, here - 0.1).waypoints[0], here)
    for each, way in ((wide, 2.0 * np.pi - 6.0), (arm, -6.0)):
        end = plan_motion(each, start, start - 6.0 * np.eye(6)[0], time_limit=0.0).waypoints[-1]
        assert np.allclose(end - start, way * np.eye(6)[0])
        env = gym.make("viapoint/Reach-v0", arm=each, decide_at=("target",)).unwrapped  # as in environments
        goal = start - 6.0 * np.eye(6)[0]
        env.reset(options={"start": start + 2.0 * np.pi * np.eye(6)[0], "goal": goal})
        assert np.allclose(env.scenes.goal[0], end)
        env.reset(options={"start": start, "goal": start + 0.1, "jumps": [[0.1, *goal]]})
        assert np.allclose(env.scenes.jumps[0, 0, 1:], end)
        env.batch.move_goals([goal])
        assert np.allclose(env.scenes.goal[0], end)


def test_a_start_that_is_the_goal_is_a_plan() -> None:
    for arm, place in ((PANDA, PANDA.home), (ve.arm_of("planar"), (0.0, 0.4))):
        plan = plan_motion(arm, place, place)
        assert (plan.success, plan.jerk, *plan.execute().jerk_ratio) == (True, 1.0, 1.0)
        assert plan.duration > 0.0
        assert np.isfinite(plan.joints(100).torque).all()


def test_short_movements_succeed_in_physics() -> None:
    rng = np.random.default_rng(5)
    low, high = PANDA.joint_range.T
    starts = rng.uniform(low + 0.2, high - 0.2, (150, 7))
    goals = starts + rng.uniform(0.003, 0.03, (150, 1)) * rng.normal(size=(150, 7))
    plans = plan_motions(PANDA, starts, goals, [[]] * 150, time_limit=0.0)
    good = [plan for plan in plans if plan.success]
    outcome, _ = execute_plans(good)
    assert len(good) > 100
    assert outcome.is_success.all()


def test_results_depend_on_neither_threads_nor_the_form_of_obstacles_and_of_no_seeds() -> None:
    task, starts, goals, obstacles = drawn(6, arm="panda")
    several = np.random.default_rng(5).spawn(6)  # problems of a batch share no generator
    for threads, rng, own in ((1, 5, [5] * 6), (3, np.random.default_rng(5), several)):
        together = plan_motions(task.arm, starts, goals, obstacles, threads=threads, rng=rng)
        for i in range(6):
            alone = plan_motion(task.arm, starts[i], goals[i], obstacles[i], rng=own[i])
            assert np.array_equal(alone.waypoints, together[i].waypoints)
            assert np.array_equal(alone.durations, together[i].durations)
    first = plan_motion(PANDA, PANDA.home, GOAL, [POST])
    for form, seeds in (([POST.to_dict()], []), (pack([[POST]]), np.zeros((0, 2, 7)))):
        other = plan_motion(PANDA, PANDA.home, GOAL, form, seeds=seeds)
        assert np.array_equal(first.waypoints, other.waypoints)


def test_within_bounds_no_allowed_direction_is_better() -> None:
    """Where refinement ends, the gradient vanishes, or points out of the bounds (Karush-Kuhn-Tucker)."""
    table, scene = movements.movement_table(2), pack([[]])
    setting = movements.arm_setting(PANDA, False, scene)
    aim = refine.Aim(clearance=0.0, jerk=1.0, gain=0.0)
    generator = np.random.default_rng(0)
    line = GOAL - PANDA.home
    gradient = np.empty(14)
    for _ in range(20):
        offsets = np.concatenate((generator.uniform(-0.5, 0.5, (2, 7)), [line], np.zeros((2, 7))))
        low = offsets[:2] - generator.uniform(0.0, 0.3, (2, 7))
        high = offsets[:2] + generator.uniform(0.0, 0.3, (2, 7))
        movement = movements.Movement(table, 0, PANDA.home, offsets, 1.0)
        work = refine._work(setting, 5, 7, scene)
        row = refine._refine(movement, np.stack((low, high)), aim, 360.0, work)
        assert ((offsets[:2] >= low) & (offsets[:2] <= high)).all()
        objective(setting, table, row, PANDA.home, offsets, scene, aim, gradient)
        wanted = np.where(gradient.reshape(2, 7) > 0.0, low, high)
        free = offsets[:2] != wanted
        assert 0 < free.sum() < 14
        assert np.abs(gradient.reshape(2, 7)[free]).max() < 1e-3 * np.abs(gradient).max()


@pytest.mark.parametrize("kwargs", [{"arm": "panda"}, {"arm": "planar", "whole_arm": True}], ids=str)
def test_gradient_of_the_objective(kwargs) -> None:
    task, starts, goals, obstacles = drawn(5, **kwargs)
    aim = refine.SEED._replace(clearance=0.2)  # many residuals
    setting = movements.arm_setting(task.arm, task.space.of_hand, pack([[]]))
    table = movements.movement_table(2)
    dimension = task.space.dimension
    generator = np.random.default_rng(0)
    gradient, measured = np.empty((2, 2 * dimension))
    for start, goal, scene in zip(starts, goals, obstacles, strict=True):
        line = goal - start
        offsets = np.concatenate(([line / 3, 2 * line / 3, line], np.zeros((2, dimension))))
        offsets[:2] += generator.uniform(-0.02, 0.02, (2, dimension))
        for i in range(2 * dimension):
            change = np.zeros_like(offsets)
            change[i // dimension, i % dimension] = 1e-6
            more = objective(setting, table, 80, start, offsets + change, scene, aim, gradient)
            less = objective(setting, table, 80, start, offsets - change, scene, aim, gradient)
            measured[i] = (more - less) / 2e-6
        objective(setting, table, 80, start, offsets, scene, aim, gradient)
        computed = 2.0 * gradient
        # The nearest sphere changes here and there, where the objective has a kink.
        assert np.abs(computed - measured).max() < 0.03 * np.abs(measured).max()


REFUSED = [
    ({"goal": ve.Pose((2.0, 0.0, 0.5))}, "cannot be reached"),
    ({"start": PANDA.home[:6]}, r"shape \(7,\)"),
    ({"goal": {"place": (0.5, 0.2, 0.4)}}, "position"),
    ({"obstacles": 5}, "obstacles must be"),
]


def test_a_batch_goes_on_after_problems_that_are_refused(tmp_path) -> None:
    faults = [*REFUSED, ({"goal": GOAL + 9.0 * np.eye(7)[2]}, "outside the limits")]
    problems = [changes for changes, _ in faults] + [{}]
    given = [{"start": PANDA.home, "goal": GOAL, "obstacles": [], **changes} for changes in problems]
    parts = ([each[name] for each in given] for name in ("start", "goal", "obstacles"))
    plans = plan_motions(PANDA, *parts)
    assert [plan.success for plan in plans] == [False] * (len(plans) - 1) + [True]
    for number, (_, reason) in enumerate(faults):
        assert re.match(f"problem {number}: .*{reason}", plans[number].reason)
        assert (plans[number].source == "refused") == (number < len(REFUSED))
    refused = plans[0]
    assert "cannot be reached" in repr(refused)
    uses = (
        lambda: refused.joints(force=True),
        lambda: refused.execute(force=True),
        lambda: write_motion(refused, tmp_path / "plan.csv", force=True),
        lambda: execute_plans(plans),
        refused.trajectory,
    )
    for use in uses:
        with pytest.raises(UnsafePlanError, match="no movement"):
            use()
    assert plan_motion(PANDA, PANDA.home, [ve.Pose((2.0, 0.0, 0.5)), ve.Pose((0.5, 0.2, 0.4))]).success


def test_numbers_of_other_types_compile_nothing_anew() -> None:
    wall = ve.Box((0.1, 0.1, 0.3), position=(0.5, 0.15, 0.3))
    expected = plan_motion(PANDA, PANDA.home, GOAL, [wall], duration=2.0, margin=0.0)
    known = len(module.refine_seeds.signatures)
    plan = plan_motion(PANDA, PANDA.home, GOAL, [wall], duration=np.uint8(2), margin=np.float32(0.0))
    assert len(module.refine_seeds.signatures) == known
    assert np.array_equal(plan.waypoints, expected.waypoints)


def test_a_pose_is_reached_by_any_of_its_free_configurations() -> None:
    """The nearest ten of 55 touch the boards."""
    place = np.array([0.54, 0.33, 0.42])
    boards = [ve.Box((0.15, 0.15, 0.02), position=place + np.array([0.0, 0.0, 0.155]))]
    boards.append(ve.Box((0.02, 0.15, 0.1), position=place + np.array([0.12, 0.0, 0.0])))
    plan = plan_motion(PANDA, PANDA.home, ve.Pose(place), boards)
    assert plan.success
    assert np.allclose(PANDA.hand(plan.waypoints[-1]), place, atol=1e-4)


@pytest.mark.parametrize("end", [np.pi, -np.pi])
def test_joint_limits_themselves_are_allowed(end) -> None:
    """Also in single precision, which rounds beyond them."""
    arm = dataclasses.replace(PANDA, joint_range=PANDA.joint_range.copy())
    arm.joint_range[6] = -np.pi, np.pi
    start = arm.home.copy()
    start[6] = np.float32(end)
    assert plan_motion(arm, start, arm.home).success


THIN = """<mujoco><compiler angle="radian"/><worldbody><body name="upper" pos="0 0 0.3">
  <joint name="first" axis="0 0 1" range="-3 3" actuatorfrcrange="-500 500"/>
  <geom type="capsule" fromto="0.05 0 0 0.7 0 0" size="0.006" mass="0.3"/><body name="fore" pos="0.75 0 0">
  <joint name="second" axis="0 0 1" range="-2.5 2.5" actuatorfrcrange="-500 500"/>
  <geom type="capsule" fromto="0 0 0 0.7 0 0" size="0.006" mass="0.3"/><site name="tcp" pos="0.7 0 0"/>
</body></body></worldbody></mujoco>"""


def test_nothing_thin_is_passed_through_between_two_instants() -> None:
    arm = ve.load_arm(THIN, velocity_limit=6.0, name="thin")
    for angle in np.linspace(-1.5, 1.5, 9):
        for distance in (0.5, 1.0, 1.4):
            place = distance * np.cos(angle), distance * np.sin(angle), 0.3
            post = ve.Cylinder(0.001, 0.2, position=place)
            plan = plan_motion(arm, [-2.9, 0.0], [2.9, 0.0], [post], time_limit=0.0)
            assert not plan.success
            assert plan.clearance < -0.001


POINTS, PLACE, LOW = np.random.default_rng(0).normal(0.0, 0.04, (30, 3)), (0.5, 0.15, 0.4), (-0.05, 0.37, 0.0)
SURFACE = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))
SURFACE[np.arange(200), np.arange(200) % 3] = 1.0
TO_THE_GOAL = np.array((-0.18, 0.24, 0.0))
CROSSING = []
for seconds in (1.0, 1.25, 1.5, 1.75):
    CROSSING.append(ve.Sphere(0.05, position=(0.1, 0.4, 0.0) - seconds * TO_THE_GOAL, velocity=TO_THE_GOAL))


@pytest.mark.parametrize(
    ("arm", "obstacle"),
    [
        ("panda", ve.ConvexMesh.hull(POINTS, position=PLACE)),
        ("panda", ve.PointCloud(SURFACE * POST.size, 0.02, position=POST.position)),
        # It starts out of the way, and crosses the straight movement; where it will be later is free now.
        ("panda", ve.Sphere(0.1, position=(0.75, 0.15, 0.5), velocity=(-0.3, 0.0, 0.0))),
        ("planar", ve.Sphere(0.02, position=LOW)),
        ("planar", ve.Capsule(0.02, 0.05, position=LOW)),
        ("planar", ve.PointCloud([LOW], 0.02)),
        # The movement waits or hurries where it crosses the goal after so many seconds.
        *(("planar", each) for each in CROSSING),
    ],
)
def test_plans_succeed_among_all_shapes_at_rest_and_moving(arm, obstacle) -> None:
    ends = (PANDA.home, GOAL) if arm == "panda" else ((-0.2, 0.3), (0.1, 0.4))
    plan = plan_motion(arm, *ends, [obstacle])
    assert plan.success
    assert plan.execute().is_success.all()


@pytest.mark.parametrize("speed", [0.3, 0.5, 0.7])
def test_no_obstacle_comes_while_the_arm_settles(speed) -> None:
    start, goal = (-0.2, 0.3), (0.1, 0.4)
    end = plan_motion("planar", start, goal).duration
    for late in (0.02, 0.05, 0.08):  # when it would be at the goal after the straight movement, [s]
        place = (0.1 + 0.05 + speed * (end + late), 0.4, 0.0)
        post = ve.Cylinder(0.025, 0.04, position=place, velocity=(-speed, 0.0, 0.0))
        plan = plan_motion("planar", start, goal, [post])
        assert not plan.success or plan.execute().is_success.all()


def test_the_benchmark_is_that_of_the_literature() -> None:
    arm, problems = benchmark_panda(), benchmark_problems()
    assert (len(problems), len(arm.spheres.radius)) == (700, 59)
    faults = []
    for each in problems:
        plan = plan_motion(arm, each.start, each.goal, each.obstacles, time_limit=0.0)
        if plan.reason.startswith(("the start", "the goal", "the arm")):
            faults.append(each.name)
    assert faults == ["table_pick 41"]
    search = benchmark.benchmark_planner("search13")(arm, problems[0])
    assert search.source == "search13"  # as many plans as the name says


def test_first_problems_of_the_benchmark() -> None:
    arm = benchmark_panda()
    problems = [problem for problem in benchmark_problems() if problem.number <= 3]
    plans = [plan_motion(arm, problem.start, problem.goal, problem.obstacles) for problem in problems]
    assert all(plan.success for plan in plans)
    outcome, _ = execute_plans([plan for plan in plans if len(plan.durations) == 3])
    assert outcome.is_success.all()


def test_the_smoothest_of_enough_free_movements_is_taken() -> None:
    one, best = (plan_motion(PANDA, PANDA.home, GOAL, [POST], enough=enough) for enough in (1, 30))
    assert best.seeds > one.seeds
    assert best.jerk <= one.jerk


@pytest.mark.parametrize("file", ["plan.csv", "plan.yaml"])
def test_files_hold_the_movement(tmp_path, file) -> None:
    written = write_motion(plan_motion(PANDA, PANDA.home, GOAL, [POST]), tmp_path / file, rate=250)
    text = (tmp_path / file).read_text()
    (tmp_path / file).write_text(f"{text}\n", encoding="utf-8-sig")  # as a spreadsheet may save it
    names, again = read_motion(tmp_path / file)
    assert names == PANDA.joint_names
    for one, other in zip(written[:4], again[:4], strict=True):
        assert np.allclose(one, other, rtol=1e-9, atol=1e-8)
    own = torques(PANDA.chain, again.position, again.velocity, again.acceleration)
    assert np.allclose(again.torque, own) if file == "plan.csv" else np.isnan(again.torque).all()
    assert "effort" not in text  # controllers of positions refuse it
    plan = plan_motion(PANDA, PANDA.home, GOAL, duration=3.0 + 1e-11)
    write_motion(plan, tmp_path / file)  # the last two instants would be the same in the file
    assert len(read_motion(tmp_path / file)[1].time) == 301


def test_files_of_other_forms_are_refused(tmp_path) -> None:
    plan = plan_motion(PANDA, PANDA.home, GOAL, [POST])
    with pytest.raises(ValueError):
        write_motion(plan, tmp_path / "plan.txt")
    twice = "time,position:a,velocity:a,acceleration:a,torque:a\n" + 2 * "0,0,0,0,0\n"
    texts = {"a.csv": "time,x\n1,2\n", "b.yaml": "points: 3\n", "c.csv": "", "d.csv": twice}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=r"time, position:NAME|joint_names, positions"):
            read_motion(tmp_path / name)
    unsafe = plan_motion(PANDA, PANDA.home, GOAL, WALL, time_limit=0.0)
    with pytest.raises(UnsafePlanError):
        write_motion(unsafe, tmp_path / "plan.csv")
    assert not (tmp_path / "plan.csv").exists()


def test_command_line_plans_and_measures(tmp_path, capsys, failed) -> None:
    scene = tmp_path / "scene.json"
    scene.write_text(ve.obstacles_to_json([POST]))
    words = ["plan", "--scene", str(scene), "--goal", *map(str, GOAL), "--out", str(tmp_path / "plan.csv")]
    main(words)
    assert "success" in capsys.readouterr().out
    assert np.allclose(read_motion(tmp_path / "plan.csv")[1].position[-1], GOAL)
    scene.write_text("\ufeff" + ve.obstacles_to_json([POST]))  # as editors of Windows do
    main(words)
    foreign = tmp_path / "foreign.csv"
    foreign.write_text("time,x\n0,1\n")
    for refused in (foreign, tmp_path, foreign / "plan.csv"):
        failed(*words[:-1], refused)
    assert foreign.read_text() == "time,x\n0,1\n"
    scene.write_text(ve.obstacles_to_json(WALL))
    assert "no plan is safe" in failed(*words, "--time-limit", 0)
    scene.write_text(
        f'{{"format": "viapoint-scene", "obstacles": {ve.obstacles_to_json([POST])}, "reaches": [[0, 1, 0.1, 0, 0]]}}'
    )
    assert "has reaches" in failed(*words)
    scene.write_text('{"format": "viapoint-scene", "env": "viapoint/PlanarReach-v0", "start": [0.1, 0.4]}')
    assert "of the arm planar" in failed(*words)
    assert ".npz" in failed("evaluate", "--env", PLANE, "--scenes", scene)
    main(["plan", "--arm", str(UR5E)])
    assert "shoulder_pan: -6.283 to 6.283 rad, at most 3.14 rad/s" in capsys.readouterr().out
    assert "leave out --tool" in failed("plan", "--arm", DATA / "panda_spheres.xml", "--tool", "hand")
    results = tmp_path / "results.json"
    for _ in range(2):  # the second time, the file of the first is replaced
        main(["evaluate", "--scenes", "motionbenchmaker", "--n-scenes", "3", "--json", str(results)])
    assert "| plan_motion | all" in capsys.readouterr().out
    assert len(json.loads(results.read_text())["problems"]) == 3


def write_problem(folder, number, objects, names, start, goal) -> None:
    """Write a problem as the benchmark does; values of JSON are values of YAML."""
    folder.mkdir(exist_ok=True)
    wanted = [{"joint_name": name, "position": q} for name, q in zip(names, goal, strict=True)]
    # Joints of a gripper and of a head are in the files, too.
    state = {"name": ["head", *names], "position": [0.1, *start]}
    request = {"start_state": {"joint_state": state}, "goal_constraints": [{"joint_constraints": wanted}]}
    scene = {"world": {"collision_objects": objects}}
    (folder / f"scene{number:04}.yaml").write_text(json.dumps(scene))
    (folder / f"request{number:04}.yaml").write_text(json.dumps(request))


NO_TURN, QUARTER = [0, 0, 0, 1], [0, 0, 0.5**0.5, 0.5**0.5]
SHELF = {
    "id": "shelf",
    "pose": {"position": [0.5, 0, 0], "orientation": QUARTER},
    "primitive_poses": [
        {"position": [0.1, 0, 0.2], "orientation": NO_TURN},
        {"position": [0, 0, 0.4], "orientation": NO_TURN},
    ],
    "primitives": [
        {"type": "box", "dimensions": [0.2, 0.4, 0.6]},
        {"type": "cylinder", "dimensions": [0.3, 0.05]},
    ],
}


def test_problems_are_read_from_the_original_files(tmp_path) -> None:
    folder, names = tmp_path / "cage_panda", [f"panda_joint{j}" for j in range(1, 8)]
    goal = [j / 10 for j in range(1, 8)]
    write_problem(
        folder, 7, [SHELF], names, [0, 0, 0, -1, 0, 1, "1e-05"], goal
    )  # as PyYAML reads such numbers
    for name in ("request0007_more.yaml", "scene_sensed0007.yaml", "scene0008.yaml"):
        (folder / name).touch()
    [problem], [fault] = read_problems(tmp_path)
    assert "scene0008.yaml" in fault  # the others go on
    assert problem.name == "cage 7"
    assert np.allclose(problem.goal, goal)
    box, can = problem.obstacles
    assert np.allclose(box.position, (0.5, 0.1, 0.2))  # turned by a quarter of a turn about z
    assert np.allclose(box.size, (0.1, 0.2, 0.3))
    assert (can.radius, can.half_length) == (0.05, 0.15)
    scene = folder / "scene0007.yaml"
    request = folder / "request0007.yaml"
    asked = json.loads(request.read_text())
    place = {"translation": [0.4, 0, 0], "rotation": [0, 0, 1, 0]}
    asked["start_state"]["multi_dof_joint_state"] = {"transforms": [place]}
    request.write_text(json.dumps(asked))
    [moved], _ = read_problems(tmp_path)
    assert np.allclose(moved.obstacles[0].position, (-0.1, -0.1, 0.2))  # relative to the robot
    world = json.loads(scene.read_text())
    held = {"attached_collision_objects": [{"link_name": "hand"}]}
    scene.write_text(json.dumps(world | {"robot_state": held}))
    with pytest.raises(ValueError):
        read_problems(tmp_path)
    write_problem(folder, 7, [SHELF | {"meshes": [{"vertices": []}]}], names, goal, goal)
    with pytest.raises(ValueError, match=r"shelf.*meshes"):  # not left out without a word
        read_problems(tmp_path)
    (folder / "request0007.yaml").write_text("start_state: {}\n")
    for bad, told in ((tmp_path, "request0007.*'joint_state'"), (tmp_path / "nothing", "folder")):
        with pytest.raises(ValueError, match=told):
            read_problems(bad)


def test_planners_are_measured_on_problems_of_another_arm(tmp_path, capsys, failed) -> None:
    arm = ve.load_arm(UR5E)
    box = {"primitives": [{"type": "box", "dimensions": [0.1, 0.1, 0.4]}]}
    box["primitive_poses"] = [{"position": [0.5, 0.3, 0.2], "orientation": NO_TURN}]
    write_problem(tmp_path / "box_ur5e", 1, [box], arm.joint_names, arm.home, arm.home + 0.2)
    words = ["evaluate", "--problems", str(tmp_path)]
    main([*words, "--arm", str(UR5E), "--baselines", "plan_motion", "--format", "json"])
    [line] = json.loads(capsys.readouterr().out)
    assert (line["set"], line["solved"], line["physics"]) == ("box_ur5e", True, True)
    assert line["length"] == pytest.approx(0.2 * 6**0.5, rel=1e-3)
    assert "panda_joint1" in failed(*words)


def test_narrow_passages_that_a_search_finds_are_planned() -> None:
    """A third of these scenes were not solved when every refinement asked for a clearance of 4 cm."""
    task = registered_task(WHOLE)
    frozen = scenes_for("validation", task, 60)
    hard = frozen.take(frozen.band == len(BANDS) - 1).scenes
    start, goal = task.space.coordinates(hard.start), task.space.coordinates(hard.goal)
    each = [hard.obstacles.take([i]) for i in range(len(start))]
    plans = plan_motions(task.arm, start, goal, each, space="hand", time_limit=10.0)
    assert sum(plan.success for plan in plans) >= len(plans) - 2


def test_without_the_library_its_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl.base", None)
    ompl_paths._ompl.cache_clear()
    with pytest.raises(ValueError, match=r"pip install '\.\[planning\]'"):
        make_method("ompl", PLANE)


def test_it_solves_scenes_of_all_bands_and_stands_in_the_table():
    pytest.importorskip("ompl")
    frozen = load(shipped_path(PLANE), "validation")
    frozen = frozen.take(np.concatenate([np.flatnonzero(frozen.band == band)[:3] for band in range(4)]))
    method = make_method("ompl", PLANE)
    (result,) = evaluate_methods([method], frozen, PLANE, batch=20, time_decisions=False).results
    summary = result.summary()
    assert summary["success"]["rate"] >= 0.9
    assert summary["collision"]["rate"] <= 0.1
    actions = result.outcomes["action"]
    counts = actions[:, 0].astype(int)
    durations = [row[1 : 2 + count].sum() for row, count in zip(actions, counts, strict=True)]
    np.testing.assert_allclose(result.outcomes["duration"], durations)


def test_where_there_is_no_way_it_gives_up(monkeypatch):
    pytest.importorskip("ompl")
    monkeypatch.setattr(module, "OMPL_MARGINS", module.OMPL_MARGINS[:1])
    monkeypatch.setattr(module, "OMPL_PATIENCE", 0.05)
    simulation = SceneSimulation(PLANE, 1)
    given = {name: ENCLOSED[name] for name in ("start", "goal", "obstacles")}
    scenes = draw_given(given, simulation.task.sampler(), [np.random.default_rng(0)])
    method = make_method("ompl", PLANE)
    assert not method.plan(scenes).success
    assert not method.execute(scenes, method.decide({}, scenes))["is_success"].any()


@pytest.mark.parametrize("env_id", [PLANE, WHOLE, PANDA_TASK])
def test_plans_are_as_clear_as_they_are_said_to_be(env_id):
    pytest.importorskip("ompl")
    scenes = load(shipped_path(env_id), "validation").scenes.take(np.arange(0, 240, 20))
    method = make_method("ompl", env_id)
    plans = [method.plan(scenes.take([row])) for row in range(12)]
    for plan in plans:
        done = plan.execute(force=True)
        assert done.is_success[0] or plan.clearance < 0.002
        assert done.min_clearance[0] > plan.clearance - 0.002
    assert sum(plan.success for plan in plans) > 6


def test_where_no_seed_is_free_a_path_is_followed(monkeypatch):
    """That of compiled trees, of several the one with the smoothest movement, and that of OMPL where they find none."""
    pytest.importorskip("ompl")
    arm = benchmark_panda()
    problem = next(each for each in benchmark_problems() if each.name == "bookshelf_thin 20")
    given = {"start": problem.start, "goal": problem.goal, "obstacles": problem.obstacles}
    given |= {"arm": arm, "seeds": 0, "n_via": 1, "time_limit": 20.0}
    plan = plan_motion(**given, ompl=False)
    assert (plan.success, plan.source) == (True, "path")
    assert plan_motion(**given, ompl=False, enough=4).jerk < plan.jerk
    monkeypatch.setattr(module, "clear_path", lambda *_: np.empty((0, 7)))
    plan = plan_motion(**given)
    assert (plan.success, plan.source) == (True, "ompl")
    assert not plan_motion(**given, ompl=False).success


def test_movements_along_paths_are_smoother_than_those_through_their_points() -> None:
    """A refinement that looks at too few instants of a long movement does not see some contacts, and fails."""
    arm, still = benchmark_panda(), np.zeros(7)
    problem = next(each for each in benchmark_problems() if each.name == "table_under_pick 2")
    ends, obstacles = np.stack((problem.start, problem.goal)), pack([problem.obstacles])
    given = module._Problem(arm, space_of(arm, "joints"), ends[0], still, still, ends[1], obstacles)
    path = clear_path(given.setting(), ends, obstacles, 0.001, np.random.default_rng(0), 20.0)
    points = points_on(path, 12)
    durations = np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1))
    table = movements.table_with((durations / durations.sum())[None], movements.FINE_INSTANTS)
    _, _, cost = module._moved(given, 0.0, table, points[1:-1], 1.0, np.inf)
    # Through the points themselves, it has 1,000 times this unit.
    assert cost < 30.0 * refine.unit_of_jerk(ends[1] - ends[0], False)


LIFT = """<mujoco><worldbody><body name="carriage"><joint name="lift" type="slide" axis="0 0 1" range="0 0.5"/>
<geom size="0.02" mass="1"/><body name="arm"><joint name="turn" axis="0 0 1" range="-90 90"/>
<geom type="capsule" fromto="0.05 0 0.1 0.4 0 0.1" size="0.02"/></body></body></worldbody></mujoco>"""
LIFTED = ve.load_arm(LIFT, name="lift", torque_limit=100.0, velocity_limit=1.0)
"""Arm that turns and is lifted, 0.1 m above its base."""
FENCE, CEILING = (ve.Box((0.2, 0.02, 0.2), position=(0.3, 0.0, height)) for height in (0.1, 0.7))
"""Obstacles below and above which the arm cannot pass; it can between them."""


@pytest.mark.parametrize("arm", [benchmark_panda(), LIFTED])
def test_a_path_of_trees_is_clear_between_its_ends(arm):
    """The same seed gives the same path; where there is none, none is found."""
    ends, shapes = np.array([[0.0, -0.8], [0.0, 0.8]]), [FENCE, CEILING]
    if len(arm.joint_names) > 2:
        problem = next(each for each in benchmark_problems() if each.name == "cage 1")
        ends, shapes = np.stack((problem.start, problem.goal)), problem.obstacles
    obstacles, setting = pack([shapes]), movements.arm_setting(arm, False, pack([shapes]))
    path = clear_path(setting, ends, obstacles, 0.002, np.random.default_rng(5), 20.0)
    again = clear_path(setting, ends, obstacles, 0.002, np.random.default_rng(5), 20.0)
    np.testing.assert_array_equal(path, again)
    np.testing.assert_array_equal(path[[0, -1]], ends)
    low, high = arm.joint_range.T
    assert ((path >= low) & (path <= high)).all()
    shares = np.linspace(0.0, 1.0, 200)[:, None]
    between = np.concatenate([one + shares * (other - one) for one, other in itertools.pairwise(path)])
    rows, own = row_clearances(arm.chain, arm.spheres, between, obstacles.take([0] * len(between)), 1.0)
    assert min(own.min(), rows.min()) > -0.002
    wall = ve.Box((0.01, 2.0, 2.0), position=(0.25, 0.0, 0.0), quaternion=(0.707, 0.0, 0.0, 0.707))
    rng = np.random.default_rng(5)
    assert not len(clear_path(setting, ends, pack([[*shapes, wall]]), 0.002, rng, 0.1))


def test_some_targets_of_trees_shift_the_tool_and_leave_it_turned_as_it_is():
    """At the limits of the joints, the tool comes as near as it can."""
    arm, rng = benchmark_panda(), np.random.default_rng(0)
    setting, placed = movements.arm_setting(arm, False, pack([[]])), memory(arm.chain, arm.spheres)
    joints = np.tile(arm.home, (21, 1))
    for target in joints[1:]:
        _shift(setting, arm.home, rng, target, placed)
    axes, _ = link_poses(arm.chain, joints)
    kept = np.abs(axes[:, -1] - axes[0, -1]).max(axis=(1, 2)) < 1e-4
    assert kept.sum() > 10
    assert 0.1 < np.abs(arm.hand(joints[kept]) - arm.hand(arm.home)).max() < 0.3


def test_a_seed_that_is_free_is_not_lost(monkeypatch):
    """Also where the refinement leaves the narrow passage that it leads through."""
    monkeypatch.setattr(module, "ROUGH", 1e9)  # no more seeds follow a free one
    arm = benchmark_panda()
    problem = next(each for each in benchmark_problems() if each.name == "table_under_pick 3")
    ends, obstacles = np.stack((problem.start, problem.goal)), pack([problem.obstacles])
    setting, rng = movements.arm_setting(arm, False, obstacles, room=-1e-5), np.random.default_rng(22)
    path = clear_path(setting, ends, obstacles, 0.001, rng, 20.0)
    plan = plan_motion(arm, *ends, obstacles, n_via=3, seeds=points_on(path, 3)[None, 1:-1])
    assert (plan.success, plan.source, plan.seeds) == (True, "given", 1)


def test_points_lie_on_the_path_and_keep_its_corners():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [2.0, 2.0]])
    np.testing.assert_array_equal(points_on(path, 2), path)
    np.testing.assert_allclose(points_on(path, 1), [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    for count in (3, 4, 8, 12):
        points = points_on(path, count)
        assert len(points) == count + 2
        assert all((np.abs(points - corner).max(axis=-1) < 1e-12).any() for corner in path)
        length = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum()
        assert length == pytest.approx(4.0)
