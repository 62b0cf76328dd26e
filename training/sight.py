"""What can be seen of a planned movement: how near it comes to the obstacles, where, and whether the arm reaches.

All of it is a function of scene and path, of NumPy arrays and of torch tensors, and differentiable with respect
to the path. The nearest pair of points is searched for without gradients, over every body, obstacle and time; only the
pairs found are then differentiated.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs._arrays import clamp, namespace_of
from viapoint.envs.clearance import FAR, clearance_profile, links_profile
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
_ORDER = np.arange(PHASES).reshape(STRETCHES, LOOKS).T.ravel()
INSTANTS = (_ORDER + 1).astype(np.float32) / PHASES
"""Fractions of the duration at which a movement is looked at, the first looks of all stretches first, shape (PHASES,).

So looks of different stretches, of which the least is asked for, are far apart in memory, and each kind is together.
"""
_PLACE = np.argsort(_ORDER)
"""Of each instant among them, in the order of time, shape (PHASES,)."""
_BESIDE = _PLACE[np.clip(np.add.outer([-1, 0, 1], _ORDER), 0, PHASES - 1)]
"""Numbers of the instants just before, at and after each, shape (3, PHASES)."""
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
        return Sight(xp.full_like(hand[..., -STRETCHES:, 0], FAR), margin)
    if among_links(task):
        return Sight(_seen_of_links(observation, hand, task, duration), margin)
    near = _nearest(observation, hand, task, duration)
    if getattr(hand, "requires_grad", False):
        around = _picked(hand, near.instants, 2)
        return Sight(_lowest(_beside(around, near, observation, task, duration)), margin)
    return Sight(_lowest(near.clearance), margin)


def push(observation: Observation, hand: Array, task: Task, duration: Array = None) -> tuple[Sight, Array]:
    """What is seen of hand paths, and where the nearest obstacle of each stretch pushes the hand.

    The push is the gradient of the clearance by difference quotients, the weaker the farther the obstacle, shape
    (B, H, STRETCHES, D).
    """
    xp = namespace_of(hand)
    margin = xp.min(task.arm.reach_margin(hand), axis=-1)
    if "obstacles" not in observation:
        at_ends = hand[..., -STRETCHES:, :]
        return Sight(xp.full_like(at_ends[..., 0], FAR), margin), xp.zeros_like(at_ends)
    if among_links(task):
        near = _approaches(observation, hand, task, duration, NEAR)
        return Sight(near.clearance, margin), near.gradient * _nearness(near.clearance)
    nearest = _nearest(observation, hand, task, duration)
    lowest, at = _lowest(nearest.clearance), nearest.only_at()
    moves = xp.asarray(_STEP * np.eye(hand.shape[-1])[:, None], dtype=hand.dtype)
    moved = _picked(hand, at.instants, 2) + moves
    gradient = (_beside(moved, at, observation, task, duration) - at.clearance) / _STEP
    return Sight(lowest, margin), xp.moveaxis(gradient, 2, -1) * _nearness(lowest)


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
    middle = hand[..., LOOKS // 2 * STRETCHES :, :][..., :STRETCHES, :]
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
    in_order = _numbers(hand)[..., _PLACE, :]
    return approaches(task.arm, in_order, obstacles, STRETCHES, within, taken)


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


class _Nearest(NamedTuple):
    """The nearest approach of each stretch, just before, at and after it."""

    clearance: Array
    """Shape (B, H, 3, STRETCHES), [m]."""
    instants: Array
    """Numbers of the instants of the path, shape (B, H, 3, STRETCHES)."""
    obstacle: Array
    """Number of the one it is to, shape (B, H, STRETCHES)."""

    def only_at(self) -> _Nearest:
        """Not before and after."""
        return _Nearest(self.clearance[:, :, 1:2], self.instants[:, :, 1:2], self.obstacle)


def _nearest(observation: Observation, hand: Array, task: Task, duration: Array) -> _Nearest:
    """Searched for without gradients, over every obstacle and instant."""
    xp = namespace_of(hand)
    rows, present = _rows(observation, task)
    every = _Others(rows[:, None], present[:, None], None)
    if "obstacle_velocities" in observation:
        velocity = velocities(observation, rows[..., : hand.shape[-1]])
        times = _still(duration)[..., None] * xp.asarray(INSTANTS, dtype=hand.dtype)
        every = every._replace(drift=velocity[:, None, :, None] * times[:, :, None, :, None])
    profile = _clearance(_still(hand), every, task)
    looks = xp.reshape(profile, (*profile.shape[:3], LOOKS, STRETCHES))
    which = xp.argmin(_least_look(looks), axis=2)
    look = xp.argmin(xp.min(looks, axis=2), axis=2)
    at = STRETCHES * look + xp.arange(STRETCHES)
    instants = xp.moveaxis(xp.asarray(_BESIDE)[:, at], 0, 2)
    by_pair = xp.reshape(profile, (*profile.shape[:2], -1))
    return _Nearest(_picked(by_pair, PHASES * which[:, :, None] + instants, 2), instants, which)


def _beside(places: Array, near: _Nearest, observation: Observation, task: Task, duration: Array) -> Array:
    """Clearance of places of the hand from the obstacle of their stretch at some instants of the path.

    Args:
        places: Shape (B, H, M, STRETCHES, D), [m].
        near: With instants of shape (B, H, M, STRETCHES), or of one for all M.
        observation: Of B scenes.
        task: The environment's.
        duration: Of the movements, shape (B, H), [s].

    Returns:
        Shape (B, H, M, STRETCHES), [m].
    """
    xp, (rows, present) = namespace_of(places), _rows(observation, task)
    chosen, shown = (_picked(part, near.obstacle, 1)[:, :, None, :, None] for part in (rows, present))
    drift = None
    if "obstacle_velocities" in observation:
        velocity = _picked(velocities(observation, rows[..., : places.shape[-1]]), near.obstacle, 1)
        times = duration[..., None, None] * xp.asarray(INSTANTS, dtype=places.dtype)[near.instants]
        drift = (velocity[:, :, None] * times[..., None])[..., None, None, :]
    return _clearance(places[..., None, :], _Others(chosen, shown, drift), task)[..., 0, 0]


def _rows(observation: Observation, task: Task) -> tuple[Array, Array]:
    """Obstacles, shape (B, n, 2 D + 1), [m], and which are there, shape (B, n)."""
    rows: ObstacleRows = task.observation.obstacles(observation["obstacles"])
    together = namespace_of(rows.centre).concat(
        (rows.centre, rows.half_axis, rows.radius[..., None]), axis=-1
    )
    return together, rows.present > 0.5


def _least_look(profile: Array) -> Array:
    """Least of the looks of each stretch, shape (..., LOOKS, STRETCHES); NumPy's own reductions of few are slow."""
    looks = (profile[..., each, :] for each in range(LOOKS))
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
    """Lowest point of the parabola through neighbouring values, shape (B, H, 3, .), where it lies between them."""
    xp = namespace_of(three)
    before, at, after = three[:, :, 0], three[:, :, 1], three[:, :, 2]
    slope, curvature = 0.5 * (after - before), after - 2.0 * at + before
    between = curvature > xp.abs(slope)
    drop = 0.5 * slope * slope / xp.where(between, curvature, xp.ones_like(curvature))
    return xp.where(between, at - drop, at)


def _clearance(hand: Array, others: _Others, task: Task) -> Array:
    """Of the hand and, where they count, the links, from each obstacle at each time, shape (..., n, T)."""
    arm, (rows, present, drift) = task.arm, others
    if not task.whole_arm:
        return clearance_profile(hand, arm.hand_radius, rows, present, drift=drift)
    quick = getattr(arm, "links_at", None)
    if quick is None:
        links = arm.links(arm.posture(hand))
        return clearance_profile(hand, arm.hand_radius, rows, present, links, arm.link_radii, drift)
    nearest = links_profile(quick(hand), arm.link_radii, rows, present, drift)
    if arm.hand_radius <= arm.link_radii[-1]:  # it is inside the end of the last link
        return nearest
    alone = clearance_profile(hand, arm.hand_radius, rows, present, drift=drift)
    return namespace_of(hand).minimum(nearest, alone)
