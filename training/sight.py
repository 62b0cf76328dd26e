"""What can be seen of a planned movement: how near it comes to the obstacles, where, and whether the arm reaches.

All of it is an exact function of scene and path, of NumPy arrays and of torch tensors, and differentiable with respect
to the path. The nearest pair of points is searched for without gradients, over every body, obstacle and time; only the
pairs found are then differentiated.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs._arrays import clamp, namespace_of
from viapoint.envs.clearance import FAR, clearance_profile
from viapoint.envs.observation import ObstacleRows
from viapoint.envs.task import Task
from viapoint.training.approaches import Approaches, Obstacles, approaches

Array = Any
"""A NumPy array or a torch tensor."""
Observation = dict[str, Array]

STRETCHES = 16
"""Parts of equal duration, each with one nearest approach."""
LOOKS = 3
"""How often a movement is looked at in each of them."""
PHASES = STRETCHES * LOOKS
INSTANTS = np.arange(1, PHASES + 1, dtype=np.float32) / PHASES
"""Fractions of the duration at which a movement is looked at, shape (PHASES,)."""
NEAR = 0.06
"""Clearance from which on an obstacle no longer matters, [m]."""
_STEP = 1e-3
"""Of the difference quotient that tells where an obstacle pushes, [m]."""


class Sight(NamedTuple):
    """What is seen of H movements in each of B scenes."""

    clearance: Array
    """Least in each stretch, shape (B, H, STRETCHES), [m]."""
    reach_margin: Array
    """Least over the movement, shape (B, H), [m]."""


def see(observation: Observation, hand: Array, task: Task, duration: Array = None) -> Sight:
    """Clearance and reach of hand paths.

    Args:
        observation: Of B scenes.
        hand: Shape (B, H, PHASES, D), [m].
        task: The environment's.
        duration: Of the movements, shape (B, H), [s]; where obstacles move it must be known.
    """
    xp = namespace_of(hand)
    margin = xp.min(task.arm.reach_margin(hand), axis=-1)
    if "obstacles" not in observation:
        return Sight(xp.full_like(hand[..., LOOKS - 1 :: LOOKS, 0], FAR), margin)
    if among_links(task):
        return Sight(_seen_of_links(observation, hand, task, duration), margin)
    nearest, pairs = _nearest(observation, hand, task, duration)
    return Sight(_lowest(_clearance(nearest, pairs, task)[..., 0, :]), margin)


def push(observation: Observation, hand: Array, task: Task, duration: Array = None) -> tuple[Sight, Array]:
    """What is seen of hand paths, and where the nearest obstacle of each stretch pushes the hand.

    The push is the gradient of the clearance by difference quotients, the weaker the farther the obstacle, shape
    (B, H, STRETCHES, D).
    """
    xp = namespace_of(hand)
    margin = xp.min(task.arm.reach_margin(hand), axis=-1)
    if "obstacles" not in observation:
        at_ends = hand[..., LOOKS - 1 :: LOOKS, :]
        return Sight(xp.full_like(at_ends[..., 0], FAR), margin), xp.zeros_like(at_ends)
    if among_links(task):
        near = _approaches(observation, hand, task, duration, NEAR)
        return Sight(near.clearance, margin), near.gradient * _nearness(near.clearance)
    nearest, pairs = _nearest(observation, hand, task, duration)
    moves = xp.asarray(_STEP * np.eye(hand.shape[-1]), dtype=hand.dtype)
    around = xp.concat((nearest, nearest[..., 1:2, :] + moves), axis=-2)
    if pairs.drift is not None:
        same = xp.broadcast_to(pairs.drift[..., 1:2, :], (*pairs.drift.shape[:-2], *moves.shape))
        pairs = pairs._replace(drift=xp.concat((pairs.drift, same), axis=-2))
    clearance = _clearance(around, pairs, task)[..., 0, :]
    gradient = (clearance[..., 3:] - clearance[..., 1:2]) / _STEP
    lowest = _lowest(clearance[..., :3])
    return Sight(lowest, margin), gradient * _nearness(lowest)


def _nearness(clearance: Array) -> Array:
    """How much an obstacle matters, shape (..., 1)."""
    return clamp(1.0 - clearance / NEAR, 0.0, 1.5)[..., None]


def among_links(task: Task) -> bool:
    """Whether all links of an arm in space must clear: then looking everywhere would take too long."""
    return task.whole_arm and task.arm.dimension == 3


def _seen_of_links(observation: Observation, hand: Array, task: Task, duration: Array) -> Array:
    """Clearance in each stretch; with respect to the hand it is differentiated as if it changed in proportion."""
    if namespace_of(hand) is np:
        return _approaches(observation, hand, task, duration, -np.inf).clearance
    middle = hand[..., LOOKS // 2 :: LOOKS, :]
    near = _approaches(observation, hand, task, duration, NEAR if middle.requires_grad else -np.inf)
    clearance, gradient = (middle.new_tensor(part) for part in near)
    return clearance + (gradient * (middle - middle.detach())).sum(-1)


def _approaches(
    observation: Observation, hand: Array, task: Task, duration: Array, within: float
) -> Approaches:
    rows: ObstacleRows = task.observation.obstacles(_numbers(observation["obstacles"]))
    together = np.concatenate((rows.centre, rows.half_axis, rows.radius[..., None]), axis=-1)
    velocity, taken = None, None
    if "obstacle_velocities" in observation:
        velocity = _numbers(observation["obstacle_velocities"]).reshape(rows.centre.shape)
        taken = _numbers(duration)
    obstacles = Obstacles.packed(together, rows.present > 0.5, velocity)
    return approaches(task.arm, _numbers(hand), obstacles, STRETCHES, within, taken)


def _numbers(part: Array) -> Any:
    return part if type(part) is np.ndarray else part.detach().cpu().numpy()


class _Others(NamedTuple):
    """n obstacles."""

    rows: Array
    """Shape (..., n, 2 D + 1), [m]."""
    present: Array
    """Shape (..., n)."""
    drift: Array
    """How far each has moved at each time, shape (..., n, T, D), [m]; None where they stand."""


def _nearest(observation: Observation, hand: Array, task: Task, duration: Array) -> tuple[Array, _Others]:
    """Nearest approach of each stretch: the hand just before, at and after it, and the obstacle it is to.

    Shapes (B, H, STRETCHES, 3, D), and of obstacles (B, H, STRETCHES, 1, .).
    """
    xp = namespace_of(hand)
    rows: ObstacleRows = task.observation.obstacles(observation["obstacles"])
    obstacles = xp.concat((rows.centre, rows.half_axis, rows.radius[..., None]), axis=-1)
    present, moving = rows.present > 0.5, "obstacle_velocities" in observation
    every = _Others(obstacles[:, None], present[:, None], None)
    if moving:
        velocity = velocities(observation, rows.centre)
        times = _still(duration)[..., None] * xp.asarray(INSTANTS, dtype=hand.dtype)
        every = every._replace(drift=velocity[:, None, :, None] * times[:, :, None, :, None])
    profile = _clearance(_still(hand), every, task)
    profile = xp.reshape(profile, (*profile.shape[:3], STRETCHES, LOOKS))
    which = xp.argmin(_least_look(profile), axis=2)
    look = xp.argmin(xp.min(profile, axis=2), axis=-1)
    phase = LOOKS * xp.arange(STRETCHES) + look
    around = clamp(phase[..., None] + xp.arange(-1, 2), 0, PHASES - 1)
    nearest = _picked(hand, around, 2)
    pairs = _Others(_picked(obstacles, which, 1)[..., None, :], _picked(present, which, 1)[..., None], None)
    if moving:
        times = duration[..., None, None] * xp.asarray(INSTANTS, dtype=hand.dtype)[around]
        pairs = pairs._replace(
            drift=(_picked(velocity, which, 1)[..., None, :] * times[..., None])[..., None, :, :]
        )
    return nearest, pairs


def _least_look(profile: Array) -> Array:
    """Least of the looks of each stretch, shape (..., STRETCHES, LOOKS); NumPy's own reductions of few are slow."""
    looks = (profile[..., each] for each in range(LOOKS))
    return functools.reduce(namespace_of(profile).minimum, looks)


