"""Table of all obstacle shapes, lists of obstacles as dictionaries and JSON, and distances from lists of obstacles."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.common.types import Float
from viapoint.envs.common.validation import finite_array, is_number
from viapoint.envs.geometry.box import Box
from viapoint.envs.geometry.convex_mesh import ConvexMesh, NamedMesh
from viapoint.envs.geometry.cylinder import Cylinder
from viapoint.envs.geometry.half_space import HalfSpace
from viapoint.envs.geometry.point_cloud import PointCloud
from viapoint.envs.geometry.round_shapes import Capsule, Sphere
from viapoint.envs.geometry.shape import Shape, checked_radius
from viapoint.primitives.array_api import broadcast_batch

SHAPES: dict[str, type[Shape]] = {
    shape.kind: shape for shape in (Sphere, Capsule, Cylinder, Box, HalfSpace, ConvexMesh, PointCloud)
}
"""Shapes by their names in dictionaries."""


MESH_HINT = "register_mesh names a convex mesh of your own"
"""Hint of error messages about unknown shapes."""
LISTS = "a list of shapes, dictionaries or rows of numbers"
"""Allowed obstacles, for error messages."""


def register_mesh(name: str, mesh: ConvexMesh) -> None:
    """Register a convex mesh under a name, so that scenes of arms in space may contain it.

    The name is then a shape: environments take it in `shapes`, dictionaries as `shape`, and `reset` also takes a
    `ConvexMesh` with the same vertices. Random scenes do not contain it. Files and specs store the name only: register
    the mesh before you load one of them. Registering the same mesh again changes nothing.

    Raises:
        TypeError: The mesh is no `ConvexMesh`.
        ValueError: The name is taken by another shape, or is no identifier, or the mesh has a pose.

    Example:
        >>> import gymnasium as gym
        >>> import numpy as np
        >>> from viapoint.envs import ConvexMesh, register_mesh
        >>> wedge = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 0, 1), (0, 1, 1)]) / 10
        >>> register_mesh("wedge", ConvexMesh(wedge))
        >>> env = gym.make("viapoint/PandaObstacles-v0", shapes=("capsule", "wedge"))
        >>> _ = env.reset(options={"obstacles": [{"shape": "wedge", "position": (0.4, 0.0, 0.2)}]})
    """
    if not isinstance(mesh, ConvexMesh):
        raise TypeError(
            f"mesh must be a ConvexMesh, such as ConvexMesh.hull(points), got {type(mesh).__name__}"
        )
    if mesh != ConvexMesh(mesh.vertices, name=mesh.name):
        raise ValueError(
            f"mesh {name!r} must have no position and no quaternion of its own; obstacles have them"
        )
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"the name of a mesh must be an identifier such as 'rock', got {name!r}")
    found = SHAPES.setdefault(name, NamedMesh.named(name, mesh))
    if not (issubclass(found, NamedMesh) and np.array_equal(found.mesh.vertices, mesh.vertices)):
        raise ValueError(f"another shape is registered as {name!r}; give this mesh another name")


def as_obstacle(value: Shape | Mapping[str, Any]) -> Shape:
    """Return a shape from its dictionary; a shape is returned as it is.

    Args:
        value: Shape, or a mapping with its kind as `shape`, its parameters, and optionally `position`, `quaternion` and
            `name`.

    Raises:
        ValueError: The shape or a parameter is unknown or missing, or a value is not allowed.

    Example:
        >>> from viapoint.envs import as_obstacle
        >>> box = as_obstacle({"shape": "box", "size": (0.1, 0.2, 0.02), "position": (0.5, 0.0, 0.3)})
        >>> box.distance([0.5, 0.0, 0.5]).round(3).item()
        0.18
        >>> as_obstacle({"shape": "box", "sizes": (0.1, 0.2, 0.02)})
        Traceback (most recent call last):
        ValueError: box: parameters are size, position, quaternion, name; unknown are ['sizes'], missing are ['size']
    """
    if isinstance(value, Shape):
        return value
    if not isinstance(value, Mapping):
        raise ValueError(f"an obstacle must be a shape of viapoint.envs or a dictionary, got {value!r:.80}")
    values = dict(value)
    kind = values.pop("shape", None)
    shape = SHAPES.get(kind) if isinstance(kind, str) else None
    if shape is None:
        raise ValueError(f"shape must be one of {', '.join(SHAPES)}, got {kind!r}; {MESH_HINT}")
    allowed = shape.parameters()
    unknown = [name for name in values if name not in allowed]
    needed = [each.name for each in fields(shape) if each.init and each.default is MISSING]
    missing = [name for name in needed if name not in values]
    if unknown or missing:
        raise ValueError(
            f"{kind}: parameters are {', '.join(allowed)}; unknown are {unknown}, missing are {missing}"
        )
    return shape(**values)


def as_obstacles(values: Iterable[Shape | Mapping[str, Any]], *, single: bool = False) -> list[Shape]:
    """Return shapes from a list of shapes and dictionaries; an error names the index of the obstacle.

    Batches of shapes are refused if each must be a `single` one.

    Example:
        >>> from viapoint.envs import as_obstacles
        >>> as_obstacles([{"shape": "sphere", "radius": 0.1}, {"shape": "sphere", "radius": -1.0}])
        Traceback (most recent call last):
        ValueError: obstacle 1: sphere: radius must be greater than 0, got -1.0
    """
    refuse_single(values)
    if not isinstance(values, Iterable):
        raise ValueError(f"obstacles must be {LISTS}, got {values!r:.80}")
    found = []
    for i, value in enumerate(values):
        try:
            found.append(as_obstacle(value))
            if single:
                found[-1].require_single()
        except ValueError as error:
            raise ValueError(f"obstacle {i}: {error}") from None
    return found


def obstacles_to_json(obstacles: Iterable[Shape | Mapping[str, Any]]) -> str:
    """Return obstacles as JSON.

    Example:
        >>> from viapoint.envs import Sphere, obstacles_from_json, obstacles_to_json
        >>> text = obstacles_to_json([Sphere(0.1, position=(0.5, 0.0, 0.3))])
        >>> text
        '[{"shape": "sphere", "radius": 0.1, "position": [0.5, 0.0, 0.3], "quaternion": [1.0, 0.0, 0.0, 0.0]}]'
        >>> obstacles_from_json(text) == [Sphere(0.1, position=(0.5, 0.0, 0.3))]
        True
    """
    return json.dumps([each.to_dict() for each in as_obstacles(obstacles)])


def obstacles_from_json(text: str) -> list[Shape]:
    """Return the obstacles of :func:`obstacles_to_json`.

    Raises:
        ValueError: The text is not JSON, not a list, or an obstacle is not allowed.

    Example:
        >>> from viapoint.envs import obstacles_from_json
        >>> [table] = obstacles_from_json('[{"shape": "box", "size": [0.4, 0.6, 0.02], "name": "table"}]')
        >>> table.name, table.size.tolist()
        ('table', [0.4, 0.6, 0.02])
    """
    try:
        values = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"obstacles must be JSON ({error})") from None
    if not isinstance(values, list):
        raise ValueError(f"obstacles must be a JSON list of dictionaries, got {type(values).__name__}")
    return as_obstacles(values)


def refuse_single(obstacles: Any) -> None:
    """Raise ValueError for one shape or dictionary that is in no list."""
    if isinstance(obstacles, Shape | Mapping):
        raise ValueError(f"obstacles must be {LISTS}; put a single obstacle in a list, got {obstacles!r:.80}")


def signed_distances(
    obstacles: Sequence[Shape | Mapping[str, Any]], first: Any, second: Any = None, radius: Any = 0.0
) -> Float:
    """Return the signed distance of spheres or capsules from each of n obstacles, shape (..., n), [m].

    Args:
        obstacles: n shapes or dictionaries.
        first: Centres of spheres, or one end of capsules' axes, shape (..., 3), [m].
        second: The other end; None for spheres.
        radius: Radius, [m].

    Example:
        >>> from viapoint.envs import Box, Sphere, signed_distances
        >>> scene = [Box((0.4, 0.6, 0.02), position=(0.5, 0.0, 0.2)), Sphere(0.05, position=(0.5, 0.2, 0.27))]
        >>> signed_distances(scene, [0.5, 0.0, 0.27], radius=0.03).round(3).tolist()
        [0.02, 0.12]
    """
    obstacles = as_obstacles(obstacles)
    ends = _checked_ends(first, second)
    if not obstacles:
        return np.zeros((*ends[0].shape[:-1], 0))
    each = [_distance(obstacle, ends, radius) for obstacle in obstacles]
    return np.stack(np.broadcast_arrays(*each), axis=-1)


def _checked_ends(first: Any, second: Any) -> list[Float]:
    """Return the ends of segments, or points alone where there is no second end."""
    ends = [finite_array("first", first, (..., 3))]
    if second is not None:
        ends.append(finite_array("second", second, (..., 3)))
    return ends


def _distance(obstacle: Shape, ends: Sequence[Float], radius: Any) -> Any:
    """Return the distance of spheres or capsules from one obstacle."""
    if len(ends) == 1:
        return obstacle.distance(ends[0], radius)
    return obstacle.segment_distance(ends[0], ends[1], radius)


def nearest_distance(
    obstacles: Sequence[Shape | Mapping[str, Any]],
    first: Any,
    second: Any = None,
    radius: Any = 0.0,
    most: float = np.inf,
) -> Any:
    """Return the least signed distance of spheres or capsules from all obstacles, shape (...,), at most `most`, [m].

    Broad phase: bounding spheres bound every distance from below. Narrow phase: obstacles in the order of their bounds;
    distances are only computed where the bound is below the least distance so far.

    Args:
        obstacles: Shapes or dictionaries.
        first: Centres of spheres, or one end of capsules' axes, shape (..., 3), [m].
        second: The other end; None for spheres.
        radius: Radius, which broadcasts with the leading axes, [m].
        most: Greatest distance of interest, [m].

    Example:
        >>> from viapoint.envs import HalfSpace, Sphere, nearest_distance
        >>> nearest_distance([HalfSpace(), Sphere(0.1, position=(0.5, 0.0, 0.3))], [0.5, 0.0, 0.6], most=1.0).round(3)
        np.float64(0.2)
    """
    obstacles = as_obstacles(obstacles, single=True)
    if not is_number(most) or np.isnan(most):
        raise ValueError(f"most must be a number, got {most!r:.60}")
    ends, radius = _checked_ends(first, second), checked_radius(radius)
    leading = {f"end {i}": end.shape[:-1] for i, end in enumerate(ends)}
    shape = broadcast_batch(**leading, radius=np.shape(radius))
    flat = [np.broadcast_to(end, (*shape, 3)).reshape(-1, 3) for end in ends]
    size = np.broadcast_to(radius, shape).reshape(-1)
    middle = 0.5 * (flat[0] + flat[-1])
    reach = size + _length(flat[-1] - middle)
    least = np.full(len(middle), float(most))
    if not obstacles or not len(middle):
        return least.reshape(shape)
    spheres = [each.bounding_sphere for each in obstacles]
    bounds = np.stack([_length(middle - centre) - wide - reach for centre, wide in spheres])
    for which in np.argsort(bounds.min(axis=1), kind="stable"):
        some = np.flatnonzero(bounds[which] < least)
        if some.size:
            found = _distance(obstacles[which], [end[some] for end in flat], size[some])
            least[some] = np.minimum(least[some], found)
    return least.reshape(shape)


def add_to_model(
    spec: mujoco.MjSpec, obstacles: Sequence[Shape | Mapping[str, Any]], body: Any = None, **attributes: Any
) -> list[list[str]]:
    """Add the geoms of obstacles to a MuJoCo model, and return their names, one list for each obstacle.

    Args:
        spec: Model.
        obstacles: Shapes or dictionaries, with different names.
        body: Body of the geoms; the world by default.
        **attributes: Attributes of all geoms, such as `contype` or `rgba`.

    Example:
        >>> import mujoco
        >>> from viapoint.envs import Box, Capsule, add_to_model
        >>> spec = mujoco.MjSpec()
        >>> add_to_model(spec, [Box((0.1, 0.1, 0.1)), Capsule(0.02, 0.1, position=(0.0, 0.0, 0.2), name="post")])
        [['obstacle_0_0'], ['post_0']]
        >>> spec.compile().ngeom
        2
    """
    body = spec.worldbody if body is None else body
    obstacles = as_obstacles(obstacles)
    named = [each.name or f"obstacle_{i}" for i, each in enumerate(obstacles)]
    for i, name in enumerate(named):
        if named.index(name) < i:
            raise ValueError(f"obstacle {i}: obstacle {named.index(name)} has the name {name!r}, too")
    names: list[list[str]] = []
    for i, each in enumerate(obstacles):
        names.append([])
        for j, geom in enumerate(each.geoms()):
            name = f"{named[i]}_{j}"
            mesh = {}
            if geom.vertices is not None:
                mesh = {"meshname": name}
                spec.add_mesh(
                    name=name, uservert=geom.vertices.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
                )  # fmt: skip
            body.add_geom(
                name=name, type=geom.type, size=geom.size, pos=geom.position, quat=geom.quaternion,
                **mesh, **attributes,
            )  # fmt: skip
            names[-1].append(name)
    return names


def _length(vectors: Float) -> Any:
    return np.sqrt((vectors * vectors) @ np.ones(3))
