"""Capsules and spheres that contain the collision geoms of a file.

A capsule contains the convex hull of points if it contains the points. The point of a capsule that is farthest from a
convex body K is on one of the balls at its ends; the signed distance d of K tells how far. So for ends a, b, radius R

    excess = R + max(d(a), d(b)),   R = max over the points p of K of |p - segment(a, b)|.                        (1)

The ends minimise the excess. Where it is over the tolerance, a plane cuts K into two convex pieces, and a capsule for
each contains the piece; (1) still takes d from the whole of K.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.common.arrays import Float
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.meshes import convex_hull
from viapoint.envs.geometry.shapes import ConvexMesh

Geom = mujoco.mjtGeom

ROUNDING = 1e-6  # Added to the radius, so that rounding leaves nothing outside, [m]
SHORTEST = 1e-3  # Length of the axis below which a capsule becomes a sphere, [m]
# Corners of each ring of the polytope around an ellipsoid, and half of those of the prism around a cylinder
RIM_POINTS = 24
CUTS = (0.35, 0.5, 0.65)  # Planes that cut a body, as shares of its length along a principal axis
LEAST_SHARE = 0.3  # Least length along an axis across which a body is cut, as a share of the greatest
# Corners of a hull above which it is simplified, planes to begin with, and how far it may reach beyond, [m]
MANY_CORNERS, BEGIN, DETAIL = 500, 50, 1e-3
# First and last step of the search for the ends, and last one where cuts are compared, as shares of the size
FIRST_STEP, LAST_STEP, COARSE_STEP = 0.25, 5e-4, 0.05
# Greatest number of capsules for one geom, and where their excess is at most SMALL, [m]
MOST_CAPSULES, MOST_SMALL, SMALL = 256, 48, 0.02
_ONE_WAY = np.concatenate((np.eye(6), np.kron([[1.0, 1.0], [1.0, -1.0]], np.eye(3))))
# Directions in which the search moves one end of a capsule, or both, shape (24, 2, 3)
MOVES = np.concatenate((_ONE_WAY, -_ONE_WAY)).reshape(-1, 2, 3)


class FittedCapsule(NamedTuple):
    """Capsule, or sphere, that contains a geom or a piece of it."""

    ends: Float  # Ends of the axis, shape (2, 3), equal for a sphere, [m]
    radius: float  # Radius, [m]
    excess: float  # Greatest distance of a point of the capsule from the geom, [m]
    # Corners of the piece of the geom that the capsule was fitted to, shape (n, 3), [m]; none if it is exact
    corners: Float
    geom: int = -1  # Number of the geom


def cover_geom(model: mujoco.MjModel, geom: int, tolerance: float) -> list[FittedCapsule]:
    """Return capsules and spheres that together contain a geom, in the geom's frame.

    Spheres and capsules are returned as they are. Boxes, cylinders, ellipsoids and the convex hulls of meshes are
    covered so that no capsule reaches farther than `tolerance`, [m], from the geom, if MOST_CAPSULES suffice for that.

    Raises:
        ValueError: The geom is of another type, or is flat.
    """
    try:
        corners, radius, larger = _simple_hull(model, geom)
        if radius > 0.0:
            return [FittedCapsule(corners, radius, 0.0, np.empty((0, 3)), geom)]
        body = ConvexMesh.hull(corners)
        found = [_fit_capsule(np.asarray(body.vertices), body)]
        while True:
            worst = max(range(len(found)), key=lambda index: found[index].excess)
            excess = found[worst].excess
            most = MOST_SMALL if excess <= SMALL - larger else MOST_CAPSULES
            if excess <= tolerance - larger or len(found) >= most:
                return [each._replace(excess=each.excess + larger, geom=geom) for each in found]
            found += _best_halves(found.pop(worst).corners, body, tolerance - larger)
    except ValueError as error:
        raise ValueError(f"geom {model.geom(geom).name or geom}: {error}") from None


def split(model: mujoco.MjModel, capsule: FittedCapsule) -> list[FittedCapsule]:
    """Return two capsules with less excess that together contain what a capsule of :func:`cover_geom` contains."""
    corners, _, larger = _simple_hull(model, capsule.geom)
    halves = _best_halves(capsule.corners, ConvexMesh.hull(corners), 0.5 * (capsule.excess - larger))
    return [each._replace(excess=each.excess + larger, geom=capsule.geom) for each in halves]


def hull_of(model: mujoco.MjModel, geom: int) -> tuple[Float, float, float]:
    """Return corners, shape (n, 3), and a radius, [m]: the convex hull of balls around them contains the geom.

    The last number bounds how far the hull reaches beyond the geom, [m]. It is 0 for spheres, capsules, boxes and the
    convex hulls of meshes. The frame is that of the geom.

    Raises:
        ValueError: The geom is neither of these, nor a cylinder or an ellipsoid.
    """
    size = model.geom_size[geom]
    kind = Geom(int(model.geom_type[geom]))
    if kind in (Geom.mjGEOM_SPHERE, Geom.mjGEOM_CAPSULE):
        half = size[1] if kind == Geom.mjGEOM_CAPSULE else 0.0
        return np.array([(0.0, 0.0, -half), (0.0, 0.0, half)]), float(size[0]), 0.0
    if kind == Geom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        return np.asarray(vertices, np.float64), 0.0, 0.0
    if kind == Geom.mjGEOM_BOX:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        return np.asarray(size * signs), 0.0, 0.0
    if kind == Geom.mjGEOM_CYLINDER:
        rim = _rim(2 * RIM_POINTS)
        rings = [size[0] * rim + (0.0, 0.0, side * size[1]) for side in (-1.0, 1.0)]
        return np.concatenate(rings), 0.0, float(size[0] * (rim[0, 0] - 1.0))
    if kind == Geom.mjGEOM_ELLIPSOID:
        rim = _rim(RIM_POINTS)
        heights = np.sin(np.pi * (np.arange(1, RIM_POINTS // 2) / (RIM_POINTS // 2) - 0.5))
        rings = [np.sqrt(1.0 - z * z) * rim + (0.0, 0.0, z) for z in heights]
        poles = np.array([(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
        wide = rim[0, 0]
        larger = float(size.max() * (wide**2 - 1.0))
        return np.asarray(size * wide * np.concatenate((*rings, poles))), 0.0, larger
    raise ValueError(
        "a link may have geoms of the types sphere, capsule, cylinder, ellipsoid, box and mesh, not "
        f"{kind.name.removeprefix('mjGEOM_').lower()}"
    )


def _simple_hull(model: mujoco.MjModel, geom: int) -> tuple[Float, float, float]:
    """Return what :func:`hull_of` returns, or the corners of a simpler polytope around the hull if it has many corners.

    Planes of faces are added where the polytope reaches farthest beyond the hull, until that is nowhere over DETAIL.
    """
    corners, radius, larger = hull_of(model, geom)
    if len(corners) <= MANY_CORNERS:
        return corners, radius, larger
    hull = convex_hull(corners)
    corners = corners[hull.vertices]
    if len(corners) <= MANY_CORNERS:
        return corners, radius, larger
    from scipy.spatial import HalfspaceIntersection  # here, because it takes as long as all of the package

    # Normals and negative offsets of planes: those of the box around the hull, which bound the polytope, and of faces
    box = np.block([[np.eye(3), -corners.max(axis=0)[:, None]], [-np.eye(3), corners.min(axis=0)[:, None]]])
    planes = np.concatenate((box, hull.equations))
    chosen = np.concatenate((np.arange(6), np.arange(6, len(planes), len(planes) // BEGIN)))
    body = ConvexMesh.hull(corners)
    while True:
        around = HalfspaceIntersection(planes[chosen], corners.mean(axis=0)).intersections
        # A sharp corner may be far from the hull, though no plane of the hull is far below it.
        beyond = body.distance(around)
        highest = np.array([(planes[:, :3] @ point + planes[:, 3]).argmax() for point in around])
        added = np.setdiff1d(highest[beyond > DETAIL], chosen)
        if not added.size:
            return around, radius, larger + max(float(beyond.max()), 0.0)
        chosen = np.concatenate((chosen, added))


def _rim(number: int) -> Float:
    """Return the corners of a regular polygon around the unit circle, shape (number, 3)."""
    angle = 2.0 * np.pi * np.arange(number) / number
    wide = 1.0 / np.cos(np.pi / number)
    return np.stack((wide * np.cos(angle), wide * np.sin(angle), 0.0 * angle), axis=-1)


def _fit_capsule(corners: Float, body: ConvexMesh, last_step: float = LAST_STEP) -> FittedCapsule:
    """Return a capsule that contains points, shape (n, 3), [m], with little excess over a convex body around them."""
    faces: Any = body.mesh
    planes = faces.normals, (faces.normals * faces.corners[:, 0]).sum(axis=1)
    centre, axes, low, high = _principal_frame(corners)
    size = high - low
    away = ((corners - 0.5 * (corners.max(axis=0) + corners.min(axis=0))) ** 2).sum(axis=1)
    sorted_corners = np.ascontiguousarray(corners[np.argsort(-away)])
    best, least = np.empty((2, 3)), np.inf
    for i in range(3):
        # Along each principal axis, begin with ends that are half a width inside.
        inset = 0.5 * min(float(np.delete(size, i).max()), float(size[i]))
        ends = np.tile(0.5 * (low + high), (2, 1))
        ends[:, i] = low[i] + inset, high[i] - inset
        ends = centre + ends @ axes.T
        excess = _refine(ends, sorted_corners, planes, float(size.max()), last_step)
        if excess < least:
            best, least = ends, excess
    if np.linalg.norm(best[1] - best[0]) < SHORTEST:
        best = np.tile(best.mean(axis=0), (2, 1))
    radius = _radius(best, sorted_corners, np.inf) + ROUNDING
    return FittedCapsule(best, radius, radius + float(body.distance(best).max()), corners)


@compiled
def _refine(ends: Float, corners: Float, body: tuple[Float, Float], size: float, last_step: float) -> float:
    """Move ends, shape (2, 3), to the least excess (1) near them, and return it without rounding.

    It is a compass search for the corners of a capsule, those far from the middle first, in a body of normals and
    offsets of its faces. The last step is a share of the size, [m].
    """
    probe, best = np.empty((2, 3)), np.empty((2, 3))
    step = FIRST_STEP * size
    least = _excess(ends, corners, body, np.inf)
    while step > last_step * size:
        lowest = least - 1e-9  # less of an improvement is rounding
        for move in range(len(MOVES)):
            probe[:] = ends + step * MOVES[move]
            value = _excess(probe, corners, body, lowest)
            if value < lowest:
                lowest = value
                best[:] = probe
        if lowest < least - 1e-9:
            ends[:] = best
            least = lowest
        else:
            step *= 0.5  # no direction is better
    return least


@compiled
def _excess(ends: Float, corners: Float, body: tuple[Float, Float], bound: float) -> float:
    """Return the excess (1) of a capsule with some ends around points, shape (n, 3), or a number above a bound, [m].

    The height above the highest face is d for ends inside the body, and less than d outside.
    """
    normals, offsets = body
    highest = -1e9
    for end in range(2):
        for face in range(len(offsets)):
            height = -offsets[face]
            for a in range(3):
                height += normals[face, a] * ends[end, a]
            highest = max(highest, height)
    return highest + _radius(ends, corners, bound - highest)


@compiled
def _radius(ends: Float, corners: Float, bound: float) -> float:
    """Return the greatest distance of points, shape (n, 3), from a segment with the ends (2, 3), [m].

    Once it is above a bound, it need not be the greatest.
    """
    most = max(bound, 0.0) ** 2
    length = 1e-18  # a sphere has no axis to divide by
    for a in range(3):
        length += (ends[1, a] - ends[0, a]) ** 2
    greatest = 0.0
    for corner in range(len(corners)):
        along = 0.0
        for a in range(3):
            along += (corners[corner, a] - ends[0, a]) * (ends[1, a] - ends[0, a])
        share = min(max(along / length, 0.0), 1.0)
        square = 0.0
        for a in range(3):
            square += (corners[corner, a] - ends[0, a] - share * (ends[1, a] - ends[0, a])) ** 2
        greatest = max(greatest, square)
        if greatest > most:  # worse than the best so far
            break
    return float(np.sqrt(greatest))


def _best_halves(corners: Float, body: ConvexMesh, tolerance: float) -> list[FittedCapsule]:
    """Return the capsules of two pieces of a polytope that is cut by the best of some planes."""
    centre, axes, low, high = _principal_frame(corners)
    hull, size = convex_hull(corners), high - low
    best: list[FittedCapsule] = []
    least = 2, np.inf
    for i in np.flatnonzero(size >= LEAST_SHARE * size.max()):
        for share in CUTS:
            level = float(centre @ axes[:, i] + low[i] + share * size[i])
            pieces = _cut(corners, hull.simplices, axes[:, i], level)
            halves = [_fit_capsule(piece, body, COARSE_STEP) for piece in pieces]
            excess = [capsule.excess for capsule in halves]
            merit = sum(each > tolerance for each in excess), max(excess)
            if not best or merit < least:
                best, least = halves, merit
    return [_fit_capsule(half.corners, body) for half in best]


def _cut(corners: Float, triangles: Float, normal: Float, offset: float) -> tuple[Float, Float]:
    """Return the corners of the two pieces of a polytope below and above the plane normal . x = offset."""
    edges = np.concatenate((triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]))
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    height = corners @ normal - offset
    first = height[edges[:, 0]]
    second = height[edges[:, 1]]
    crosses = first * second < 0.0
    share = first[crosses] / (first[crosses] - second[crosses])
    start = corners[edges[crosses, 0]]
    end = corners[edges[crosses, 1]]
    between = start + share[:, None] * (end - start)
    # Corners on the plane belong to both pieces.
    below = corners[height <= ROUNDING]
    above = corners[height >= -ROUNDING]
    return np.concatenate((below, between)), np.concatenate((above, between))


def _principal_frame(points: Float) -> tuple[Float, Float, Float, Float]:
    """Return the mean of points, principal axes as columns, and the least and greatest coordinates along them."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2].T
    local = (points - centre) @ axes
    return centre, axes, local.min(axis=0), local.max(axis=0)
