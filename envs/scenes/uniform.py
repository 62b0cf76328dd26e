"""Scenes whose ends and obstacles are uniform in the workspace, without a feasible path to begin with.

Other scenes are built about a feasible path, so that each has a solution. These are not: start, goal and obstacles are
drawn independently of each other, and an attempt is rejected only if the arm cannot rest at an end or if the straight
movement hits nothing. A few of the scenes have no solution.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float, Index
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.draws import IN_THE_WAY, Uniforms, rotate, whole_between
from viapoint.envs.scenes.feasible_path import Ends
from viapoint.envs.scenes.planar_obstacles import draw_shapes
from viapoint.envs.scenes.scene import FARTHEST_CENTRE, LARGEST_HALF_AXIS, Scenes, rest_clearance
from viapoint.envs.scenes.spatial_families import draw_obstacles

DRAWN = 3
"""Obstacles that are drawn for each row; the first ones that leave room at start and goal are taken."""
NUMBERS = {2: 6, 3: 9}
"""Uniform numbers that make one obstacle, by the dimension."""
N_TIMES = 24
"""Positions along the straight line at which its clearance and reach are computed."""


class UniformScenes:
    """Attempts at scenes with ends and obstacles that are uniform in the workspace.

    Start and goal are uniform in the box :attr:`~viapoint.envs.arms.base.Arm.workspace`, `reach_margin` inside the
    reach, and may have any distance from each other; the straight line between them is within reach. The number of
    obstacles is uniform between its limits. Their centres are uniform in the same box, their directions are uniform in
    the plane, and their kinds and sizes are those of the distribution's other scenes. Obstacles that come closer to the
    resting arm at start or goal than `end_margin` are left out. A scene is good if the straight movement cuts into an
    obstacle, or if it has none.

    The arguments are those of :class:`~viapoint.envs.scenes.sampler.SceneSampler`.
    """

    def __init__(
        self, collision_model: CollisionModel, distribution: SceneDistribution | SpaceDistribution
    ) -> None:
        self._collision_model, self._distribution = collision_model, distribution

    @property
    def rows(self) -> int:
        """Greatest number of obstacles in a scene."""
        return self._distribution.n_obstacles[1]

    @property
    def size(self) -> int:
        """Uniform numbers of one attempt."""
        dimension = self._collision_model.arm.dimension
        return 2 * dimension + 1 + DRAWN * self.rows * NUMBERS[dimension]

    def __call__(self, uniforms: Uniforms, ends: Ends) -> tuple[Index, Scenes]:
        """Return the indices of good attempts and their scenes; `size` of the uniform numbers are taken."""
        start, goal, good = self._ends(uniforms, ends)
        count = whole_between(self._distribution.n_obstacles, uniforms.take(1)[:, 0])
        rows = np.flatnonzero(good)
        start, goal, count = start[rows], goal[rows], count[rows]
        drawn = Scenes(start, goal, self._obstacles(uniforms.at(rows), len(rows)))
        obstacles, enough = self._first(drawn, self._free(drawn), count)
        some = np.flatnonzero(enough)
        rows, scenes = rows[some], Scenes(start[some], goal[some], obstacles[some])
        blocked = blocks_straight_movement(self._collision_model, scenes)
        some = np.flatnonzero(blocked | (count[some] == 0))
        return rows[some], scenes.take(some)

    def _ends(self, uniforms: Uniforms, ends: Ends) -> tuple[Float, Float, Bool]:
        """Return starts and goals, shape (N, D), [m], and which are apart and joined within reach, shape (N,)."""
        arm = self._collision_model.arm
        low, high = (np.array(corner) for corner in arm.workspace)
        u = uniforms.take(2 * arm.dimension).reshape(-1, 2, arm.dimension)
        points = low + (high - low) * u
        if ends is not None:
            given = np.stack(ends, axis=1)
            points = np.where(np.isnan(given), points, given)
        inside = np.asarray(arm.reach_margin(points)) > self._distribution.reach_margin
        if ends is not None:
            inside |= np.isfinite(given[..., 0])
        start, goal = points[:, 0], points[:, 1]
        good = np.asarray(inside.all(axis=-1) & (norm(goal - start) >= MIN_GOAL_DISTANCE))
        good[good] = np.asarray(arm.reach_margin(_lines(start[good], goal[good]))).min(axis=-1) > 0.0
        return start, goal, good

    def _obstacles(self, uniforms: Uniforms, n_scenes: int) -> Float:
        """Return obstacles anywhere in the workspace, shape (N, DRAWN rows, 2 D + 1), [m]."""
        arm, distribution, number = self._collision_model.arm, self._distribution, DRAWN * self.rows
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
            clearance = rest_clearance(scenes, point, self._collision_model)[:, : free.shape[1]]
            free &= clearance > self._distribution.end_margin
        return np.asarray(free)

    def _first(self, scenes: Scenes, free: Bool, count: Float) -> tuple[Float, Bool]:
        """Return the first `count` free obstacles of each scene, shape (N, rows, 2 D + 1), and which have as many."""
        first = np.argsort(~free, axis=-1, kind="stable")[:, : self.rows]
        chosen = np.take_along_axis(scenes.obstacles, first[..., None], axis=1)
        chosen[np.arange(self.rows) >= count[:, None]] = 0.0
        return chosen, free.sum(axis=-1) >= count


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
