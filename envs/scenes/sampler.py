"""Rejection sampling of scenes, in the plane and in space.

In a scene, the straight movement hits an obstacle and the feasible path does not. Each scene has a random generator of
its own and is a function of its numbers alone; attempts at all scenes are computed together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Bool, Float, Index, Int
from viapoint.envs.geometry.rows import CAPSULES, has_shapes, row_size, shape_columns, shape_number
from viapoint.envs.scenes.config import SceneDistribution, SpaceDistribution
from viapoint.envs.scenes.draws import RESHAPE_NUMBERS, ObstacleSampler, Uniforms, reshaped
from viapoint.envs.scenes.families import MOST_DRAWN, scene_families
from viapoint.envs.scenes.feasible_path import DRAW_ORDER, DrawOrder, Ends, sample_ends, sample_paths
from viapoint.envs.scenes.planar_families import FAMILY_ROWS
from viapoint.envs.scenes.planar_obstacles import FamilyObstacles, HandObstacles, WholeArmObstacles
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.scenes.spatial_obstacles import SpatialObstacles
from viapoint.envs.scenes.uniform import UniformScenes, blocks_straight_movement

Distribution = SceneDistribution | SpaceDistribution

FAMILY_ATTEMPTS = 2000
"""Attempts at a scene of a family in the plane; few of them succeed."""
TOGETHER = 1280
"""Attempts that are computed at once: only the first good one of a scene counts, so not all of them."""
MOST_AHEAD = 320
"""Greatest number of attempts, over all scenes, for which several groups are drawn at once."""
UNIFORM_GROUPS = (4, 8, *[16] * 400)
"""Attempts at a uniform scene that are drawn one after the other."""
SHARED_GROUPS = 8
"""Groups of attempts at a scene that share the number :attr:`ObstacleSampler.fixed`."""


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
        self._order = order or DRAW_ORDER[self.arm.dimension]

    def __call__(self, generators: Sequence[np.random.Generator], ends: Ends = None) -> Scenes:
        """Sample one scene from each generator.

        Args:
            generators: N random generators.
            ends: Given starts and goals, shape (N, D) each, NaN where they are sampled, [m].

        Raises:
            RuntimeError: No scene was found in many attempts, for example with given ends at the border of the reach.
        """
        number, dimension, fixed = len(generators), self.arm.dimension, self._obstacles.fixed
        scenes = Scenes(
            np.zeros((number, dimension)),
            np.zeros((number, dimension)),
            np.zeros((number, self._obstacles.rows, self._row_size)),
        )
        pending, shared = np.arange(number), np.zeros(number)
        if fixed is not None:
            shared = np.array([each.random() for each in generators])
        numbers = AttemptNumbers(generators, self._size, self._order)
        while len(pending) and not numbers.exhausted:
            made = numbers.made
            u = numbers.draw(pending)
            if fixed is not None:
                sharing = max(sum(self._order.groups[:SHARED_GROUPS]) - made, 0)
                u[:, :sharing, self._size - self._reshape_size - self._obstacles.size + fixed] = shared[
                    pending, None
                ]
            first = self._attempts(u, pending, ends, scenes)
            numbers.put_back(pending, first)
            pending = pending[first < 0]
        if len(pending):
            raise RuntimeError(self._not_found(numbers.made, pending[0], ends))
        if self._spare:
            spare = np.pad(scenes.obstacles, ((0, 0), (0, self._spare), (0, 0)))
            scenes = scenes._replace(obstacles=spare)
        return scenes

    def _not_found(self, attempts: int, scene: int, ends: Ends) -> str:
        where = (
            f"between start {ends[0][scene]} and goal {ends[1][scene]}"
            if ends is not None
            else f"in the workspace {self.arm.workspace} m of {self.arm.name}; an arm of your own may need a larger "
            "one, or fewer obstacles (n_obstacles)"
        )
        n_obstacles = self.distribution.n_obstacles
        return f"no scene with {n_obstacles} obstacles was found in {attempts} attempts {where}"

    @property
    def _row_size(self) -> int:
        """Number of values of an obstacle."""
        return row_size(self.arm.dimension, self.distribution.shapes)

    @property
    def _size(self) -> int:
        """Uniform numbers of one attempt."""
        ends = 2 * self.arm.dimension * self._order.n_ends
        return ends + 3 * self._order.n_paths + self._obstacles.size + self._reshape_size

    @property
    def _reshape_size(self) -> int:
        """Uniform numbers that decide the shapes of obstacles."""
        shaped = self.distribution.shapes != CAPSULES
        return RESHAPE_NUMBERS * self._obstacles.rows if shaped else 0

    def _attempts(self, u: Float, pending: Int, ends: Ends, scenes: Scenes) -> Int:
        """Store the scene of the first good attempt at each, and return which it was, shape (P,), -1 for none.

        Args:
            u: Uniform numbers, shape (P, attempts, .).
            pending: Indices of the scenes, shape (P,).
            ends: See :meth:`__call__`.
            scenes: Array to store the scenes in.
        """
        rest, begin, good = np.arange(len(pending)), 0, np.full(len(pending), -1)
        while begin < u.shape[1] and len(rest):
            several = max(TOGETHER // len(rest), 1)
            some = u[rest, begin : begin + several]
            each = np.repeat(rest, some.shape[1])
            where = pending[each]
            given = None if ends is None else (ends[0][where], ends[1][where])
            found, attempt = self._attempt(Uniforms(some.reshape(-1, self._size)), given)
            owner = each[found]
            first = np.flatnonzero(np.concatenate(([True], owner[1:] != owner[:-1]))[: len(owner)])
            solved = owner[first]
            scenes.put(pending[solved], attempt.take(first))
            good[solved] = begin + found[first] % some.shape[1]
            rest, begin = np.flatnonzero(good < 0), begin + several
        return good

    def _attempt(self, uniforms: Uniforms, ends: Ends) -> tuple[Index, Scenes]:
        """Return the indices of good attempts and their scenes; each stage looks at the rows that are left."""
        d, order, arm = self.distribution, self._order, self.arm
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
    """Rejection sampler of scenes that are uniform in the workspace, see :class:`UniformScenes`."""

    def __init__(self, collision_model: CollisionModel, distribution: Distribution) -> None:
        order = DRAW_ORDER[distribution.dimension]._replace(groups=UNIFORM_GROUPS)
        super().__init__(collision_model, distribution, order=order)
        self._uniform = UniformScenes(collision_model, _drawn(distribution))

    @property
    def _size(self) -> int:
        return self._uniform.size + self._reshape_size

    def _attempt(self, uniforms: Uniforms, ends: Ends) -> tuple[Index, Scenes]:
        rows, scenes = self._uniform(uniforms, ends)
        return self._reshaped(uniforms.at(rows), rows, scenes)


class MixedSampler(SceneSampler):
    """Sampler of scenes of which a share is uniform in the workspace.

    The first random number of each scene says from which of the two samplers it comes.
    """

    def __init__(self, collision_model: CollisionModel, distribution: Distribution) -> None:
        super().__init__(collision_model, distribution)
        self._uniform = UniformSampler(collision_model, distribution)

    def __call__(self, generators: Sequence[np.random.Generator], ends: Ends = None) -> Scenes:
        """Sample one scene from each generator, see :meth:`SceneSampler.__call__`."""
        number, d = len(generators), self.arm.dimension
        uniform = np.array([each.random() for each in generators]) < self.distribution.uniform_share
        most = self.distribution.n_obstacles[1]
        scenes = Scenes(
            np.zeros((number, d)), np.zeros((number, d)), np.zeros((number, most, self._row_size))
        )
        for rows, sample in (
            (np.flatnonzero(uniform), self._uniform),
            (np.flatnonzero(~uniform), super().__call__),
        ):
            if rows.size:
                some = None if ends is None else (ends[0][rows], ends[1][rows])
                scenes.put(rows, sample([generators[int(row)] for row in rows], some))
        return scenes


class AttemptNumbers:
    """Uniform numbers for attempts at N scenes.

    While few scenes are left, several groups of attempts are drawn at once, as computing them together is faster. The
    generators are then put back to where the group of the first good attempt ended, so results do not depend on it.

    Args:
        generators: N generators; if several scenes share one, only one group is drawn at once.
        size: Numbers of one attempt.
        order: Groups of attempts.
    """

    def __init__(self, generators: Sequence[np.random.Generator], size: int, order: DrawOrder) -> None:
        self._generators, self._size, self._order = generators, size, order
        self._apart = len({id(each.bit_generator) for each in generators}) == len(generators)
        self._ahead = min(order.ahead * max(len(generators) // 2, 1), MOST_AHEAD)
        self._group = 0
        self._groups: tuple[int, ...] = ()
        self._states: list[list[Any]] = []

    @property
    def made(self) -> int:
        """Attempts at each scene so far."""
        return sum(self._order.groups[: self._group])

    @property
    def exhausted(self) -> bool:
        """Flag: there are no further attempts."""
        return self._group >= len(self._order.groups)

    def draw(self, scenes: Int) -> Float:
        """Return numbers of the next attempts at P scenes, shape (P, attempts, size)."""
        groups = self._order.groups[self._group :]
        self._groups = groups[:1]
        for attempts in groups[1:] if self._apart else ():
            if len(scenes) * (sum(self._groups) + attempts) > self._ahead:
                break
            self._groups += (attempts,)
        self._group += len(self._groups)
        drawn = np.empty((len(scenes), sum(self._groups), self._size))
        self._states = [
            self._fill(self._generators[int(i)], each) for i, each in zip(scenes, drawn, strict=True)
        ]
        return drawn

    def put_back(self, scenes: Int, first: Int) -> None:
        """Put the generators of P scenes back to the end of the group of the first good attempt, -1 for none."""
        if len(self._groups) == 1:
            return
        ends = np.cumsum(self._groups)
        for i, states, attempt in zip(scenes, self._states, first, strict=True):
            if 0 <= attempt < ends[-1] - self._groups[-1]:
                self._generators[int(i)].bit_generator.state = states[int((attempt >= ends).sum())]

    def _fill(self, generator: np.random.Generator, drawn: Float) -> list[Any]:
        """Fill the rows of each group; return the states of the generator after all but the last."""
        states, begin = [], 0
        for attempts in self._groups:
            if begin:
                states.append(generator.bit_generator.state)
            generator.random(out=drawn[begin : begin + attempts])
            begin += attempts
        return states


def scene_sampler(collision_model: CollisionModel, distribution: Distribution) -> SceneSampler:
    """Return the sampler of a distribution."""
    kind = MixedSampler if distribution.uniform_share else SceneSampler
    return kind(collision_model, distribution)


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


def sampler_of_family(
    collision_model: CollisionModel, distribution: Distribution, family: str
) -> SceneSampler:
    """Return a sampler of one family of scenes.

    Raises:
        ValueError: There is no such family, or it needs more obstacles than the task has.
    """
    families, most = scene_families(distribution.dimension), distribution.n_obstacles[1]
    if family not in families:
        raise ValueError(f"family must be one of {', '.join(families)}, got {family!r}")
    record = families[family]
    if not set(record.shapes) <= {*distribution.shapes, *CAPSULES}:
        raise ValueError(
            f"{family} needs a task with the shapes {', '.join(record.shapes)}, this one has "
            f"{', '.join(distribution.shapes)}"
        )
    if most < record.n_obstacles:
        raise ValueError(
            f"{family} needs a task with up to {record.n_obstacles} obstacles, this one has {most} at most"
        )
    if isinstance(distribution, SpaceDistribution):
        return SceneSampler(collision_model, dataclasses.replace(distribution, families=(family,)))
    planar = dataclasses.replace(distribution, n_obstacles=(1, min(FAMILY_ROWS, most)))
    obstacles = FamilyObstacles(collision_model, planar, record.build)
    order = DRAW_ORDER[2]._replace(groups=(1,) * FAMILY_ATTEMPTS)
    return SceneSampler(collision_model, planar, obstacles=obstacles, order=order)
