"""Scenes: start, goal and obstacles of a movement, and checks of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.common.validation import MIN_GOAL_DISTANCE
from viapoint.envs.geometry.distance import arm_clearance, hand_clearance
from viapoint.envs.geometry.half_space import EXTENT, HalfSpace
from viapoint.envs.geometry.rows import (
    has_shapes,
    pair_distance,
    rotation_axes,
    shape_columns,
    shape_number,
    shape_rows,
    widened,
)
from viapoint.envs.geometry.shape import UNIT_TOLERANCE
from viapoint.envs.geometry.shapes import SHAPES

if TYPE_CHECKING:
    from viapoint.envs.arms.base import CollisionModel

LARGEST_HALF_AXIS = 0.3
"""Greatest half length of a bar, [m]."""
LARGEST_RADIUS = 0.1
"""Greatest radius of an obstacle, [m]."""
FASTEST = 1.0
"""Greatest speed of an obstacle, [m/s]."""
FARTHEST_CENTRE = 1.0
"""Greatest coordinate of an obstacle's centre, [m]."""
LARGEST_HALF_LENGTH, FARTHEST_SHAPE = 1.0, 2.0
"""Greatest half length and coordinate of the box of an obstacle where obstacles may have any shape, [m]."""
FARTHEST_SURFACE = FARTHEST_SHAPE - EXTENT
"""Greatest distance of a half-space's surface from the origin, [m]; its observed cube is then not too far."""
ROUNDING = 1e-9
"""Rounding error of distances, [m]."""

TARGETS = {
    "T1": (-0.32, 0.42),
    "T2": (-0.22, 0.27),
    "T3": (-0.02, 0.27),
    "T4": (0.08, 0.42),
    "T5": (-0.02, 0.57),
    "T6": (-0.22, 0.57),
}
"""The six targets of Flash & Hogan 1985, Fig. 2, [m], shoulder at the origin.

The figure gives no coordinates. Its movements T1-T4, T2-T5 and T3-T6 (Figs. 1, 3 and 4) are the three diagonals of a
hexagon here, 40, 36 and 36 cm long, in front of the right shoulder and within the reach of the arm.
"""


class Scenes(NamedTuple):
    """N scenes of up to n obstacles each."""

    start: Float
    """Shape (N, D), [m]."""
    goal: Float
    """Shape (N, D), [m]."""
    obstacles: Float
    """Rows (centre D, half-axis D, radius), shape (N, n, 2 D + 1), [m], or rows with shapes, see
    :mod:`viapoint.envs.geometry.rows`; absent rows are zero."""

    @property
    def present(self) -> Bool:
        """Rows that are obstacles, shape (N, n); absent ones have no radius."""
        return self.obstacles[..., -1] > 0.0

    def take(self, rows: Any) -> Scenes:
        """Return the scenes at `rows`, an index, slice or mask."""
        return Scenes(self.start[rows], self.goal[rows], self.obstacles[rows])

    def put(self, rows: Any, scenes: Scenes) -> None:
        """Overwrite the scenes at `rows`."""
        for mine, theirs in zip(self, scenes, strict=True):
            mine[rows] = theirs

    def as_options(self) -> dict[str, Float]:
        """Return the scenes as options of `reset`."""
        return dict(self._asdict())


def rows_of_lights(length: float = 0.25, radius: float = 0.008) -> tuple[list[tuple[str, str]], Scenes]:
    """Return the obstacle paradigm of Flash & Hogan 1985: a row of lights across the middle of each movement.

    Args:
        length: Length of the row, [m]; the paper's rows were up to 25 cm long.
        radius: Radius of the row, [m].

    Returns:
        Ordered pairs of targets, 0.3 m or more apart, and their scenes.

    Example:
        >>> from viapoint.envs import rows_of_lights
        >>> pairs, scenes = rows_of_lights()
        >>> pairs[0], scenes.obstacles.shape  # one capsule in each scene, [m]
        (('T1', 'T3'), (14, 1, 5))
    """
    pairs = [
        (a, b) for a in TARGETS for b in TARGETS if np.hypot(*np.subtract(TARGETS[a], TARGETS[b])) >= 0.3
    ]
    start = np.array([TARGETS[a] for a, _ in pairs])
    goal = np.array([TARGETS[b] for _, b in pairs])
    along = (goal - start) / norm(goal - start)[..., None]
    half = 0.5 * length * np.stack((-along[:, 1], along[:, 0]), axis=-1)
    rows = np.concatenate(((start + goal) / 2.0, half, np.full((len(pairs), 1), radius)), axis=-1)
    return pairs, Scenes(start, goal, rows[:, None, :])


