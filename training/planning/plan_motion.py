"""Planner for known obstacles: seeds of via-points, refined by the gradient of clearance, checked, and polished.

It needs an arm and obstacles, but no environment and no network.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import (
    RANGE_TOLERANCE,
    UnreachableError,
    inverse_kinematics,
    nearest_goals,
)
from viapoint.envs.arms.kinematics import motion_torques, slowdowns, torques
from viapoint.envs.arms.registry import arm_of
from viapoint.envs.common.arrays import Float, norm
from viapoint.envs.common.validation import as_real_array, finite_array, number_of_at_least, whole_number
from viapoint.envs.geometry.clearance import row_clearances
from viapoint.envs.geometry.obstacles import Obstacles, pack
from viapoint.envs.geometry.shapes import Shape, as_obstacles
from viapoint.envs.outcome import SETTLING, relative_jerk, straight_jerk_cost
from viapoint.envs.plans import Plan, SpaceName
from viapoint.envs.scenes.options import Pose, as_pose
from viapoint.envs.spaces import Space, space_of
from viapoint.training.planning.motion_plan import Limits, MotionPlan, joint_motion
from viapoint.training.planning.movements import (
    FINE_INSTANTS,
    NEAR,
    OUTSIDE,
    Movement,
    MovementTable,
    Setting,
    arm_setting,
    fine_table,
    movement_table,
    table_with,
)
from viapoint.training.planning.ompl_paths import import_ompl, path_around
from viapoint.training.planning.refine import (
    SMOOTH,
    Found,
    exact_clearance,
    is_free,
    refine_seeds,
    unit_of_jerk,
)
from viapoint.training.planning.rrt_connect import VIA_COUNTS, clear_path, points_on

# Once enough movements are free, more seeds are tried around the one with the least jerk: MORE for each doubling of its
# relative jerk cost beyond ROUGH, and at most MOST_MORE.
ROUGH, MORE, MOST_MORE = 1.3, 16, 12
# Spread of the first random seeds around the straight line, and of later ones, [rad] and [m]
SPREADS = {"joints": (0.8, 1.0), "hand": (0.15, 0.3)}
NARROW = 8  # Number of seeds with the first spread
CLOSE = 0.3  # Share of the first spread for every second seed around the best movement
# Number of seeds after which a path is looked for, where none became free, and of seeds along this path
EARLY, ALONG = 4, 4
# Paths that are looked for in turn: clearances beyond what movements keep, as shares of those of the ends up to ROOM,
# [m], of which smooth movements need some; and greatest shares of the time that is left. Random seeds follow the first
# turn.
PATHS, ROOM = ((0.4, 0.15), (0.1, 0.2), (0.0, 0.4)), 0.02
PATH_ATTEMPTS = 12
JAGGED = 20.0  # Relative jerk cost of a movement along a path beyond which one more path is tried
ALONG_TIME = 0.1  # Time limit of the refinement of a movement along a path, [s]
MOST_REFINED = 12  # Greatest number of via-points that are refined, which takes longer the more there are
SEEDS = 256  # Greatest number of random seeds
CHUNKS = 1, 1, 2, 4  # Numbers of seeds between two looks at the clock; the last one repeats
LONGEST_SEARCH = 1.0  # Default of the time limit, [s]
SHORTEST = 0.25  # Shortest duration that is chosen, after which servos come to rest in time, [s]
UNLIMITED = 0.85  # The same for arms without velocity limits, [s]
# Instants of FINE_INSTANTS at which limits are looked at: every second one, and the last
LIMIT_INSTANTS = np.append(np.arange(0, FINE_INSTANTS - 1, 2), FINE_INSTANTS - 1)
BETWEEN = 1.0005  # Factor on shares of limits at these instants, for the greatest ones between two of them
ROUNDS = 6  # Number of durations that are tried in motion and among moving obstacles
# Factor from one of these durations to the next, and from the straight movement to the first
LONGER = 1.3
SPARE = 1e-3  # Clearance that movements keep beyond the margin where their ends have it, [m]
COARSE = 0.01  # Excess of an arm's spheres above which a contact may be one of the spheres only, [m]
ROUNDING = 1e-6  # Rounding error of clearances, [m]
# Required clearances of a path of OMPL in each attempt, until one can be made smooth, [m]
OMPL_MARGINS = (0.010, 0.004, 0.001, 0.001)
OMPL_ROOM = 0.7  # Greatest of these clearances, as a share of that of the ends
OMPL_PATIENCE = 1.0  # Time limit for each path of OMPL as a baseline, [s]
GOALS = 8  # Greatest number of configurations that are tried for a pose


class _Problem(NamedTuple):
    """One planning problem in coordinates of a space, and the beginning of its search."""

    arm: Arm
    space: Space
    start: Float
    velocity: Float
    acceleration: Float
    goal: Float
    obstacles: Obstacles
    duration: float | None = None
    margin: float = 0.0
    given: Any = ()  # Via-points that are tried first, shape (S, K, D)
    enough: int = 1  # Number of free movements
    generator: Any = None  # Random generator of the seeds
    names: Sequence[str] = ()  # Names of the obstacles, empty for those without

    def setting(self, near: float = np.inf) -> Setting:
        """Return arm and space; in the plane without spheres that are farther than `near` from all obstacles, [m].

        The margin is not for the arm itself: parts of some arms are always near one another.
        """
        found = arm_setting(self.arm, self.space.of_hand, self.obstacles, room=-RANGE_TOLERANCE, near=near)
        return found._replace(spheres=found.spheres._replace(self_allowance=self.margin))

    @property
    def room(self) -> Float:
        """Factor on the spread of seeds in each coordinate, shape (D,), which is less for short slides."""
        if self.space.of_hand:
            return np.ones(len(self.start))
        half = 0.5 * np.ptp(self.arm.joint_range, axis=1)
        return np.where(self.arm.chain.sliding, np.minimum(half, 1.0), 1.0)

    @property
    def in_motion(self) -> bool:
        """True if the movement begins in motion."""
        return bool(self.velocity.any() or self.acceleration.any())

    @property
    def moves(self) -> bool:
        """True if the clearance of a movement depends on its duration."""
        return self.in_motion or bool(self.obstacles.velocity.any())

    @property
    def least(self) -> float | None:
        """Least factor on the durations of movements, see :func:`_timed`; None where they change clearances."""
        return 0.0 if self.duration is None and not self.moves else None

    def movement(self, vias: Float, table: MovementTable, times: int, duration: float) -> Movement:
        """Return a movement through via-points relative to the start, shape (K, D), by its row of a table."""
        offsets = np.empty((len(vias) + 3, len(self.start)))
        offsets[:-3] = vias
        offsets[-3] = self.goal - self.start
        offsets[-2] = self.velocity * duration
        offsets[-1] = self.acceleration * duration**2
        return Movement(table, times, self.start, offsets, duration)


def plan_motion(
    arm: Arm | str,
    start: Any,
    goal: Any,
    obstacles: Iterable[Shape | Mapping[str, Any]] | Obstacles = (),
    *,
    n_via: int = 2,
    seeds: Any = SEEDS,
    enough: int = 1,
    time_limit: float = LONGEST_SEARCH,
    margin: float = 0.0,
    duration: float | None = None,
    space: SpaceName | None = None,
    velocity: Any = None,
    acceleration: Any = None,
    ompl: bool = True,
    rng: np.random.Generator | int | None = None,
) -> MotionPlan:
    """Plan a minimum-jerk movement through via-points from a start to a goal around obstacles.

    The straight movement is taken if it is free. Otherwise via-points are refined by the gradient of clearance and jerk
    (see `viapoint.training.planning.refine`), from the straight line first, and then from random seeds, until
    `enough` free movements are found; if all are rough, from some more seeds around the best one. Each is checked at
    256 instants and polished; the one with the least jerk is taken. Where the first seeds fail, RRT-Connect looks for
    a path (see `viapoint.training.planning.rrt_connect`), which the movement follows through as many via-points as it
    needs. Among moving obstacles, several durations are tried, each 1.3 times as long as the one before.

    Args:
        arm: Arm, or name of one.
        start: Joint positions, shape (J,), [rad]; in hand space a position of the hand, shape (2,), [m]. Positions of
            continuous joints count modulo a turn; the movement has them within their range.
        goal: The same; or several of them, shape (G, D), of which the cheapest to reach is taken; or one or several
            poses of the tool, :class:`~viapoint.envs.scenes.options.Pose`.
        obstacles: Shapes or dictionaries at time 0, with their velocities, or packed obstacles of one scene.
        n_via: Number of via-points, 1 to 3; movements along a path may have up to 32.
        seeds: Greatest number of random seeds, for all goals together; or via-points, shape (S, n_via, D), that are
            tried first, before up to 256 random ones.
        enough: Number of free movements among which the one with the least jerk is chosen.
        time_limit: Time after which no further seed is tried, [s]; with 0, only the straight movement is looked at.
            Inverse kinematics of poses, 10 to 40 ms, and up to 200 ms for one out of reach, comes before.
        margin: Least clearance of the movement from obstacles, [m]; from itself, the arm keeps 0.
        duration: Duration, [s]; None for the shortest that keeps 97 % of the limits, 0.25 s or more.
        space: `joints` or `hand`; that of the arm by default.
        velocity: Initial velocity, shape (D,); 0 by default.
        acceleration: Initial acceleration, shape (D,); 0 by default.
        ompl: True to follow a path of OMPL's RRT-Connect where nothing else is found, if the extra `planning` is
            installed.
        rng: Random generator of the seeds, or its seed; 0 by default.

    Returns:
        The best movement found. `success` tells whether it is free and keeps all limits, and `reason` why not.

    Raises:
        ValueError: An argument has another shape or is not finite, or a pose cannot be reached.

    Example:
        >>> from viapoint.envs import Box, arm_of
        >>> from viapoint.training import plan_motion
        >>> arm = arm_of("panda")
        >>> goal = arm.home + [0.8, 0.5, 0.0, 0.6, 0.0, 0.3, 0.0]
        >>> wall = Box((0.1, 0.1, 0.3), position=(0.5, 0.15, 0.3))
        >>> plan = plan_motion(arm, arm.home, goal, [wall])
        >>> plan.success, plan.clearance > 0.0, plan.source
        (True, True, 'straight, refined')
    """
    # Plain numbers: compiled functions would be compiled again for those of other types.
    n_via = whole_number("n_via", n_via, 1, 3)
    enough = whole_number("enough", enough, 1)
    time_limit = number_of_at_least("time_limit", time_limit, 0.0)
    margin = number_of_at_least("margin", margin, 0.0)
    if duration is not None:
        duration = number_of_at_least("duration", duration, 1e-3)
    arm = arm_of(arm)
    where = space_of(arm, arm.space if space is None else space)
    _warm_up(arm, where.of_hand, n_via)
    began = time.perf_counter()
    shapes = [] if isinstance(obstacles, Obstacles) else as_obstacles(obstacles)
    packed = obstacles if isinstance(obstacles, Obstacles) else pack([shapes])
    if len(packed.kind) != 1:
        raise ValueError(f"obstacles must be those of one scene, got {len(packed.kind)} scenes")
    number, given = SEEDS, np.zeros((0, n_via, where.dimension))
    if np.ndim(seeds) == 0:
        number = whole_number("seeds", seeds, 0)
    elif np.size(seeds):
        given = finite_array("seeds", seeds, (None, n_via, where.dimension))
    if not isinstance(rng, np.random.Generator):
        rng = np.random.default_rng(whole_number("rng", 0 if rng is None else rng, 0))
    shape = (where.dimension,)
    rest = np.zeros(shape)
    change = rest if acceleration is None else acceleration
    problem = _Problem(
        arm=arm,
        space=where,
        start=np.array(finite_array("start", start, shape)),
        velocity=np.array(finite_array("velocity", rest if velocity is None else velocity, shape)),
        acceleration=np.array(finite_array("acceleration", change, shape)),
        goal=rest,
        obstacles=packed,
        duration=duration,
        margin=margin,
        given=given,
        enough=enough,
        generator=rng,
        names=[shape.name for shape in shapes],
    )
    if not where.of_hand:  # a start outside the range of a continuous joint is turned into it, others stay
        problem = problem._replace(start=nearest_goals(arm, problem.start, problem.start))
    goals = _goals(problem, goal)
    number = -(-number // len(goals))  # rounded up
    until = time.perf_counter() + time_limit
    # Straight movements are cheap, and the first goal that is reached bounds what others may cost. Paths are looked for
    # where no goal is reached without.
    straight = []
    if len(goals) > 1:
        straight = [_plan(problem._replace(goal=each), 0, 0.0) for each in goals]
    plans = list[MotionPlan]()
    for paths in (False, True) if straight else (True,):
        for rank, each in enumerate(goals):
            least = min((plan.duration for plan in (*straight, *plans) if plan.success), default=np.inf)
            if straight and (straight[rank].duration >= least or (paths and np.isfinite(least))):
                continue
            # A goal that cannot be reached costs its share of the time, or a few seeds if another one is reached.
            now = time.perf_counter()
            share = now + (until - now) / (len(goals) - rank)
            few = number if np.isinf(least) else min(number, NARROW)
            plans.append(_plan(problem._replace(goal=each), few, share, paths, ompl))
    plans += straight
    best = max(plans, key=_merit)
    return dataclasses.replace(best, milliseconds=1e3 * (time.perf_counter() - began))


def _merit(plan: MotionPlan) -> tuple[bool, float]:
    """Return by what the best plan has the greatest: a short one that succeeds, then clearance, and small loads."""
    worst = min(plan.clearance, 0.0) - max(*plan.limits, 1.0)
    return plan.success, -plan.duration if plan.success else worst


def plan_motions(
    arm: Arm | str,
    starts: Sequence[Any],
    goals: Sequence[Any],
    obstacles: Sequence[Any],
    *,
    threads: int | None = None,
    **kwargs: Any,
) -> list[MotionPlan]:
    """Plan N movements on threads; the other arguments are those of :func:`plan_motion`.

    Each movement is planned as :func:`plan_motion` plans it alone, except where the time limit is reached, or a path of
    OMPL is followed: all threads have its random generator in common. The `reason` of each plan without success begins
    with the number of its problem, such as `problem 3: `, from 0. A problem with an argument that is not allowed, or a
    pose out of reach, is refused: its plan has the source `refused` and no waypoints, and raises UnsafePlanError when
    it is executed or exported, also with `force=True`.

    Args:
        arm: Arm, or name of one.
        starts: N starts.
        goals: N goals.
        obstacles: Obstacles of the N problems, each as :func:`plan_motion` takes them.
        threads: Number of threads; as many as the machine has processors by default.
        **kwargs: Arguments of :func:`plan_motion`; a random generator `rng` gives each problem one of its own.

    Example:
        >>> from viapoint.training import plan_motions
        >>> plans = plan_motions("planar", [(-0.2, 0.3), (-0.2, 0.4)], [(0.1, 0.4), (0.2, 0.3)], [[], []])
        >>> [plan.success for plan in plans]
        [True, True]
        >>> plan_motions("planar", [(-0.2, 0.3, 0.0)], [(0.1, 0.4)], [[]])
        [MotionPlan('planar', refused: problem 0: start must have shape (2,), got (3,))]
    """
    arm = arm_of(arm)
    if threads is not None:
        whole_number("threads", threads, 1)
    if not len(starts) == len(goals) == len(obstacles):
        raise ValueError(
            f"starts, goals and obstacles must be equally many, got {len(starts)}, {len(goals)}, {len(obstacles)}"
        )

    # Problems that shared a generator would depend on one another, and on the threads.
    rng = kwargs.pop("rng", None)
    rngs = rng.spawn(len(starts)) if isinstance(rng, np.random.Generator) else [rng] * len(starts)

    home = space_of(arm, kwargs.get("space") or arm.space).coordinates(arm.home)
    # What is a fault of all problems is raised here.
    number_of_at_least("time_limit", kwargs.get("time_limit", LONGEST_SEARCH), 0.0)
    seed = None if isinstance(rng, np.random.Generator) else rng
    rest = plan_motion(arm, home, home, **{**kwargs, "time_limit": 0.0, "rng": seed})
    refused = dataclasses.replace(
        rest, waypoints=rest.waypoints[:0], durations=rest.durations[:0], success=False, clearance=np.nan,
        limits=Limits(np.nan, np.nan), jerk=np.nan, source="refused", milliseconds=0.0,
    )  # fmt: skip

    def plan(number: int) -> MotionPlan:
        try:
            found = plan_motion(
                arm, starts[number], goals[number], obstacles[number], rng=rngs[number], **kwargs
            )
        except (ValueError, TypeError) as error:
            found = dataclasses.replace(refused, reason=str(error))
        if found.success:
            return found
        return dataclasses.replace(found, reason=f"problem {number}: {found.reason}")

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(plan, range(len(starts))))


def checked_motion(
    arm: Arm, space: SpaceName, plan: Plan, obstacles: Obstacles, source: str, *, shortest: bool = False
) -> MotionPlan:
    """Return a plan of any planner, of one movement in one scene, with its clearance and its limits.

    Its duration is the shortest that the limits allow with `shortest`, otherwise that of the plan, or a longer one if
    the limits need it. `source` is the name of the planner.
    """
    waypoints = np.array(plan.waypoints, np.float64)
    durations = np.asarray(plan.durations)
    duration = float(durations.sum())
    zero = np.zeros(waypoints.shape[1])
    problem = _Problem(
        arm=arm,
        space=space_of(arm, space),
        start=waypoints[0],
        velocity=zero if plan.velocity is None else np.asarray(plan.velocity),
        acceleration=zero if plan.acceleration is None else np.asarray(plan.acceleration),
        goal=waypoints[-1],
        obstacles=obstacles,
    )
    table = table_with(durations[None] / duration, FINE_INSTANTS)
    movement = problem.movement(waypoints[1:-1] - waypoints[0], table, 0, duration)
    return _known(problem, movement, source, 0.0 if shortest else 1.0, _fault(problem)[0])


def ompl_motion(
    arm: Arm, start: Float, goal: Float, obstacles: Obstacles, *, space: SpaceName = "joints"
) -> MotionPlan:
    """Return the smooth movement along a path of RRT-Connect, or the one with the most clearance if none is free.

    It is the minimum-jerk movement through as few points of the path as stay clear. OMPL has one random generator for
    all its planners, so that results depend on those before. Start and goal are coordinates of the space in which the
    movement is smooth; the path is one of joints. Obstacles are at rest.
    """
    where = space_of(arm, space)

    def smooth(configurations: Float) -> MotionPlan:
        points = where.coordinates(configurations)
        plan = Plan(points, np.asarray(primitives.passage_durations(points, 1.0)))
        return checked_motion(arm, space, plan, obstacles, "ompl", shortest=True)

    ends = np.ascontiguousarray(where.joints(np.stack((start, goal))))
    best = smooth(ends)
    setting = arm_setting(arm, where.of_hand, obstacles)
    nearest = _clearance_of(setting, ends, obstacles, OMPL_MARGINS[0])
    for most in OMPL_MARGINS:
        margin = min(most, OMPL_ROOM * nearest)
        path = path_around(setting, ends, obstacles, margin, OMPL_PATIENCE)
        if path is None:
            continue
        for count in VIA_COUNTS:
            plan = smooth(points_on(path, count))
            if plan.clearance > best.clearance:
                best = plan
            if plan.success and plan.clearance >= 0.5 * margin:
                return plan
    return best


@functools.lru_cache(maxsize=64)
def _warm_up(arm: Arm, of_hand: bool, n_via: int) -> None:
    """Make tables, and load or compile the machine code, so that no time limit is spent on them."""
    space = space_of(arm, "hand" if of_hand else "joints")
    start = np.array(space.coordinates(arm.home))
    still = np.zeros_like(start)
    problem = _Problem(arm, space, start, still, still, start + 0.01, pack([[]]))
    straight = _straight(problem)
    is_free(problem.setting(), straight, problem.obstacles, 0.0)
    _known(problem, straight, "straight", 0.0, _fault(problem)[0])
    tables = movement_table(n_via), fine_table(n_via)
    _refined(problem, problem.setting(), 0.0, tables, np.zeros((0, n_via, len(start))), 1.0, np.inf)
    rng = np.random.default_rng(0)
    clear_path(problem.setting(), np.stack((arm.home, arm.home)), problem.obstacles, 0.0, rng, 0.0)


def _goals(problem: _Problem, goal: Any) -> Float:
    """Return the goals that are tried, nearest first, shape (G, D)."""
    poses = [goal] if isinstance(goal, Pose | Mapping) else goal
    if isinstance(poses, Sequence) and any(isinstance(each, Pose | Mapping) for each in poses):
        return _goals_of_poses(problem, [as_pose("goal", each) for each in poses])
    values = as_real_array(goal)
    number = 0 if values is None or not values.ndim else values.shape[-1]
    if number != len(problem.start) and number in (3, 7):
        raise ValueError(
            f"goal must be {len(problem.start)} coordinates, got {number}; a place in space is "
            "goal=Pose(position=(x, y, z)), with quaternion=(w, x, y, z) for the direction of the tool "
            "(command line: --position, --quaternion)"
        )
    several = values is not None and values.ndim > 1
    goals = finite_array("goal", goal if several else [goal], (None, len(problem.start)))
    if not problem.space.of_hand:
        goals = nearest_goals(problem.arm, goals, problem.start)
    away = np.abs(goals - problem.start).max(axis=-1)
    # Copies are contiguous and writable, which compiled functions depend on.
    return np.array(goals[np.argsort(away, kind="stable")])


def _goals_of_poses(problem: _Problem, poses: list[Pose]) -> Float:
    """Return coordinates of configurations with the tool at a pose, shape (G, D); free ones where there are any.

    For each pose the nearest come first; poses out of reach are passed over unless all are.
    """
    arm, found = problem.arm, []
    fault = None
    near = problem.space.joints(problem.start)
    resting = ~problem.obstacles.velocity[0].any(axis=-1)
    for pose in poses:
        try:
            joints = inverse_kinematics(arm, pose.position, pose.quaternion, seed=near)
        except UnreachableError as error:
            fault = error
            continue
        many = problem.obstacles.take(np.zeros(len(joints), np.int64))
        rows, own = row_clearances(arm.chain, problem.setting().spheres, joints, many, problem.margin + SPARE)
        apart = np.minimum(own, rows[:, resting].min(axis=1, initial=np.inf))
        free = apart >= problem.margin
        if free.any():
            joints = joints[free]
        found.append(problem.space.coordinates(joints[:GOALS]))
    if not found and fault is not None:
        raise fault
    return np.concatenate(found)


def _fault(problem: _Problem) -> tuple[str, float]:
    """Return what is wrong with start or goal, empty for nothing, and the clearance that movements are to keep, [m].

    It is a little more than the margin, for what happens between the instants and in physics, unless an end is nearer.
    """
    arm, space = problem.arm, problem.space
    ends = np.stack((problem.start, problem.goal))
    joints = np.ascontiguousarray(space.joints(ends))
    inside = space.inside(ends)
    # Where moving obstacles are in the end depends on the duration.
    resting = ~problem.obstacles.velocity[0].any(axis=-1)
    both = problem.obstacles.take([0, 0])
    most = problem.margin + SPARE
    rows, own = row_clearances(arm.chain, problem.setting().spheres, joints, both, most)
    for end, name in enumerate(("start", "goal")):
        beyond = np.maximum(arm.joint_range[:, 0] - joints[end], joints[end] - arm.joint_range[:, 1])
        worst = int(beyond.argmax())
        if not inside[end]:
            if space.of_hand or beyond[worst] <= 0.0:
                return f"the {name} is out of reach", most
            low, high = arm.joint_range[worst]
            allowed = f"must be from {low:.7g} to {high:.7g}, got {joints[end, worst]:.7g}"
            return f"the {name} is outside the limits: joint {arm.joint_names[worst]!r} {allowed}", most
        counts = both.present[end] & (resting | (end == 0))
        row = int(np.where(counts, rows[end], np.inf).argmin()) if counts.any() else -1
        apart = min(rows[end, row], own[end]) if row >= 0 else own[end]
        if apart >= problem.margin:
            continue
        if apart == own[end]:
            apart -= problem.margin
            which = f"the arm touches itself at the {name} ({arm.nearest_bodies(joints[end])})"
        else:
            called = f" {problem.names[row]!r}" if problem.names and problem.names[row] else ""
            touches = "in contact with" if apart < 0.0 else "nearer than the margin to"
            which = f"the {name} is {touches} obstacle {row}{called}"
        which += f", clearance {1e3 * apart:.1f} mm"
        if arm.excess > COARSE and -arm.excess < apart < 0.0:
            reach = f"spheres reach up to {1e3 * arm.excess:.0f} mm beyond the arm's geoms"
            which += f" ({reach}; load_arm(..., tolerance=0.005) brings most of them closer)"
        return which, most
    if problem.in_motion:
        moving = joint_motion(space, ends[:1], problem.velocity[None], problem.acceleration[None])
        torque = motion_torques(arm.chain, *moving)[0]
        shares = {"velocity": moving.velocity[0] / arm.velocity_limit, "torque": torque / arm.torque_limit}
        for kind, share in shares.items():
            share = np.abs(share)
            if share.max() > 1.0:
                joint = arm.joint_names[int(share.argmax())]
                return f"the start has {share.max():.2f} times the {kind} limit of joint {joint!r}", most
    counted = both.present & (resting | np.array([[True], [False]]))
    nearest = min(float(own.min()), float(rows.min(where=counted, initial=most)))
    return "", max(problem.margin, min(most, nearest - ROUNDING))


def _plan(
    problem: _Problem, number: int, until: float, paths: bool = False, ompl: bool = False
) -> MotionPlan:
    """Return the best movement to one goal, after a search with up to a number of random seeds until some time, [s].

    With `paths`, those that are found by trees are followed where the first seeds fail, in the end also one of OMPL.
    """
    fault, kept = _fault(problem)
    straight = _straight(problem)
    coarse = straight._replace(table=movement_table(0))
    if fault or is_free(problem.setting(), coarse, problem.obstacles, kept):
        plan = _known(problem, straight, "straight", problem.least, fault)
        if plan.success or fault or problem.duration is not None:
            return plan
    duration = straight.duration
    # In motion, and among moving obstacles, a longer movement is another one: several durations share the seeds.
    several = problem.moves and problem.duration is None
    if several:
        number = -(-number // ROUNDS)  # rounded up
        duration *= 1.0 if problem.in_motion else LONGER  # the straight one in motion has it already
    tried, best, source = 0, None, "given"
    for _ in range(ROUNDS if several else 1):
        follows = paths and not problem.moves
        early = EARLY if follows else math.inf
        found, more = _search(problem, kept, duration, number, until, early=early, source=source)
        tried += more
        if found is None and follows and time.perf_counter() < until:
            problem = problem._replace(given=problem.given[:0])
            found, more = _search_around(problem, kept, duration, number, until, ompl)
            tried += more
        if found is not None:
            best = found
            if best.success or not several:
                return dataclasses.replace(best, seeds=tried)
            problem = problem._replace(given=best.waypoints[None, 1:-1])
            source = best.source
        duration *= LONGER
    plan = best or _known(problem, straight, "straight", problem.least)
    ended = "the time limit was reached" if time.perf_counter() >= until else "no free one was found"
    seeds = "1 seed" if tried == 1 else f"{tried} seeds"
    reason = f"{plan.reason}; {ended} from {seeds}" if tried else f"{plan.reason}; no time for another one"
    return dataclasses.replace(plan, success=False, seeds=tried, reason=reason)


def _straight(problem: _Problem) -> Movement:
    """Return the straight movement.

    Where clearance depends on its duration, it has the shortest one that it would have from rest, in motion LONGER.
    """
    still = np.zeros_like(problem.start)
    resting = problem._replace(velocity=still, acceleration=still)
    movement = resting.movement(np.zeros((0, len(still))), fine_table(0), 0, problem.duration or 1.0)
    duration = movement.duration
    if problem.duration is None and problem.moves:
        duration, _, _ = _timed(problem, movement, 0.0)
        duration *= LONGER if problem.in_motion else 1.0
    return problem.movement(movement.offsets[:-3], movement.table, 0, duration)


def _search(
    problem: _Problem,
    kept: float,
    duration: float,
    number: int,
    until: float,
    *,
    first: int = 0,
    early: float = math.inf,
    source: str = "given",
) -> tuple[MotionPlan | None, int]:
    """Refine seeds until enough movements are free; return the one with the least jerk, and the number of seeds.

    Given seeds, from a `source`, come first, then the straight line and `number` random ones, without those before the
    `first` of them. Beside the given ones, no more than `early` are tried if none becomes free.
    """
    given, enough, n_via = problem.given, problem.enough, problem.given.shape[1]
    way = problem.goal - problem.start
    straight = np.arange(1, n_via + 1)[:, None] / (n_via + 1) * way
    unit = unit_of_jerk(way, problem.space.of_hand)
    near, far = SPREADS[problem.space.name]
    room = problem.room
    tables = movement_table(n_via), fine_table(n_via)
    setting = problem.setting(kept + NEAR)  # clearances below NEAR are right
    best, least = None, np.inf
    tight, widest = None, problem.margin  # the best of those that keep the margin and nothing more
    tried = free = since = 0
    total = len(given) + max(1 + number - first, 0)
    while time.perf_counter() < until:
        left = total - tried
        if free >= enough:  # rough movements are worth many more seeds
            more = int(MORE * math.log2(max(least / unit / ROUGH, 1.0)))
            left = min(left, since + min(more, MOST_MORE) - tried)
        elif not free:
            left = int(min(left, len(given) + early - tried))
        if left <= 0:
            break
        seeds = np.empty((min(CHUNKS[min(tried, len(CHUNKS) - 1)], left), *straight.shape))
        for k in range(len(seeds)):
            if tried + k < len(given):
                seeds[k] = given[tried + k] - problem.start
                continue
            rank = tried + k - len(given) + first
            away = room * problem.generator.uniform(-1.0, 1.0, straight.shape)
            if best is not None and (free >= enough or rank % 2):  # what is free is seldom alone
                seeds[k] = best[0].offsets[:n_via] + (1.0 if rank % 2 else CLOSE) * near * away
            else:
                spread = 0.0 if rank == 0 else near if rank < NARROW else far
                seeds[k] = straight + spread * away
        done, found = _refined(
            problem, setting, kept, tables, seeds, duration, until, known=least, enough=max(enough - free, 1)
        )
        for k in range(done):
            clearance = float(found.clearance[k])
            movement = problem.movement(found.vias[k], tables[1], int(found.times[k]), duration)
            if clearance < kept:
                if clearance >= widest:
                    widest = clearance
                    # Its clearance is computed again, with regard to the margin.
                    tight = movement, "random", None
                continue
            free += 1
            if free == enough:
                since = tried + k + 1
            if found.cost[k] < least:
                least = float(found.cost[k])
                rank = tried + k - len(given) + first
                name = source if tried + k < len(given) else "random" if rank else "straight, refined"
                best = movement, name, clearance
        tried += done
    chosen = best or tight
    if chosen is None:
        return None, tried
    movement, name, known = chosen
    return _known(problem, movement, name, problem.least, clearance=known), tried


def _clearance_of(setting: Setting, joints: Float, obstacles: Obstacles, most: float) -> float:
    """Return the least clearance of configurations, shape (N, J), among obstacles of one scene, at most `most`, [m]."""
    many = obstacles.take([0] * len(joints))
    rows, own = row_clearances(setting.chain, setting.spheres, joints, many, most)
    return min(float(own.min()), float(rows.min(initial=most)))


def _search_around(
    problem: _Problem, kept: float, duration: float, number: int, until: float, ompl: bool
) -> tuple[MotionPlan | None, int]:
    """Return the best movement along a clear path or from random seeds, and the number of seeds.

    Points of a path become seeds first, then as many via-points as the movement needs. As many paths are followed as
    free movements are wanted, and one more if the movement is jagged.
    """
    ends = np.ascontiguousarray(problem.space.joints(np.stack((problem.start, problem.goal))))
    setting = problem.setting()
    room = max(_clearance_of(setting, ends, problem.obstacles, kept + ROOM) - kept, 0.0)
    tried = free = 0
    best = None
    for attempt in range(PATH_ATTEMPTS):
        if time.perf_counter() >= until:
            break
        share, time_share = PATHS[attempt % len(PATHS)]
        patience = time_share * (until - time.perf_counter())
        margin = kept + share * room
        path = clear_path(setting, ends, problem.obstacles, margin, problem.generator, patience)
        found = None
        if len(path):
            vias = problem.space.coordinates(points_on(path, problem.given.shape[1]))[1:-1]
            near, _ = SPREADS[problem.space.name]
            away = problem.room * problem.generator.uniform(-near, near, (ALONG, *vias.shape))
            away[0] = 0.0
            along = problem._replace(given=vias + away)
            found, more = _search(along, kept, duration, number, until, early=0, source="path")
            tried += more
            found = found or _along(problem, kept, duration, until, path, "path")
        if found is None and attempt == len(PATHS) - 1:
            found, more = _search(problem, kept, duration, number, until, first=EARLY)
            tried += more
        if found is None:
            continue
        free += found.success
        if best is None or (found.success, -found.jerk) > (best.success, -best.jerk):
            best = found
        if free >= problem.enough + (best.jerk > JAGGED):
            return best, tried
    patience = until - time.perf_counter()
    if best is None and ompl and patience > 0.0:
        try:
            import_ompl()  # the time of the first import does not count
        except ValueError:
            return None, tried
        other = path_around(setting, ends, problem.obstacles, kept, patience)
        if other is not None:
            best = _along(problem, kept, duration, until, other, "ompl")
    return best, tried


def _refined(
    problem: _Problem,
    setting: Setting,
    kept: float,
    tables: tuple[MovementTable, MovementTable],
    seeds: Float,
    duration: float,
    until: float,
    *,
    smooth: float = SMOOTH,
    known: float = math.inf,
    enough: int = 1,
) -> tuple[int, Found]:
    """Refine seeds, shape (S, K, D); see :func:`~viapoint.training.planning.refine.refine_seeds`."""
    fixed = problem.movement(seeds[:0, 0], tables[0], 0, duration).offsets
    unit = unit_of_jerk(problem.goal - problem.start, problem.space.of_hand)
    endless = np.full(seeds.shape[1:], np.inf)
    return refine_seeds(
        setting, *tables, problem.start, fixed, seeds, np.stack((-endless, endless)), duration,
        problem.obstacles, kept, unit, smooth, known, enough, until - time.perf_counter(),
    )  # fmt: skip


def _along(
    problem: _Problem, kept: float, duration: float, until: float, path: Float, source: str
) -> MotionPlan | None:
    """Return a movement along a path of joints, with as many via-points as it needs; None if there is none.

    Fewer points of a free movement often make a smoother one.
    """
    for number in VIA_COUNTS:
        if time.perf_counter() >= until:
            break
        points = problem.space.coordinates(points_on(path, number))
        # Passage times of least jerk take longer to compute than all else, and leave narrow passages more often.
        shares = np.sqrt(np.maximum(norm(np.diff(points, axis=0)), 1e-6))
        durations = (shares / shares.sum())[None]
        table = table_with(durations, FINE_INSTANTS)
        found = _moved(problem, kept, table, points[1:-1], duration, until)
        if found is None:
            continue
        for fewer in reversed(VIA_COUNTS[: VIA_COUNTS.index(number)]):
            if time.perf_counter() >= until:
                break
            movement, _, cost = found
            instants = np.linspace(0, FINE_INSTANTS - 1, fewer + 2).round().astype(np.int64)[1:-1]
            points = movement.start + movement.table.basis[movement.times, instants] @ movement.offsets
            other = _moved(problem, kept, fine_table(fewer), points, duration, until)
            if other is not None and other[2] < cost:
                found = other
        movement, clearance, _ = found
        return _known(problem, movement, source, problem.least, clearance=clearance)
    return None


def _moved(
    problem: _Problem,
    kept: float,
    table: MovementTable,
    vias: Float,
    duration: float,
    until: float,
) -> tuple[Movement, float, float] | None:
    """Return the movement through via-points, shape (K, D), after refinement, its clearance, [m], and its jerk cost.

    None if it is not free. Many via-points are left where they are. Movements along paths are long: with fewer instants
    than those of a fine table, the refinement would not see what is between two of them.
    """
    offsets = vias - problem.start
    if len(vias) > MOST_REFINED:
        movement = problem.movement(offsets, table, 0, duration)
        clearance = exact_clearance(problem.setting(), movement, problem.obstacles, kept)
        cost = np.einsum("ij,id,jd->", table.cost[0], movement.offsets, movement.offsets)
        return (movement, clearance, float(cost)) if clearance >= kept else None
    soon = min(until, time.perf_counter() + ALONG_TIME)
    tables = table, table
    _, found = _refined(problem, problem.setting(), kept, tables, offsets[None], duration, soon, smooth=0.0)
    clearance = float(found.clearance[0])
    movement = problem.movement(found.vias[0], table, int(found.times[0]), duration)
    return (movement, clearance, float(found.cost[0])) if clearance >= kept else None


def _timed(problem: _Problem, movement: Movement, least: float | None) -> tuple[float, Limits, str]:
    """Return the duration of a movement, the shares of the limits that it uses, and how it fails to keep them.

    `least` is the least factor on its duration; limits may need a greater one. None keeps the duration as it is.
    """
    arm = problem.arm
    table, times, start, offsets, duration = movement
    position = start + table.basis[times, LIMIT_INSTANTS] @ offsets
    velocity = table.rate[times, LIMIT_INSTANTS] @ offsets / duration
    acceleration = table.bend[times, LIMIT_INSTANTS] @ offsets / duration**2
    motion = joint_motion(problem.space, position, velocity, acceleration)
    one = (part[None] for part in motion)
    (needed,) = slowdowns(arm.chain, arm.velocity_limit, arm.torque_limit, *one)
    factor = 1.0 if least is None else max(needed, least)
    if least == 0.0:
        shortest = SHORTEST if np.isfinite(arm.velocity_limit).all() else UNLIMITED
        factor = max(factor, shortest / duration)
    rate = motion.velocity / factor
    change = motion.acceleration / factor**2
    torque = motion_torques(arm.chain, motion.position, rate, change)
    shares = np.stack((np.abs(rate) / arm.velocity_limit, np.abs(torque) / arm.torque_limit)).max(axis=1)
    limits = Limits(*(BETWEEN * shares.max(axis=1)).tolist())
    kind = "velocity" if limits.velocity > limits.torque else "torque"
    share = max(limits)
    worst = shares.max(axis=0).argmax()
    when = f"in {factor * duration:.2f} s; this movement takes {needed * duration:.2f} s or more"
    if limits.torque > 1.0:
        at_rest = np.abs(torques(arm.chain, motion.position, np.zeros(1), np.zeros(1))) / arm.torque_limit
        if at_rest.max() > 1.0:
            kind = "torque"
            when = "for the weight of the arm"
            share = float(at_rest.max())
            worst = at_rest.max(axis=0).argmax()
    beyond = f"joint {arm.joint_names[worst]!r} needs {share:.2f} times its {kind} limit {when}"
    return factor * duration, limits, beyond


def _exact(problem: _Problem, movement: Movement) -> float:
    """Return the clearance of a movement, also while the arm comes to rest at the goal, [m]; OUTSIDE out of reach."""
    setting, obstacles, margin = problem.setting(), problem.obstacles, problem.margin
    clearance = exact_clearance(setting, movement, obstacles, margin)
    if obstacles.velocity[0].any():
        later = obstacles._replace(centre=obstacles.centre + movement.duration * obstacles.velocity)
        rest = Movement(fine_table(0), 0, problem.goal, np.zeros((3, len(problem.goal))), SETTLING)
        clearance = min(clearance, exact_clearance(setting, rest, later, margin))
    return clearance


def _known(
    problem: _Problem,
    movement: Movement,
    source: str,
    least: float | None,
    fault: str = "",
    clearance: float | None = None,
) -> MotionPlan:
    """Return a movement with what is known of it; see :func:`_timed` for its duration, and `least`."""
    duration, limits, beyond = _timed(problem, movement, least)
    table, times, start, offsets, _ = movement
    vias = offsets[:-3]
    movement = problem.movement(vias, table, times, duration)
    if clearance is None or clearance >= NEAR or problem.moves:
        clearance = _exact(problem, movement)
    kept = clearance
    if problem.margin > 0.0 and clearance != OUTSIDE:  # in which own clearances count with the margin
        clearance = min(clearance, _exact(problem._replace(margin=0.0), movement))
    cost = np.einsum("ij,id,jd->", table.cost[times], movement.offsets, movement.offsets)
    straight_cost = float(straight_jerk_cost(float(np.linalg.norm(problem.goal - problem.start)), 1.0))
    jerk = float(relative_jerk(float(cost), straight_cost))
    reason = fault
    if not reason and clearance == OUTSIDE:
        reason = "it leaves the joint limits or the reach"
    elif not reason and kept < problem.margin:
        nearest = clearance if clearance < 0.0 else kept
        reason = f"its clearance is {1e3 * nearest:.1f} mm, less than {1e3 * problem.margin:g} mm"
    elif not reason and max(limits) > 1.0:
        reason = beyond
    return MotionPlan(
        arm=problem.arm,
        space=problem.space.name,
        waypoints=np.concatenate((start[None], start + vias, problem.goal[None])),
        durations=table.durations[times] * duration,
        velocity=problem.velocity,
        acceleration=problem.acceleration,
        obstacles=problem.obstacles,
        success=not reason,
        clearance=clearance,
        limits=limits,
        jerk=jerk,
        source=source,
        reason=reason,
    )
