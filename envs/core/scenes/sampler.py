"""Rejection sampling of scenes.

A layout is drawn, then several pairs of start and goal for it. A scene is accepted if both ends are free and the straight
movement between them is not. A scene depends on its own random generator only, whatever the batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from viapoint.envs.common.types import Bool, Float, Int
from viapoint.envs.common.validation import fewest_and_most
from viapoint.envs.core.arms.arm import Arm
from viapoint.envs.core.geometry.obstacles import ABSENT, Obstacles, no_obstacles
from viapoint.envs.core.plans import SpaceName
from viapoint.envs.core.scenes.ends import Attempts, Mover, draw_ends
from viapoint.envs.core.scenes.families_registry import check_families, scene_families
from viapoint.envs.core.scenes.layout import PLACE, ROW, TALL, Layout, Room
from viapoint.envs.core.scenes.motions import Changes, draw_courses, draw_jumps
from viapoint.envs.core.scenes.scene import MOST_JUMPS, Scenes, resting

LOW_HALF_HEIGHT, TALL_HALF_HEIGHT = 0.04, 0.3
"""Half heights of obstacles in the plane that the hand alone must clear, and that links must clear, too, [m]."""
PLANE_MARGIN, SPACE_MARGIN = 0.025, 0.02
"""Least clearance of starts and goals from obstacles, [m]."""
LEAST_WAY = 0.5
"""Least length of the way from start to goal in joint space, [rad]."""
PLANE_REACH, SPACE_REACH = 0.6755, 0.97
"""Reaches of the tools of the reference arms, measured from joint 2, [m]."""
SHOULDER = 0.333
"""Height of joint 2 of the reference arm in space, [m]."""
ATTEMPTS, FAMILY_ATTEMPTS = 1000, 50
"""Layouts that are drawn for a scene at most, and layouts after which another family is tried."""
MOST_PLACES = 8
"""Greatest number of places of a layout."""


class Given(NamedTuple):
    """Parts of N scenes that are given and not drawn; None for those that are drawn."""

    start: Float | None = None
    """Joint positions, shape (N, J)."""
    goal: Float | None = None
    """Joint positions, shape (N, J)."""
    obstacles: Obstacles | None = None
    """Obstacles, with as many rows as the sampler's scenes."""
    jumps: Float | None = None
    """Jumps of the target, shape (N, MOST_JUMPS, J + 1)."""
    turns: tuple[Float, Float] | None = None
    """Times and velocities of changes of course, shape (N, n) and (N, n, 3)."""


