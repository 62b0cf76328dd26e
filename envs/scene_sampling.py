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

ENDS, WITNESSES, CANDIDATES, PHASES, WAYS = 16, 6, 32, 40, 15
"""How many pairs of ends, witnesses and obstacles are drawn at once, at how many times a movement is looked at,
and how many ways round are told apart."""
MOST = 8
"""Obstacles of a scene at most."""
ATTEMPTS = 200
INWARD = 0.85
"""Share of witnesses that pass between base and obstacles, where links count: few others leave room for them."""


@dataclass(frozen=True, kw_only=True)
class SceneDistribution:
    """What scenes are like."""

    n_obstacles: tuple[int, int] = (1, 5)
    """Fewest and most obstacles."""
    distance: tuple[float, float] = (0.25, 0.45)
    """From start to goal, [m]."""
    post_radius: tuple[float, float] = (0.012, 0.045)
    """[m]."""
    bar_radius: tuple[float, float] = (0.006, 0.010)
    """[m]."""
    bar_half_length: tuple[float, float] = (0.05, 0.125)
    """[m]; the rows of lights of Flash & Hogan 1985 were up to 0.25 m long."""
    bar_tilt: float = 0.6
    """Greatest angle between a bar and the perpendicular of the straight line, [rad]."""
    spread: float = 0.26
    """Greatest distance of an obstacle's centre from the straight line, [m]."""
    ease: float = 0.3
    """Hardness is a uniform number to this power: less is harder."""
    witness_margin: float = 0.006
    """Least clearance of the witness, [m]: what sampling times and tracking may cost, and to spare."""
    link_margin: float = 0.015
    """Least clearance of the witness's links, [m]: they are looked at less often."""
    end_margin: float = 0.025
    """Least clearance of the hand at start and goal, [m]."""
    reach_margin: float = 0.03
    """How far inside the arm's reach start, goal and witness stay, [m]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be sampled."""
        fewest, most = self.n_obstacles
        if not 0 <= fewest <= most <= MOST:
            raise ValueError(
                f"n_obstacles must be (fewest, most), 0 <= fewest <= most <= {MOST}, got {self.n_obstacles}"
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
        self._ways = _ways_round(self._layout, float(np.mean(distribution.distance)))

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
            drawn = _Uniforms(np.stack([generators[int(i)].random(self._size) for i in pending]))
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
        return 4 * ENDS + 3 * WITNESSES + 7 * CANDIDATES + 2 + self._rows

    def _attempt(self, u: _Uniforms, ends: tuple[Float, Float] | None) -> tuple[NDArray[np.bool_], Scenes]:
        """Scenes, and which of them are good."""
        start, goal, good = self._ends(u, ends)
        path, reached = self._witness(u, start, goal)
        hardness = u.take(1) ** self.distribution.ease
        rows = self._candidates(u, start, goal, path, hardness)
        free = self._free(path, start, goal, rows)
        obstacles, enough = self._choose(u, (start, goal), rows, free, hardness)
        return good & reached & enough, Scenes(start, goal, obstacles)

    def _ends(self, u: _Uniforms, ends: tuple[Float, Float] | None) -> tuple[Float, Float, NDArray[np.bool_]]:
        """Starts and goals inside the workspace with the straight line between them inside the reach."""
        low, high = (np.array(corner) for corner in self.arm.workspace)
        inside: Any
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
            inside |= np.isfinite(ends[1][:, :1])
        good: Any = inside & (margin > self.distribution.reach_margin)
        first = good.argmax(axis=-1)
        rows = np.arange(len(first))
        return start[rows, first], goal[rows, first], good.any(axis=-1)

    def _witness(self, u: _Uniforms, start: Float, goal: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Hand path of a movement through one via-point inside the reach, shape (N, PHASES, D)."""
        along = 1.6 * u.take(WITNESSES) - 0.8
        side = 2.0 * u.take(WITNESSES) - 1.0
        across = np.copysign(0.15 + 0.8 * np.abs(side), side)
        if self.whole_arm:
            across = np.where(u.take(WITNESSES) < INWARD, np.abs(across) * _side_of_base(start, goal), across)
        action = np.stack((along, across, np.zeros_like(along)), axis=-1)
        ends = np.broadcast_to(start[:, None], (*action.shape[:2], start.shape[-1]))
        plan = self._layout.decode(action, ends, np.broadcast_to(goal[:, None], ends.shape))
        times = plan.durations.sum(axis=-1)[..., None] * np.linspace(0.0, 1.0, PHASES)
        paths = plan.trajectory()(times)
        good = (self.arm.reach_margin(paths) > self.distribution.reach_margin).all(axis=-1)
        first = good.argmax(axis=-1)
        return paths[np.arange(len(first)), first], good.any(axis=-1)

    def _candidates(self, u: _Uniforms, start: Float, goal: Float, path: Float, hardness: Float) -> Float:
        """Posts and bars, shape (N, CANDIDATES, 5): a half about the straight line, a half beside the witness."""
        d = self.distribution
        along = (goal - start)[:, None] / np.sqrt(((goal - start) ** 2).sum(axis=-1))[:, None, None]
        fraction, offset = u.take(CANDIDATES), 2.0 * u.take(CANDIDATES) - 1.0
        bar = u.take(CANDIDATES) < 0.5
        tilt = d.bar_tilt * (2.0 * u.take(CANDIDATES) - 1.0)
        half = np.where(bar, _between(d.bar_half_length, u.take(CANDIDATES)), 0.0)
        size = u.take(CANDIDATES)
        radius = np.where(bar, _between(d.bar_radius, size), _between(d.post_radius, size))
        beside = np.arange(CANDIDATES) % 2 == 1
        phase = (0.15 * PHASES + 0.7 * PHASES * fraction).astype(np.int64)
        each = np.arange(len(path))[:, None]
        tangent = _unit(path[each, phase + 1] - path[each, phase - 1])
        direction = np.where(beside[:, None], tangent, along)
        normal = np.stack((-direction[..., 1], direction[..., 0]), axis=-1)
        axis = half[..., None] * (normal * np.cos(tilt)[..., None] + direction * np.sin(tilt)[..., None])
        gap = d.witness_margin + 0.002 + 0.08 * np.abs(offset) * (1.0 - hardness)
        away = np.copysign(half + radius + self.arm.hand_radius + gap, offset)
        line = start[:, None] + (goal - start)[:, None] * fraction[..., None]
        foot = np.where(beside[:, None], path[each, phase], line)
        centre = foot + normal * np.where(beside, away, d.spread * offset)[..., None]
        return np.concatenate((centre, axis, radius[..., None]), axis=-1)

    def _free(self, path: Float, start: Float, goal: Float, rows: Float) -> NDArray[np.bool_]:
        """Which candidates leave room for the witness, and for the arm at its ends, shape (N, CANDIDATES)."""
        d, radius = self.distribution, self.arm.hand_radius
        present = np.ones(rows.shape[:-1], dtype=bool)
        ends = np.stack((start, goal), axis=1)
        free = hand_clearance(path, radius, rows, present) > d.witness_margin
        free &= hand_clearance(ends, radius, rows, present) > d.end_margin
        if self.whole_arm:
            some = np.concatenate((path[:, ::3], path[:, -1:]), axis=1)
            links = self.arm.links(self.arm.posture(some))
            free &= arm_clearance(links, self.arm.link_radii, rows, present) > d.link_margin
        return np.asarray(free)

    def _choose(
        self,
        u: _Uniforms,
        ends: tuple[Float, Float],
        rows: Float,
        free: NDArray[np.bool_],
        hardness: Float,
    ) -> tuple[Float, NDArray[np.bool_]]:
        """Obstacles among the free candidates, in random rows, the first of them in the way of the straight movement.

        One after the other is chosen; hardness moves the choice from any candidate to the one that closes most of the
        ways round that are still open.
        """
        fewest, most = self.distribution.n_obstacles
        count = fewest + np.floor((most - fewest + 1) * u.take(1))
        chance = u.take(CANDIDATES)
        shuffled = u.take(self._rows).argsort(axis=-1, kind="stable")
        distance = np.sqrt(segment_distance_squared(ends[0][:, None], ends[1][:, None], rows)[..., 0])
        in_the_way = free & (distance - rows[..., -1] - self.arm.hand_radius < -0.004)
        enough = (free.sum(axis=-1) >= count[:, 0]) & (in_the_way.any(axis=-1) | (count[:, 0] == 0))
        closed = self._ways_closed(ends, rows)
        still_open = np.ones((len(rows), 1, closed.shape[-1]), dtype=bool)
        eligible, each = in_the_way, np.arange(len(rows))
        chosen = np.zeros((len(rows), self._rows, rows.shape[-1]))
        for row in range(self._rows):
            gain = (closed & still_open).sum(axis=-1) / np.maximum(still_open.sum(axis=-1), 1)
            key = np.where(eligible, 2.0 * hardness * gain + (1.0 - hardness) * chance, -1.0)
            best = key.argmax(axis=-1)
            chosen[:, row] = np.where(row < count, rows[each, best], 0.0)
            still_open &= ~closed[each, best][:, None]
            free = free & (np.arange(CANDIDATES) != best[:, None])
            eligible = free
        return np.take_along_axis(chosen, shuffled[..., None], axis=1), enough

    def _ways_closed(self, ends: tuple[Float, Float], rows: Float) -> NDArray[np.bool_]:
        """Which ways round each candidate closes, shape (N, CANDIDATES, ways): an estimate that steers difficulty."""
        start, goal = (end[:, None] for end in ends)
        along, length = _unit(goal - start), np.sqrt(((goal - start) ** 2).sum(axis=-1))
        across = np.stack((-along[..., 1], along[..., 0]), axis=-1)
        centre, axis, radius = rows[..., :2] - start, rows[..., 2:4], rows[..., 4]
        fraction = np.clip((centre * along).sum(axis=-1) / length, 0.0, 1.0)
        ways = self._ways[np.round(fraction * (len(self._ways) - 1)).astype(np.int64)]
        lateral = (centre * across).sum(axis=-1)[..., None]
        reach = np.abs((axis * across).sum(axis=-1)) + radius + self.arm.hand_radius
        return np.asarray(np.abs(ways - lateral.astype(np.float32)) < reach[..., None].astype(np.float32))


class _Uniforms:
    """Rows of uniform numbers, taken in order."""

    def __init__(self, values: Float) -> None:
        self._values = values
        self._next = 0

    def take(self, count: int) -> Float:
        """The next `count` numbers of each row, shape (N, count)."""
        self._next += count
        return self._values[:, self._next - count : self._next]


def _ways_round(layout: ActionLayout, distance: float) -> NDArray[np.float32]:
    """How far movements through one via-point are from the straight line, at 21 places along it: (21, ways), [m]."""
    along, across = (g.ravel() for g in np.meshgrid((-0.7, 0.0, 0.7), np.linspace(-1.0, 1.0, WAYS)))
    action = np.zeros((len(along), layout.size))
    action[:, 0], action[:, 1] = along, across
    start = np.zeros((len(along), layout.dimension))
    goal = start.copy()
    goal[:, 0] = distance
    plan = layout.decode(action, start, goal)
    path = plan.trajectory()(plan.durations.sum(axis=-1)[:, None] * np.linspace(0.0, 1.0, 200))
    places = np.linspace(0.0, distance, 21)
    return np.stack([np.interp(places, way[:, 0], way[:, 1]) for way in path], axis=-1).astype(np.float32)


def _side_of_base(start: Float, goal: Float) -> Float:
    """1 where the arm's base lies to the left of the straight line, -1 where to its right, shape (N, 1)."""
    line, middle = goal - start, 0.5 * (start + goal)
    return np.where(line[:, :1] * middle[:, 1:2] < line[:, 1:2] * middle[:, :1], 1.0, -1.0)


def _unit(vectors: Float) -> Float:
    return np.asarray(vectors / np.maximum(np.sqrt((vectors**2).sum(axis=-1, keepdims=True)), 1e-9))


def _between(bounds: tuple[float, float], u: Any) -> Any:
    return bounds[0] + (bounds[1] - bounds[0]) * u
