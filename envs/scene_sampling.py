"""Drawing scenes in which the straight movement hits something and a via-point movement does not.

A scene is a function of a row of uniform numbers, the same count for every attempt, so each environment draws from its
own generator and all of them are computed together. That a scene can be solved is built in: first a movement through
a via-point is drawn, the witness, then obstacles are placed clear of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.action import ActionLayout, check_increasing_pair
from viapoint.envs.arms.arm import Arm
from viapoint.envs.clearance import arm_clearance, hand_clearance, segment_distance_squared
from viapoint.envs.scenes import Scenes

Float = NDArray[np.float64]

ENDS, WITNESSES, CANDIDATES, PHASES = 16, 6, 24, 40
"""How many pairs of ends, witnesses and obstacles are drawn at once, and at how many times a movement is looked at."""
ATTEMPTS = 200


@dataclass(frozen=True, kw_only=True)
class SceneDistribution:
    """What scenes are like."""

    n_obstacles: tuple[int, int] = (1, 5)
    """Fewest and most obstacles."""
    distance: tuple[float, float] = (0.25, 0.45)
    """From start to goal, [m]."""
    post_radius: tuple[float, float] = (0.010, 0.035)
    """[m]."""
    bar_radius: tuple[float, float] = (0.006, 0.010)
    """[m]."""
    bar_half_length: tuple[float, float] = (0.03, 0.125)
    """[m]; the rows of lights of Flash & Hogan 1985 were up to 0.25 m long."""
    bar_tilt: float = 0.6
    """Greatest angle between a bar and the perpendicular of the straight line, [rad]."""
    spread: float = 0.16
    """Greatest distance of an obstacle's centre from the straight line, [m]."""
    witness_margin: float = 0.012
    """Least clearance of the witness, [m]: what sampling times and tracking may cost, and to spare."""
    end_margin: float = 0.025
    """Least clearance of the arm at start and goal, [m]."""
    reach_margin: float = 0.03
    """How far inside the arm's reach start, goal and witness stay, [m]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be sampled."""
        fewest, most = self.n_obstacles
        if not 0 <= fewest <= most <= CANDIDATES // 2:
            raise ValueError(
                f"n_obstacles must be (fewest, most) with 0 <= fewest <= most <= {CANDIDATES // 2}, got {self.n_obstacles}"
            )
        for name in ("distance", "post_radius", "bar_radius", "bar_half_length"):
            check_increasing_pair(name, getattr(self, name))


