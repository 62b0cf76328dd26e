"""Planned movements of many actions at once: paths, durations and jerk, in NumPy and without gradients."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint import primitives
from viapoint.envs.actions.via_points import MIN_GOAL_DISTANCE, ActionLayout, frame
from viapoint.envs.common.types import Numbers
from viapoint.envs.mdp.task import Task
from viapoint.primitives._passage.rest_to_rest import nearer_fraction

Observation = Mapping[str, Numbers]

NOMINAL = 0.3
"""Distance of the straight movement that the effort of the rest of a movement is compared with, [m]."""
BLOCK = 1 << 16
"""Places of the hand that are computed together, so that temporary arrays stay in the cache."""
_LEAST_PRODUCT = 1e-6
"""Lower bound of tau1 (1 - tau1); below it the via-point coincides with an end and its residual vanishes."""


class PlannedMovements(NamedTuple):
    """Planned movements of H actions in each of B scenes."""

    path: Numbers
    """Places of the hand at the given shares of the duration, shape (B, H, T, D), [m]."""
    duration: Numbers
    """Shape (B, H), [s]."""
    log_jerk: Numbers
    """Log of the jerk cost relative to the straight movement of the same duration, shape (B, H)."""
    effort: Numbers
    """Log jerk cost that the smoothness term of the reward weighs, shape (B, H).

    From rest it is relative to the zero action's; on the way 1 + the cost relative to a straight movement of NOMINAL.
    """


def planned(observation: Observation, actions: Numbers, task: Task, shares: Numbers) -> PlannedMovements:
    """Compute the movements that actions stand for.

    From rest they are those of :meth:`~viapoint.envs.actions.via_points.ActionLayout.decode`; where a movement may be
    under way (see :func:`is_replanning`) those of :class:`~viapoint.envs.actions.replanning.Reviser`.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: The environment's.
        shares: Fractions of the duration at which the path is wanted, in [0, 1], shape (T,).

    Example:
        >>> import gymnasium, numpy, viapoint.envs
        >>> env = gymnasium.make_vec("viapoint/PlanarObstacles-v0", num_envs=2).unwrapped
        >>> observation, _ = env.reset(seed=0)
        >>> planned(observation, numpy.zeros((2, 5, 3)), env.task, numpy.linspace(0, 1, 8)).path.shape
        (2, 5, 8, 2)
    """
    block = max(1, BLOCK // max(actions.shape[1] * len(shares), 1))
    if len(actions) > block:
        starts = range(0, len(actions), block)
        pieces = [
            _block(part(observation, slice(i, i + block)), actions[i : i + block], task, shares)
            for i in starts
        ]
        return PlannedMovements(*(np.concatenate(field) for field in zip(*pieces, strict=True)))
    return _block(observation, actions, task, shares)


def part(observation: Observation, rows: Any) -> Observation:
    """Select the observations at `rows`, an index array, slice or mask."""
    return {name: values[rows] for name, values in observation.items()}


def is_replanning(parts: Container[str]) -> bool:
    """Return whether decisions on observations with these parts revise a movement that may be under way."""
    return "remaining" in parts


def direction(observation: Observation) -> Numbers:
    """Return the vector from hand to goal, shape (B, D), [m]; on the way, along the first axis where it is short."""
    line: Numbers = observation["goal"] - observation["hand"]
    if not is_replanning(observation):
        return line
    short = (line * line).sum(axis=-1, keepdims=True) < MIN_GOAL_DISTANCE**2
    return np.where(short, MIN_GOAL_DISTANCE * np.eye(1, line.shape[-1], dtype=line.dtype), line)


def _block(observation: Observation, actions: Numbers, task: Task, shares: Numbers) -> PlannedMovements:
    if is_replanning(observation):
        return _revised(observation, actions, task, shares)
    if task.action.n_via == 1 and task.action.timing == "optimal":
        return _through_one(observation, actions, task, shares)
    start, goal = (_for_each(observation[name], actions) for name in ("hand", "goal"))
    plan = task.action.decode(actions.astype(np.float64), start, goal)
    return _sampled(plan.trajectory(), plan.durations.sum(axis=-1), goal - start, task, shares)


def _through_one(observation: Observation, actions: Numbers, task: Task, shares: Numbers) -> PlannedMovements:
    """Compute movements from rest through one via-point at its optimal time, in single precision.

    This is a second copy of what :meth:`~viapoint.envs.actions.via_points.Plan.trajectory` computes, for speed: 512
    paths at 24 instants take 0.23 ms instead of 0.82 ms, and 0.10 ms in batches, which is a third of a search. One
    kernel serves all dimensions, the Green's function of the sixth derivative with both ends at rest:

        x(tau) = x0 + D q(tau) + r g(tau),  r = E - D q(tau1),
        g = w^3 (6 w^2 + 15 w a + 10 a^2) / (6 p^5),  w = min(tau, tau1) - tau tau1,  a = |tau - tau1|,

    with p = tau1 (1 - tau1), E from start to via-point and D from start to goal.
    """
    layout, d = task.action, task.action.dimension
    line = np.asarray(observation["goal"] - observation["hand"], np.float32)
    square = (line * line).sum(axis=-1)[:, None]
    offsets = actions[..., :d].astype(np.float32) * np.asarray(layout.via_scale[:d], np.float32)
    along = 0.5 * np.sqrt(square) + offsets[..., 0]
    tau1 = _passage(along, (offsets[..., 1:] ** 2).sum(axis=-1), square)
    residual = offsets
    residual[..., 0] = along - np.sqrt(square) * _minimum_jerk(tau1)
    product = np.maximum(tau1 * (1.0 - tau1), np.float32(_LEAST_PRODUCT))
    log_jerk = np.log1p((residual * residual).sum(axis=-1) / (36.0 * square * product**5))
    axes = np.stack(frame(line), axis=1)
    kernel = _kernel(np.asarray(shares, np.float32)[:, None], tau1[:, None])
    bend = (residual @ axes / (6.0 * product**5)[..., None]).swapaxes(1, 2)
    straight = _minimum_jerk(np.asarray(shares, np.float32))[:, None]
    path = np.empty((len(actions), d, len(shares), actions.shape[1]), np.float32)
    for i in range(d):
        np.multiply(bend[:, i, None], kernel, out=path[:, i])
        path[:, i] += (
            np.asarray(observation["hand"], np.float32)[:, i, None, None] + line[:, i, None, None] * straight
        )
    low, high = layout.duration_range
    stretch = np.float32(0.5 * np.log(high / low)) * actions[..., d].astype(np.float32)
    duration = layout.centre_duration * np.exp(stretch)
    return PlannedMovements(path.transpose(0, 3, 2, 1), duration, log_jerk, log_jerk - 5.0 * stretch)


def _passage(along: Numbers, across_square: Numbers, square: Numbers) -> Numbers:
    """Return tau1 of via-points in the frame of start and goal, by the Newton iteration of the primitives."""
    length = np.sqrt(square)
    late = along > 0.5 * length
    near = np.where(late, length - along, along)
    root = nearer_fraction(near * length, square, near * near + across_square)
    return np.asarray(np.where(late, 1.0 - root, root))


def _minimum_jerk(tau: Numbers) -> Numbers:
    """Return 10 tau^3 - 15 tau^4 + 6 tau^5."""
    return np.asarray(tau * tau * tau * (10.0 + tau * (6.0 * tau - 15.0)))


def _kernel(tau: Numbers, tau1: Numbers) -> Numbers:
    """Return w^3 (6 w^2 + 15 w a + 10 a^2), shape (B, T, H), in few temporary arrays."""
    least = np.minimum(tau, tau1)
    apart = (tau + tau1) - 2.0 * least
    least -= tau * tau1
    bracket = 6.0 * least
    bracket += 15.0 * apart
    bracket *= least
    apart *= apart
    apart *= 10.0
    bracket += apart
    bracket *= least
    least *= least
    bracket *= least
    return np.asarray(bracket)


def _revised(observation: Observation, actions: Numbers, task: Task, shares: Numbers) -> PlannedMovements:
    """Compute movements from the present motion, by the rule of :class:`viapoint.envs.actions.replanning.Reviser`."""
    layout = task.action
    d, number = layout.dimension, layout.n_via
    place, velocity, acceleration, goal = (
        _for_each(observation[name], actions) for name in ("hand", "velocity", "acceleration", "goal")
    )
    line = direction(observation).astype(np.float64)
    axes = np.stack(frame(line), axis=1)[:, None]
    shape = (*actions.shape[:2], number, d)
    offsets = actions[..., : number * d].reshape(shape) * np.asarray(layout.via_scale[:d])
    vias = _for_each(observation["via"], actions).reshape(shape) + offsets @ axes if number else offsets
    duration = _revised_duration(observation, actions[..., number * d], layout)
    points = np.concatenate((place[:, :, None], vias, goal[:, :, None]), axis=2)
    began: Any = {"start_velocity": velocity, "start_acceleration": acceleration}
    durations = primitives.passage_durations(points, duration, **began)
    trajectory = primitives.through(points, durations, **began)
    found = _sampled(trajectory, duration, line[:, None], task, shares)
    cost = np.asarray(trajectory.cost()) * (layout.centre_duration**5 / (360.0 * NOMINAL**2))
    return found._replace(effort=np.log1p(cost))


def _revised_duration(observation: Observation, component: Numbers, layout: ActionLayout) -> Numbers:
    """Return the durations of revisions, shape (B, H), [s]."""
    low, high = layout.duration_range
    remaining = np.maximum(observation["remaining"].astype(np.float64), 0.5 * low)
    factor = np.exp(component * (0.5 * np.log(high / low)))
    return np.asarray(np.clip(remaining * factor, 0.5 * low, np.maximum(remaining, high)))


def _sampled(
    trajectory: primitives.Trajectory, duration: Numbers, line: Numbers, task: Task, shares: Numbers
) -> PlannedMovements:
    ratio = np.asarray(trajectory.cost()) * duration**5 / (360.0 * (line * line).sum(axis=-1))
    log_jerk = np.log(np.maximum(ratio, 1.0))
    path = np.asarray(trajectory(duration[..., None] * np.asarray(shares, np.float64)))
    effort = log_jerk - 5.0 * np.log(duration / task.action.centre_duration)
    return PlannedMovements(path, duration, log_jerk, effort)


def _for_each(values: Numbers, actions: Numbers) -> NDArray[np.float64]:
    """Repeat a part of B observations for H actions in each, shape (B, H, .), in double precision."""
    wide = values.astype(np.float64)[:, None]
    return np.broadcast_to(wide, (*actions.shape[:2], values.shape[-1]))
