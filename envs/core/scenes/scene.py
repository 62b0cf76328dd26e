"""Scenes: start, goal and obstacles of movements, their changes, and checks of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.types import Bool, Float
from viapoint.envs.core.arms.arm import Arm
from viapoint.envs.core.arms.chain import Chain, Spheres
from viapoint.envs.core.geometry.clearance import FAR, Placed, memory, place, place_group, self_clearance
from viapoint.envs.core.geometry.compiled import compiled
from viapoint.envs.core.geometry.distance import point_distance
from viapoint.envs.core.geometry.obstacles import (
    ABSENT,
    BOX,
    CAPSULE,
    CYLINDER,
    HALF_SPACE,
    MESH,
    SPHERE,
    Obstacles,
    no_obstacles,
)

MOST_JUMPS = 4
"""Greatest number of jumps of the target in an episode."""
NEVER = 1e9
"""Time of a change that does not happen, [s]."""
ROUNDING = 1e-9
"""Rounding error of times, [s], and joint positions, [rad]."""
LEAST_APART = 0.02
"""Least difference of start and goal in the joint that moves most, [rad] or [m]."""
FARTHEST = 2.0
"""Greatest coordinate and half length of an obstacle, [m]; half-spaces have none."""
FASTEST = 1.0
"""Greatest speed of an obstacle, [m/s]."""
LENGTHS = {SPHERE: 1, CAPSULE: 2, CYLINDER: 2, BOX: 3}
"""Number of sizes that must be positive, by kind."""


class Scenes(NamedTuple):
    """N scenes of up to n obstacles each, for an arm of J joints."""

    start: Float
    """Joint positions at the start, shape (N, J), [rad] or [m]."""
    goal: Float
    """Joint positions of the first target, shape (N, J), [rad] or [m]."""
    obstacles: Obstacles
    """Obstacles at time 0."""
    jumps: Float
    """Jumps of the target in the order of time: rows (time [s], joint positions), shape (N, MOST_JUMPS, J + 1).

    Absent rows are zero.
    """
    turn_time: Float
    """Times at which obstacles change their velocity, shape (N, n), [s]; NEVER where they do not."""
    turn_velocity: Float
    """Velocities after the change, shape (N, n, 3), [m/s]."""

    def take(self, rows: Any) -> Scenes:
        """Return the scenes at `rows`, an index array, slice or mask."""
        return Scenes(
            self.start[rows],
            self.goal[rows],
            self.obstacles.take(rows),
            self.jumps[rows],
            self.turn_time[rows],
            self.turn_velocity[rows],
        )

    def put(self, rows: Any, scenes: Scenes) -> Scenes:
        """Return the scenes after the ones at `rows` were overwritten in place; only tables of shapes are new."""
        self.start[rows] = scenes.start
        self.goal[rows] = scenes.goal
        self.jumps[rows] = scenes.jumps
        self.turn_time[rows] = scenes.turn_time
        self.turn_velocity[rows] = scenes.turn_velocity
        return self._replace(obstacles=self.obstacles.put(rows, scenes.obstacles))

    @classmethod
    def together(cls, parts: Sequence[Scenes]) -> Scenes:
        """Return the scenes of several records in one, which shares no memory with them."""
        number = sum(len(part.start) for part in parts)
        obstacles = no_obstacles(number, parts[0].obstacles.kind.shape[1])
        first = 0
        for part in parts:
            last = first + len(part.start)
            obstacles = obstacles.put(slice(first, last), part.obstacles)
            first = last
        return cls(
            start=np.concatenate([part.start for part in parts]),
            goal=np.concatenate([part.goal for part in parts]),
            obstacles=obstacles,
            jumps=np.concatenate([part.jumps for part in parts]),
            turn_time=np.concatenate([part.turn_time for part in parts]),
            turn_velocity=np.concatenate([part.turn_velocity for part in parts]),
        )

    @property
    def jump_times(self) -> Float:
        """Times of the jumps, shape (N, MOST_JUMPS), [s]; NEVER for none."""
        return np.where((self.jumps != 0.0).any(axis=-1), self.jumps[..., 0], NEVER)

    def goals(self, time: Float) -> Float:
        """Return the targets, shape (N, J), at one time for each scene, shape (N,), [s]; a jump counts at once."""
        number = (self.jump_times <= time[:, None] + ROUNDING).sum(axis=-1)
        targets = np.concatenate((self.goal[:, None], self.jumps[..., 1:]), axis=1)
        return np.asarray(targets[np.arange(len(targets)), number])

    def obstacles_at(self, time: Float) -> Obstacles:
        """Return the obstacles with their places and velocities at one time for each scene, shape (N,), [s]."""
        time = time[:, None]
        before = np.minimum(time, self.turn_time)[..., None]
        after = np.maximum(time - self.turn_time, 0.0)[..., None]
        velocity = self.obstacles.velocity
        centre = self.obstacles.centre + velocity * before + self.turn_velocity * after
        turned = (self.turn_time <= time + ROUNDING)[..., None]
        now = np.where(turned, self.turn_velocity, velocity)
        return self.obstacles._replace(centre=centre, velocity=now)


def resting(start: Float, goal: Float, obstacles: Obstacles) -> Scenes:
    """Return scenes without jumps and changes of course."""
    number, joints = start.shape
    return Scenes(
        start,
        goal,
        obstacles,
        np.zeros((number, MOST_JUMPS, joints + 1)),
        np.full(obstacles.kind.shape, NEVER),
        np.zeros(obstacles.centre.shape),
    )


@compiled
def row_clearance(
    spheres: Spheres, placed: Placed, obstacles: Obstacles, scene: int, row: int, time: float, floor: float
) -> float:
    """Return the clearance of a placed arm from one obstacle, at most FAR, without its base, [m].

    The search stops at the first clearance below `floor`; the exact value below it does not matter.
    """
    least = FAR
    if obstacles.kind[scene, row] == ABSENT:
        return least
    for group in range(len(spheres.link)):
        if spheres.link[group] == 0:
            continue
        ball = placed.ball[group]
        size = spheres.ball_radius[group]
        away = point_distance(obstacles, scene, row, ball[0], ball[1], ball[2], time, least + size)
        if away - size >= least:
            continue
        place_group(spheres, group, placed)
        for sphere in range(spheres.first[group], spheres.first[group + 1]):
            here, radius = placed.centre[sphere], spheres.radius[sphere]
            away = point_distance(obstacles, scene, row, here[0], here[1], here[2], time, least + radius)
            least = min(least, away - radius)
            if least < floor:
                return least
    return least


@compiled
def row_clearances(
    chain: Chain, spheres: Spheres, joints: Float, obstacles: Obstacles
) -> tuple[Float, Float]:
    """Return the clearances of N arms from n obstacles at time 0, shape (N, n), and from themselves, shape (N,), [m].

    Args:
        chain: Chain of the arm.
        spheres: Spheres of the arm.
        joints: Joint positions, shape (N, J).
        obstacles: Obstacles of N scenes.
    """
    placed = memory(chain, spheres)
    number, rows = obstacles.kind.shape
    found, own = np.empty((number, rows)), np.empty(number)
    for scene in range(number):
        place(chain, spheres, joints[scene], placed)
        own[scene] = self_clearance(spheres, placed, FAR, -FAR)
        for row in range(rows):
            found[scene, row] = row_clearance(spheres, placed, obstacles, scene, row, 0.0, -FAR)
    return found, own


@compiled
def contains_base(chain: Chain, spheres: Spheres, joints: Float, obstacles: Obstacles) -> Bool:
    """Return True for obstacles that contain all spheres of the base, shape (N, n)."""
    placed = memory(chain, spheres)
    place(chain, spheres, joints, placed)
    found = np.zeros(obstacles.kind.shape, np.bool_)
    for scene in range(found.shape[0]):
        for row in range(found.shape[1]):
            if obstacles.kind[scene, row] == ABSENT:
                continue
            outside = False
            some = False
            for group in range(len(spheres.link)):
                if spheres.link[group] != 0:
                    continue
                place_group(spheres, group, placed)
                for sphere in range(spheres.first[group], spheres.first[group + 1]):
                    here, radius = placed.centre[sphere], spheres.radius[sphere]
                    away = point_distance(obstacles, scene, row, here[0], here[1], here[2], 0.0, FAR)
                    some = True
                    outside = outside or away + radius > 0.0
            found[scene, row] = some and not outside
    return found


class Check:
    """Check of N scenes; its methods raise ValueError for the first scene that has a fault.

    Args:
        scenes: Scenes.
        arm: Arm.
        names: Names of the obstacles, for messages: one list for each scene.
    """

    def __init__(self, scenes: Scenes, arm: Arm, names: Sequence[Sequence[str]] = ()) -> None:
        self.scenes, self.arm, self.names = scenes, arm, names

    def all(self) -> None:
        """Check that a movement can start and end in each scene, and its changes."""
        self.obstacles()
        for name, joints in (("start", self.scenes.start), ("goal", self.scenes.goal)):
            self.end(name, joints, self.scenes.obstacles)
        apart = np.abs(self.scenes.goal - self.scenes.start).max(axis=-1)
        self._refuse(apart < LEAST_APART, f"start and goal must differ by {LEAST_APART} or more in a joint", apart)
        self.changes()

    def obstacles(self) -> None:
        """Check sizes, places and velocities of obstacles."""
        obstacles = self.scenes.obstacles
        kind, present = obstacles.kind, obstacles.present
        parts = (obstacles.centre, obstacles.size, obstacles.velocity, self.scenes.turn_velocity)
        for values in parts:
            finite = np.isfinite(values).all(axis=-1)
            self._refuse_row(present & ~finite, "must be finite")
        for number, count in LENGTHS.items():
            size = obstacles.size[..., :count]
            wrong = (size.min(axis=-1) <= 0.0) | (size.max(axis=-1) > FARTHEST)
            self._refuse_row((kind == number) & wrong, f"must have sizes over 0 and up to {FARTHEST:g} m")
        wide = (kind >= MESH) & (obstacles.size[..., 1] > FARTHEST)
        self._refuse_row(wide, f"must reach at most {FARTHEST:g} m from its own origin")
        far = present & (kind != HALF_SPACE) & (np.abs(obstacles.centre).max(axis=-1) > FARTHEST)
        self._refuse_row(far, f"must have its centre at most {FARTHEST:g} m from the origin along each axis")
        for velocity in (obstacles.velocity, self.scenes.turn_velocity):
            speed = np.sqrt((velocity**2).sum(axis=-1))
            self._refuse_row(present & (speed > FASTEST), f"must be at most {FASTEST:g} m/s fast", speed)
        inside = contains_base(self.arm.chain, self.arm.spheres, self.arm.home, obstacles)
        self._refuse_row(inside, "may touch the base of the arm, but not contain all of it")

    def end(self, name: str, joints: Float, obstacles: Obstacles, where: Bool | None = None) -> None:
        """Check an end: finite, inside the joint limits, and free of the arm itself and of obstacles.

        Args:
            name: Name of the end.
            joints: Joint positions, shape (N, J).
            obstacles: Obstacles at the time of the end.
            where: True for scenes that have this end, shape (N,); by default all have it.
        """
        there = np.ones(len(joints), bool) if where is None else where
        self._refuse(there & ~np.isfinite(joints).all(axis=-1), f"{name} must be finite")
        for joint, (low, high) in enumerate(self.arm.joint_range):
            position = joints[:, joint]
            outside = (position < low - ROUNDING) | (position > high + ROUNDING)
            named = f"{name}: joint {self.arm.joint_names[joint]!r}"
            self._refuse(there & outside, f"{named} must be from {low:.4g} to {high:.4g}", position)
        rows, own = row_clearances(self.arm.chain, self.arm.spheres, joints, obstacles)
        self._refuse(there & (own <= 0.0), f"{name}: the arm touches itself; its clearance must be over 0 m", own)
        touches = f"touches the arm at the {name}; its clearance must be over 0 m"
        self._refuse_row(there[:, None] & obstacles.present & (rows <= 0.0), touches, rows)

    def changes(self) -> None:
        """Check jumps of the target and changes of course."""
        scenes = self.scenes
        turns = scenes.obstacles.present & (scenes.turn_time < NEVER)
        late = ~(scenes.turn_time > 0.0)
        self._refuse_row(turns & late, "must change its course after 0 s", scenes.turn_time)
        before = np.zeros(len(scenes.start))
        for jump in range(MOST_JUMPS):
            time = scenes.jump_times[:, jump]
            given = time < NEVER
            if not given.any():
                break
            name = f"target of jump {jump}"
            self._refuse(given & ~(time > before), f"{name} must come after {'the one before it' if jump else '0 s'}", time)
            obstacles = scenes.obstacles_at(np.where(given, time, 0.0))
            self.end(name, np.where(given[:, None], scenes.jumps[:, jump, 1:], scenes.goal), obstacles, given)
            before = np.where(given, time, before)

    def _refuse(self, wrong: Bool, message: str, values: Float | None = None) -> None:
        """Raise ValueError for the first scene in which something is wrong, shape (N,)."""
        if wrong.any():
            scene = int(wrong.argmax())
            got = "" if values is None else f", got {values[scene]:.4g}"
            raise ValueError(f"{self._scene(scene)}{message}{got}")

    def _refuse_row(self, wrong: Bool, message: str, values: Float | None = None) -> None:
        """Raise ValueError for the first obstacle with which something is wrong, shape (N, n)."""
        if wrong.any():
            scene = int(wrong.any(axis=-1).argmax())
            row = int(wrong[scene].argmax())
            known = self.names[scene] if scene < len(self.names) else ()
            name = f" {known[row]!r}" if row < len(known) and known[row] else ""
            got = "" if values is None else f", got {values[scene, row]:.4g}"
            raise ValueError(f"{self._scene(scene)}obstacle {row}{name} {message}{got}")

    def _scene(self, scene: int) -> str:
        """Return the beginning of a message: the scene, if there are several."""
        return f"scene {scene}: " if len(self.scenes.start) > 1 else ""
