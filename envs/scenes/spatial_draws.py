"""Random numbers, starts, goals and paths of spatial scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from viapoint.envs.actions.via_points import ActionLayout
from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.scenes.config import SpaceDistribution

GROUPS = (1, 2, 4, *[8] * 400)
"""How many attempts follow one another: few are left after the first, but one in a hundred makes a tunnel."""
AHEAD = 32
"""Attempts of all scenes that are looked at together where one group of each makes fewer."""


class Numbers:
    """Numbers for attempts at N scenes."""

    def __init__(self, generators: Sequence[np.random.Generator], size: int) -> None:
        """From N generators, `size` numbers for each attempt; of a generator that several share none go ahead."""
        self._generators, self._size = generators, size
        self._apart = len({id(each.bit_generator) for each in generators}) == len(generators)
        self._group = 0
        self._groups: tuple[int, ...] = ()
        self._states: list[list[Any]] = []

    @property
    def made(self) -> int:
        """How many attempts at each scene there have been."""
        return sum(GROUPS[: self._group])

    def draw(self, scenes: Int) -> Float:
        """Of the next attempts at P scenes, shape (P, attempts, size); none after the last group."""
        self._groups = GROUPS[self._group :][:1]
        ahead = GROUPS[self._group + 1 :] if self._apart else ()
        for attempts in ahead:
            if len(scenes) * (sum(self._groups) + attempts) > AHEAD:
                break
            self._groups += (attempts,)
        self._group += len(self._groups)
        drawn = np.empty((len(scenes), sum(self._groups), self._size))
        self._states = [
            self._fill(self._generators[int(i)], each) for i, each in zip(scenes, drawn, strict=True)
        ]
        return drawn

    def put_back(self, scenes: Int, first: Int) -> None:
        """Have the generators of P scenes as the group of the first good attempt left them, shape (P,); -1 for none."""
        ends = np.cumsum(self._groups)
        for i, states, attempt in zip(scenes, self._states, first, strict=True):
            if 0 <= attempt < ends[-1] - self._groups[-1]:
                self._generators[int(i)].bit_generator.state = states[int((attempt >= ends).sum())]

    def _fill(self, generator: np.random.Generator, drawn: Float) -> list[Any]:
        """Fill the rows of each group; the states of the generator after all but the last."""
        states, begin = [], 0
        for attempts in self._groups:
            if begin:
                states.append(generator.bit_generator.state)
            generator.random(out=drawn[begin : begin + attempts])
            begin += attempts
        return states


ENDS, WITNESSES, PHASES = 12, 8, 16
"""How many pairs of ends and witnesses are drawn at once, and at how many times a movement is looked at."""
FIRST = 2
"""Witnesses that are looked at before the others: mostly one of them is good."""


def draw_ends(
    u: Float, arm: Arm, d: SpaceDistribution, ends: tuple[Float, Float] | None
) -> tuple[Float, Float, Bool]:
    """Starts and goals inside the workspace with the straight line between them inside the reach, and which are good.

    Args:
        u: Uniform numbers, shape (N, ENDS, 6).
        arm: Whose hand moves.
        d: Distances, steepness and margin.
        ends: Given ones, NaN where they are to be drawn.
    """
    low, high = (np.array(corner) for corner in arm.workspace)
    start = low + (high - low) * u[..., :3]
    height, angle = d.steepness * (2.0 * u[..., 3] - 1.0), 2.0 * np.pi * u[..., 4]
    level = np.sqrt(1.0 - height**2)
    shortest, longest = d.distance
    step = np.stack((level * np.cos(angle), level * np.sin(angle), height), axis=-1)
    if ends is not None:
        start = np.where(np.isnan(ends[0])[:, None], start, ends[0][:, None])
    goal = start + (shortest + (longest - shortest) * u[..., 5:6]) * step
    good: Any = ((goal >= low) & (goal <= high)).all(axis=-1)
    if ends is not None:
        goal = np.where(np.isnan(ends[1])[:, None], goal, ends[1][:, None])
        good |= np.isfinite(ends[1][:, :1])
    first, last = start[good], goal[good]
    line = first[:, None, :] + (last - first)[:, None, :] * np.linspace(0.0, 1.0, 5)[:, None]
    good[good] = arm.reach_margin(line).min(axis=-1) > d.reach_margin
    each, chosen = np.arange(len(u)), good.argmax(axis=-1)
    return start[each, chosen], goal[each, chosen], good.any(axis=-1)


def draw_path(
    u: Float, arm: Arm, ends: tuple[Float, Float], reach_margin: float, above: Bool
) -> tuple[Float, Bool]:
    """Hand path of the first movement through one via-point inside the reach, shape (N, PHASES, 3), and which have one.

    Args:
        u: Uniform numbers, shape (N, WITNESSES, 3).
        arm: Whose hand moves.
        ends: Starts and goals, shape (N, 3) each, [m].
        reach_margin: How far inside the reach the hand stays, [m].
        above: Whether the movement passes above the straight line, or anywhere, shape (N,).
    """
    path, good = _first_path(u[:, :FIRST], arm, ends, reach_margin, above)
    left = np.flatnonzero(~good)
    if len(left):
        between = ends[0][left], ends[1][left]
        path[left], good[left] = _first_path(u[left, FIRST:], arm, between, reach_margin, above[left])
    return path, good


def _first_path(
    u: Float, arm: Arm, ends: tuple[Float, Float], reach_margin: float, above: Bool
) -> tuple[Float, Bool]:
    """The same of some witnesses."""
    angle = np.pi * np.where(above[:, None], 0.25 + 0.5 * u[..., 0], 1.3 * u[..., 0] - 0.15)
    size = 0.45 + 0.5 * u[..., 1]
    along = u[..., 2] - 0.5
    action = np.stack((along, size * np.cos(angle), size * np.sin(angle), np.zeros_like(along)), axis=-1)
    start, goal = (np.broadcast_to(end[:, None], (*action.shape[:2], 3)) for end in ends)
    plan = ActionLayout(dimension=arm.dimension).decode(action, start, goal)
    paths = plan.trajectory()(plan.durations.sum(axis=-1)[..., None] * np.linspace(0.0, 1.0, PHASES))
    good = (arm.reach_margin(paths) > reach_margin).all(axis=-1)
    first = good.argmax(axis=-1)
    return paths[np.arange(len(first)), first], good.any(axis=-1)
