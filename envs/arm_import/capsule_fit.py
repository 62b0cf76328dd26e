"""A capsule around the shapes of a link."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from viapoint.envs.common.types import Float

Geom = mujoco.mjtGeom
MIN_LENGTH = 1e-3
"""Least length of a capsule's axis, [m]."""


def surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Float, float]:
    """Points of the world that span a geom, shape (n, 3), [m], and how far around them it reaches, [m]."""
    size, kind = model.geom_size[geom], Geom(int(model.geom_type[geom]))
    turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    around = 0.0
    if kind == Geom.mjGEOM_MESH:
        first = model.mesh_vertadr[model.geom_dataid[geom]]
        local = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[geom]]].astype(
            np.float64
        )
    elif kind in (Geom.mjGEOM_SPHERE, Geom.mjGEOM_CAPSULE):
        half = size[1] if kind == Geom.mjGEOM_CAPSULE else 0.0
        local, around = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), float(size[0])
    elif kind == Geom.mjGEOM_CYLINDER:
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        rim = size[0] * np.stack((np.cos(angle), np.sin(angle), 0.0 * angle), axis=-1)
        local = np.concatenate((rim - (0.0, 0.0, size[1]), rim + np.array([0.0, 0.0, size[1]])))
    elif kind in (Geom.mjGEOM_BOX, Geom.mjGEOM_ELLIPSOID):
        local = size * np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
    else:
        return np.empty((0, 3)), 0.0
    return place + local @ turn.T, around


def around_points(points: Float, around: Float, axes: Float) -> tuple[Float, float]:
    """The smallest capsule with one of some axes that contains balls: its ends, shape (2, 3), and its radius, [m].

    Args:
        points: Centres of the balls, shape (n, 3), [m].
        around: Their radii, shape (n,), [m].
        axes: Directions to try besides the principal ones, shape (m, 3).
    """
    centred = points - points.mean(axis=0)
    principal = np.linalg.svd(np.concatenate((centred, np.eye(3) * 1e-9)), full_matrices=False)[2]
    tried = [_along(points, around, axis) for axis in np.concatenate((axes, principal))]
    return min(tried, key=lambda capsule: _volume(*capsule))


def _along(points: Float, around: Float, axis: Float) -> tuple[Float, float]:
    """A capsule along an axis: as thin as the middle of its cross-section allows, then as short as it may be."""
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    sideways = np.linalg.svd(axis[None])[2][1:]
    flat = points @ sideways.T
    middle = 0.5 * ((flat - around[:, None]).min(axis=0) + (flat + around[:, None]).max(axis=0))
    away = np.sqrt(((flat - middle) ** 2).sum(axis=-1))
    radius = float((away + around).max()) + 1e-6
    bulge = np.sqrt((radius - around) ** 2 - np.minimum(away, radius - around) ** 2)
    along = points @ axis
    low, high = float((along + bulge).min()), float((along - bulge).max())
    if high - low < MIN_LENGTH:
        low, high = 0.5 * (low + high - MIN_LENGTH), 0.5 * (low + high + MIN_LENGTH)
    centre = middle @ sideways
    return np.stack((centre + low * axis, centre + high * axis)), radius


def _volume(ends: Float, radius: float) -> float:
    length: Any = np.linalg.norm(ends[1] - ends[0])
    return float(np.pi * radius**2 * (length + 4.0 / 3.0 * radius))