Problem = tuple[Bool, Callable[[int], str]]
"""Mask of the scenes that have a fault, shape (N,), and a function that describes it in one of them."""
Names = Sequence[Sequence[str]]
"""Names of obstacles, empty where there is none: one list for all scenes, or one for each."""


def problem(
    wrong: Any, why: str, values: Any = None, part: Callable[[int, int], str] | None = None
) -> Problem:
    """Return a fault of scenes.

    Args:
        wrong: True for scenes, shape (N,), or for parts of them, shape (N, n), that have the fault.
        why: Description of the fault with what is allowed.
        values: Wrong numbers, of the shape of `wrong`.
        part: Function that names one of n parts of a scene.
    """
    wrong = np.asarray(wrong)

    def reason(scene: int) -> str:
        index = (scene,) if part is None else (scene, int(wrong[scene].argmax()))
        got = "" if values is None else f", got {values[index]:.4g}"
        return f"{why}{got}" if part is None else f"{part(*index)} {why}{got}"

    return wrong if part is None else wrong.any(axis=-1), reason


def check_scenes(scenes: Scenes, collision_model: CollisionModel, names: Names = ((),)) -> None:
    """Check that a movement can start and end in each scene.

    Args:
        scenes: N scenes.
        collision_model: Arm and the parts of it that obstacles may not touch.
        names: Names of the obstacles, for the message.

    Raises:
        ValueError: A scene is impossible; the message names the scene, the fault and the allowed values.
    """
    refuse(problems(scenes, collision_model, names))


def refuse(faults: Iterator[Problem]) -> None:
    """Raise ValueError for the first of some faults that a scene has."""
    for wrong, reason in faults:
        if wrong.any():
            first = int(wrong.argmax())
            raise ValueError(f"scene {first}: {reason(first)}")


def problems(scenes: Scenes, collision_model: CollisionModel, names: Names = ((),)) -> Iterator[Problem]:
    """Yield the faults that N scenes can have; see :func:`check_scenes`."""
    d = scenes.start.shape[-1]

    def obstacle(scene: int, row: int) -> str:
        known = names[scene if len(names) > 1 else 0]
        name = f" {known[row]!r}" if row < len(known) and known[row] else ""
        return f"obstacle {row}{name} at {scenes.obstacles[scene, row, :d].round(4).tolist()} m"

    arm, ends = collision_model.arm, (("start", scenes.start), ("goal", scenes.goal))
    apart = norm(scenes.goal - scenes.start)
    yield problem(
        apart < MIN_GOAL_DISTANCE, f"start and goal must be {MIN_GOAL_DISTANCE} m or more apart", apart
    )
    for name, point in ends:
        margin = np.asarray(arm.reach_margin(point))
        yield problem(
            margin < 0.0, f"{name} must be within the arm's reach: its margin must be 0 m or more", margin
        )
    faults = _problems_of_shapes(scenes) if has_shapes(scenes.obstacles) else _problems_of_capsules(scenes)
    for wrong, why in faults:
        yield problem(wrong, why, part=obstacle)
    if scenes.present.any() and (base := getattr(arm, "base", ())):
        yield problem(
            _contain(scenes, base), "may overlap the base of the arm, but not contain it", part=obstacle
        )
    for name, point in ends:
        clearance = rest_clearance(scenes, point, collision_model)[:, :-1]
        yield problem(
            clearance <= 0.0,
            f"touches the arm at the {name}: its clearance must be over 0 m",
            clearance,
            obstacle,
        )


