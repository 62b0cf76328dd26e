"""Scene of the camera: arm, table, obstacles, and a movement drawn over them."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.mjcf import HIDDEN_GROUP
from viapoint.envs.common.arrays import in_space, norm
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.rows import rotation_axes, shape_columns, shape_number
from viapoint.envs.geometry.shapes import SHAPES
from viapoint.envs.rendering.overlay import Movement
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.simulator import Simulator

Geom = Any
"""Decorative geom of a scene."""
Shape = mujoco.mjtGeom

MATT, GLOWING = 0.0, 1.0
"""Emission relative to the colour: lines glow, bodies are lit."""
VAULT = 0.4
"""Height of a post's rounded head relative to its radius."""

CAMERA = "view"
OVERHEAD, AMONG = 0.5, 0.7
"""Opacity of links that pass above the obstacles, and of links that collide with them."""
LOW, TALL = 0.030, 0.060
"""Height of obstacles in the plane, [m]: below links that pass above them, and where links collide."""
PLAN, DONE = 0.0065, 0.0030
"""Radii of the planned and of the executed path, [m]; the planned one shows as a rim of the other."""
SPACING = 0.011
"""Distance of the points of a drawn path, [m]."""
FADED: Colour = tuple(0.6 * a + 0.4 * b for a, b in zip(PALETTE.plan, PALETTE.table, strict=True))  # type: ignore[assignment]
"""Colour of a replaced plan."""
FADED_RADIUS = 0.0045
"""Radius of the path of a replaced plan, [m]."""


