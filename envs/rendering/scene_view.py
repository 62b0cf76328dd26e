"""Scene of the camera: arm and obstacles as the simulation has them, and a movement drawn over them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.common.arrays import norm
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.obstacles import Obstacles, bounding_boxes
from viapoint.envs.simulator import Simulator

Geom = Any  # Decorative geom of a scene

MATT, GLOWING = 0.0, 1.0  # Emission relative to the colour: lines glow, bodies are lit
CAMERA = "view"
# Radii of the planned, the executed and a replaced path, [m]; the planned one shows as a rim of the executed
PLAN, DONE, REPLACED = 0.0065, 0.0030, 0.0045
SPACING = 0.011  # Distance of the points of a drawn path, [m]
# Radius of the points that a sensor has met, [m], and how many of them are drawn at most
SEEN, MOST_SEEN = 0.004, 600
# Half lengths of the board that stands for a half-space, [m], and its opacity
HALF_SPACE_BOARD, GLASSY = (1.0, 1.0, 0.002), 0.4
BELOW_SURFACE = 0.008  # Depth of this board, [m]: a floor at the height of the table is hidden by it
ABOVE_TABLE = 0.001  # Height of paths of the plane above the table, [m]
# Colour of a replaced plan
FADED: Colour = tuple(0.6 * a + 0.4 * b for a, b in zip(PALETTE.plan, PALETTE.table, strict=True))  # type: ignore[assignment]


class Picture(NamedTuple):
    """Arm, obstacles and paths of one picture."""

    joints: Float  # Joint positions, shape (J,), [rad]
    obstacles: Obstacles  # Obstacles at their present places, of one scene
    ends: tuple[Float, Float]  # Hand positions at start and goal, shape (3,) each, [m]
    planned: Float  # Planned path of the hand, shape (n, 3), [m]; empty for none
    vias: Float  # Via-points of the hand, shape (K, 3), [m]
    done: Float  # Executed path of the hand so far, shape (T, 3), [m]
    touched: int  # Index into the executed path of the first contact; its length without contact
    replaced: Sequence[Float]  # Paths of plans that were replaced, shape (n, 3) each, [m]
    seen: Float  # Points that a sensor has met, shape (M, 3), [m]


class SceneView:
    """Writer of MuJoCo scenes with the arm, its surroundings and a movement, for pictures of a size in pixels.

    It uses a simulator of one simulation alone.
    """

    scene: mujoco.MjvScene  # Scene to write, which belongs to the screen that shows it

    def __init__(self, simulator: Simulator, width: int, height: int) -> None:
        self._simulator = simulator
        self.model = simulator.model
        self._data = mujoco.MjData(self.model)
        self._option = mujoco.MjvOption()
        self._flat = simulator.arm.space == "hand"
        self._floor = float(self.model.geom("table").pos[2])
        self._aim(width, height)

    def write(self, picture: Picture) -> None:
        """Set up one picture."""
        self._pose(picture)
        shapes = ShapeWriter(self.scene)
        self._draw_ends(shapes, picture)
        for path in picture.replaced:
            shapes.line(self._lowered(path), REPLACED, FADED)
        if len(picture.planned):
            shapes.line(self._lowered(picture.planned), PLAN, PALETTE.plan)
        for via in self._lowered(picture.vias):
            shapes.ball(via, 0.011, PALETTE.via, GLOWING)
        seen = picture.seen[:: -(-len(picture.seen) // MOST_SEEN) or 1].copy()
        if self._flat and len(seen):  # on top of the obstacles, whose sides the camera hardly sees
            centre, half = bounding_boxes(picture.obstacles)
            seen[:, 2] = (centre + half)[0, picture.obstacles.present[0], 2].max()
        for point in seen:
            shapes.ball(point, SEEN, PALETTE.seen, GLOWING)
        free = picture.touched
        done = self._lowered(picture.done)
        for part, colour in ((done[: free + 1], PALETTE.executed), (done[free:], PALETTE.contact)):
            if len(part) > 1:
                shapes.line(part + np.array([0.0, 0.0, PLAN]), DONE, colour)

    def _pose(self, picture: Picture) -> None:
        """Start the scene with the arm in a configuration among the obstacles; geoms in contact are red."""
        model, data = self.model, self._data
        self._simulator.place(np.zeros(1, np.int64), picture.joints[None], picture.obstacles)
        self._simulator.copy_obstacles(0, model, data, picture.obstacles.centre[0])
        data.qpos[: len(picture.joints)] = picture.joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self.scene)
        table = model.geom("table").id
        for geom in self._shown({table}):
            geom.castshadow = False  # there is nothing below it, and its own surface would be speckled
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE and geom.objid != table:
                # MuJoCo draws the planes that the model was compiled with, and others as something else.
                geom.type, geom.dataid, geom.size = mujoco.mjtGeom.mjGEOM_BOX, -1, HALF_SPACE_BOARD
                geom.pos = geom.pos - BELOW_SURFACE * geom.mat[:, 2]
                geom.rgba[3], geom.transparent = GLASSY, True
                geom.castshadow = False
        if picture.touched < len(picture.done):
            mujoco.mj_collision(model, data)
            pairs = data.contact.geom[: data.ncon].ravel()
            for geom in self._shown({int(each) for each in pairs}):
                geom.rgba = np.array((*PALETTE.contact, 1.0), dtype=np.float32)

    def _aim(self, width: int, height: int) -> None:
        """Widen the camera's field of view for upright pictures, so that the whole workspace stays in view."""
        camera = self.model.camera(CAMERA).id
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        if width < height:
            half = np.tan(np.radians(self.model.cam_fovy[camera]) / 2.0)
            self.model.cam_fovy[camera] = 2.0 * np.degrees(np.arctan(half * height / width))

    def _shown(self, numbers: set[int]) -> list[Any]:
        """Return the scene's geoms that show some geoms of the model."""
        geoms = self.scene.geoms[: self.scene.ngeom]
        return [g for g in geoms if g.objtype == mujoco.mjtObj.mjOBJ_GEOM and g.objid in numbers]

    def _lowered(self, points: Float) -> Float:
        """Return points on the table for arms in the plane, where obstacles would hide them, else as they are."""
        if not self._flat:
            return points
        flat = points.copy()
        flat[..., 2] = self._floor + ABOVE_TABLE
        return flat

    def _draw_ends(self, shapes: ShapeWriter, picture: Picture) -> None:
        """Draw start and goal."""
        start, goal = (self._lowered(end) for end in picture.ends)
        if self._flat:
            shapes.ring(start, 0.021, 0.004, PALETTE.start)
            shapes.ring(goal, 0.031, 0.005, PALETTE.goal)
            shapes.disc(goal, 0.018, 0.003, PALETTE.goal, GLOWING)
        else:
            shapes.ball(goal, 0.018, PALETTE.goal, GLOWING)
            shapes.ball(start, 0.010, PALETTE.start, GLOWING)