class SceneSampler:
    """Sampler of scenes for an arm.

    Args:
        arm: Arm.
        space: Space in which the straight movement is straight: `hand` or `joints`.
        n_obstacles: Fewest and most obstacles; furniture has as many as it needs.
        kinds: Kinds that obstacles may have.
        families: Names of families, drawn with equal chances; a repeated name is drawn more often.
        rows: Rows for obstacles in the scenes, at least as many as are drawn.
        tall: True if obstacles in the plane are in the way of the links, too.
        jumps: Fewest and most jumps of the target.
        moving: True if obstacles move.
        durations: Shortest, centre and longest duration of a movement, [s]; in joint space relative to the shortest
            duration of the straight movement that the velocity limits of the joints allow.

    Raises:
        ValueError: A number or name is not allowed.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        space: SpaceName,
        n_obstacles: tuple[int, int],
        kinds: tuple[str, ...],
        families: tuple[str, ...],
        rows: int,
        tall: bool = False,
        jumps: tuple[int, int] = (0, 0),
        moving: bool = False,
        durations: tuple[float, float, float] = (0.5, 0.8, 1.2),
    ) -> None:
        fewest, most = fewest_and_most("n_obstacles", n_obstacles, rows, rows)
        fewest_and_most("jumps", jumps, MOST_JUMPS, MOST_JUMPS)
        self.arm, self.space, self.kinds, self.rows = arm, space, kinds, rows
        self.plane = is_planar(arm)
        self.families = check_families(families, self.plane, kinds, most)
        self.room = room_of(arm, self.plane, kinds, (fewest, most), tall)
        self.changes = Changes(jumps[0], jumps[1], moving, durations)
        self.mover = Mover(
            arm.chain,
            arm.spheres,
            arm.joint_range,
            arm.velocity_limit,
            arm.home,
            self.plane,
            space == "hand",
            PLANE_MARGIN if self.plane else SPACE_MARGIN,
            0.0 if self.plane else LEAST_WAY,
        )
        self._builds = [scene_families(self.plane)[name].build for name in self.families]
        self._candidates = max(2 * most + 2, rows)

    def __call__(self, generators: Sequence[np.random.Generator], given: Given | None = None) -> Scenes:
        """Draw one scene from each of N random generators.

        Args:
            generators: N random generators.
            given: Parts of the scenes that are not drawn.

        Raises:
            RuntimeError: No scene was found in many attempts.
        """
        given = given or Given()
        number, joints = len(generators), len(self.arm.home)
        attempts = Attempts.empty(number, self._candidates, MOST_PLACES, joints)
        ends = np.zeros((number, 2, joints))
        for end, configurations in enumerate((given.start, given.goal)):
            if configurations is not None:
                ends[:, end] = configurations
                attempts.fixed[:, end] = True
        obstacles = given.obstacles or no_obstacles(number, self._candidates)
        scenes = resting(ends[:, 0], ends[:, 1], obstacles)
        rooms = self._rooms(number, given)
        builds = [self._any_family(rng) for rng in generators]
        pending = np.arange(number)
        for attempt in range(ATTEMPTS):
            for i in pending:
                rng = generators[i]
                if attempt and attempt % FAMILY_ATTEMPTS == 0:
                    builds[i] = self._any_family(rng)
                layout = builds[i](rng, rooms[i])
                self._write(attempts, int(i), layout, given)
                rng.random(out=attempts.numbers[i])
            found = draw_ends(self.mover, attempts, pending, ends, obstacles)
            found &= self._change(generators, pending, found, scenes, given)
            pending = pending[~found]
            if not len(pending):
                return self._without_spare_rows(scenes)
        raise RuntimeError(
            f"no scene of the families {', '.join(self.families)} with {self.room.fewest} to {self.room.most} "
            f"obstacles was found in {ATTEMPTS} attempts for the arm {self.arm.name!r}; allow fewer obstacles or "
            "other families, or give other ends"
        )

    def _any_family(self, rng: np.random.Generator) -> Build:
        """Return the function of a random family."""
        return self._builds[int(len(self._builds) * rng.random())]

    def _rooms(self, number: int, given: Given) -> list[Room]:
        """Return the room of each scene; in the plane it tells the ends that are given."""
        room = self.room if given.obstacles is None else self.room._replace(fewest=0, most=0)
        if not self.plane or (given.start is None and given.goal is None):
            return [room] * number
        ends: list[list[Any]] = []
        for joints in (given.start, given.goal):
            if joints is None:
                ends.append([None] * number)
                continue
            hand = (self.arm.hand(joints) - np.array(room.foot)) / room.scale
            ends.append([(float(x), float(y)) for x, y, _ in hand])
        return [room._replace(start=start, goal=goal) for start, goal in zip(*ends, strict=True)]

    def _write(self, attempts: Attempts, scene: int, layout: Layout, given: Given) -> None:
        """Write a layout into the tables of attempts."""
        rows, starts, goals, keep = layout.rows, layout.starts, layout.goals, layout.keep
        attempts.keep[scene] = keep
        if given.obstacles is None:
            attempts.count[scene] = len(rows) // ROW
            attempts.rows[scene, : len(rows)] = rows
        for end, places in enumerate((starts, goals)):
            attempts.places[scene, end, : len(places)] = places
            attempts.n_places[scene, end] = len(places) // PLACE

    def _change(
        self,
        generators: Sequence[np.random.Generator],
        scenes: Scenes,
        which: Int,
        given: Given,
    ) -> Bool:
        """Draw the changes of the scenes at some indices, and return True for those in which they fit, shape (K,)."""
        number, joints = len(which), len(self.arm.home)
        obstacles, turns = scenes.obstacles, Turns(scenes.turn_time, scenes.turn_velocity)
        ends = np.stack((scenes.start, scenes.goal), axis=1)
        thing = self.mover, self.changes, which, ends, obstacles, turns
        if self.changes.moving and given.obstacles is None:
            numbers = np.empty((number, obstacles.kind.shape[1], CANDIDATES, NUMBERS_OF_COURSE))
            for k, scene in enumerate(which):
                generators[scene].random(out=numbers[k])
            draw_courses(*thing, numbers)
        if self.changes.most_jumps == 0 or given.jumps is not None:
            return np.ones(number, bool)
        numbers = np.empty((number, numbers_of_jumps(joints)))
        for k, scene in enumerate(which):
            generators[scene].random(out=numbers[k])
        return draw_jumps(*thing, scenes.jumps, numbers)


def is_planar(arm: Arm) -> bool:
    """Return True for an arm of two hinges with vertical axes."""
    if len(arm.home) != 2 or arm.chain.sliding.any():
        return False
    placed = memory(arm.chain, arm.spheres)
    place(arm.chain, arm.spheres, arm.home, placed)
    return bool((np.abs(placed.rotation[1:, 2, 2]) > 1.0 - 1e-6).all())


def room_of(arm: Arm, kinds: tuple[str, ...], n_obstacles: tuple[int, int], tall: bool) -> Room:
    """Return the room for layouts around an arm."""
    plane = is_planar(arm)
    rng = np.random.default_rng(0)
    low, high = arm.joint_range.T
    joints = rng.uniform(low, high, (REACH_SAMPLES, len(low)))
    foot = arm.chain.origin[0].copy()
    reach = float(np.sqrt(((arm.hand(joints) - foot) ** 2).sum(axis=-1)).max())
    scale = reach / (PLANE_REACH if plane else SPACE_REACH)
    foot[2] = 0.0 if plane else foot[2] - SHOULDER * scale
    ...
