"""Decisions of the live page: plans, ranked proposals, and simulated movements."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from viapoint import primitives
from viapoint.envs import Plan, ReachVectorEnv, Scenes, Task
from viapoint.envs.common.arrays import Float, Observation, norm
from viapoint.envs.geometry.clearance import FAR
from viapoint.envs.geometry.obstacles import pack
from viapoint.training.live.arena import AGENT, HAND, MOTION, OMPL, SEARCH, STRAIGHT, Arena
from viapoint.training.live.state import Movement, Proposal, Scene, State
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.plan_motion import SEEDS, checked_motion, ompl_motion, plan_motion
from viapoint.training.planning.problem import Problem
from viapoint.training.planning.search import GeometrySearch, merits

# Time limits of the motion planner after a change, and in a pause where that found no free movement, [s]
TIME_LIMIT, SECOND_LIMIT = 0.03, 0.3
N_PROPOSALS = 5  # Proposals that are shown
N_CANDIDATES = 256  # Best candidates among which distinct proposals are looked for
APART = 0.03  # Distance by which the paths of two proposals differ somewhere, [m]
N_CHECKS, REFINEMENTS = 512, 3  # Candidates of the geometry search, and rounds around the best
NEXT_START = 0.02  # Least way to a goal that begins a new movement, in a coordinate


def decide(arena: Arena, state: State, time_limit: float = TIME_LIMIT) -> Proposal:
    """Return the plan of the method, or by hand; where the scene is impossible, the motion planner says why."""
    if state.by_hand is not None:
        assert state.plan is not None
        return _by_hand(arena, state, state.by_hand, state.duration or state.plan.duration)
    if state.method in (MOTION, OMPL):
        return _planned(arena, state, time_limit)
    scene, (name, task, decide_) = state.scene, _chooser(arena, state)
    try:
        observation = begin_episode(arena.env(name), scene)
    except ValueError:
        best = _planned(arena, state, time_limit)
        if best.motion.success:
            raise  # what changes later is at fault, which the motion planner does not know
        return best
    begin = time.perf_counter()
    action = decide_(observation)
    seconds = time.perf_counter() - begin
    plan = task.action.decode(action, scene.start[None], scene.goal[None]).take(0)
    if state.duration is not None:
        return _by_hand(arena, state, plan.waypoints[1:-1], state.duration)
    maker = SEARCH if state.method == AGENT and name == "any" else state.method
    return Proposal(_checked(arena, scene, plan), maker, seconds)


def _checked(arena: Arena, scene: Scene, plan: Plan, source: str = "given") -> MotionPlan:
    return checked_motion(arena.task.arm, arena.task.space_name, plan, pack([scene.obstacles]), source)


def _chooser(arena: Arena, state: State) -> tuple[str, Task, Callable[[Observation], Float]]:
    """Return the environment in which a method decides, the task of its actions, and its function of observations."""
    if arena.agent_decides(state) and not arena.stepwise:
        return "own", arena.task, functools.partial(arena.act, checks=state.checks)
    task = dataclasses.replace(arena.env("any").task, n_via=arena.n_via(state))
    if state.method == STRAIGHT:
        return "any", task, lambda _: np.zeros((1, task.action.size))
    return "any", task, GeometrySearch(task, N_CHECKS, refinements=REFINEMENTS).decide


def _planned(arena: Arena, state: State, time_limit: float) -> Proposal:
    """Return the plan of a motion planner, which also says why there is no free movement."""
    scene, task = state.scene, arena.task
    problem = task.arm, scene.start, scene.goal, pack([scene.obstacles])
    maker = OMPL if state.method == OMPL else MOTION
    begin = time.perf_counter()
    if maker == OMPL:
        motion = ompl_motion(*problem, space=task.space_name)
    else:
        n_via = int(np.clip(arena.n_via(state), 1, 3))
        seeds: Any = SEEDS
        if state.before is not None and len(state.before.waypoints) == n_via + 2 and time_limit == TIME_LIMIT:
            seeds = state.before.waypoints[None, 1:-1]
        motion = plan_motion(
            *problem, n_via=n_via, seeds=seeds, time_limit=time_limit, duration=state.duration,
            space=task.space_name, ompl=False,
        )  # fmt: skip
    seconds = time.perf_counter() - begin
    if state.duration is not None:  # or the shortest that the limits allow; as it is if that fails
        plan = Plan(motion.waypoints, motion.durations * (state.duration / motion.duration))
        retimed = _checked(arena, scene, plan, motion.source)
        motion = retimed if retimed.success else motion
    return Proposal(motion, maker, seconds)


def _by_hand(arena: Arena, state: State, vias: Float, duration: float) -> Proposal:
    """Return the plan from start to goal through via-points, shape (K, D), in a duration, [s]."""
    waypoints = np.concatenate((state.scene.start[None], vias, state.scene.goal[None]))
    plan = Plan(waypoints, np.asarray(primitives.passage_durations(waypoints, np.asarray(duration))))
    return Proposal(_checked(arena, state.scene, plan), HAND)


def propose(arena: Arena, state: State) -> tuple[Proposal, ...]:
    """Return the plan and the best others that differ from it, with their simulated rewards.

    Where the motion planner found no free movement, it looks once more.
    """
    first, found = state.proposals[0], []
    if first.maker == MOTION and not first.motion.success:
        return (decide(arena, state, SECOND_LIMIT),)
    if state.method in (MOTION, OMPL, STRAIGHT):
        return (first,)
    env = arena.env("whole")
    now = state.scene._replace(jumps=(), turns=(), reaches=())  # later changes are not known
    try:
        begin_episode(env, now)
    except ValueError:  # the scene is impossible
        return (first,)
    scenes = env.scenes
    assert scenes is not None
    for each in _distinct(arena, state, scenes):
        env.begin(scenes)
        outcome = env.execute_plan(each.motion.plan.take(np.newaxis))
        success = each.motion.success and outcome.info["is_success"][0]
        found.append(each._replace(reward=float(outcome.reward[0]) if success else None))
    return tuple(found)


def _distinct(arena: Arena, state: State, scenes: Scenes) -> list[Proposal]:
    """Return the plan and the best candidates whose paths differ from it and from one another."""
    scene = state.scene
    first = state.proposals[0]
    name, task, _ = _chooser(arena, state)
    by_agent, maker = name == "own", SEARCH
    if by_agent and not hasattr(arena.policy, "propose"):  # it proposes one action
        return [first]
    if by_agent:
        maker = AGENT
        observation = begin_episode(arena.env(name), scene)
        actions, values = arena.propose(Problem.of_observation(observation, task))
    else:
        actions = candidate_actions(task, N_CHECKS, replanning=False).astype(np.float64)
        # Merits of several actions in one problem are bounds for all but the best.
        each_alone = Problem.of_scenes(scenes, task).take(np.zeros(len(actions), np.int64))
        values = merits(task, each_alone, actions[:, None])[:, 0]
    order = np.argsort(-values, kind="stable")[:N_CANDIDATES]
    ends = (np.tile(end, (len(order), 1)) for end in (scene.start, scene.goal))
    plans = task.action.decode(np.asarray(actions[order], dtype=np.float64), *ends)
    chosen, paths = first.motion.plan, arena.path(plans, 9)
    apart = norm(paths - arena.path(chosen, 9)).max(axis=-1)
    same = np.flatnonzero((apart < 1e-6) & np.isclose(plans.duration, chosen.duration))
    known: list[float | None] = [float(value) if by_agent else None for value in values[order]]
    found = [first._replace(value=known[same[0]] if same.size else None)]
    while len(found) < N_PROPOSALS and (apart > APART).any():
        i = int((apart > APART).argmax())
        found.append(Proposal(_checked(arena, scene, plans.take(i)), maker, value=known[i]))
        apart = np.minimum(apart, norm(paths - paths[i]).max(axis=-1))
    return found


def execute(arena: Arena, state: State) -> Iterator[Movement]:
    """Execute the plan, decision by decision where it is revised, and yield the movement so far after each.

    A goal that is dragged meanwhile is followed. When the arm has reached a goal that has been dragged away, a new
    episode begins there.
    """
    assert state.plan is not None
    scene, goal, reward = state.scene, state.scene.goal, 0.0
    if arena.stepwise and arena.agent_decides(state) and state.by_hand is None and state.picked == 0:
        env = arena.env("steps")
        decide_: Callable[[Observation], Float] = arena.act
        decision = env.execute_actions(decide_(begin_episode(env, scene)))
    else:
        name, _, decide_ = _chooser(arena, state)
        env = arena.env(name)
        begin_episode(env, scene)
        decision = env.execute_plan(state.plan.plan.take(np.newaxis))
    while True:
        rollout, scenes, plans = env.last_rollout[0], env.scenes, env.last_plan
        assert scenes is not None
        reward += float(decision.reward[0])
        info = {name: value[0] for name, value in decision.info.items()}
        yield Movement(rollout, scenes, None if plans is None else plans.take(0), info, reward)
        moved = not np.array_equal(state.scene.goal, goal)
        observation, goal = decision.observation, state.scene.goal
        if decision.terminated[0] or decision.truncated[0]:
            here = env.task.space.coordinates(rollout.joints[-1])
            if not moved or not info["is_success"] or np.abs(here - goal).max() < NEXT_START:
                return
            places = scenes.obstacles_at(rollout.time[-1:]).centre[0]
            resting = [
                dataclasses.replace(shape, position=place, velocity=np.zeros(3))
                for shape, place in zip(scene.obstacles, places, strict=False)
            ]
            scene = Scene(here, goal, tuple(resting))
            observation = begin_episode(env, scene)
        elif moved:
            observation = env.move_goals(goal[None])
        decision = env.execute_actions(decide_(observation))


def begin_episode(env: ReachVectorEnv, scene: Scene) -> Observation:
    """Begin an episode in a scene, and return the observation; a target without jumps gets none."""
    jumps = {"jumps": ()} if env.task.n_jumps[1] else {}
    observation, _ = env.reset(options={**jumps, **scene.options()})
    return observation


def profile(arena: Arena, scene: Scene, plan: Plan) -> dict[str, Float]:
    """Return time, speed of the tool, jerk, and clearance of a plan among obstacles that keep their course."""
    times = np.linspace(0.0, float(plan.duration), 80)
    trajectory = plan.trajectory()
    coordinates = np.asarray(trajectory(times))
    return {
        "time": times,
        "speed": norm(np.gradient(arena.tool(coordinates), times, axis=0)),
        "jerk": norm(np.asarray(trajectory(times, 3))),
        "clearance": arena.clearances(coordinates, scene.obstacles, times)[:, 0],
    }


def describe_plan(proposal: Proposal, duration: float | None = None) -> str:
    """Return one sentence on a plan, for which a user may want a duration, [s]."""
    motion = proposal.motion
    if not motion.success and proposal.maker == MOTION:
        return f"No free movement was found: {motion.reason}. The best one is shown in red."
    if not motion.success:
        return f"This plan fails: {motion.reason}."
    clear = f"{1e3 * motion.clearance:.0f} mm clear"
    if motion.clearance >= 0.999 * FAR:
        clear = "no obstacle near"
    jerk = f"{motion.jerk:.1f} times the jerk of the straight line"
    short = duration is not None and motion.duration > duration + 0.005
    limits = ", the shortest time that the limits of the arm allow" if short else ""
    return f"The plan takes {motion.duration:.2f} s{limits}, {clear}, with {jerk}."


def describe_outcome(info: Mapping[str, Any], in_joints: bool) -> str:
    """Return one sentence on an executed movement."""
    if info["collision"]:
        return f"Failure: the arm touches something after {info['first_contact_time']:.2f} s."
    if not info["reachable"]:
        return "Failure: the plan leaves the arm's reach."
    clearance = 1e3 * info["min_clearance"]
    error = 1e3 * info["goal_error"]
    near = "" if clearance >= 999.0 * FAR else f", least clearance {clearance:.0f} mm"
    state = "Success: at rest" if info["is_success"] else "Failure:"
    return f"{state} {error:.1f} {'mrad' if in_joints else 'mm'} from the goal after {info['duration']:.2f} s{near}."
