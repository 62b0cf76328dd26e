"""Replanning: plans that begin at the present command, without a jump of position, velocity or acceleration.

An action changes the *nominal* plan: the rest of the plan under way while its goal is the present one, else
the smoothest movement to the new goal. By the principle of optimality the rest of a minimum-jerk movement, made again
through its own via-points, is itself, so a zero action changes nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint import primitives
from viapoint.envs.actions.via_points import ActionLayout, Motion, Plan, frame
from viapoint.envs.common.arrays import norm, put, take
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE

CORRECTION_JERK = 10.0
"""Jerk of the correction by which a plan follows a target that moves a little, [m/s^3]: 60 distance / time^3."""


class MovingPlan(NamedTuple):
    """N movements that may begin in motion."""

    waypoints: Float
    """Present position, via-points and goal, shape (N, K + 2, D), [m]."""
    durations: Float
    """Durations of the segments, shape (N, K + 1), [s]."""
    velocity: Float
    """Initial velocity, shape (N, D), [m/s]."""
    acceleration: Float
    """Initial acceleration, shape (N, D), [m/s^2]."""

    @classmethod
    def of(cls, plan: Plan) -> MovingPlan:
        """Return a plan that begins at rest."""
        start = np.asarray(plan.waypoints[..., 0, :])
        return cls(plan.waypoints, plan.durations, np.zeros_like(start), np.zeros_like(start))

    @property
    def plan(self) -> Plan:
        """Via-points and durations alone."""
        return Plan(self.waypoints, self.durations)

    @property
    def duration(self) -> Float:
        """Total duration, shape (N,), [s]."""
        return np.asarray(self.durations.sum(axis=-1))

    def trajectory(self) -> primitives.Trajectory:
        """Return the minimum-jerk movement through the waypoints."""
        return primitives.through(
            self.waypoints, self.durations, start_velocity=self.velocity, start_acceleration=self.acceleration
        )


class NominalPlan(NamedTuple):
    """Plans that N hands follow on a zero action."""

    begun: Bool
    """True if a movement is under way; otherwise the nominal plan is the straight movement."""
    changed: Bool
    """True if the goal differs from that of the plan under way."""
    jumped: Bool
    """True if it differs so much that the default is the smoothest movement to it."""
    state: Motion
    """Present command."""
    start: Float
    """Start of the episode, shape (N, D), [m]."""
    goal: Float
    """Present goal, shape (N, D), [m]."""
    vias: Float
    """Via-points, shape (N, K, D), [m]."""
    remaining: Float
    """Remaining duration, shape (N,), [s]; 0 where the hand rests at its goal."""


class ReplanningDecoder:
    """Decoder of actions during a movement."""

    def __init__(self, layout: ActionLayout) -> None:
        self.layout = layout
        self.least_remaining = 0.5 * layout.duration_range[0]
        """Shortest revised movement; a plan with less time left is not revised, [s]."""

    def default(self, plan: MovingPlan, time: Float, begun: Bool, start: Float, goal: Float) -> NominalPlan:
        """Return the plans of zero actions, `time` after the beginning of N movements under way, shape (N,), [s].

        The other arguments are parts of the result, see :class:`NominalPlan`.
        """
        trajectory, end, number = plan.trajectory(), plan.duration, self.layout.n_via
        distance = norm(goal - plan.waypoints[:, -1])
        jumped = distance >= MIN_GOAL_DISTANCE
        state = Motion(*(part[:, 0] for part in trajectory.sample(time[:, None])))
        at_rest = Motion.at_rest(start)
        state = Motion(*(np.where(begun[:, None], a, b) for a, b in zip(state, at_rest, strict=True)))
        centre = np.full(len(goal), self.layout.centre_duration)
        shares = np.arange(1, number + 1) / (number + 1)
        straight = start[:, None] + (goal - start)[:, None] * shares[:, None]
        rest = trajectory(self._passages(plan, time))
        anew = primitives.point_to_point(
            state.position, goal, centre, start_velocity=state.velocity, start_acceleration=state.acceleration
        )(centre[:, None] * shares)
        # A target that moves a little changes the rest of the plan a little.
        share, left = distance / MIN_GOAL_DISTANCE, np.maximum(end - time, 0.0)
        nearby = rest + share[:, None, None] * (anew - rest)
        vias = np.where(jumped[:, None, None], anew, nearby)
        left = np.maximum(left + share * (centre - left), np.cbrt(60.0 * distance / CORRECTION_JERK))
        remaining = np.where(jumped | ~begun, centre, left)
        changed, vias = (distance > 0.0) & begun, np.where(begun[:, None, None], vias, straight)
        return NominalPlan(begun, changed, jumped & begun, state, start, goal, vias, remaining)

    def _passages(self, plan: MovingPlan, time: Float) -> Float:
        """Return passage times of the remaining via-points, and times on the last segment for those passed.

        Shape (N, K), [s], in order.
        """
        number = self.layout.n_via
        knots = np.cumsum(plan.durations, axis=-1)
        inner, end = knots[:, :-1], knots[:, -1:]
        index = np.arange(number)
        ahead = (inner > time[:, None]).sum(axis=-1, keepdims=True)
        kept = np.take_along_axis(inner, np.minimum(index + number - ahead, number - 1), axis=-1)
        since = np.minimum(np.maximum(time[:, None], inner[:, -1:] if number else 0.0), end)
        filled = since + (end - since) * (index - ahead + 1) / (number - ahead + 1)
        return np.where(index < ahead, kept, filled)

    def revise(self, default: NominalPlan, plan: MovingPlan, actions: Float) -> tuple[MovingPlan, Bool]:
        """Return plans for actions (N, m), and True where the present one is kept: zero action or close to the goal."""
        zero = (actions == 0.0).all(axis=-1)
        near = (default.remaining > 0.0) & (default.remaining < self.least_remaining)
        keep = default.begun & ~default.changed & (zero | near)
        revised = MovingPlan(*(part.copy() for part in plan))
        first, later = np.flatnonzero(~default.begun), np.flatnonzero(default.begun & ~keep)
        if first.size:
            place, goal = default.state.position[first], default.goal[first]
            put(revised, first, MovingPlan.of(self.layout.decode(actions[first], place, goal)))
        if later.size:
            put(revised, later, self._revised(take(default, later), actions[later]))
        return revised, keep

    def _revised(self, default: NominalPlan, actions: Float) -> MovingPlan:
        layout, state = self.layout, default.state
        nominal = default.vias, default.goal, default.remaining
        points, duration = revised_waypoints(layout, self._line(default), state.position, *nominal, actions)
        zero = (actions == 0.0).all(axis=-1)
        slightly = default.changed & ~default.jumped
        plan = timed(points, np.where(zero & slightly, default.remaining, duration), state)
        # The smoothest movement itself: its via-points are evenly spaced in time.
        even = np.broadcast_to(duration[:, None] / (layout.n_via + 1), plan.durations.shape)
        return plan._replace(durations=np.where((zero & ~slightly)[:, None], even, plan.durations))

    @staticmethod
    def _line(default: NominalPlan) -> Float:
        """Return the line of the offsets' frame: from the hand to the goal or, at the goal, from the start."""
        line = default.goal - default.state.position
        for other in (default.goal - default.start, np.eye(1, line.shape[-1])):
            line = np.where((norm(line) < MIN_GOAL_DISTANCE)[:, None], other, line)
        return line