class ShapeWriter:
    """Writer of decorative shapes into a scene; shapes beyond the scene's capacity are left out."""

    def __init__(self, scene: mujoco.MjvScene) -> None:
        self._scene = scene

    def ball(self, centre: Float, radius: float, colour: Colour, glow: float = MATT) -> None:
        """Add a sphere at `centre` (3,) [m], without a shadow."""
        geom = self._geom(mujoco.mjtGeom.mjGEOM_SPHERE, (radius,) * 3, centre, colour, glow)
        if geom is not None:
            geom.castshadow = False

    def disc(self, centre: Float, radius: float, height: float, colour: Colour, glow: float = MATT) -> None:
        """Add a flat cylinder that stands on `centre` (3,) [m]."""
        middle = np.array([*centre[:2], centre[2] + height / 2.0])
        self._geom(mujoco.mjtGeom.mjGEOM_CYLINDER, (radius, height / 2.0, 0.0), middle, colour, glow)

    def ring(self, centre: Float, radius: float, thickness: float, colour: Colour) -> None:
        """Add a circle on the table around `centre` (3,) [m]: two discs, far cheaper than a tube."""
        self.disc(centre, radius, 0.001, colour, GLOWING)
        self.disc(centre, radius - thickness, 0.002, PALETTE.table)

    def line(self, points: Float, radius: float, colour: Colour) -> None:
        """Add a tube along a polyline, shape (n, 3), [m], without a shadow."""
        for first, second in itertools.pairwise(resampled(points, SPACING)):
            geom = self._geom(mujoco.mjtGeom.mjGEOM_CAPSULE, (radius,) * 3, first, colour, GLOWING)
            if geom is not None:
                mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, radius, first, second)
                geom.castshadow = False

    def _geom(
        self, kind: int, size: tuple[float, ...], centre: Float, colour: Colour, glow: float
    ) -> Geom | None:
        """Add a MuJoCo geom of a size [m] at `centre` (3,) [m]."""
        if self._scene.ngeom >= self._scene.maxgeom:
            return None
        geom = self._scene.geoms[self._scene.ngeom]
        lit = np.array((*(c / (1.0 + glow) for c in colour), 1.0), dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size), centre, np.eye(3).flatten(), lit)
        geom.emission, geom.specular, geom.shininess = glow, 0.15, 0.3
        self._scene.ngeom += 1
        return geom


def resampled(points: Float, spacing: float) -> Float:
    """Return points about `spacing` [m] apart along a polyline through `points` (n, 3) [m], with both ends."""
    length = np.concatenate(([0.0], np.cumsum(norm(np.diff(points, axis=0)))))
    count = max(int(np.ceil(length[-1] / spacing)), 1) + 1
    places = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(places, length, column) for column in points.T], axis=-1)
