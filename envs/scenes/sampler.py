"""Rejection sampling of scenes.

A layout is drawn, then several pairs of start and goal for it. A scene is accepted if both ends are free and the
straight movement between them is not. Then follow its changes: jumps of the target, and courses of obstacles. A course
has a constant velocity and at most one turn, or it is a minimum-jerk reach, as that of another hand. A scene depends on
its own random generator only, whatever the batch.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import descend, planar_joints, solve_planar
from viapoint.envs.arms.kinematics import Chain, Spheres, link_poses, sphere_centres, tool_position, transform
from viapoint.envs.common.arrays import Bool, Float, Int, norm
from viapoint.envs.geometry.clearance import (
    Placed,
    memory,
    obstacle_clearance,
    place,
    point_clearances,
    row_clearances,
    self_clearance,
)
from viapoint.envs.geometry.compiled import compiled, inlined, inner, kernel, rotated
from viapoint.envs.geometry.obstacles import ABSENT, HALF_SPACE, no_obstacles
from viapoint.envs.plans import SHORTEST_DURATION
from viapoint.envs.scenes.families_registry import Build, scene_families
from viapoint.envs.scenes.layout import MOST_PLACES, PLACE, ROW, Layout, Room, mix, most_rows
from viapoint.envs.scenes.scene import (
    ENDS,
    FARTHEST,
    FASTEST,
    MINIMUM_JERK_PEAK,
    MOST_JUMPS,
    NEVER,
    Scenes,
    extents,
    reached,
    resting,
    way_since_start,
)

if TYPE_CHECKING:
    from viapoint.envs.task import Task

# Half heights of obstacles in the plane that the hand alone must clear, and that links must clear, too, [m]
LOW_HALF_HEIGHT, TALL_HALF_HEIGHT = 0.04, 0.3
PLANE_MARGIN, SPACE_MARGIN = 0.025, 0.02  # Least clearance of starts and goals from obstacles, [m]
LIMIT_MARGIN = 0.02  # Least distance of ends from joint limits, [rad] or [m]; at most a tenth of the range
LEAST_WAY = 0.5  # Least length of the way from start to goal in joint space, [rad]
PLANE_REACH, SPACE_REACH = 0.6755, 0.947  # Reaches of the reference arms from joint 2, [m]
SHOULDER = 0.333  # Height of joint 2 of the reference arm in space, [m]
REACH_SAMPLES = 2000  # Configurations among which the reach of an arm is looked for
# Greatest number of obstacles that are drawn, unless a task asks for more in every scene; more can be given
MOST_DRAWN = 32
VIEW_MARGIN = 0.01  # Least distance of obstacles from a sensor that does not move, [m]
# Layouts that are drawn for a scene at most, and layouts after which another family is tried
ATTEMPTS, FAMILY_ATTEMPTS = 1000, 50

# Ends

PAIRS, TRIES = 3, 6  # Pairs of start and goal for a layout, and attempts at each end
# Share of starts at home or near it, and of these and starts in places of goals; others are free ones
HOME, REACHING = 0.4, 0.8
FREE_GOALS = 0.1  # Share of goals that are free configurations, where the layout has places
EXCHANGED = 0.25  # Share of pairs whose ends are exchanged, where the layout has no places of starts
JITTER = 0.3  # Greatest deviation from home of half of the starts there, [rad]
# Least clearance of the arm from itself at ends, [m], and the share of that at home that it is at most
SELF_MARGIN, HOME_SHARE = 0.005, 0.5
INSTANTS = 32  # Parts of the straight movement between which it is looked at
ROLL = 0.3  # Greatest deviation of the tool's roll about its axis from quarter turns, [rad]
SEED_SPREAD = 0.3  # Spread of seeds of inverse kinematics around home, as a share of the ranges
BLOCKED, FREE, OUT_OF_REACH = 1, 0, -1  # Outcome of a straight movement

# Changes

CANDIDATES = 8  # Candidates for a jump, or for the course of an obstacle
COURSE_NUMBERS = 9  # Random numbers of a candidate for the course of an obstacle
# Time of the first jump, and from a jump to the next, relative to the centre duration
FIRST_JUMP, NEXT_JUMP = (0.1, 0.7), (0.4, 0.9)
# Distance from a target to the next in hand space, [m], and in joint space, [rad]
JUMP_OF_HAND, JUMP_OF_JOINTS = (0.10, 0.30), (0.25, 0.75)
SPEED = (0.05, 0.30)  # Speed of obstacles, [m/s]
STEEPNESS = 0.5  # Greatest height that an obstacle in space gains, relative to its way
TURNING, TURN = 0.5, (0.2, 0.7)  # Share of obstacles that turn, and the relative time of the turn
# Duration of a reach of an obstacle, [s], its least and greatest length, [m], and its greatest peak speed, [m/s]
REACH_TIME, REACH_LENGTH, REACH_SPEED = (0.6, 1.2), (0.15, 0.45), 0.9 * FASTEST
MET_AT = (0.35, 0.65)  # Share of the duration of a reach after which an obstacle is where it was drawn
MEETING = (0.25, 0.6)  # Time at which an obstacle is where it was drawn, relative to the centre duration
# Least clearance of the start at first, of the goal while movements may end, and of targets that appear, [m]
MARGIN = 0.015
FARTHEST_MOVING = 1.5  # Greatest coordinate of a moving obstacle at the beginning, [m]
BEGINNING, BEGINNING_TIMES = 0.2, 3
"""Time that the start stays free, relative to the centre duration, and number of times at which this is checked."""
# Time until which the goal stays free, relative to the longest duration, and number of times
ENDING, ENDING_TIMES = 1.2, 10
PASSED = 8  # Parts of the way to a new target between which it is looked at


class SceneSampler:
    """Sampler of the scenes of a task.

    Scenes have rows for as many obstacles as the task allows. Obstacles in the plane are in the way of the links, too,
    if `whole_arm`, and keep away from the place of a sensor that does not move.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.plane = is_planar(task.arm)
        fewest, most = task.n_obstacles
        self.rows = most  # Number of rows for obstacles
        most = min(most, max(fewest, MOST_DRAWN))
        self.room = room_of(task.arm, task.shapes, (fewest, most), task.whole_arm)
        self.viewpoint = None if task.sensor is None else task.sensor.viewpoint  # Place of a still sensor
        self._setting = _setting_of(task, self.plane)
        known = scene_families(self.plane)
        self._builds = [known[name].build for name in task.families]
        self._bare = known["clutter"].build
        self._width = max(most_rows(most), self.rows)
        self._memories = [memory(task.arm.chain, task.arm.spheres) for _ in range(3)]

    def __call__(
        self,
        generators: Sequence[np.random.Generator],
        scenes: Scenes | None = None,
        given: Collection[str] = (),
    ) -> Scenes:
        """Draw one scene from each of N random generators, without the `given` parts, which are those of `scenes`.

        Parts are `start`, `goal`, `obstacles`, `jumps`, `turns` and `reaches`.

        Raises:
            RuntimeError: No scene was found in many attempts.
        """
        number = len(generators)
        if scenes is None:
            home = np.tile(self.task.arm.home, (number, 1))
            scenes = resting(home, home, no_obstacles(number, self.rows))
        draft = self._draft(scenes, given)
        rooms = self._rooms(scenes, given)
        bare = self.room.most == 0 or "obstacles" in given
        builds = [self._bare if bare else self._any_family(rng) for rng in generators]
        pending = np.arange(number)
        for attempt in range(ATTEMPTS):
            for i in map(int, pending):
                rng = generators[i]
                if attempt and attempt % FAMILY_ATTEMPTS == 0 and not bare:
                    builds[i] = self._any_family(rng)
                _write(draft, i, builds[i](rng, rooms[i]))
                rng.random(out=draft.numbers[i])
            found = np.zeros(len(pending), np.bool_)
            draw_ends(draft, pending, found)
            obstacles = draft.scenes.obstacles.take(pending)
            if "obstacles" not in given:  # what is drawn can be given back
                found &= np.maximum(*extents(obstacles)).max(axis=1, initial=0.0) <= FARTHEST
            if self.viewpoint is not None:
                found &= point_clearances(obstacles, self.viewpoint) >= VIEW_MARGIN
            found[found] = self._change(draft, pending[found], generators, given)
            pending = pending[~found]
            if not len(pending):
                return draft.scenes.with_rows(self.rows)
        if "obstacles" in given:
            raise RuntimeError(
                f"obstacles must leave room for start and goal of the arm {self.task.arm.name!r}, but in {ATTEMPTS} "
                "attempts no free ones were found; give fewer or other obstacles, or both ends"
            )
        raise RuntimeError(
            f"no scene of the families {', '.join(self.task.families)} with {self.room.fewest} to {self.room.most} "
            f"obstacles was found in {ATTEMPTS} attempts for the arm {self.task.arm.name!r}; allow fewer obstacles or "
            "other families, or give other ends"
        )

    def _draft(self, scenes: Scenes, given: Collection[str]) -> Draft:
        """Return copies of scenes with the given parts, and memory for the others."""
        number, joints = scenes.start.shape
        fixed = np.zeros((number, 2), np.bool_)
        fixed[:, 0] = "start" in given
        fixed[:, 1] = "goal" in given
        drawn = "obstacles" not in given
        copies = scenes.take(np.arange(number))
        if drawn:
            empty = resting(copies.start, copies.goal, no_obstacles(number, self._width))
            copies = empty._replace(jumps=copies.jumps)
        return Draft(
            setting=self._setting,
            scenes=copies,
            rows=np.zeros((number, self._width, ROW)),
            n_rows=np.full(number, 0 if drawn else -1),
            keep=np.zeros(number, np.int64),
            places=np.zeros((number, 2, MOST_PLACES, PLACE)),
            n_places=np.zeros((number, 2), np.int64),
            fixed=fixed,
            numbers=np.zeros((number, PAIRS, 2, numbers_of_end(joints))),
            joints=np.empty(joints),
            position=np.empty(3),
            axes=np.empty((3, 3)),
            placed=self._memories[0],
            at_start=self._memories[1],
            at_goal=self._memories[2],
        )

    def _any_family(self, rng: np.random.Generator) -> Build:
        """Return the function of a random family."""
        return self._builds[int(len(self._builds) * rng.random())]

    def _rooms(self, scenes: Scenes, given: Collection[str]) -> list[Room]:
        """Return the room of each scene; in the plane it tells the ends that are given."""
        room = self.room
        if "obstacles" in given:
            room = room._replace(fewest=0, most=0)
        rooms = [room] * len(scenes.start)
        for end in ENDS:
            if self.plane and end in given:
                hand = (self.task.arm.hand(getattr(scenes, end)) - np.array(room.foot)) / room.scale
                for i, (x, y, _) in enumerate(hand.tolist()):
                    place: dict[str, Any] = {end: (x, y)}
                    rooms[i] = rooms[i]._replace(**place)
        return rooms

    def _change(
        self, draft: Draft, which: Int, generators: Sequence[np.random.Generator], given: Collection[str]
    ) -> Bool:
        """Draw the changes of K scenes, and return True for those in which they fit, shape (K,)."""

        def numbers(*shape: int) -> Float:
            return np.array([generators[scene].random(shape) for scene in which]).reshape(-1, *shape)

        moves = self.task.moving_obstacles and "obstacles" not in given
        jumps = self.task.n_jumps[1] > 0 and "jumps" not in given
        if not moves and not jumps:
            return np.ones(len(which), bool)
        space, action = self.task.space, self.task.action
        start, goal = draft.scenes.start[which], draft.scenes.goal[which]
        durations = action.zero_duration(space.coordinates(start), space.coordinates(goal))
        durations = np.maximum(durations, SHORTEST_DURATION * action.centre)
        if moves:
            draw_courses(draft, which, durations, numbers(self._width, CANDIDATES, COURSE_NUMBERS))
        if not jumps:
            return np.ones(len(which), bool)
        return draw_jumps(draft, which, durations, numbers(numbers_of_jumps(start.shape[1])))


