"""Executed movements of the live page, piece by piece, and profiles of plans over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs import Plan, ReachVectorEnv, Task
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Observation
from viapoint.envs.geometry.clearance import FAR, configuration_clearances
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.training.live.scene import LiveScene

SAMPLES = 80
"""Instants of a profile and points of a drawn path."""
DECISION_INTERVAL = 0.1
"""Greatest horizon of decisions while a goal may be dragged, [s]."""
APART = 0.02
"""Least difference of a coordinate between the present position and a goal that begins a new movement."""

Decide = Callable[[Observation], Float]
"""Function that returns the action, shape (1, m), for an observation."""


class Profile(NamedTuple):
    """Movement at T instants."""

    time: Float
    """Shape (T,), [s]."""
    coordinates: Float
    """Shape (T, D)."""
    tool: Float
    """Places of the tool, shape (T, 3), [m]."""
    speed: Float
    """Speed of the tool, shape (T,), [m/s]."""
    jerk: Float
    """Jerk of the plan, shape (T,), [m/s^3] or [rad/s^3]; NaN for executed movements."""
    clearance: Float
    """Clearance from the nearest obstacle, shape (T,), [m]; at most 1."""
    own: Float
    """Clearance of the arm from itself, shape (T,), [m]; NaN for executed movements."""


class Segment(NamedTuple):
    """Part of an executed movement."""

    time: Float
    """Times since the beginning of the movement, shape (T,), [s]."""
    joints: Float
    """Joint positions, shape (T, J), [rad]."""
    hand: Float
    """Places of the tool, shape (T, 3), [m]."""
    contact: Bool
    """True where the arm touches something, shape (T,)."""
    clearance: Float
    """Clearance from the nearest obstacle, shape (T,), [m]."""
    places: Float
    """Places of the obstacles, shape (T, n, 3), [m]."""
    plan: Plan | None
    """Plan that is followed from now on; None where it is the one already known."""
    info: Mapping[str, Any]
    """Metrics of the movement so far."""
    restarted: bool = False
    """True if a new movement begins with this segment."""


def plan_profile(task: Task, obstacles: Obstacles, plan: Plan, samples: int = SAMPLES) -> Profile:
    """Return the profile of a plan from rest among the obstacles of one scene, if they keep their course."""
    arm, space = task.arm, task.space
    time = np.linspace(0.0, float(plan.duration), samples)
    trajectory = plan.trajectory()
    coordinates = np.asarray(trajectory(time))
    joints = space.joints(coordinates)
    tool = arm.hand(joints)
    each_time = obstacles.take(np.zeros(samples, np.int64)).at(time)
    each = configuration_clearances(arm.chain, arm.spheres, joints, each_time, np.zeros(samples))
    speed = norm(np.gradient(tool, time, axis=0))
    jerk = norm(np.asarray(trajectory(time, 3)))
    return Profile(time, coordinates, tool, speed, jerk, each[:, 0], each[:, 1])


def executed_profile(segments: list[Segment]) -> Profile:
    """Return the profile of an executed movement."""
    time = np.concatenate([each.time for each in segments])
    tool = np.concatenate([each.hand for each in segments])
    joints = np.concatenate([each.joints for each in segments])
    clearance = np.concatenate([each.clearance for each in segments])
    speed = norm(np.gradient(tool, time, axis=0)) if len(time) > 2 else np.zeros_like(time)
    rows = np.unique(np.linspace(0, len(time) - 1, 2 * SAMPLES).astype(int))
    unknown = np.full(len(rows), np.nan)
    return Profile(time[rows], joints[rows], tool[rows], speed[rows], unknown, clearance[rows], unknown)


def execute_whole(env: ReachVectorEnv, scene: LiveScene, plan: Plan) -> Iterator[Segment]:
    """Execute a plan of one movement as one segment."""
    env.reset(options=scene.options())
    info = env.execute_plan(in_batch(plan)).info
    yield _segment(env, 0, info)


def execute_stepwise(env: ReachVectorEnv, act: Decide, scene: LiveScene) -> Iterator[Segment]:
    """Execute the velocities of an agent to the end of the episode, as one segment."""
    info, _ = play_episode(env, scene, act)
    yield _segment(env, 0, info)


def play_episode(env: ReachVectorEnv, scene: LiveScene, decide: Decide) -> tuple[dict[str, Any], float]:
    """Play one episode in a batch of one, and return its last metrics and its total reward."""
    observation, _ = env.reset(options=scene.options())
    total, over = 0.0, False
    while not over:
        decision = env.execute_actions(decide(observation))
        observation = decision.observation
        total += float(decision.reward[0])
        over = bool(decision.terminated[0] or decision.truncated[0])
    return decision.info, total


def execute_replanning(
    env: ReachVectorEnv, decide: Decide, scene: LiveScene, plan: Plan, goal_of: Callable[[], Float]
) -> Iterator[Segment]:
    """Execute an episode whose plan is revised, decision by decision.

    When the arm has reached a goal that has been dragged away meanwhile, a new episode begins there.

    Args:
        env: Batch of one environment with replanning.
        decide: Function that makes the later decisions.
        scene: Scene.
        plan: First plan.
        goal_of: Function that returns the present goal, which the user may drag, shape (D,).
    """
    env.reset(options=scene.options())
    decision = env.execute_plan(in_batch(plan))
    done, known, offset, restarted = 0, 1, 0.0, False
    while True:
        segment = _segment(env, done, decision.info)
        history = env.last_plans[0]
        newest = history[-1][1].take(0) if len(history) != known else None
        known, done = len(history), done + len(segment.time)
        yield segment._replace(time=segment.time + offset, plan=newest, restarted=restarted)
        wanted, restarted = goal_of(), False
        moved = not np.array_equal(wanted, scene.goal)
        if decision.terminated[0] or decision.truncated[0]:
            if not moved or not decision.info["is_success"][0]:
                return
            following = _following(env, scene, segment, wanted)
            if following is None:
                return
            offset += float(segment.time[-1])
            scene, done, known, restarted = following, 0, 0, True
            observation, _ = env.reset(options=scene.options())
        elif moved:
            observation = env.move_goals(wanted[None])
        else:
            observation = decision.observation
        scene = scene._replace(goal=wanted)
        decision = env.execute_actions(decide(observation))


def _following(env: ReachVectorEnv, scene: LiveScene, segment: Segment, goal: Float) -> LiveScene | None:
    """Return the scene of a movement from where the arm is, among obstacles at rest; None if it is there already."""
    here = env.task.space.coordinates(segment.joints[-1])
    if np.abs(here - goal).max() < APART:
        return None
    rest = LiveScene.of(env.scenes._replace(obstacles=_now(env)), env.task)  # type: ignore[union-attr]
    return rest._replace(start=here, goal=goal, jumps=scene.jumps[:0], turns=0.0 * rest.turns)


def _now(env: ReachVectorEnv) -> Any:
    """Return the obstacles at their present places, at rest."""
    assert env.scenes is not None
    time = np.array([env.last_rollout[0].time[-1]])
    now = env.scenes.obstacles_at(time)
    return now._replace(velocity=np.zeros_like(now.velocity))


def _segment(env: ReachVectorEnv, first: int, info: Mapping[str, Any]) -> Segment:
    """Return the states of the last movement from one on."""
    rollout = env.last_rollout[0]
    time = rollout.time[first:]
    assert env.scenes is not None
    obstacles = env.scenes.take(np.zeros(len(time), np.int64)).obstacles_at(time)
    present = obstacles.present[0] if len(time) else slice(None)
    return Segment(
        time=time,
        joints=rollout.joints[first:],
        hand=rollout.hand[first:],
        contact=rollout.contact[first:],
        clearance=rollout.clearance[first:],
        places=obstacles.centre[:, present],
        plan=None,
        info=info,
    )


def in_batch(plan: Plan) -> Plan:
    """Return a plan as a batch of one."""
    return Plan(plan.waypoints[None], plan.durations[None])


def describe_outcome(info: Mapping[str, Any], in_joints: bool) -> str:
    """Return one sentence on an executed movement of a batch of one."""
    values = {name: np.asarray(value).reshape(-1)[0] for name, value in info.items()}
    clearance = values["min_clearance"]
    clear = "" if clearance >= 0.999 * FAR else f", least clearance {1e3 * clearance:.0f} mm"
    error = f"{1e3 * values['goal_error']:.1f} {'mrad' if in_joints else 'mm'}"
    if values["is_success"]:
        return f"Success: at rest {error} from the goal after {values['duration']:.2f} s{clear}."
    if values["collision"]:
        return f"Failure: the arm touches something after {values['first_contact_time']:.2f} s."
    if not values["reachable"]:
        return "Failure: the plan leaves the arm's reach."
    return f"Failure: {error} from the goal after {values['duration']:.2f} s{clear}."
