"""The movements that actions stand for: from rest, or from the middle of another movement."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs._arrays import namespace_of
from viapoint.envs.action import ActionLayout, frame
from viapoint.envs.task import Task
from viapoint.training import graphs
from viapoint.training.sight import INSTANTS, Array, Observation

SHORT = 0.02
"""Lines shorter than this have no direction, [m]."""
NOMINAL = 0.3
"""Distance of the straight movement that the effort of the rest of a movement is compared with, [m]."""


class Movements(NamedTuple):
    """H movements in each of B scenes."""

    path: Array
    """Of the hand, at the ends of equal parts of the duration, shape (B, H, PHASES, D), [m]."""
    duration: Array
    """Shape (B, H), [s]."""
    log_jerk: Array
    """Log of the jerk cost relative to the straight movement of the same duration, shape (B, H)."""
    effort: Array
    """What the smoothness term of the reward weighs: jerk cost relative to the zero action's as a logarithm, (B, H)."""


def movements(observation: Observation, actions: Array, task: Task) -> Movements:
    """The movements of H actions in each of B scenes, shape (B, H, m); on the way where the observation tells it."""
    return (
        _on_the_way(observation, actions, task)
        if on_the_way(observation)
        else _at_rest(observation, actions, task)
    )


def on_the_way(parts: Container[str]) -> bool:
    """Whether decisions on observations with these parts are revisions of a movement that may be under way."""
    return "remaining" in parts


def direction(observation: Observation) -> Array:
    """From the hand to the goal, shape (B, D), [m]; along the first axis where they are the same."""
    xp = namespace_of(observation["hand"])
    line = observation["goal"] - observation["hand"]
    if not on_the_way(observation):
        return line
    short = xp.sum(line * line, axis=-1, keepdims=True) < SHORT**2
    ahead = xp.asarray(SHORT * np.eye(line.shape[-1])[0], dtype=line.dtype)
    return xp.where(short, ahead, line)


def _at_rest(observation: Observation, actions: Array, task: Task) -> Movements:
    start, goal = (_for_each(observation[name], actions) for name in ("hand", "goal"))
    drawn, line = graphs.is_drawn(), goal - start
    plan = (graphs.decoded if drawn else ActionLayout.decode)(task.action, actions, start, goal)
    trajectory = graphs.through(*plan) if drawn else plan.trajectory()
    duration = namespace_of(actions).sum(plan.durations, axis=-1)
    return _seen(trajectory, duration, line, task)


def _on_the_way(observation: Observation, actions: Array, task: Task) -> Movements:
    """As :class:`viapoint.envs.revision.Reviser` makes them."""
    xp, layout = namespace_of(actions), task.action
    d, number = layout.dimension, layout.n_via
    state = [_for_each(observation[name], actions) for name in ("hand", "velocity", "acceleration", "goal")]
    place, velocity, acceleration, goal = state
    line = direction(observation)
    axes = [axis[:, None] for axis in frame(line)]
    waypoints = [place]
    for k in range(number):
        via = _for_each(observation["via"][:, k * d : (k + 1) * d], actions)
        for i, axis in enumerate(axes):
            via = via + axis * (actions[..., k * d + i : k * d + i + 1] * layout.via_scale[i])
        waypoints.append(via)
    low, high = layout.duration_range
    factor = xp.exp(actions[..., number * d] * (0.5 * float(np.log(high / low))))
    remaining = xp.maximum(observation["remaining"], xp.full_like(observation["remaining"], 0.5 * low))
    longest = xp.maximum(remaining, xp.full_like(remaining, high))
    duration = xp.minimum(xp.maximum(remaining * factor, xp.full_like(factor, 0.5 * low)), longest)
    points = xp.stack([*waypoints, goal], axis=-2)
    began = {"start_velocity": velocity, "start_acceleration": acceleration}
    maker: Any = graphs if graphs.is_drawn() else primitives
    durations = maker.passage_durations(points, duration, **began)
    trajectory = maker.through(points, durations, **began)
    found = _seen(trajectory, duration, xp.broadcast_to(line[:, None], goal.shape), task)
    cost = trajectory.cost() * layout.centre_duration**5 / (360.0 * NOMINAL**2)
    return found._replace(effort=xp.log(1.0 + cost))


def _seen(trajectory: primitives.Trajectory, duration: Array, line: Array, task: Task) -> Movements:
    xp = namespace_of(duration)
    ratio = trajectory.cost() * duration**5 / (360.0 * xp.sum(line * line, axis=-1))
    log_jerk = xp.log(xp.maximum(ratio, xp.ones_like(ratio)))
    instants = duration[..., None] * xp.asarray(INSTANTS, dtype=duration.dtype)
    path = graphs.places(trajectory, instants) if graphs.is_drawn() else trajectory(instants)
    return Movements(path, duration, log_jerk, effort_of(log_jerk, duration, task))


def effort_of(log_jerk: Array, duration: Array, task: Task) -> Array:
    """Of movements from rest to rest."""
    return log_jerk - 5.0 * namespace_of(duration).log(duration / task.action.centre_duration)


def _for_each(part: Array, actions: Array) -> Array:
    """A part of B observations for H actions in each, shape (B, H, .)."""
    return namespace_of(part).broadcast_to(part[:, None], (*actions.shape[:2], part.shape[-1]))