def _contain(scenes: Scenes, base: Sequence[Any]) -> Bool:
    """Return which obstacles contain all capsules of an arm's base, shape (N, n).

    As obstacles are convex, they contain a capsule if they contain the balls around both ends of its axis.
    """
    rows = widened(scenes.obstacles)[scenes.present]
    inside, contain = np.ones(len(rows), dtype=bool), np.zeros(scenes.present.shape, dtype=bool)
    for capsule in base:
        for end in capsule.ends:
            place = np.broadcast_to(np.asarray(end, dtype=np.float64), (len(rows), 3))
            inside &= pair_distance(rows, place) <= -capsule.radius
    contain[scenes.present] = inside
    return contain


def _problems_of_capsules(scenes: Scenes) -> Iterator[tuple[Any, str]]:
    """Yield the faults of single capsules: masks, shape (N, n), and what is wrong."""
    dimension = scenes.start.shape[-1]
    radius = scenes.obstacles[..., -1]
    yield (scenes.obstacles != 0.0).any(axis=-1) & (radius <= 0.0), "has no positive radius"
    yield radius > LARGEST_RADIUS, f"has a radius over {LARGEST_RADIUS} m"
    half = norm(scenes.obstacles[..., dimension : 2 * dimension])
    yield half > LARGEST_HALF_AXIS, f"has a half-axis over {LARGEST_HALF_AXIS} m"
    far = np.abs(scenes.obstacles[..., :dimension]) > FARTHEST_CENTRE
    yield far.any(axis=-1), "has its centre over 1 m from the origin"


def _problems_of_shapes(scenes: Scenes) -> Iterator[tuple[Any, str]]:
    """Yield the faults of single obstacles of any shape: masks, shape (N, n), and what is wrong."""
    rows, (kind, centre, quaternion, half) = scenes.obstacles, shape_columns(scenes.obstacles)
    again = rows.copy()
    known = {number: name for number, (name, shape) in enumerate(SHAPES.items()) if shape.in_scenes}
    strange = ~np.isin(kind, list(known)) | (np.abs(norm(quaternion) - 1.0) > UNIT_TOLERANCE)
    for number in np.unique(kind[scenes.present & ~strange]):
        some = scenes.present & (kind == number)
        place = centre[some][:, : scenes.start.shape[-1]]
        name = known[int(number)]
        again[some] = shape_rows(name, place, quaternion[some], half[some])
        shape, (x, y, z) = SHAPES[name], np.moveaxis(half[some], -1, 0)
        strange[some] |= (half[some] <= 0.0).any(axis=-1) | (shape.round & (np.abs(x - y) > 1e-6))
        if name in ("sphere", "capsule"):
            strange[some] |= (z < x - 1e-6) | ((name == "sphere") & (z > x + 1e-6))
        if (only := shape.only_half) is not None:
            strange[some] |= (np.abs(half[some] - only) > 1e-6).any(axis=-1)
    strange |= (np.abs(again - rows) > 1e-6).any(axis=-1)
    yield (rows != 0.0).any(axis=-1) & (strange | ~scenes.present), "is no row of a shape"
    yield (half > LARGEST_HALF_LENGTH).any(axis=-1), f"has a half length over {LARGEST_HALF_LENGTH:g} m"
    apart = np.abs((centre * rotation_axes(quaternion)[2]).sum(axis=-1) + EXTENT)
    away = (kind == shape_number(HalfSpace.kind)) & (apart > FARTHEST_SURFACE + ROUNDING)
    yield away, f"has its surface over {FARTHEST_SURFACE:g} m from the origin"
    far = np.abs(centre) > FARTHEST_SHAPE + ROUNDING
    yield far.any(axis=-1), f"has its centre over {FARTHEST_SHAPE:g} m from the origin"


def rest_clearance(scenes: Scenes, point: Float, collision_model: CollisionModel) -> Float:
    """Return the clearance of an arm, its hand at (N, D), from n obstacles and one far away, shape (N, n + 1), [m]."""
    arm = collision_model.arm
    hand = hand_clearance(point[:, None], arm.hand_radius, scenes.obstacles, scenes.present)
    if collision_model.whole_arm:
        links = arm.links(arm.inverse_kinematics(point))[:, None]
        hand = np.minimum(hand, arm_clearance(links, arm.link_radii, scenes.obstacles, scenes.present))
    return np.concatenate(
        (hand, np.ones_like(hand[:, :1]) if hand.size else np.ones((len(point), 1))), axis=-1
    )
