"""Scenes that are given to `reset` as options, and files of scenes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.inverse_kinematics import inverse_kinematics, nearest_goals, planar_joints
from viapoint.envs.arms.kinematics import sphere_centres
from viapoint.envs.common.arrays import Float, norm
from viapoint.envs.common.validation import as_real_array, finite_array
from viapoint.envs.geometry.clearance import FAR, row_clearances
from viapoint.envs.geometry.obstacles import Obstacles, no_obstacles, pack, unpack
from viapoint.envs.geometry.shapes import (
    ConvexMesh,
    Shape,
    as_obstacles,
    obstacles_from_json,
    registered_name,
)
from viapoint.envs.plans import SpaceName
from viapoint.envs.scenes.sampler import SceneSampler
from viapoint.envs.scenes.scene import ENDS, MOST_JUMPS, NEVER, Scenes, check_scenes, resting
from viapoint.envs.sensors import VIEW_MARGIN
from viapoint.envs.spaces import space_of

OPTIONS = (*ENDS, "obstacles", "jumps", "turns", "reaches")  # Options of `reset` that give a part of a scene
FORMAT = "viapoint-scene"  # Value of the key `format` of a scene file
REACHED = 1e-6  # Greatest distance of the hand from a given place, [m]


class Pose(NamedTuple):
    """Pose of the tool.

    Example:
        >>> from viapoint.envs.scenes.options import Pose
        >>> Pose(position=(0.5, 0.1, 0.4), quaternion=(0.0, 1.0, 0.0, 0.0)).position  # pointing downwards
        (0.5, 0.1, 0.4)
    """

    position: Any
    """Shape (3,), [m]."""
    quaternion: Any = None
    """Orientation (w, x, y, z), shape (4,); None for any."""


def draw_given(
    options: Mapping[str, Any], sampler: SceneSampler, generators: Sequence[np.random.Generator]
) -> Scenes:
    """Return N scenes with the parts that `options` gives; the other parts are drawn to fit.

    Drawn obstacles stand in the way of given ends; drawn ends are free of given obstacles.

    Args:
        options: May hold `start` and `goal`: in hand space positions of the hand, shape (2,), (3,) or N of them, [m];
            in joint space joint positions, shape (J,) or (N, J), or a :class:`Pose` or its dictionary, or N of them.
            `obstacles`: a list of shapes or dictionaries, or their JSON, for all scenes, or N such lists. `jumps`: rows
            (time [s], target). `turns`: rows (time [s], velocity [m/s]), and `reaches`: rows (begin [s], duration [s],
            x, y, z of the way [m]), for each given obstacle, of zeros for none. All are rows (n, .), or N such.
        sampler: Sampler of the task's scenes.
        generators: N random generators.

    Raises:
        ValueError: A part has another shape or is not finite, a name is unknown, or a scene is impossible.
    """
    _refuse_unknown(options)
    if not options:
        return sampler(generators)
    number, arm = len(generators), sampler.task.arm
    shapes = _shapes(options["obstacles"], sampler, number) if "obstacles" in options else None
    obstacles = no_obstacles(number, sampler.rows) if shapes is None else pack(shapes, sampler.rows)
    names = [[shape.name for shape in each] for each in shapes or ()]
    home = np.tile(arm.home, (number, 1))
    ends: dict[str, Float] = {}
    for name in ENDS:  # the start first, near which the goal is looked for
        if name in options:
            ends[name] = _end(name, options[name], sampler, obstacles, ends.get("start", home))
    scenes = resting(ends.get("start", home), ends.get("goal", home), obstacles)
    if "jumps" in options:
        scenes = scenes._replace(jumps=_jumps(options["jumps"], sampler, scenes.goal))
    for name in ("turns", "reaches"):
        if name in options and shapes is None:
            raise ValueError(f"options[{name!r}] are those of options['obstacles'], which must be given, too")
    if "reaches" in options:
        reach = _rows("reaches", options["reaches"], sampler, (number, sampler.rows, 5))
        scenes = scenes._replace(reach=reach)
    if "turns" in options:
        turns = _rows("turns", options["turns"], sampler, (number, sampler.rows, 4))
        turn_time = np.where((turns != 0.0).any(axis=-1), turns[..., 0], NEVER)
        scenes = scenes._replace(turn_time=turn_time, turn_velocity=turns[..., 1:].copy())
    # What is wrong with the given parts is said before others are drawn around them.
    check_scenes(scenes, arm, names, tuple(ends))
    sensor = sampler.task.sensor
    if sensor is not None and (sensor.mount == "world" or "start" in ends):
        apart = sampler.sensor_clearances(scenes)
        if (apart < VIEW_MARGIN).any():
            raise ValueError(
                f"options['obstacles'] must be {VIEW_MARGIN} m or more from the sensor, got {apart.min():.3g} m in "
                f"scene {int(apart.argmin())}"
            )
    try:
        drawn = sampler(generators, scenes, options)
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    check_scenes(drawn, arm, names)
    return drawn


def _refuse_unknown(names: Mapping[str, Any]) -> None:
    """Check the names of options."""
    unknown = ", ".join(repr(name) for name in names if name not in OPTIONS)
    if unknown:
        raise ValueError(f"options of reset are {', '.join(OPTIONS)} and reset_mask, got {unknown}")


def _shapes(value: Any, sampler: SceneSampler, number: int) -> list[list[Shape]]:
    """Return the given obstacles of N scenes."""
    several = False
    if isinstance(value, list | tuple) and value:
        several = all(isinstance(each, list | tuple | str) for each in value)
    if several and len(value) != number:
        raise ValueError(f"options['obstacles'] must be one list, or {number} lists, got {len(value)}")
    lists = []
    for each in value if several else [value]:
        try:
            lists.append(obstacles_from_json(each) if isinstance(each, str) else as_obstacles(each))
        except ValueError as error:
            raise ValueError(f"options['obstacles']: {error}") from None
    if not several:
        lists *= number
    for shapes in lists:
        if len(shapes) > sampler.rows:
            raise ValueError(
                f"options['obstacles'] must be at most {sampler.rows}, got {len(shapes)}; make the environment with "
                "a greater n_obstacles"
            )
        for row, shape in enumerate(shapes):
            _check_shape(row, shape, sampler)
    return lists


def _check_shape(row: int, shape: Shape, sampler: SceneSampler) -> None:
    """Check that a task has obstacles of a kind, and that one does not contain the base of the arm."""
    kind, allowed = shape.kind, sampler.task.shapes
    if isinstance(shape, ConvexMesh):
        kind = registered_name(shape.vertices, allowed)
        if not kind:
            raise ValueError(
                f"obstacle {row} is a mesh: register_mesh gives it a name, which must be one of the shapes of the "
                f"environment, {', '.join(allowed)}"
            )
    if kind not in allowed:
        raise ValueError(f"obstacle {row} must be one of the task's shapes, {', '.join(allowed)}, got {kind}")
    arm = sampler.task.arm
    base = np.repeat(arm.spheres.link, np.diff(arm.spheres.first)) == 0
    centres = sphere_centres(arm.chain, arm.spheres, arm.home)[base]
    if base.any() and (shape.distance(centres) + arm.spheres.radius[base]).max() <= 0.0:
        named = f" {shape.name!r}" if shape.name else ""
        raise ValueError(f"obstacle {row}{named} may touch the base of the arm, but not contain all of it")


def _end(name: str, value: Any, sampler: SceneSampler, obstacles: Obstacles, near: Float) -> Float:
    """Return the joint positions of a given end, shape (N, J), where there are several those near others."""
    number, joints = len(obstacles.kind), len(sampler.task.arm.home)
    label = f"options[{name!r}]"
    several = [value] * number if isinstance(value, Pose | Mapping) else value
    is_list = isinstance(several, Sequence) and len(several) > 0
    if is_list and all(isinstance(each, Pose | Mapping) for each in several):
        if len(several) != number:
            raise ValueError(f"{label} must be one pose, or {number} poses, got {len(several)}")
        poses = [as_pose(label, each) for each in several]
        if sampler.task.space_name == "joints":
            found = np.empty((number, joints))
            for i, pose in enumerate(poses):
                found[i] = _solution(label, pose, sampler.task.arm, obstacles.take([i]), near[i])
            return found
        if any(pose.quaternion is not None for pose in poses):
            raise ValueError(f"{label} must have no quaternion: in hand space an end is a place of the hand")
        value = [pose.position for pose in poses]
    if sampler.task.space_name == "joints":
        array = finite_array(label, value, (joints,), (number, joints))
        array = np.broadcast_to(array, (number, joints))
        array = nearest_goals(sampler.task.arm, array, near if name == "goal" else array)
        return np.array(array, order="C")
    array = finite_array(label, value, (2,), (3,), (number, 2), (number, 3))
    height = sampler.room.foot[2]
    if array.shape[-1] == 3 and (np.abs(array[..., 2] - height) > REACHED).any():
        raise ValueError(f"{label} must have z = {height:g} m, as the hand has, got {array.tolist()}")
    return _planar(label, sampler.task.arm, np.broadcast_to(array[..., :2], (number, 2)))


def _planar(label: str, arm: Arm, hand: Float) -> Float:
    """Return the joint positions for places of the hand in the plane, shape (..., 2)."""
    joints = np.clip(planar_joints(arm, np.array(hand, order="C")), *arm.joint_range.T)
    away = norm(arm.hand(joints)[..., :2] - hand)
    if (away > REACHED).any():
        where = hand[away > REACHED][0].tolist()
        raise ValueError(
            f"{label} must be within the arm's reach, got {where} m: the nearest place found is "
            f"{1e3 * away.max():.1f} mm away"
        )
    return joints


def as_pose(label: str, value: Any) -> Pose:
    """Return a pose from itself or a dictionary, of which an error tells the label."""
    if isinstance(value, Pose):
        return value
    if not isinstance(value, Mapping) or "position" not in value or not set(value) <= set(Pose._fields):
        raise ValueError(f"{label} must have a position, and may have a quaternion, got {value!r:.80}")
    return Pose(**value)


def _solution(label: str, pose: Pose, arm: Arm, obstacles: Obstacles, near: Float) -> Float:
    """Return joint positions with the tool at a pose, the nearest to others that are free, shape (J,)."""
    try:
        found = inverse_kinematics(arm, pose.position, pose.quaternion, seed=near)
    except ValueError as error:
        raise ValueError(f"{label}: {error}") from None
    many = obstacles.take(np.zeros(len(found), np.int64))
    rows, own = row_clearances(arm.chain, arm.spheres, found, many, FAR)
    free = np.minimum(rows.min(axis=-1, initial=1.0), own) > 0.0
    # If none is free, the check of the scene says why.
    return np.asarray(found[int(free.argmax())])


def _jumps(value: Any, sampler: SceneSampler, goal: Float) -> Float:
    """Return given jumps from goals, shape (N, J), in joint positions, the absent ones last."""
    number, joints = goal.shape
    size = 2 if sampler.task.space_name == "hand" else joints
    given = _rows("jumps", value, sampler, (number, MOST_JUMPS, 1 + size))
    present = (given != 0.0).any(axis=-1)
    jumps = np.zeros((number, MOST_JUMPS, 1 + joints))
    targets = given[present][:, 1:]
    if sampler.task.space_name == "hand":
        targets = _planar("target of options['jumps']", sampler.task.arm, targets)
    jumps[present] = np.concatenate((given[present][:, :1], targets), axis=-1)
    order = np.argsort(~present, axis=-1, kind="stable")  # absent rows may be between others
    jumps = np.take_along_axis(jumps, order[..., None], axis=1)
    for row in jumps.transpose(1, 0, 2):
        there = (row != 0.0).any(axis=-1, keepdims=True)
        goal = np.where(there, nearest_goals(sampler.task.arm, row[:, 1:], goal), goal)
        row[:, 1:] = np.where(there, goal, 0.0)
    return jumps


def _rows(name: str, value: Any, sampler: SceneSampler, shape: tuple[int, int, int]) -> Float:
    """Return an option as rows of N scenes; rows of zeros stand behind the given ones."""
    number, most, size = shape
    label, found = f"options[{name!r}]", np.zeros(shape)
    array = as_real_array(value)
    # Scenes with different numbers of rows are no array.
    several = isinstance(value, list | tuple) if array is None else array.ndim == 3
    if several and len(value) != number:
        raise ValueError(f"{label} must be one list of rows of numbers, or {number} lists, got {len(value)}")
    for scene, rows in enumerate(value if several else [value] * number):
        given = finite_array(label, rows)
        if given.size == 0:
            continue
        if given.ndim != 2 or given.shape[1] != size or len(given) > most:
            allowed = f"up to {most} rows of {size} numbers"
            raise ValueError(f"{label} must be {allowed}, got shape {given.shape} in scene {scene}")
        found[scene, : len(given)] = given
    if found.any() and sampler.task.whole_movement:
        raise ValueError(f"{label} need several decisions, such as decide_at=('target',), not 'end'")
    return found


def scene_to_json(
    scenes: Scenes, arm: Arm, space: SpaceName | None = None, *, scene: int = 0, env_id: str = ""
) -> str:
    """Return a scene as JSON, which :func:`scene_from_json` reads as options of `reset`.

    Args:
        scenes: N scenes.
        arm: Arm.
        space: Space of the task; by default, that of the arm.
        scene: Index of the scene.
        env_id: Environment of the scene, for readers of the file.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import Task, scene_from_json, scene_to_json
        >>> task = Task.of()
        >>> text = scene_to_json(task.sampler()([np.random.default_rng(0)]), task.arm)
        >>> sorted(scene_from_json(text))
        ['goal', 'jumps', 'obstacles', 'start']
    """
    return options_to_json(scene_options(scenes, arm, space, scene), env_id)


def scene_options(scenes: Scenes, arm: Arm, space: SpaceName | None = None, scene: int = 0) -> dict[str, Any]:
    """Return a scene as options of `reset`, arrays and a list of shapes, see :func:`scene_to_json`."""
    where = space_of(arm, arm.space if space is None else space)
    options: dict[str, Any] = {name: where.coordinates(getattr(scenes, name)[scene]).copy() for name in ENDS}
    options["obstacles"] = unpack(scenes.obstacles, scene)
    times = scenes.jump_times[scene]
    jumps = scenes.jumps[scene][times < NEVER]
    # Without jumps the list is empty: a task that may have some draws them where none are given.
    jumped = np.column_stack((jumps[:, 0], where.coordinates(jumps[:, 1:])))
    options["jumps"] = jumped if len(jumps) else ()
    present = scenes.obstacles.present[scene]
    turn_time = scenes.turn_time[scene][present]
    if (turn_time < NEVER).any():
        turns = np.column_stack((turn_time, scenes.turn_velocity[scene][present]))
        options["turns"] = np.where(turn_time[:, None] < NEVER, turns, 0.0)
    reaches = scenes.reach[scene][present]
    if reaches.any():
        options["reaches"] = reaches
    return options


def options_to_json(options: Mapping[str, Any], env_id: str = "") -> str:
    """Return options of `reset`, arrays and shapes, as JSON, see :func:`scene_to_json`."""

    def plain(value: Any) -> Any:
        return value.to_dict() if isinstance(value, Shape) else value.tolist()

    env = {"env": env_id} if env_id else {}
    return json.dumps({"format": FORMAT, **env, **options}, indent=1, default=plain) + "\n"


def scene_from_json(text: str | bytes) -> dict[str, Any]:
    """Return the options of `reset` from the JSON of :func:`scene_to_json`; numbers are checked by `reset`.

    Raises:
        ValueError: The text is no scene file, or an obstacle is not allowed.

    Example:
        >>> from viapoint.envs.scenes.options import scene_from_json
        >>> scene_from_json('{"format": "viapoint-scene", "goal": [0.1, 0.4]}')
        {'goal': [0.1, 0.4]}
    """
    try:
        record = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the scene file is not JSON: {error}") from None
    if not isinstance(record, Mapping) or record.get("format") != FORMAT:
        raise ValueError(
            f'a scene file is a JSON object with "format": "{FORMAT}"; obstacles alone are a JSON list of objects'
        )
    options = {name: value for name, value in record.items() if name not in ("format", "env")}
    _refuse_unknown(options)
    if "obstacles" in options:
        options["obstacles"] = as_obstacles(options["obstacles"])
    return options
