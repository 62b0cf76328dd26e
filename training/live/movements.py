"""Executed movements of the live page, piece by piece, and profiles of plans over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task
    from viapoint.envs.sim.outcome import Rollout
    from viapoint.training.live.decisions import DecisionMaker
    from viapoint.training.live.scene_file import LiveScene

SAMPLES = 80
"""Instants of a profile."""
DECISION_INTERVAL = 0.1
"""Horizon of the decisions while a goal may be dragged, [s]."""


class Profile(NamedTuple):
    """Speed, jerk and clearance over a movement, shape (T,) each."""

    time: Float
    """[s]."""
    speed: Float
    """[m/s]."""
    jerk: Float
    """[m/s^3]."""
    clearance: Float
    """Clearance from the nearest obstacle, [m]; at most 1."""


class Segment(NamedTuple):
    """Part of an executed movement."""

    time: Float
    """Times since the beginning of the episode, shape (T,), [s]."""
    joints: Float
    """Joint angles, shape (T, J), [rad]."""
    hand: Float
    """Hand positions, shape (T, D), [m]."""
    contact: Bool
    """True where the arm touches something, shape (T,)."""
    clearance: Float
    """Clearance from the nearest obstacle, shape (T,), [m]."""
    path: Float | None
    """Path of the plan that is followed, shape (P, D), [m]; None where it is the one already known."""
    info: Mapping[str, Any]
    """Metrics of the movement so far."""
    restarted: bool = False
    """True if a new movement begins with this segment."""


def plan_profile(task: Task, scene: LiveScene, plan: Plan) -> Profile:
    """Return the profile of a plan from rest among the obstacles of a scene, which may move."""
    trajectory = plan.trajectory()
    time = np.linspace(0.0, float(np.sum(plan.durations)), SAMPLES)
    hand, velocity, jerk = (np.asarray(trajectory(time, nu)) for nu in (0, 1, 3))
    scenes = scene.batch()
    places = scenes.places(time[None])
    each = task.collision_model.clearance_profile(hand[None], places, scenes.present)
    return Profile(time, norm(velocity), norm(jerk), each[0].min(axis=-1, initial=1.0))


def executed_profile(segments: list[Segment]) -> Profile:
    """Return the profile of an executed movement; its jerk is not measured (NaN)."""
    time, hand, clearance = (
        np.concatenate([getattr(each, name) for each in segments]) for name in ("time", "hand", "clearance")
    )
    speed = norm(np.gradient(hand, time, axis=0)) if len(time) > 2 else np.zeros_like(time)
    rows = np.unique(np.linspace(0, len(time) - 1, 2 * SAMPLES).astype(int))
    return Profile(time[rows], speed[rows], np.full(len(rows), np.nan), clearance[rows])


def execute_whole(env: Any, scene: LiveScene, plan: Plan) -> Iterator[Segment]:
    """Execute a plan as one segment.

    Args:
        env: Vector environment of one environment, with whole movements as actions.
        scene: Scene.
        plan: Plan of one row without a batch dimension.
    """
    env.reset(options=scene.options(changing=False))
    _, _, info = env.execute_plan(Plan(plan.waypoints[None], plan.durations[None]))
    yield _segment(env.last_rollout[0], 0, None, info)


def execute_stepwise(env: Any, agent: Any, scene: LiveScene) -> Iterator[Segment]:
    """Execute the velocity actions of an agent to the end of the episode, as one segment."""
    observation, _ = env.reset(options=scene.options(changing=False))
    over = False
    while not over:
        actions, _ = agent.predict(observation, deterministic=True)
        observation, _, info = env.execute_actions(actions)
        over = bool(env.terminated[0] or env.truncated[0])
    rollout = env.last_rollout[0]
    yield _segment(rollout, 0, rollout.hand, info)


def execute_replanning(
    env: Any,
    decisions: DecisionMaker,
    scene: LiveScene,
    plan: Plan,
    goal_of: Callable[[], Float],
    checks: int = 0,
) -> Iterator[Segment]:
    """Execute an episode whose plan is revised, decision by decision.

    Args:
        env: Vector environment of one environment with replanning.
        decisions: Maker of the later decisions.
        scene: Scene.
        plan: First plan.
        goal_of: Function that returns the present goal, which the user may drag, shape (D,), [m].
        checks: Proposals that the agent checks with computed geometry.
    """
    env.reset(options=scene.options(changing=True))
    goal = scene.goal
    observation, _, info = env.execute_plan(Plan(plan.waypoints[None], plan.durations[None]))
    known, done, offset, restarted = env.last_plan, 0, 0.0, False
    while True:
        segment = _segment(env.last_rollout[0], done, None, info)
        current, path = env.last_plan, None
        if not all(np.array_equal(a, b) for a, b in zip(current, known, strict=True)):
            moving = env.unwrapped.last_plans[0][-1][1]
            known, path = current, np.asarray(moving.trajectory().sample(48, 0)[0][0])
        done += len(segment.time)
        yield segment._replace(time=segment.time + offset, path=path, restarted=restarted)
        wanted, restarted = goal_of(), False
        moved = norm(wanted - goal) > 0.0
        if env.terminated[0]:
            if not moved or not info["is_success"][0]:  # without a success, the segment may be empty
                return
            hand = segment.hand[-1]
            if norm(wanted - hand) < MIN_GOAL_DISTANCE:
                return
            offset += float(segment.time[-1])
            scene, done, restarted = scene._replace(start=hand, goal=wanted), 0, True
            rest = scene.batch().places(np.array([[segment.time[-1]]]))[0, 0]
            scene = scene._replace(obstacles=rest, jumps=scene.jumps[:0])
            observation, _ = env.reset(options=scene.options(changing=True))
        elif moved:
            observation = env.move_goals(wanted[None])
        goal = wanted
        observation, _, info = env.execute_actions(decisions.action(observation, checks))


def _segment(rollout: Rollout, first: int, path: Float | None, info: Mapping[str, Any]) -> Segment:
    """Return the states of a rollout from one on."""
    return Segment(
        rollout.time[first:], rollout.joints[first:], rollout.hand[first:], rollout.contact[first:],
        rollout.clearance[first:], path, info,
    )  # fmt: skip


def describe_outcome(info: dict[str, Any]) -> str:
    """Return one sentence on an executed movement."""
    clearance = info["min_clearance"]
    clear = "" if clearance >= 0.999 else f", least clearance {1e3 * clearance:.0f} mm"
    if info["is_success"]:
        error, duration = 1e3 * info["goal_error"], info["duration"]
        return f"Success: at rest {error:.1f} mm from the goal after {duration:.2f} s{clear}."
    if info["collision"]:
        return f"Failure: the arm touches something after {info['first_contact_time']:.2f} s."
    if not info["reachable"]:
        return "Failure: the plan leaves the arm's reach, so the arm does not start."
    return f"Failure: {1e3 * info['goal_error']:.0f} mm from the goal after {info['duration']:.2f} s{clear}."
