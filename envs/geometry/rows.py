"""Obstacles of scenes as rows of numbers.

A scene of spheres and capsules has rows (centre D, half-axis D, radius). Where scenes have other shapes, too, the same
numbers are a capsule around the obstacle, which bounds its distance from below, and the shape stands in between:

    (centre D, half-axis D, kind 1, quaternion 4, half lengths 3, radius 1)

The kind is an index into :data:`~viapoint.envs.geometry.shapes.SHAPES`; pose and half lengths are those of the box of
:meth:`~viapoint.envs.geometry.shape.Shape.box`. Rows of zeros are absent obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from viapoint.envs.common.arrays import frame_axes, in_space, norm
from viapoint.envs.common.types import Float, Int, Numbers, Single
from viapoint.envs.common.validation import as_real_array, whole_number
from viapoint.envs.geometry.convex_mesh import ConvexMesh, NamedMesh
from viapoint.envs.geometry.point_cloud import PointCloud
from viapoint.envs.geometry.round_shapes import Capsule, Sphere
from viapoint.envs.geometry.segments import segment_axis_squared
from viapoint.envs.geometry.shape import Shape
from viapoint.envs.geometry.shapes import LISTS, MESH_HINT, SHAPES, as_obstacles, refuse_single

CAPSULES = ("capsule",)
"""Shapes of scenes whose rows are capsules; spheres are capsules without a length."""
SHAPE_SIZE = 8
"""Numbers of the shape in a row."""
POSE_SIZE = 13
"""Number of values of one obstacle in an observation after those of its kind."""


class ShapeColumns(NamedTuple):
    """Shapes of rows, see the module."""

    kind: Int
    """Indices into SHAPES, shape (...,)."""
    centre: Float
    """Shape (..., 3), [m]."""
    quaternion: Float
    """Shape (..., 4)."""
    half: Float
    """Half lengths, shape (..., 3), [m]."""


def shape_number(kind: str) -> int:
    """Return the index of a shape in SHAPES, which stands for it in rows."""
    return list(SHAPES).index(kind)


def row_size(dimension: int, shapes: Sequence[str] = CAPSULES) -> int:
    """Return the number of values of a row, for scenes of some shapes in D dimensions."""
    return 2 * dimension + 1 + (0 if tuple(shapes) == CAPSULES else SHAPE_SIZE)


def has_shapes(rows: Numbers) -> bool:
    """Return True for rows with other shapes than capsules."""
    return int(rows.shape[-1]) > 2 * 3 + 1


def dimension_of(rows: Numbers) -> int:
    """Return the dimension D of rows."""
    return (int(rows.shape[-1]) - 1 - SHAPE_SIZE * has_shapes(rows)) // 2


def shape_columns(rows: Float) -> ShapeColumns:
    """Return kind, pose and half lengths of rows of either kind, shape (..., .)."""
    d = dimension_of(rows)
    if not has_shapes(rows):
        axis, radius = in_space(rows[..., d : 2 * d]), rows[..., -1]
        length = norm(axis)
        kind = np.full(rows.shape[:-1], shape_number("capsule"))
        half = np.stack((radius, radius, length + radius), axis=-1)
        return ShapeColumns(kind, in_space(rows[..., :d]), turn_up_to(axis, length), half)
    columns = rows[..., 2 * d : -1]
    return ShapeColumns(
        columns[..., 0].astype(np.int64), in_space(rows[..., :d]), columns[..., 1:5], columns[..., 5:]
    )


def shape_rows(kind: str, centre: Float, quaternion: Float, half: Float) -> Float:
    """Return rows of one kind of shape, shape (..., 2 D + 1 + SHAPE_SIZE), [m].

    Args:
        kind: Key of SHAPES.
        centre: Centres of the bounding boxes, shape (..., D), [m].
        quaternion: Orientations, shape (..., 4).
        half: Half lengths of the bounding boxes, shape (..., 3), [m].
    """
    local, radius = SHAPES[kind].bound(half)
    axes = rotation_axes(quaternion)
    half_axis = local[..., :1] * axes[0] + local[..., 1:2] * axes[1] + local[..., 2:] * axes[2]
    number = np.full_like(half[..., :1], shape_number(kind))
    parts = (centre, half_axis[..., : centre.shape[-1]], number, quaternion, half, radius[..., None])
    return np.concatenate(parts, axis=-1)


def widened(rows: Float) -> Float:
    """Return rows of capsules as rows with shapes; rows with shapes stay as they are."""
    if has_shapes(rows):
        return rows
    shape, present = shape_columns(rows), rows[..., -1:] > 0.0
    half = np.where(present, shape.half, 0.0)
    wide = shape_rows("capsule", rows[..., : dimension_of(rows)], shape.quaternion, half)
    return np.where(present, wide, 0.0)


def rotation_axes(quaternion: Float) -> tuple[Float, Float, Float]:
    """Return the axes of frames, shape (..., 3) each, from their quaternions, shape (..., 4)."""
    first, second, third = (np.stack(axis, axis=-1) for axis in frame_axes(quaternion))
    return first, second, third


def turn_up_to(axis: Float, length: Float) -> Float:
    """Return the quaternions that turn the z axis, along which capsules lie, to axes of some lengths."""
    lying = length > 1e-9
    unit = np.where(lying[..., None], axis / np.where(lying, length, 1.0)[..., None], (0.0, 0.0, 1.0))
    unit = np.where(unit[..., 2:] < 0.0, -unit, unit)  # a capsule has no sense of direction
    x, y, z = (unit[..., i] for i in range(3))
    size = np.sqrt(2.0 * (1.0 + z))
    return np.stack(((1.0 + z) / size, -y / size, x / size, np.zeros_like(z)), axis=-1)


def pair_distance(rows: Float, first: Float, second: Float | None = None) -> Float:
    """Return the signed distance of M spheres' centres or segments, each from the shape of one row, shape (M,), [m].

    Args:
        rows: Rows with shapes, shape (M, .).
        first: Points, or one end of segments, shape (M, 3), [m].
        second: Other ends; None for points.
    """
    found, shapes = np.empty(len(rows)), shape_columns(rows)
    for number in np.unique(shapes.kind):
        some = np.flatnonzero(shapes.kind == number)
        ends = [end[some].astype(np.float64, copy=False) for end in (first, second) if end is not None]
        kind = list(SHAPES.values())[number]
        if issubclass(kind, Capsule) and second is not None:
            found[some] = _capsule_distance(rows[some], *ends)
            continue
        shape = kind.from_box(*(part[some] for part in shapes[1:]))
        found[some] = shape.distance(*ends) if second is None else shape.segment_distance(*ends)
    return found


def _capsule_distance(rows: Float, first: Float, second: Float) -> Float:
    """Return the distance of M segments, each from the capsule of one row, shape (M,), [m]."""
    d = dimension_of(rows)
    centre, axis = in_space(rows[:, :d]).T, in_space(rows[:, d : 2 * d]).T
    gap, link = first.T - (centre - axis), (second - first).T
    squared = segment_axis_squared(list(gap), list(link), list(2.0 * axis))
    return np.asarray(np.sqrt(squared) - rows[:, -1])


def obstacle_rows(obstacles: Any, dimension: int, shapes: Sequence[str] = CAPSULES) -> Any:
    """Return obstacles as the rows of scenes, shape (n, row_size), [m].

    Args:
        obstacles: Shapes and dictionaries, or one list of them for each of N scenes; rows of numbers are returned as
            they are.
        dimension: D. In the plane, spheres, capsules and centres lie at the height 0, and boxes and cylinders stand
            upright; their heights do not matter.
        shapes: Names of the shapes that the scenes may have. Spheres count as capsules where they have no name of their
            own.

    Returns:
        Rows of shape (n, 2 D + 1) for capsules alone, else (n, 2 D + 1 + SHAPE_SIZE); for N lists (N, n, .), where rows
        that a scene lacks are zero.

    Raises:
        ValueError: The obstacles are no list of shapes, dictionaries or numbers, or a shape is not allowed in scenes or
            does not lie in the plane.

    Example:
        >>> from viapoint.envs import Capsule, obstacle_rows
        >>> obstacle_rows([Capsule.between((0.0, 0.3), (0.2, 0.3), radius=0.02)], dimension=2).round(3).tolist()
        [[0.1, 0.3, 0.1, 0.0, 0.02]]
    """
    refuse_single(obstacles)
    if is_shape_list(obstacles):
        parts = _parts_of_scenes(obstacles)
        return np.array([_row(i, part, dimension, tuple(shapes)) for i, part in enumerate(parts)])
    if not _has_lists(obstacles):
        return _checked_numbers(obstacles)
    size, each = row_size(dimension, shapes), list[Float]()
    for i, scene in enumerate(obstacles):
        try:
            each.append(_rows_of_scene(scene, dimension, shapes, size))
        except ValueError as error:
            raise ValueError(f"scene {i}: {error}") from None
    rows = np.zeros((len(each), max(map(len, each)), size))
    for row, found in zip(rows, each, strict=True):
        row[: len(found)] = found
    return rows


def _rows_of_scene(scene: Any, dimension: int, shapes: Sequence[str], size: int) -> Float:
    """Return the obstacles of one scene as rows of a size."""
    if not isinstance(scene, list | tuple | np.ndarray):
        raise ValueError(f"obstacles must be {LISTS}, got {scene!r:.60}")
    if not len(scene):
        return np.zeros((0, size))
    rows = np.asarray(obstacle_rows(scene, dimension, shapes), dtype=np.float64)
    if rows.shape[1:] == (row_size(dimension),) and size > row_size(dimension):
        rows = widened(rows)
    if rows.shape[1:] != (size,):
        raise ValueError(f"rows of obstacles must have {size} numbers, got shape {rows.shape}")
    return rows


def obstacle_names(obstacles: Any) -> list[list[str]]:
    """Return the names of the obstacles that :func:`obstacle_rows` takes, empty where there is none.

    Returns:
        One list for all scenes, or one for each of N scenes; rows of numbers have no names.
    """
    if is_shape_list(obstacles):
        return [[each.name for each in _parts_of_scenes(obstacles)]]
    return [obstacle_names(scene)[0] for scene in obstacles] if _has_lists(obstacles) else [[]]


def is_shape_list(obstacles: Any) -> bool:
    """Return True for a list of shapes and dictionaries."""
    return isinstance(obstacles, list | tuple) and any(
        isinstance(each, Shape | Mapping) for each in obstacles
    )


def _has_lists(obstacles: Any) -> bool:
    """Return True for lists of shapes and dictionaries, one for each scene."""
    return isinstance(obstacles, list | tuple) and any(map(is_shape_list, obstacles))


def _checked_numbers(obstacles: Any) -> Any:
    """Return obstacles that are real numbers as they are.

    Raises:
        ValueError: The obstacles are something else, or a row that is not zero has no positive radius.
    """
    array = as_real_array(obstacles)
    if array is None:
        raise ValueError(f"obstacles must be {LISTS}, got {obstacles!r:.80}")
    if array.ndim > 1 and array.size:
        wrong = ~np.isfinite(array).all(axis=-1) | ((array != 0.0).any(axis=-1) & ~(array[..., -1] > 0.0))
        if wrong.any():
            *scene, row = np.argwhere(wrong)[0]
            place = f"scene {scene[0]}: " if scene else ""
            raise ValueError(
                f"{place}obstacle {row} must have finite numbers, the last of which is a positive radius, got "
                f"{array[wrong][0].tolist()}"
            )
    return obstacles


def obstacles_from_rows(rows: Float) -> list[Shape]:
    """Return the obstacles of one scene; rows without a radius are none.

    Args:
        rows: Rows of either kind, shape (n, .), [m].

    Raises:
        ValueError: Rows have another number of values, or the kind of a row is no shape.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs import obstacles_from_rows
        >>> obstacles_from_rows(np.array([(0.1, 0.3, 0.1, 0.0, 0.02), (0.0, 0.0, 0.0, 0.0, 0.0)]))[0].half_length
        array(0.1)
    """
    found = list[Shape]()
    sizes = [row_size(d, shapes) for shapes in (CAPSULES, ()) for d in (2, 3)]
    if np.ndim(rows) != 2 or np.shape(rows)[1] not in sizes:
        raise ValueError(f"rows must have shape (n, .) with {sizes} numbers each, got shape {np.shape(rows)}")
    rows = np.asarray(rows, dtype=np.float64)
    d = dimension_of(rows)
    for i in np.flatnonzero(rows[:, -1] > 0.0):
        row = rows[i]
        centre, axis, radius = in_space(row[:d]), in_space(row[d : 2 * d]), row[-1]
        kind, _, quaternion, half = shape_columns(row)
        if has_shapes(row) and row[2 * d] not in range(len(SHAPES)):
            kinds = ", ".join(f"{number} {name}" for number, name in enumerate(SHAPES))
            raise ValueError(f"obstacle {i} has the kind {row[2 * d]:g}; kinds are {kinds}")
        shape = list(SHAPES.values())[int(kind)]
        if shape is not Capsule or (has_shapes(row) and axis.any()):
            exact = shape.from_box(centre, quaternion, half)
            values = {name: getattr(exact, name) for name in (*shape.sizes, "position")}
            found.append(shape(**values, quaternion=quaternion))
        elif axis.any():
            found.append(Capsule.between(centre - axis, centre + axis, radius))
        else:
            found.append(Sphere(radius, position=centre))
    return found


def observation_rows(
    obstacles: Sequence[Shape | Mapping[str, Any]], n_rows: int, shapes: Sequence[str] | None = None
) -> Single:
    """Return obstacles as rows of numbers for networks, one for each; absent rows are zero.

    A row is (shape one-hot, centre 3, rotation 6, half lengths 3, present): the centre and half lengths are those of
    the bounding box along the axes of the shape's frame, [m], and the rotation is the first two axes of the frame (Zhou
    et al., On the continuity of rotation representations in neural networks, 2019).

    Args:
        obstacles: Shapes and dictionaries.
        n_rows: Number of rows.
        shapes: Names of the shapes of the one-hot part; by default all of SHAPES.

    Raises:
        ValueError: There are too many obstacles, or one is not allowed or has none of the shapes.

    Example:
        >>> from viapoint.envs import Box, observation_rows
        >>> rows = observation_rows([Box((0.1, 0.2, 0.25), position=(0.5, 0.0, 0.25))], n_rows=2)
        >>> rows[0, 7:].astype(float).round(3).tolist()  # behind the one-hot
        [0.5, 0.0, 0.25, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.1, 0.2, 0.25, 1.0]
    """
    given = as_obstacles(obstacles)
    if len(given) > whole_number("n_rows", n_rows, 0):
        raise ValueError(f"there may be at most {n_rows} obstacles, got {len(given)}")
    kinds = list(SHAPES if shapes is None else shapes)
    rows = np.zeros((n_rows, len(kinds) + POSE_SIZE), np.float32)
    for i, (row, each) in enumerate(zip(rows, given, strict=False)):
        kind = _kind_among(each, kinds)
        if kind not in kinds:
            raise ValueError(f"{_numbered(i, each)}: the shapes are {', '.join(kinds)}, not {kind}")
        row[kinds.index(kind)] = 1.0
        centre, half = each.box()
        row[len(kinds) :] = (*centre, *each.rotation[:, :2].T.ravel(), *half, 1.0)
    return rows


def observed_rows(rows: Float, shapes: Sequence[str]) -> Float:
    """Return rows with shapes, shape (..., n, .), as those of :func:`observation_rows`."""
    kind, centre, quaternion, half = shape_columns(rows)
    present = rows[..., -1:] > 0.0
    one_hot = kind[..., None] == np.array([shape_number(name) for name in shapes])
    first, second, _ = rotation_axes(quaternion)
    found = np.concatenate((one_hot, centre, first, second, half, present), axis=-1)
    return np.where(present, found, 0.0)


def rows_of_observed(seen: Numbers, shapes: Sequence[str], dimension: int) -> Float:
    """Return the rows of scenes from those of :func:`observed_rows`, shape (..., n, .)."""
    kind, place = seen[..., : len(shapes)].argmax(axis=-1), len(shapes)
    values: Float = seen[..., place:].astype(np.float64)
    centre, rotation, half = values[..., :3], values[..., 3:9], values[..., 9:12]
    quaternion, present = quaternion_of_axes(rotation[..., :3], rotation[..., 3:]), seen[..., -1] > 0.5
    found = np.zeros((*seen.shape[:-1], row_size(dimension, shapes)))
    for number, name in enumerate(shapes):
        some = present & (kind == number)
        found[some] = shape_rows(name, centre[some][:, :dimension], quaternion[some], half[some])
    return found


def quaternion_of_axes(first: Float, second: Float) -> Float:
    """Return the quaternions, shape (..., 4), of frames by their first two axes, shape (..., 3).

    Of the products of w, x, y and z with one of them, those with the greatest are taken (S. W. Shepperd, Quaternion
    from rotation matrix, 1978).
    """
    third = np.cross(first, second)
    (a, b, c), (d, e, f), (g, h, i) = (np.moveaxis(axis, -1, 0) for axis in (first, second, third))
    products = np.stack(
        [
            np.stack((1.0 + a + e + i, f - h, g - c, b - d), axis=-1),
            np.stack((f - h, 1.0 + a - e - i, d + b, g + c), axis=-1),
            np.stack((g - c, d + b, 1.0 - a + e - i, h + f), axis=-1),
            np.stack((b - d, g + c, h + f, 1.0 - a - e + i), axis=-1),
        ],
        axis=-2,
    )
    greatest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    chosen = np.take_along_axis(products, greatest[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(chosen / norm(chosen)[..., None])


def check_shapes(shapes: Any, dimension: int = 3) -> tuple[str, ...]:
    """Return the names of the shapes that scenes may have.

    Raises:
        ValueError: A name is unknown or repeated, a mesh is in the plane, or no named shape is one of random scenes.
    """
    names = (shapes,) if isinstance(shapes, str) else tuple(shapes) if isinstance(shapes, Sequence) else ()
    allowed = []
    for name, shape in SHAPES.items():
        if shape.in_scenes and (dimension == 3 or not issubclass(shape, ConvexMesh)):
            allowed.append(name)
    drawn = [name for name in allowed if SHAPES[name].only_half is None]
    known = all(isinstance(name, str) and name in allowed for name in names)
    if not known or len(set(names)) < len(names) or not set(names) & set(drawn):
        raise ValueError(
            f"shapes must be some of {', '.join(allowed)}, without repetition, and at least one of {', '.join(drawn)}, "
            f"got {shapes!r}; {MESH_HINT}"
        )
    return names


def _parts_of_scenes(obstacles: Any) -> list[Shape]:
    """Return a list of shapes and dictionaries as single shapes that scenes hold; a point cloud becomes its spheres."""
    found = list[Shape]()
    for each in as_obstacles(obstacles, single=True):
        if isinstance(each, PointCloud):
            name = each.name or each.kind
            found += [
                Sphere(geom.size[0], position=geom.position, name=f"{name} point {j}")
                for j, geom in enumerate(each.geoms())
            ]
        else:
            found.append(each)
    return found


def _with_name(mesh: ConvexMesh, shapes: tuple[str, ...]) -> ConvexMesh:
    """Return a mesh as the registered one with the same vertices, if it is among the shapes."""
    for shape in (SHAPES[name] for name in shapes):
        if issubclass(shape, NamedMesh) and np.array_equal(shape.mesh.vertices, mesh.vertices):
            return shape(position=mesh.position, quaternion=mesh.quaternion, name=mesh.name)
    return mesh


def _kind_among(obstacle: Shape, shapes: Sequence[str]) -> str:
    """Return the kind of an obstacle; a sphere is a capsule where spheres have no name of their own."""
    as_capsule = obstacle.kind == "sphere" and "sphere" not in shapes and "capsule" in shapes
    return "capsule" if as_capsule else obstacle.kind


def _numbered(index: int, obstacle: Shape) -> str:
    """Return number and name of an obstacle, for error messages."""
    return f"obstacle {index}{f' {obstacle.name!r}' if obstacle.name else ''}"


def _row(index: int, obstacle: Shape, dimension: int, shapes: tuple[str, ...]) -> Float:
    """Return an obstacle as a row of a scene."""
    if isinstance(obstacle, ConvexMesh):
        obstacle = _with_name(obstacle, shapes)
    kind = _kind_among(obstacle, shapes)
    if kind not in shapes and not (dimension == 2 and isinstance(obstacle, ConvexMesh)):
        raise ValueError(
            f"{_numbered(index, obstacle)}: the scenes of this environment have the shapes {', '.join(shapes)}, not "
            f"{kind}; make it with other shapes, with which an agent must be trained; {MESH_HINT}"
        )
    try:
        centre, half = obstacle.box() if dimension == 3 else obstacle.in_plane()
    except ValueError as error:
        raise ValueError(f"{_numbered(index, obstacle)}: {error}") from None
    if shapes == CAPSULES:
        axis = obstacle.half_axis if isinstance(obstacle, Capsule) else np.zeros(3)
        return np.concatenate((centre[:dimension], axis[:dimension], half[:1]))
    return shape_rows(kind, centre[:dimension], obstacle.quaternion, half)
