"""Sampling of changes of scenes: jumps of the target and motions of obstacles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from viapoint import primitives
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.common.validation import fewest_and_most
from viapoint.envs.scenes.draws import Uniforms, between, directions, whole_between
from viapoint.envs.scenes.dynamic_scene import MOST_JUMPS, ChangingScenes
from viapoint.envs.scenes.scene import FARTHEST_CENTRE, Scenes, rest_clearance

CANDIDATES, ATTEMPTS = 8, 40
"""Candidates for a jump or a course, and attempts at the jumps of an episode."""
REDRAWN = 100
"""Attempts to replace a scene in which no jump fits: one in a few hundred of some tasks."""
N_TIMES = 10
"""Times at which the clearance of start and goal is computed."""


@dataclass(frozen=True, kw_only=True)
class ChangeDistribution:
    """Distribution of the changes of scenes; times are relative to the centre duration of a movement."""

    n_jumps: tuple[int, int] = (0, 0)
    """Fewest and most jumps of the target."""
    moving: bool = False
    """Flag: obstacles move."""
    first_jump: tuple[float, float] = (0.1, 0.7)
    """Time of the first jump."""
    next_jump: tuple[float, float] = (0.4, 0.9)
    """Time from a jump to the next."""
    jump_distance: tuple[float, float] = (0.10, 0.30)
    """Distance from a target to the next, [m]."""
    steepness: float = 0.5
    """Greatest height gained by a jump or an obstacle in space, relative to the distance."""
    speed: tuple[float, float] = (0.05, 0.30)
    """Speed of the obstacles, [m/s]."""
    turning: float = 0.5
    """Share of the obstacles that change their course."""
    turn: tuple[float, float] = (0.2, 0.7)
    """Time of the change of course."""
    meeting: tuple[float, float] = (0.25, 0.6)
    """Time at which an obstacle is where it would stand if it did not move."""
    end_margin: float = 0.015
    """Least clearance of the arm at the start, and at the goal while movements may end, [m]."""
    reach_margin: float = 0.03
    """Least distance of targets from the border of the reach, [m]."""

    def __post_init__(self) -> None:
        """Check the number of jumps."""
        number = fewest_and_most("n_jumps", self.n_jumps, MOST_JUMPS, MOST_JUMPS)
        object.__setattr__(self, "n_jumps", number)


class ChangeSampler:
    """Sampler of the changes of scenes, each from a random generator of its own.

    The durations are the shortest, the centre and the longest of a movement, [s].
    """

    def __init__(
        self,
        collision_model: CollisionModel,
        distribution: ChangeDistribution,
        *,
        durations: tuple[float, float, float],
    ) -> None:
        self.collision_model, self.arm, self.distribution = collision_model, collision_model.arm, distribution
        self._shortest, self._centre, self._longest = durations

    def __call__(
        self,
        generators: Sequence[np.random.Generator],
        scenes: Scenes,
        jumps: Float | None = None,
        courses: Float | None = None,
        *,
        again: Callable[[Int], Scenes] | None = None,
    ) -> ChangingScenes:
        """Sample the changes of N scenes.

        Args:
            generators: N random generators.
            scenes: N scenes; obstacles whose courses are sampled get there when a movement may meet them.
            jumps: Given jumps, shape (N, MOST_JUMPS, D + 1).
            courses: Given courses, shape (N, n, 2 D + 1).
            again: Function that samples other scenes instead of those in which no jump fits; by default these raise.

        Raises:
            RuntimeError: No jump that fits was found in many attempts.
        """
        changing, left = self._changing(generators, scenes, jumps, courses)
        for _ in range(REDRAWN if again else 0):
            if not left.size:
                break
            assert again is not None
            others, still = self._changing([generators[int(i)] for i in left], again(left), jumps, courses)
            changing.put(left, others)
            left = left[still]
        if left.size:
            start, goal = changing.start[left[0]], changing.goal[left[0]]
            raise RuntimeError(
                f"no jump of the target was found in {ATTEMPTS} attempts from start {start}, goal {goal}"
            )
        return changing

    def _changing(
        self,
        generators: Sequence[np.random.Generator],
        scenes: Scenes,
        jumps: Float | None,
        courses: Float | None,
    ) -> tuple[ChangingScenes, Int]:
        """Return N scenes with changes, and the indices of those in which no jump fits."""
        number, dimension = scenes.start.shape
        still = np.zeros((number, scenes.obstacles.shape[1], 2 * dimension + 1))
        none = np.zeros((number, MOST_JUMPS, dimension + 1))
        obstacles, moving = scenes.obstacles, still if courses is None else courses
        if courses is None and self.distribution.moving and still.size:
            obstacles, moving = self._courses(generators, scenes)
        changing = ChangingScenes(scenes.start, scenes.goal, obstacles, none, moving)
        if jumps is not None:
            return changing._replace(jumps=jumps), np.arange(0)
        if not self.distribution.n_jumps[1]:
            return changing, np.arange(0)
        return changing, self._jump(generators, changing)

    def _jump(self, generators: Sequence[np.random.Generator], scenes: ChangingScenes) -> Int:
        """Sample the jumps of scenes, all of an episode at once, and return the scenes in which none fit."""
        most = self.distribution.n_jumps[1]
        pending = np.arange(len(scenes.start))
        size = 1 + most * (1 + 3 * CANDIDATES)
        for _ in range(ATTEMPTS):
            if not len(pending):
                break
            u = Uniforms(np.stack([generators[int(i)].random(size) for i in pending]))
            number = whole_between(self.distribution.n_jumps, u.take(1)[:, 0])
            good, jumps = self._attempt(u, number, scenes.take(pending))
            scenes.jumps[pending[good]] = jumps[good]
            pending = pending[~good]
        return pending

    def _attempt(self, uniforms: Uniforms, number: Float, scenes: ChangingScenes) -> tuple[Bool, Float]:
        """Return which of N episodes get all their jumps, and the jumps; the hand is assumed to make no detours."""
        d, centre = self.distribution, self._centre
        jumps, good = np.zeros_like(scenes.jumps), np.ones(len(number), dtype=bool)
        target, each = scenes.goal, np.arange(len(number))
        movement = primitives.point_to_point(scenes.start, target, centre)
        before = np.zeros(len(number))
        for k in range(d.n_jumps[1]):
            wait = centre * between(d.next_jump if k else d.first_jump, uniforms.take(1)[:, 0])
            time = before + wait
            targets = self._targets(uniforms, target)
            state = [part[:, 0] for part in movement.sample(wait[:, None])]
            position, velocity, acceleration = (np.repeat(part[:, None], CANDIDATES, 1) for part in state)
            revised = primitives.point_to_point(
                position, targets, centre, start_velocity=velocity, start_acceleration=acceleration
            )
            fits = self._fits(scenes, time, targets, revised(np.linspace(0.0, centre, N_TIMES)))
            chosen, some = fits.argmax(axis=-1), number > k
            target = np.where(some[:, None], targets[each, chosen], target)
            good &= fits.any(axis=-1) | ~some
            jumps[some, k] = np.concatenate((time[:, None], target), axis=-1)[some]
            movement = primitives.point_to_point(
                state[0], target, centre, start_velocity=state[1], start_acceleration=state[2]
            )
            before = time
        return good, jumps

    def _targets(self, uniforms: Uniforms, target: Float) -> Float:
        """Return candidates for the next target, shape (N, CANDIDATES, D), [m]."""
        angle, length = 2.0 * np.pi * uniforms.take(CANDIDATES), uniforms.take(CANDIDATES)
        step = self._direction(angle, uniforms.take(CANDIDATES), target.shape[-1])
        return np.asarray(
            target[:, None] + between(self.distribution.jump_distance, length)[..., None] * step
        )

    def _fits(self, scenes: ChangingScenes, time: Float, targets: Float, paths: Float) -> Bool:
        """Return which targets are in the workspace, free when they appear, and have a direct path within reach."""
        low, high = (np.array(corner) for corner in self.arm.workspace)
        inside = ((targets >= low) & (targets <= high)).all(axis=-1)
        inside &= np.asarray(self.arm.reach_margin(targets)) > self.distribution.reach_margin
        inside &= (np.asarray(self.arm.reach_margin(paths)) > 0.5 * self.distribution.reach_margin).all(
            axis=-1
        )
        then = scenes.at(time)
        many = Scenes(*(np.repeat(field, CANDIDATES, axis=0) for field in then))
        clearance = rest_clearance(many, targets.reshape(-1, targets.shape[-1]), self.collision_model)
        free: Bool = inside & (clearance.min(axis=-1).reshape(inside.shape) > self.distribution.end_margin)
        return free

    def _courses(self, generators: Sequence[np.random.Generator], scenes: Scenes) -> tuple[Float, Float]:
        """Return obstacles at the start and their courses; an obstacle stands still if no course fits."""
        d, (number, rows) = self.distribution, scenes.obstacles.shape[:2]
        size, dimension = rows * CANDIDATES, scenes.start.shape[-1]
        u = Uniforms(np.stack([generator.random(9 * size) for generator in generators]))
        velocities = [self._velocity(u, size, dimension) for _ in range(2)]
        turns = u.take(size) < d.turning
        turn = np.where(turns, self._centre * between(d.turn, u.take(size)), 0.0)
        velocities[1] = np.where(turns[..., None], velocities[1], velocities[0])
        meeting = self._centre * between(d.meeting, u.take(size))
        courses = np.concatenate((velocities[0], turn[..., None], velocities[1]), axis=-1)
        at_rest = np.repeat(scenes.obstacles, CANDIDATES, axis=1)
        many = ChangingScenes(
            scenes.start, scenes.goal, at_rest, np.zeros((number, 0, dimension + 1)), courses
        )
        ahead = _moved(many, meeting)[..., :dimension] - at_rest[..., :dimension]
        many.obstacles[..., :dimension] -= np.where(many.present[..., None], ahead, 0.0)
        fits = self._free(many).reshape(number, rows, CANDIDATES)
        first = fits.argmax(axis=-1) + CANDIDATES * np.arange(rows)
        some = (fits.any(axis=-1) & scenes.present)[..., None]
        each = np.arange(number)[:, None]
        return np.where(some, many.obstacles[each, first], scenes.obstacles), np.where(
            some, courses[each, first], 0.0
        )

    def _velocity(self, uniforms: Uniforms, size: int, dimension: int) -> Float:
        angle = 2.0 * np.pi * uniforms.take(size)
        speed = between(self.distribution.speed, uniforms.take(size))
        return np.asarray(speed[..., None] * self._direction(angle, uniforms.take(size), dimension))

    def _direction(self, angle: Float, height: Float, dimension: int) -> Float:
        """Return unit vectors; in space a uniform number, the height, makes them climb or fall."""
        steepness = self.distribution.steepness if dimension == 3 else 0.0
        return directions(angle, steepness * (2.0 * height - 1.0), dimension)

    def _free(self, many: ChangingScenes) -> Bool:
        """Return which obstacles leave start and goal free at first, and the goal while movements may end."""
        d, dimension = self.distribution, many.start.shape[-1]
        good = (np.abs(many.obstacles[..., :dimension]) < FARTHEST_CENTRE).all(axis=-1)
        at_first = np.linspace(0.0, 0.2 * self._centre, 3)
        at_last = np.append(0.0, np.linspace(self._shortest, 1.2 * self._longest, N_TIMES))
        for point, times in ((many.start, at_first), (many.goal, at_last)):
            rows = many.places(np.repeat(times[None], len(point), axis=0))
            scenes = Scenes(many.start, many.goal, rows.reshape(len(rows), -1, rows.shape[-1]))
            clearance = rest_clearance(scenes, point, self.collision_model)[:, :-1]
            good &= (clearance.reshape(rows.shape[:3]) > d.end_margin).all(axis=1)
        return np.asarray(good)


def _moved(many: ChangingScenes, time: Float) -> Float:
    """Return obstacles, shape (N, n, 2 D + 1), each at a time of its own, shape (N, n), [s]."""
    number, rows = time.shape
    each = ChangingScenes(
        np.repeat(many.start, rows, axis=0),
        np.repeat(many.goal, rows, axis=0),
        many.obstacles.reshape(-1, 1, many.obstacles.shape[-1]),
        np.zeros((number * rows, *many.jumps.shape[1:])),
        many.courses.reshape(-1, 1, many.courses.shape[-1]),
    )
    return each.places(time.reshape(-1, 1)).reshape(number, rows, -1)
