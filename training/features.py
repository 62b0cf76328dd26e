"""What can be computed of a movement before it is made.

An agent that knows the arm's geometry and the minimum-jerk expansion need not learn them. These features are exact
functions of observation and action, of NumPy arrays and of torch tensors, differentiable through the primitives; what
the physics adds is left to learning.
"""

from __future__ import annotations

from collections.abc import Container
from typing import NamedTuple

from viapoint.envs._arrays import clamp, namespace_of
from viapoint.envs.action import frame
from viapoint.envs.execution import SETTLING
from viapoint.envs.reward import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.task import Task
from viapoint.training.movements import Movements, direction, movements, on_the_way
from viapoint.training.sight import STRETCHES, Array, Observation, Sight, push, see, velocities

GEOMETRY = STRETCHES + 4
"""Numbers that tell clearance and reach of a movement."""
SURE = 0.006
"""Within half of it on either side of touching, success is not foretold for sure, [m]."""


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
    log_jerk: Array
    """Log of the jerk cost relative to the straight movement of the same duration, shape (B, A)."""

    def vector(self) -> Array:
        """As :meth:`Foresight.vector`, which says part of the same."""
        return _with_jerk(self.fares[..., :GEOMETRY], self.log_jerk)

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
        return _with_jerk(_sized(self.seen), self.log_jerk)


def fares_size(task: Task) -> int:
    """Numbers that tell how a movement would fare."""
    return GEOMETRY + STRETCHES * task.arm.dimension


def scene_view(observation: Observation, task: Task) -> SceneView:
    """The scene of an observation, seen along the line from `hand` to `goal`."""
    start, goal = observation["hand"], observation["goal"]
    xp = namespace_of(start)
    line = direction(observation)
    distance = xp.sqrt(xp.sum(line * line, axis=-1, keepdims=True))
    axes = xp.stack(frame(line), axis=-1)
    ends = [2.0 * xp.concat((start, goal, distance), axis=-1)]
    if on_the_way(observation):
        ends += _motion(observation, axes, task)
    together = xp.concat(ends, axis=-1)
    if "obstacles" not in observation:
        empty = xp.zeros((len(start), 1, scene_sizes(observation, task)[1]), dtype=start.dtype)
        return SceneView(together, empty, empty[..., 0] > 0.0)
    rows = task.observation.obstacles(observation["obstacles"])
    centre = (rows.centre - 0.5 * (start + goal)[:, None]) @ axes
    half = rows.half_axis @ axes
    half = xp.where(half[..., 1:2] < 0.0, -half, half)  # a bar has no sense of direction
    seen = [xp.concat((centre, half, rows.radius[..., None]), axis=-1) * 5.0]
    if on_the_way(observation):
        seen.append(3.0 * velocities(observation, rows.centre) @ axes)
    return SceneView(together, xp.concat(seen, axis=-1), rows.present > 0.5)


def _motion(observation: Observation, axes: Array, task: Task) -> list[Array]:
    """How the hand moves, in the frame, and how long it would go on, of size one."""
    velocity, acceleration = (
        (observation[name][:, None] @ axes)[:, 0] * scale
        for name, scale in (("velocity", 1.0), ("acceleration", 0.1))
    )
    return [velocity, acceleration, observation["remaining"], observation["time_left"]]


def scene_sizes(parts: Container[str], task: Task) -> tuple[int, int]:
    """Numbers of :attr:`SceneView.ends` and of each obstacle, for observations with these parts."""
    d = task.arm.dimension
    return (4 * d + 3, 3 * d + 1) if on_the_way(parts) else (2 * d + 1, 2 * d + 1)


def foresee(observation: Observation, actions: Array, task: Task) -> Foresight:
    """What is known of H actions in each of B scenes.

    Args:
        observation: Of B scenes.
        actions: Shape (B, H, m), in [-1, 1].
        task: The environment's.
    """
    moves = movements(observation, actions, task)
    seen = see(observation, moves.path, task, moves.duration)
    return Foresight(seen, moves.log_jerk, known_reward(seen, moves, task, observation.get("time_left")))


def look_at(observation: Observation, actions: Array, task: Task) -> Look:
    """See how actions of shape (B, A, m) would fare."""
    return look_along(observation, actions, movements(observation, actions, task), task)


def look_along(observation: Observation, actions: Array, moves: Movements, task: Task) -> Look:
    """See how actions would fare whose movements are known already."""
    xp = namespace_of(actions)
    seen, pushed = push(observation, moves.path, task, moves.duration)
    axes = xp.stack(frame(direction(observation)), axis=-1)
    in_frame = xp.reshape(pushed @ axes[:, None], (*pushed.shape[:2], -1))
    known = known_reward(seen, moves, task, observation.get("time_left")).total()
    return Look(actions, xp.concat((_sized(seen), in_frame), axis=-1), known, moves.log_jerk)


def known_reward(seen: Sight, moves: Movements, task: Task, time_left: Array = None) -> KnownReward:
    """As :func:`viapoint.envs.reward.reward_terms` has it.

    Args:
        seen: Of the movements.
        moves: They.
        task: The environment's.
        time_left: Of the episodes, shape (B, 1), [s], where they are several decisions. Then success and collision
            are counted, too, as if nothing would change on the way: they are paid at an episode's end, and to learn
            from there takes long.
    """
    least = clamp(namespace_of(seen.clearance).min(seen.clearance, axis=-1), *CLEARANCE_RANGE)
    relative = moves.duration / task.action.centre_duration
    clearance = task.weights.clearance * least / CLEARANCE_UNIT
    return KnownReward(
        clearance if time_left is None else clearance + _hope(seen, time_left - moves.duration, task),
        -task.weights.smoothness * moves.effort,
        -task.weights.duration * (relative - 1.0),
    )


def _hope(seen: Sight, spare: Array, task: Task) -> Array:
    """Success of what touches nothing, stays in reach and is in time, collision of what does not, as ramps.

    Args:
        seen: Of the movements.
        spare: Time that is left when they are over, shape (B, H), [s].
        task: The environment's.
    """
    xp = namespace_of(spare)
    least = xp.minimum(xp.min(seen.clearance, axis=-1), seen.reach_margin)
    clear = clamp(0.5 + least / SURE, 0.0, 1.0)
    in_time = clamp(spare / SETTLING - 1.0, 0.0, 1.0)
    return clear * in_time * task.weights.success - (1.0 - clear) * task.weights.collision


def _with_jerk(geometry: Array, log_jerk: Array) -> Array:
    return namespace_of(log_jerk).concat((geometry, 0.3 * log_jerk[..., None]), axis=-1)


def _sized(seen: Sight) -> Array:
    xp = namespace_of(seen.clearance)
    least, margin = xp.min(seen.clearance, axis=-1)[..., None], seen.reach_margin[..., None]
    parts = (seen.clearance * 20.0, least * 20.0, least * 150.0, margin * 20.0, least * 1000.0)
    return clamp(xp.concat(parts, axis=-1), -2.0, 2.0)
