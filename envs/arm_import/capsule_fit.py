"""Capsules and spheres that cover the geoms of a link.

A capsule contains the convex hull of points if it contains the points. The point of a capsule that is farthest from a
convex body K is on one of the balls at its ends; the signed distance d of K tells how far. So for ends a, b, radius R

    excess = R + max(d(a), d(b)),   R = max over the points p of K of |p - segment(a, b)|.                        (1)

The ends minimise the excess. Where it is over the tolerance, a plane cuts K into two convex pieces, and a capsule for
each contains the piece; (1) still takes d from the whole of K.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.convex_mesh import ConvexMesh, Polytope
from viapoint.envs.geometry.distance import point_distance_squared

Geom = mujoco.mjtGeom

ROUNDING = 1e-6
"""Added to the radius, so that rounding leaves nothing outside, [m]."""
SHORTEST = 1e-3
"""Length of the axis below which a capsule becomes a sphere, [m]."""
RIM_POINTS = 24
"""Corners of each ring of the polytope around an ellipsoid, and half of those of the prism around a cylinder."""
CUTS = (0.35, 0.5, 0.65)
"""Places of the planes that cut a body, as shares of its length along a principal axis."""
LEAST_SHARE = 0.3
"""Least length along an axis across which a body is cut, as a share of the greatest."""
FIRST_STEP, LAST_STEP = 0.25, 5e-4
"""First and last step of the search for the ends, as shares of the size of the body."""
MOST_CAPSULES = 64
"""Greatest number of capsules for one geom."""


class Capsule(NamedTuple):
    """Capsule, or sphere, that covers a part of a link."""

    ends: Float
    """Ends of the axis, shape (2, 3), equal for a sphere, [m]."""
    radius: float
    """Radius, [m]."""
    excess: float
    """Greatest distance of a point of the capsule from the geom that it covers, [m]."""


def cover_geom(model: mujoco.MjModel, data: mujoco.MjData, geom: int, tolerance: float) -> list[Capsule]:
    """Return capsules and spheres that together contain a geom, in the world's frame.

    Spheres and capsules are returned as they are. Boxes, cylinders, ellipsoids and the convex hulls of meshes are
    covered, with a distance of `tolerance`, [m], between capsules and geom at most.

    Raises:
        ValueError: The geom is of another type, needs more than MOST_CAPSULES capsules, or is flat.
    """
    size, kind = model.geom_size[geom], Geom(int(model.geom_type[geom]))
    turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    if kind in (Geom.mjGEOM_SPHERE, Geom.mjGEOM_CAPSULE):
        half = size[1] * turn[:, 2] if kind == Geom.mjGEOM_CAPSULE else np.zeros(3)
        return [Capsule(np.stack((place - half, place + half)), float(size[0]), 0.0)]
    try:
        corners, larger = polytope_around(model, geom)
        found = cover_points(corners, tolerance - larger)
    except ValueError as error:
        raise ValueError(f"geom {model.geom(geom).name or geom}: {error}") from None
    return [Capsule(place + each.ends @ turn.T, each.radius, each.excess + larger) for each in found]


def polytope_around(model: mujoco.MjModel, geom: int) -> tuple[Float, float]:
    """Return the corners of a polytope that contains a geom, in the geom's frame, shape (n, 3), and its excess, [m].

    The excess is an upper bound of the distance of the corners from the geom. It is 0 for boxes and the convex hulls of
    meshes.

    Raises:
        ValueError: The geom is neither of these, nor a cylinder or an ellipsoid.
    """
    size, kind = model.geom_size[geom], Geom(int(model.geom_type[geom]))
    if kind == Geom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], np.float64), 0.0
    if kind == Geom.mjGEOM_BOX:
        return np.asarray(size * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))), 0.0
    if kind == Geom.mjGEOM_CYLINDER:
        rim = _rim(2 * RIM_POINTS)
        corners = np.concatenate([size[0] * rim + (0.0, 0.0, side * size[1]) for side in (-1.0, 1.0)])
        return corners, float(size[0] * (rim[0, 0] - 1.0))
    if kind == Geom.mjGEOM_ELLIPSOID:
        rim = _rim(RIM_POINTS)
        heights = np.sin(np.pi * (np.arange(1, RIM_POINTS // 2) / (RIM_POINTS // 2) - 0.5))
        rings = [np.sqrt(1.0 - z * z) * rim + (0.0, 0.0, z) for z in heights]
        poles = np.array([(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
        wide = rim[0, 0]
        return np.asarray(size * wide * np.concatenate((*rings, poles))), float(size.max() * (wide**2 - 1.0))
    raise ValueError(
        "a link may have geoms of the types sphere, capsule, cylinder, ellipsoid, box and mesh, not "
        f"{kind.name.removeprefix('mjGEOM_').lower()}"
    )


def _rim(number: int) -> Float:
    """Return the corners of a regular polygon around the unit circle, shape (number, 3)."""
    angle = 2.0 * np.pi * np.arange(number) / number
    wide = 1.0 / np.cos(np.pi / number)
    return np.stack((wide * np.cos(angle), wide * np.sin(angle), 0.0 * angle), axis=-1)


def cover_points(points: Float, tolerance: float) -> list[Capsule]:
    """Return capsules and spheres that together contain the convex hull of points, shape (n, 3), [m].

    Raises:
        ValueError: More than MOST_CAPSULES capsules are needed.
    """
    body = ConvexMesh.hull(points)
    pieces, found = [(body.vertices, fit_capsule(body.vertices, body))], []
    while pieces:
        corners, capsule = pieces.pop()
        if capsule.excess <= tolerance:
            found.append(capsule)
            continue
        if len(pieces) + len(found) + 2 > MOST_CAPSULES:
            raise ValueError(
                f"tolerance {tolerance:g} m takes more than {MOST_CAPSULES} capsules for one geom"
            )
        pieces += _best_halves(corners, body, tolerance)
    return found


def fit_capsule(corners: Float, body: ConvexMesh) -> Capsule:
    """Return a capsule that contains points, shape (n, 3), with little excess over a convex body around them, [m]."""
    centre, axes, (low, high) = _principal_frame(corners)
    size = float((high - low).max())
    best, least = np.empty((2, 3)), np.inf
    for i in range(3):
        others = 0.5 * (np.delete(low, i) + np.delete(high, i))
        inset = min(0.5 * float(np.delete(high - low, i).max()), 0.5 * float(high[i] - low[i]))
        ends = np.array([np.insert(others, i, z) for z in (low[i] + inset, high[i] - inset)])
        start = centre + ends @ axes.T
        refined, value = _refine(start, corners, body, size)
        if value < least:
            best, least = refined, value
    if norm(best[1] - best[0]) < SHORTEST:
        best = np.repeat(best.mean(axis=0)[None], 2, axis=0)
    radius = float(_radii(best[None], corners)[0]) + ROUNDING
    return Capsule(best, radius, radius + float(np.asarray(body.distance(best)).max()))


def _refine(ends: Float, corners: Float, body: ConvexMesh, size: float) -> tuple[Float, float]:
    """Return ends of the least excess (1) near some ends, by a compass search, and the excess without rounding."""
    moves = np.concatenate((np.eye(6), np.kron([[1.0, 1.0], [1.0, -1.0]], np.eye(3)))).reshape(-1, 2, 3)
    moves = np.concatenate((moves, -moves))
    normals, offsets = body.polytope.normals, body.polytope.offsets

    def excess(probes: Float) -> Float:
        heights = (probes @ normals.T - offsets).max(axis=(-2, -1))  # d of points inside, less than d outside
        return np.asarray(_radii(probes, corners) + heights)

    step, least = FIRST_STEP * size, float(excess(ends[None])[0])
    while step > LAST_STEP * size:
        probes = ends + step * moves
        values = excess(probes)
        i = int(values.argmin())
        if values[i] < least - 1e-9:
            ends, least = probes[i], float(values[i])
        else:
            step *= 0.5
    return ends, least


def _radii(ends: Float, corners: Float) -> Float:
    """Return the greatest distance of points from each of M segments, (M, 2, 3), shape (M,), [m]."""
    rows = np.concatenate(
        (ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0]), np.zeros((len(ends), 1))), axis=-1
    )
    return np.asarray(np.sqrt(point_distance_squared(corners, rows).max(axis=-1)))


def _best_halves(corners: Float, body: ConvexMesh, tolerance: float) -> list[tuple[Float, Capsule]]:
    """Return the corners of two pieces of a polytope, and their capsules, cut by the best of some planes."""
    centre, axes, (low, high) = _principal_frame(corners)
    polytope, size = ConvexMesh.hull(corners).polytope, high - low
    best: list[tuple[Float, Capsule]] = []
    least = 2, np.inf
    for i in np.flatnonzero(size >= LEAST_SHARE * size.max()):
        for share in CUTS:
            level = float(centre @ axes[:, i] + low[i] + share * size[i])
            halves = [
                (piece, fit_capsule(piece, body))
                for piece in cut_polytope(corners, polytope, axes[:, i], level)
            ]
            excess = [capsule.excess for _, capsule in halves]
            merit = sum(each > tolerance for each in excess), max(excess)
            if not best or merit < least:
                best, least = halves, merit
    return best


def cut_polytope(corners: Float, polytope: Polytope, normal: Float, offset: float) -> tuple[Float, Float]:
    """Return the corners of the two pieces of a polytope below and above the plane normal . x = offset."""
    height = corners @ normal - offset
    first, along = polytope.starts @ normal - offset, polytope.edges @ normal
    crosses = first * (first + along) < 0.0
    share = -first[crosses] / along[crosses]
    between = polytope.starts[crosses] + share[:, None] * polytope.edges[crosses]
    # Corners on the plane belong to both pieces.
    low, high = corners[height <= ROUNDING], corners[height >= -ROUNDING]
    return np.concatenate((low, between)), np.concatenate((high, between))


def _principal_frame(points: Float) -> tuple[Float, Float, Float]:
    """Return the mean of points, principal axes as columns, and lowest and highest coordinates, shape (2, 3)."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2].T
    local = (points - centre) @ axes
    return centre, axes, np.stack((local.min(axis=0), local.max(axis=0)))
