"""Scenes that change during an episode: targets that jump, obstacles that move."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.scenes.scene import FASTEST, Problem, Scenes, problem, rest_clearance

if TYPE_CHECKING:
    from viapoint.envs.arms.base import CollisionModel

MOST_JUMPS = 4
"""Greatest number of jumps in an episode."""


class ChangingScenes(NamedTuple):
    """N scenes of up to n obstacles each, and their changes."""

    start: Float
    """Shape (N, D), [m]."""
    goal: Float
    """First target, shape (N, D), [m]."""
    obstacles: Float
    """Obstacles at the start: rows (centre D, half-axis D, radius), shape (N, n, 2 D + 1), [m]."""
    jumps: Float
    """Rows (time [s], target D [m]), in the order of time, shape (N, MOST_JUMPS, D + 1); absent rows are zero."""
    courses: Float
    """Rows (velocity D [m/s], time of the change of course [s], velocity D after it [m/s]), shape (N, n, 2 D + 1).

    The course is straight before and after. Where both velocities are the same there is no change, whatever the time.
    """

    @property
    def present(self) -> Bool:
        """Rows that are obstacles, shape (N, n); absent ones have no radius."""
        return self.obstacles[..., -1] > 0.0

    @property
    def turns(self) -> Bool:
        """Obstacles that change their course, shape (N, n)."""
        d = self.start.shape[-1]
        return np.asarray(self.present & (self.courses[..., :d] != self.courses[..., d + 1 :]).any(axis=-1))

    @property
    def jump_times(self) -> Float:
        """Times of the jumps, shape (N, MOST_JUMPS), [s]; infinite for none."""
        return np.where((self.jumps != 0.0).any(axis=-1), self.jumps[..., 0], np.inf)

    @property
    def turn_times(self) -> Float:
        """Times of the changes of course, shape (N, n), [s]; infinite for none."""
        return np.where(self.turns, self.courses[..., self.start.shape[-1]], np.inf)

    def take(self, rows: Any) -> ChangingScenes:
        """Return the scenes at `rows`, an index, slice or mask."""
        return ChangingScenes(*(field[rows] for field in self))

    def put(self, rows: Any, scenes: ChangingScenes) -> None:
        """Overwrite the scenes at `rows`."""
        for mine, theirs in zip(self, scenes, strict=True):
            mine[rows] = theirs

    def as_options(self) -> dict[str, Float]:
        """Return the scenes as options of `reset`."""
        return dict(self._asdict())

    def goals(self, time: Float) -> Float:
        """Return the targets, shape (N, D), [m], at one time for each scene, shape (N,), [s]; a jump counts at once."""
        number = (self.jump_times <= time[:, None] + 1e-9).sum(axis=-1)
        targets = np.concatenate((self.goal[:, None], self.jumps[..., 1:]), axis=1)
        return np.asarray(targets[np.arange(len(targets)), number])

    def places(self, time: Float, *, unturned: Float | None = None) -> Float:
        """Return obstacles at times of shape (N, T), [s], shape (N, T, n, 2 D + 1), [m].

        Changes of course after `unturned`, shape (N,), [s], are ignored, as they cannot be foreseen.
        """
        d = self.start.shape[-1]
        turn = self.turn_times
        if unturned is not None:
            turn = np.where(turn > unturned[:, None] + 1e-9, np.inf, turn)
        before = np.minimum(time[..., None], turn[:, None])[..., None]
        after = np.maximum(time[..., None] - turn[:, None], 0.0)[..., None]
        rows = np.repeat(self.obstacles[:, None], time.shape[1], axis=1)
        rows[..., :d] += self.courses[:, None, :, :d] * before + self.courses[:, None, :, d + 1 :] * after
        return rows

    def velocities(self, time: Float) -> Float:
        """Return velocities, shape (N, n, D), [m/s], at one time for each scene, shape (N,), [s]."""
        d = self.start.shape[-1]
        turned = (self.turn_times <= time[:, None] + 1e-9)[..., None]
        velocity = np.where(turned, self.courses[..., d + 1 :], self.courses[..., :d])
        return np.where(self.present[..., None], velocity, 0.0)

    def straight_length(self, time: Float) -> Float:
        """Return the length of the straight lines from target to target until a time for each, shape (N,), [m]."""
        length, before = norm(self.goal - self.start), self.goal
        for k in range(self.jumps.shape[1]):
            jumped = self.jump_times[:, k] <= time + 1e-9
            length = length + np.where(jumped, norm(self.jumps[:, k, 1:] - before), 0.0)
            before = np.where(jumped[:, None], self.jumps[:, k, 1:], before)
        return length

    def at(self, time: Float) -> Scenes:
        """Return the scenes at one time for each, shape (N,), [s]."""
        return Scenes(self.start, self.goals(time), self.places(time[:, None])[:, 0])


def problems_of_changes(
    scenes: ChangingScenes, collision_model: CollisionModel, *, time_limit: float
) -> Iterator[Problem]:
    """Yield the faults that the changes of N scenes can have; the scenes are possible at the start."""
    d = scenes.start.shape[-1]
    given, turns = (scenes.jumps != 0.0).any(axis=-1), scenes.turns

    def jump(_: int, row: int) -> str:
        return f"jump {row}"

    def course(_: int, row: int) -> str:
        return f"course {row}"

    lost = (scenes.courses != 0.0).any(axis=-1) & ~scenes.present
    yield problem(lost, "must belong to an obstacle", part=course)
    timed = ((given, scenes.jumps[..., 0], jump), (turns, scenes.courses[..., d], course))
    for there, time, part in timed:
        yield problem(there & (time <= 0.0), "must change after 0 s", time, part)
        yield problem(
            there & (time >= time_limit), f"must change before the time limit, {time_limit:g} s", time, part
        )
    late = np.zeros_like(given)
    late[:, 1:] = scenes.jump_times[:, 1:] <= scenes.jump_times[:, :-1]
    yield problem(given & late, "must be later than the one before it", scenes.jumps[..., 0], jump)
    for first in (0, d + 1):
        speed = np.sqrt((scenes.courses[..., first : first + d] ** 2).sum(axis=-1))
        yield problem(
            scenes.present & (speed > FASTEST), f"must be at most {FASTEST} m/s fast", speed, course
        )
    for k in range(scenes.jumps.shape[1]):
        goal = np.where(given[:, k, None], scenes.jumps[:, k, 1:], scenes.goal)
        margin = np.asarray(collision_model.arm.reach_margin(goal))
        yield problem(
            given[:, k] & (margin < 0.0),
            f"the target of jump {k} must be within the arm's reach: its margin must be 0 m or more",
            margin,
        )
        then = scenes.at(np.where(given[:, k], scenes.jumps[:, k, 0], 0.0))
        least = rest_clearance(then, goal, collision_model).min(axis=-1)
        yield problem(
            given[:, k] & (least <= 0.0),
            f"the target of jump {k} must be free when it appears: the arm's clearance must be over 0 m",
            least,
        )
