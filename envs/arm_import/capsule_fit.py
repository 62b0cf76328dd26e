"""Bounding capsules of the geoms of a link."""

from __future__ import annotations

import mujoco
import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float

Geom = mujoco.mjtGeom
Capsule = tuple[Float, float]
"""Ends of the axis, shape (2, 3), and radius, [m]."""

MIN_LENGTH = 1e-3
"""Least length of a capsule's axis, [m]."""
ROUNDING = 1e-6
"""Added to the radius, so that rounding leaves nothing outside, [m]."""
RIM_POINTS = 24
"""Points on each rim of a cylinder."""


def bounding_balls(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Float, float]:
    """Return balls whose convex hull is a geom: centres in the world, shape (n, 3), [m], and their common radius, [m].

    Ellipsoids count as their bounding boxes. Cylinders count as inscribed prisms, whose faces are up to 0.9 % of the
    radius inside. Planes, height fields and other unbounded geoms have no balls.
    """
    size, kind = model.geom_size[geom], Geom(int(model.geom_type[geom]))
    turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    radius = 0.0
    if kind == Geom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        local = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(np.float64)
    elif kind in (Geom.mjGEOM_SPHERE, Geom.mjGEOM_CAPSULE):
        half = size[1] if kind == Geom.mjGEOM_CAPSULE else 0.0
        local, radius = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), float(size[0])
    elif kind == Geom.mjGEOM_CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS, endpoint=False)
        rim = size[0] * np.stack((np.cos(angle), np.sin(angle), 0.0 * angle), axis=-1)
        local = np.concatenate((rim - (0.0, 0.0, size[1]), rim + np.array([0.0, 0.0, size[1]])))
    elif kind in (Geom.mjGEOM_BOX, Geom.mjGEOM_ELLIPSOID):
        local = size * np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
    else:
        return np.empty((0, 3)), 0.0
    return place + local @ turn.T, radius


def fit_capsule(centres: Float, radii: Float, axes: Float) -> Capsule:
    """Return the smallest capsule by volume, among some directions of its axis, that contains all balls.

    Args:
        centres: Centres of the balls, shape (n, 3), [m].
        radii: Radii of the balls, shape (n,), [m].
        axes: Directions to try, shape (m, 3), besides the principal axes of the centres.
    """
    centred = centres - centres.mean(axis=0)
    # The tiny rows give three axes where fewer than three points do not.
    principal = np.linalg.svd(np.concatenate((centred, np.eye(3) * 1e-9)), full_matrices=False)[2]
    capsules = [_capsule_along(centres, radii, axis) for axis in np.concatenate((axes, principal))]
    return min(capsules, key=_volume)


def _capsule_along(centres: Float, radii: Float, axis: Float) -> Capsule:
    """Return a capsule of a given direction that contains all balls.

    The axis runs through the middle of the bounding rectangle of the cross-section. The radius is the least that
    contains all balls from there, and the length the least for this radius: a ball of radius r at distance d from the
    axis is inside a cap whose centre is up to sqrt((R - r)^2 - d^2) away from it along the axis.
    """
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    sideways = np.linalg.svd(axis[None])[2][1:]  # two directions normal to the axis
    flat = centres @ sideways.T
    middle = 0.5 * ((flat - radii[:, None]).min(axis=0) + (flat + radii[:, None]).max(axis=0))
    away = norm(flat - middle)
    radius = float((away + radii).max()) + ROUNDING
    slack = np.sqrt((radius - radii) ** 2 - np.minimum(away, radius - radii) ** 2)
    along = centres @ axis
    low, high = float((along + slack).min()), float((along - slack).max())
    if high - low < MIN_LENGTH:
        low, high = 0.5 * (low + high - MIN_LENGTH), 0.5 * (low + high + MIN_LENGTH)
    centre = middle @ sideways
    return np.stack((centre + low * axis, centre + high * axis)), radius


def _volume(capsule: Capsule) -> float:
    ends, radius = capsule
    return float(np.pi * radius**2 * (np.linalg.norm(ends[1] - ends[0]) + 4.0 / 3.0 * radius))