def _write(draft: Draft, scene: int, layout: Layout) -> None:
    """Write a layout into the tables of a scene."""
    draft.keep[scene] = layout.keep
    if draft.n_rows[scene] >= 0:
        draft.n_rows[scene] = len(layout.rows) // ROW
        draft.rows[scene].reshape(-1)[: len(layout.rows)] = layout.rows
    for end, places in enumerate((layout.starts, layout.goals)):
        draft.places[scene, end].reshape(-1)[: len(places)] = places
        draft.n_places[scene, end] = len(places) // PLACE


def is_planar(arm: Arm) -> bool:
    """Return True for an arm of two hinges with vertical axes."""
    if len(arm.home) != 2 or arm.chain.sliding.any():
        return False
    rotation, _ = link_poses(arm.chain, arm.home)
    return bool((np.abs(rotation[1:, 2, 2]) > 1.0 - 1e-6).all())


def _setting_of(task: Task, plane: bool) -> Setting:
    """Return what compiled functions know of a task."""
    arm = task.arm
    shortest, longest = task.duration_range
    centre = task.action.centre
    width = arm.joint_range[:, 1] - arm.joint_range[:, 0]
    margin = np.minimum(LIMIT_MARGIN, 0.1 * width)
    inner = arm.joint_range + margin[:, None] * np.array([1.0, -1.0])
    # Joints that turn more than once are kept within half a turn from home.
    near = arm.home[:, None] + np.pi * np.array([-1.0, 1.0])
    several = (width > 2.0 * np.pi + 1e-3) & ~arm.chain.sliding
    near = np.stack((np.maximum(near[:, 0], inner[:, 0]), np.minimum(near[:, 1], inner[:, 1])), axis=-1)
    inner = np.where(several[:, None], near, inner)
    away = arm.hand(arm.home) - arm.chain.origin[0]
    _, own = row_clearances(arm.chain, arm.spheres, arm.home[None], no_obstacles(1), SELF_MARGIN / HOME_SHARE)
    return Setting(
        chain=arm.chain,
        spheres=arm.spheres,
        joint_range=arm.joint_range,
        inner_range=inner,
        home=arm.home,
        bearing=math.atan2(away[1], away[0]),
        plane=plane,
        of_hand=task.space_name == "hand",
        margin=PLANE_MARGIN if plane else SPACE_MARGIN,
        self_margin=min(SELF_MARGIN, HOME_SHARE * float(own[0])),
        least_way=0.0 if plane else LEAST_WAY,
        n_jumps=task.n_jumps,
        reaching=task.courses == "reaches",
        relative_durations=(shortest / centre, longest / centre),
    )