class SceneView:
    """Writer of MuJoCo scenes with the arm, its surroundings and a movement."""

    scene: mujoco.MjvScene
    """Scene to write, which belongs to the screen that shows it."""

    def __init__(self, simulator: Simulator, width: int, height: int) -> None:
        """Copy the simulator's model, so that changes of appearance do not affect the simulation."""
        self.arm, self._meshes = simulator.arm, simulator.meshes
        self.model = copy.copy(simulator.model)
        self._data = mujoco.MjData(self.model)
        self._option = mujoco.MjvOption()
        self._hand = self.model.geom("hand").id
        self._links = self._geoms_of_links()
        self.whole_arm = any(self.model.geom_contype[g] for g in self._links)
        """True if the links collide, too."""
        self._floor = self._level_table()
        self._aim(width, height)
        if self.arm.dimension == 2:
            self.model.geom_rgba[self._links, 3] = AMONG if self.whole_arm else OVERHEAD

    def set(
        self, scene: Scenes, joints: Float, movement: Movement | None, step: int, replaced: Sequence[Float]
    ) -> None:
        """Set up one picture of a scene.

        Of a movement the whole plan is drawn, its execution up to a step, and the paths of plans that it replaced.
        """
        contact = None if movement is None else movement.contact
        contact = None if contact is None or step < contact.step else contact
        self._pose(joints)
        if contact is not None:
            self._paint(self._hand if contact.link is None else self._links[contact.link], PALETTE.contact)
        shapes = ShapeWriter(self.scene)
        self._draw_fittings(shapes)
        self._draw_ends(shapes, scene)
        self._draw_obstacles(shapes, scene, None if contact is None else contact.obstacle)
        if movement is not None:
            self._draw_movement(shapes, movement, step)
        for path in replaced:
            shapes.line(in_space(resampled(path, SPACING), self._floor + 0.001), FADED_RADIUS, FADED)

    def _pose(self, joints: Float) -> None:
        """Start the scene with the arm in a configuration."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        self._data.qpos[: len(joints)] = joints
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        mujoco.mjv_updateScene(
            self.model, self._data, self._option, None, self._camera, everything, self.scene
        )  # fmt: skip
        for geom in self._shown(self.model.geom("table").id):
            geom.castshadow = False  # there is nothing below it, and its own surface would be speckled

    def _geoms_of_links(self) -> list[int]:
        """Return the geoms of the moving bodies without the hand, and hide the obstacles' own geoms."""
        links = []
        for geom in range(self.model.ngeom):
            body = self.model.geom_bodyid[geom]
            if self.model.body_mocapid[body] >= 0:
                self.model.geom_group[geom] = HIDDEN_GROUP
            elif self.model.body_weldid[body] > 0 and geom != self._hand:
                links.append(geom)
        return links

    def _level_table(self) -> float:
        """Move the table right below the lowest moving part of a planar arm, and return its height, [m]."""
        table = self.model.geom("table").id
        if self.arm.dimension == 2 and self.whole_arm:
            self.model.geom_pos[table, 2] = -max(self.arm.link_radii) - 0.003
        return float(self.model.geom_pos[table, 2])

    def _aim(self, width: int, height: int) -> None:
        """Widen the camera's field of view for upright pictures, so that the whole workspace stays in view."""
        camera = self.model.camera(CAMERA).id
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        if width < height:
            half = np.tan(np.radians(self.model.cam_fovy[camera]) / 2.0)
            self.model.cam_fovy[camera] = 2.0 * np.degrees(np.arctan(half * height / width))

    def _paint(self, part: int, colour: Colour) -> None:
        """Colour one geom of the model."""
        for geom in self._shown(part):
            geom.rgba = np.array((*colour, 1.0), dtype=np.float32)

    def _shown(self, number: int) -> list[Any]:
        """Return the scene's geoms that show a geom of the model."""
        geoms = self.scene.geoms[: self.scene.ngeom]
        return [g for g in geoms if g.objtype == mujoco.mjtObj.mjOBJ_GEOM and g.objid == number]

    def _draw_fittings(self, shapes: ShapeWriter) -> None:
        """Draw base and joints of a planar arm, and the handle if the hand is below the links."""
        if self.arm.dimension != 2:
            return
        for geom, radius in zip(self._links, self.arm.link_radii, strict=True):
            joint = self._data.xpos[self.model.geom_bodyid[geom]]
            shapes.disc(joint, 0.55 * radius, radius + 0.004, PALETTE.joint)
        base = np.array([0.0, 0.0, self._floor])
        shapes.disc(base, 1.25 * self.arm.link_radii[0], self._data.xpos[1, 2] - self._floor, PALETTE.joint)
        hand = self._data.geom_xpos[self._hand]
        grip = np.array([*hand[:2], self._data.xpos[self.model.geom_bodyid[self._hand], 2]])
        if grip[2] - hand[2] > self.arm.hand_radius:
            shapes.rod(hand, grip, 0.5 * self.arm.hand_radius, PALETTE.joint)

    def _draw_ends(self, shapes: ShapeWriter, scene: Scenes) -> None:
        """Draw start and goal."""
        start, goal = in_space(scene.start[0], self._floor), in_space(scene.goal[0], self._floor)
        if self.arm.dimension == 2:
            shapes.ring(start, 0.021, 0.004, PALETTE.start)
            shapes.ring(goal, 0.031, 0.005, PALETTE.goal)
            shapes.disc(goal, 0.018, 0.003, PALETTE.goal, GLOWING)
        else:
            shapes.ball(goal, 0.018, PALETTE.goal, GLOWING)
            shapes.ball(start, 0.010, PALETTE.start, GLOWING)

    def _draw_obstacles(self, shapes: ShapeWriter, scene: Scenes, in_contact: int | None) -> None:
        """Draw obstacles; those of the plane are upright, capsules among them posts and walls."""
        dimension, top = self.arm.dimension, TALL if self.whole_arm else LOW
        for row in np.flatnonzero(scene.present[0]):
            numbers = scene.obstacles[0, row]
            colour: Colour = PALETTE.contact if row == in_contact else PALETTE.obstacle
            if shape_columns(numbers).kind != shape_number("capsule"):
                self._draw_shape(shapes, numbers, colour)
                continue
            centre, radius = in_space(numbers[:dimension], self._floor), float(numbers[-1])
            half_axis = in_space(numbers[dimension : 2 * dimension], 0.0)
            if dimension == 3 and half_axis.any():
                shapes.rod(centre - half_axis, centre + half_axis, radius, colour)
            elif dimension == 3:
                shapes.ball(centre, radius, colour)
            elif half_axis.any():
                shapes.wall(centre, half_axis, top, radius, colour)
            else:
                shapes.post(centre, top, radius, colour)

    def _draw_shape(self, shapes: ShapeWriter, row: Float, colour: Colour) -> None:
        """Draw an obstacle by its MuJoCo geoms, in the plane from the table up to the height of the others."""
        kind, centre, quaternion, half = shape_columns(row)
        shape = list(SHAPES.values())[int(kind)]
        if self.arm.dimension == 2 and rotation_axes(quaternion)[2][2] ** 2 > 0.5:
            top = TALL if self.whole_arm else LOW
            centre = np.array([*centre[:2], 0.5 * (self._floor + top)])
            half = np.array([*half[:2], 0.5 * (top - self._floor)])
        for geom in shape.from_box(centre, quaternion, half).geoms():
            position, turned, mesh = geom.position, geom.quaternion, self._meshes.get(shape.kind)
            if mesh is not None:
                (offset,), (turned,) = mesh.place(turned[None])
                position = position + offset
            turn = np.stack(rotation_axes(turned), axis=-1)
            shapes.geom(geom.type, geom.size, position, colour, turn=turn, mesh=mesh.mesh if mesh else -1)

    def _draw_movement(self, shapes: ShapeWriter, movement: Movement, step: int) -> None:
        """Draw the planned path, its via-points, and the executed path up to `step`, red after the first contact."""
        level = self._floor + 0.001
        planned = in_space(resampled(movement.planned, SPACING), level)
        shapes.line(planned, PLAN, PALETTE.plan)
        for via in in_space(movement.vias, level):
            shapes.ball(via, 0.011, PALETTE.via, GLOWING)
        free = step if movement.contact is None else min(step, movement.contact.step)
        for first, last, colour in ((0, free, PALETTE.executed), (free, step, PALETTE.contact)):
            if last > first:
                done = in_space(resampled(movement.hand[first : last + 1], SPACING), level + PLAN)
                shapes.line(done, DONE, colour)


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