class SceneSampler:
    """Draws scenes for an arm, each from a generator of its own."""

    def __init__(self, arm: Arm, distribution: SceneDistribution, *, whole_arm: bool) -> None:
        self.arm = arm
        self.distribution = distribution
        self.whole_arm = whole_arm
        self._layout = ActionLayout(dimension=arm.dimension)
        self._rows = distribution.n_obstacles[1]

    def __call__(
        self, generators: Sequence[np.random.Generator], ends: tuple[Float, Float] | None = None
    ) -> Scenes:
        """One scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, D) each, NaN where they are to be drawn, [m].

        Raises:
            RuntimeError: No scene was found in many attempts, as with given ends in a corner of the reach.
        """
        number, dimension = len(generators), self.arm.dimension
        scenes = Scenes(
            np.zeros((number, dimension)),
            np.zeros((number, dimension)),
            np.zeros((number, self._rows, 2 * dimension + 1)),
        )
        pending = np.arange(number)
        for _ in range(ATTEMPTS):
            drawn = _Uniforms(np.stack([generators[i].random(self._size) for i in pending]))
            given = None if ends is None else (ends[0][pending], ends[1][pending])
            found, attempt = self._attempt(drawn, given)
            scenes.put(pending[found], attempt.take(found))
            pending = pending[~found]
            if not len(pending):
                return scenes
        raise RuntimeError(
            f"no scene with {self.distribution.n_obstacles} obstacles was found in {ATTEMPTS} attempts"
            + ("" if ends is None else f" between start {ends[0][pending[0]]} and goal {ends[1][pending[0]]}")
        )

    @property
    def _size(self) -> int:
        """Uniform numbers of one attempt."""
        return 4 * ENDS + 2 * WITNESSES + 7 * CANDIDATES + 2 + self._rows

    def _attempt(self, u: _Uniforms, ends: tuple[Float, Float] | None) -> tuple[NDArray[np.bool_], Scenes]:
        """Scenes, and which of them are good."""
        start, goal, good = self._ends(u, ends)
        path, reached = self._witness(u, start, goal)
        rows = self._candidates(u, start, goal)
        clearance = self._least_clearance(path, rows)
        resting = np.minimum(self._least_clearance(start[:, None], rows), self._least_clearance(goal[:, None], rows))
        free = (clearance > self.distribution.witness_margin) & (resting > self.distribution.end_margin)
        obstacles, enough = self._choose(u, start, goal, rows, clearance, free)
        return good & reached & enough, Scenes(start, goal, obstacles)

    def _ends(self, u: _Uniforms, ends: tuple[Float, Float] | None) -> tuple[Float, Float, NDArray[np.bool_]]:
        """Starts and goals inside the workspace with the straight line between them inside the reach."""
        low, high = (np.array(corner) for corner in self.arm.workspace)
        start = low + (high - low) * np.stack([u.take(ENDS), u.take(ENDS)], axis=-1)
        angle = 2.0 * np.pi * u.take(ENDS)
        length = _between(self.distribution.distance, u.take(ENDS))
        step = length[..., None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
        if ends is not None:
            start = np.where(np.isnan(ends[0])[:, None], start, ends[0][:, None])
        goal = start + step
        if ends is not None:
            goal = np.where(np.isnan(ends[1])[:, None], goal, ends[1][:, None])
        line = start[..., None, :] + (goal - start)[..., None, :] * np.linspace(0.0, 1.0, 5)[:, None]
        margin = self.arm.reach_margin(line).min(axis=-1)
        inside = ((goal >= low) & (goal <= high)).all(axis=-1)
        if ends is not None:
            inside |= ~np.isnan(ends[1]).any(axis=-1)[:, None]
        good = inside & (margin > self.distribution.reach_margin)
        first = good.argmax(axis=-1)
        rows = np.arange(len(first))
        return start[rows, first], goal[rows, first], good.any(axis=-1)

    def _witness(self, u: _Uniforms, start: Float, goal: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Hand path of a movement through one via-point inside the reach, shape (N, PHASES, D)."""
        along = 1.6 * u.take(WITNESSES) - 0.8
        side = 2.0 * u.take(WITNESSES) - 1.0
        across = np.copysign(0.15 + 0.8 * np.abs(side), side)
        action = np.stack((along, across, np.zeros_like(along)), axis=-1)
        ends = np.broadcast_to(start[:, None], (*action.shape[:2], start.shape[-1]))
        plan = self._layout.decode(action, ends, np.broadcast_to(goal[:, None], ends.shape))
        times = plan.durations.sum(axis=-1)[..., None] * np.linspace(0.0, 1.0, PHASES)
        paths = plan.trajectory()(times)
        good = (self.arm.reach_margin(paths) > self.distribution.reach_margin).all(axis=-1)
        first = good.argmax(axis=-1)
        return paths[np.arange(len(first)), first], good.any(axis=-1)

    def _candidates(self, u: _Uniforms, start: Float, goal: Float) -> Float:
        """Posts and bars about the straight line, shape (N, CANDIDATES, 5)."""
        d = self.distribution
        line = (goal - start)[:, None]
        along = line / np.sqrt((line * line).sum(axis=-1, keepdims=True))
        across = np.stack((-along[..., 1], along[..., 0]), axis=-1)
        fraction, offset = u.take(CANDIDATES), d.spread * (2.0 * u.take(CANDIDATES) - 1.0)
        centre = start[:, None] + line * fraction[..., None] + across * offset[..., None]
        bar = (u.take(CANDIDATES) < 0.5)[..., None]
        tilt = d.bar_tilt * (2.0 * u.take(CANDIDATES) - 1.0)
        half = _between(d.bar_half_length, u.take(CANDIDATES))
        axis = across * (half * np.cos(tilt))[..., None] + along * (half * np.sin(tilt))[..., None]
        size = u.take(CANDIDATES)[..., None]
        radius = np.where(bar, _between(d.bar_radius, size), _between(d.post_radius, size))
        return np.concatenate((centre, np.where(bar, axis, 0.0), radius), axis=-1)

    def _least_clearance(self, path: Float, rows: Float) -> Float:
        """Clearance of the arm from each candidate while its hand is on `path`, shape (N, CANDIDATES), [m]."""
        present = np.ones(rows.shape[:-1], dtype=bool)
        clearance = hand_clearance(path, self.arm.hand_radius, rows, present)
        if self.whole_arm:
            links = self.arm.links(self.arm.posture(path))
            clearance = np.minimum(clearance, arm_clearance(links, self.arm.link_radii, rows, present))
        return np.asarray(clearance)

    def _choose(
        self, u: _Uniforms, start: Float, goal: Float, rows: Float, clearance: Float, free: NDArray[np.bool_]
    ) -> tuple[Float, NDArray[np.bool_]]:
        """Obstacles among the free candidates, in random rows, the first of them in the way of the straight movement.

        A drawn tightness moves the choice from any candidate to those that stand closest to the witness.
        """
        fewest, most = self.distribution.n_obstacles
        count = fewest + np.floor((most - fewest + 1) * u.take(1))
        tightness = u.take(1)
        distance = np.sqrt(segment_distance_squared(start[:, None], goal[:, None], rows)[..., 0])
        in_the_way = free & (distance - rows[..., -1] - self.arm.hand_radius < -0.004)
        key = (1.0 - tightness) * u.take(CANDIDATES) + tightness * clearance / 0.1
        key = np.where(free, key, np.inf)
        first = np.where(in_the_way, key, np.inf).argmin(axis=-1)
        key[np.arange(len(first)), first] = -np.inf
        order = key.argsort(axis=-1, kind="stable")[:, : self._rows]
        chosen = np.take_along_axis(rows, order[..., None], axis=1)
        chosen = np.where((np.arange(self._rows) < count)[..., None], chosen, 0.0)
        shuffled = u.take(self._rows).argsort(axis=-1, kind="stable")
        enough = (free.sum(axis=-1) >= count[:, 0]) & (in_the_way.any(axis=-1) | (count[:, 0] == 0))
        return np.take_along_axis(chosen, shuffled[..., None], axis=1), enough


class _Uniforms:
    """Rows of uniform numbers, taken in order."""

    def __init__(self, values: Float) -> None:
        self._values = values
        self._next = 0

    def take(self, count: int) -> Float:
        """The next `count` numbers of each row, shape (N, count)."""
        self._next += count
        return self._values[:, self._next - count : self._next]


def _between(bounds: tuple[float, float], u: Any) -> Any:
    return bounds[0] + (bounds[1] - bounds[0]) * u
