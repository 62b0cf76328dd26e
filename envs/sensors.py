"""Range sensors: fans of rays and depth images of the obstacles of a scene.

A sensor sees the first surface along each ray. It does not see backs, nor what lies behind other obstacles. Rays are
cast against the signed distances of the shapes, so that a new shape is seen without code of its own. The arm is not
seen: its pose is known, and software of real sensors filters it out.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.kinematics import forward, link_poses
from viapoint.envs.common.arrays import Bool, Float, Int, frame_matrices
from viapoint.envs.common.validation import (
    finite_array,
    number_of_at_least,
    unit_quaternion,
    whole_number,
)
from viapoint.envs.geometry.clearance import point_distance_and_normal
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import ABSENT, HALF_SPACE, POINT_CLOUD, Obstacles, bounding_boxes

Mount = Literal["world", "hand"]
MOUNTS = ("world", "hand")  # Frames in which the pose of a sensor may be given
MOST_RAYS = 65_536  # Greatest number of rays of a sensor
MOST_LOOKS = 64  # Greatest number of looks that are remembered
WIDEST_IMAGE = 2.9  # Greatest field of view of an image, [rad]: its rays meet a plane
VIEW_MARGIN = 0.01  # Least distance of obstacles from a sensor when an episode begins, [m]
TOUCH = 1e-5  # Distance from a surface at which a ray has met it, [m]
MOST_STEPS = 100  # Greatest number of steps along a ray towards a convex obstacle


class Readings(NamedTuple):
    """Readings of R rays in N scenes."""

    ranges: Float  # Distances along the rays, the greatest range where nothing is met, shape (N, R), [m]
    points: Float  # Ends of the rays in the world, shape (N, R, 3), [m]
    seen: Int  # Row of the obstacle that a ray meets, -1 for none, shape (N, R); not part of the observation
    eye: Float  # Place of the sensor, shape (N, 3), [m]


class Looks(NamedTuple):
    """Readings of the last L looks of a sensor in N scenes, the newest first; looks not yet made have met nothing."""

    eyes: Float  # Places of the sensor, shape (N, L, 3), [m]
    ranges: Float  # Distances along the rays, shape (N, L, R), [m]
    points: Float  # Ends of the rays in the world, shape (N, L, R, 3), [m]

    @classmethod
    def none(cls, sensor: Sensor, number: int) -> Looks:
        """Return the memory of a sensor that has not looked yet in a number of scenes."""
        shape = number, sensor.looks, sensor.n_rays
        return cls(np.zeros((*shape[:2], 3)), np.full(shape, sensor.range), np.zeros((*shape, 3)))

    def add(self, rows: Int, sensor: Sensor, arm: Arm, joints: Float, obstacles: Obstacles) -> None:
        """Look once more in the scenes at indices (n,), at joint positions (n, J), and forget the oldest look."""
        for part in self:
            part[rows, 1:] = part[rows, :-1]
        readings = sensor.read(arm, joints, obstacles)
        self.eyes[rows, 0] = readings.eye
        self.ranges[rows, 0], self.points[rows, 0] = readings.ranges, readings.points


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Range sensor: a fan of rays, or a depth image of several rows.

    Its frame has x forward, y to the left and z up. The rays of a fan lie in the plane of x and y, at equal angles from
    the left to the right. Those of an image go through the pixels of a pinhole camera, row by row from the top left.
    Noise and dropped rays depend on the readings alone, so that a scene looks the same whenever it is looked at.

    Raises:
        ValueError: A number is out of range.

    Example:
        >>> from viapoint.envs import Box, Sensor, Task
        >>> from viapoint.envs.geometry.obstacles import pack
        >>> sensor = Sensor(columns=3, field_of_view=1.0)
        >>> box = Box((0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0))
        >>> sensor.read(Task.of().arm, [[0.0, 1.0]], pack([[box]])).ranges.round(3).tolist()
        [[1.5, 0.4, 1.5]]
    """

    mount: Mount = "world"
    """Frame of the pose: `world`, or `hand` for a sensor that moves with the tool."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the sensor in this frame, [m]."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of the sensor in this frame, (w, x, y, z)."""
    columns: int = 192
    """Number of rays in a row."""
    rows: int = 1
    """Number of rows; 1 for a fan."""
    field_of_view: float = 1.5 * math.pi
    """Angle from the left to the right edge, [rad]."""
    range: float = 1.5
    """Greatest distance that is measured, [m]."""
    noise: float = 0.0
    """Standard deviation of the distances, [m]."""
    dropped: float = 0.0
    """Share of rays that return the greatest range whatever they meet."""
    looks: int = 1
    """Number of looks that an observation holds, the newest first: the start of an episode and the end of each decision
    are looks. With more than one, the points that were seen on the way are remembered."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.mount not in MOUNTS:
            raise ValueError(f"mount of the sensor must be one of {', '.join(MOUNTS)}, got {self.mount!r}")
        checked: dict[str, Any] = {
            "position": tuple(finite_array("position of the sensor", self.position, (3,)).tolist()),
            "quaternion": tuple(unit_quaternion("quaternion of the sensor", self.quaternion).tolist()),
        }
        for name, most in (("columns", MOST_RAYS), ("rows", MOST_RAYS), ("looks", MOST_LOOKS)):
            checked[name] = whole_number(f"{name} of the sensor", getattr(self, name), 1, most)
        if checked["columns"] * checked["rows"] > MOST_RAYS:
            raise ValueError(f"a sensor must have at most {MOST_RAYS} rays")
        widest = 2.0 * math.pi if checked["rows"] == 1 else WIDEST_IMAGE
        bounds = {"field_of_view": (1e-3, widest + 1e-9), "range": (2.0 * VIEW_MARGIN, 100.0)}
        bounds |= {"noise": (0.0, 1.0), "dropped": (0.0, 1.0)}
        for name, (least, below) in bounds.items():
            checked[name] = number_of_at_least(f"{name} of the sensor", getattr(self, name), least, below)
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def n_rays(self) -> int:
        """Number of rays."""
        return self.columns * self.rows

    @functools.cached_property
    def directions(self) -> Float:
        """Unit vectors of the rays in the frame of the sensor, shape (R, 3)."""
        column = (np.arange(self.columns) + 0.5) / self.columns - 0.5
        if self.rows == 1:
            angle = -self.field_of_view * column
            return np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=-1)
        width = 2.0 * math.tan(0.5 * self.field_of_view)
        row = ((np.arange(self.rows) + 0.5) / self.rows - 0.5) * self.rows / self.columns
        down, left = np.meshgrid(row, -column, indexing="ij")
        rays = np.stack((np.ones_like(left), width * left, -width * down), axis=-1).reshape(-1, 3)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def pose(self, arm: Arm, joints: Float) -> tuple[Float, Float]:
        """Return its axes as columns, (N, 3, 3), and its origins, (N, 3) [m], for joint positions of shape (N, J)."""
        rotation = frame_matrices(np.array(self.quaternion))
        position = np.array(self.position)
        number = len(joints)
        if self.mount == "world":
            return np.tile(rotation, (number, 1, 1)), np.tile(position, (number, 1))
        links, _ = link_poses(arm.chain, joints)
        tool = links[:, -1] @ arm.chain.tool_rotation
        place, _ = forward(arm.chain, joints)
        return tool @ rotation, place + tool @ position

    def sees(self, arm: Arm, reach: float, heights: tuple[float, float]) -> bool:
        """Return True if a ray comes to where an arm may meet obstacles: near enough, and between two heights, [m].

        What a hand can meet is within `reach` of the first joint, and within twice as much of itself, [m].
        """
        rotation, eye = self.pose(arm, arm.home[None])
        rays = self.directions @ rotation[0].T
        on_hand = self.mount == "hand"
        away = (arm.hand(arm.home) if on_hand else arm.chain.origin[0]) - eye[0]
        radius = 2.0 * reach if on_hand else reach
        # The part of each ray that is in the ball around this place
        middle = rays @ away
        half_square = radius**2 - away @ away + middle**2
        half = np.sqrt(np.maximum(half_square, 0.0))
        first = np.maximum(middle - half, 0.0)
        last = np.minimum(middle + half, self.range)
        # The part of it that is between the heights; a level ray is there all the way, or nowhere
        rise = np.where(np.abs(rays[:, 2]) < 1e-9, 1e-9, rays[:, 2])
        to_heights = (np.array(heights)[:, None] - eye[0, 2]) / rise
        first = np.maximum(first, to_heights.min(axis=0))
        last = np.minimum(last, to_heights.max(axis=0))
        return bool(((half_square >= 0.0) & (first <= last)).any())

    def ray_towards(self, local: Any) -> Any:
        """Return the number of the ray nearest to points, -1 outside the field of view, shape (...), int32.

        Points are in the frame of the sensor, shape (..., 3), [m].
        """
        x, y, z = local[..., 0], local[..., 1], local[..., 2]
        if self.rows == 1:
            column = np.floor((0.5 - np.arctan2(y, x) / self.field_of_view) * self.columns)
            inside = (column >= 0) & (column < self.columns)
            return np.where(inside, column, -1).astype(np.int32)
        width = 2.0 * math.tan(0.5 * self.field_of_view)
        before = np.maximum(x, 1e-9)  # points behind are left out below
        column = np.floor((0.5 - y / (before * width)) * self.columns)
        row = np.floor((0.5 - z * self.columns / (before * width * self.rows)) * self.rows)
        inside = (x > 0.0) & (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return np.where(inside, row * self.columns + column, -1).astype(np.int32)

    def read(self, arm: Arm, joints: Any, obstacles: Obstacles) -> Readings:
        """Return the readings of obstacles at their present places, with arms at joint positions of shape (N, J)."""
        rotation, origin = self.pose(arm, np.asarray(joints, np.float64))
        ranges, seen, rays = self._cast(rotation, origin, obstacles)
        if self.noise or self.dropped:  # functions of the distances and the rays' numbers
            numbers = np.arange(1, self.n_rays + 1, dtype=np.uint64)
            # Distances of one scene differ in their last bits where its numbers were written and read.
            bits = np.rint(ranges / GRAIN).astype(np.uint64) + numbers * np.uint64(GOLDEN)
            first, second, third = (_uniform(bits + np.uint64(k)) for k in range(3))
            # Two uniform numbers give a normal one (G. E. P. Box and M. E. Muller, 1958).
            normal = np.sqrt(-2.0 * np.log(1.0 - first)) * np.cos(2.0 * np.pi * second)
            noisy = np.clip(ranges + self.noise * normal, 0.0, self.range)
            seen = np.where(third < self.dropped, -1, seen)
            ranges = np.where(seen < 0, self.range, noisy)
        return Readings(ranges, origin[:, None] + ranges[..., None] * rays, seen, origin)

    def hidden(self, rotation: Float, origin: Float, obstacles: Obstacles) -> Bool:
        """Return True for obstacles that no ray meets, shape (N, n), for poses of the sensor, see :meth:`pose`."""
        _, seen, _ = self._cast(rotation, origin, obstacles)
        rows = np.arange(obstacles.kind.shape[1])
        met = (seen[..., None] == rows).any(axis=1)
        return np.asarray(obstacles.present & ~met)

    def _cast(self, rotation: Float, origin: Float, obstacles: Obstacles) -> tuple[Float, Int, Float]:
        """Return exact distances, rows of the obstacles that are met, and the rays, shape (N, R, 3)."""
        rays = np.ascontiguousarray(np.einsum("nij,rj->nri", rotation, self.directions))
        centre, half = bounding_boxes(obstacles)
        ball = np.linalg.norm(half, axis=-1)
        ball[obstacles.kind == HALF_SPACE] = np.inf  # they have no end
        ranges = np.full((len(origin), self.n_rays), self.range)
        seen = np.full(ranges.shape, -1, np.int64)
        _cast(obstacles, centre, ball, origin, rays, ranges, seen)
        return ranges, seen, rays


NAMED = ("rays", "camera", "hand_rays", "hand_camera")  # Names of usual sensors, see :func:`named_sensor`


def named_sensor(name: str, arm: Arm, foot: tuple[float, float, float], scale: float) -> Sensor:
    """Return a usual sensor for an arm.

    Args:
        name: `rays`, a fan of 192 rays from the first joint at the height of the hand; `camera`, a depth image from
            above and behind the base; `hand_rays`, a short fan of 192 rays all around the hand; `hand_camera`, a depth
            image from the tool along its approach axis, its z axis. Those of the hand remember eight looks.
        arm: Arm.
        foot: Place of its foot, [m].
        scale: Size of the arm relative to the reference arm.

    Raises:
        ValueError: There is no such sensor.
    """
    hand = arm.hand(arm.home)
    bearing = math.atan2(hand[1] - foot[1], hand[0] - foot[0])  # where the arm works
    if name == "rays":
        turn = math.cos(0.5 * bearing), 0.0, 0.0, math.sin(0.5 * bearing)
        return Sensor(position=(foot[0], foot[1], float(hand[2])), quaternion=turn, range=1.5 * scale)
    if name == "camera":
        along = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        eye = np.array(foot) + scale * (-0.35 * along + [0.0, 0.0, 1.15])
        target = np.array(foot) + scale * (0.5 * along + [0.0, 0.0, 0.3])
        turn = _towards(target - eye)
        place = float(eye[0]), float(eye[1]), float(eye[2])
        return Sensor(
            position=place, quaternion=turn, columns=48, rows=36, field_of_view=1.3, range=2.5 * scale
        )
    if name == "hand_rays":
        return Sensor(mount="hand", field_of_view=2.0 * math.pi, range=0.4 * scale, looks=8)
    if name == "hand_camera":
        turn = math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0
        return Sensor(
            mount="hand", quaternion=turn, columns=32, rows=24, field_of_view=1.5, range=1.0 * scale, looks=8
        )
    raise ValueError(f"sensor must be one of {', '.join(NAMED)}, got {name!r}")


GRAIN = 1e-9  # Distance below which readings count as equal for the random numbers of their noise, [m]
GOLDEN = 0x9E3779B97F4A7C15  # Odd number near 2^64 divided by the golden ratio, the step of SplitMix64


def _uniform(bits: Any) -> Float:
    """Return numbers in [0, 1) that look random (SplitMix64, G. L. Steele et al., 2014)."""
    mixed = bits * np.uint64(GOLDEN)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed ^= mixed >> np.uint64(31)
    return np.asarray((mixed >> np.uint64(11)) * 2.0**-53)


def _towards(direction: Float) -> tuple[float, float, float, float]:
    """Return the quaternion of a level frame whose x axis has a direction, shape (3,)."""
    yaw = math.atan2(direction[1], direction[0])
    pitch = -math.atan2(direction[2], math.hypot(direction[0], direction[1]))
    a, b = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    c = math.cos(0.5 * pitch)
    d = math.sin(0.5 * pitch)
    return a * c, -b * d, a * d, b * c


@compiled
def _cast(
    obstacles: Obstacles,
    centre: Float,
    ball: Float,
    origin: Float,
    rays: Float,
    ranges: Float,
    seen: Int,
) -> None:
    """Shorten ranges, (N, R), to the first surface along each ray, (N, R, 3), and fill in the row of the obstacle.

    The bounding balls of obstacles have a centre, (N, n, 3), and a radius, which is infinite for half-spaces.
    """
    for scene in range(len(origin)):
        for row in range(obstacles.kind.shape[1]):
            kind = obstacles.kind[scene, row]
            if kind == ABSENT:
                continue
            x0, y0, z0 = origin[scene]
            radius = ball[scene, row] + TOUCH
            away_x = centre[scene, row, 0] - x0
            away_y = centre[scene, row, 1] - y0
            away_z = centre[scene, row, 2] - z0
            square = away_x**2 + away_y**2 + away_z**2
            for ray in range(rays.shape[1]):
                x, y, z = rays[scene, ray]
                first, last = 0.0, ranges[scene, ray]
                if radius < np.inf:
                    middle = away_x * x + away_y * y + away_z * z
                    half_square = radius * radius - square + middle * middle  # where the ray is in the ball
                    if half_square < 0.0:
                        continue
                    half = math.sqrt(half_square)
                    first = max(middle - half, 0.0)
                    last = min(middle + half, last)
                way = first
                # A ray along points goes on in small steps, and to a convex shape in few.
                steps = 0
                while way < last and (steps < MOST_STEPS or kind == POINT_CLOUD):
                    steps += 1
                    apart, a, b, c = point_distance_and_normal(
                        obstacles, scene, row, x0 + way * x, y0 + way * y, z0 + way * z, 0.0, 1e9
                    )
                    if apart < TOUCH:
                        ranges[scene, ray] = way
                        seen[scene, ray] = row
                        break
                    step = max(apart, TOUCH)
                    if kind != POINT_CLOUD:
                        # A convex shape lies behind the plane through its nearest point.
                        closing = -(a * x + b * y + c * z)
                        if closing <= 0.0:  # the ray leaves the shape behind
                            break
                        step = apart / closing
                    way += step