def farthest_reach(arm: Arm) -> float:
    """Return the greatest distance of the hand from the first joint, in a plane from its axis, [m]."""
    low, high = arm.joint_range.T
    joints = np.random.default_rng(0).uniform(low, high, (REACH_SAMPLES, len(low)))
    away = arm.hand(joints) - arm.chain.origin[0]
    if is_planar(arm):
        away[:, 2] = 0.0
    return float(norm(away).max())


def room_of(arm: Arm, kinds: tuple[str, ...], n_obstacles: tuple[int, int], tall: bool) -> Room:
    """Return the room for layouts around an arm."""
    plane = is_planar(arm)
    low, high = arm.joint_range.T
    foot = arm.chain.origin[0].copy()
    if plane:
        foot[2] = arm.hand(arm.home)[2]
    scale = round(farthest_reach(arm) / (PLANE_REACH if plane else SPACE_REACH), 2)
    height = TALL_HALF_HEIGHT if tall else LOW_HALF_HEIGHT
    foot[2] -= 0.0 if plane else SHOULDER * scale
    turns = not arm.chain.sliding[0] and high[0] - low[0] < 2.0 * np.pi
    centres = sphere_centres(arm.chain, arm.spheres, arm.home)
    low_enough = np.abs(centres[:, 2] - foot[2]) < height + arm.spheres.radius
    passing = arm.spheres.radius[low_enough & (np.repeat(arm.spheres.link, np.diff(arm.spheres.first)) > 1)]

    return Room(
        kinds,
        *n_obstacles,
        scale=scale,
        foot=(float(foot[0]), float(foot[1]), float(foot[2])),
        turn=(float(low[0]), float(high[0])) if turns else (-math.pi, math.pi),
        height=height,
        hand=float(passing.max(initial=0.0)) / scale,
        links=_links(arm, scale) if plane else (0.0, 0.0),
    )


