"""Spheres, posts and bars in space, and what is built of them: rows (centre 3, half-axis 3, radius 1), in [m]."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.types import Float
from viapoint.envs.scenes.config import BEAMS, BOARDS, SpaceDistribution

PARTS = 6
"""Rows of a structure at most."""
NUMBERS = 6
"""Uniform numbers that make one structure or one obstacle."""


class Course(NamedTuple):
    """Where the hand would go in N scenes, and the place on the way where something is built."""

    start: Float
    """Shape (N, 1, 3), [m]."""
    goal: Float
    """Shape (N, 1, 3), [m]."""
    place: Float
    """On the movement that is kept clear, shape (N, K, 3), [m]."""
    heading: Float
    """Horizontal direction of the movement there, shape (N, K, 3)."""
    top: Float
    """Height of the links above the hand there, shape (N, K), [m]."""
    hardness: Float
    """Shape (N, 1), in [0, 1]."""

    def on_line(self, fraction: Float) -> Float:
        """Places on the straight line, shape (N, K, 3), [m]."""
        return np.asarray(self.start + (self.goal - self.start) * fraction[..., None])

    def take(self, rows: Any) -> Course:
        """The scenes at `rows`, an index, slice or mask."""
        return Course(*(part[rows] for part in self))


class Built(NamedTuple):
    """What is built at K places of N scenes."""

    rows: Float
    """Shape (N, K, PARTS, 7), [m]; parts that are not needed are zero."""
    retreat: Float
    """Directions in which parts make room, shape (N, K, PARTS, 3)."""


def structure(family: str, d: SpaceDistribution, course: Course, u: Float, hand_radius: float) -> Built:
    """What a family builds at K places.

    Args:
        family: One of :data:`~viapoint.envs.scenes.config.FAMILIES`.
        d: Sizes.
        course: Where the hand would go.
        u: Uniform numbers, shape (N, K, NUMBERS).
        hand_radius: [m].
    """
    rows, retreat = np.zeros((*u.shape[:2], PARTS, 7)), np.zeros((*u.shape[:2], PARTS, 3))
    retreat[..., 2] = -1.0
    if family == "clutter":
        rows[:, :, 0] = single(d, course.on_line(0.25 + 0.5 * u[..., 0]) + 0.06 * (u[..., 3:6] - 0.5), u)
    elif family == "pillar":
        foot = course.on_line(0.3 + 0.4 * u[..., 0])
        radius = _between(d.pillar_radius, u[..., 1])
        side = 0.06 * (u[..., 2] - 0.5)
        top = foot[..., 2] + 0.15 * u[..., 3]
        rows[:, :, 0] = _post(foot + _left(course.heading) * side[..., None], top, radius)
    else:
        below = hand_radius + d.link_margin + 0.005 + 0.06 * u[..., 0] * (1.0 - course.hardness)
        rows[:, :, :3] = (_shelf if family in BOARDS else _gate)(d, course, u, below)
    if family in ("clutter", "pillar"):
        top = rows[:, :, 0, :3] + rows[:, :, 0, 3:6]
        away = top - course.place
        retreat[:, :, 0] = away / np.maximum(np.sqrt((away**2).sum(axis=-1, keepdims=True)), 1e-6)
    elif family not in BOARDS:
        aside = np.stack((-_left(course.heading), _left(course.heading)), axis=-2)
        retreat[:, :, :2] = retreat[:, :, 4:] = aside
    if family in BEAMS:
        rows[:, :, 3] = _beam(d, course, u)
        retreat[:, :, 3, 2] = 1.0
    if family == "tunnel":
        rows[:, :, 4:] = rows[:, :, :2]
        rows[:, :, 4:, :3] += d.tunnel_length * course.heading[:, :, None]
    return Built(rows, retreat)


def single(d: SpaceDistribution, centre: Float, u: Float) -> Float:
    """A sphere, a post or a bar at each of K places, shape (N, K, 7)."""
    kind, size, turn, tilt = u[..., 0] * 97.0 % 1.0, u[..., 1], 2.0 * np.pi * u[..., 2], u[..., 3] - 0.5
    half = _between(d.bar_half_length, u[..., 4])
    level = np.stack((np.cos(turn), np.sin(turn), 2.0 * tilt), axis=-1)
    axis = half[..., None] * level / np.sqrt((level**2).sum(axis=-1, keepdims=True))
    bar = _row(centre, axis, _between(d.bar_radius, size))
    sphere = _row(centre, np.zeros_like(centre), _between(d.sphere_radius, size))
    post = _post(centre, centre[..., 2] + 0.1 * u[..., 5], _between(d.post_radius, size))
    return np.where((kind < 0.35)[..., None], sphere, np.where((kind < 0.65)[..., None], post, bar))


def _shelf(d: SpaceDistribution, course: Course, u: Float, below: Float) -> Float:
    """Three bars side by side under the movement, roughly across it."""
    radius = _between(d.bar_radius, u[..., 1])
    half = _between(d.board_half_length, u[..., 2])
    turn = 1.2 * (u[..., 3] - 0.5)
    across = np.cos(turn)[..., None] * _left(course.heading) + np.sin(turn)[..., None] * course.heading
    middle = course.place + 0.04 * (u[..., 4:5] - 0.5) * course.heading
    middle = np.concatenate((middle[..., :2], (middle[..., 2] - below - radius)[..., None]), axis=-1)
    bars = [
        _row(middle - side * d.board_spacing * _left(across), half[..., None] * across, radius)
        for side in (-1.0, 0.0, 1.0)
    ]
    return np.stack(bars, axis=-2)


def _gate(d: SpaceDistribution, course: Course, u: Float, below: Float) -> Float:
    """Two posts, on either side of the movement, and a sill under it."""
    radius, sill = _between(d.post_radius, u[..., 1]), _between(d.bar_radius, u[..., 2])
    width = _between(d.gate_half_width, u[..., 3] * (1.0 - course.hardness))
    across = _left(course.heading)
    middle = course.place + (0.04 * (u[..., 4] - 0.5))[..., None] * across
    top = course.place[..., 2] + 0.12 * u[..., 5]
    posts = [_post(middle + (side * width)[..., None] * across, top, radius) for side in (-1.0, 1.0)]
    low = np.concatenate((middle[..., :2], (course.place[..., 2] - below - sill)[..., None]), axis=-1)
    return np.stack((*posts, _row(low, width[..., None] * across, sill)), axis=-2)


def _beam(d: SpaceDistribution, course: Course, u: Float) -> Float:
    """A bar over the links above the hand, across the movement, from near the arm's base outwards."""
    radius, half = _between(d.bar_radius, u[..., 5]), _between(d.beam_half_length, u[..., 2])
    out = _left(course.heading)
    out = np.where((out * course.place).sum(axis=-1, keepdims=True) < 0.0, -out, out)
    height = course.top + d.link_margin + radius
    middle = course.place + (half - d.beam_overlap)[..., None] * out
    return _row(np.concatenate((middle[..., :2], height[..., None]), axis=-1), half[..., None] * out, radius)


def _post(centre: Float, top: Float, radius: Float) -> Float:
    """Posts that stand on the table."""
    top = np.maximum(top, radius + 0.02)
    middle = np.stack((centre[..., 0], centre[..., 1], 0.5 * (top + radius)), axis=-1)
    nothing = np.zeros_like(top)
    return _row(middle, np.stack((nothing, nothing, 0.5 * (top - radius)), axis=-1), radius)


def _row(centre: Float, axis: Float, radius: Float) -> Float:
    return np.concatenate((centre, axis, radius[..., None]), axis=-1)


def _left(heading: Float) -> Float:
    """Horizontal directions turned by a quarter to the left."""
    return np.stack((-heading[..., 1], heading[..., 0], np.zeros_like(heading[..., 0])), axis=-1)


def _between(bounds: tuple[float, float], u: Any) -> Any:
    return bounds[0] + (bounds[1] - bounds[0]) * u
