"""Rejection sampling of scenes, in the plane and in space.

In a scene, the straight movement hits an obstacle and the feasible path does not. An attempt at a scene takes the next
numbers of a random generator, and the first good attempt is the scene. Numbers are drawn in groups of attempts; the
next scene of a generator begins after the group of the good attempt. So scenes do not depend on how many attempts are
computed at once, or with which others: those at many scenes are computed together.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Index, Int
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.geometry.rows import CAPSULES, has_shapes, row_size, shape_columns, shape_number
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.draws import (
    IN_THE_WAY,
    RESHAPE_NUMBERS,
    ObstacleSampler,
    Uniforms,
    reshaped,
    rotate,
    whole_between,
)
from viapoint.envs.scenes.families import MOST_DRAWN
from viapoint.envs.scenes.feasible_path import DRAW_ORDER, DrawOrder, Ends, sample_ends, sample_paths
from viapoint.envs.scenes.planar_obstacles import HandObstacles, WholeArmObstacles, draw_shapes
from viapoint.envs.scenes.scene import FARTHEST_CENTRE, LARGEST_HALF_AXIS, Scenes, rest_clearance
from viapoint.envs.scenes.spatial_families import draw_obstacles
from viapoint.envs.scenes.spatial_obstacles import SpatialObstacles

Distribution = SceneDistribution | SpaceDistribution

TOGETHER = 1024
"""Attempts that are computed at once: more take as much time each."""
MOST = 24
"""Attempts at one scene for which further groups are begun: those after the first good one are in vain."""
SHARED_GROUPS = 8
"""Groups of attempts at a scene that share the number :attr:`SceneSampler.fixed`."""
UNIFORM_GROUPS = (4, 8, *[16] * 400)
"""Attempts at a uniform scene that are drawn one after the other."""
DRAWN = 3
"""Obstacles of a uniform scene that are drawn for each row; the first ones that leave start and goal free are taken."""
UNIFORM_NUMBERS = {2: 6, 3: 9}
"""Uniform numbers that make one obstacle of a uniform scene, by the dimension."""
N_TIMES = 24
"""Positions along the straight line at which its clearance and reach are computed."""


class SceneSampler:
    """Rejection sampler of scenes for an arm.

    Args:
        collision_model: Arm that moves, and the bodies that must clear the obstacles.
        distribution: Distribution of scenes, of the same dimension.
        obstacles: Sampler of obstacles; by default that of the distribution.
        order: Amounts of random numbers; by default those of the dimension.
    """

    def __init__(
        self,
        collision_model: CollisionModel,
        distribution: Distribution,
        *,
        obstacles: ObstacleSampler | None = None,
        order: DrawOrder | None = None,
    ) -> None:
        self.collision_model, self.arm, self.distribution = collision_model, collision_model.arm, distribution
        drawn = _drawn(distribution)
        self._spare = 0 if obstacles else distribution.n_obstacles[1] - drawn.n_obstacles[1]
        if obstacles is None and isinstance(drawn, SpaceDistribution):
            obstacles = SpatialObstacles(collision_model, drawn)
        planar = WholeArmObstacles if collision_model.whole_arm else HandObstacles
        self._obstacles: ObstacleSampler = obstacles or planar(collision_model, drawn)  # type: ignore[arg-type]
        self.order = order or DRAW_ORDER[self.arm.dimension]

    def __call__(self, generators: Sequence[np.random.Generator], ends: Ends = None) -> Scenes:
        """Sample one scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, D) each, NaN where they are sampled, [m].

        Raises:
            RuntimeError: No scene was found in many attempts, for example with given ends at the border of the reach.
        """
        number = len(generators)
        start, goal = np.zeros((2, number, self.arm.dimension))
        scenes = Scenes(start, goal, np.zeros((number, self._obstacles.rows, self._row_size)))
        pending = np.arange(number)
        attempts = [Attempts(self, each) for each in generators]
        apart = len({id(each.bit_generator) for each in generators}) == number
        while len(pending):
            left = np.ones(len(pending), dtype=bool)
            for begin in range(0, len(pending), TOGETHER):
                some = pending[begin : begin + TOGETHER]
                given = None if ends is None else (ends[0][some], ends[1][some])
                which, found = next_attempts([attempts[k] for k in some], given, apart=apart)
                scenes.put(some[which], found)
                left[begin + which] = False
            pending = pending[left]
        if not self._spare:
            return scenes
        # Empty rows for given obstacles, of which there may be more than are drawn.
        return scenes._replace(obstacles=np.pad(scenes.obstacles, ((0, 0), (0, self._spare), (0, 0))))

    def not_found(self, attempts: int, ends: Ends) -> str:
        """Return the message for a scene, with given ends or not, of which no attempt was good."""
        where = (
            f"between start {ends[0]} and goal {ends[1]}"
            if ends is not None
            else f"in the workspace {self.arm.workspace} m of {self.arm.name}; an arm of your own may need a larger "
            "one, or fewer obstacles (n_obstacles)"
        )
        n_obstacles = self.distribution.n_obstacles
        return f"no scene with {n_obstacles} obstacles was found in {attempts} attempts {where}"

    @functools.cached_property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        ends = 2 * self.arm.dimension * self.order.n_ends
        return ends + 3 * self.order.n_paths + self._obstacles.size + self._reshape_size

    @functools.cached_property
    def fixed(self) -> int | None:
        """Index of the number that attempts of the first groups share; None for none."""
        fixed = self._obstacles.fixed
        return None if fixed is None else self.size - self._reshape_size - self._obstacles.size + fixed

    @property
    def _row_size(self) -> int:
        """Number of values of an obstacle."""
        return row_size(self.arm.dimension, self.distribution.shapes)

    @property
    def _reshape_size(self) -> int:
        """Uniform numbers that decide the shapes of obstacles."""
        shaped = self.distribution.shapes != CAPSULES
        return RESHAPE_NUMBERS * self._obstacles.rows if shaped else 0

    def attempt(self, uniforms: Uniforms, ends: Ends) -> tuple[Index, Scenes]:
        """Return the indices of good attempts and their scenes; each stage looks at the rows that are left."""
        d, order, arm = self.distribution, self.order, self.arm
        u = uniforms.take_table(order.n_ends, 2 * arm.dimension, by_column=order.by_column)
        start, goal, good = sample_ends(u, arm, d.distance, d.steepness, d.reach_margin, ends)
        rows = np.flatnonzero(good)
        if len(rows) < len(good):
            uniforms, start, goal = uniforms.at(rows), start[rows], goal[rows]
        u = uniforms.take_table(order.n_paths, self._obstacles.path_numbers, by_column=order.by_column)
        steered = self._obstacles.steered(uniforms, len(rows))
        feasible, good = sample_paths(u, arm, start, goal, d.reach_margin, steered)
        if not good.all():
            some = np.flatnonzero(good)
            uniforms, rows, feasible = uniforms.at(some), rows[some], feasible.take(some)
        obstacles = np.zeros((0, self._obstacles.rows, self._row_size))
        if len(rows):
            obstacles, good = self._obstacles(uniforms, feasible)
            some = np.flatnonzero(good)
            rows, feasible, obstacles = rows[some], feasible.take(some), obstacles[some]
            uniforms = uniforms.at(some)
        return self._reshaped(uniforms, rows, Scenes(feasible.start, feasible.goal, obstacles))

    def _reshaped(self, uniforms: Uniforms, rows: Index, scenes: Scenes) -> tuple[Index, Scenes]:
        """Return the good attempts and their scenes with obstacles of the distribution's shapes.

        What is inside a capsule may no longer be in the way of the straight movement; such attempts fail. Boxes are
        parts of structures of boxes, which stay as they are and in the way.
        """
        if not self._reshape_size:
            return rows, scenes
        u = uniforms.take_table(self._obstacles.rows, RESHAPE_NUMBERS)
        boxes = _has_boxes(scenes.obstacles)
        scenes = scenes._replace(obstacles=reshaped(scenes.obstacles, u, self.distribution.shapes))
        good = boxes | ~scenes.present.any(axis=-1)
        rest = np.flatnonzero(~good)
        good[rest] = blocks_straight_movement(self.collision_model, scenes.take(rest))
        some = np.flatnonzero(good)
        return rows[some], scenes.take(some)


class UniformSampler(SceneSampler):
    """Rejection sampler of scenes that are uniform in the workspace, without a feasible path to begin with.

    Start and goal are uniform in the box :attr:`~viapoint.envs.arms.base.Arm.workspace`, `reach_margin` inside the
    reach, and may have any distance from each other; the straight line between them is within reach. The number of
    obstacles is uniform between its limits. Their centres are uniform in the same box, their directions are uniform in
    the plane, and their kinds and sizes are those of the distribution's other scenes. Obstacles that come closer to the
    resting arm at start or goal than `end_margin` are left out. A scene is good if the straight movement cuts into an
    obstacle, or if it has none. A few of the scenes have no solution.
    """

    def __init__(self, collision_model: CollisionModel, distribution: Distribution) -> None:
        order = DRAW_ORDER[distribution.dimension]._replace(groups=UNIFORM_GROUPS)
        super().__init__(collision_model, distribution, order=order)
        self._drawn = _drawn(distribution)
        self._rows = self._drawn.n_obstacles[1]

    @property
    def size(self) -> int:
        """See :attr:`SceneSampler.size`."""
        dimension = self.arm.dimension
        return 2 * dimension + 1 + DRAWN * self._rows * UNIFORM_NUMBERS[dimension] + self._reshape_size

    def attempt(self, uniforms: Uniforms, ends: Ends) -> tuple[Index, Scenes]:
        """See :meth:`SceneSampler.attempt`."""
        start, goal, good = self._ends(uniforms, ends)
        count = whole_between(self._drawn.n_obstacles, uniforms.take(1)[:, 0])
        rows = np.flatnonzero(good)
        start, goal, count = start[rows], goal[rows], count[rows]
        drawn = Scenes(start, goal, self._draw_obstacles(uniforms.at(rows), len(rows)))
        obstacles, enough = self._first(drawn, self._free(drawn), count)
        some = np.flatnonzero(enough)
        rows, scenes = rows[some], Scenes(start[some], goal[some], obstacles[some])
        blocked = blocks_straight_movement(self.collision_model, scenes)
        some = np.flatnonzero(blocked | (count[some] == 0))
        rows, scenes = rows[some], scenes.take(some)
        return self._reshaped(uniforms.at(rows), rows, scenes)

    def _ends(self, uniforms: Uniforms, ends: Ends) -> tuple[Float, Float, Bool]:
        """Return starts and goals, shape (N, D), [m], and which are apart and joined within reach, shape (N,)."""
        arm = self.arm
        low, high = (np.array(corner) for corner in arm.workspace)
        u = uniforms.take(2 * arm.dimension).reshape(-1, 2, arm.dimension)
        points = low + (high - low) * u
        if ends is not None:
            given = np.stack(ends, axis=1)
            points = np.where(np.isnan(given), points, given)
        inside = np.asarray(arm.reach_margin(points)) > self._drawn.reach_margin
        if ends is not None:
            inside |= np.isfinite(given[..., 0])
        start, goal = points[:, 0], points[:, 1]
        good = np.asarray(inside.all(axis=-1) & (norm(goal - start) >= MIN_GOAL_DISTANCE))
        good[good] = np.asarray(arm.reach_margin(_lines(start[good], goal[good]))).min(axis=-1) > 0.0
        return start, goal, good

    def _draw_obstacles(self, uniforms: Uniforms, n_scenes: int) -> Float:
        """Return obstacles anywhere in the workspace, shape (N, DRAWN rows, 2 D + 1), [m]."""
        arm, distribution, number = self.arm, self._drawn, DRAWN * self._rows
        if not number:
            return np.zeros((n_scenes, 0, 2 * arm.dimension + 1))
        low, high = (np.array(corner) for corner in arm.workspace)
        centre = low + (high - low) * uniforms.take_table(number, arm.dimension)
        if isinstance(distribution, SpaceDistribution):
            return draw_obstacles(distribution, centre, uniforms.take_table(number, 6))
        every_way = dataclasses.replace(distribution, bar_tilt=0.5 * np.pi)
        half, radius, angle = draw_shapes(uniforms, every_way, number)
        axis = half[..., None] * rotate(np.broadcast_to((1.0, 0.0), centre.shape), angle)
        return np.concatenate((centre, axis, radius[..., None]), axis=-1)

    def _free(self, scenes: Scenes) -> Bool:
        """Return which obstacles leave room for the arm at start and goal and are within bounds, shape (N, n)."""
        d = scenes.start.shape[-1]
        free = np.abs(scenes.obstacles[..., :d]).max(axis=-1, initial=0.0) < FARTHEST_CENTRE
        free &= norm(scenes.obstacles[..., d : 2 * d]) < LARGEST_HALF_AXIS
        for point in (scenes.start, scenes.goal):
            clearance = rest_clearance(scenes, point, self.collision_model)[:, : free.shape[1]]
            free &= clearance > self._drawn.end_margin
        return np.asarray(free)

    def _first(self, scenes: Scenes, free: Bool, count: Float) -> tuple[Float, Bool]:
        """Return the first `count` free obstacles of each scene, shape (N, rows, 2 D + 1), and which have as many."""
        first = np.argsort(~free, axis=-1, kind="stable")[:, : self._rows]
        chosen = np.take_along_axis(scenes.obstacles, first[..., None], axis=1)
        chosen[np.arange(self._rows) >= count[:, None]] = 0.0
        return chosen, free.sum(axis=-1) >= count


class Attempts:
    """Attempts at the next scene of one random generator, until one is good."""

    def __init__(self, sampler: SceneSampler, generator: np.random.Generator) -> None:
        self.generator, self.sampler = generator, sampler
        self._shared = 0.0 if sampler.fixed is None else generator.random()
        self.made = 0
        """Attempts that were taken."""
        self._rest = np.empty((0, sampler.size))
        # Attempts up to the end of each group that was drawn, and the generator's state there.
        self._groups: list[tuple[int, Mapping[str, Any]]] = []

    def take(self, least: int, most: int) -> Float:
        """Return the numbers of the next attempts, shape (n, size); n = 0 after the last.

        Args:
            least: Attempts for which further groups are begun.
            most: Greatest number n.
        """
        groups, sampler = self._groups, self.sampler
        while len(self._rest) < least and len(groups) < len(sampler.order.groups):
            count = sampler.order.groups[len(groups)]
            drawn = self.generator.random((count, sampler.size))
            if sampler.fixed is not None and len(groups) < SHARED_GROUPS:
                drawn[:, sampler.fixed] = self._shared
            groups.append((count + (groups[-1][0] if groups else 0), self.generator.bit_generator.state))
            self._rest = np.concatenate((self._rest, drawn)) if len(self._rest) else drawn
        taken, self._rest = self._rest[:most], self._rest[most:]
        self.made += len(taken)
        return taken

    def end(self, attempt: int) -> None:
        """Set the generator back to the end of the group that holds an attempt."""
        state = next(state for end, state in self._groups if attempt < end)
        if state is not self._groups[-1][1]:
            self.generator.bit_generator.state = state


def next_attempts(
    attempts: Sequence[Attempts], ends: Ends = None, *, apart: bool = True
) -> tuple[Int, Scenes]:
    """Compute the next attempts at several scenes.

    Args:
        attempts: Attempts of one sampler at N scenes, at most TOGETHER.
        ends: Starts and goals of the N scenes, see :meth:`SceneSampler.__call__`.
        apart: False if scenes share a generator: whole groups are then drawn in turn.

    Returns:
        Indices of scenes with a good attempt, and the scenes; their generators are at the next scene.

    Raises:
        RuntimeError: There are no further attempts at a scene.
    """
    number, sampler = len(attempts), attempts[0].sampler
    order = sampler.order
    least = min(max(order.ahead // number, 1), MOST) if apart else 1
    most = max(TOGETHER // number, least) if apart else max(order.groups)
    taken = [each.take(least, most) for each in attempts]
    for k, each in enumerate(attempts):
        if not len(taken[k]):
            given = None if ends is None else (ends[0][k], ends[1][k])
            raise RuntimeError(sampler.not_found(each.made, given))
    counts = np.array([len(each) for each in taken])
    owner, begin = np.repeat(np.arange(number), counts), np.repeat(np.cumsum(counts) - counts, counts)
    given = None if ends is None else (ends[0][owner], ends[1][owner])
    found, scenes = sampler.attempt(Uniforms(np.concatenate(taken)), given)
    first = np.flatnonzero(np.diff(owner[found], prepend=-1))
    which, place = owner[found[first]], found[first] - begin[found[first]]
    for k, at in zip(which, place, strict=True):
        attempts[k].end(attempts[k].made - len(taken[k]) + int(at))
    return which, scenes.take(first)


def _has_boxes(obstacles: Float) -> Bool:
    """Return which of N scenes have a box, shape (N,), from rows of either kind."""
    if not has_shapes(obstacles):
        return np.zeros(len(obstacles), dtype=bool)
    boxes = shape_columns(obstacles).kind == shape_number("box")
    return np.asarray((boxes & (obstacles[..., -1] > 0.0)).any(axis=-1))


def _drawn(distribution: Distribution) -> Distribution:
    """Return a distribution without the room for given obstacles beyond those that are drawn."""
    fewest, most = distribution.n_obstacles
    return dataclasses.replace(distribution, n_obstacles=(fewest, min(most, MOST_DRAWN)))


def blocks_straight_movement(collision_model: CollisionModel, scenes: Scenes) -> Bool:
    """Return in which of N scenes the straight movement cuts into an obstacle, shape (N,)."""
    if not scenes.obstacles.size:
        return np.zeros(len(scenes.start), dtype=bool)
    lines = _lines(scenes.start, scenes.goal)
    least = collision_model.least_clearance(lines, scenes.obstacles, scenes.present, floor=-IN_THE_WAY)
    return np.asarray(least < -IN_THE_WAY)


def _lines(start: Float, goal: Float) -> Float:
    """Return positions along straight lines, shape (N, N_TIMES, D), [m]."""
    return np.asarray(start[:, None] + (goal - start)[:, None] * np.linspace(0.0, 1.0, N_TIMES)[:, None])
