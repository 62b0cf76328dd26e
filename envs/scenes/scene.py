"""Scenes: start, goal and obstacles of movements, their changes, and checks of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import RANGE_TOLERANCE
from viapoint.envs.common.arrays import Bool, Float, norm
from viapoint.envs.geometry.clearance import FAR, row_clearances
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import HALF_SPACE, Obstacles, no_obstacles
from viapoint.envs.geometry.shapes import IN_TABLES

MOST_JUMPS = 4  # Greatest number of jumps of the target in an episode
ENDS = ("start", "goal")  # Names of the ends of a movement
NEVER = 1e9  # Time of a change that does not happen, [s]
ROUNDING = 1e-9  # Rounding error of times, [s]
LEAST_APART = 0.02  # Least difference of start and goal in the joint that moves most, [rad] or [m]
FASTEST = 1.0  # Greatest speed of an obstacle, [m/s]
# Time between two points of a reach, [s]: in the physics, obstacles move straight between them
CHORD = 0.04
SHORTEST_REACH, LATEST = 1e-3, 60.0  # Shortest duration of a reach of an obstacle, and its latest end, [s]
MINIMUM_JERK_PEAK = 1.875  # Peak speed of a minimum-jerk movement relative to its mean speed
# Peak acceleration of a minimum-jerk movement relative to length / duration^2, and the greatest one of an obstacle,
# [m/s^2]: chords are at most acceleration * CHORD^2 / 8 = 1 mm from the reach
MINIMUM_JERK_ACCELERATION, MOST_ACCELERATION = 10.0 / math.sqrt(3.0), 8e-3 / CHORD**2


class Scenes(NamedTuple):
    """N scenes of up to n obstacles each, for an arm of J joints.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import Task
        >>> scenes = Task.of(arm="panda").sampler()([np.random.default_rng(0), np.random.default_rng(1)])
        >>> scenes.start.shape, scenes.take([1]).obstacles.kind.shape[0]
        ((2, 7), 1)
    """

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
    reach: Float
    """Minimum-jerk reaches of obstacles: (begin [s], duration [s], way 3 [m]), shape (N, n, 5); of zeros for none.

    A reach that has begun before time 0 goes on from the place of the obstacle at time 0.
    """

    def take(self, rows: Any) -> Scenes:
        """Return the scenes at `rows`, an index array, slice or mask."""
        start, goal, obstacles, *changes = self
        return Scenes(start[rows], goal[rows], obstacles.take(rows), *[part[rows] for part in changes])

    def put(self, rows: Any, scenes: Scenes) -> Scenes:
        """Return the scenes after the ones at `rows` were overwritten in place; only tables of shapes are new."""
        for name in self._fields:
            if name != "obstacles":
                getattr(self, name)[rows] = getattr(scenes, name)
        return self._replace(obstacles=self.obstacles.put(rows, scenes.obstacles))

    def with_rows(self, rows: int) -> Scenes:
        """Return the scenes with another number of rows for obstacles; those behind are left out."""
        wide = resting(self.start, self.goal, self.obstacles.with_rows(rows))
        kept = min(rows, self.turn_time.shape[1])
        for name in ("turn_time", "turn_velocity", "reach"):  # which have a row for each obstacle
            getattr(wide, name)[:, :kept] = getattr(self, name)[:, :kept]
        return wide._replace(jumps=self.jumps)

    @staticmethod
    def together(parts: Sequence[Scenes]) -> Scenes:
        """Return the scenes of several records in one, which shares no memory with them."""
        start = np.concatenate([part.start for part in parts])
        whole = resting(start, start.copy(), no_obstacles(len(start), parts[0].obstacles.kind.shape[1]))
        first = 0
        for part in parts:
            last = first + len(part.start)
            whole = whole.put(slice(first, last), part)
            first = last
        return whole

    @property
    def jump_times(self) -> Float:
        """Times of the jumps, shape (N, MOST_JUMPS), [s]; NEVER for none."""
        return np.where((self.jumps != 0.0).any(axis=-1), self.jumps[..., 0], NEVER)

    def goals(self, time: Float) -> Float:
        """Return the targets, shape (N, J), at one time for each scene, shape (N,), [s]; a jump counts at once."""
        number = (self.jump_times <= time[:, None] + ROUNDING).sum(axis=-1)
        targets = np.concatenate((self.goal[:, None], self.jumps[..., 1:]), axis=1)
        return np.asarray(targets[np.arange(len(targets)), number])

    def obstacles_at(self, time: Float, *, in_chords: bool = False) -> Obstacles:
        """Return the obstacles at one time for each scene, shape (N,), [s], or as the physics moves them, in chords."""
        time = time[:, None]
        before = np.minimum(time, self.turn_time)[..., None]  # time on the first course
        after = np.maximum(time - self.turn_time, 0.0)[..., None]  # and on the second one
        velocity = self.obstacles.velocity
        centre = self.obstacles.centre + velocity * before + self.turn_velocity * after
        turned = (self.turn_time <= time + ROUNDING)[..., None]
        now = np.where(turned, self.turn_velocity, velocity)
        if self.reach.any():
            begin = CHORD * np.floor(time / CHORD + ROUNDING) if in_chords else time
            moved, rate = _ways(self.reach, begin[:, 0])
            if in_chords:
                rate = (_ways(self.reach, begin[:, 0] + CHORD)[0] - moved) / CHORD
            centre = centre + moved + rate * (time - begin)[..., None]
            now = now + rate
        return self.obstacles._replace(centre=centre, velocity=now)

    def course_times(self) -> Float:
        """Return the times at which obstacles change their velocity, shape (N, .), [s]; NEVER fills the rows."""
        if not self.reach.any():
            return self.turn_time
        begin, duration = self.reach[..., 0], self.reach[..., 1]
        chords = CHORD * np.arange(1, math.ceil((begin + duration).max() / CHORD) + 1)
        moving = (duration > 0.0) & (begin < chords[:, None, None])
        moving &= chords[:, None, None] < begin + duration + CHORD
        return np.concatenate((self.turn_time, np.where(moving.any(axis=2).T, chords, NEVER)), axis=1)


@compiled
def reached(begin: float, duration: float, time: float) -> float:
    """Return the share of its way that a minimum-jerk reach has made at a time, [s].

    Flash & Hogan 1985: x(s) = 10 s^3 - 15 s^4 + 6 s^5, with the share s of the duration.
    """
    share = min(max((time - begin) / duration, 0.0), 1.0)
    return share**3 * (10.0 + share * (6.0 * share - 15.0))


@compiled
def reach_rate(begin: float, duration: float, time: float) -> float:
    """Return the rate of :func:`reached` at a time, 30 s^2 (1 - s)^2 / T with the share s of the duration T, [1/s]."""
    share = min(max((time - begin) / duration, 0.0), 1.0)
    return 30.0 * (share * (1.0 - share)) ** 2 / duration


@compiled
def way_since_start(reach: Float, time: float) -> float:
    """Return the share of its way that an obstacle with a reach, shape (5,), has made since time 0."""
    if reach[1] <= 0.0:
        return 0.0
    return reached(reach[0], reach[1], time) - reached(reach[0], reach[1], 0.0)


@compiled
def _ways(reach: Float, time: Float) -> tuple[Float, Float]:
    """Return ways [m] and velocities [m/s], shape (N, n, 3), of reaches, shape (N, n, 5), at times, shape (N,), [s]."""
    moved, velocity = np.zeros((2, *reach.shape[:2], 3))
    for scene in range(reach.shape[0]):
        for row in range(reach.shape[1]):
            begin, duration = reach[scene, row, :2]
            if duration > 0.0:
                moved[scene, row] = way_since_start(reach[scene, row], time[scene]) * reach[scene, row, 2:]
                velocity[scene, row] = reach_rate(begin, duration, time[scene]) * reach[scene, row, 2:]
    return moved, velocity


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
        np.zeros((*obstacles.kind.shape, 5)),
    )


def check_scenes(
    scenes: Scenes, arm: Arm, names: Sequence[Sequence[str]] = (), ends: Sequence[str] = ENDS
) -> None:
    """Check that a movement can start and end in each scene, and its changes.

    Names of the obstacles, a list for each scene, are for messages. Jumps are only checked together with both ends.

    Raises:
        ValueError: A scene is impossible; the message names the scene, the fault and what is allowed.
    """
    _check_obstacles(scenes, arm.farthest, names)
    everywhere = np.ones(len(scenes.start), bool)
    for name in ends:
        check_end(arm, name, getattr(scenes, name), scenes.obstacles, everywhere, names)
    if len(ends) == len(ENDS):
        apart = np.abs(scenes.goal - scenes.start).max(axis=-1)
        allowed = f"start and goal must be apart, by {LEAST_APART} rad or more in a joint"
        _refuse(apart < LEAST_APART, allowed, apart)
        _check_jumps(scenes, arm, names)


def _check_jumps(scenes: Scenes, arm: Arm, names: Sequence[Sequence[str]]) -> None:
    """Check that each jump is later than the one before it, and its target is possible."""
    before = np.zeros(len(scenes.start))
    for jump in range(MOST_JUMPS):
        time = scenes.jump_times[:, jump]
        given = time < NEVER
        if not given.any():
            break
        late = given & (time <= before)
        _refuse(late, f"jump {jump} must come after the one before it, and after 0 s", time)
        obstacles = scenes.obstacles_at(np.where(given, time, 0.0))
        target = np.where(given[:, None], scenes.jumps[:, jump, 1:], scenes.goal)
        check_end(arm, f"target of jump {jump}", target, obstacles, given, names)
        before = time  # jumps are in order


def extents(obstacles: Obstacles) -> tuple[Float, Float]:
    """Return sizes of obstacles, and their distances from the origin along an axis, shape (N, n) each, [m].

    Both are 0 for absent rows, and distances are for half-spaces.
    """
    kind, size = obstacles.kind, obstacles.size
    largest = np.where(np.isin(kind, IN_TABLES), size[..., 1], size.max(axis=-1))
    away = np.abs(obstacles.centre).max(axis=-1) * (kind != HALF_SPACE)
    return largest * obstacles.present, away * obstacles.present


def _check_obstacles(scenes: Scenes, farthest: float, names: Sequence[Sequence[str]]) -> None:
    """Check sizes, places and courses of obstacles, of which half-spaces have no place."""
    obstacles, turn_time = scenes.obstacles, scenes.turn_time
    present = obstacles.present
    largest, away = extents(obstacles)
    _refuse(largest > farthest, f"must be at most {farthest:.3g} m large", largest, names)
    _refuse(away > farthest, f"must be at most {farthest:.3g} m from the origin along each axis", away, names)
    for velocity in (obstacles.velocity, scenes.turn_velocity):
        speed = norm(velocity)
        _refuse(present & (speed > FASTEST), f"must be at most {FASTEST:g} m/s fast", speed, names)
    _refuse(present & (turn_time <= 0.0), "must change its course after 0 s", turn_time, names)
    _refuse(~present & (turn_time < NEVER), "is not there, and cannot turn", turn_time)
    begin, duration = scenes.reach[..., 0], scenes.reach[..., 1]
    reaches = present & scenes.reach.any(axis=-1)
    _refuse(~present & scenes.reach.any(axis=-1), "is not there, and cannot reach", duration)
    shortest = f"must reach in {SHORTEST_REACH:g} s or more"
    _refuse(reaches & (duration < SHORTEST_REACH), shortest, duration, names)
    late = reaches & (begin + duration > LATEST)
    _refuse(late, f"must end its reach within {LATEST:g} s", begin + duration, names)
    time = np.where(reaches & (duration > 0.0), duration, np.inf)
    mean = norm(scenes.reach[..., 2:]) / time
    # Other movements of the obstacle come on top.
    speed = MINIMUM_JERK_PEAK * mean + np.maximum(norm(obstacles.velocity), norm(scenes.turn_velocity))
    _refuse(reaches & (speed > FASTEST), f"must reach with at most {FASTEST:g} m/s", speed, names)
    peak = MINIMUM_JERK_ACCELERATION * mean / time
    longer = f"must have a longer duration in reaches, with at most {MOST_ACCELERATION:g} m/s^2"
    _refuse(reaches & (peak > MOST_ACCELERATION), longer, peak, names)


def check_end(
    arm: Arm, name: str, joints: Float, obstacles: Obstacles, there: Bool, names: Sequence[Sequence[str]] = ()
) -> None:
    """Check an end of the scenes that have it: inside the joint limits, and free of the arm itself and of obstacles."""
    for joint, (low, high) in enumerate(arm.joint_range):
        position = joints[:, joint]
        outside = (position < low - RANGE_TOLERANCE) | (position > high + RANGE_TOLERANCE)
        allowed = f"must be from {low:.7g} to {high:.7g}"
        _refuse(there & outside, f"{name}: joint {arm.joint_names[joint]!r} {allowed}", position)
    rows, own = row_clearances(arm.chain, arm.spheres, joints, obstacles, FAR)
    wrong = there & (own <= 0.0)
    bodies = arm.nearest_bodies(joints[wrong.argmax()]) if wrong.any() else ""
    touches = f"the arm touches itself ({bodies}); its clearance must be over 0 m"
    _refuse(wrong, f"{name}: {touches}", own)
    touches = f"touches the arm at the {name}; its clearance must be over 0 m"
    _refuse(there[:, None] & obstacles.present & (rows <= 0.0), touches, rows, names)


def _refuse(wrong: Bool, message: str, values: Float, names: Sequence[Sequence[str]] = ()) -> None:
    """Raise ValueError for the first scene, shape (N,), or obstacle, shape (N, n), with which something is wrong."""
    if not wrong.any():
        return
    place = np.unravel_index(int(wrong.argmax()), wrong.shape)
    scene = int(place[0])
    which = f"scene {scene}: " if len(wrong) > 1 else ""
    if wrong.ndim == 2:
        row = int(place[1])
        known = names[scene] if scene < len(names) else ()
        name = f" {known[row]!r}" if row < len(known) and known[row] else ""
        which += f"obstacle {row}{name} "
    raise ValueError(f"{which}{message}, got {values[place]:.7g}")
