"""What can be computed of a movement before it is made.

An agent that knows the arm's geometry and the minimum-jerk expansion need not learn them. These features are exact
functions of observation and action, of NumPy arrays and of torch tensors, differentiable through the primitives; what
the physics adds is left to learning.
"""

from __future__ import annotations

from typing import NamedTuple

from viapoint.envs._arrays import clamp, namespace_of
from viapoint.envs.action import frame
from viapoint.envs.reward import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.task import Task
from viapoint.training.sight import INSTANTS, STRETCHES, Array, Observation, Sight, push, see

GEOMETRY = STRETCHES + 4
"""Numbers that tell clearance and reach of a movement."""


class SceneView(NamedTuple):
    """A scene in the frame of its start and goal, so that equal tasks look equal wherever they are."""

    ends: Array
    """Start and goal in the arm's frame, and their distance, shape (B, 2 D + 1)."""
    rows: Array
    """Obstacles in the frame along, across and above the straight line, from its middle, shape (B, n, 2 D + 1)."""
    present: Array
    """Shape (B, n), bool."""


class Look(NamedTuple):
    """What an actor sees of A movements in each of B scenes before it improves them."""

    actions: Array
    """That make the movements, shape (B, A, m), inside (-1, 1)."""
    fares: Array
    """How each would fare: clearance, reach, and where the nearest obstacle pushes in each stretch, shape (B, A, .)."""
    known: Array
    """The part of each one's reward that the plan alone decides, shape (B, A)."""

    def at(self, some: Array) -> Look:
        """Only some of the movements, `some` of shape (B, n) in each scene."""
        rows = namespace_of(some).arange(len(some))[:, None]
        return Look(*(part[rows, some] for part in self))

    @property
    def free(self) -> Array:
        """Which of the movements touch nothing and stay in reach, shape (B, A), bool."""
        return (self.fares[..., STRETCHES] > 0.0) & (self.fares[..., STRETCHES + 2] > 0.0)


class KnownReward(NamedTuple):
    """The terms of the reward that the plan alone decides, shape (B, H) each."""

    clearance: Array
    smoothness: Array
    duration: Array

    def total(self) -> Array:
        """Shape (B, H)."""
        return self.clearance + self.smoothness + self.duration


class Foresight(NamedTuple):
    """What is known of planned movements, shape (B, H, ...) for H actions in each of B scenes."""

    seen: Sight
    log_jerk: Array
    """Log of the jerk cost relative to the straight movement of the same duration, shape (B, H)."""
    reward: KnownReward

    def vector(self) -> Array:
        """The features as a network likes them, of size one, shape (B, H, GEOMETRY + 1)."""
        xp = namespace_of(self.log_jerk)
        return xp.concat((_sized(self.seen), 0.3 * self.log_jerk[..., None]), axis=-1)


def fares_size(task: Task) -> int:
    """Numbers that tell how a movement would fare."""
    return GEOMETRY + STRETCHES * task.arm.dimension


def scene_view(observation: Observation, task: Task) -> SceneView:
    """The scene of an observation, seen along its straight line; `hand` is the start."""
    start, goal = observation["hand"], observation["goal"]
    xp = namespace_of(start)
    line = goal - start
    distance = xp.sqrt(xp.sum(line * line, axis=-1, keepdims=True))
    ends = 2.0 * xp.concat((start, goal, distance), axis=-1)
    if "obstacles" not in observation:
        empty = xp.zeros((len(start), 1, 2 * task.arm.dimension + 1), dtype=start.dtype)
        return SceneView(ends, empty, empty[..., 0] > 0.0)
    rows = task.observation.obstacles(observation["obstacles"])
    axes = xp.stack(frame(line), axis=-1)
    centre = (rows.centre - 0.5 * (start + goal)[:, None]) @ axes
    half = rows.half_axis @ axes
    half = xp.where(half[..., 1:2] < 0.0, -half, half)  # a bar has no sense of direction
    seen = xp.concat((centre, half, rows.radius[..., None]), axis=-1) * 5.0
    return SceneView(ends, seen, rows.present > 0.5)


