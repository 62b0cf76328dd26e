"""Replanning: plans that begin at the present command, without a jump of position, velocity or acceleration.

An action changes the *nominal* plan: the rest of the plan under way while its goal is the present one, else
the smoothest movement to the new goal. By the principle of optimality the rest of a minimum-jerk movement, made again
through its own via-points, is itself, so a zero action changes nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs.common.arrays import Bool, Float, norm, put, take
from viapoint.envs.plans import ActionLayout, Motion, Plan, turned

# Jerk with which a plan follows a goal that moves a little, [m/s^3] or [rad/s^3]: 60 distance / time^3
CORRECTION_JERK = 10.0
# Distance of a new goal from the old one below which the plan changes in proportion, [m] or [rad]
NEARBY = {"hand": 0.02, "joints": 0.05}


class NominalPlan(NamedTuple):
    """Plans that N arms follow on a zero action, in coordinates of the space."""

    begun: Bool  # True if a movement is under way; otherwise the nominal plan is the straight movement
    changed: Bool  # True if the goal differs from that of the plan under way
    jumped: Bool  # True if it differs so much that the default is the smoothest movement to it
    state: Motion  # Present command
    start: Float  # Start of the episode, shape (N, D)
    goal: Float  # Present goal, shape (N, D)
    vias: Float  # Via-points, shape (N, K, D)
    remaining: Float  # Remaining duration, shape (N,), [s]; 0 where the arm rests at its goal


def nominal_plan(
    layout: ActionLayout, plan: Plan, time: Float, begun: Bool, start: Float, goal: Float
) -> NominalPlan:
    """Return the plans of zero actions, `time` after the beginning of N movements under way, shape (N,), [s].

    The other arguments are parts of the result, see :class:`NominalPlan`.
    """
    number = layout.n_via
    trajectory = plan.trajectory()
    distance = norm(goal - plan.waypoints[:, -1])
    nearby = NEARBY[layout.space]
    jumped = distance >= nearby
    moving = Motion(*(part[:, 0] for part in trajectory.sample(time[:, None])))
    at_rest = Motion.at_rest(start)
    state = Motion(*(np.where(begun[:, None], a, b) for a, b in zip(moving, at_rest, strict=True)))
    shares = np.arange(1, number + 1) / (number + 1)
    straight = start[:, None] + (goal - start)[:, None] * shares[:, None]
    rest = trajectory(_passages(plan, time, number))
    whole = np.maximum(layout.zero_duration(state.position, goal), least_remaining(layout))
    anew = primitives.point_to_point(
        state.position, goal, whole, start_velocity=state.velocity, start_acceleration=state.acceleration
    )(whole[:, None] * shares)
    share = np.minimum(distance / nearby, 1.0)  # a small move changes the rest of the plan a little
    mixed = rest + share[:, None, None] * (anew - rest)
    vias = np.where(begun[:, None, None], mixed, straight)
    left = np.maximum(plan.duration - time, 0.0)
    left = np.maximum(left + share * (whole - left), np.cbrt(60.0 * distance / CORRECTION_JERK))
    remaining = np.where(jumped | ~begun, whole, left)
    return NominalPlan(begun, (distance > 0.0) & begun, jumped & begun, state, start, goal, vias, remaining)


def least_remaining(layout: ActionLayout) -> float:
    """Return the shortest revised movement; a plan with less time left is not revised, [s]."""
    return 0.5 * layout.duration_range[0] if layout.space == "hand" else 0.3


def revise(layout: ActionLayout, nominal: NominalPlan, plan: Plan, actions: Float) -> tuple[Plan, Bool]:
    """Return plans for actions (N, m), and True where the present one is kept: zero action or close to the goal."""
    zero = (actions == 0.0).all(axis=-1)
    near = (nominal.remaining > 0.0) & (nominal.remaining < least_remaining(layout))
    keep = nominal.begun & ~nominal.changed & (zero | near)
    revised = Plan(*(part.copy() for part in plan))
    first = np.flatnonzero(~nominal.begun)
    if first.size:
        fresh = layout.plans(actions[first], nominal.state.position[first], nominal.goal[first])
        put(revised, first, fresh)
    later = np.flatnonzero(nominal.begun & ~keep)
    if later.size:
        put(revised, later, _revised(layout, take(nominal, later), actions[later]))
    return revised, keep


def timed(waypoints: Float, duration: Float, state: Motion) -> Plan:
    """Return the plan through waypoints, from a state, with the passage times of least jerk."""
    durations = primitives.passage_durations(
        waypoints, duration, start_velocity=state.velocity, start_acceleration=state.acceleration
    )
    return Plan(waypoints, durations, state.velocity, state.acceleration)


def _revised(layout: ActionLayout, nominal: NominalPlan, actions: Float) -> Plan:
    """Return plans in motion for actions that change them."""
    state, number, d = nominal.state, layout.n_via, layout.dimension
    offsets = actions[:, : number * d].reshape(len(actions), number, d) * layout.via_scale
    if layout.space == "hand":
        # The frame's line is that from the hand to the goal or, at the goal, from the start.
        line = nominal.goal - state.position
        for other in (nominal.goal - nominal.start, np.eye(1, d)):
            line = np.where((norm(line) < NEARBY["hand"])[:, None], other, line)
        offsets = turned(offsets, line[:, None])
    points = np.concatenate((state.position[:, None], nominal.vias + offsets, nominal.goal[:, None]), axis=1)
    least = least_remaining(layout)
    remaining = np.maximum(nominal.remaining, least)
    duration = np.maximum(remaining * np.exp(layout.log_half_range * actions[:, number * d]), least)
    if layout.space == "hand":
        duration = np.minimum(duration, np.maximum(remaining, layout.duration_range[1]))
    zero = (actions == 0.0).all(axis=-1)
    slightly = nominal.changed & ~nominal.jumped
    plan = timed(points, np.where(zero & slightly, nominal.remaining, duration), state)
    # The smoothest movement itself: its via-points are evenly spaced in time.
    even = np.broadcast_to(duration[:, None] / (number + 1), plan.durations.shape)
    return plan._replace(durations=np.where((zero & ~slightly)[:, None], even, plan.durations))


def _passages(plan: Plan, time: Float, number: int) -> Float:
    """Return passage times of the remaining via-points, and times on the last segment for those passed.

    Shape (N, K), [s], in order.
    """
    knots = np.cumsum(plan.durations, axis=-1)
    inner, end = knots[:, :-1], knots[:, -1:]
    index = np.arange(number)
    ahead = (inner > time[:, None]).sum(axis=-1, keepdims=True)
    kept = np.take_along_axis(inner, np.minimum(index + number - ahead, number - 1), axis=-1)
    since = np.minimum(np.maximum(time[:, None], inner[:, -1:] if number else 0.0), end)
    filled = since + (end - since) * (index - ahead + 1) / (number - ahead + 1)
    return np.where(index < ahead, kept, filled)
