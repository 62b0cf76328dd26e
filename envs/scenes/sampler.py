"""Rejection sampling of scenes.

A layout is drawn, then several pairs of start and goal for it. A scene is accepted if both ends are free and the
straight movement between them is not. A scene depends on its own random generator only, whatever the batch.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import planar_joints
from viapoint.envs.arms.kinematics import link_poses, sphere_centres
from viapoint.envs.common.arrays import Bool, Float, Int, norm
from viapoint.envs.geometry.clearance import memory, point_clearances, row_clearances
from viapoint.envs.geometry.obstacles import no_obstacles
from viapoint.envs.plans import SHORTEST_DURATION
from viapoint.envs.scenes.ends import (
    HOME_SHARE,
    PAIRS,
    SELF_MARGIN,
    Draft,
    Setting,
    draw_ends,
    numbers_of_end,
)
from viapoint.envs.scenes.families_registry import Build, scene_families
from viapoint.envs.scenes.layout import MOST_PLACES, PLACE, ROW, Layout, Room, most_rows
from viapoint.envs.scenes.motions import (
    CANDIDATES,
    COURSE_NUMBERS,
    MARGIN,
    draw_courses,
    draw_jumps,
    numbers_of_jumps,
)
from viapoint.envs.scenes.scene import ENDS, MOST_JUMPS, NEVER, Scenes, extents, resting
from viapoint.envs.sensors import VIEW_MARGIN

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
# Layouts that are drawn for a scene at most, and layouts after which another family is tried
ATTEMPTS, FAMILY_ATTEMPTS = 1000, 50


class SceneSampler:
    """Sampler of the scenes of a task.

    Scenes have rows for as many obstacles as the task allows. Obstacles in the plane are in the way of the links, too,
    if `whole_arm`, and keep away from the place of a sensor at the beginning.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.plane = is_planar(task.arm)
        fewest, most = task.n_obstacles
        self.rows = most  # Number of rows for obstacles
        most = min(most, max(fewest, MOST_DRAWN))
        self.room = room_of(task.arm, task.shapes, (fewest, most), task.whole_arm)
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
        farthest = self.task.arm.farthest
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
                found &= np.maximum(*extents(obstacles)).max(axis=1, initial=0.0) <= farthest
            found[found] = self._change(draft, pending[found], generators, given)
            if self.task.sensor is not None:
                found &= self.sensor_clearances(draft.scenes.take(pending)) >= VIEW_MARGIN
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
            f"obstacles, within {farthest:.3g} m, was found in {ATTEMPTS} attempts for the arm {self.task.arm.name!r}; "
            "allow fewer obstacles or other families, or give other ends or jumps"
        )

    def sensor_clearances(self, scenes: Scenes) -> Float:
        """Return the distance of the sensor from the nearest obstacle at first, at most 1 m, shape (N,), [m]."""
        assert self.task.sensor is not None
        _, eyes = self.task.sensor.pose(self.task.arm, scenes.start)
        return point_clearances(scenes.obstacles, eyes)

    def _are_jumps_clear(self, scenes: Scenes) -> Bool:
        """Return True where the arm is clear of obstacles at all targets when they appear, shape (N,)."""
        arm, clear = self.task.arm, np.ones(len(scenes.start), bool)
        for jump in range(MOST_JUMPS):
            time, target = scenes.jump_times[:, jump], scenes.jumps[:, jump, 1:].copy()
            apart, _ = row_clearances(arm.chain, arm.spheres, target, scenes.obstacles_at(time), MARGIN)
            clear &= (time == NEVER) | (apart >= MARGIN).all(axis=1)
        return clear

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

        drawn = "obstacles" not in given
        moves = self.task.moving_obstacles and drawn
        jumps = self.task.n_jumps[1] > 0 and "jumps" not in given
        if moves or jumps:
            space, action = self.task.space, self.task.action
            start, goal = draft.scenes.start[which], draft.scenes.goal[which]
            durations = action.zero_duration(space.coordinates(start), space.coordinates(goal))
            durations = np.maximum(durations, SHORTEST_DURATION * action.centre)
        if moves:
            draw_courses(draft, which, durations, numbers(self._width, CANDIDATES, COURSE_NUMBERS))
        if jumps:
            return draw_jumps(draft, which, durations, numbers(numbers_of_jumps(start.shape[1])))
        if drawn and "jumps" in given:  # given targets are as free as drawn ones
            return self._are_jumps_clear(draft.scenes.take(which))
        return np.ones(len(which), bool)


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
    """Return True for an arm of two hinges with axes that point up."""
    if len(arm.home) != 2 or arm.chain.sliding.any():
        return False
    rotation, _ = link_poses(arm.chain, arm.home)
    return bool((rotation[1:, 2, 2] > 1.0 - 1e-6).all())


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
        farthest=arm.farthest,
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