def _links(arm: Arm, scale: float) -> tuple[float, float]:
    """Return the lengths of the links of an arm in the plane, see :class:`Room`."""
    _, origin = link_poses(arm.chain, planar_joints(arm, arm.hand(arm.home)[:2]))
    upper = origin[2] - origin[1]
    fore = arm.hand(arm.home) - origin[2]
    left = upper[0] * fore[1] - upper[1] * fore[0] < 0.0
    lengths = float(norm(upper[:2])) / scale, float(norm(fore[:2])) / scale
    return -lengths[0] if left else lengths[0], lengths[1]


class Setting(NamedTuple):
    """Arm, the space in which it moves, and what scenes must be like, as compiled functions read them."""

    chain: Chain
    spheres: Spheres
    joint_range: Float  # Ranges of the joints, shape (J, 2), [rad] or [m]
    inner_range: Float  # Ranges of the joints at ends, shape (J, 2), [rad] or [m]
    home: Float  # Shape (J,), [rad] or [m]
    bearing: float  # Bearing of the tool at home, seen from the axis of the first joint, [rad]
    plane: bool  # True for an arm of two joints in the plane
    of_hand: bool  # True if movements are planned in hand space, False for joint space
    margin: float  # Least clearance of ends from obstacles, [m]
    self_margin: float  # Least clearance of ends from the arm itself, [m]
    least_way: float  # Least length of the way from start to goal in joint space, [rad]
    n_jumps: tuple[int, int]  # Fewest and most jumps of the target
    reaching: bool  # True if obstacles that move are on reaches of their own
    # Shortest and longest duration of movements, relative to that of the zero action
    relative_durations: tuple[float, float]


class Draft(NamedTuple):
    """N scenes that are being drawn: one attempt at each, with a layout as padded tables, and memory."""

    setting: Setting
    scenes: Scenes  # Scenes with W obstacles each, which compiled functions change in place
    rows: Float  # Obstacles of the layouts, shape (N, W, ROW)
    n_rows: Int  # Numbers of obstacles, shape (N,); -1 for scenes whose obstacles are given
    keep: Int  # Numbers of obstacles that are kept, or 0, shape (N,)
    places: Float  # Places of starts, then those of goals, shape (N, 2, P, PLACE)
    n_places: Int  # Numbers of both, shape (N, 2)
    fixed: Bool  # True for starts and goals that are given, shape (N, 2)
    numbers: Float  # Uniform random numbers, shape (N, PAIRS, 2, :func:`numbers_of_end`)
    joints: Float  # Shape (J,)
    position: Float  # Shape (3,)
    axes: Float  # Shape (3, 3)
    placed: Placed
    at_start: Placed
    at_goal: Placed


def numbers_of_end(joints: int) -> int:
    """Return how many random numbers the attempts at an end take: two, and for each try a place and a seed."""
    return 2 + TRIES * (8 + joints)


# Functions with one caller are compiled within it: handing over a draft costs seconds of compilation.
@kernel
def draw_ends(draft: Draft, which: Int, found: Bool) -> None:
    """Draw starts, goals and obstacles of the scenes at K indices; set `found`, (K,), for those that were found."""
    for k in range(len(which)):
        scene = which[k]
        # Places in the plane are points: another attempt would be the same one.
        once = draft.setting.plane or (draft.fixed[scene, 0] and draft.fixed[scene, 1])
        for pair in range(1 if once else PAIRS):
            if draft.n_rows[scene] >= 0:
                _unpack_rows(draft, scene)
            if _draw_pair(draft, scene, pair):
                found[k] = True
                break


@inlined
def _unpack_rows(draft: Draft, scene: int) -> None:
    """Put the obstacles of a layout into a scene, at rest; the rows behind them become absent."""
    obstacles, rows = draft.scenes.obstacles, draft.rows[scene]  # pairs before may have left some out
    for row in range(obstacles.kind.shape[1]):
        draft.scenes.turn_time[scene, row] = NEVER
        obstacles.kind[scene, row] = ABSENT
        if row < draft.n_rows[scene]:
            obstacles.kind[scene, row] = int(rows[row, 0])
        draft.scenes.turn_velocity[scene, row] = 0.0
        draft.scenes.reach[scene, row] = 0.0
        obstacles.velocity[scene, row] = 0.0
        for axis in range(3):
            obstacles.centre[scene, row, axis] = rows[row, 1 + axis]
            obstacles.size[scene, row, axis] = rows[row, 13 + axis]
            for column in range(3):
                obstacles.rotation[scene, row, axis, column] = rows[row, 4 + 3 * axis + column]