def foresee(observation: Observation, actions: Array, task: Task) -> Foresight:
    """What is known of H actions in each of B scenes.

    Args:
        observation: Of B scenes.
        actions: Shape (B, H, m), in [-1, 1].
        task: The environment's.
    """
    hand, log_jerk, relative = _planned(observation, actions, task)
    seen = see(observation, hand, task)
    return Foresight(seen, log_jerk, known_reward(seen, log_jerk, relative, task))


def look_at(observation: Observation, actions: Array, task: Task) -> Look:
    """See how actions of shape (B, A, m) would fare."""
    hand, log_jerk, relative = _planned(observation, actions, task)
    return look_along(observation, actions, task, hand, log_jerk, relative)


def look_along(
    observation: Observation, actions: Array, task: Task, hand: Array, log_jerk: Array, relative: Array
) -> Look:
    """See how actions would fare whose paths, jerk and duration are known already.

    Args:
        observation: Of B scenes.
        actions: Shape (B, A, m).
        task: The environment's.
        hand: Their paths, shape (B, A, PHASES, D), [m].
        log_jerk: Log of their jerk cost relative to the straight movement's, shape (B, A).
        relative: Their duration relative to the zero action's, shape (B, A).
    """
    xp = namespace_of(hand)
    seen, pushed = push(observation, hand, task)
    axes = xp.stack(frame(observation["goal"] - observation["hand"]), axis=-1)
    in_frame = xp.reshape(pushed @ axes[:, None], (*pushed.shape[:2], -1))
    known = known_reward(seen, log_jerk, relative, task).total()
    return Look(actions, xp.concat((_sized(seen), in_frame), axis=-1), known)


def known_reward(seen: Sight, log_jerk: Array, relative: Array, task: Task) -> KnownReward:
    """As :func:`viapoint.envs.reward.reward_terms` has it."""
    xp = namespace_of(log_jerk)
    least = clamp(xp.min(seen.clearance, axis=-1), *CLEARANCE_RANGE)
    return KnownReward(
        task.weights.clearance * least / CLEARANCE_UNIT,
        -task.weights.smoothness * (log_jerk - 5.0 * xp.log(relative)),
        -task.weights.duration * (relative - 1.0),
    )


def _planned(observation: Observation, actions: Array, task: Task) -> tuple[Array, Array, Array]:
    """Hand paths, log of the relative jerk cost, and duration relative to the zero action's."""
    xp = namespace_of(actions)
    start, goal = _ends(observation, actions)
    plan = task.action.decode(actions, start, goal)
    trajectory, duration = plan.trajectory(), xp.sum(plan.durations, axis=-1)
    line = goal - start
    ratio = trajectory.cost() * duration**5 / (360.0 * xp.sum(line * line, axis=-1))
    log_jerk = xp.log(xp.maximum(ratio, xp.ones_like(ratio)))
    return trajectory(_times(duration)), log_jerk, duration / task.action.centre_duration


def _ends(observation: Observation, actions: Array) -> tuple[Array, Array]:
    """Start and goal for each action."""
    xp = namespace_of(actions)
    shape = (*actions.shape[:2], observation["hand"].shape[-1])
    start, goal = (xp.broadcast_to(observation[name][:, None], shape) for name in ("hand", "goal"))
    return start, goal


def _times(duration: Array) -> Array:
    """When movements are looked at, shape (..., PHASES), [s]."""
    xp = namespace_of(duration)
    return duration[..., None] * xp.asarray(INSTANTS, dtype=duration.dtype)


def _sized(seen: Sight) -> Array:
    xp = namespace_of(seen.clearance)
    least, margin = xp.min(seen.clearance, axis=-1)[..., None], seen.reach_margin[..., None]
    parts = (seen.clearance * 20.0, least * 20.0, least * 150.0, margin * 20.0, least * 1000.0)
    return clamp(xp.concat(parts, axis=-1), -2.0, 2.0)