def _picked(values: Array, rows: Array, shared: int) -> Array:
    """Some rows of each of many arrays, as NumPy takes them fastest: from one plain list.

    Args:
        values: Shape (*lead, n, ...), with `shared` axes in `lead`.
        rows: Below n, shape (*lead, *some).
        shared: Number of leading axes.

    Returns:
        Shape (*lead, *some, ...).
    """
    xp, count = namespace_of(values), values.shape[shared]
    lead, rest = tuple(values.shape[:shared]), tuple(values.shape[shared + 1 :])
    first = count * xp.reshape(xp.arange(math.prod(lead)), lead + (1,) * (rows.ndim - shared))
    taken = xp.take(xp.reshape(values, (-1, *rest)), xp.reshape(rows + first, (-1,)), axis=0)
    return xp.reshape(taken, (*rows.shape, *rest))


def velocities(observation: Observation, like: Array) -> Array:
    """Of the obstacles, shape (B, n, D), [m/s]: as `like`."""
    return namespace_of(like).reshape(observation["obstacle_velocities"], like.shape)


def _still(values: Array) -> Array:
    """Values without gradients."""
    return values.detach() if hasattr(values, "detach") else values


def _lowest(three: Array) -> Array:
    """Lowest point of the parabola through three neighbouring values, shape (..., 3), where it lies between them."""
    xp = namespace_of(three)
    before, at, after = three[..., 0], three[..., 1], three[..., 2]
    slope, curvature = 0.5 * (after - before), after - 2.0 * at + before
    between = curvature > xp.abs(slope)
    drop = 0.5 * slope * slope / xp.where(between, curvature, xp.ones_like(curvature))
    return xp.where(between, at - drop, at)


def _clearance(hand: Array, others: _Others, task: Task) -> Array:
    """Of the hand and, where they count, the links, from each obstacle at each time, shape (..., n, T)."""
    arm, (rows, present, drift) = task.arm, others
    if not task.whole_arm:
        return clearance_profile(hand, arm.hand_radius, rows, present, drift=drift)
    links = arm.links(arm.posture(hand))
    return clearance_profile(hand, arm.hand_radius, rows, present, links, arm.link_radii, drift)