@inlined
def _draw_pair(draft: Draft, scene: int, pair: int) -> bool:
    """Draw a start and a goal, and return True if they and the straight movement between them are as they must be."""
    start_given, goal_given = draft.fixed[scene]
    # The goal first: it is harder to find.
    for end in (1, 0):
        if not draft.fixed[scene, end] and not _draw_end(draft, scene, pair, end):
            return False
    start, goal = draft.scenes.start[scene], draft.scenes.goal[scene]
    exchange = not start_given and not goal_given and draft.n_places[scene, 0] == 0
    if exchange and draft.numbers[scene, pair, 0, 1] < EXCHANGED:
        for joint in range(len(start)):
            start[joint], goal[joint] = goal[joint], start[joint]
    way = 0.0
    for joint in range(len(start)):
        way += (goal[joint] - start[joint]) ** 2
    both_given = start_given and goal_given
    if not both_given and np.sqrt(way) < draft.setting.least_way:
        return False
    drawn = draft.n_rows[scene] >= 0
    if drawn and (start_given or goal_given or draft.keep[scene]) and not _make_room(draft, scene):
        return False
    what = straight_movement(draft, scene)
    if what == FREE:
        # Given obstacles need not be in the way.
        return bool(draft.n_rows[scene] <= 0)
    return what == BLOCKED or both_given


@inlined
def _draw_end(draft: Draft, scene: int, pair: int, end: int) -> bool:
    """Draw a start (end 0) or a goal (end 1), and return True if it is free."""
    setting = draft.setting
    joints = draft.scenes.goal[scene] if end else draft.scenes.start[scene]
    numbers = draft.numbers[scene, pair, end]
    size = len(joints)
    listed = end
    home, reaching = 0.0, 1.0 if setting.plane else 1.0 - FREE_GOALS
    if end == 0 and draft.n_places[scene, 0] == 0 and not setting.plane:
        listed = 1
        home, reaching = HOME, REACHING
    n_places = draft.n_places[scene, listed]
    for k in range(1 if setting.plane else TRIES):
        first = 2 + k * (8 + size)
        for joint in range(size):
            low, high = setting.inner_range[joint]
            seed = numbers[first + 8 + joint]
            joints[joint] = low + (high - low) * seed
            if numbers[0] < home:
                deviation = JITTER if numbers[first] < 0.5 else 0.0
                joints[joint] = setting.home[joint] + deviation * (2.0 * seed - 1.0)
        if n_places > 0 and home <= numbers[0] < reaching:
            there = draft.places[scene, listed, int(numbers[first] * n_places)]
            if not _reach(draft, scene, there, numbers[first + 1 : first + 8], joints):
                continue
        if not is_end(draft, joints):
            continue
        if draft.keep[scene] > 0:  # obstacles in the way are left out
            return True
        placed, margin = draft.placed, setting.margin
        obstacles = draft.scenes.obstacles
        if obstacle_clearance(setting.spheres, placed, obstacles, scene, 0.0, margin, margin) >= margin:
            return True
    return False


@inner
def is_end(draft: Draft, joints: Float) -> bool:
    """Return True if joints are within their inner ranges, and the arm, which is placed, is free of itself."""
    setting, placed = draft.setting, draft.placed
    for joint in range(len(joints)):
        low, high = setting.inner_range[joint]
        if not low <= joints[joint] <= high:
            return False
    place(setting.chain, setting.spheres, joints, placed)
    margin = setting.self_margin
    return bool(self_clearance(setting.spheres, placed, margin, margin) >= margin)


@inner
def is_row_clear(
    draft: Draft, placed: Placed, scene: int, row: int, time: float, margin: float, link: int
) -> bool:
    """Return True if links from `link` on of a placed arm have a margin to one obstacle at some time, [m]."""
    scenes, obstacles = draft.scenes, draft.scenes.obstacles
    x = obstacles.centre[scene, row, 0]
    y = obstacles.centre[scene, row, 1]
    z = obstacles.centre[scene, row, 2]
    # After the turn, the place is that of the first course, moved by the difference of the courses.
    after = max(time - scenes.turn_time[scene, row], 0.0)
    moved = way_since_start(scenes.reach[scene, row], time)
    for axis in range(3):
        change = scenes.turn_velocity[scene, row, axis] - obstacles.velocity[scene, row, axis]
        obstacles.centre[scene, row, axis] += after * change + moved * scenes.reach[scene, row, 2 + axis]
    spheres = draft.setting.spheres
    least = obstacle_clearance(spheres, placed, obstacles, scene, time, margin, margin, row, link)
    obstacles.centre[scene, row, 0] = x
    obstacles.centre[scene, row, 1] = y
    obstacles.centre[scene, row, 2] = z
    return bool(least >= margin)


