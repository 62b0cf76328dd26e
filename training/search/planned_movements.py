"""Planned movements of many actions at once: paths, durations and jerk, in NumPy and without gradients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs.actions.replanning import revised_waypoints
from viapoint.envs.actions.via_points import frame
from viapoint.envs.common.types import Numbers
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.mdp.observation import is_replanning
from viapoint.primitives._passage.rest_to_rest import STEPS, nearer_fraction

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task

Observation = Mapping[str, Numbers]

NOMINAL_DISTANCE = 0.3
"""Distance of the straight movement that the effort of the rest of a movement is compared with, [m]."""
PATH_BLOCK = 1 << 16
"""Hand positions that are computed together, so that temporary arrays stay in the cache."""
REVISED_PARTS = ("hand", "velocity", "acceleration", "goal", "via", "remaining")
"""Parts of an observation that determine the revised movement of an action."""
COARSE_STEPS = 3
"""Newton steps for passage times with a relative error of 1e-5."""
_LEAST_PRODUCT = 1e-6
"""Lower bound of tau1 (1 - tau1); below it the via-point coincides with an end and its residual vanishes."""


class PlannedMovements(NamedTuple):
    """Planned movements of H actions in each of B scenes."""

    path: Numbers
    """Hand positions at the given fractions of the duration, shape (B, H, T, D), [m]."""
    duration: Numbers
    """Shape (B, H), [s]."""
    log_jerk: Numbers
    """Log of the jerk cost relative to the straight movement of the same duration, shape (B, H)."""
    effort: Numbers
    """Log jerk cost that the smoothness term of the reward weighs, shape (B, H).

    From rest it is relative to the zero action. In motion it is log(1 + cost / cost of a straight movement of
    NOMINAL_DISTANCE in the centre duration).
    """


def plan_movements(
    observation: Observation, actions: Numbers, task: Task, fractions: Numbers, *, coarse: bool = False
) -> PlannedMovements:
    """Compute the movements that actions stand for.

    From rest they are those of :meth:`~viapoint.envs.actions.via_points.ActionLayout.decode`; where a movement may be
    under way (see :func:`is_replanning`) those of :class:`~viapoint.envs.actions.replanning.ReplanningDecoder`.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        fractions: Fractions of the duration at which the path is sampled, in [0, 1], shape (T,).
        coarse: Compute passage times to a relative error of 1e-5, in less time; for one via-point at its optimal time.
    """
    block = max(1, PATH_BLOCK // max(actions.shape[1] * len(fractions), 1))
    if len(actions) > block:
        blocks = [slice(i, i + block) for i in range(0, len(actions), block)]
        pieces = [
            _plan_block(take_rows(observation, rows), actions[rows], task, fractions, coarse)
            for rows in blocks
        ]
        return PlannedMovements(*(np.concatenate(field) for field in zip(*pieces, strict=True)))
    return _plan_block(observation, actions, task, fractions, coarse)


def take_rows(observation: Observation, rows: Any) -> Observation:
    """Select the observations at `rows`, an index array, slice or mask."""
    return {name: values[rows] for name, values in observation.items()}


def direction(observation: Observation) -> Numbers:
    """Return the vector from hand to goal, shape (B, D), [m]; when replanning, short ones become the first axis."""
    line: Numbers = observation["goal"] - observation["hand"]
    if not is_replanning(observation):
        return line
    short = (line * line).sum(axis=-1, keepdims=True) < MIN_GOAL_DISTANCE**2
    return np.where(short, MIN_GOAL_DISTANCE * np.eye(1, line.shape[-1], dtype=line.dtype), line)


def _plan_block(
    observation: Observation, actions: Numbers, task: Task, fractions: Numbers, coarse: bool
) -> PlannedMovements:
    if is_replanning(observation):
        return _revised(observation, actions, task, fractions)
    if task.action.n_via == 1 and task.action.timing == "optimal":
        return _through_one(observation, actions, task, fractions, coarse)
    shape = (*actions.shape[:2], task.action.dimension)
    start, goal = (
        np.broadcast_to(observation[name].astype(np.float64)[:, None], shape) for name in ("hand", "goal")
    )
    plan = task.action.decode(actions.astype(np.float64), start, goal)
    trajectory, duration = plan.trajectory(), plan.durations.sum(axis=-1)
    return _sampled(trajectory, np.asarray(trajectory.cost()), duration, goal - start, task, fractions)


def _through_one(
    observation: Observation, actions: Numbers, task: Task, fractions: Numbers, coarse: bool
) -> PlannedMovements:
    """Compute movements from rest through one via-point at its optimal time, in single precision.

    This is a second copy of what :meth:`~viapoint.envs.actions.via_points.Plan.trajectory` computes, for speed: 512
    paths at 24 instants take 0.23 ms instead of 0.82 ms, and 0.10 ms in batches, which is a third of a search. One
    kernel serves all dimensions, the Green's function of the sixth derivative with both ends at rest:

        (1)  x(tau) = x0 + D q(tau) + r g(tau),  r = E - D q(tau1)
        (2)  g = w^3 (6 w^2 + 15 w a + 10 a^2) / (6 p^5),  w = min(tau, tau1) - tau tau1,  a = |tau - tau1|
        (3)  J / J_straight = 1 + |r|^2 / (36 |D|^2 p^5)

    with p = tau1 (1 - tau1), E from start to via-point and D from start to goal.
    """
    layout, d = task.action, task.action.dimension
    line = np.asarray(observation["goal"] - observation["hand"], np.float32)
    square = (line * line).sum(axis=-1)[:, None]
    offsets = actions[..., :d].astype(np.float32) * np.asarray(layout.via_scale[:d], np.float32)
    along = 0.5 * np.sqrt(square) + offsets[..., 0]
    tau1 = _passage_time(along, (offsets[..., 1:] ** 2).sum(axis=-1), square, coarse)
    residual = offsets  # r of (1), in the frame of start and goal
    residual[..., 0] = along - np.sqrt(square) * _minimum_jerk(tau1)
    product = np.maximum(tau1 * (1.0 - tau1), np.float32(_LEAST_PRODUCT))
    log_jerk = np.log1p((residual * residual).sum(axis=-1) / (36.0 * square * product**5))  # (3)
    axes = np.stack(frame(line), axis=1)
    kernel = _kernel(np.asarray(fractions, np.float32)[:, None], tau1[:, None])
    bend = (residual @ axes / (6.0 * product**5)[..., None]).swapaxes(1, 2)
    straight = _minimum_jerk(np.asarray(fractions, np.float32))[:, None]
    path = np.empty((len(actions), d, len(fractions), actions.shape[1]), np.float32)
    hand = np.asarray(observation["hand"], np.float32)
    for i in range(d):  # (1), one axis at a time: the arrays stay in the cache
        np.multiply(bend[:, i, None], kernel, out=path[:, i])
        path[:, i] += hand[:, i, None, None] + line[:, i, None, None] * straight
    low, high = layout.duration_range
    stretch = np.float32(0.5 * np.log(high / low)) * actions[..., d].astype(np.float32)
    duration = layout.centre_duration * np.exp(stretch)
    return PlannedMovements(path.transpose(0, 3, 2, 1), duration, log_jerk, log_jerk - 5.0 * stretch)


def _passage_time(along: Numbers, across_square: Numbers, square: Numbers, coarse: bool) -> Numbers:
    """Return tau1 of via-points in the frame of start and goal, by the Newton iteration of the primitives."""
    length = np.sqrt(square)
    late = along > 0.5 * length
    near = np.where(late, length - along, along)
    least = near * near + across_square
    root = nearer_fraction(near * length, square, least, steps=COARSE_STEPS if coarse else STEPS)
    return np.asarray(np.where(late, 1.0 - root, root))


def _minimum_jerk(tau: Numbers) -> Numbers:
    """Return q(tau) = 10 tau^3 - 15 tau^4 + 6 tau^5 (Flash & Hogan 1985, Eq. 2)."""
    return np.asarray(tau * tau * tau * (10.0 + tau * (6.0 * tau - 15.0)))


def _kernel(tau: Numbers, tau1: Numbers) -> Numbers:
    """Return w^3 (6 w^2 + 15 w a + 10 a^2) of (2), shape (B, T, H), in few temporary arrays."""
    least = np.minimum(tau, tau1)
    apart = (tau + tau1) - 2.0 * least  # a
    least -= tau * tau1  # w
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


def _revised(observation: Observation, actions: Numbers, task: Task, fractions: Numbers) -> PlannedMovements:
    """Compute movements from the present motion, see :class:`viapoint.envs.actions.replanning.ReplanningDecoder`."""
    layout = task.action
    seen = {name: observation[name].astype(np.float64)[:, None] for name in REVISED_PARTS}
    line = direction(observation).astype(np.float64)[:, None]
    vias = seen["via"].reshape(len(actions), 1, layout.n_via, layout.dimension)
    points, duration = revised_waypoints(
        layout, line, seen["hand"], vias, seen["goal"], seen["remaining"][..., 0], actions
    )
    shape = (*actions.shape[:2], layout.dimension)
    motion: Any = {
        f"start_{name}": np.broadcast_to(seen[name], shape) for name in ("velocity", "acceleration")
    }
    passage = primitives.passage_durations(points, duration, **motion)
    trajectory = primitives.through(points, passage, **motion)
    cost = np.asarray(trajectory.cost())
    relative = cost * (layout.centre_duration**5 / (360.0 * NOMINAL_DISTANCE**2))
    found = _sampled(trajectory, cost, duration, line, task, fractions)
    return found._replace(effort=np.log1p(relative))


def _sampled(
    trajectory: primitives.Trajectory,
    cost: Numbers,
    duration: Numbers,
    line: Numbers,
    task: Task,
    fractions: Numbers,
) -> PlannedMovements:
    """Sample trajectories; the straight movement over a distance A in T has the jerk cost 360 A^2 / T^5."""
    ratio = cost * duration**5 / (360.0 * (line * line).sum(axis=-1))
    log_jerk = np.log(np.maximum(ratio, 1.0))
    path = np.asarray(trajectory(duration[..., None] * np.asarray(fractions, np.float64)))
    effort = log_jerk - 5.0 * np.log(duration / task.action.centre_duration)
    return PlannedMovements(path, duration, log_jerk, effort)
