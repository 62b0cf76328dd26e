"""Decorative shapes in a MuJoCo scene, which have no physics."""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float

Geom = Any
"""Decorative geom of a scene."""
Shape = mujoco.mjtGeom

MATT, GLOWING = 0.0, 1.0
"""Emission relative to the colour: lines glow, bodies are lit."""
VAULT = 0.4
"""Height of a post's rounded head relative to its radius."""


class ShapeWriter:
    """Writer of decorative shapes into a scene; shapes beyond the scene's capacity are left out."""

    def __init__(self, scene: mujoco.MjvScene) -> None:
        self._scene = scene

    def ball(self, centre: Float, radius: float, colour: Colour, glow: float = MATT) -> None:
        """Add a sphere at `centre` (3,) [m]."""
        self.geom(Shape.mjGEOM_SPHERE, (radius,) * 3, centre, colour, glow)

    def disc(self, centre: Float, radius: float, height: float, colour: Colour, glow: float = MATT) -> None:
        """Add a flat cylinder that stands on `centre` (3,) [m]."""
        middle = np.array([*centre[:2], centre[2] + height / 2.0])
        self.geom(Shape.mjGEOM_CYLINDER, (radius, height / 2.0, 0.0), middle, colour, glow)

    def rod(
        self, first: Float, second: Float, radius: float, colour: Colour, glow: float = MATT
    ) -> Geom | None:
        """Add a capsule from `first` (3,) to `second` (3,) [m]."""
        geom = self.geom(Shape.mjGEOM_CAPSULE, (radius,) * 3, first, colour, glow)
        if geom is not None:
            mujoco.mjv_connector(geom, Shape.mjGEOM_CAPSULE, radius, first, second)
        return geom

    def line(self, points: Float, radius: float, colour: Colour) -> None:
        """Add a tube through `points` (n, 3) [m] without a shadow."""
        for first, second in itertools.pairwise(points):
            geom = self.rod(first, second, radius, colour, GLOWING)
            if geom is not None:
                geom.castshadow = False

    def ring(self, centre: Float, radius: float, thickness: float, colour: Colour) -> None:
        """Add a circle on the table around `centre` (3,) [m]: two discs, far cheaper than a tube."""
        self.disc(centre, radius, 0.001, colour, GLOWING)
        self.disc(centre, radius - thickness, 0.002, PALETTE.table)

    def post(self, foot: Float, top: float, radius: float, colour: Colour) -> None:
        """Add an upright post with a rounded head, from `foot` (3,) up to the height `top` [m]."""
        vault = VAULT * radius
        self.disc(foot, radius, top - vault - foot[2], colour)
        head = np.array([*foot[:2], top - vault])
        self.geom(Shape.mjGEOM_ELLIPSOID, (radius, radius, vault), head, colour)

    def wall(self, foot: Float, half_axis: Float, top: float, radius: float, colour: Colour) -> None:
        """Add a rounded wall about `foot` (3,) along `half_axis` (3,), up to the height `top` [m]."""
        crest = top - radius
        ends = foot - half_axis, foot + half_axis
        for end in ends:
            self.rod(end, np.array([*end[:2], crest]), radius, colour)
        self.rod(np.array([*ends[0][:2], crest]), np.array([*ends[1][:2], crest]), radius, colour)
        half = float(np.linalg.norm(half_axis))
        along = half_axis / half
        turn = np.stack((along, (-along[1], along[0], 0.0), (0.0, 0.0, 1.0)), axis=-1)
        middle = np.array([*foot[:2], (foot[2] + crest) / 2.0])
        self.geom(Shape.mjGEOM_BOX, (half, radius, (crest - foot[2]) / 2.0), middle, colour, turn=turn)

    def geom(
        self,
        kind: int,
        size: tuple[float, ...],
        centre: Float,
        colour: Colour,
        glow: float = MATT,
        turn: Float | None = None,
        mesh: int = -1,
    ) -> Geom | None:
        """Add a MuJoCo geom of a size [m] at `centre` (3,) [m]; the columns of `turn` (3, 3) are its axes.

        A mesh has its index in the model.
        """
        if self._scene.ngeom >= self._scene.maxgeom:
            return None
        geom = self._scene.geoms[self._scene.ngeom]
        turn = np.eye(3) if turn is None else turn
        lit = np.array((*(c / (1.0 + glow) for c in colour), 1.0), dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size), centre, turn.flatten(), lit)
        geom.dataid = 2 * mesh if mesh >= 0 else -1  # odd numbers are hulls
        geom.emission, geom.specular, geom.shininess = glow, 0.15, 0.3
        self._scene.ngeom += 1
        return geom


def resampled(points: Float, spacing: float) -> Float:
    """Return points about `spacing` [m] apart along a polyline through `points` (n, D) [m], with both ends."""
    length = np.concatenate(([0.0], np.cumsum(norm(np.diff(points, axis=0)))))
    count = max(int(np.ceil(length[-1] / spacing)), 1) + 1
    places = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(places, length, column) for column in points.T], axis=-1)