@inlined
def _make_room(draft: Draft, scene: int) -> bool:
    """Leave out obstacles that touch an end, and those that are too many; return True if the others are enough.

    If the obstacles of the layout belong together, none may touch an end.
    """
    setting = draft.setting
    obstacles = draft.scenes.obstacles
    keep = draft.keep[scene]
    place(setting.chain, setting.spheres, draft.scenes.start[scene], draft.at_start)
    place(setting.chain, setting.spheres, draft.scenes.goal[scene], draft.at_goal)
    count = 0
    for row in range(obstacles.kind.shape[1]):
        if obstacles.kind[scene, row] == ABSENT:
            continue
        if keep > 0 and count == keep:
            obstacles.kind[scene, row] = ABSENT
            continue
        free = is_row_clear(draft, draft.at_start, scene, row, 0.0, setting.margin, 1)
        free = free and is_row_clear(draft, draft.at_goal, scene, row, 0.0, setting.margin, 1)
        if not free and keep == 0:
            return False
        kind = obstacles.kind[scene, row]
        obstacles.kind[scene, row] = ABSENT
        if free:  # it moves to the first row that is left
            obstacles.kind[scene, count] = kind
            for axis in range(3):
                obstacles.centre[scene, count, axis] = obstacles.centre[scene, row, axis]
                obstacles.size[scene, count, axis] = obstacles.size[scene, row, axis]
                for column in range(3):
                    turn = obstacles.rotation[scene, row, axis, column]
                    obstacles.rotation[scene, count, axis, column] = turn
            count += 1
    return bool(keep == 0 or count == keep)


@inlined
def straight_movement(draft: Draft, scene: int) -> int:
    """Return what becomes of the straight movement: FREE, BLOCKED by an obstacle, or OUT_OF_REACH."""
    setting = draft.setting
    start = draft.scenes.start[scene]
    goal = draft.scenes.goal[scene]
    placed, joints = draft.placed, draft.joints
    x, y, u, v = 0.0, 0.0, 0.0, 0.0
    if setting.of_hand:
        x, y, _ = tool_position(setting.chain, start, placed.rotation, placed.origin)
        u, v, _ = tool_position(setting.chain, goal, placed.rotation, placed.origin)
    blocked = False
    for k in range(1, INSTANTS):
        share = _bit_reversed(k)
        if setting.of_hand:
            here = x + share * (u - x), y + share * (v - y)
            if not solve_planar(setting.chain, setting.joint_range, here[0], here[1], joints):
                return OUT_OF_REACH
        else:
            for joint in range(len(joints)):
                joints[joint] = start[joint] + share * (goal[joint] - start[joint])
        if not blocked:
            place(setting.chain, setting.spheres, joints, placed)
            least = obstacle_clearance(setting.spheres, placed, draft.scenes.obstacles, scene, 0.0, 0.0, 0.0)
            blocked = least < 0.0
        if blocked and not setting.of_hand:  # the hand may still leave the reach
            break
    return BLOCKED if blocked else FREE


@kernel
def _bit_reversed(number: int) -> float:
    """Return the k-th point of the sequence 1/2, 1/4, 3/4, 1/8, 5/8, ..., which soon finds what is in the way."""
    point, step = 0.0, 0.5
    while number:
        point += step * (number & 1)
        number >>= 1
        step *= 0.5
    return point


@inlined
def _reach(draft: Draft, scene: int, there: Float, numbers: Float, joints: Float) -> bool:
    """Solve for joint positions with the tool in a place, and return True if it gets there."""
    setting = draft.setting
    across = there[6] * (2.0 * numbers[0] - 1.0), there[7] * (2.0 * numbers[1] - 1.0)
    position, axes = draft.position, draft.axes
    position[0] = there[0] + there[9] * across[0] - there[10] * across[1]
    position[1] = there[1] + there[10] * across[0] + there[9] * across[1]
    position[2] = there[2] + there[8] * (2.0 * numbers[2] - 1.0)
    chain, limits = setting.chain, setting.inner_range
    if setting.plane:
        return bool(solve_planar(chain, limits, position[0], position[1], joints))
    _seed(setting, position, joints)
    if len(joints) < 6:
        return bool(descend(chain, limits, position, axes, False, joints) == 0.0)
    _tool_axes(there[3:6], there[11], numbers[3:7], axes)
    if draft.keep[scene] == 0 and not _is_hand_clear(draft, scene, position, axes):
        return False
    return bool(descend(chain, limits, position, axes, True, joints) == 0.0)


@inner
def _seed(setting: Setting, position: Float, joints: Float) -> None:
    """Change joints between their limits into some near home, with the first one turned towards a position.

    From there inverse kinematics finds more solutions, and fewer contorted ones.
    """
    origin = setting.chain.origin[0]
    for joint in range(len(joints)):
        low, high = setting.inner_range[joint]
        joints[joint] = setting.home[joint] + SEED_SPREAD * (joints[joint] - 0.5 * (low + high))
        if joint == 0 and not setting.chain.sliding[0]:
            joints[0] += np.arctan2(position[1] - origin[1], position[0] - origin[0]) - setting.bearing
        joints[joint] = min(max(joints[joint], low), high)