def revised_waypoints(
    layout: ActionLayout,
    line: Float,
    position: Float,
    vias: Float,
    goal: Float,
    remaining: Float,
    actions: NDArray[Any],
) -> tuple[Float, Float]:
    """Return waypoints (..., K + 2, D), [m], and durations (...,), [s], of revised plans; batch dimensions broadcast.

    Args:
        layout: Layout of the actions.
        line: Vector along which offsets are measured, shape (..., D), [m].
        position: Commanded position, shape (..., D), [m].
        vias: Default via-points, shape (..., K, D), [m].
        goal: Present goal, shape (..., D), [m].
        remaining: Default remaining time, shape (...,), [s].
        actions: Shape (..., m), in [-1, 1].
    """
    d, number = layout.dimension, layout.n_via
    low, high = layout.duration_range
    offsets = actions[..., : number * d].reshape(*actions.shape[:-1], number, d) * np.array(
        layout.via_scale[:d]
    )
    moved = vias + sum(offsets[..., i : i + 1] * axis[..., None, :] for i, axis in enumerate(frame(line)))
    remaining = np.maximum(remaining, 0.5 * low)
    duration = np.clip(
        remaining * (high / low) ** (0.5 * actions[..., number * d]), 0.5 * low, np.maximum(remaining, high)
    )
    shape = (*actions.shape[:-1], 1, d)
    first, last = (np.broadcast_to(end[..., None, :], shape) for end in (position, goal))
    return np.concatenate((first, moved, last), axis=-2), duration


def timed(waypoints: Float, duration: Float, state: Motion) -> MovingPlan:
    """Return the plan through waypoints, from a state, with the passage times of least jerk."""
    durations = primitives.passage_durations(
        waypoints, duration, start_velocity=state.velocity, start_acceleration=state.acceleration
    )
    return MovingPlan(waypoints, durations, state.velocity, state.acceleration)