@inlined
def _is_hand_clear(draft: Draft, scene: int, position: Float, axes: Float) -> bool:
    """Return True if the last link is free with the tool at a pose, which is known without inverse kinematics."""
    chain, spheres, placed = draft.setting.chain, draft.setting.spheres, draft.placed
    last = len(chain.mass)
    for row in range(3):
        for column in range(3):
            turn = 0.0
            for k in range(3):
                turn += axes[row, k] * chain.tool_rotation[column, k]
            placed.rotation[last, row, column] = turn
        placed.origin[last, row] = position[row]
        for k in range(3):
            placed.origin[last, row] -= placed.rotation[last, row, k] * chain.tool_origin[k]
    for group in range(len(spheres.link)):
        if spheres.link[group] == last:
            placed.known[group] = False
            ball = transform(placed.rotation, placed.origin, last, spheres.ball_centre[group])
            placed.ball[group, 0], placed.ball[group, 1], placed.ball[group, 2] = ball
    clear = True
    for row in range(draft.scenes.obstacles.kind.shape[1]):
        clear = clear and is_row_clear(draft, placed, scene, row, 0.0, draft.setting.margin, last)
    return clear


@kernel
def _tool_axes(approach: Float, cone: float, numbers: Float, axes: Float) -> None:
    """Fill in random axes of the tool, as columns, with the z axis in a cone around the approach."""
    x, y, z = approach
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        x, length, cone = 1.0, 1.0, np.pi
    _fill_frame(x / length, y / length, z / length, axes)
    # A uniform direction in the cone around the third axis.
    cosine = 1.0 - (1.0 - np.cos(cone)) * numbers[0]
    sine = np.sqrt(max(1.0 - cosine * cosine, 0.0))
    angle = 2.0 * np.pi * numbers[1]
    u = sine * np.cos(angle)
    v = sine * np.sin(angle)
    x, y, z = rotated(axes, (u, v, cosine))
    _fill_frame(x, y, z, axes)
    roll = 0.5 * np.pi * np.floor(4.0 * numbers[2]) + ROLL * (2.0 * numbers[3] - 1.0)
    c, s = np.cos(roll), np.sin(roll)
    for row in range(3):
        first, second = axes[row, 0], axes[row, 1]
        axes[row, 0] = c * first + s * second
        axes[row, 1] = c * second - s * first


@kernel
def _fill_frame(x: float, y: float, z: float, axes: Float) -> None:
    """Fill in axes, as columns, of which the third is a unit vector, and the first is horizontal."""
    level = np.sqrt(x * x + y * y)
    u, v = 1.0, 0.0
    if level > 1e-6:
        u, v = -y / level, x / level
    axes[0, 0], axes[1, 0], axes[2, 0] = u, v, 0.0
    axes[0, 1], axes[1, 1], axes[2, 1] = -z * v, z * u, x * v - y * u
    axes[0, 2], axes[1, 2], axes[2, 2] = x, y, z


_mixed = compiled(mix)


def numbers_of_jumps(joints: int) -> int:
    """Return how many random numbers the jumps of a scene take."""
    return 1 + MOST_JUMPS * (1 + CANDIDATES * (1 + joints))


@compiled
def draw_courses(draft: Draft, which: Int, durations: Float, numbers: Float) -> None:
    """Set the obstacles of the scenes at indices (K,) in motion, but half-spaces, and those of which no course fits.

    `durations` are those of the straight movements, shape (K,), [s]; `numbers` are uniform random numbers, shape
    (K, W, CANDIDATES, COURSE_NUMBERS).
    """
    setting, scenes, obstacles = draft.setting, draft.scenes, draft.scenes.obstacles
    for k in range(len(which)):
        scene = which[k]
        place(setting.chain, setting.spheres, scenes.start[scene], draft.at_start)
        place(setting.chain, setting.spheres, scenes.goal[scene], draft.at_goal)
        for row in range(obstacles.kind.shape[1]):
            if obstacles.kind[scene, row] in (ABSENT, HALF_SPACE):
                continue
            met = obstacles.centre[scene, row].copy()
            fits = False
            for candidate in range(CANDIDATES):
                _set_course(draft, scene, row, met, durations[k], numbers[k, row, candidate])
                fits = _course_fits(draft, durations[k], scene, row)
                if fits:
                    break
            if not fits:
                _set_course(draft, scene, row, met, 0.0, np.zeros(COURSE_NUMBERS))  # it rests


@compiled
def _set_course(draft: Draft, scene: int, row: int, met: Float, duration: float, u: Float) -> None:
    """Give an obstacle a random course through a place during a movement of some duration; it rests if that is 0."""
    first, second = np.zeros(3), np.zeros(3)
    turn, meeting = NEVER, duration * _mixed(MEETING, u[8])
    draft.scenes.reach[scene, row] = 0.0
    height = 0.0 if draft.setting.plane else STEEPNESS
    if duration > 0.0 and draft.setting.reaching:
        time = _mixed(REACH_TIME, u[3])
        begin = meeting - time * _mixed(MET_AT, u[4])
        longest = min(REACH_LENGTH[1], REACH_SPEED * time / MINIMUM_JERK_PEAK)
        _fill_vector(_mixed((REACH_LENGTH[0], longest), u[0]), u[1], height * (2.0 * u[2] - 1.0), first)
        made = reached(begin, time, meeting) - reached(begin, time, 0.0)
        draft.scenes.reach[scene, row, 0] = begin
        draft.scenes.reach[scene, row, 1] = time
        for axis in range(3):
            draft.scenes.reach[scene, row, 2 + axis] = first[axis]
            draft.scenes.obstacles.centre[scene, row, axis] = met[axis] - made * first[axis]
        return
    if duration > 0.0:
        _fill_vector(_mixed(SPEED, u[0]), u[1], height * (2.0 * u[2] - 1.0), first)
        if u[6] < TURNING:
            turn = duration * _mixed(TURN, u[7])
            _fill_vector(_mixed(SPEED, u[3]), u[4], height * (2.0 * u[5] - 1.0), second)
    for axis in range(3):
        way = first[axis] * min(meeting, turn) + second[axis] * max(meeting - turn, 0.0)
        draft.scenes.obstacles.centre[scene, row, axis] = met[axis] - way
        draft.scenes.obstacles.velocity[scene, row, axis] = first[axis]
        draft.scenes.turn_velocity[scene, row, axis] = second[axis]
    draft.scenes.turn_time[scene, row] = turn


@compiled
def _fill_vector(length: float, heading: float, rise: float, vector: Float) -> None:
    """Fill in a vector of some length, shape (3,), from its heading in turns and the sine of its rise."""
    angle = 2.0 * np.pi * heading
    level = np.sqrt(1.0 - rise * rise)  # cosine of the angle to the horizontal
    vector[0] = length * level * np.cos(angle)
    vector[1] = length * level * np.sin(angle)
    vector[2] = length * rise


@compiled
def _course_fits(draft: Draft, duration: float, scene: int, row: int) -> bool:
    """Return True if an obstacle leaves the start free at first, and the goal at first and while movements may end."""
    shortest, longest = draft.setting.relative_durations
    x, y, z = draft.scenes.obstacles.centre[scene, row]
    if max(abs(x), abs(y), abs(z)) > FARTHEST_MOVING:
        return False
    for k in range(BEGINNING_TIMES):
        time = duration * BEGINNING * k / (BEGINNING_TIMES - 1)
        if not is_row_clear(draft, draft.at_start, scene, row, time, MARGIN, 1):
            return False
    for k in range(-1, ENDING_TIMES):
        share = k / (ENDING_TIMES - 1)
        time = duration * _mixed((shortest, ENDING * longest), share) if k >= 0 else 0.0
        if not is_row_clear(draft, draft.at_goal, scene, row, time, MARGIN, 1):
            return False
    return True


@compiled
def draw_jumps(draft: Draft, which: Int, durations: Float, numbers: Float) -> Bool:
    """Draw the jumps of the target of the scenes at indices (K,), and return True where all of them fit, shape (K,).

    `durations` are those of the straight movements, shape (K,), [s]; `numbers` are uniform random numbers, shape
    (K, :func:`numbers_of_jumps`).
    """
    joints = draft.scenes.start.shape[1]
    fewest, most = draft.setting.n_jumps
    each = 1 + CANDIDATES * (1 + joints)
    good = np.ones(len(which), np.bool_)
    before, target = np.empty(joints), np.empty(joints)
    for k in range(len(which)):
        scene, u = which[k], numbers[k]
        count = fewest + int((most - fewest + 1) * u[0])
        start = draft.scenes.start[scene]
        before[:] = draft.scenes.goal[scene]
        draft.scenes.jumps[scene] = 0.0
        time = 0.0
        for jump in range(count):
            first = 1 + jump * each
            time += durations[k] * _mixed(NEXT_JUMP if jump else FIRST_JUMP, u[first])
            fits = False
            for candidate in range(CANDIDATES):
                begin = first + 1 + candidate * (1 + joints)
                fits = _jump(draft, start, before, u[begin : begin + 1 + joints], target)
                fits = fits and is_end(draft, target)
                for row in range(draft.scenes.obstacles.kind.shape[1]):
                    # The target must be free when it appears.
                    fits = fits and is_row_clear(draft, draft.placed, scene, row, time, MARGIN, 1)
                if fits:
                    break
            if not fits:
                good[k] = False
                break
            draft.scenes.jumps[scene, jump, 0] = time
            for joint in range(joints):
                before[joint] = target[joint]
                draft.scenes.jumps[scene, jump, 1 + joint] = target[joint]
    return good


@compiled
def _jump(draft: Draft, start: Float, before: Float, u: Float, target: Float) -> bool:
    """Fill in a target at a random distance from the one before, and return True if the hand has a way to it."""
    setting, placed = draft.setting, draft.placed
    if not setting.of_hand:
        length = 0.0
        for joint in range(len(target)):
            target[joint] = 2.0 * u[1 + joint] - 1.0
            length += target[joint] ** 2
        scale = _mixed(JUMP_OF_JOINTS, u[0]) / max(np.sqrt(length), 1e-6)
        for joint in range(len(target)):
            target[joint] = before[joint] + scale * target[joint]
        return True
    x, y, _ = tool_position(setting.chain, before, placed.rotation, placed.origin)
    a, b, _ = tool_position(setting.chain, start, placed.rotation, placed.origin)
    length = _mixed(JUMP_OF_HAND, u[0])
    angle = 2.0 * np.pi * u[1]
    to_x = x + length * np.cos(angle)
    to_y = y + length * np.sin(angle)
    # The hand is between the start and the target before: its way is between the ways from there.
    for k in range(PASSED + 1):
        share = k / PASSED
        for p, q in ((a, b), (x, y)):
            there = p + share * (to_x - p), q + share * (to_y - q)
            if not solve_planar(setting.chain, setting.inner_range, there[0], there[1], target):
                return False
    return True
